"""One side of a case, reference or field, as the engine reads it: all recordings on end, at one rate.

Positions are counted in units of the joint, so that the numbers of its model hold for fast and slow,
turning and sliding joints: half its travel where a command is a target, otherwise what it covers in
`UNIT_S` at its nominal speed.
Axes: `T` samples of all recordings, `J` joints, `C` candidates, `P` numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import warp as wp

from brokk_rl.kinematics import LinkChain
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.case import estimate_running_s
from diagnosis.engine import kernel
from diagnosis.engine.joint_model import COMMAND_NAMES, JointModel
from diagnosis.engine.servo import SERVO
from diagnosis.engine.valve import VALVE

UNIT_S = 1.0 / 0.3
"""The numbers of `valve` were chosen on joints of about 0.3 rad/s; there the unit is 1 rad."""
MODELS = {"speed": VALVE, "position": SERVO}
"""Model of the joints of each command interface."""
FASTEST_HZ = 50.0
"""Recordings of a higher rate are thinned out: hydraulic joints do nothing faster."""
STOP_UNITS = 0.006
"""Distance from the end of the travel at which a joint rests against it."""
DEVICE = "cpu"
"""A GPU does each of the many small calls in the time of its longest thread: 24,000 steps one after the
other. On one H100 a case took several minutes, on one core of its host 15 s."""
OPEN_FLOW = 0.04
"""Share of its full flow from which on a valve counts as open."""
MAX_DEMAND = 1.5
"""A joint asks for at most so much flow, over that of its full speed."""


def measure_units(machine: Machine) -> np.ndarray:
    """Return the position unit of each joint, `(J,)`, rad or m."""
    if machine.interface == "position":
        return 0.5 * (machine.upper - machine.lower)
    return machine.max_speed * UNIT_S


def choose_stride(machine: Machine) -> int:
    """Return of how many samples the engine reads one."""
    return max(1, round(1.0 / (machine.period_s * FASTEST_HZ)))


@dataclass
class Side:
    """Recordings on end.

    Attributes:
        u: Commands, `(T, J)`.
        q: Positions in units of each joint, `(T, J)`.
        begins: First row of the recording of each row, `(T,)`.
        time_s: Time since the machine was started, `(T,)`.
        period_s: Time between rows.
        poses: Polynomials of each joint's place in its travel, `(J, T, 4)`.
        loads: Weight of the outer links on each joint, over that of the stretched arm, `(J, T, 4)`.
        stops: 1 at the upper end of the travel, -1 at the lower, `(J, T)`.
        machine: The machine.
        demand: Flow that all other joints ask for, over that of one at full speed, `(J, T)`.
        pressing: Pressure that the heaviest open other joint asks the pump for, over the pump's margin, `(J, T)`.
        others: How far the valves of up to four other joints are open out and in, 0 to 1, `(J, T, 8)`.
            The highest load pressure sets the pump, and no valve keeps its own flow quite the same.
    """

    u: np.ndarray
    q: np.ndarray
    begins: np.ndarray
    time_s: np.ndarray
    period_s: float
    poses: np.ndarray
    loads: np.ndarray
    stops: np.ndarray
    machine: Machine = field(repr=False)
    demand: np.ndarray = field(repr=False)
    pressing: np.ndarray = field(repr=False)
    others: np.ndarray = field(repr=False)

    @property
    def num_samples(self) -> int:
        """Number of rows, `T`."""
        return len(self.u)

    @property
    def num_joints(self) -> int:
        """Number of joints, `J`."""
        return self.u.shape[1]

    @property
    def substeps(self) -> int:
        """Steps of the simulation in one period."""
        return max(1, int(np.ceil(self.period_s / self.model.substep_s - 1e-9)))

    @property
    def model(self) -> JointModel:
        """Model of its joints."""
        return MODELS[self.machine.interface]

    @cached_property
    def starts(self) -> np.ndarray:
        """First rows of the recordings."""
        return np.unique(self.begins)

    @cached_property
    def ends(self) -> np.ndarray:
        """Rows behind the last of each recording."""
        return np.append(self.starts[1:], self.num_samples)

    @cached_property
    def load(self) -> np.ndarray:
        """Weight on each joint in its positive direction, over the largest, `(J, T)`."""
        return self.loads.sum(2)

    def count(self, seconds: float) -> int:
        """Return the number of samples of a time, at least one."""
        return max(1, round(seconds / self.period_s))

    def simulate(self, joint: int, numbers: np.ndarray) -> np.ndarray:
        """Return the paths of candidates with numbers `(C, P)`, `(C, T)` in units."""
        return self.simulate_flow(joint, numbers)[0]

    def simulate_flow(self, joint: int, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return paths and asked flow of candidates with numbers `(C, P)`, `(C, T)` each."""
        numbers = np.ascontiguousarray(np.atleast_2d(numbers))
        commands_only = numbers[:, : len(COMMAND_NAMES)]
        distinct, which = np.unique(commands_only, axis=0, return_inverse=True)
        first = np.zeros(len(distinct), dtype=int)
        first[which] = np.arange(len(numbers))
        shape = (len(distinct), self.num_samples * self.substeps)
        spool = wp.empty(shape, dtype=float, device=DEVICE)
        commands, begins = self._shared
        wp.launch(
            kernel.simulate_spool,
            dim=len(distinct),
            inputs=[
                commands,
                begins,
                joint,
                self.period_s,
                self.substeps,
                int(self.model.integrates),
                _send(numbers[first]),
            ],
            outputs=[spool],
            device=DEVICE,
        )
        path = wp.empty((len(numbers), self.num_samples), dtype=float, device=DEVICE)
        poses, loads, load, stops, time_s = self._own[joint]
        chosen = wp.array(which.astype(np.int32), dtype=wp.int32, device=DEVICE)
        if not self.model.integrates:
            middle = 0.5 * (self.machine.upper + self.machine.lower)[joint]
            wp.launch(
                kernel.simulate_servo,
                dim=len(numbers),
                inputs=[
                    spool,
                    chosen,
                    begins,
                    load,
                    _send(self.q[:, joint]),
                    middle / measure_units(self.machine)[joint],
                    self.period_s,
                    self.substeps,
                    _send(numbers),
                ],
                outputs=[path],
                device=DEVICE,
            )
            found = path.numpy()
            return found, np.zeros_like(found)
        flow = wp.empty((len(numbers), self.num_samples), dtype=float, device=DEVICE)
        wp.launch(
            kernel.simulate_path,
            dim=len(numbers),
            inputs=[
                spool,
                chosen,
                begins,
                poses,
                loads,
                load,
                stops,
                _send(self.demand[joint]),
                _send(self.pressing[joint]),
                _send(self.others[joint]),
                time_s,
                self.period_s,
                self.substeps,
                _send(numbers),
            ],
            outputs=[path, flow],
            device=DEVICE,
        )
        return path.numpy(), flow.numpy()

    @cached_property
    def _shared(self) -> tuple[wp.array, wp.array]:
        """Commands and beginnings where the kernel reads them."""
        return _send(self.u), wp.array(self.begins.astype(np.int32), dtype=wp.int32, device=DEVICE)

    @cached_property
    def _own(self) -> list[tuple[wp.array, ...]]:
        """Poses, loads and stops of each joint where the kernel reads them."""
        time_s, found = _send(self.time_s), []
        for j in range(self.num_joints):
            stops = wp.array(self.stops[j].astype(np.int32), dtype=wp.int32, device=DEVICE)
            arrays = (_send(self.poses[j]), _send(self.loads[j]), _send(self.load[j]))
            found.append((*arrays, stops, time_s))
        return found

    def with_commands(self, u: np.ndarray) -> Side:
        """Return the same side under other commands."""
        found = replace(self, u=u)
        found.__dict__["_own"] = self._own  # poses and stops are the same: they are not sent again
        return found

    def _press(self, joint: int, numbers: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """Return what a joint with numbers `(P,)` and asked flow `(T,)` asks the pump for, over its margin, `(T,)`."""
        if not self.model.integrates:
            return np.zeros(self.num_samples)
        lifted = -np.sign(flow) * self.load[joint]
        needed = numbers[self.model.place["pump_weight"]] * np.maximum(lifted, 0.0)
        is_open = np.minimum(np.abs(flow) / kernel.WAKING_DEMAND, 1.0)
        return is_open * (1.0 + needed)

    def with_positions(self, q: np.ndarray) -> Side:
        """Return the same side in other poses `q` `(T, J)`, units; the demand is still to be asked for."""
        poses, loads, stops = describe_poses(q * measure_units(self.machine), self.machine)
        return replace(self, q=q, poses=poses, loads=loads, stops=stops)

    def ask_others(self, numbers: Sequence[np.ndarray]) -> None:
        """Simulate what each joint asks for with its numbers `(P,)`, and set what the others see of it."""
        signed = [self.simulate_flow(j, row)[1][0].astype(float) for j, row in enumerate(numbers)]
        flows = np.minimum(np.abs(signed), MAX_DEMAND)
        self.demand = flows.sum(0) - flows
        asked = [self._press(j, row, signed[j]) for j, row in enumerate(numbers)]
        others = [np.delete(asked, j, 0) for j in range(self.num_joints)]
        self.pressing = np.stack([np.max(one, 0, initial=0.0) for one in others])
        ways = np.stack([signed, np.negative(signed)], 2)
        opened = np.clip(ways / OPEN_FLOW, 0.0, 1.0)
        self.others = np.zeros((self.num_joints, self.num_samples, kernel.NUM_WAYS))
        for j in range(self.num_joints):
            for i, other in enumerate(np.delete(opened, j, 0)):
                # Behind the fourth joint all others count as one with it.
                place = min(2 * i, kernel.NUM_WAYS - 2)
                seen = self.others[j, :, place : place + 2]
                seen[:] = np.maximum(seen, other)


def _send(values: np.ndarray) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=wp.float64, device=DEVICE)


