"""Core of `mode=play`: commands of a person in, state of the simulated machines out.

It knows no browser and runs in one thread; the page hands its commands over.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.contracts.actuator import ActuatorModel, FollowerModel
from brokk_rl.contracts.task import STEPS, SUCCESS, Policy
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.sim.scene import FAR_M

PERSON = "person"
"""Name of the driver who is no policy."""
TRACE_S = 15.0
"""Time that traces show, s. Chosen by hand: about one insertion."""
MAX_CATCH_UP = 16
"""Control steps between two pictures at most; a computer that is too slow falls behind the clock."""
NUM_RATED = 30
"""Pictures over which the rate is measured: a second. Chosen by hand."""
DISTANCE_M, HEIGHT_M = (1.6, 4.6), (0.0, 1.6)
"""Where a target may be put: distance from the slew axis and height. Chosen by hand: a block that
is nearer would stand in the undercarriage, and the arm of a Brokk 170 reaches 5.2 m."""
SHOWN_STATE = {"scene": "start.scene", "target_m": "start.target_m", "estimate_m": "estimate_m"}
"""Drawn parts of the task's state, where it has them, by name: scenes, `(N, S)`, see `brokk_rl.sim.scene`; true
targets in the base frame, `(N, 3)`; and the same as the policy sees them."""
KEY_STEP = 0.25
"""Stroke by which one press of a key moves a lever. Chosen by hand: four presses to full speed."""
PUSH_S = 0.5
"""Time for which a push lasts, s. Chosen by hand."""
LARGEST_EFFECT = 3.0
"""Largest size of an effect, in typical sizes. Chosen by hand: three times what a machine has."""


class PersonAtLevers(FollowerModel):
    """Follower that gives a person's commands in one environment and the policy's in the others.

    Levers stay where they were put until they are released.

    Args:
        inner: Follower of the other environments.
        machine: The machine.

    Attributes:
        env: Environment that the person drives; `None` for none.
        levers: Positions of the levers, `(J,)` in [-1, 1].
        proposed: Last commands that the policy proposed, `(N, J)`.
    """

    def __init__(self, inner: FollowerModel, machine: Machine) -> None:
        self._inner = inner
        self._is_exclusive = torch.as_tensor(machine.is_exclusive)
        self.env: int | None = None
        self.levers = torch.zeros(machine.num_joints)
        self.proposed = torch.zeros(machine.num_joints)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """State of the follower inside."""
        return self._inner.state

    def reset(self, mask: torch.Tensor) -> None:
        """Reset the follower inside; the person's levers stay."""
        self._inner.reset(mask)

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the commands that are given, `(N, J)`, for those proposed."""
        self.proposed = proposed
        given = self._inner.step(proposed)
        if self.env is None:
            return given
        given = given.clone()
        # a lever of an exclusive joint rules out the others
        positioning = bool(self.levers[self._is_exclusive].any())
        command = self.levers * mask_exclusive_joints(self._is_exclusive, positioning)
        given[self.env] = command.to(given.device)
        return given


@dataclass(frozen=True)
class EffectDial:
    """One number of an effect: 0 is none of it, 1 the typical size on a machine that has it.

    Attributes:
        low: Smallest size, in typical sizes.
        high: Largest size.
        typical: Number at size 1 on each joint, `(J,)` or `(1,)`.
        none: Number at size 0, likewise.
        parameters: Numbers of the model by name, `(N, J)` or `(N, 1)`; an entry is replaced.
        key: Name of the number there.
    """

    low: float
    high: float
    typical: torch.Tensor
    none: torch.Tensor
    parameters: dict[str, torch.Tensor]
    key: str

    def turn(self, size: float) -> None:
        """Give all machines the effect in `size`, limited to what makes sense."""
        size = min(max(size, self.low), self.high)
        value = self.none + size * (self.typical - self.none)
        before = self.parameters[self.key]
        # a replaced entry is not drawn anew when an episode begins
        self.parameters[self.key] = value.to(before).expand_as(before).clone()


def list_dials(model: ActuatorModel, machine: Machine) -> dict[str, EffectDial]:
    """Return a dial for each number of each effect around an actuator model, by `effect.number`.

    Numbers that only shape an effect, such as its time constant, have none.
    """
    found = {}
    layer: Any = model
    while layer is not None:
        for name, effect in getattr(layer, "effects", {}).items():
            for key, number in effect.numbers.items():
                if number.none is not None and number.is_on(machine):
                    place = f"{name}.{key}" if name else key
                    dial = _make_dial(number, machine, layer.parameters, place)
                    if dial.low < dial.high:
                        found[f"{effect.name()}.{key}"] = dial
        layer = getattr(layer, "inner", None)
    return found


def _make_dial(
    number: Any, machine: Machine, parameters: dict[str, torch.Tensor], key: str
) -> EffectDial:
    none, typical = (number.scale_to(machine, value) for value in (number.none, number.typical))
    ends = (np.array(number.limit_on(machine)) - none) / (typical - none)
    low, high = max(-LARGEST_EFFECT, ends.min(0).max()), min(LARGEST_EFFECT, ends.max(0).min())
    return EffectDial(
        low=math.ceil(low * 10 - 1e-6) / 10,
        high=math.floor(high * 10 + 1e-6) / 10,
        typical=torch.as_tensor(typical, dtype=torch.float32),
        none=torch.as_tensor(none, dtype=torch.float32),
        parameters=parameters,
        key=key,
    )


class PlaySession:
    """Simulated machines that a person watches and touches.

    Args:
        loop: Control loop; its follower is replaced by one that knows the person.
        policies: Policies by name; the first one drives at first.
        neutral: Whether effects begin switched off instead of drawn as configured.

    Attributes:
        driver: Who drives: a policy's name, or `PERSON`.
        selected: World that traces and commands are about.
        paused: Whether time stands still.
        speed: Wanted share of real time.
        note: About the policy that was loaded last, such as its checkpoint.
        endings: Number of finished episodes by ending, of the present driver.
        successes: Number of them with success.
    """

    def __init__(self, loop: ControlLoop, policies: dict[str, Policy], neutral: bool) -> None:
        self.loop, self.machine = loop, loop.machine
        self._policies = dict(policies)
        self._kinematics = Kinematics(loop.machine, loop.device)
        self._person = PersonAtLevers(loop.follower, loop.machine)
        loop.follower = self._person
        self.dials = list_dials(loop.actuator, loop.machine)
        for dial in self.dials.values():
            if neutral:
                dial.turn(0.0)
        self.starts_neutral = neutral
        self.driver = next(iter(policies))
        self.selected, self.paused, self.speed = 0, False, 1.0
        self.note = ""
        self._acting = self.driver
        self._owed_s, self._steps = 0.0, 0
        self._pinned_m = torch.full((loop.num_envs, 3), torch.nan, device=loop.device)
        self._restarted = torch.zeros(loop.num_envs, dtype=torch.bool, device=loop.device)
        self._push_n = torch.zeros(loop.num_envs, 3, device=loop.device)
        self._push_steps = torch.zeros(loop.num_envs, device=loop.device)
        self._trace: deque[dict[str, np.ndarray]] = deque(
            maxlen=round(TRACE_S / loop.machine.period_s)
        )
        self._clock: deque[tuple[float, int]] = deque(maxlen=NUM_RATED)
        self.endings: Counter[str] = Counter()
        self.successes = 0
        loop.begin()

    @property
    def drivers(self) -> list[str]:
        """Names of those who can drive."""
        return [*self._policies, PERSON]

    @property
    def can_push(self) -> bool:
        """True where the simulator knows loads from outside."""
        return hasattr(self.loop.world, "joint_load")

    @property
    def can_move_target(self) -> bool:
        """True where the task lets its target be moved."""
        return "move_target" in self.loop.task.offers

    def choose_driver(self, name: str) -> None:
        """Let a policy drive all machines, or the person the selected one.

        Raises:
            ConfigError: There is no such driver.
        """
        if name not in self.drivers:
            raise ConfigError(f"play.driver={name}: {list_choices(name, self.drivers)}")
        self.driver = name
        if name != PERSON:
            self._acting = name
        self.release_levers()
        self.endings.clear()
        self.successes = 0

    def replace_policy(self, name: str, policy: Policy, note: str) -> None:
        """Put a newer policy in the place of the one called `name`; episodes go on."""
        self._policies[name] = policy
        self.note = note
        self.endings.clear()
        self.successes = 0

    def select_world(self, index: int) -> None:
        """Choose the world that traces and commands are about."""
        self.selected = index
        self.release_levers()

    def nudge_lever(self, joint: int, change: float) -> None:
        """Move the person's lever of a joint by `change`, of full stroke."""
        self.put_lever(joint, float(self._person.levers[joint]) + change)

    def put_lever(self, joint: int, position: float) -> None:
        """Put the person's lever of a joint to a position in [-1, 1]."""
        self._person.levers[joint] = min(max(position, -1.0), 1.0)

    def release_levers(self) -> None:
        """Let all levers spring back to neutral."""
        self._person.levers.zero_()
        self._person.env = self.selected if self.driver == PERSON else None

    @property
    def t_s(self) -> float:
        """Simulated time since the start."""
        return self._steps * self.machine.period_s

    @property
    def episode_s(self) -> float:
        """Time since the start of the selected world's episode."""
        return float(self.loop.task.state[STEPS][self.selected]) * self.machine.period_s

    @property
    def levers(self) -> np.ndarray:
        """Positions of the person's levers, `(J,)`."""
        return self._person.levers.numpy().copy()

    def reset(self, world: int | None = None) -> None:
        """Begin a new episode in a world, or in all, with the next step; its target is drawn."""
        rows = slice(None) if world is None else world
        self._pinned_m[rows] = torch.nan
        self._restarted[rows] = True
        self.loop.task.state[STEPS][rows] = float(self.loop.task.max_episode_steps)
        if self.paused:
            self.step()

    def push(self, force_n: np.ndarray) -> None:
        """Push the tip of the selected arm for `PUSH_S`; only where it `can_push`.

        Args:
            force_n: Force in the base frame, `(3,)`, N.
        """
        self._push_n[self.selected] = torch.as_tensor(force_n, dtype=torch.float32)
        self._push_steps[self.selected] = round(PUSH_S / self.machine.period_s)

    def move_target(self, position_m: np.ndarray) -> np.ndarray:
        """Put the selected world's target, and the block with it, elsewhere.

        It stays there until `reset`.

        Args:
            position_m: Wanted place in the base frame, `(3,)`.

        Returns:
            The place, limited to `DISTANCE_M` and `HEIGHT_M`.

        Raises:
            ConfigError: The task's target cannot be moved.
        """
        position = np.array(position_m, float)
        distance = max(float(np.hypot(*position[:2])), 1e-6)
        position[:2] *= np.clip(distance, *DISTANCE_M) / distance
        position[2] = np.clip(position[2], *HEIGHT_M)
        self._pinned_m[self.selected] = torch.as_tensor(position, dtype=torch.float32)
        worlds = torch.arange(self.loop.num_envs, device=self.loop.device)
        self._put_targets(worlds == self.selected)
        return position

    def advance(self, elapsed_s: float) -> int:
        """Simulate as much as `elapsed_s` of the wall clock ask for; return the control steps."""
        if self.paused:
            self._owed_s = 0.0
            return 0
        period_s = self.machine.period_s
        self._owed_s += elapsed_s * self.speed
        due = int(self._owed_s / period_s)
        self._owed_s -= due * period_s
        steps = min(due, MAX_CATCH_UP)
        for _ in range(steps):
            self.step()
        self._clock.append((elapsed_s, steps))
        return steps

    def step(self) -> None:
        """Simulate one control period."""
        loop, task = self.loop, self.loop.task
        if self.can_push:
            self._apply_pushes()
        if self._person.env is not None and not self._restarted[self._person.env]:
            # a person has the time that it takes
            task.state[STEPS][self._person.env].clamp_(max=float(task.max_episode_steps - 2))
        with torch.no_grad():
            groups = loop.get_observations()
            loop.step(self._policies[self._acting].act(dict(groups.items())))  # type: ignore[arg-type]
        self._steps += 1
        self._record()
        self._count_endings()
        is_drawn_anew = loop.done & self._pinned_m.isfinite().all(1)
        if is_drawn_anew.any():
            self._put_targets(is_drawn_anew)

    def read(self) -> dict[str, np.ndarray]:
        """Return the state to draw: joint positions `q`, `(N, J)`, and what `SHOWN_STATE` names."""
        state = {"q": _to_numpy(self.loop.world.q)}
        for name, entry in SHOWN_STATE.items():
            if entry in self.loop.task.state:
                state[name] = _to_numpy(self.loop.task.state[entry])
        return state

    def read_traces(self) -> dict[str, np.ndarray]:
        """Return the last seconds of the selected world by name, oldest first; empty before any.

        `t_s` `(T,)`; `proposed` and `given`, commands of the policy and in force, `(T, J)`;
        `lateral_m` and `height_m` of the tip from the target, `(T,)`; `force_n`, peak contact
        force, `(T,)`.
        """
        traces = {}
        for name in self._trace[0] if self._trace else ():
            traces[name] = np.array([row[name][self.selected] for row in self._trace])
        return traces

    def _apply_pushes(self) -> None:
        """Load the joints of the arms that are being pushed, and no others."""
        world: Any = self.loop.world
        force_n = self._push_n * (self._push_steps > 0)[:, None]
        tip = self._kinematics.jacobian(world.q).tip
        world.joint_load.copy_((force_n[:, None] @ tip)[:, 0])
        self._push_steps -= 1

    def _put_targets(self, mask: torch.Tensor) -> None:
        """Move targets and blocks of the worlds of `mask`, `(N,)` bool, to where they were put."""
        task = self.loop.task
        shift_m = self._pinned_m - task.state["start.target_m"]
        task.move_target(mask, shift_m.nan_to_num())
        scene = task.state["start.scene"]
        self.loop.world.place(mask & (scene[:, :2].norm(dim=1) < FAR_M), scene)

    def _record(self) -> None:
        """Add the step that was just simulated to the traces."""
        loop = self.loop
        tip = self._kinematics.pose(loop.end_q).tip_in_base_m
        target = loop.task.state.get("start.target_m")
        error = tip - target if target is not None else torch.full_like(tip, torch.nan)
        # a finished world has its next target already; NaN leaves a gap in the line
        error = torch.where(loop.done[:, None], torch.nan, error)
        seconds = np.full(loop.num_envs, self.t_s)
        self._trace.append(
            {
                "t_s": seconds,
                "proposed": _to_numpy(self._person.proposed),
                "given": _to_numpy(loop.end_u),
                "lateral_m": _to_numpy(error[:, :2].norm(dim=1)),
                "height_m": _to_numpy(error[:, 2]),
                "force_n": _to_numpy(loop.end_force_n),
            }
        )

    def _count_endings(self) -> None:
        """Count the episodes that have ended, but for those that the person ended."""
        loop = self.loop
        ended = loop.done & ~self._restarted
        for index in ended.nonzero()[:, 0].tolist():
            self.endings[loop.task.reasons[int(loop.reason[index])]] += 1
            self.successes += int(loop.finished[SUCCESS][index] > 0)
        self._restarted &= ~loop.done

    def measure_rate(self) -> float:
        """Return simulated seconds per second over the last pictures."""
        elapsed_s = sum(row[0] for row in self._clock)
        if self.paused or not elapsed_s:
            return 0.0
        return sum(row[1] for row in self._clock) * self.machine.period_s / elapsed_s


def _to_numpy(value: torch.Tensor) -> np.ndarray:
    return value.detach().cpu().numpy().copy()
