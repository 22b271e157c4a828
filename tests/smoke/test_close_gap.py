"""`mode=close_gap`, end to end and small: retrain, evaluate on three plants, report; and go on after an interruption."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Done

pytestmark = pytest.mark.slow

SMALL = (
    "mode=close_gap", "session.out=run", "session.device=cpu", "actuator=lag", "actuator@stand_in.actuator=lag",
    "effect@found=[@found.yaml]", "effect@stand_in.effect=[@found.yaml]", "sim.native.num_worlds=16", "rl.num_starts=64",
    "rl.save_interval=2", "rl.budget.max_env_steps=768", "evaluation.episodes=8", "evaluation.num_recorded=2",
)  # fmt: skip
FOUND = "# @package effect\ndead_band: {_target_: actuators.effects.command.DeadBand, joints: [q3], extend: 0.1, retract: 0.1}\n"


@pytest.mark.slow
def test_a_policy_is_retrained_and_judged_on_three_plants(
    brokk: Callable[..., Done], tmp_path: Path
) -> None:
    (tmp_path / "found.yaml").write_text(FOUND)
    assert (done := brokk(*SMALL)).code == 0, done.err
    run = tmp_path / "run"
    found = json.loads((run / "close_gap.json").read_text())
    assert list(found["success"]) == ["before", "after", "classical"] and found["episodes"] == 8
    assert found["plants"] == {
        "simulator": "lag",
        "repaired": "lag + dead_band",
        "machine": "lag + dead_band",
    }
    assert (
        found["retraining"]["trained with"] == "lag + library + dead_band"
        and found["retraining"]["control steps"] == 768
    )
    for policy in found["success"].values():
        # the stand-in is just the repaired simulator, and all meet the same starts and noise
        assert policy["repaired"] == policy["machine"]
    assert (run / "close_gap.html").exists() and (run / "retrained" / "policy.onnx").exists()

    before = (run / "retrained" / "policy.safetensors").read_bytes()
    (run / "machine" / "evaluation.json").unlink()  # as if interrupted there
    assert (done := brokk(*SMALL, "resume=run")).code == 0, done.err
    assert (run / "retrained" / "policy.safetensors").read_bytes() == before, "what is done is kept"
    assert json.loads((run / "close_gap.json").read_text())["success"] == found["success"]
