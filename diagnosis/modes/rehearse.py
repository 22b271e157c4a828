"""`brokk mode=rehearse`: a story of several modes in one command, on a machine with effects that nobody is told of."""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from brokk_rl.contracts.actuator import Effect
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import BrokkError, ConfigError, list_choices
from brokk_rl.modes.evaluate import Evaluation
from brokk_rl.rl.runner import TrainingConfig
from brokk_rl.session import RESOLVED, Session, read_record, write_text
from brokk_rl.spec import spec
from diagnosis import story_page

log = logging.getLogger(__name__)

GIVEN = "given"
"""Folder with what the stages take from the story."""
HANDED_ON = ("sim", "task", "rl", "evaluation")
"""Groups that a stage can take from the story."""
FOLDER = "{folder}"


@spec
class Stage:
    """One command of a story; its run folder is `<story>/<name of the stage>`.

    Attributes:
        title: What it is for, in words.
        command: Arguments of `brokk`; `{folder}` stands for the run folder of the story.
        takes: Groups (`sim`, `task`, `rl`, `evaluation`) and `device` that it takes from the story.
        links: Links made before it, both ends below the run folder: where, and to what.
        needs: A file below the run folder without whose content the story ends before this stage;
            `null`: nothing.
        resumes: Whether an interrupted one goes on with `resume=`; otherwise it begins anew.
    """

    title: str
    command: tuple[str, ...]
    takes: tuple[str, ...]
    links: dict[str, str]
    needs: str | None
    resumes: bool

    def check(self) -> None:
        for name in self.takes:
            if name not in (*HANDED_ON, "device"):
                raise ConfigError(
                    f"a stage takes '{name}', which the story does not have; {list_choices(name, (*HANDED_ON, 'device'))}"
                )


@spec
class Rehearse:
    """Rehearses a story: runs modes one after the other, each in a folder of its own, and tells at the end what came of it.

    Attributes:
        session: Folder, seed, device.
        sim: Physics of the stages.
        task: Task of the stages.
        rl: How stages train.
        evaluation: How stages evaluate.
        withheld: Effects that the machine has and that no stage but it is told of:
            `<folder>/given/withheld.yaml`.
        stages: The story, in order.
        resume: Run folder of an interrupted story; finished stages are kept. The same as
            `session.out`.
    """

    session: Session
    sim: Simulator
    task: Task
    rl: TrainingConfig
    evaluation: Evaluation
    withheld: dict[str, Effect]
    stages: dict[str, Stage]
    resume: str | None

    def check(self) -> None:
        if not self.stages:
            raise ConfigError(
                "mode=rehearse has no story of its own; give one, as in experiment=gap_loop"
            )
        if self.resume is not None and Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: a story goes on in its folder; add session.out={self.resume}"
            )

    def run(self) -> None:
        """Runs the stages that are not finished; writes `story.html` after each of them.

        Raises:
            BrokkError: a stage failed; the story goes on from there with `resume=`.
        """
        folder = self.session.folder.resolve()
        given = self._hand_on(folder)
        told = {name: stage.title for name, stage in self.stages.items()}
        for number, (name, stage) in enumerate(self.stages.items(), 1):
            if stage.needs is not None and not _holds_something(folder / stage.needs):
                log.warning("the story ends before '%s': %s holds nothing", name, stage.needs)
                break
            if (read_record(folder / name) or {}).get("outcome") == "finished":
                log.info("%d of %d, %s: done already", number, len(self.stages), name)
                continue
            log.info("%d of %d, %s: %s", number, len(self.stages), name, stage.title)
            self._play(name, stage, folder, given)
            story_page.write(folder, told, given["withheld"])
        story_page.write(folder, told, given["withheld"])
        Console().print(f"story: {self.session.folder / story_page.PAGE}", highlight=False)

    def _hand_on(self, folder: Path) -> dict[str, Any]:
        """Writes what stages take from the story, as it was composed, into files that `group=@<file>` takes; returns it."""
        composed = yaml.safe_load((folder / RESOLVED).read_text())
        given = {name: composed[name] for name in (*HANDED_ON, "withheld")}
        (folder / GIVEN).mkdir(exist_ok=True)
        for name, node in given.items():
            head = "# @package effect\n" if name == "withheld" else ""
            write_text(
                folder / GIVEN / f"{name}.yaml", head + yaml.safe_dump(node, sort_keys=False)
            )
        return given

    def _play(self, name: str, stage: Stage, folder: Path, given: dict[str, Any]) -> None:
        """Runs one stage in a process of its own, as a person would, and waits for it."""
        place = folder / name
        for link, target in stage.links.items():
            path = folder / link
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            path.symlink_to(folder / target)
        words = [word.replace(FOLDER, str(folder)) for word in stage.command]
        words += [
            f"{group}=@{folder / GIVEN / group}.yaml" for group in stage.takes if group != "device"
        ]
        words += [f"session.device={self.session.device}"] if "device" in stage.takes else []
        words += [f"session.out={place}"]
        if place.exists():
            if stage.resumes:
                words += [f"resume={place}"]
            else:
                shutil.rmtree(place)  # half of it: what is not finished has no record that says so
        with subprocess.Popen([sys.executable, "-P", "-m", "brokk_rl", *words]) as process:
            try:
                code = process.wait()
            except BaseException:
                process.terminate()
                raise
        if code:
            raise BrokkError(
                f"the stage '{name}' failed, see above; what came before it is kept: go on with resume={self.session.out} "
                f"session.out={self.session.out}"
            )


def _holds_something(path: Path) -> bool:
    """Says whether a YAML file holds anything but comments."""
    return path.is_file() and bool(yaml.safe_load(path.read_text()))
