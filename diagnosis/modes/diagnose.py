"""`brokk mode=diagnose`: where the gap between a simulator and the machine lies, which effects cause it, how far they close it."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch
from threadpoolctl import threadpool_limits

from actuators.contracts import ActuatorFit, FitTask
from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.parallel import use_workers
from brokk_rl.progress import SHARE, ItemProgress
from brokk_rl.session import Session
from brokk_rl.spec import spec
from diagnosis import answer, case, effect_library, effects_file, measured_changes, report
from diagnosis.answer import Answer, Outcome
from diagnosis.case import GapCase
from diagnosis.effect_library import EffectType
from diagnosis.engine.side import MODELS
from diagnosis.own_simulator import OwnSimulator
from diagnosis.reference_diagnosis import ReferenceDiagnosis
from diagnosis.request import DiagnosisSubject
from diagnosis.simulator_diagnosis import SimulatorDiagnosis, describe_doubts

log = logging.getLogger(__name__)


@spec
class Diagnose:
    """Compare a simulator with recordings and name the effects that it lacks.

    Attributes:
        session: Folder, seed, device.
        machine: The machine that was recorded.
        fit: Fit of the simulator to `reference/`, for joints commanded by torque.
        actuator: The simulator that `diagnosis.field` is held against.
        simulator: A simulator of your own in its place: `module:function`, or an MJCF file.
        diagnosis: Recordings to diagnose.
    """

    session: Session
    machine: Machine
    fit: ActuatorFit
    actuator: Actuator | None
    simulator: str | None
    diagnosis: DiagnosisSubject

    def check(self) -> None:
        if self.simulator is None:
            return
        if self.actuator is not None:
            raise ConfigError(
                f"give either actuator=… or simulator={self.simulator}: one is held against the recordings"
            )
        OwnSimulator(source=self.simulator)

    @property
    def base(self) -> Actuator | None:
        """The simulator that is held against the field; `None` where there is a reference."""
        if self.simulator is None:
            return self.actuator
        return OwnSimulator(source=self.simulator)

    def run(self) -> None:
        """Write `diagnosis.json`, `report.html` and `effects.yaml`.

        Raises:
            RecordingError: a recording cannot be used, or there is too little data to fit a
                simulator to.
            ConfigError: neither a case nor an actuator is given, or an effect is unknown.
            StorageError: something could not be written.
        """
        self.session.seed_all()
        outcome = self.find_causes(self._case())
        self.write(outcome)
        _print_answer(outcome.answer, self.session.folder)

    def find_causes(self, given: GapCase) -> Outcome:
        """Return the outcome for recordings at hand; the progress is shown.

        Raises:
            RecordingError: there is too little data to fit a simulator to.
            ConfigError: an effect is unknown, or there is neither a reference nor an actuator.
        """
        if self.base is None and not given.reference:
            raise ConfigError(
                "diagnosis.field needs a simulator to hold it against: add actuator=<name>, or simulator=<your own>"
            )
        torch.set_num_threads(1)  # the arrays are small: threads would only wait for each other
        with (
            ItemProgress("fitting the simulator", SHARE) as progress,
            use_workers(self.diagnosis.workers),
            threadpool_limits(1),
        ):

            def tell(doing: str, done: float) -> None:
                progress.reach(done, doing)

            generator = self.session.generator("diagnosis")
            if doubts := given.doubts():
                return self._add_changes(describe_doubts(given, "; ".join(doubts)), given)
            if given.reference and self.machine.interface in MODELS:
                work = ReferenceDiagnosis(given, self._kinds, generator)
            else:
                base, seed = self._find_base(given), self.session.stream("base")
                work = SimulatorDiagnosis(given, self._kinds, generator, base, seed)
            return self._add_changes(work.run(tell), given)

    def _add_changes(self, found: Outcome, given: GapCase) -> Outcome:
        """Return the outcome with what changed on the machine since the reference, whatever the cause."""
        if not given.reference:
            return found
        changes = measured_changes.measure_changes(
            given.reference, given.field, self.machine, self.diagnosis.repeatability
        )
        told = found.answer
        reason, num_beyond = told.reason, sum(one.is_beyond for one in changes)
        if told.verdict == "none" and num_beyond:
            # Efforts and scatter may change where the motion does not.
            reason += f"; {num_beyond} measured quantities changed beyond what the machine repeats"
        more = {**told.more, "changes": measured_changes.list_changes(changes)}
        return replace(found, answer=replace(told, reason=reason, more=more))

    def write(self, outcome: Outcome) -> None:
        """Write `diagnosis.json`, `report.html` and `effects.yaml`.

        Raises:
            StorageError: something could not be written.
        """
        folder = self.session.folder
        outcome.answer.write(folder / answer.ANSWER_FILE)
        effects_file.write_effects(outcome.answer, self._kinds, folder / effects_file.EFFECTS_FILE)
        with use_workers(self.diagnosis.workers):
            report.write_report(outcome, folder, self.machine)

    @cached_property
    def _kinds(self) -> list[EffectType]:
        """Effects that are asked about; loading them logs which ones are left out, so it happens once."""
        return effect_library.load_effects(self.machine, self.diagnosis.effects, self.base)

    def _case(self) -> GapCase:
        subject = self.diagnosis
        if subject.case is not None:
            return case.load_case(Path(subject.case), self.machine)
        assert subject.field is not None, "checked by Subject"
        return GapCase(self.machine, [], case.read_recordings(subject.field, self.machine))

    def _find_base(self, given: GapCase) -> Actuator:
        """Return the simulator: the one that was given, or one fitted to the reference."""
        if self.base is not None:
            return self.base
        pieces = case.split_recordings(given.reference, self.machine)
        seed, device = self.session.stream("base"), self.session.torch_device()
        folder = self.session.folder / "base"
        known = pieces[:-1] or pieces
        return self.fit.fit(FitTask(self.machine, known, pieces[-1:], folder, seed, device))


def _print_answer(found: Answer, folder: Path) -> None:
    rows = []
    for one in found.selected:
        told = []
        for name, values in one.parameters.items():
            for joint, value in values.items():
                told.append(
                    f"{name} {joint} {' ('.join(report.format_estimate(value, 1.0, '.4g'))})"
                )
        closes = f"{100 * one.gap_closed.mean:.0f} %" if one.gap_closed else ""
        joints, others = " ".join(one.joints), " ".join(one.same_as)
        chance = f"{one.probability:.2f}"
        rows.append((one.effect, joints, chance, "\n".join(told), closes, others))
    print_text(f"{found.verdict}: {found.reason}", "bold")
    if found.selected:
        print_table(("effect", "joints", "probability", "numbers", "closes", "same as"), rows)
    print_text(f"report: {folder / report.REPORT_FILE}, answer: {folder / answer.ANSWER_FILE}")
