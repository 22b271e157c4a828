"""`study.do=run`: the loop with the study's room beside it, on the machine or with a twin."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.page.settings import PageSettings
from deploy.runtime.supervisor import CompanionProcess, DeploymentLoop
from deploy.runtime.target import FileTarget
from deploy.twin.bench import TwinBench
from study import study_folder as folders
from study.conductor import Words
from study.study_server import StudyServerConfig
from study.trial import Times

LOCK, TARGET = ".sitting", "target.json"
"""FileTarget in the study's folder that one program at a time holds; file in the run folder that
says to the loop where the hole is."""


@spec
class Consent:
    """Consent text for participants; a lab replaces it with its own.

    Attributes:
        version: Kept with each consent.
        text: Paragraphs by language, `en` and `de`.
    """

    version: str
    text: dict[str, tuple[str, ...]]

    def check(self) -> None:
        if missing := {"en", "de"} - set(self.text):
            raise ConfigError(
                f"study.sitting.consent.text: no text in {', '.join(sorted(missing))}"
            )


@spec
class Sitting:
    """Settings of a sitting.

    Attributes:
        loop: The loop on the machine's computer; listens, shows, records.
        bench: The twin in place of the machine; `null` on a
            machine.
        page: The operator's page.
        consent: Text of the consent.
        times: How a trial begins and ends.
    """

    loop: DeploymentLoop
    bench: TwinBench | None
    page: PageSettings
    consent: Consent
    times: Times

    def check(self) -> None:
        if self.loop.commands:
            raise ConfigError(
                "study.do=run: in a study people move the machine; deploy=listen, not deploy=auto"
            )
        if self.bench is not None and self.bench.operator is not None:
            raise ConfigError(
                "study.do=run: that operator follows advice that is not shown; bench=twin"
            )

    def run(
        self, machine: Machine, session: Session, folder: Path, participant: str | None
    ) -> None:
        """Lead sittings until a person stops the program.

        Raises:
            ConfigError: the folder holds no study of this machine, the plan has no such
                participant, or another program leads sittings of this study.
        """
        data = folders.read_study(folder)
        machine.check_fingerprint(data.plan["fingerprint"], f"the study in {folder}")
        there = []
        for who in data.plan["participants"]:
            if who not in data.plan.get("erased", {}):
                there.append(who)
        if participant is not None and participant not in there:
            raise ConfigError(
                f"study.participant={participant}: nobody of the plan; {list_choices(participant, there)}"
            )
        target = session.folder / TARGET
        loop = replace(
            self.loop, page=None, video=None, record=False, target=FileTarget(path=str(target))
        )
        room = StudyServerConfig(
            page=loop.build_page_config(self.page, machine, session),
            folder=folder.resolve(),
            participant=participant,
            words=Words(self.consent.version, self.consent.text),
            times=self.times,
            facts={"simulated": False, "twin": self.bench is not None, "run": session.folder.name},
            target=target,
            port=self.bench.twin.fault_port if self.bench else None,
        )  # fmt: skip
        beside = self.bench.companions(machine, session) if self.bench else []
        with reserve_study(folder):
            loop.run(
                machine,
                session,
                [*beside, CompanionProcess("study", "study.study_server:run", (room,), None)],
            )


@contextmanager
def reserve_study(folder: Path) -> Iterator[None]:
    """Keep others from leading sittings of the same study, as long as this process lives."""
    with (folder / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                f"{folder}: sittings of this study go on already, in another program; end that one first"
            ) from error
        yield
