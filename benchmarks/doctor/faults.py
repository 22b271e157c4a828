"""Faults of the doctor's exam, written apart from the doctor: a deployed loop that makes mistakes.

Each fault is a class of hooks in a plain numpy loop, with its size drawn by seed. The loop calls them
where real deployment code would make the mistake. `LISTED` have a name that the doctor can give,
`UNLISTED` have none. `EFFECTS` are machines outside of the training, `TASKS` are targets outside of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Hook = Callable[[np.ndarray, int], np.ndarray]
"""Takes a value and the number of the control period."""


@dataclass
class Fault:
    """A fault in a deployed loop.

    Attributes:
        label: What the doctor should say: kinds, any of which is right.
        term: Fields' first parts, any of which is right.
        size: Drawn numbers, for the record.
        see: By term (`q`, `u`, `target`): what the loop reads in place of the newest value.
        before: By term: what stands in the history before the first sample.
        window: By term: the history as the loop hands it to its encoder, (H, C).
        vector: The vector that the network gets.
        send: The command that leaves for the valves.
        network: The network of another policy.
    """

    label: tuple[str, ...]
    term: tuple[str, ...]
    size: dict[str, Any] = field(default_factory=dict)
    see: dict[str, Hook] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)
    window: dict[str, Hook] = field(default_factory=dict)
    vector: Hook | None = None
    send: Hook | None = None
    network: str | None = None


Draw = Callable[[np.random.Generator, Mapping[str, Any]], Fault]


def pick_joint(rng: np.random.Generator, facts: Mapping[str, Any]) -> int:
    """Returns a joint that the fault is put on; one on which it does not act is drawn again."""
    return int(rng.choice(facts["moving"]))


def pick_sign(rng: np.random.Generator) -> float:
    """Returns 1 or -1."""
    return float(rng.choice([-1.0, 1.0]))


def change_one(column: int, change: Callable[[float], float]) -> Hook:
    """Returns a hook that changes one number."""

    def hook(value: np.ndarray, _: int) -> np.ndarray:
        value = value.copy()
        value[column] = change(value[column])
        return value

    return hook


def permute(order: np.ndarray) -> Hook:
    """Returns a hook that reorders the numbers."""
    return lambda value, _: value[order]


def swap(rng: np.random.Generator, num: int, must: int) -> np.ndarray:
    """Returns an order in which one given number changes places with another."""
    other = int(rng.choice([one for one in range(num) if one != must]))
    order = np.arange(num)
    order[[must, other]] = order[[other, must]]
    return order


class Late:
    """Returns what it was given some calls ago."""

    def __init__(self, periods: int) -> None:
        self.kept: list[np.ndarray] = []
        self.periods = periods

    def __call__(self, value: np.ndarray, _: int) -> np.ndarray:
        self.kept.append(value.copy())
        return self.kept[max(0, len(self.kept) - 1 - self.periods)]


class Held:
    """Refreshes its value every few calls."""

    def __init__(self, every: int, phase: int) -> None:
        self.every, self.phase, self.value = every, phase, None

    def __call__(self, value: np.ndarray, step: int) -> np.ndarray:
        if self.value is None or (step - self.phase) % self.every == 0:
            self.value = value.copy()
        return self.value


class Stuck:
    """Keeps one number from a step on."""

    def __init__(self, column: int, since: int) -> None:
        self.column, self.since, self.kept = column, since, 0.0

    def __call__(self, value: np.ndarray, step: int) -> np.ndarray:
        if step <= self.since:
            self.kept = float(value[self.column])
        value = value.copy()
        value[self.column] = self.kept
        return value


def rotate_z(angle: float) -> np.ndarray:
    """Returns the matrix of a turn about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def order_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Two encoders are swapped."""
    order = swap(rng, 5, pick_joint(rng, facts))
    return Fault(("order",), ("q",), {"order": order.tolist()}, see={"q": permute(order)})


def order_joints(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The robot's driver lists its joints in another order than the training did."""
    order = np.roll(np.arange(5), int(rng.integers(1, 5)))
    return Fault(
        ("order",), ("joints", "observation"), {"order": order.tolist()},
        see={"q": permute(order), "u": permute(order)},
    )  # fmt: skip


def order_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Two valves are swapped."""
    order = swap(rng, 5, pick_joint(rng, facts))
    return Fault(("order",), ("command",), {"order": order.tolist()}, send=permute(order))


def order_target(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Two axes of the target are swapped."""
    order = np.array([[1, 0, 2], [2, 1, 0], [0, 2, 1]])[rng.integers(3)]
    return Fault(
        ("order", "frame"), ("target",), {"order": order.tolist()}, see={"target": permute(order)}
    )


