"""Every `brokk …` command of the pages composes as typed, with values that its specs accept."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from packages import EXAMPLE, install_example

from brokk_rl import cli, extensions, registry
from brokk_rl.build import build_quick_nodes
from brokk_rl.errors import RecordingError

ROOT = Path(__file__).parents[2]
NEWCOMERS = (ROOT / "README.md", *ROOT.glob("docs/tutorials/*.md"))
"""Pages whose commands are checked in every run of the tests; those of the others are slow."""
OTHERS = (ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/tutorials/*.ipynb"))
BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.M | re.S)
INLINE = re.compile(r"`((?:\.venv/bin/)?brokk [^`]+)`")
NOT_COMPOSED = {
    "session.seed=<random, 1000 or more>": "a rule for a number instead of one",
    "-sc install=": "completion of a shell composes nothing",
    " $R ": "words that stand once, above several commands",
    "group=option": "any group",
    "hydra/launcher=": "Hydra warns of the launcher's schema; brokk silences that",
    "search=": "its sweeper comes with the extra `optuna`",
}
"""Parts of commands that stand for something that does not compose, and the reason."""
WITHOUT_VALUES = {
    "mode=identify fit=valve …": "the values before the dots stand in the line above it",
    "diagnosis.case=": "the folder is the reader's",
    "subject.model=arm.urdf": "the file is the reader's",
    '"$': "a variable of the shell holds a value that must be given",
}
"""Parts of commands that leave out such values: groups and fields are checked alone."""


def find_commands(page: Path) -> Iterator[tuple[str, bool]]:
    """Yields each command of a page, and whether it stands in a block, whole and to be typed."""
    text = page.read_text()
    if page.suffix == ".ipynb":
        cells = ["".join(cell["source"]) for cell in json.loads(text)["cells"]]
        for cell in cells:
            for command in re.findall(r"^!(brokk .*)", cell.replace("\\\n", " "), re.M):
                yield re.split(r" 2>", command)[0], True
        text = "\n".join(cells)
    for block in BLOCK.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            found = re.search(r"(?:^|[ /])(brokk(?: .*)?)$", re.sub(r"(^|\s)#.*", "", line).strip())
            if found:
                yield found[1], True
    for command in INLINE.findall(BLOCK.sub("", text)):
        yield command.removeprefix(".venv/bin/"), False


def read_arguments(command: str) -> list[str]:
    """Returns the arguments with a value in the place of each placeholder."""
    text = re.split(r" [|;&]", command)[0].replace("…", "")
    text = re.sub(r"<([\w, ]+)[|.][^>]*>", r"\1", text)  # <mlp|ideal>, <1..5>
    text = re.sub(r"<([^>]+)>", lambda found: re.sub(r"\W", "_", found[1]), text)
    text = re.sub(r"\"\$\w+\"|\$\{(\w+)[^}]*\}|\$(\w+)", r"\1\2", text)
    found = []
    for word in shlex.split(text)[1:]:
        found.append(word[1:-1] if word.startswith("[") else word)  # [session.seed=1]: if you like
    return found


def list_jobs(arguments: list[str]) -> list[list[str]]:
    """Returns the overrides of a command; of a sweep those of the first and the last job."""
    words = [word for word in arguments if not word.startswith("-")]
    write_option_files(words)
    extensions.register_options(words)
    known = {f"{one.group}={one.name}" for one in registry.list_options()}
    # As the command does: a group without an option `none` is left out by it.
    words = [w if w in known else re.sub(r"^(\w+)=none$", r"~\1", w) for w in words]
    first, last = [], []
    for override in OverridesParser.create().parse_overrides(words):
        line = str(override.input_line)
        values = [line.partition("=")[2]]
        if override.is_sweep_override():
            values = list(override.sweep_string_iterator())
        name, equals, _ = line.partition("=")
        first.append(f"{name}{equals}{values[0]}")
        last.append(f"{name}{equals}{values[-1]}")
    return [first] if first == last else [first, last]


def explain_fault(overrides: list[str], whole: bool) -> str | None:
    """Returns why a command does not compose, `None` if it does."""
    # a policy's folder is there only after a run
    chosen = [
        re.sub(r"^(\+?policy(@[\w.]+)?)=(?!(classical|shipped|trained)$).*", r"\1=trained", line)
        for line in overrides
    ]
    try:
        cfg = hydra.compose("config", overrides=chosen)
        if whole:
            cfg = OmegaConf.merge(cfg, {"session": {"out": "folder"}}) if "session" in cfg else cfg
            build_quick_nodes(*extensions.read_values(cfg))
    except RecordingError:  # recordings are there only after a run
        return None
    except Exception as error:
        told = cli.explain(error) or repr(error)
        return told if whole or "must be given" not in told else None
    return None


def find_faults(pages: Sequence[Path]) -> list[str]:
    """Returns the commands of these pages that do not compose, with the message."""
    faults = {}
    for command, in_block in dict.fromkeys(
        found for page in pages for found in find_commands(page)
    ):
        if any(part in command for part in NOT_COMPOSED):
            continue
        whole = in_block and not any(part in command for part in WITHOUT_VALUES)
        for job in list_jobs(read_arguments(command)):
            key = (*sorted(job), whole)
            if key not in faults:
                faults[key] = (command, explain_fault(job, whole))
    return [f"{command}\n    {fault}" for command, fault in faults.values() if fault]


def write_option_files(overrides: list[str]) -> None:
    """Puts a shipped option in the place of each file that a command names by `group=@<file>`."""
    for override in overrides:
        group, _, value = override.partition("=")
        for name in re.findall(r"@([\w./]+\.yaml)", value):
            options = [one for one in registry.list_options() if one.group == group.split("@")[0]]
            same = [one for one in options if one.name == Path(name).stem]
            path = Path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text((same or options)[0].path.read_text())


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A working directory that holds `examples/my_package` as `mine`, installed."""
    site, projects = (tmp_path_factory.mktemp(name) for name in ("site", "projects"))
    shutil.copytree(EXAMPLE.parent, projects / "mine")
    made = {"conf/machine/arm.yaml": (EXAMPLE / "conf/machine/my_arm.yaml").read_text()}
    with pytest.MonkeyPatch.context() as patch:
        install_example(site, patch, **made)  # the tutorial makes a machine
        patch.chdir(projects)
        with hydra.initialize_config_module("conf", version_base="1.3"):
            yield


def test_commands_for_newcomers_compose(desk: None) -> None:
    assert not find_faults(NEWCOMERS)


@pytest.mark.slow
def test_commands_of_the_other_pages_compose(desk: None) -> None:
    assert not find_faults(OTHERS)


def test_a_fault_of_one_command_is_named(tmp_path: Path, desk: None) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```\nbrokk mode=list\nbrokk mode=list list.group=task\nbrokk mode=list list.gruop=task\n```\n"
    )
    (fault,) = find_faults([page])
    assert fault.startswith("brokk mode=list list.gruop=task\n")