def stack_side(recordings: Sequence[Recording], machine: Machine) -> Side:
    """Return recordings of a machine on end, their positions in units."""
    stride = choose_stride(machine)
    period_s = machine.period_s * stride
    running_s = estimate_running_s(recordings)
    u, q, begins, time_s, count = [], [], [], [], 0
    for recording, begun_s in zip(recordings, running_s, strict=True):
        rows = recording.num_samples // stride
        whole = recording.u[: rows * stride].reshape(rows, stride, -1)
        # The mean command of the interval that ends at the next kept sample.
        u.append(whole.mean(1))
        q.append(recording.q[: rows * stride : stride])
        begins.append(np.full(rows, count))
        time_s.append(begun_s + recording.t_s[0] + period_s * np.arange(rows))
        count += rows
    positions = np.concatenate(q).astype(float)
    poses, loads, stops = describe_poses(positions, machine)
    return Side(
        u=np.concatenate(u).astype(float),
        q=positions / measure_units(machine),
        begins=np.concatenate(begins),
        time_s=np.concatenate(time_s),
        period_s=period_s,
        poses=poses,
        loads=loads,
        stops=stops,
        machine=machine,
        demand=np.zeros((machine.num_joints, count)),
        pressing=np.zeros((machine.num_joints, count)),
        others=np.zeros((machine.num_joints, count, kernel.NUM_WAYS)),
    )


