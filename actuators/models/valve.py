"""Grey box with a measured valve curve: quick to fit and to run.

Per joint, once a control period; everything but the play is linear, or a table:

    u        command of `dead_time_s` ago, its mean over the period
    play     play operator of width `play` on u
    spool    first-order lag `spool_s`
    flow     `curve_extend` or `curve_retract` of |spool|, between `knots` straight, in parts of the
    machine's `max_speed` share    1 / max(1, sum over joints of `demand` * |flow| / |flow at full
    command|): one pump pose     1 + `pose_…` . (weight, weight squared, positions of all joints),
    of its direction; weight only where masses are known speed    first-order lag `speed_s` of flow
    * share * pose; a joint at its stop has none

The curve takes in dead bands, gain, asymmetry, notches and saturation; load and geometry of the
cylinder are in the pose.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch

from actuators.models.joint_model import CommandParts, JointMemory, PlannableModel
from actuators.models.joint_weight import build_joint_weight
from actuators.models.machine_tensors import MachineTensors
from actuators.models.parameters import NonNegativePerJoint
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

CELLS = 512
"""The curves are tabulated in so many equal steps of the spool's whole stroke: a step is finer than
any valve repeats."""
BEYOND = 1.2
"""Positions, in halves of the travel from its middle, beyond which the pose counts no further."""


@spec
class ValveActuator:
    """Dead time, play, two lags, a measured flow curve on each side, one pump, pose dependence.

    Attributes:
        dead_time_s: Pure transport delay of the command; `null` takes the machine's.
        play: Width of the play between command and spool, of full command.
        spool_s: Time constant with which the spool follows.
        speed_s: Time constant with which the speed follows the flow.
        demand: Flow at full command over the flow of the pump.
        knots: Spool strokes, rising from 0 to 1, at which the curves are given.
        curve_extend: Speed at each knot over the machine's `max_speed`, positive direction; one
            curve for all joints, or by joint.
        curve_retract: The same for the negative direction, positive numbers.
        pose_extend: Relative change of the speed per feature of the pose, positive direction, by
            joint; empty for none.
        pose_retract: The same for the negative direction.
    """

    label: ClassVar = "valve"

    dead_time_s: NonNegativePerJoint | None
    play: NonNegativePerJoint
    spool_s: NonNegativePerJoint
    speed_s: NonNegativePerJoint
    demand: NonNegativePerJoint
    knots: tuple[float, ...]
    curve_extend: tuple[float, ...] | dict[str, tuple[float, ...]]
    curve_retract: tuple[float, ...] | dict[str, tuple[float, ...]]
    pose_extend: dict[str, tuple[float, ...]]
    pose_retract: dict[str, tuple[float, ...]]

    def check(self) -> None:
        ends = self.knots[:1] + self.knots[-1:]
        if ends != (0.0, 1.0) or (np.diff(self.knots) <= 0).any():
            raise ConfigError(
                f"actuator.knots: expected strokes that rise from 0 to 1, got {list(self.knots)}"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ValveModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: a number makes no sense, a table has the wrong length, or the dead time
                does not fit the machine's history.
        """
        return ValveModel(self, machine, num_envs, device)

    def export_tables(self, machine: Machine) -> dict[str, Any]:
        """Return all numbers by joint, as plain data, for a computer without torch.

        Raises:
            ConfigError: as `build`, or the weight on the joints is no sum of sines and cosines.
        """
        model = self.build(machine, 1, torch.device("cpu"))
        found: dict[str, Any] = {key: row[0].tolist() for key, row in model.parameters.items()}
        found["knots"] = list(self.knots)
        for name, value in _list_curves(self):
            rows = _expand_rows(value, machine, len(self.knots), f"actuator.{name}")
            found[name] = rows.tolist()
        found["pose"] = None
        if self.pose_extend or self.pose_retract:
            pose = PoseFeatures(machine, torch.device("cpu"))
            found["pose"] = pose.export_weight()
            for name in ("extend", "retract"):
                slopes = getattr(self, f"pose_{name}") or {}
                rows = _expand_rows(slopes, machine, pose.size, f"actuator.pose_{name}")
                found["pose"][name] = rows.tolist()
        return found