def order_history(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The history is handed over newest first."""
    term = str(rng.choice(["q", "u"]))
    return Fault(("order",), (term,), {"term": term}, window={term: lambda w, _: w[::-1]})


def order_layout(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The history is flattened joint by joint."""
    return Fault(
        ("order",), ("q",), {}, window={"q": lambda w, _: np.ravel(w, order="F").reshape(w.shape)}
    )


def sign_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """An encoder counts the other way."""
    joint = pick_joint(rng, facts)
    return Fault(("sign",), ("q",), {"joint": joint}, see={"q": change_one(joint, lambda x: -x)})


def sign_u(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The valve's feedback has another sign than the command."""
    return Fault(("sign",), ("u",), {}, see={"u": lambda u, _: -u})


def sign_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """A valve is wired the other way."""
    joint = pick_joint(rng, facts)
    return Fault(("sign",), ("command",), {"joint": joint}, send=change_one(joint, lambda x: -x))


def sign_target(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The camera's y axis points the other way."""
    return Fault(("sign", "frame"), ("target",), {}, see={"target": change_one(1, lambda x: -x)})


def degrees(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Positions come in degrees."""
    return Fault(("scale",), ("q",), {}, see={"q": lambda q, _: np.rad2deg(q)})


def scale_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The gear ratio of an encoder is wrong."""
    joint, factor = (
        pick_joint(rng, facts),
        float(rng.choice([rng.uniform(0.5, 0.9), rng.uniform(1.1, 2.0)])),
    )
    return Fault(
        ("scale",),
        ("q",),
        {"joint": joint, "factor": factor},
        see={"q": change_one(joint, lambda x: factor * x)},
    )


def scale_u(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The valve's feedback has another full scale."""
    factor = float(rng.uniform(0.2, 0.8))
    return Fault(("scale",), ("u",), {"factor": factor}, see={"u": lambda u, _: factor * u})


def scale_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Somebody slows the machine down by a factor."""
    factor = float(rng.uniform(0.4, 0.9))
    return Fault(("scale",), ("command",), {"factor": factor}, send=lambda u, _: factor * u)


def raw_target(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The target is not normalised."""
    mean, std = np.array(facts["target_mean"]), np.array(facts["target_std"])
    return Fault(("scale",), ("target",), {}, see={"target": lambda x, _: x * std + mean})


def frame_yaw(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The target is given in a frame that is turned about the vertical."""
    angle = pick_sign(rng) * float(rng.uniform(0.05, 1.6))
    return Fault(
        ("frame",),
        ("target",),
        {"angle_rad": angle},
        see={"target": lambda x, _: rotate_z(angle) @ x},
    )


def frame_shift(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The target is given from the ground, or from the boom's foot, not from the base."""
    axis, shift = int(rng.choice([0, 2])), pick_sign(rng) * float(rng.uniform(0.05, 0.8))
    return Fault(
        ("frame", "default_pose"),
        ("target",),
        {"axis": axis, "shift_m": shift},
        see={"target": change_one(axis, lambda x: x + shift)},
    )


def frame_optical(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The target has the axes of a camera."""
    return Fault(
        ("frame",), ("target",), {}, see={"target": lambda x, _: np.array([-x[1], -x[2], x[0]])}
    )


def rate_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The policy runs at a part of its rate."""
    every = int(rng.integers(2, 5))
    return Fault(
        ("rate",), ("command",), {"every": every}, send=Held(every, int(rng.integers(every)))
    )


def rate_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Positions are refreshed at a part of the rate."""
    every = int(rng.integers(2, 5))
    return Fault(
        ("rate",), ("q",), {"every": every}, see={"q": Held(every, int(rng.integers(every)))}
    )


def delay_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Positions are some periods old."""
    periods = int(rng.integers(1, 7))
    return Fault(("delay",), ("q",), {"periods": periods}, see={"q": Late(periods)})


def delay_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Commands wait in a queue."""
    periods = int(rng.integers(1, 7))
    return Fault(("delay",), ("command",), {"periods": periods}, send=Late(periods))


def delay_u(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The valve's feedback is a period late."""
    return Fault(("delay",), ("u",), {"periods": 1}, see={"u": Late(1)})


def stuck_q(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """An encoder's message stops coming, and its last value stays."""
    joint, since = pick_joint(rng, facts), int(rng.integers(10, 80))
    return Fault(("stale",), ("q",), {"joint": joint, "row": since}, see={"q": Stuck(joint, since)})


def missing_u(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The history of commands is never filled."""
    return Fault(("stale",), ("u",), {}, see={"u": lambda u, _: 0.0 * u})


def clip_vector(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The observation is clipped too tightly."""
    bound = float(rng.uniform(0.3, 0.9))
    return Fault(
        ("clip",),
        ("observation", "q", "u", "target"),
        {"bound": bound},
        vector=lambda v, _: v.clip(-bound, bound),
    )


def clip_command(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The driver limits commands."""
    bound = float(rng.uniform(0.15, 0.5))
    return Fault(("clip",), ("command",), {"bound": bound}, send=lambda u, _: u.clip(-bound, bound))


def default_pose(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The zero of a joint is elsewhere than in training."""
    joint, offset = int(rng.integers(5)), pick_sign(rng) * float(rng.uniform(0.03, 0.4))
    return Fault(
        ("default_pose",),
        ("q",),
        {"joint": joint, "offset_rad": offset},
        see={"q": change_one(joint, lambda x: x + offset)},
    )


def history_zero(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The history of positions begins with zeros."""
    return Fault(("history",), ("observation",), {}, before={"q": 0.0})


def other_network(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Another policy's network was copied to the machine."""
    return Fault(("network",), ("network",), {"network": facts["other"]}, network=facts["other"])


def noisy_vector(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """Radio interference: noise in what the network sees."""
    sigma, noise = float(rng.uniform(0.05, 0.2)), np.random.default_rng(int(rng.integers(1 << 31)))
    return Fault(
        ("unlisted",),
        (),
        {"sigma": sigma},
        vector=lambda v, _: v + sigma * noise.standard_normal(len(v)),
    )


class Dropping:
    """Keeps the whole observation at random periods."""

    def __init__(self, share: float, seed: int) -> None:
        self.share, self.noise, self.kept = share, np.random.default_rng(seed), None

    def __call__(self, vector: np.ndarray, _: int) -> np.ndarray:
        if self.kept is None or self.noise.random() > self.share:
            self.kept = vector.copy()
        return self.kept


def dropped(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """A third of the observations is lost on the way, at random."""
    share = float(rng.uniform(0.2, 0.5))
    return Fault(
        ("unlisted",), (), {"share": share}, vector=Dropping(share, int(rng.integers(1 << 31)))
    )


def coupled(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """An encoder measures against the ground, not against the link before."""
    part = float(rng.uniform(0.3, 1.0))

    def see(q: np.ndarray, _: int) -> np.ndarray:
        q = q.copy()
        q[2] += part * q[1]
        return q

    return Fault(("unlisted",), (), {"part": part}, see={"q": see})


def coarse(rng: np.random.Generator, facts: Mapping[str, Any]) -> Fault:
    """The observation is packed into few bits."""
    step = float(rng.uniform(0.05, 0.2))
    return Fault(("unlisted",), (), {"step": step}, vector=lambda v, _: np.round(v / step) * step)


LISTED: tuple[Draw, ...] = (
    order_q, order_joints, order_command, order_target, order_history, order_layout, sign_q, sign_u, sign_command,
    sign_target, degrees, scale_q, scale_u, scale_command, raw_target, frame_yaw, frame_shift, frame_optical, rate_command,
    rate_q, delay_q, delay_command, delay_u, stuck_q, missing_u, clip_vector, clip_command, default_pose, history_zero,
    other_network,
)  # fmt: skip
UNLISTED: tuple[Draw, ...] = (noisy_vector, dropped, coupled, coarse)


def draw_effect(number: int, rng: np.random.Generator, joint: str) -> tuple[str, dict[str, Any]]:
    """Returns an effect outside of the training's range, by name, with its numbers."""
    if number == 0:
        return "flow_gain", {"joints": [joint], "gain": float(rng.uniform(0.35, 0.65))}
    if number == 1:
        return "dead_time", {"joints": "all", "dead_time_s": float(rng.uniform(0.25, 0.45))}
    return "dead_band", {
        "joints": [joint],
        "extend": float(rng.uniform(0.25, 0.5)),
        "retract": float(rng.uniform(0.25, 0.5)),
    }


NUM_EFFECTS, NUM_TASKS = 3, 3
"""Machines and tasks outside of the training, of the forty faults of a policy."""


def move_target(number: int, rng: np.random.Generator, target_m: np.ndarray) -> np.ndarray:
    """Returns a target outside of the training: farther, higher, or far to the side."""
    target_m = target_m.copy()
    flat = np.hypot(*target_m[:2])
    if number == 0:
        target_m[:2] *= (flat + rng.uniform(1.2, 2.2)) / flat
    elif number == 1:
        target_m[2] += rng.uniform(1.4, 2.2)
    else:
        angle = pick_sign(rng) * rng.uniform(2.2, 2.8)
        target_m[:2] = rotate_z(angle)[:2, :2] @ [flat, 0.0]
    return target_m
