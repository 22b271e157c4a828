"""Stages of a story: modes that run one after another, each in a process and a run folder of its own."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from brokk_rl.errors import BrokkError, ConfigError, list_choices
from brokk_rl.session import RESOLVED, Session, write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

HANDED_ON_FOLDER = "given"
"""Folder with the files that stages take from the story."""
FOLDER_PLACEHOLDER = "{folder}"
EVALUATION = "evaluation"
"""A node that is no group: a stage takes its values one by one."""


@spec
class StoryStage:
    """One command of a story; its run folder is `<story>/<name of the stage>`.

    Attributes:
        title: Its purpose in words.
        command: Arguments of `brokk`; `{folder}` stands for the run folder of the story.
        takes: Groups and `evaluation` that it takes from the story.
        links: Links made before it, both ends below the run folder: path and target.
        needs: A file below the run folder without whose content the story ends before this stage;
            `null`: nothing.
    """

    title: str
    command: tuple[str, ...]
    takes: tuple[str, ...]
    links: dict[str, str]
    needs: str | None


def check_stages(stages: Mapping[str, StoryStage], groups: Sequence[str]) -> None:
    """Refuse stages that take another group than the story has, one of `groups`."""
    for stage in stages.values():
        for name in stage.takes:
            if name not in groups:
                raise ConfigError(
                    f"a stage takes '{name}', which the story does not have; {list_choices(name, groups)}"
                )


def write_groups(
    folder: Path, groups: Sequence[str], heads: Mapping[str, str] | None = None
) -> None:
    """Write composed groups of a story as files for `group=@<file>`.

    Args:
        folder: Run folder of the story.
        groups: Names of the groups.
        heads: First line of a group's file.

    Raises:
        StorageError: a file could not be written.
    """
    composed = yaml.safe_load((folder / RESOLVED).read_text())
    for name in groups:
        text = (heads or {}).get(name, "") + yaml.safe_dump(composed[name], sort_keys=False)
        write_text(folder / HANDED_ON_FOLDER / f"{name}.yaml", text)


def run_story(session: Session, stages: Mapping[str, StoryStage]) -> None:
    """Run the stages one after another, in the folder of the session.

    Raises:
        BrokkError: a stage failed.
    """
    folder = session.folder.resolve()
    for number, (name, stage) in enumerate(stages.items(), 1):
        if stage.needs is not None and not _has_content(folder / stage.needs):
            log.warning("the story ends before '%s': %s holds nothing", name, stage.needs)
            break
        log.info("%d of %d, %s: %s", number, len(stages), name, stage.title)
        _play_stage(session, name, stage, folder)


def _play_stage(session: Session, name: str, stage: StoryStage, folder: Path) -> None:
    """Run one stage as a separate command, and wait for its end."""
    for link, target in stage.links.items():
        path = folder / link
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(folder / target)
    words = [word.replace(FOLDER_PLACEHOLDER, str(folder)) for word in stage.command]
    for taken in stage.takes:
        given = folder / HANDED_ON_FOLDER / f"{taken}.yaml"
        if taken == EVALUATION:
            values = yaml.safe_load(given.read_text())
            del values["_target_"]
            words += [f"{taken}.{key}={json.dumps(one)}" for key, one in values.items()]
        else:
            words.append(f"{taken}=@{given}")
    words.append(f"session.out={folder / name}")
    # The command sets this for Hydra; a stage that inherited it would print a traceback of user errors.
    env = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    with subprocess.Popen([sys.executable, "-P", "-m", "brokk_rl", *words], env=env) as process:
        try:
            code = process.wait()
        except BaseException:
            process.terminate()
            raise
    if code:
        raise BrokkError(
            f"the stage '{name}' failed, see above; {folder} keeps what came before it"
        )


def _has_content(path: Path) -> bool:
    """Return whether a YAML file holds anything but comments."""
    return path.is_file() and bool(yaml.safe_load(path.read_text()))
