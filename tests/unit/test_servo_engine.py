"""The servo model of the engine against SciPy and worked numbers, and diagnoses of arms written apart from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import option
from gaps import diagnose
from motion import make_recording
from scipy.signal import cont2discrete, lsim

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import effect_library
from diagnosis.case import GapCase
from diagnosis.engine.evidence import RowEvidence
from diagnosis.engine.rows import Row
from diagnosis.engine.servo import SERVO
from diagnosis.engine.side import Side, stack_side
from diagnosis.engine.sizes import is_plain, translate

RESPONSE_S, DAMPING, DELAY_S = 0.05, 0.7, 0.06
ARM_RESPONSE_S, ARM_DAMPING = 0.03, 0.8
SUBSTEPS = 10
"""Steps of the plant in a control period."""


def record_arm(seed: int, lost: float, late_s: float, damping: float = ARM_DAMPING) -> Recording:
    """Returns a minute and a half of ramps to and fro, followed by a loop of second order.

    A frame is lost with the chance `lost`, else late by up to `late_s`; none overtakes another.
    """
    random = np.random.default_rng(seed)
    count = 4500
    slopes = random.uniform(0.3, 1.2, (count // 45, 5)) * ARM.period_s
    slopes[1::2] *= -1.0
    u = np.cumsum(np.repeat(slopes, 45, 0), 0)
    u = np.clip(u - u.mean(0), -0.9, 0.9)
    come_s = ARM.period_s * np.arange(count) + random.uniform(0.0, 1.0, count) * late_s
    arrives = random.random(count) >= lost
    come_s = np.maximum.accumulate(come_s[arrives])
    fine_s = ARM.period_s / SUBSTEPS * np.arange(count * SUBSTEPS)
    sent = u[arrives][np.maximum(np.searchsorted(come_s, fine_s, "right") - 1, 0)]
    middle, half = (ARM.upper + ARM.lower) / 2, (ARM.upper - ARM.lower) / 2
    loop = np.array([[0.0, 1.0], [-(ARM_RESPONSE_S**-2), -2.0 * damping / ARM_RESPONSE_S]])
    drive = np.array([[0.0], [ARM_RESPONSE_S**-2]])
    continuous = (loop, drive, np.eye(2), 0.0 * drive)
    discrete: Any = cont2discrete(continuous, ARM.period_s / SUBSTEPS)
    a, b = discrete[:2]
    state, q = np.stack([middle + half * u[0], np.zeros(5)]), []
    for k, command in enumerate(sent):
        if k % SUBSTEPS == 0:
            q.append(state[0].copy())
        state = a @ state + b * (middle + half * command)
    noise = 3e-4 * random.standard_normal((count, 5))
    return make_recording(ARM, u, np.array(q) + noise)


ARM = option("machine", "so101")


PAIR = replace(ARM, joints=ARM.joints[:2], name="pair")
"""Two servos of a tabletop arm."""


def record_pair(seeds: tuple[int, ...], **changes: float) -> list[Recording]:
    """Return recordings of the first joints of the arm, sound ones without changes."""
    found = []
    for seed in seeds:
        arm = record_arm(seed, **({"lost": 0.0, "late_s": 0.0} | changes))
        found.append(make_recording(PAIR, arm.u[:, :2], arm.q[:, :2]))
    return found


def stand_still(machine: Machine, u: np.ndarray) -> Side:
    """Return a side whose joints stand in the middle of their travel under targets `(T, J)`."""
    middle = 0.5 * (machine.upper + machine.lower)
    still = make_recording(machine, u, np.repeat(middle[None], len(u), 0))
    return stack_side([still], machine)


def simulate(u: np.ndarray, **values: float) -> np.ndarray:
    """Return the path of the first joint under targets `(T,)`, half travels from the middle."""
    numbers = np.zeros(len(SERVO.numbers))
    plain = {"response_s": RESPONSE_S, "damping_ratio": DAMPING, "firmware_damping": 0.5}
    for name, value in (plain | values).items():
        numbers[SERVO.place[name]] = value
    side = stand_still(PAIR, np.stack([u, np.zeros_like(u)], 1))
    middle = 0.5 * (PAIR.upper + PAIR.lower)
    unit = 0.5 * (PAIR.upper - PAIR.lower)[0]
    return side.simulate(0, numbers)[0].astype(float) - middle[0] / unit


def test_a_loop_without_friction_is_that_of_scipy() -> None:
    u = np.zeros(200)
    u[20:90] = 0.4
    u[90:] = -0.3
    path = simulate(u, delay_s=DELAY_S)
    fine, late = 20, round(DELAY_S / PAIR.period_s)
    held = np.repeat(np.concatenate([np.zeros(late), u[:-late]]), fine)
    w = 1.0 / RESPONSE_S
    system = ([[0.0, 1.0], [-w * w, -2.0 * DAMPING * w]], [[0.0], [w * w]], [[1.0, 0.0]], [[0.0]])
    _, expected, _ = lsim(system, held, PAIR.period_s / fine * np.arange(len(held)), interp=False)
    # Four explicit steps a period of 20 ms.
    assert np.abs(path - expected[::fine]).max() < 0.03


def test_a_servo_under_a_steady_target_does_not_follow_its_own_measured_motion() -> None:
    """Nor is it told of it by a sag that depends on the place."""
    numbers = SERVO.list_values("mean")
    for name, value in {"sag": 0.1, "sag_pose_1": -0.5, "sag_pose_2": 0.2}.items():
        numbers[SERVO.place[name]] = value
    side = stand_still(PAIR, np.full((300, 2), 0.25))
    q = side.q.copy()
    q[1:] += np.random.default_rng(1).normal(0.0, 0.02, (299, 2)).cumsum(0)
    path = side.simulate(0, numbers)[0]
    assert side.with_positions(q).simulate(0, numbers)[0] == pytest.approx(path, abs=1e-6)
    assert np.ptp(path) > 0.1  # it moves to its target


def test_dry_friction_holds_a_joint_beside_its_target() -> None:
    up = np.linspace(0.0, 0.4, 150)
    u = np.concatenate([up, up[::-1], np.zeros(50)])
    path = simulate(u, dry=0.05)
    # On the way back the joint is late by twice the friction over the stiffness.
    forth, back = np.interp(0.2, up, path[:150]), np.interp(0.2, up, path[299:149:-1])
    lag = 2.0 * 2.0 * DAMPING * RESPONSE_S * 0.4 / (149 * PAIR.period_s)
    assert back - forth == pytest.approx(2.0 * 0.05 + lag, abs=0.01)


def test_a_limited_pull_reaches_the_speed_at_which_its_damping_takes_it_all() -> None:
    u = np.full(100, 0.9)
    u[0] = 0.0
    shortage, inside = 4.0, 0.5
    path = simulate(u, shortage=shortage, firmware_damping=inside)
    speed = np.diff(path)[18:26].max() / PAIR.period_s
    outside_s = 2.0 * (1.0 - inside) * DAMPING * RESPONSE_S
    assert speed == pytest.approx(0.1 / shortage / outside_s, rel=0.03)


def test_a_joint_falls_where_the_limit_is_below_its_weight() -> None:
    held = simulate(np.zeros(100), sag=0.03, shortage=2.0)
    falls = simulate(np.zeros(100), sag=0.06, shortage=2.0)
    assert held[-1] == pytest.approx(-0.03, abs=1e-3)
    assert falls[-1] < -0.3


def command_positions(name: str) -> Machine:
    """Return a machine whose joints are commanded by position."""
    known = option("machine", name)
    joints = [replace(joint, command="position") for joint in known.joints]
    return replace(known, joints=tuple(joints), levers=())


@pytest.mark.parametrize("name", ["so101", "brokk170"])
def test_every_row_has_the_numbers_of_its_effect(name: str) -> None:
    machine = command_positions(name)
    kinds = {kind.name: kind for kind in effect_library.load_effects(machine)}
    loaded = {"sag_load"} if machine.has_bodies else {"sag", "sag_pose_1"}
    for row in SERVO.rows:
        changed = {number for number, *_ in row.changes}
        if is_plain(row, SERVO) and (row.effect != "sag" or changed <= loaded):
            assert set(translate(row, 0, machine)) <= set(kinds[row.effect].numbers)


def test_weight_pulls_a_joint_from_its_target() -> None:
    machine = command_positions("brokk170")
    side = stand_still(machine, np.zeros((100, machine.num_joints)))
    joint = int(np.abs(side.load[:, 0]).argmax())
    numbers = SERVO.list_values("mean")
    for name in ("dry", "load_dry"):
        numbers[SERVO.place[name]] = 0.0
    row = Row("sag", (("sag_load", "add", 0.05),))
    pulled = side.simulate(joint, SERVO.change(numbers, [row]))[0]
    off = pulled[-1] - side.q[-1, joint]
    assert off == pytest.approx(0.05 * side.load[joint, -1], rel=1e-2)


def test_a_row_pays_for_what_it_earns_on_a_left_out_part() -> None:
    reference = stack_side(record_pair((1, 2)), PAIR)
    evidence = RowEvidence(reference, reference)
    joint, *_ = evidence.view_field([one.numbers for one in evidence.bases])
    base, row = evidence.bases[0], SERVO.rows[-1]
    added = joint.simulate([row])[0]
    for part, is_paid in ((-1, False), (2, True)):
        base.left_out[:] = np.where(base.part == part, added, 0.0)
        assert (evidence._price(joint, row) > 20.0) == is_paid


@pytest.mark.parametrize(
    ("lost", "late_s", "named"),
    [(0.0, 0.0, []), (0.2, 0.0, ["frame_loss"]), (0.0, 0.08, ["delay_jitter"])],
)
def test_late_and_lost_frames_of_servos_are_named(
    lost: float, late_s: float, named: list[str]
) -> None:
    field = record_pair((4, 5), lost=lost, late_s=late_s)
    answer = diagnose(GapCase(PAIR, record_pair((1, 2, 3)), field))
    assert [one.effect for one in answer.selected][:1] == named


@pytest.mark.parametrize(
    ("late", "joints"), [(3, [1]), pytest.param(2, [0, 1], marks=pytest.mark.slow)]
)
def test_late_servos_are_named_with_their_delay(late: int, joints: list[int]) -> None:
    field = []
    for one in record_pair((4, 5)):
        q = one.q.copy()
        q[late:, joints] = one.q[:-late, joints]
        field.append(replace(one, q=q))
    answer = diagnose(GapCase(PAIR, record_pair((1, 2, 3)), field))
    names = tuple(PAIR.joint_names[j] for j in joints)
    assert [(one.effect, one.joints) for one in answer.selected] == [("dead_time", names)]
    for name in names:
        estimate = answer.selected[0].parameters["dead_time_s"][name]
        assert estimate.mean == pytest.approx(late * PAIR.period_s, rel=0.1)


@pytest.mark.parametrize("factor", [pytest.param(0.6, marks=pytest.mark.slow), 1.5])
def test_another_damping_is_named_alone_with_its_size(factor: float) -> None:
    field = []
    changed = record_pair((4, 5), damping=factor * ARM_DAMPING)
    for one, other in zip(record_pair((4, 5)), changed, strict=True):
        field.append(replace(one, q=np.stack([one.q[:, 0], other.q[:, 1]], 1)))
    answer = diagnose(GapCase(PAIR, record_pair((1, 2, 3)), field))
    assert [(one.effect, one.joints) for one in answer.selected] == [("damping", ("pitch",))]
    estimate = answer.selected[0].parameters["factor"]["pitch"]
    assert estimate.mean == pytest.approx(factor, rel=0.1)
    assert estimate.ci95[0] < factor < estimate.ci95[1]
