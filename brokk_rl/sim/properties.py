"""State, faults and properties that the worlds of both simulators share.

Properties of a machine are nominal numbers times factors, which events draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
import torch

from brokk_rl.machine import Machine
from brokk_rl.sim.events import Event, Property
from brokk_rl.sim.model import DriveReferences
from brokk_rl.sim.scene import ScenePlacement, make_nominal_scenes

FIELDS: dict[Property, tuple[str, ...]] = {
    "mass": ("body_mass", "body_inertia", "body_subtreemass"),
    "friction": ("geom_friction",),
    "stiffness": ("actuator_gainprm", "actuator_biasprm"),
    "yield_force": ("actuator_forcerange",),
}
"""Fields of MuJoCo's model that follow from each property. What MuJoCo derives from them for the
softness of contacts (`body_invweight0`, `dof_invweight0`) stays nominal."""


def list_fields(events: Iterable[Event]) -> tuple[str, ...]:
    """Return the fields of the model that differ from world to world."""
    found: list[str] = []
    for event in events:
        found.extend(FIELDS[event.property])
    return tuple(found)


class WorldProperties:
    """Factors on the machine's properties, drawn by events, and the model's fields that follow.

    Nothing synchronises with the host, so that a CUDA graph can hold the draws.

    Args:
        model: Gives the nominal numbers.
        machine: Gives joints and links.
        drive: Its lead and leash follow from stiffness and yield force.
        fields: The model's fields of all worlds by name, `(N, …)`, written in place.
        events: One a property.

    Attributes:
        factors: By property, `(N, J)`, friction `(N, 1)`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        machine: Machine,
        drive: DriveReferences,
        fields: dict[str, torch.Tensor],
        events: tuple[Event, ...],
    ) -> None:
        self._fields, self._drive, self._events = fields, drive, events
        some = next(iter(fields.values()))
        num, device, dtype = len(some), some.device, some.dtype

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        self._nominal = {name: constant(getattr(model, name)) for name in fields}
        self.factors: dict[str, torch.Tensor] = {}
        for event in events:
            width = 1 if event.property == "friction" else machine.num_joints
            self.factors[event.property] = torch.ones(num, width, dtype=dtype, device=device)
        links = [int(model.joint(name).bodyid[0]) for name in machine.joint_names]
        self._links = torch.tensor(links, device=device)
        carried = np.zeros((model.nbody, model.nbody))
        for body in range(model.nbody):  # parents come first
            carried[body] = carried[model.body_parentid[body]]
            carried[body, body] = 1.0
        self._carried = constant(carried)
        self._stiffness = constant(model.actuator_gainprm[:, 0])
        self._damping = constant(-model.actuator_biasprm[:, 2])
        self._yield_force = constant(model.actuator_forcerange[:, 1])
        everywhere = torch.ones(num, dtype=torch.bool, device=device)
        for event in events:
            self._draw(event, everywhere)

    def begin(self, mask: torch.Tensor) -> None:
        """Draw anew for the worlds of `mask`, `(N,)` bool, what an episode changes."""
        for event in self._events:
            if event.when != "startup":
                self._draw(event, mask)
        self.apply()

    def _draw(self, event: Event, mask: torch.Tensor) -> None:
        value = self.factors[event.property]
        low, high = event.factor
        width = 1 if event.joints_alike else value.shape[1]
        drawn = low + (high - low) * torch.rand(len(mask), width, device=mask.device)
        value.copy_(drawn.to(value.dtype).expand_as(value).where(mask[:, None], value))

    def apply(self) -> None:
        """Write the fields that follow from `factors`; everything is in place."""
        fields, nominal, factors = self._fields, self._nominal, self.factors
        if "mass" in factors:
            factor = factors["mass"]
            for name in ("body_mass", "body_inertia"):
                usual = nominal[name][self._links]
                scaled = usual * factor.reshape(*factor.shape, *[1] * (usual.dim() - 1))
                fields[name].index_copy_(1, self._links, scaled)
            fields["body_subtreemass"].copy_(fields["body_mass"] @ self._carried)
        if "friction" in factors:
            scaled = nominal["geom_friction"] * factors["friction"][..., None]
            fields["geom_friction"].copy_(scaled)
        ones = torch.ones_like(self._stiffness)
        stiff = factors.get("stiffness", ones)
        stiffness, damping = self._stiffness * stiff, self._damping * stiff.sqrt()
        if "stiffness" in factors:
            fields["actuator_gainprm"][..., 0].copy_(stiffness)
            fields["actuator_biasprm"][..., 1].copy_(-stiffness)
            fields["actuator_biasprm"][..., 2].copy_(-damping)
        bound = self._yield_force * factors.get("yield_force", ones)
        if "yield_force" in factors:
            fields["actuator_forcerange"][..., 0].copy_(-bound)
            fields["actuator_forcerange"][..., 1].copy_(bound)
        if "stiffness" in factors or "yield_force" in factors:
            self._drive.set_servos(stiffness, damping, bound)


