"""Joints in another order are named with the order: by legs where states are logged, any by a logged vector."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from arm import make_machine

from brokk_rl.record import Recording
from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm, PolicyContract
from diagnosis.deployment.examination import Deployment
from diagnosis.deployment.orders import invert_order, list_orders, match_order

LEGS, KINDS = ("FL", "FR", "RL", "RR"), ("hip", "thigh", "calf")
BY_KIND = [f"{leg}_{kind}" for kind in KINDS for leg in LEGS]
NUM_ROWS = 160


class TanhNetwork:
    """A network of two layers with fixed weights."""

    def __init__(self, size: int) -> None:
        rng = np.random.default_rng(0)
        self._first, self._second = rng.normal(0, 0.3, (size, 24)), rng.normal(0, 0.3, (24, 12))

    def answer(self, vectors: np.ndarray) -> np.ndarray:
        return np.tanh(np.tanh(vectors @ self._first) @ self._second)


def make_policy() -> LoadedPolicy:
    pose = np.repeat([0.1, 0.8, -1.2], 4)
    terms = []
    for name, columns, mean, newest in (
        ("q", [f"q_{joint}_rad" for joint in BY_KIND], pose, 0),
        ("dq", [f"dq_{joint}" for joint in BY_KIND], np.zeros(12), 0),
        ("u", [f"u_{joint}" for joint in BY_KIND], np.zeros(12), -1),
    ):
        terms.append(ObservationTerm(name, tuple(columns), 1, newest, mean, np.ones(12), None))
    commands = tuple(f"u_{joint}" for joint in BY_KIND)
    contract = PolicyContract(Path("a.json"), 50.0, tuple(BY_KIND), tuple(terms), commands, None)  # fmt: skip
    return LoadedPolicy(contract, cast(Any, TanhNetwork(36)))


def run_loop(
    policy: LoadedPolicy, inputs: dict[str, list[int]], outputs: list[int], observed: bool
) -> Recording:
    """Returns a run whose code hands columns over in other orders, the pose subtracted in the right one."""
    t_s = np.arange(NUM_ROWS) * 0.02
    phase = np.arange(12)
    pose = np.repeat([0.1, 0.8, -1.2], 4)
    q = pose + 0.2 * np.sin((2 + 0.3 * phase) * t_s[:, None] + phase)
    dq = np.gradient(q, 0.02, axis=0)
    u, vectors = np.zeros((NUM_ROWS, 12)), np.zeros((NUM_ROWS, 36))
    for k in range(NUM_ROWS):
        parts = {"q": q[k] - pose, "dq": dq[k], "u": u[k - 1] if k else np.zeros(12)}
        vectors[k] = np.concatenate([part[inputs.get(name, list(range(12)))] for name, part in parts.items()])  # fmt: skip
        u[k] = policy.network.answer(vectors[k : k + 1])[0][outputs]
    extra = {f"dq_{joint}": dq[:, j] for j, joint in enumerate(BY_KIND)}
    if observed:
        extra |= {f"obs_{j}": vectors[:, j] for j in range(36)}
    return Recording(
        machine="quadruped", joints=tuple(BY_KIND), units=("rad",) * 12, rate_hz=50.0, t_s=t_s,
        u=u.astype(np.float32), q=q.astype(np.float32),
        extra={name: values.astype(np.float32) for name, values in extra.items()},
    )  # fmt: skip


SAME = list(range(12))
BY_LEG = [BY_KIND.index(f"{leg}_{kind}") for leg in ("FR", "FL", "RR", "RL") for kind in KINDS]
SHUFFLED = np.random.default_rng(3).permutation(12).tolist()
ALL = dict.fromkeys(("q", "dq", "u"), BY_LEG)


@pytest.mark.parametrize(
    ("inputs", "outputs", "observed", "text"),
    [
        (ALL, SAME, False, "q, dq and u are in another order: FR_hip, FR_thigh, FR_calf"),
        (ALL, list(invert_order(tuple(BY_LEG))), False, "q, dq, u and the commands are in another order: FR_hip, FR_thigh"),
        ({"q": [1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10]}, SAME, False, "q is in another order: FR_hip, FL_hip"),
        ({"dq": SHUFFLED}, SAME, True, "dq is in another order: " + ", ".join(BY_KIND[k] for k in SHUFFLED)),
        ({}, SHUFFLED, False, "commands reach the joints in another order: " + BY_KIND[SHUFFLED[0]]),
    ],
)  # fmt: skip
def test_an_order_of_twelve_joints_is_named(
    inputs: dict[str, list[int]], outputs: list[int], observed: bool, text: str
) -> None:
    policy = make_policy()
    recording = run_loop(policy, inputs, outputs, observed)
    answer = Deployment(policy, make_machine(*BY_KIND)).examine([recording], None, {}, 0)
    assert answer.verdict == "code"
    assert text in answer.reason


def test_orders_of_legs_and_kinds_are_listed_with_what_undoes_them() -> None:
    orders = set(list_orders(BY_KIND))
    assert tuple(BY_LEG) in orders and invert_order(tuple(BY_LEG)) in orders
    assert tuple(SAME) not in orders
    long = {"FL": "left_front", "FR": "right_front", "RL": "left_hind", "RR": "right_hind"}
    assert tuple(BY_LEG) in set(list_orders([long[name[:2]] + name[2:] for name in BY_KIND]))
    known = np.random.default_rng(0).normal(size=(50, 12))
    assert match_order(known, known[:, SHUFFLED]) == tuple(SHUFFLED)
    assert match_order(known, known[:, SHUFFLED] + 1.0) is None
    assert match_order(known, known) is None