class PoseFeatures:
    """Features of the speed besides the command: load, its square, and all positions."""

    def __init__(self, machine: Machine, device: torch.device) -> None:
        self._plant = MachineTensors(machine, device)
        self.size = machine.num_joints + (2 if machine.has_bodies else 0)
        self.weight = build_joint_weight(machine, device) if machine.has_bodies else None

    def features(self, q: torch.Tensor) -> torch.Tensor:
        """Return the features of each joint at positions `q` `(N, J)`, shape `(N, J, M)`."""
        place = self.place(q)[:, None, :].expand(-1, q.shape[1], -1)
        if self.weight is None:
            return place
        weight = self.weight.weigh(q)[..., None]
        return torch.cat((weight, weight.square(), place), 2)

    def export_weight(self) -> dict[str, Any]:
        """Return the sums of angles and the coefficients of the weight; empty without masses.

        Raises:
            ConfigError: the weight is no sum of sines and cosines.
        """
        weight = self.weight
        if weight is None:
            return {"sums": [], "linear": []}
        if not weight.is_planar:
            raise ConfigError(
                "actuator: expected an arm whose weight is a sum of sines and cosines of its angles; "
                "leave out pose_extend and pose_retract"
            )
        linear = torch.cat((weight.linear, weight.constant[None]))
        return {"sums": weight.sums.tolist(), "linear": linear.tolist()}

    def place(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions from the middle of the travel, in halves of it, `(N, J)`."""
        return ((q - self._plant.middle) / self._plant.half_travel).clamp(-BEYOND, BEYOND)


class ValveModel(PlannableModel):
    """The grey box at work in `N` environments; see the module for its equations.

    `pilot` and `spool` are of full stroke, `step` is the motion in a period.
    """

    STATES = ("pilot", "spool", "step")
    INTERFACE = ("speed", "a valve sets speeds")

    def __init__(
        self, config: ValveActuator, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        super().__init__(config, machine, num_envs, device)

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        curves = [
            _expand_rows(value, machine, len(config.knots), f"actuator.{name}")
            for name, value in _list_curves(config)
        ]
        self._table = tensor(tabulate_curves(np.array(config.knots), *curves)).reshape(-1)
        full = tensor(np.maximum(np.stack([curve[:, -1] for curve in curves]), 1e-3))
        self._full_extend, self._full_retract = full[0], full[1]
        self._row = torch.arange(machine.num_joints, device=device) * (CELLS + 1)
        self._pose = None
        if config.pose_extend or config.pose_retract:
            pose, sides = PoseFeatures(machine, device), []
            for name in ("pose_extend", "pose_retract"):
                rows = getattr(config, name) or {}
                sides.append(_expand_rows(rows, machine, pose.size, f"actuator.{name}"))
            self._pose, self._slopes = pose, tensor(np.stack(sides))

    def solve(self, drive: CommandParts) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the parts of spool and speed that are left after a period."""
        return self._compute_decay("spool_s"), self._compute_decay("speed_s")

    def begin(self, drive: CommandParts, q: torch.Tensor, before: torch.Tensor) -> JointMemory:
        """Return spools at the command in force, and the motion that the history shows."""
        return {"pilot": drive.earlier[0], "spool": drive.earlier[0], "step": q - before}

    def advance(
        self,
        k: int,
        q: torch.Tensor,
        drive: CommandParts,
        solution: tuple[torch.Tensor, torch.Tensor],
        memory: JointMemory,
    ) -> tuple[torch.Tensor, JointMemory]:
        """Return positions, spools and the motion after step `k`."""
        spool_kept, step_kept = solution
        command = torch.lerp(drive.later[k], drive.earlier[k], drive.part)
        play = 0.5 * self.parameters["play"]
        pilot = memory["pilot"].clamp(command - play, command + play)
        spool = torch.lerp(pilot, memory["spool"], spool_kept)
        wanted = self._want(spool)
        if self._pose:
            both = (self._slopes[:, None] * self._pose.features(q)).sum(-1)
            change = torch.where(spool > 0, both[0], both[1])
            wanted = wanted * (1.0 + change).clamp(min=0.0)
        step = torch.lerp(wanted, memory["step"], step_kept)
        moved = q + step
        held = self.plant.hold_from(q, moved)
        step = step.masked_fill(held != moved, 0.0)
        return held, {"pilot": pilot, "spool": spool, "step": step}

    def _compute_decay(self, name: str) -> torch.Tensor:
        """Return the part of a first-order lag's state that is left after a period."""
        return torch.exp(-self.plant.period_s / self.parameters[name].clamp(min=1e-6))

    def _want(self, spool: torch.Tensor) -> torch.Tensor:
        """Return the motion in a period that spools `(N, J)` ask for in the mean pose."""
        flow = self._flow(spool)
        full = torch.where(spool > 0, self._full_extend, self._full_retract)
        asked = (self.parameters["demand"] * (flow / full).abs()).sum(-1, keepdim=True)
        return flow * self.plant.full_step / asked.clamp(min=1.0)

    def _flow(self, spool: torch.Tensor) -> torch.Tensor:
        place = (spool.clamp(-1.0, 1.0) + 1.0) * (CELLS / 2)
        cell = place.floor().clamp(max=CELLS - 1)
        at = cell.to(torch.int64) + self._row
        return torch.lerp(self._table[at], self._table[at + 1], place - cell)


def tabulate_curves(knots: np.ndarray, extend: np.ndarray, retract: np.ndarray) -> np.ndarray:
    """Return signed speeds at equal steps of the spool, `(J, CELLS + 1)`; curves `(J, K)`."""
    half = np.linspace(0.0, 1.0, CELLS // 2 + 1)
    rows = []
    for out, back in zip(extend, retract, strict=True):
        negative, positive = np.interp(half[:0:-1], knots, back), np.interp(half, knots, out)
        rows.append(np.concatenate([-negative, positive]))
    return np.stack(rows)


def _list_curves(config: ValveActuator) -> tuple[tuple[str, object], tuple[str, object]]:
    return ("curve_extend", config.curve_extend), ("curve_retract", config.curve_retract)


def _expand_rows(value: object, machine: Machine, size: int, where: str) -> np.ndarray:
    """Return the table `value` as `(J, size)`; zeros where it is empty."""
    if isinstance(value, tuple):
        value = dict.fromkeys(machine.joint_names, value)
    assert isinstance(value, dict)
    if not value:
        return np.zeros((machine.num_joints, size))
    rows = []
    for name in machine.joint_names:
        if name not in value:
            raise ConfigError(f"{where}: no row for joint {name} of machine '{machine.name}'")
        if len(value[name]) != size:
            raise ConfigError(f"{where}.{name}: expected {size} numbers, got {len(value[name])}")
        rows.append(value[name])
    return np.array(rows)
