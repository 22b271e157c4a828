"""Each excitation does what it says: worked numbers, and the plant's own weight as an oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import MACHINE, option

from actuators.excite.poses import draw_start_poses
from brokk_rl.contracts.actuator import Segment
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine


def segments(
    name: str, machine: Machine, duration_s: float, seed: int = 0, **fields: object
) -> list[Segment]:
    excitation = replace(option("excitation", name), **fields)
    return excitation.segments(machine, duration_s, np.random.default_rng(seed))


def moved(segment: Segment) -> set[int]:
    return set(np.flatnonzero(np.abs(segment.u).max(0)).tolist())


def test_start_poses_load_each_joint_from_both_sides_where_gravity_can() -> None:
    """Four poses show every sign there is."""
    generator = np.random.default_rng(0)

    def find_signs(q: np.ndarray) -> list[set[float]]:
        signs = np.sign(np.round(Gravity(MACHINE).load(q)))
        return [set(column) for column in signs.T.tolist()]

    anywhere = find_signs(generator.uniform(MACHINE.lower, MACHINE.upper, (500, 5)))
    chosen = draw_start_poses(MACHINE, 0.06, generator)
    for _ in range(5):
        assert find_signs(np.stack([next(chosen) for _ in range(4)])) == anywhere


def test_a_machine_without_bodies_starts_anywhere_within_its_margins() -> None:
    bare = option("machine", "mini_excavator")
    assert not bare.has_bodies
    for name in ("levels", "holds", "ramps", "work"):
        for segment in segments(name, bare, 300.0):
            margin = segment.stop_margin * (bare.upper - bare.lower)
            assert (segment.start >= bare.lower + margin).all()
            assert (segment.start <= bare.upper - margin).all()


def test_sines_are_one_segment_a_joint_of_whole_waves_from_home() -> None:
    found = segments("sine", MACHINE, 900.0)
    names = [f"sine_{joint}" for joint in MACHINE.joint_names]
    assert sorted(segment.name for segment in found) == names
    for segment in found:
        (joint,) = moved(segment)
        assert segment.name.endswith(MACHINE.joint_names[joint]) and segment.stops == "home"
        assert (segment.start == MACHINE.home).all() and len(segment.u) == 3600  # 180 s at 20 Hz
        u = segment.u[:, joint]
        assert u[0] == 0 and 0.1 < np.abs(u).max() <= 1.0
        assert abs(u.sum() * MACHINE.period_s) < 0.1, "whole waves end where they began"


def test_the_waves_keep_to_their_band() -> None:
    band = {"lowest_hz": 0.2, "highest_hz": 0.25, "smallest": 0.5, "largest": 0.6}
    segment = segments("sine", MACHINE, 600.0, **band)[0]
    u = segment.u[:, moved(segment).pop()]
    rising = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0))
    assert 0.45 < np.abs(u).max() <= 0.6
    assert np.median(np.diff(rising)) == pytest.approx(20 / 0.225, rel=0.15)


def test_levels_move_several_joints_at_once_and_exclusive_ones_by_themselves() -> None:
    found = segments("levels", MACHINE, 600.0)
    assert len(found) == 10 and all(len(segment.u) == 1200 for segment in found)
    u = np.concatenate([segment.u for segment in found])
    others = np.delete(u, 1, axis=1)
    assert not ((u[:, 1] != 0) & (others != 0).any(1)).any()
    assert ((others != 0).sum(1) >= 2).mean() > 0.4
    assert 0.15 < (u[:, 1] != 0).mean() < 0.35  # 0.3 of the turns, 0.7 of the levels
    # each pose has its exclusive turn
    assert all((segment.u[:, 1] != 0).any() for segment in found)


def test_ramps_cross_zero_at_each_slope_in_both_directions() -> None:
    found = segments("ramps", MACHINE, 1200.0, reach=0.3)
    slopes = {}
    for segment in found:
        (joint,) = moved(segment)
        u = segment.u[:, joint]
        middle = len(u) // 2
        slopes.setdefault(joint, set()).add(round(float(np.diff(u)[middle]) / MACHINE.period_s, 2))
        assert u[0] == u[-1] == 0 and u[middle] == pytest.approx(0.0, abs=1e-12)
        way = np.abs(np.cumsum(u)).max() * MACHINE.period_s * MACHINE.max_speed[joint]
        assert way <= 0.32 * (MACHINE.upper - MACHINE.lower)[joint]
    assert set(slopes) == set(range(5))
    seen = set().union(*slopes.values())
    assert {round(abs(slope), 2) for slope in seen} == {0.05, 0.1, 0.2}
    assert min(seen) < 0 < max(seen)


def test_holds_are_still_in_poses_of_different_load() -> None:
    found = segments("holds", MACHINE, 100.0)
    assert [len(segment.u) for segment in found] == [500] * 4
    assert not any(segment.u.any() for segment in found)
    assert len({tuple(segment.start) for segment in found}) == 4


def test_reversals_come_back() -> None:
    for segment in segments("reversals", MACHINE, 120.0):
        (joint,) = moved(segment)
        assert segment.u[:, joint].sum() == pytest.approx(0.0)
        assert (np.diff(np.sign(segment.u[:, joint])) == -2).sum() >= 12


def test_an_excitation_that_finds_no_room_says_so() -> None:
    for name in ("holds", "ramps", "reversals", "sine"):
        with pytest.raises(ConfigError, match=f"excitation={name}.*raise collect.run_minutes"):
            segments(name, MACHINE, 5.0)


@pytest.mark.parametrize("name", ["sine", "levels", "ramps", "reversals", "work"])
def test_another_seed_draws_others(name: str) -> None:
    one, other = (segments(name, MACHINE, 300.0, seed) for seed in (1, 2))
    first, second = (np.concatenate([part.u for part in found]) for found in (one, other))
    assert not np.array_equal(first, second)


def test_a_person_at_work_ramps_few_levers_and_corrects_after_a_stroke() -> None:
    fields = {"ramp_s": 0.5, "level": (0.9, 0.9), "corrections": 3, "correction_level": (0.2, 0.3)}
    played = segments("work", MACHINE, 600.0, **fields)
    u = np.concatenate([segment.u for segment in played])
    moving = np.abs(u) > 0
    assert moving.sum(1).max() == 2
    exclusive = moving[:, MACHINE.is_exclusive].any(1)
    assert exclusive.any() and not moving[exclusive][:, ~MACHINE.is_exclusive].any()
    # A stroke of 0.9 takes 0.5 s to ramp, a correction of 0.3 half of its 0.2 s: no jump.
    assert max(np.abs(np.diff(segment.u, axis=0)).max() for segment in played) < 0.31
    turned = (u[:-1] * u[1:] < 0).sum() + ((u[:-2] * u[2:] < 0) & (u[1:-1] == 0)).sum()
    assert turned > 50 and (moving.any(1)).mean() < 0.95
