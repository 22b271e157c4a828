"""Cases and answers of a diagnosis are read and written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE
from conftest import Brokk

from brokk_rl.errors import RecordingError
from diagnosis import answer, case, effect_library, effects_file
from diagnosis.closure import Gate, RivalError
from diagnosis.engine import decide
from diagnosis.engine.baseline import multiply_plain
from diagnosis.engine.descent import Prior, descend
from diagnosis.engine.evidence import LOSS_LIMIT, JointRow
from diagnosis.engine.rows import Row
from diagnosis.reference_diagnosis import propose_measurement, rank_effects


def test_a_case_without_its_half_is_refused(tmp_path: Path) -> None:
    (tmp_path / "field").mkdir()
    with pytest.raises(RecordingError, match=r"no reference/.*diagnosis.field"):
        case.load_case(tmp_path, MACHINE)


PLACE = {"rmse_rad": 0.03, "floor_rad": 0.002, "after_rad": 0.004, "share": 1.0}


def said() -> answer.Answer:
    """An answer with everything in it."""
    selected = answer.Selected(
        effect="backlash", joints=("q3",), probability=0.97,
        parameters={"gap_rad": {"q3": answer.Estimate(0.031, (0.028, 0.034))}}, gap_closed=answer.Estimate(0.91, (0.86, 0.95)),
        same_as=("lag",), decided_by="a dial gauge",
    )  # fmt: skip
    return answer.Answer(
        verdict="effects", selected=(selected,), ranking=(answer.Ranked("backlash", ("q3",), 0.97),),
        gap=answer.Gap(0.03, 0.004, 0.002, answer.Estimate(0.93, (0.88, 0.96))),
        where=answer.Where({"q3": PLACE}, (answer.RegimeGap("q3", "after a reversal", 0.8),), "actuation"),
        next_experiment=answer.NextExperiment("a dial gauge", ("backlash", "lag")),
        rivals={"hold": RivalError(0.09, {"q1": 0.1}), "arx": RivalError(None, {})},
        gates=(Gate("near_floor", False, 2.5, 1.75, "too far"),), reason="play", more={"sanity": [{"a": 1}]},
    )  # fmt: skip


def test_an_answer_is_written_in_the_fixed_format_and_read_again(tmp_path: Path) -> None:
    path = tmp_path / "diagnosis.json"
    said().write(path)
    found = json.loads(path.read_text())
    assert found["schema"] == 1 and found["sanity"] == [{"a": 1}]
    assert found["selected"][0]["parameters"]["gap_rad"]["q3"] == {"mean": 0.031, "ci95": [0.028, 0.034]}  # fmt: skip
    assert found["gap"]["before"] == {"rmse_rad": 0.03}
    regimes = [{"joint": "q3", "regime": "after a reversal", "share": 0.8}]
    assert found["where"] == {"joints": {"q3": PLACE}, "regimes": regimes, "stage": "actuation"}
    assert found["next_experiment"] == {"excitation": "a dial gauge", "separates": ["backlash", "lag"]}  # fmt: skip
    assert [one["rmse_rad"] for one in found["rivals"].values()] == [0.09, None]
    assert found["gates"] == [{"name": "near_floor", "passed": False, "value": 2.5, "limit": 1.75, "text": "too far"}]  # fmt: skip
    assert propose_measurement(said().selected) == said().next_experiment
    assert found["ranking"] == [{"effect": "backlash", "joints": ["q3"], "probability": 0.97}]
    assert answer.read_answer(path) == said()
    assert replace(said(), gap=answer.Gap(0.03, 0.03, 0.01, None)).to_json()["gap"]["closed"] is None  # fmt: skip
    path.write_text(json.dumps(found | {"schema": 2}))
    with pytest.raises(RecordingError, match="schema 2"):
        answer.read_answer(path)


def test_rivals_share_what_the_first_name_leaves() -> None:
    # Of one name in two forms the better one counts.
    earned = (("backlash", 90.0), ("lag", 60.0), ("stiction", 45.0), ("lag", 44.0), ("creep", -1.0))
    rivals = [decide.EffectFinding(name, {2: nats}) for name, nats in earned]
    found = rank_effects(said().selected, rivals, "effects", MACHINE)
    # Of 0.03, as e to 1, since 15 nats lie between them.
    shares = {"backlash": 0.97, "lag": 0.03 / (1 + np.exp(-1)), "stiction": 0.03 / (1 + np.e)}
    assert {one.effect: one.probability for one in found} == pytest.approx(shares)
    assert [one.effect for one in found] == list(shares)
    assert [one.effect for one in rank_effects((), (), "none", MACHINE)] == ["none"]


def test_training_takes_the_found_effects_as_they_are(tmp_path: Path, brokk: Brokk) -> None:
    path = tmp_path / effects_file.EFFECTS_FILE
    effects_file.write_effects(said(), effect_library.load_effects(MACHINE), path)
    done = brokk("mode=train", f"effect=@{path}", "--cfg", "job")
    text = done.out[done.out.index("backlash:") :]
    assert "q3: 0.031" in text and "other: 0.0" in text


def weigh(**nets: dict[int, float]) -> decide.EvidenceTable:
    """Return a table of effects with gains by joint, nats; jitter is of the whole machine, slip outside the library."""
    kinds: Any = {"jitter": {"is_common": True}, "slip": {"is_outside": True}}
    found = [decide.EffectFinding(name, one, **kinds.get(name, {})) for name, one in nets.items()]
    return decide.EvidenceTable(tuple(found))


def test_a_cause_is_named_or_unknown_by_what_it_earns() -> None:
    lag = {1: 50.0}
    cases = [
        (weigh(lag={1: 32.0}), 0.0, "effects"), (weigh(lag={1: 31.9}), 0.0, "none"),
        # a row outside the library, or flexible columns, explain so much more
        (weigh(slip={1: 82.0}, lag=lag), 0.0, "effects"), (weigh(slip={1: 82.1}, lag=lag), 0.0, "unknown"),
        (weigh(lag=lag), 82.0, "effects"), (weigh(lag=lag), 82.1, "unknown"),
        # a cause of the whole machine that one joint alone shows is none
        (weigh(jitter={0: 75.0, 1: 32.0}), 50.1, "effects"), (weigh(jitter={0: 75.1, 1: 31.9}), 32.1, "unknown"),
        (weigh(jitter={0: 31.0, 1: 31.9}), 0.0, "none"), (weigh(jitter={0: 32.0}), 0.0, "effects"),
    ]  # fmt: skip
    for table, generic, expected in cases:
        assert decide.is_unknown(table, generic, is_coarse=False) == (expected == "unknown")
        if expected != "unknown":
            assert len(decide.select(table, lambda _: weigh())) == (expected == "effects")
        # the best effects of all joints together explain it, or the steps of a coarse sensor
        owned = (*table.found, *weigh(creep={2: 99.0}, sag={3: 99.0}).found)
        assert not decide.is_unknown(decide.EvidenceTable(owned), generic, is_coarse=False)
        assert not decide.is_unknown(table, generic, is_coarse=True)
    # joints bear a common cost in proportion
    assert decide.share_cost([60.0, 25.0, 15.0], 20.0) == [48.0, 20.0, 12.0]
    assert decide.share_cost([60.0, -5.0], 56.0) == [0.0, 0.0]


def test_a_further_effect_earns_enough_beside_those_before_it() -> None:
    first = weigh(lag={1: 400.0, 2: 50.0}, creep={1: 90.0})
    cases = [
        # on other joints it earns what any effect has to earn
        ({0: 32.0}, [{0: 32.0}]), ({0: 31.9}, []),
        # where one before it earns four times as much it does not count; other joints keep what they earn
        ({1: 100.0}, [{1: 100.0}]), ({1: 99.9}, []), ({0: 32.0, 1: 99.9}, [{0: 32.0}]), ({1: 40.0, 2: 50.0}, [{2: 50.0}]),
    ]  # fmt: skip
    for nets, expected in cases:
        # jitter earns more, and shows on joints of the first alone
        tables = iter([weigh(jitter={1: 99.0, 2: 12.0, 0: 9.0}, creep=nets), weigh()])
        found = decide.select(first, lambda _, tables=tables: next(tables))
        assert [dict(one.nets) for one in found[1:]] == expected
    # what shows by itself is not named again
    assert decide.select(first, lambda _: weigh(), known=[first.found[0]]) == []


@pytest.mark.parametrize(("nats", "told"), [(131.9, False), (132.0, True)])
def test_held_commands_earn_enough_beyond_a_dead_time(nats: float, told: bool) -> None:
    # 100 nats are left of the dead time when it has paid for a joint
    late = {0: JointRow(Row("dead_time", (("delay_s", "add", 0.1),)), 112.0)}
    given = {"field": None, "weigh_rows": lambda _: {}, "weigh_common": lambda *_: late}
    decider: Any = object.__new__(decide.Decider)
    decider.evidence = SimpleNamespace(**given)
    decider.outside = frozenset()
    decider._view = lambda _: [SimpleNamespace(side=None)]
    decider._find_held = lambda _: decide.EffectFinding("delay_jitter", {0: nats})
    assert (len(decider.weigh(()).found) == 2) is told


def test_a_joint_counts_for_the_effect_that_earns_most_on_it() -> None:
    row = Row("lag", (("command_lag_s", "add", 0.2),))
    lag = {0: JointRow(row, 50.0), 1: JointRow(row, 30.0), 2: JointRow(row, 12.0)}
    backlash = {0: JointRow(row, 49.0), 1: JointRow(row, 31.0)}
    table = {"lag": lag, "backlash": backlash, "hysteresis": {0: JointRow(row, 99.0)}}
    expected = {0: "lag", 1: "backlash"}
    assert decide.find_owners(table, frozenset({"hysteresis"})) == expected


def test_a_joint_that_a_common_cause_makes_worse_stays_as_it_was() -> None:
    row = Row("flow_sharing", (("demand_limit", "add", 1.0),))
    found = decide.add_up("flow_sharing", {0: JointRow(row, LOSS_LIMIT), 1: JointRow(row, 90.0)})
    assert found.joints == (0, 1)
    assert set(found.rows) == {1}


def test_what_one_joint_alone_shows_is_no_heat_of_the_oil() -> None:
    row = Row("thermal_drift", (("thermal_share", "add", 0.2), ("thermal_s", "add", 90.0)))
    for other_nats, told in ((0.0, False), (60.0, True)):
        rows = {0: JointRow(row, 90.0), 1: JointRow(row, other_nats)}
        assert decide.add_up("thermal_drift", rows).shows_on_several == told


def test_a_descent_goes_on_where_long_steps_gain_nothing() -> None:
    """From 3 a step of Gauss and Newton down an arc tangent ends beyond -5, and so does one half as long."""
    wide = np.array([1e6])
    prior = Prior(0.0 * wide, wide, np.array([1e-6]), -wide, wide)
    assert abs(descend(np.arctan, np.zeros(1), multiply_plain, np.array([3.0]), prior, 30)) < 1e-6
