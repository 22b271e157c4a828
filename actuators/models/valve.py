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

from typing import Any, ClassVar

import numpy as np
import torch

from actuators.models.parameters import PerJoint, SpreadParameters, expand_per_joint
from actuators.models.transport import check_dead_time, select_commands_in_force
from brokk_rl.errors import ConfigError
from brokk_rl.gravity import Gravity
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

NUMBERS = ("dead_time_s", "play", "spool_s", "speed_s", "demand")
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
        spread: Relative half width, by field name, of draws per environment and joint at
            reset.
    """

    label: ClassVar = "valve"

    dead_time_s: PerJoint | None
    play: PerJoint
    spool_s: PerJoint
    speed_s: PerJoint
    demand: PerJoint
    knots: tuple[float, ...]
    curve_extend: tuple[float, ...] | dict[str, tuple[float, ...]]
    curve_retract: tuple[float, ...] | dict[str, tuple[float, ...]]
    pose_extend: dict[str, tuple[float, ...]]
    pose_retract: dict[str, tuple[float, ...]]
    spread: dict[str, float]

    def check(self) -> None:
        steps = np.diff(self.knots)
        if (
            len(self.knots) < 2
            or self.knots[0] != 0.0
            or self.knots[-1] != 1.0
            or (steps <= 0).any()
        ):
            raise ConfigError(
                f"actuator.knots: expected strokes that rise from 0 to 1, got {list(self.knots)}"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "ValveModel":
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
        found: dict[str, Any] = {name: model.parameters[name][0].tolist() for name in NUMBERS}
        found["knots"] = list(self.knots)
        for name, value in _list_curves(self):
            rows = _expand_rows(value, machine, len(self.knots), f"actuator.{name}")
            found[name] = rows.tolist()
        found["pose"] = model.export_pose()
        return found


class PoseFeatures:
    """Features of the speed besides the command: load, its square, and all positions.

    The weight on the joints of a planar arm is linear in the sines and cosines of the sums of its
    angles, which costs a tenth of the whole mechanics; where that is exact it is used, else the
    mechanics are.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        lower, upper = (
            torch.as_tensor(side, dtype=torch.float32, device=device)
            for side in (machine.lower, machine.upper)
        )
        self._middle, self._half = (lower + upper) / 2, (upper - lower) / 2
        self.size = machine.num_joints + (2 if machine.has_bodies else 0)
        self._weighs = machine.has_bodies
        if not self._weighs:
            return
        self._gravity = Gravity(machine, device)
        self._force = torch.tensor(
            [body.yield_force.value for body in machine.bodies], dtype=torch.float32, device=device
        )
        hinges = np.array([joint.kind == "hinge" for joint in machine.joints])
        axes = np.array([body.axis for body in machine.bodies])
        sums = np.tril(np.abs(axes @ axes.T) > 1.0 - 1e-6) & hinges & hinges[:, None]
        signs = np.sign(axes @ axes.T)
        self._sums = torch.as_tensor((sums * signs).T, dtype=torch.float32, device=device)
        at = (
            torch.rand(256, machine.num_joints, generator=torch.Generator().manual_seed(0)).to(
                device
            )
            * (upper - lower)
            + lower
        )
        truth = self._gravity.load(at) / self._force
        found = torch.linalg.lstsq(self._waves(at).double().cpu(), truth.double().cpu()).solution
        self._linear = found.float().to(device)
        self._planar = bool((self._waves(at) @ self._linear - truth).abs().max() < 1e-3)

    def features(self, q: torch.Tensor) -> torch.Tensor:
        """Return the features of each joint at positions `q` `(N, J)`, shape `(N, J, M)`."""
        place = ((q - self._middle) / self._half).clamp(-BEYOND, BEYOND)
        place = place[:, None, :].expand(-1, q.shape[1], -1)
        if not self._weighs:
            return place
        weight = self._weight(q)[..., None]
        return torch.cat((weight, weight.square(), place), 2)

    def export_weight(self) -> dict[str, Any]:
        """Return the sums of angles and the coefficients of the weight; empty without masses.

        Raises:
            ConfigError: the weight is no sum of sines and cosines.
        """
        if not self._weighs:
            return {"sums": [], "linear": []}
        if not self._planar:
            raise ConfigError(
                "actuator: expected an arm whose weight is a sum of sines and cosines of its angles; "
                "leave out pose_extend and pose_retract"
            )
        return {"sums": self._sums.tolist(), "linear": self._linear.tolist()}

    def _weight(self, q: torch.Tensor) -> torch.Tensor:
        return (
            self._waves(q) @ self._linear if self._planar else self._gravity.load(q) / self._force
        )

    def _waves(self, q: torch.Tensor) -> torch.Tensor:
        angle = q @ self._sums
        return torch.cat((angle.cos(), angle.sin(), torch.ones_like(angle[:, :1])), 1)


