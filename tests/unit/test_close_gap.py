"""Gain in success by training with a diagnosis: intervals, sentences, and the mode's refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import option
from conftest import Done
from training import CPU, plant, small, train

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import describe_policy, write_policy
from brokk_rl.rl.policy import load_initial_weights, make_actor
from diagnosis import retraining

EPISODES = 200


def spread(actor: Any) -> torch.Tensor:
    return actor.distribution.log_std_param


def row(rate: float) -> dict[str, Any]:
    return {
        "episodes": EPISODES,
        "success_strict": {"mean": rate},
        "time_to_insert_s": {"median": 9.0 if rate else None},
    }


def evaluations(**rates: tuple[float, float, float]) -> dict[str, dict[str, Any]]:
    """Returns what `mode=evaluate` says on simulator, repaired simulator and machine, from rates by policy."""
    return {
        place: {
            "episodes": EPISODES,
            "policies": {policy: row(three[number]) for policy, three in rates.items()},
        }
        for number, place in enumerate(retraining.PLANTS)
    }


def test_success_that_fell_and_came_back_is_told_as_such(tmp_path: Path) -> None:
    found = retraining.compare_policies(
        evaluations(before=(0.95, 0.2, 0.15), after=(0.9, 0.95, 0.93), classical=(0.9, 0.1, 0.1))
    )
    text, tone = retraining.write_headline(found)
    assert tone == "good" and "95 % (91 to 97)" in text and "15 % (11 to 21)" in text
    assert found["fall"]["mean"] == pytest.approx(0.8) and found["return"]["mean"] == pytest.approx(
        0.78
    )
    assert found["predicted"]["mean"] == 0.95 and found["achieved"]["mean"] == 0.93
    retraining.write_report(found | {"plants": {}, "retraining": {}}, tmp_path)
    assert text in (tmp_path / retraining.REPORT_FILE).read_text()
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(("after", "tone"), [(0.5, "good"), (0.16, "bad"), (0.05, "bad")])
def test_what_did_not_come_back_is_not_sold_as_success(after: float, tone: str) -> None:
    rates = evaluations(before=(0.95, 0.2, 0.15), after=(0.9, 0.95, after))
    assert retraining.write_headline(retraining.compare_policies(rates))[1] == tone


def test_without_a_fall_there_is_nothing_to_regain() -> None:
    found = retraining.compare_policies(
        evaluations(before=(0.95, 0.94, 0.93), after=(0.95, 0.95, 0.95))
    )
    assert retraining.write_headline(found)[0].startswith("Nothing to regain")


def test_the_interval_of_a_difference_is_newcombe_s() -> None:
    # his table II, case (a), 56/70 and 48/80: 0.0524 to 0.3339
    first, second = (
        {"mean": k / n, "ci95": list(retraining.compute_wilson_interval(k, n))}
        for k, n in ((56, 70), (48, 80))
    )
    assert retraining.subtract_rates(first, second)["ci95"] == pytest.approx(
        [0.0524, 0.3339], abs=5e-5
    )


def test_training_that_begins_with_a_policy_has_its_network_and_its_own_exploration(
    machine: Machine, tmp_path: Path
) -> None:
    training = small(max_env_steps=64)
    runner = train(machine, tmp_path / "old", training)
    old = runner.alg.actor
    with torch.no_grad():
        spread(old).fill_(-3.0)  # as one that has settled
    env = runner.env
    network = training.describe_network()
    contract = describe_policy(network, env.task, env.description, machine)
    write_policy(tmp_path / "old", contract, old.state_dict())
    loop = plant(machine).build(CPU, 16, 64, 0)
    actor = make_actor(network, loop.get_observations(), loop.num_actions)
    load_initial_weights(actor, str(tmp_path / "old"), machine)
    groups = loop.get_observations()
    np.testing.assert_array_equal(actor(groups).detach(), old(groups).detach())
    shipped = option("rl", "ppo").runner["actor"]["distribution_cfg"]["init_std"]
    torch.testing.assert_close(spread(actor).exp(), torch.full((5,), shipped))

    network["actor"]["hidden_dims"] = [8]
    other = make_actor(network, loop.get_observations(), loop.num_actions)
    with pytest.raises(CheckpointError, match="policy="):
        load_initial_weights(other, str(tmp_path / "old"), machine)


def test_without_an_effect_there_is_nothing_to_retrain_with(brokk: Callable[..., Done]) -> None:
    done = brokk("mode=close_gap")
    assert done.code == 2 and "no effect to retrain with" in done.err


def test_an_interrupted_run_goes_on_in_its_own_folder_only(
    brokk: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "found.yaml").write_text(
        "# @package effect\nlag: {_target_: actuators.effects.speed.Lag, joints: all, time_constant_s: 0.1}\n"
    )
    done = brokk("mode=close_gap", "effect@found=[@found.yaml]", "resume=elsewhere")
    assert done.code == 2 and "session.out=elsewhere" in done.err
