"""`brokk mode=doctor_policy`: whether code, actuator or task makes a policy fail on the machine."""

from __future__ import annotations

import logging
from pathlib import Path

from brokk_rl import record
from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Actuator, Effect
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from diagnosis.deployment import page
from diagnosis.deployment.contract import load_policy
from diagnosis.deployment.examination import ANSWER_FILE, Deployment, DoctorAnswer

log = logging.getLogger(__name__)


@spec
class DoctorRequest:
    """Logs and policy to examine.

    Attributes:
        log: Glob or globs of recordings of the policy's run.
        policy: Folder of the policy, `package:path`, or an ONNX file beside its contract.
        others: Folders of policies that may have run instead.
        target_in_base_m: Target where the log has no `target_x_m`; `null`: none is known.
        sent: The commands of the log are those that the policy's loop sent; `false` where a person
            moves the levers.
    """

    log: str | tuple[str, ...]
    policy: str
    others: tuple[str, ...]
    target_in_base_m: tuple[float, float, float] | None
    sent: bool


@spec
class DoctorPolicy:
    """Examine a deployed policy by the log of its run.

    Attributes:
        session: Folder and seed.
        machine: The machine.
        actuator: Actuator of the simulator that trained the policy; `null`: motion is not judged.
        effect: Effects that the training draws, by name.
        doctor: Logs and policy.
    """

    session: Session
    machine: Machine
    actuator: Actuator | None
    effect: dict[str, Effect]
    doctor: DoctorRequest

    def run(self) -> None:
        """Write `doctor.json` and `doctor.html`.

        Raises:
            RecordingError: A log cannot be used.
            CheckpointError: A policy cannot be used.
            StorageError: Something could not be written.
        """
        asked = self.doctor
        policy = load_policy(asked.policy, self.machine)
        others = {folder: load_policy(folder, self.machine) for folder in asked.others}
        deployment = Deployment(policy, self.machine, others, asked.target_in_base_m, asked.sent)
        recordings = record.read_recordings(asked.log, self.machine)
        seed = self.session.stream("doctor")
        found = deployment.examine(recordings, self.actuator, self.effect, seed)
        folder = self.session.folder
        found.write(folder)
        page.write_page(found, folder)
        print_answer(found, folder)


def print_answer(found: DoctorAnswer, folder: Path) -> None:
    """Show the verdict and the mistakes."""
    print_text(f"{found.verdict}: {found.reason}", "bold")
    if found.findings:
        rows = []
        for one in found.findings:
            shown = "{:.2f} to {:.2f} s".format(*one.time_s)
            rows.append((one.kind, one.field, shown, f"{one.explained:.1%}"))
        print_table(("kind", "field", "shows", "rows explained"), rows)
        for line in page.describe_remedies(found.findings):
            print_text(line)
    for run in found.runs:
        for line in run.cannot_tell:
            print_text(f"not judged: {line}")
    print_text(f"page: {folder / page.PAGE_FILE}, answer: {folder / ANSWER_FILE}")
