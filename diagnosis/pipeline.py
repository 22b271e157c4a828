"""The whole way from a case to an outcome."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from actuators.identify.curve_fit import ValveCurveFit
from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import examine_recordings
from brokk_rl.contracts.actuator import Excitation
from diagnosis import (
    calibration,
    decision,
    detection,
    effect_library,
    gates,
    hypotheses,
    next_experiment,
    speed_curves,
    verdict,
)
from diagnosis.answer import Answer, NextExperiment, Outcome, Ranked, Selected, Where
from diagnosis.attribution import MIN_RESTORED, EffectAttribution, EffectPart
from diagnosis.baseline import Baseline
from diagnosis.case import GapCase
from diagnosis.closure import Estimate, Gate, serialize_estimate
from diagnosis.detection import DetectionResult, ProgressCallback
from diagnosis.effect_library import DetectedEffect, EffectSimulator, EffectType
from diagnosis.free_runs import WindowedRuns
from diagnosis.gap import GapClosure, evaluate_unseen
from diagnosis.hypotheses import MAX_SAME, Choice, Hypothesis
from diagnosis.motion_delay import measure_motion_delays
from diagnosis.refine import FittedSet
from diagnosis.request import Penalties, ProbabilityModel
from diagnosis.residual_model import CLUES
from diagnosis.rivals import Rival
from diagnosis.speed_curves import SpeedCurves
from diagnosis.stages import Survey, examine_gap
from diagnosis.verdict import Judgement

MAX_TRIED = 3
"""Effects that are tried in turn where the likeliest fail their gates. Chosen by hand: each is fitted
by simulation."""
RIVAL_SHARE = 0.6
"""A rival that earns so much of what a selected effect earns is worth an experiment."""
CURVE_SEED = 0
"""Seed for the bootstraps of speed curves and delays. Draws of later steps stay as they are."""
DECIDED_BY = {
    frozenset(
        {"flow_gain", "encoder_scale"}
    ): "an outside measurement of the angle (inclinometer, laser) at two positions",
    frozenset(
        {"dead_time", "clock_offset"}
    ): "one clock for commands and positions, or a pulse that both record",
}
"""Measurements that would tell apart what commands and joint positions cannot."""


@dataclass(frozen=True)
class DiagnosisPipeline:
    """A diagnosis: case, baseline, library, penalties.

    Attributes:
        case: The recordings.
        base: The simulator.
        kinds: The library.
        penalties: Penalties of effects.
        calibration: Calibration of the probabilities.
        thresholds: When a stretch of a recording is worth telling.
        excitations: Experiments that could follow, by name.
        curve_fit: Reads the speed curves of machine and simulator.
        generator: Draws bootstraps, permutations and excitations.
    """

    case: GapCase
    base: Baseline
    kinds: Sequence[EffectType]
    penalties: Penalties
    calibration: ProbabilityModel
    thresholds: InspectionThresholds
    excitations: Mapping[str, Excitation]
    curve_fit: ValveCurveFit
    generator: np.random.Generator

    def run(self, tell: ProgressCallback) -> Outcome:
        """Return the outcome; `tell` receives the name and the progress of each step."""
        if doubts := self.case.doubts():
            return self._cannot_tell("; ".join(doubts))
        tell("recordings", 0.3)
        remarks = examine_recordings(self.case.field, self.case.machine, self.thresholds)
        told = verdict.judge_case(self.case, self.base, remarks, self._known())
        if failed := gates.list_failures(told):
            return self._cannot_tell(failed, told)
        tell("speed curves", 0.31)
        curves = speed_curves.measure_curves(
            self.base.field,
            [self.base.field.with_base(one.base) for one in self._list_left_out()],
            self.case.machine,
            self.curve_fit,
            np.random.default_rng(CURVE_SEED),
        )
        search = detection.EffectSearch(
            self.case, self.base, self.kinds, self.penalties, tell, curves
        )
        return self._outcome(search.run(), told, curves)

    def _list_left_out(self) -> list[EffectSimulator]:
        """Return the simulators that were fitted without a part of the reference."""
        if self.base.is_flexible:
            return []
        return [one.residuals.simulator for one in self.base.left_out]

    def _known(self) -> GapClosure:
        """Return the errors of the simulator as it was."""
        machine, paths = self.case.machine, self.base.field.residuals.base
        return GapClosure(self.base, machine, paths, None, self.generator)

    def _outcome(
        self, result: DetectionResult, told: Sequence[Gate], curves: SpeedCurves
    ) -> Outcome:
        field, machine = self.base.field, self.case.machine
        rivals = verdict.collect_rivals(self.base)
        shared = effect_library.list_shared_effects(self.kinds)
        known = hypotheses.list_hypotheses(result, self._known(), self.penalties, shared)
        weighing, seen = self._settle(result, known, rivals)
        result, reach, named = seen.result, seen.reach, seen.verdict == "effects"
        foretold = reach.foretold()
        parts = EffectAttribution(result, reach).measure_parts() if named else {}
        selected = self._describe_detected(result, seen.found, parts)
        selected += self._selected(result, parts, weighing) if seen.fitted else []
        selected.sort(key=lambda one: -one.probability)
        before, floor = field.runs(field.residuals.base), self._floor()
        after = field.runs(reach.after) if named else None
        survey = self._examine(before, floor, after)
        remainder = self._remainder(result, reach) if named else None
        ranking: Sequence[Ranked] = weighing.rank(selected, machine.joint_names)
        if seen.verdict == "unknown" and seen.failed:
            ranking = gates.rank_unknown_first(ranking)
        answer = Answer(
            verdict=seen.verdict,
            selected=tuple(selected),
            ranking=tuple(ranking),
            where=survey.where(),
            gap=reach.gap(named=named),
            rivals=verdict.describe_rivals(rivals, machine),
            gates=(*told, *seen.gates),
            next_experiment=self._next(result, selected),
            reason=self._reason(seen, selected, remainder),
            more=survey.more()
            | self._more(result, foretold)
            | {"curves": speed_curves.serialize_curves(curves)}
            | {"unknown_remainder": remainder, "reference_error": reach.measure_reference()}
            | {"motion_delay_s": measure_motion_delays(before, after, machine, CURVE_SEED)}
            | self._unseen(result, seen.fitted),
        )
        return Outcome(answer, before, after, floor)

    def _settle(
        self, result: DetectionResult, known: Sequence[Hypothesis], rivals: Mapping[str, Rival]
    ) -> tuple[Choice, Judgement]:
        """Return choice and verdict: an effect that fails its gates is left out, and the rest weighed again."""
        tried = 0
        while True:
            choice = hypotheses.choose_hypothesis(known, self.calibration)
            found = hypotheses.apply_choice(result, choice, self.penalties, self.calibration)
            unknown = hypotheses.is_unknown(choice, found)
            seen = verdict.judge_findings(
                found, self.case, self.base, rivals, self.thresholds, self.generator, unknown
            )
            if choice.best is None or found.fitted is None or seen.fitted is not None:
                return choice, seen
            tried += 1
            known = [one for one in known if one.name != choice.best.name]
            if tried == MAX_TRIED:
                known = [one for one in known if one.verdict != "effects"]

    def _examine(
        self, before: WindowedRuns, floor: WindowedRuns | None, after: WindowedRuns | None
    ) -> Survey:
        machine = self.case.machine
        dead_time_s = np.full(machine.num_joints, machine.dead_time_s)
        return examine_gap(
            before, floor, after, machine, self.thresholds, dead_time_s, self.generator
        )

    def _describe_detected(
        self,
        result: DetectionResult,
        found: Sequence[DetectedEffect],
        parts: Mapping[str, EffectPart],
    ) -> list[Selected]:
        """Return the answers about effects that sensors, frames or tool points show.

        Their share of their own statistic is no share of the gap.
        """
        selected = []
        for one in found:
            answer = decision.describe_detected_effect(
                result, one, self.calibration, self.case.machine
            )
            own = {"own_statistic_explained": one.closed}
            selected.append(_add_part(answer, parts.get(one.kind.name), own))
        return selected

    def _selected(
        self, result: DetectionResult, parts: Mapping[str, EffectPart], weighing: Choice
    ) -> list[Selected]:
        kinds = {kind.name: kind for kind in self.kinds}
        chosen = decision.rank_chosen_effects(result, kinds)
        assert result.fitted is not None, "what is selected has been simulated"
        found = []
        for kind in chosen:
            swaps = decision.rank_substitutions(result, kind.name)
            like = decision.list_equivalents(swaps, decision.compute_own_gain(result, kind.name))
            signs = decision.read_chosen_signs(
                result, self.penalties, self.calibration, kind.name, swaps, like
            )
            probability = calibration.compute_probability(self.calibration.right, signs)
            alike = weighing.list_class()
            if kind.name in alike:
                like = tuple(name for name in alike if name != kind.name)[:MAX_SAME] or like
                probability = weighing.probability(*alike)
            joints = result.fitted.joints_of(kind)
            decided = next(
                (how for pair, how in DECIDED_BY.items() if kind.name in pair and pair & set(like)),
                None,
            )
            names = [
                name for name, has in zip(self.case.machine.joint_names, joints, strict=True) if has
            ]
            answer = Selected(
                effect=kind.name,
                joints=tuple(names),
                probability=probability,
                parameters=verdict.mark_bounds(
                    decision.estimate_numbers(
                        result,
                        kind,
                        self.case.machine,
                        self.calibration.get_form_error(kind.name, kind.stage),
                    ),
                    result.fitted,
                    kind,
                    self.case.machine,
                ),
                gap_closed=None,
                same_as=like,
                decided_by=decided,
            )
            found.append(_add_part(answer, parts.get(kind.name)))
        return sorted(found, key=lambda one: -one.probability)

    def _remainder(self, result: DetectionResult, reach: GapClosure) -> dict[str, Any] | None:
        """Return the unexplained remainder beside the named effects; `None` without one."""
        predictable = decision.find_unexplained_joints(result)
        names = self.case.machine.joint_names
        beyond = reach.beyond()
        joints = [
            name for name, more in zip(names, predictable, strict=True) if more or name in beyond
        ]
        if not joints:
            return None
        told = [name for name, more in zip(names, predictable, strict=True) if more]
        why = f"a flexible model still predicts the error of {', '.join(told)}" if told else ""
        over = f"the error of {', '.join(beyond)} exceeds the floor" if beyond else ""
        return {"joints": joints, "reason": "; ".join(filter(None, (why, over)))}

    def _unseen(self, result: DetectionResult, fitted: FittedSet | None) -> dict[str, Any]:
        """Return how far the effects carry on recordings apart."""
        if not self.case.unseen or fitted is None:
            return {}
        return {"unseen": evaluate_unseen(result, self.case.unseen, self.case.machine)}

    def _next(self, result: DetectionResult, selected: Sequence[Selected]) -> NextExperiment | None:
        """Return the experiment that would separate equivalent effects, and rivals with nearly the same gain."""
        kinds, rivals = {kind.name: kind for kind in self.kinds}, []
        undecided = next((one for one in selected if one.same_as), None)
        for one in selected:
            swaps = (
                []
                if one.effect not in result.chosen.names
                else decision.rank_substitutions(result, one.effect)
            )
            near = {
                swap.name: max(0.0, swap.share) for swap in swaps[:3] if swap.share > RIVAL_SHARE
            }
            if near and (undecided is None or one is undecided):
                rivals = [
                    next_experiment.RivalEffect(
                        kinds[one.effect],
                        decision.look_up_values(result, one.effect, one.effect),
                        one.probability,
                    )
                ]
                rivals += [
                    next_experiment.RivalEffect(
                        kinds[name],
                        decision.look_up_values(result, one.effect, name),
                        share * one.probability,
                    )
                    for name, share in near.items()
                ]
                break
        noises = self.base.field.residuals.noise or []
        found = next_experiment.choose_experiment(
            self.base.actuator, noises, rivals, self.excitations, self.case.machine, self.generator
        )
        if found is None and undecided and undecided.decided_by:
            return NextExperiment(
                "",
                (undecided.effect, *undecided.same_as),
                f"no excitation does; {undecided.decided_by} would",
            )
        return found

    def _floor(self) -> WindowedRuns | None:
        if not self.base.left_out:
            return None
        recordings, source, row, paths = [], [], [], []
        for one in self.base.left_out:
            source.append(one.source + len(recordings))
            recordings += one.recordings
            row.append(one.row)
            paths.append(one.residuals.base)
        return WindowedRuns(
            recordings,
            np.concatenate(source),
            np.concatenate(row),
            np.concatenate(paths).astype(float),
        )

    def _more(self, result: DetectionResult, foretold: Estimate | None) -> dict[str, Any]:
        names = self.case.machine.joint_names
        return {
            "evidence": {
                "rivals": _list_rivals(result, names),
                "threshold": self.penalties.name + self.penalties.joint,
                "unit": "log likelihood",
            },
            "remainder": _describe_remainder(result, names),
            "predicted_closed": foretold and serialize_estimate(foretold),
        }

    def _reason(
        self, seen: Judgement, selected: Sequence[Selected], remainder: Mapping[str, Any] | None
    ) -> str:
        told, result = seen.verdict, seen.result
        if told == "unknown" and seen.failed:
            return f"no effect of the library explains these recordings: {seen.failed}"
        if told == "effects":
            text = "; ".join(
                f"{one.effect} on {', '.join(one.joints) or 'the machine'}" for one in selected
            )
            return text + (
                f"; an unknown remainder on {', '.join(remainder['joints'])}" if remainder else ""
            )
        if told == "unknown":
            joints = np.flatnonzero(decision.find_unexplained_joints(result))
            where = ", ".join(self.case.machine.joint_names[j] for j in joints) or "some joints"
            best = calibration.subtract_reference_clues(result).max(1)
            clues = [
                clue
                for clue, earned in zip(CLUES, best, strict=True)
                if earned > max(decision.MIN_CLUE_NATS, 0.5 * best.max())
            ]
            if not clues:
                return f"the gap of {where} is real, and no effect of the library explains it"
            return f"the gap of {where} can be predicted ({'; '.join(clues)}), but by no effect of the library"
        return "no effect earns more on the field recordings than it would by chance"

    def _cannot_tell(self, why: str, told: Sequence[Gate] = ()) -> Outcome:
        """Return the answer of recordings that cannot tell anything; with `told` it says where the gap lies."""
        field, machine = self.base.field, self.case.machine
        runs, floor = field.runs(field.residuals.base), self._floor()
        reason = f"cannot tell, because {why}"
        known = replace(self._known().gap(), closed=None, closed_reason=reason)
        survey = self._examine(runs, floor, None) if told else None
        rivals = verdict.collect_rivals(self.base)
        answer = Answer(
            verdict="unknown",
            selected=(),
            ranking=(Ranked("unknown", (), 1.0),),
            where=survey.where() if survey else Where({}, (), None),
            gap=known,
            rivals=verdict.describe_rivals(rivals, machine),
            gates=tuple(told) or (Gate("enough_data", False, None, None, why),),
            next_experiment=None,
            reason=reason,
            more=survey.more() if survey else {},
        )
        return Outcome(answer, runs, None, floor)


def _add_part(
    answer: Selected, part: EffectPart | None, own: Mapping[str, Any] | None = None
) -> Selected:
    """Return the answer with the part of its effect; without one free runs do not show it."""
    if part is None:
        return replace(answer, gap_closed=None, edit=own)
    edit = {
        "reduced": serialize_estimate(part.reduced),
        "rise_without": serialize_estimate(part.rise),
        "restored": part.restored,
        "least": MIN_RESTORED,
    }
    return replace(
        answer, gap_closed=part.closed, identified=part.identified, edit={**edit, **(own or {})}
    )


MAX_RIVALS = 40
"""Most single effects in `diagnosis.json`. Chosen by hand; not searched."""


def _list_rivals(result: DetectionResult, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the gain of each single effect on each joint, the largest first."""
    rivals = []
    for joint, table, chosen in zip(names, result.tables, result.chosen.subsets, strict=True):
        for subset in table.scores:
            if len(subset) == 1:
                (name,) = subset
                row = {"name": f"{name} on {joint}", "effect": name, "joints": [joint]}
                gain = table.scores[subset].total
                rivals.append(row | {"score": gain, "selected": name in chosen})
    return sorted(rivals, key=lambda row: -row["score"])[:MAX_RIVALS]


def _describe_remainder(result: DetectionResult, names: Sequence[str]) -> dict[str, Any]:
    """Return the clue of each joint that gains most beyond the reference."""
    clues, left = tuple(CLUES), {}
    for j, name in enumerate(names):
        earned, null = result.clue_gains[:, j], result.reference_clue_gains[:, j]
        best = int(np.argmax(earned - null))
        left[name] = {
            "clue": clues[best],
            "earned": float(earned[best]),
            "null": float(null[best]),
            "scatter": float(result.scatter[j]),
        }
    return left