class StoredWorld:
    """Base of the worlds of both simulators: results, state that is stored, properties that vary, faults.

    Args:
        machine: The machine.
        num_worlds: `N`.
        model: As MuJoCo compiles it.
        device: Where the results lie.
        dtype: Type in which the simulator computes.
        alarm_names: Meaning of each bit of an alarm of the simulator.
    """

    def __init__(
        self,
        machine: Machine,
        num_worlds: int,
        model: mujoco.MjModel,
        device: torch.device,
        dtype: torch.dtype,
        alarm_names: dict[int, str],
    ) -> None:
        self.num_worlds, self.device, self.model = num_worlds, device, model
        self.q = torch.zeros(num_worlds, machine.num_joints, device=device)
        self.contact_force_n = torch.zeros(num_worlds, device=device)
        self.faults = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        self._machine, self._alarm_names = machine, alarm_names
        # alarms of worlds at fault and their joints' largest speeds since they were last explained
        self._alarms = torch.zeros(num_worlds, dtype=torch.int64, device=device)
        self._fastest = torch.zeros(machine.num_joints, dtype=dtype, device=device)
        self._placement = ScenePlacement(model, device, dtype)
        self._drive = DriveReferences(model, machine, num_worlds, device, dtype)
        self._properties: WorldProperties | None = None

    def _begin(
        self,
        views: dict[str, torch.Tensor],
        at_rest: dict[str, torch.Tensor],
        stored: Sequence[str],
        fields: dict[str, torch.Tensor],
        events: tuple[Event, ...],
    ) -> None:
        """Draw the properties that events change, and put all machines at home.

        Args:
            views: Tensors of all worlds by MuJoCo's names, `(N, …)`, written in place.
            at_rest: Values of one world that a reset writes.
            stored: Those that a state consists of.
            fields: Fields of the model that events change.
            events: One a property.
        """
        self._views, self._at_rest, self._stored = views, at_rest, stored
        if events:
            self._properties = WorldProperties(
                self.model, self._machine, self._drive, fields, events
            )
        home = torch.tensor(self._machine.home, dtype=torch.float32, device=self.device)
        scenes = make_nominal_scenes(self.num_worlds, self.device)
        self.reset(~self.faults, home.expand(self.num_worlds, -1), scenes)

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Begin anew in the worlds of `mask`; see `brokk_rl.contracts.world.World`."""
        if self.device.type == "cpu" and not mask.any():  # a GPU would wait for the answer
            return
        if self._properties:
            self._properties.begin(mask)
        for name, value in self._at_rest.items():
            view = self._views[name]
            torch.where(mask.view(-1, *[1] * (view.dim() - 1)), value, view, out=view)
        for view in (self._views["qpos"], self._views["act"], self.q):
            torch.where(mask[:, None], q.to(view.dtype), view, out=view)
        self._drive.reset(mask, q)
        self.place(mask, scene)
        self.contact_force_n.masked_fill_(mask, 0.0)
        self.faults.masked_fill_(mask, False)

    def place(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        """Put blocks elsewhere; see `brokk_rl.contracts.world.World`."""
        view, rows, ids = self._views, mask[:, None], self._placement.geom_ids
        position, turn = self._placement.pose(scene)
        size, pos = self._placement.geoms(scene)
        for name, value in (("mocap_pos", position), ("mocap_quat", turn)):
            torch.where(rows, value, view[name][:, 0], out=view[name][:, 0])
        for name, value in (("geom_size", size), ("geom_pos", pos)):
            view[name].index_copy_(1, ids, torch.where(rows[..., None], value, view[name][:, ids]))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return a copy of all that `load_state_dict` needs to go on exactly."""
        return {name: tensor.clone() for name, tensor in self._list_tensors().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from a state of these worlds."""
        for name, tensor in self._list_tensors().items():
            tensor.copy_(state[name])
        if self._properties:
            self._properties.apply()

    def _list_tensors(self) -> dict[str, torch.Tensor]:
        """Return the simulator's tensors, and those of the events."""
        tensors = {name: self._views[name] for name in self._stored}
        tensors |= {"reference": self._drive.reference, "q": self.q}
        tensors |= {"contact_force_n": self.contact_force_n, "faults": self.faults}
        if self._properties:
            for name, value in self._properties.factors.items():
                tensors[f"event.{name}"] = value
        return tensors

    def explain_faults(self) -> str:
        """See `brokk_rl.contracts.world.ExplainedWorld`."""
        alarms, speeds = self._alarms.unique().tolist(), self._fastest.tolist()
        self._alarms.zero_()
        self._fastest.zero_()
        said = [text for bit, text in self._alarm_names.items() if any(bit & one for one in alarms)]
        speed, joint = max(zip(speeds, self._machine.joints, strict=True), key=lambda one: one[0])
        if math.isinf(speed):
            return "; ".join([*said, f"the motion of {joint.name} was not finite"])
        return "; ".join([*said, f"the speed of {joint.name} came to {speed:,.3g} {joint.unit}/s"])

    def _note_faults(self, speeds: torch.Tensor, alarms: torch.Tensor) -> None:
        """Note alarms, `(N,)`, and sizes of joint speeds, `(N, J)`, of the worlds at fault."""
        of_faults = speeds.nan_to_num(nan=torch.inf, posinf=torch.inf).masked_fill_(
            ~self.faults[:, None], 0.0
        )
        torch.maximum(self._fastest, of_faults.amax(0), out=self._fastest)
        self._alarms.bitwise_or_(alarms.masked_fill(~self.faults, 0))
