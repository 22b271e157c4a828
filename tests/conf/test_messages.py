"""Wrong commands of a newcomer: each ends with 2, says what to write, and leaves nothing behind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from invoked import Refusal, refuse_all

COMPARE = ("mode=compare", "compare.runs=nowhere")
FILES = {
    "arm.urdf": "<robot name='a'><link name='b'/></robot>",
    "arm.xml": "<mujoco/>",
    "bad.yaml": "_target_: brokk_rl.machine.Machine\nname: [1, 2\nfoo: 3\n",
    "notes.yaml": "to do: nothing\n",
    "own/mode/broken.yaml": "# @package _global_\nname: [1, 2\n",
    "own/actuator/typo.yaml": "_target_: actuators.models.lag.FirstOrderLags\n",
    "own/actuator/lost.yaml": "_target_: nowhere.parts.Arm\n",
    "own/actuator/fails.yaml": "_target_: fails.Arm\n",
    "own/actuator/slip.yaml": "_target_: slip.Arm\n",
    "fails.py": "import math\nfrom math import squareroot\n",
    "old/resolved.yaml": "run: brokk_rl.modes.list.ListOptions\nlist: {group: null}\n",
    "empty/notes.txt": "",
    "other/evaluation.json": "[1]",
    "other/session.json": "{}",
    "slip.py": "x = 1\ndef f(:\n",
}
"""Files in the folder from which the commands are started, by name."""
WRONG: dict[tuple[str, ...], tuple[str, ...]] = {
    # words
    ("evaluate",): ("did you mean mode=evaluate?",),
    ("mode", "=", "train"): ("without spaces", "'mode'"),
    ("--mode=train",): ("--mode=train", "values have no dashes"),
    ("mode=train", "--package", "rl"): ("--package", "--cfg job"),
    ("-m", "session.seed=0,1", "session.out=arm.xml"): (
        "cannot use arm.xml",
        "session.out=<folder>",
    ),
    ("mode=train", "mode=evaluate"): ("expected one mode",),
    ("-m", "mode=train", "session.seed=range(3,1)"): ("holds no value",),
    ("-sc",): ("-sc install=bash",),
    ("arm.urdf",): ("brokk mode=check subject.model=arm.urdf",),
    ("mode=trian", "--help"): ("there is no mode=trian", "'train'"),
    ("mode=evaluate", "--cfg", "job", "task=tunnel"): ("there is no task=tunnel",),
    ("--config-dir", "nowhere", "mode=list"): ("nowhere",),
    # modes, groups, options
    ("mode=lst",): ("there is no mode=lst", "did you mean 'list'?", "doctor"),
    ("mode=",): ("has no value",),
    ("mode=list", "task=borehole_insertion"): ("'mode=list' has no 'task'",),
    ("mode=list", "list.group=actuatr"): ("did you mean 'actuator'?",),
    (*COMPARE, "session=other"): ("session.<name>=", "seed"),
    ("policy=",): ("has no value",),
    ("policy=[shipped,classical]",): ("expected one option, as in policy=shipped",),
    ("effect=backlash,lag",): ("use key=[value1,value2]",),
    ("effect=[backlash,lag,backlash]",): ("the list names 'backlash' twice", "name it once"),
    ("mode=evaluate", "task.action={kind: residual}"): ("task.action.kind=residual was asked for",),
    ("tracking=wandb,",): ("cannot be read", """'tracking="wandb,"'"""),
    ("wandb=true",): ("tracking=wandb",),
    # keys
    ("mod=train",): ("did you mean 'mode'?",),
    ("MODE=train",): ("did you mean mode?",),
    ("rl/num_envs=3",): ("did you mean rl.num_envs?",),
    ("rl.num-envs=3",): ("did you mean 'num_envs'?",),
    ("machine.joints[0].home=2",): ("is no key", "machine.joints.0.home=2"),
    ("event.mass.factor=[1,2]",): ("add event=[mass]",),
    ("mode=evaluate", "policy=~/none"): (f"policy={Path.home()}/none",),
    ("hidden_dims=256",): ("rl.runner.actor.hidden_dims",),
    ("~rl.lr",): ("'rl' has no 'lr'", "rl.runner.algorithm.learning_rate"),
    ("+machine=brokk170",): ("without the '+'",),
    ("lr=1e-4",): ("rl.runner.algorithm.learning_rate",),
    ("mode=import", "logs=x"): ("mode=import --help",),
    ("mode=inspect", "recording=x"): ("did you mean inspect.recordings?",),
    ("mode=play", "session.seed=3"): ("play.seed",),
    ("task..depth_m=3",): ("'task..depth_m'", "is no key"),
    ("policy=empty", "session.out=empty"): ("empty holds no policy",),
    ("mode=check", "subject.chain=[a,b]"): ("subject.model: expected the file of a robot",),
    ("effect=[backlash]", "effect.backlash.width=1"): ("'effect.backlash' has no", "gap_rad"),
    ("mode=perceive", "perception/segmenter=onnx", "perception.segmenter.foo=1"): (
        "'perception.segmenter' has no 'foo'",
        "choices: gate, margin, threads, weights",
    ),
    # characters, quotes, shapes
    ("mode=list", "mode.x=["): ("do not match", """'mode.x="["'"""),
    ("mode=compare", "compare.runs=[a#b]"): ("must be quoted",),
    ("mode=compare", "compare.runs=[${x}]"): ("compare.runs", "'x' not found", r"\${"),
    ("session.out=x/epoch=3,step=4",): ("must be quoted", """'session.out="x/epoch=3,step=4"'"""),
    ("session.out=it's",): ("'", r"""'session.out="it'"'"'s"'"""),
    ("session.out=a,b",): ("Ambiguous value", "quote the value"),
    ("session.out=[a]",): ("expected one folder",),
    ("-m", "mode=list", "list.group=range(a,b)"): ("list.group", "other arguments"),
    # files
    ("machine=@arm.xml",): ("brokk mode=check subject.model=arm.xml",),
    ("machine=bad.yaml",): ("a file is given by its path after @", "machine=@bad.yaml"),
    ("mode=compare", "compare.runs=other"): ("other/evaluation.json cannot be read",),
    ("session.out=other",): ("other already holds a run",),
    ("machine=@bad.yaml",): ("machine=@bad.yaml: no plain YAML", "line 3"),
    ("task=@notes.yaml",): ("task=@notes.yaml: expected _target_: <class>",),
    ("--config-dir", "own", "mode=broken"): ("broken.yaml", "line"),
    ("policy=a#b",): ("there is no policy=a#b", "or the path of a run"),
    ("session.out=/proc/x/y",): ("cannot write into /proc/x/y", "session.out=<folder>"),
    ("--config-dir", "old", "--config-name", "resolved", "mode=train"): (
        "'mode': a configuration given by --config-name",
    ),
    COMPARE: ("compare.runs", "nowhere"),
    # values
    ("mode=compare",): ("compare.runs=<value>",),
    (*COMPARE, "session.seed=abc"): ("session.seed: expected a valid integer", "'abc'"),
    ("mode=evaluate", "sim=native", "sim.num_worlds=1e12"): (
        "sim.num_worlds: expected",
        "10000000",
    ),
}
"""A command, and parts of its message."""
VALUES = {
    "rl.runner.algorithm.learning_rate=-1e-3": "rl.runner.algorithm.learning_rate: expected a number greater than 0, got -0.001",
    "rl.runner.actor.activation=swoosh": "did you mean 'swish'?",
    "rl.num_envs=64 rl.runner.algorithm.num_mini_batches=100000": "rl.runner.algorithm.num_mini_batches: expected at most 1536",
    "rl.runner.actor.distribution_cfg.std_range=[1.0,0.1]": "distribution_cfg.std_range",
    "rl.runner.algorithm=null": "rl.runner.algorithm: expected a table, got None",
    "rl.runner.actor.class_name=RNNModel": "a policy is a feed-forward network",
    "rl.runner.algorithm.class_name=Distillation": "trained with PPO",
    "rl.runner.obs_groups.actor=[policy,privileged]": "give it to the critic alone",
    "+rl.runner.algorithm.rnd_cfg={weight:1}": "rl.runner.algorithm.rnd_cfg",
    "mode=check subject.model=/etc/hostname": "subject.model: /etc/hostname is no XML",
    "machine.mjcf=nowhere.xml": "there is no MJCF 'nowhere.xml'",
    "machine.tool_m=null": "machine 'brokk170' has no tool point",
    "effect=[lag] effect.lag.time_constant_s=-3": "effect.lag.time_constant_s: expected 0 to 2",
    "hydra.run.dir=/nowhere": "give session.out=<folder>",
    "task.episode_s=0.01": "task.episode_s: expected at least a control step",
    "mode=evaluate policy=/etc/hostname": "expected a folder or a checkpoint",
    "task.hole.radius_m=0.03": "task.hole.radius_m: expected more than the chisel's 0.04 m",
    "task.termination.joint_limit.params.margin=wide": "params.margin of the termination term",
    "mode=play play.device=tpu": "play.device: expected '^(auto|cpu|cuda",
    "mode=diagnose": "give either case=<folder with reference/ and field/>, or field=<glob>",
    "mode=diagnose diagnosis.case=nowhere": "diagnosis.case=nowhere: there is no such folder",
    "mode=export": "policy has no default and must be given",
    "mode=why log=x policy=classical": "policy_path: expected policy=… with a value 'path', but policy=classical has none",
    "mode=evaluate policy.folder=runs/x": "'policy' has no 'folder'",
    "policy@rivals.b=classical": "add it by a plus: +policy@rivals.b=<option>",
    "policy=shipped task.depth_m=0.1": "task.depth_m=0.1 was asked for, the policy has 0.14",
    "mode=evaluate task=goal_pose": "for task=borehole_insertion, but task=goal_pose was asked for",
    "mode=collect excitation=[levels,hold]": "there is no excitation=hold",
    "mode=collect collect.guards.max_command=2": "max_command: expected a number less than or equal to 1, got 2",
    "mode=study study.do=simulate": "needs simulated operators; ground=twin",
    "mode=study study.do=run": "needs study.folder=<folder>",
    "mode=study study.do=erase study.folder=there": "needs study.participant=<participant>",
    "mode=study study.do=plan study.design.primary=time": "did you mean 'time_s'",
    "mode=study study.do=report study.folder=nowhere": "holds no study",
    "mode=train machine=@/dev/zero": "expected a plain file",
}  # fmt: skip
"""Words of a command whose number or word nothing can use, and a part of its message."""
WRONG |= {tuple(words.split()): (told,) for words, told in VALUES.items()}
AFTER_TORCH = {
    ("+foo=3",): ("the mode has no 'foo'", "rl"),
    ("~task",): ("no task was given",),
    ("mode=play", "preset=gpu"): ("the mode has no", "leave it out"),
    ("mode=export", "policy=shipped", "session.out=x"): ("the folder holds no checkpoint",),
    ("mode=train", "policy=classical"): ("instance of TrainedPolicy",),
    ("mode=evaluate", "rivals.classical=none"): ("rivals.classical: expected an option",),
    ("mode=check", "subject=arm"): ("subject: expected a table or an instance of CheckSubject",),
    ("--config-dir", "own", "actuator=typo"): ("no attribute 'FirstOrderLags'",),
    ("--config-dir", "own", "actuator=lost"): ("No module named 'nowhere'", "PYTHONPATH"),
    ("--config-dir", "own", "actuator=fails"): ("fails.py, line 2", "squareroot"),
    ("--config-dir", "own", "actuator=slip"): ("slip.py, line 2", "SyntaxError"),
}
"""The same for what can be known only after the import of torch: a class of one's own, and values
of several parts."""
LATE_VALUES = {
    "mode=collect excitation=[holds,ramps] collect.run_minutes=0.2 collect.file_minutes=0.2": "excitation=holds",
    "preset=bench bench=twin deploy.policy=nowhere": "policy nowhere: policy.json is missing",
    "preset=bench camera=pictures perception/source@source=folder source.folder=nowhere": "nowhere: no such folder); give a folder",
    "mode=train_perception training.frames=empty": "mode=render",
    "mode=train_perception training.frames=x training.size_px=[100,48]": "multiples of 32",
    "mode=why log=nowhere/*.parquet policy=tasks:policies/borehole_insertion": "no recording matches nowhere",
    "mode=why log=nowhere/*.parquet policy=nowhere/x": "nowhere/x: expected a run folder",
    "mode=why log=x policy=tasks:policies/borehole_insertion simulator=mlpp": "did you mean 'mlp'?",
    "mode=why log=x policy=tasks:policies/borehole_insertion simulator=nowhere.xml": "there is no such file",
}  # fmt: skip
"""As `VALUES`, after the import of torch."""
AFTER_TORCH |= {tuple(words.split()): (told,) for words, told in LATE_VALUES.items()}


@pytest.fixture(scope="module")
def refusals(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, ...], Refusal]:
    desk = tmp_path_factory.mktemp("desk")
    for name, text in FILES.items():
        (desk / name).parent.mkdir(parents=True, exist_ok=True)
        (desk / name).write_text(text)
    before = sorted(desk.iterdir())
    found = refuse_all([*WRONG, *AFTER_TORCH], desk)
    assert sorted(desk.iterdir()) == before, "a refused command leaves nothing behind"
    return found


@pytest.mark.parametrize("words", [*WRONG, *AFTER_TORCH], ids=" ".join)
def test_the_message_says_what_to_write(
    words: tuple[str, ...], refusals: dict[tuple[str, ...], Refusal]
) -> None:
    refusal = refusals[words]
    assert refusal.code == 2
    assert sum(line.startswith("error: ") for line in refusal.told.splitlines()) == 1
    assert "Traceback" not in refusal.told
    for part in (WRONG | AFTER_TORCH)[words]:
        assert part in " ".join(refusal.told.split())
    assert words in AFTER_TORCH or not refusal.torch


def test_the_traceback_comes_on_request(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BROKK_TRACE", "1")
    assert "Traceback" in brokk("mode=lst", code=2).err


def test_tab_completes_options(brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMP_LINE", "brokk mode=ide")
    monkeypatch.setenv("COMP_POINT", "14")
    assert "mode=identify" in brokk("-sc", "query=bash").out


def test_windows_is_refused_with_the_way_that_works(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "win32")
    done = brokk("mode=list", code=2)
    assert done.code == 2 and "WSL 2" in done.err
