"""Numbers that no training can use are refused by name before torch is loaded."""

from __future__ import annotations

import pytest
from invoked import Refusal, refuse_all

BAD = {
    "rl.num_envs=0": "rl.num_envs: expected a whole number from 1 to",
    "rl.num_starts=0": "rl.num_starts: expected a whole number of 1 or more, got 0",
    "rl.settling=2": "rl.settling",
    "rl.budget.max_seconds=-1": "rl.budget.max_seconds: expected a finite number above 0",
    "rl.runner.algorithm.learning_rate=-1e-3": "rl.runner.algorithm.learning_rate: expected a finite number above 0, got -0.001",
    "rl.runner.algorithm.learning_rate=fast": "rl.runner.algorithm.learning_rate",
    "rl.runner.algorithm.gamma=1.5": "rl.runner.algorithm.gamma",
    "rl.runner.num_steps_per_env=0": "rl.runner.num_steps_per_env",
    "rl.runner.actor.hidden_dims=[64,0]": "rl.runner.actor.hidden_dims",
    "rl.runner.critic.hidden_dims=256": "rl.runner.critic.hidden_dims",
    "rl.runner.actor.activation=swoosh": "did you mean 'swish'?",
    "rl.runner.algorithm.schedule=foo": "'adaptive', 'fixed', got 'foo'",
    "rl.num_envs=64 rl.runner.algorithm.num_mini_batches=100000": "rl.runner.algorithm.num_mini_batches: expected at most 1536",
    "rl.runner.actor.distribution_cfg.std_range=[1.0,0.1]": "distribution_cfg.std_range",
    "rl.runner.algorithm=null": "rl.runner.algorithm: expected a table, got None",
    "rl.runner.actor.class_name=RNNModel": "a policy sees a history",
    "rl.runner.algorithm.class_name=Distillation": "train with PPO",
    "rl.runner.obs_groups.actor=[policy,privileged]": "give it to the critic alone",
    "+rl.runner.algorithm.rnd_cfg={weight:1}": "rl.runner.algorithm.rnd_cfg",
    "evaluation.episodes=1e12": "evaluation.episodes: expected a whole number from 1 to 1e+07",
    "evaluation.seed=-1": "evaluation.seed",
    "session.seed=1e30": "session.seed: expected a whole number from 0 to",
    "mode=check subject.model=/etc/hostname": "subject.model: /etc/hostname is no XML",
    "machine.mjcf=nowhere.xml": "there is no MJCF 'nowhere.xml'",
    "machine.tool_m=null": "machine 'brokk170' has no tool point",
    "effect=[lag] effect.lag.time_constant_s=-3": "effect.lag.time_constant_s: expected 0 to 2",
    "effect=[lag] effect.lag.joints=[q9]": "effect.lag.joints: 'q9' is no joint of machine",
    "effect.library.effects.saturation.level=[2,1]": "saturation.level: expected a range [low",
    "hydra.run.dir=/nowhere": "give session.out=<folder>",
    "task.episode_s=0.01": "task.episode_s: expected at least a control step",
    "task.episode_s=nan": "task.episode_s: expected a finite number above 0, got nan",
    "task.scene=nowhere.xml": "task.scene: expected an MJCF file, got nowhere.xml",
    "mode=evaluate policy=/etc/hostname": "expected a folder or a checkpoint",
    "task.hole.radius_m=0.03": "task.hole.radius_m: expected more than the chisel's 0.04 m",
    "task.termination.joint_limit.params.margin=wide": "params.margin of the termination term",
    "+task.reward.progress.params.scale=1": "expected none, got scale",
    "task.action.scale=0": "task.action.scale",
    "task.hole.distance_m=[3.5,2.3]": "task.hole.distance_m: expected (lowest, highest)",
    "task.noise.target_sample_m=-0.01": "task.noise.target_sample_m",
    "task.scaling.target_std_m=[0.5,0.0,0.1]": "task.scaling.target_std_m[1]",
    "task.classical.damping=0": "task.classical.damping",
    "task.reward.progress.weight=nan": "task.reward.progress.weight: expected a finite number",
    "task=goal_pose task.tolerance.strict_distance_m=0": "task.tolerance.strict_distance_m",
    "event=[mass] event.mass.factor=[1.2,0.8]": "factor",
    "sim=native sim.num_worlds=0": "sim.num_worlds: expected",
    "mode=evaluate task.episode_s=-5": "task.episode_s",
    "tracking=wandb tracking.mode=sideways": "tracking.mode: expected one of 'offline'",
    "mode=identify": "identify.recordings has no default and must be given",
    "mode=identify identify.recordings=x identify.folds=1": "identify.folds: expected",
    "mode=collect collect.num_runs=0": "collect.num_runs: expected",
    "mode=collect excitation.sine.share=[2.0,1.0]": "excitation.sine.share: expected a number",
    "mode=play play.gamepad=nowhere": "play.gamepad=nowhere: No such file",
    "mode=play play.gamepad=/dev/null play.gamepad_axes=[1]": "an axis for each of q1",
    "mode=play play.port=0": "port: expected a whole number from 1024 to 65535, got 0",
    "mode=bench bench.num_envs=[0]": "num_envs[0]: expected a whole number of 1 or more, got 0",
    "mode=diagnose": "give either case=<folder with reference/ and field/>, or field=<glob>",
    "mode=diagnose diagnosis.case=nowhere": "diagnosis.case=nowhere: there is no such folder",
    "mode=diagnose diagnosis.field=x diagnosis.workers=0": "diagnosis.workers: expected 1",
    "mode=check subject.model=nowhere.urdf": "subject.model: cannot read nowhere.urdf",
    "mode=check subject.num_starts=0": "subject.num_starts: expected",
    "mode=check subject.num_poses=1e12": "subject.num_poses: expected a whole number from 1 to 1e+07",
    "mode=export": "policy has no default and must be given",
    "mode=compare compare.runs=[1]": "compare.runs",
    "mode=inspect inspect.recordings=3": "inspect",
    "mode=render render.count=0": "render.count: expected",
}  # fmt: skip
"""Words of a command, and what its message must say."""


@pytest.fixture(scope="module")
def refusals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Refusal]:
    folder = tmp_path_factory.mktemp("values")
    found = refuse_all([tuple(words.split()) for words in BAD], folder)
    assert not list(folder.iterdir()), "a refused command leaves nothing behind"
    return dict(zip(BAD, found.values(), strict=True))


@pytest.mark.parametrize("words", BAD)
def test_a_bad_value_is_refused_by_name_before_torch_is_loaded(
    words: str, refusals: dict[str, Refusal]
) -> None:
    refusal = refusals[words]
    assert refusal.code == 2 and "Traceback" not in refusal.told
    assert BAD[words] in " ".join(refusal.told.split())
    assert not refusal.torch