class ValveModel:
    """The grey box at work in `N` environments; see the module for its equations.

    Attributes:
        parameters: Numbers by name, `(N, J)`; write in place to simulate `N` candidates side by
            side.
    """

    def __init__(
        self, config: ValveActuator, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        given = {name: getattr(config, name) for name in NUMBERS}
        given["dead_time_s"] = (
            machine.dead_time_s if config.dead_time_s is None else config.dead_time_s
        )
        nominal = {
            name: expand_per_joint(value, machine, f"actuator.{name}")
            for name, value in given.items()
        }
        for name, value in nominal.items():
            if (value < 0).any():
                raise ConfigError(f"actuator.{name}: expected 0 or more, got {value.tolist()}")
        longest_s = nominal["dead_time_s"].max() * (1.0 + config.spread.get("dead_time_s", 0.0))
        check_dead_time(float(longest_s), machine, "actuator.dead_time_s")
        self._parameters = SpreadParameters(
            nominal, config.spread, num_envs, device, "actuator.spread"
        )
        self.parameters = self._parameters.value
        self._period_s = machine.period_s

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self._full_step = tensor(machine.max_speed * machine.period_s)
        self._lower, self._upper = tensor(machine.lower), tensor(machine.upper)
        curves = [
            _expand_rows(value, machine, len(config.knots), f"actuator.{name}")
            for name, value in _list_curves(config)
        ]
        self._table = tensor(tabulate_curves(np.array(config.knots), *curves)).reshape(-1)
        full = tensor(np.maximum(np.stack([curve[:, -1] for curve in curves]), 1e-3))
        self._full_extend, self._full_retract = full[0], full[1]
        self._row = torch.arange(machine.num_joints, device=device) * (CELLS + 1)
        self._pose = (
            PoseFeatures(machine, device) if config.pose_extend or config.pose_retract else None
        )
        if self._pose:
            names = ("pose_extend", "pose_retract")
            self._slopes = [
                tensor(
                    _expand_rows(
                        getattr(config, n) or {}, machine, self._pose.size, f"actuator.{n}"
                    )
                )
                for n in names
            ]
        shape = (num_envs, machine.num_joints)
        self._state = {
            name: torch.zeros(shape, device=device) for name in ("pilot", "spool", "step")
        }
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`pilot`, `spool` (of full stroke), `step` (motion in a period), each `(N, J)`; draws."""
        return {**self._state, "fresh": self._fresh, **self._parameters.state}

    def export_pose(self) -> dict[str, Any] | None:
        """Return the tables of the pose as plain data; `None` without any.

        Raises:
            ConfigError: the weight on the joints is no sum of sines and cosines.
        """
        if self._pose is None:
            return None
        extend, retract = (slope.tolist() for slope in self._slopes)
        return self._pose.export_weight() | {"extend": extend, "retract": retract}

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, start from their history."""
        for value in self._state.values():
            value.masked_fill_(mask[:, None], 0.0)
        self._fresh.logical_or_(mask)
        self._parameters.redraw(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        value, state, dt = self.parameters, self._state, self._period_s
        earlier, later, part = select_commands_in_force(history.u, value["dead_time_s"] / dt)
        q, fresh = history.q[:, -1], self._fresh[:, None]
        u = torch.lerp(later, earlier, part)
        play = 0.5 * value["play"]
        pilot = torch.where(fresh, earlier, state["pilot"])
        pilot = torch.minimum(torch.maximum(pilot, u - play), u + play)
        spool = torch.lerp(
            pilot, torch.where(fresh, earlier, state["spool"]), _compute_decay(dt, value["spool_s"])
        )
        flow = self._flow(spool)
        full = torch.where(spool > 0, self._full_extend, self._full_retract)
        asked = (value["demand"] * (flow / full).abs()).sum(1, keepdim=True)
        wanted = flow * self._full_step / asked.clamp(min=1.0)
        if self._pose:
            features = self._pose.features(q)
            slopes = [(features * slope).sum(2) for slope in self._slopes]
            wanted = wanted * (1.0 + torch.where(spool > 0, *slopes)).clamp(min=0.0)
        before = torch.where(fresh, q - history.q[:, -2], state["step"])
        step = torch.lerp(wanted, before, _compute_decay(dt, value["speed_s"]))
        moved = q + step
        held = torch.minimum(
            torch.maximum(moved, torch.minimum(self._lower, q)), torch.maximum(self._upper, q)
        )
        for name, now in (
            ("pilot", pilot),
            ("spool", spool),
            ("step", step.masked_fill(held != moved, 0.0)),
        ):
            state[name].copy_(now)
        self._fresh.fill_(False)
        return held

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
        rows.append(
            np.concatenate([-np.interp(half[:0:-1], knots, back), np.interp(half, knots, out)])
        )
    return np.stack(rows)


def _compute_decay(period_s: float, time_constant_s: torch.Tensor) -> torch.Tensor:
    """Return the part of a first-order lag's state that is left after a period."""
    return torch.exp(-period_s / time_constant_s.clamp(min=1e-6))


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
