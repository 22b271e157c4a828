"""The examiner's own view of a repair: `effects.yaml` is simulated on recordings that were withheld.

The examiner fits a simulator to the reference, puts the effects of an answer around it, and runs it
freely through recordings of the changed machine that no candidate got. The floor is the error of
the same simulator on the same machine without what the case is about, under the same commands.
Nothing of the diagnosis is used but its effects, which are simulated as it simulates them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from actuators.contracts import ActuatorFit, FitTask
from brokk_rl import record
from brokk_rl.errors import BrokkError, ConfigError, RecordingError
from brokk_rl.machine import Machine
from diagnosis import effect_library
from diagnosis.case import estimate_running_s
from diagnosis.effects_file import EFFECTS_FILE
from diagnosis.free_runs import combine_joints
from diagnosis.simulator_runs import EffectSimulator, cut_simulator_runs
from exam.generate import CASES_FOLDER, UNCHANGED_FOLDER, WITHHELD_FOLDER

HORIZON_S = 5.0
"""Length of the free runs, s: as `closed` of an answer is defined."""
STRIDE_S = 2.5
"""Distance between two of them, s: they overlap by half."""
MIN_GAP_RATIO = 1.05
"""Error over floor from which there is a gap to close. Chosen by hand; not searched."""


class ExaminerSimulator:
    """A simulator of one case, and the windows that it is held against.

    Args:
        exam: Folder of the exam.
        case: Name of the case.
        fit: Fit of the simulator.
        machine: The machine.

    Raises:
        RecordingError: there are no withheld recordings, or the simulator cannot be fitted.
    """

    def __init__(self, exam: Path, case: str, fit: ActuatorFit, machine: Machine) -> None:
        self._machine = machine
        place, hidden = exam / CASES_FOLDER / case, exam / WITHHELD_FOLDER / case
        reference = record.read_recordings(str(place / "reference" / "*.parquet"), machine)
        field = record.read_recordings(str(place / "field" / "*.parquet"), machine)
        withheld = record.read_recordings(str(hidden / "*.parquet"), machine)
        unchanged = record.read_recordings(str(hidden / UNCHANGED_FOLDER / "*.parquet"), machine)
        with tempfile.TemporaryDirectory(prefix="brokk") as scratch:
            self._actuator = fit.fit(FitTask(machine, reference, [], Path(scratch)))
        # of the field an answer knows how long the machine had run; the withheld part goes on
        running = estimate_running_s([*field, *withheld])[len(field) :]
        about = (machine, 0, HORIZON_S, STRIDE_S, running)
        self._runs = cut_simulator_runs(self._actuator, withheld, *about)
        self._before = self._measure_error(self._runs, {})
        without = cut_simulator_runs(self._actuator, unchanged, *about)
        self._floor = self._measure_error(without, {})

    def examine(self, effects: Mapping[str, Any]) -> dict[str, Any]:
        """Return the errors before, after these effects (specs by name), and at the floor, and the share closed."""
        before, floor = self._before, self._floor
        after = self._measure_error(self._runs, effects) if effects else before
        closed = compute_closed(before, after, floor)
        return {"before": before, "after": after, "floor": floor, "closed": closed}

    def _measure_error(self, runs: EffectSimulator, effects: Mapping[str, Any]) -> float:
        """Return the root mean square error over all windows and joints, in the unit of `choose_unit`."""
        kinds = {kind.name: kind for kind in effect_library.load_effects(self._machine)}
        chosen = []
        for name, effect in effects.items():
            model = self._actuator.build(self._machine, 1, torch.device("cpu"))
            around = effect.wrap(model, self._machine, 1, torch.device("cpu"))
            values = {key: value.numpy() for key, value in around.parameters.items()}
            chosen.append((kinds[name], values))
        apart = runs.simulate(chosen)[0] - runs.cut.measured
        return float(combine_joints(np.square(apart).mean((0, 1), dtype=float), self._machine))


def compute_closed(before: float, after: float, floor: float) -> float | None:
    """Return the share of a gap that is closed, `None` where there is none."""
    if before <= MIN_GAP_RATIO * floor:
        return None
    return (before - after) / (before - floor)


def read_effects(path: Path, machine: Machine) -> dict[str, Any]:
    """Return the specs of an `effects.yaml` by name; a file is not trusted with targets of its own.

    Raises:
        RecordingError: it is missing, no YAML, or names something that is no effect.
    """
    try:
        nodes = yaml.safe_load(path.read_text()) or {}
        known = {kind.name: kind.target for kind in effect_library.load_effects(machine)}
        found = {}
        for name, node in nodes.items():
            target, fields = known[name], dict(node)
            if fields.pop("_target_") != f"{target.__module__}.{target.__name__}":
                raise ValueError(f"'{name}' has another target than the library's")
            found[name] = target(**fields)
    except (OSError, KeyError, ValueError, AttributeError, yaml.YAMLError, ConfigError) as error:
        raise RecordingError(f"{path}: no effects of the library ({error})") from error
    return found


def examine_case(
    exam: Path, fit: ActuatorFit, machine: Machine, case: str, answers: Mapping[str, Path]
) -> dict[str, dict[str, Any]]:
    """Return the examination of each candidate's answer to a case, as plain JSON data.

    `error` holds the reason where an answer could not be simulated; it then closes nothing.
    """
    simulator = ExaminerSimulator(exam, case, fit, machine)
    found = {}
    for name, place in answers.items():
        error, effects = None, {}
        try:
            # a baseline writes no file: it repairs nothing
            if (place / EFFECTS_FILE).is_file():
                effects = read_effects(place / EFFECTS_FILE, machine)
            result = simulator.examine(effects)
        except BrokkError as failure:
            error, result = str(failure), simulator.examine({})
        found[name] = {**result, "error": error}
    return found