def describe_poses(q: np.ndarray, machine: Machine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what the kernel knows of positions `q` `(T, J)`, rad or m.

    Returns:
        Polynomials of each place in its travel, `(J, T, 4)`; weights, `(J, T, 4)`; and 1 at the
        upper end of the travel, -1 at the lower, `(J, T)`.
    """
    middle = 0.5 * (machine.upper + machine.lower)
    half = 0.5 * (machine.upper - machine.lower)
    # A simulated joint may run away; no law of the pose holds beyond half a travel from its ends.
    x = np.clip((q - middle) / half, -2.0, 2.0).T
    # Legendre's polynomials but for their factor: independent of each other over the travel.
    cubic = x**3 - 0.6 * x
    quartic = x**4 - 6.0 / 7.0 * x**2 + 3.0 / 35.0
    poses = np.stack([x, x**2 - 1.0 / 3.0, cubic, quartic], 2)
    loads = np.zeros((machine.num_joints, len(q), kernel.NUM_LOAD))
    if machine.has_bodies:
        loads = weigh_links(q, machine)
    unit = measure_units(machine)
    upper = (machine.upper - q) / unit < STOP_UNITS
    lower = (q - machine.lower) / unit < STOP_UNITS
    return poses, loads, (upper.astype(int) - lower.astype(int)).T


def weigh_links(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the weight of the outer links on each joint in its positive direction, over the largest sum, `(J, T, 4)`.

    Behind the fourth link all others count as one with it. The largest sum is that of the stretched arm.
    """
    chain = LinkChain(machine.joints)
    links = chain.place(q)
    bodies = machine.bodies
    com_m = np.array([body.com_m for body in bodies])
    mass_kg = np.array([body.mass_kg.value for body in bodies])
    centre_m = links.place_m + (links.rotation @ com_m[:, :, None])[..., 0]
    found = np.zeros((machine.num_joints, len(q), kernel.NUM_LOAD))
    for j in range(machine.num_joints):
        axis = links.axis[:, j]
        for i in range(j, machine.num_joints):
            lever = centre_m[:, i] - links.place_m[:, j]
            rising = axis[:, 0] * lever[:, 1] - axis[:, 1] * lever[:, 0]
            if machine.joints[j].kind == "slide":
                rising = axis[:, 2]
            place = min(i - j, kernel.NUM_LOAD - 1)
            found[j, :, place] -= mass_kg[i] * rising
    return found / measure_full_loads(machine)[:, None, None]


def measure_full_loads(machine: Machine) -> np.ndarray:
    """Return mass times lever of the stretched arm on each joint, kg m (a sliding joint: kg), `(J,)`."""
    bodies = machine.bodies
    length_m = [float(np.linalg.norm([d.value for d in body.origin_m])) for body in bodies]
    found = []
    for j, joint in enumerate(machine.joints):
        total = 0.0
        for i in range(j, machine.num_joints):
            reach_m = sum(length_m[j + 1 : i + 1]) + float(np.linalg.norm(bodies[i].com_m))
            total += bodies[i].mass_kg.value * (1.0 if joint.kind == "slide" else reach_m)
        found.append(max(total, 1e-9))
    return np.array(found)
