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
    "tabs.yaml": "_target_: brokk_rl.machine.Machine\n\tname: a\n",
    "foreign.yaml": "_target_: os.system\ncommand: ls\n",
    "notes.yaml": "to do: nothing\n",
    "list.yaml": "- 1\n- 2\n",
    "own/mode/broken.yaml": "# @package _global_\nname: [1, 2\n",
    "own/actuator/typo.yaml": "_target_: actuators.models.lag.FirstOrderLags\n",
    "own/actuator/lost.yaml": "_target_: nowhere.parts.Arm\n",
    "own/actuator/fails.yaml": "_target_: fails.Arm\n",
    "own/actuator/slip.yaml": "_target_: slip.Arm\n",
    "fails.py": "import math\nfrom math import squareroot\n",
    "old/model_10.pt": "cut off",
    "empty/notes.txt": "",
    "slip.py": "x = 1\ndef f(:\n",
}
"""Files in the folder from which the commands are started, by name."""
WRONG: dict[tuple[str, ...], tuple[str, ...]] = {
    # words
    ("evaluate",): ("brokk mode=evaluate",),
    ("mode", "=", "train"): ("without spaces", "mode=train"),
    ("mode = train",): ("'mode '", "without spaces"),
    ("--mode=train",): ("no dashes: mode=train",),
    ("--verbose",): ("there is no --verbose",),
    ("mode=train", "--cfg", "jobs"): ("there is no --cfg jobs", "'job'"),
    ("-m",): ("a sweep needs values", "session.seed=0,1,2"),
    ("mode=train", "mode=evaluate"): ("expected one mode",),
    ("-m", "session.seed=0,1", "session.out=arm.xml"): (
        "cannot use arm.xml",
        "session.out=<folder>",
    ),
    ("mode=train", "--help=rl"): ("--help takes no value",),
    ("-sc",): ("-sc install=bash",),
    ("arm.urdf",): ("brokk mode=check subject.model=arm.urdf",),
    ("mode=trian", "--help"): ("there is no mode=trian", "'train'"),
    ("mode=evaluate", "--cfg", "job", "task=tunnel"): ("there is no task=tunnel",),
    ("--config-dir", "nowhere", "mode=list"): ("nowhere",),
    # modes, groups, options
    ("mode=lst",): ("there is no mode=lst", "did you mean 'list'?", "doctor"),
    ("mode=",): ("has no value", "choices: "),
    ("mode=list,doctor",): ("several values", "brokk -m"),
    ("mode=list", "task=borehole_insertion"): ("'task'", "mode=list does not use"),
    ("mode=list", "list.group=actuatr"): ("did you mean 'actuator'?",),
    ("mode=list", "session.seed=1"): ("'mode=list' has no 'session'",),
    (*COMPARE, "session=other"): ("session.<name>=", "seed"),
    ("effect=backlash,lag",): ("a list: 'effect=[backlash,lag]'",),
    ("effect=[backlash,backlash]",): ("'backlash' stands in it twice",),
    ("policy=[shipped,classical]",): ("one option: policy=shipped;", "brokk -m"),
    ("mode=evaluate", "policy=shipped", "task=goal_pose"): ("was trained for task=",),
    ("tracking=wandb,",): ("Write tracking=wandb",),
    ("wandb=true",): ("tracking=wandb",),
    # keys
    ("mod=train",): ("did you mean 'mode'?",),
    ("MODE=train",): ("did you mean mode=train?",),
    ("rl/num_envs=3",): ("did you mean rl.num_envs=3?",),
    ("rl.num-envs=3",): ("as in rl.num_envs=3",),
    ("machine.joints[0].home=2",): ("as in machine.joints.0.home=2",),
    ("event.mass.factor=[1,2]",): ("add event=[mass]",),
    ("mode=evaluate", "policy=~/none"): (f"policy={Path.home()}/none",),
    ("hidden_dims=256",): ("rl.runner.actor.hidden_dims=256",),
    ("~rl.lr",): ("'rl' has no 'lr'", "rl.runner.algorithm.learning_rate"),
    ("+machine=brokk170",): ("without the '+'",),
    ("lr=1e-4",): ("rl.runner.algorithm.learning_rate=1e-4",),
    ("mode=import", "logs=x"): ("mode=import --help",),
    ("mode=inspect", "recording=x"): ("did you mean inspect.recordings=x?",),
    ("mode=play", "session.seed=3"): ("play.seed=3",),
    ("task..depth_m=3",): ("'task..depth_m'", "is no key"),
    ("policy=empty", "session.out=empty"): ("empty holds no policy",),
    ("mode=check", "subject.chain=[a,b]"): ("subject.model: expected the file of a robot",),
    ("mode=collect", "collect.run_minutes=-1"): ("collect.run_minutes", "above 0"),
    ("+foo=3",): ("the mode has no 'foo'", "rl"),
    ("~task",): ("the mode needs 'task'", "give task=<option>"),
    ("mode=play", "preset=gpu"): ("the mode has no", "leave it out"),
    ("effect=[backlash]", "effect.backlash.joints=[q9]"): ("joints: 'q9' is no joint",),
    (*COMPARE, "+session.sed=1"): ("no field 'sed'", "did you mean 'seed'?"),
    ("effect=[backlash]", "effect.backlash.width=1"): ("'effect.backlash' has no", "gap_rad"),
    ("mode=perceive", "perception/segmenter=onnx", "perception.segmenter.foo=1"): (
        "'perception.segmenter' has no 'foo'",
        "choices: gate, margin, threads, weights",
    ),
    # characters, quotes, shapes
    ("mode=list", "mode.x=["): ("do not match", """'mode.x="["'"""),
    ("mode=compare", "compare.runs=[a#b]"): ("#", """'compare.runs=["a#b"]'"""),
    ("mode=compare", "compare.runs=[${x}]"): ("compare.runs", "'x' not found", r"\${"),
    ("session.out=x/epoch=3,step=4",): ("= must be quoted", """'session.out="x/epoch=3,step=4"'"""),
    ("session.out=it's",): ("'", r"""'session.out="it'"'"'s"'"""),
    ("session.out=a,b",): ("""one text: 'session.out="a,b"'""",),
    ("session.out=[a]",): ("expected one folder",),
    ("session.seed=",): ("session.seed=<value>",),
    ("rl.runner.actor.hidden_dims=(64,64)",): ("'rl.runner.actor.hidden_dims=[64,64]'",),
    ("rl.runner.algorithm.learning_rate=1,5",): ("learning_rate=1.5",),
    ("-m", "mode=list", "list.group=range(a,b)"): ("list.group", "start: str"),
    ("-m", "mode=train", "session.seed=range(3,1)"): ("holds no value",),
    # files
    ("machine=@arm.xml",): ("brokk mode=check subject.model=arm.xml",),
    ("machine=bad.yaml",): ("machine=@bad.yaml",),
    ("machine=@bad.yaml",): ("machine=@bad.yaml: line 3: no valid YAML",),
    ("machine=@tabs.yaml",): ("line 2", "tab character"),
    ("machine=@foreign.yaml",): ("os.system' is no machine",),
    ("machine=@list.yaml",): ("expected a mapping",),
    ("task=@notes.yaml",): ("task=@notes.yaml: expected _target_: <class>",),
    ("machine=@nowhere.yaml",): ("there is no such file",),
    ("--config-dir", "own", "mode=broken"): ("broken.yaml", "line"),
    ("policy=a#b",): ("there is no policy=a#b", "or the path of a run"),
    ("policy=old",): ("old/model_10.pt is corrupt", "take an older one"),
    ("session.out=old",): ("old already holds a run", "session.out=<folder>"),
    COMPARE: ("compare.runs", "nowhere"),
    # values
    ("mode=compare",): ("compare.runs=<value>",),
    (*COMPARE, "session.seed=abc"): ("session.seed: expected a whole number", "'abc'"),
    (*COMPARE, "session.seed=-1"): ("session.seed", "from 0 to 1e+09"),
    ("mode=evaluate", "sim=native", "sim.num_worlds=1e12"): ("sim.num_worlds: expected", "1e+07"),
}
"""A command, and parts of its message."""
AFTER_TORCH = {
    ("mode=check", "subject=arm"): ("subject: expected a table with model, name",),
    ("--config-dir", "own", "actuator=typo"): ("has no 'FirstOrderLags'",),
    ("--config-dir", "own", "actuator=lost"): ("there is no module 'nowhere'", "PYTHONPATH"),
    ("--config-dir", "own", "actuator=fails"): ("fails.py, line 2", "squareroot"),
    ("--config-dir", "own", "actuator=slip"): ("slip.py, line 2", "SyntaxError"),
}
"""The same for what can be known only after the import of torch: a class of one's own, and values
of several parts."""


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
        assert part in refusal.told
    if words in WRONG:
        assert not refusal.torch


def test_the_traceback_comes_on_request(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BROKK_TRACE", "1")
    assert "Traceback" in brokk("mode=lst").err


def test_tab_completes_options(brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMP_LINE", "brokk mode=ide")
    monkeypatch.setenv("COMP_POINT", "14")
    assert "mode=identify" in brokk("-sc", "query=bash").out


def test_windows_is_refused_with_the_way_that_works(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "win32")
    done = brokk("mode=list")
    assert done.code == 2 and "WSL 2" in done.err
