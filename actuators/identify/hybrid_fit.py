"""Fit of `actuators.models.hybrid`: the valve curve first, then trees on what it leaves.

The residual has to reduce the error on two kinds of withheld recordings: some like those fitted to,
and the runs whose commands and positions are least like the others. A joint on which it does not
keeps the curve alone.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from actuators import open_loop
from actuators.identify.boosting_fit import BoostingFit
from actuators.identify.valve_fit import ValveFit
from actuators.models import checkpoint
from actuators.models.hybrid import MOVING, HybridActuator, ResidualInputs, compute_residual
from actuators.models.trees import TENSORS
from actuators.models.valve import ValveActuator
from actuators.recordings.split import COMMANDED, group_by_run
from brokk_rl.errors import ConfigError, RecordingError, StorageError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_text
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

SHARES = (0.0, 0.5, 1.0)
"""Parts of the residual among which validation chooses, joint by joint."""
UNLIKE = 0.25
"""Least part of all samples in the runs that are least like the others. Chosen by hand; not
searched."""
VALIDATION_S = 5.0
"""Horizon of the free runs that judge the residual: the headline horizon of the verdict."""
VALIDATION_STRIDE_S = 2.0
"""Distance between them, s. Chosen by hand; not searched."""
SPREAD_LIMIT = 3.0
"""Spread at which half the residual is left, over its root mean square in training while a joint
moves. Chosen by hand; not searched."""
PIECE = 600
"""Samples of a recording that run in one piece: shorter ones spend their time in lead-ins."""
CPU = torch.device("cpu")


@spec
class HybridFit:
    """A valve curve with a residual of boosted trees that has to win on a second kind of motion.

    Attributes:
        name: Name in tables, of the checkpoint and of the file for `actuator=@…`.
        valve: Fit of the curve.
        members: Members of the ensemble, each fitted to runs drawn with replacement.
        boosting: Trees of each member.
    """

    name: str
    valve: ValveFit
    boosting: BoostingFit
    members: int

    def check(self) -> None:
        if self.members < 2:
            raise ConfigError(f"fit.members: a spread needs 2 or more, got {self.members}")

    def require(self) -> None:
        """Check that scikit-learn is there.

        Raises:
            ConfigError: it is not.
        """
        self.boosting.require()

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> HybridActuator:
        """Fit to all recordings; write `<name>.safetensors` and `<name>.yaml` into `folder`.

        Raises:
            ConfigError: scikit-learn is not installed.
            RecordingError: too little data.
            StorageError: a file could not be written.
        """
        self.require()
        del device  # trees are fitted on the CPU
        every = [*train, *validation]
        path = folder / f"{self.name}.safetensors"
        judged = self._choose_share(machine, every, validation, folder, seed)
        curve = self.valve.fit(machine, every, [], folder / "curve", seed, CPU)
        tensors = self._fit_residual(curve, machine, every, seed)
        tensors["share"] = torch.as_tensor(judged["share"], dtype=torch.float32)
        facts = {
            "members": self.members,
            "share": dict(zip(machine.joint_names, judged["share"], strict=True)),
            "validation_percent": judged["validation_percent"],
            "spread": dict(zip(machine.joint_names, tensors["limit"].tolist(), strict=True)),
        }
        checkpoint.write_checkpoint(path, "hybrid", machine, tensors, facts)
        fitted = HybridActuator(curve=curve, checkpoint=str(path))
        _write_option(folder / f"{self.name}.yaml", fitted, machine)
        return fitted

    def _choose_share(
        self,
        machine: Machine,
        every: Sequence[Recording],
        alike: Sequence[Recording],
        folder: Path,
        seed: int,
    ) -> dict[str, Any]:
        """Return the `share` of each joint and the errors it rests on, by kind of recordings."""
        kinds = {"alike": list(alike), "unlike": select_unlike(every, machine)}
        errors: dict[str, np.ndarray] = {}
        for kind, held in kinds.items():
            names = {recording.run for recording in held}
            rest = [recording for recording in every if recording.run not in names]
            try:
                cut = open_loop.cut_windows(held, machine, VALIDATION_S, VALIDATION_STRIDE_S)
                errors[kind] = self._measure_shares(machine, rest, cut, folder / "inner", seed)
            except RecordingError as error:
                log.warning("%s: no residual, it cannot be judged: %s", self.name, error)
                return {"share": [0.0] * machine.num_joints, "validation_percent": {}}
        return {
            "share": select_shares(errors["alike"], errors["unlike"]),
            "validation_percent": {kind: rows.round(3).tolist() for kind, rows in errors.items()},
        }

    def _measure_shares(
        self,
        machine: Machine,
        rest: Sequence[Recording],
        cut: open_loop.FreeRunWindows,
        folder: Path,
        seed: int,
    ) -> np.ndarray:
        """Return the error at each of `SHARES` of a fit to `rest`, % of travel, `(S, J)`."""
        curve = self.valve.fit(machine, rest, [], folder, seed, CPU)
        tensors = self._fit_residual(curve, machine, rest, seed)
        path, rows = folder / f"{self.name}.safetensors", []
        for share in SHARES:
            tensors["share"] = torch.full((machine.num_joints,), share)
            checkpoint.write_checkpoint(path, "hybrid", machine, tensors, {})
            actuator = HybridActuator(curve=curve, checkpoint=str(path) if share else None)
            error = (open_loop.roll_out(actuator, machine, cut, CPU) - cut.measured)[:, -1]
            travel = machine.upper - machine.lower
            rows.append(100.0 * np.sqrt(np.mean(np.square(error), 0)) / travel)
        return np.array(rows)

    def _fit_residual(
        self, curve: ValveActuator, machine: Machine, recordings: Sequence[Recording], seed: int
    ) -> dict[str, torch.Tensor]:
        """Return the tensors of a residual with all of it in force."""
        rows = stack_residuals(curve, machine, recordings, self.boosting.max_rows)
        generator = np.random.default_rng(seed)
        forests: dict[str, list[np.ndarray]] = {name: [] for name in TENSORS}
        num_runs = int(rows.run.max()) + 1
        for _ in range(self.members):
            count = np.bincount(generator.integers(0, num_runs, num_runs), minlength=num_runs)
            weight = count[rows.run]
            drawn, by_joint = weight > 0, []
            for j in range(machine.num_joints):
                inputs, target = rows.inputs[j][drawn], rows.target[drawn, j]
                by_joint.append(self.boosting.grow_trees(inputs, target, seed, weight[drawn]))
            for name in TENSORS:
                forests[name].append(np.stack([forest[name] for forest in by_joint]))
        tensors = {name: torch.as_tensor(np.stack(each)) for name, each in forests.items()}
        inputs = torch.as_tensor(rows.inputs)
        joints = machine.num_joints
        tensors["low"], tensors["high"] = inputs.amin(1), inputs.amax(1)
        tensors["limit"], tensors["share"] = torch.ones(joints), torch.ones(joints)
        _, spread = compute_residual(inputs, torch.as_tensor(rows.step), tensors)
        # joints at rest agree anyway and would hide the typical spread
        moves = (torch.as_tensor(rows.step).abs() > MOVING).float()
        typical = ((spread.square() * moves).sum(0) / moves.sum(0).clamp(min=1.0)).sqrt()
        tensors["limit"] = SPREAD_LIMIT * typical.clamp(min=1e-6)
        return tensors


@dataclasses.dataclass(frozen=True)
class ResidualRows:
    """Rows to fit a residual to.

    Attributes:
        inputs: Features, `(J, B, F)`.
        step: Step of the curve in full steps, `(B, J)`.
        target: Residual of the curve in full steps, `(B, J)`.
        run: Number of the run that each row comes from, `(B,)`.
    """

    inputs: np.ndarray
    step: np.ndarray
    target: np.ndarray
    run: np.ndarray


def stack_residuals(
    curve: ValveActuator, machine: Machine, recordings: Sequence[Recording], max_rows: int
) -> ResidualRows:
    """Return what the curve leaves, driven by recorded commands and positions.

    Raises:
        RecordingError: no recording is longer than what precedes a free run.
    """
    before, size = open_loop.count_samples_before(machine), machine.num_history
    used = [recording for recording in recordings if recording.num_samples > before + 1]
    if not used:
        raise RecordingError(
            f"too little data: none of {len(recordings)} recordings is longer than {before + 1} samples"
        )
    steps = _run_curve(curve, machine, used)
    full = machine.max_speed * machine.period_s
    model = curve.build(machine, 1, CPU)
    build_inputs = ResidualInputs(machine, model.parameters["dead_time_s"][0], CPU).build
    every = -(-sum(recording.num_samples for recording in used) // max_rows)
    numbers = {name: number for number, name in enumerate(group_by_run(used))}
    inputs, step, target, run = [], [], [], []
    for recording, moved in zip(used, steps, strict=True):
        u, q = torch.as_tensor(recording.u).float(), torch.as_tensor(recording.q).float()
        rows = slice(before - size, -1, every)  # what came before the recording is not known
        seen = [x.unfold(0, size, 1).transpose(1, 2)[rows] for x in (u, q)]
        given = moved[before - 1 : -1 : every] / full
        inputs.append(build_inputs(seen[0], seen[1], torch.as_tensor(given).float()).numpy())
        increments = np.diff(recording.q.astype(np.float64), axis=0)[before - 1 :: every] / full
        step.append(given.astype(np.float32))
        target.append(increments - given)
        run.append(np.full(len(given), numbers[recording.run]))
    return ResidualRows(
        np.concatenate(inputs, 1), np.concatenate(step), np.concatenate(target), np.concatenate(run)
    )


def _run_curve(
    curve: ValveActuator, machine: Machine, recordings: Sequence[Recording]
) -> list[np.ndarray]:
    """Return the steps of the curve at recorded commands and positions, each `(T, J)`.

    Recordings run in pieces side by side; a piece begins early by what precedes a free run.
    """
    lead, size = open_loop.count_samples_before(machine), machine.num_history
    pieces, leads = [], []
    for recording in recordings:
        for start in range(0, recording.num_samples, PIECE):
            rows = slice(max(0, start - lead), start + PIECE)
            pieces.append([torch.as_tensor(part[rows]) for part in (recording.u, recording.q)])
            leads.append(start - rows.start)
    count, longest = len(pieces), lead + PIECE
    u, q = (torch.zeros(count, longest, machine.num_joints) for _ in range(2))
    for n, (commands, positions) in enumerate(pieces):
        u[n, : len(commands)] = commands
        q[n] = positions[-1]
        q[n, : len(positions)] = positions
    model = curve.build(machine, count, CPU)
    model.reset(torch.ones(count, dtype=torch.bool))
    steps = []
    history = History(q=q[:, :1].repeat(1, size, 1), u=u[:, :1].repeat(1, size, 1))
    with torch.inference_mode():
        for k in range(longest):
            history.push_u(u[:, k])
            if k:
                history.push_q(q[:, k])
            model.step(history)
            steps.append(model.state["step"].clone())
    moved = torch.stack(steps, 1).double().numpy()
    found, n = [], 0
    for recording in recordings:
        parts = []
        for _ in range(0, recording.num_samples, PIECE):
            parts.append(moved[n, leads[n] : len(pieces[n][0])])
            n += 1
        found.append(np.concatenate(parts))
    return found


def select_unlike(recordings: Sequence[Recording], machine: Machine) -> list[Recording]:
    """Return the recordings of the runs least like the others, `UNLIKE` of the samples or more.

    A run is described by size and direction of its commands, how many joints move together, and
    where they move; the distance is from the median of all runs, in their spread.
    """
    parts = list(group_by_run(recordings).values())
    described = []
    for run in parts:
        u, q = (np.concatenate([getattr(part, name) for part in run]) for name in ("u", "q"))
        place = (q - machine.lower) / (machine.upper - machine.lower)
        together = np.mean((np.abs(u) > COMMANDED).sum(1) > 1)
        row = [np.abs(u).mean(0), u.mean(0), place.mean(0), place.std(0), [together]]
        described.append(np.concatenate(row))
    table = np.array(described)
    apart = (table - np.median(table, 0)) / (table.std(0) + 1e-6)
    order = np.argsort(-np.square(apart).sum(1), kind="stable")
    total, found = sum(recording.num_samples for recording in recordings), []
    for number in order[:-1]:  # one run is left to fit to
        found += parts[number]
        if sum(recording.num_samples for recording in found) >= UNLIKE * total:
            break
    return found


def select_shares(alike: np.ndarray, unlike: np.ndarray) -> list[float]:
    """Return the share of each joint with the least mean error that is worse on neither kind.

    Args:
        alike: Error at each of `SHARES` on recordings like those fitted to, `(S, J)`.
        unlike: The same on those least like them.
    """
    shares = []
    for j in range(alike.shape[1]):
        best = 0
        for number in range(1, len(SHARES)):
            rows = (number, 0)
            worse = any(errors[rows[0], j] > errors[rows[1], j] for errors in (alike, unlike))
            total = [alike[row, j] + unlike[row, j] for row in (number, best)]
            best = number if not worse and total[0] < total[1] else best
        shares.append(SHARES[best])
    return shares


def _write_option(path: Path, fitted: HybridActuator, machine: Machine) -> None:
    """Write the fitted actuator as an option for `actuator=@<path>`."""

    def describe(actuator: Any) -> dict[str, Any]:
        target = f"{type(actuator).__module__}.{type(actuator).__name__}"
        # through JSON, which makes lists of tuples as YAML wants them
        return {"_target_": target, **json.loads(json.dumps(dataclasses.asdict(actuator)))}

    facts = {**describe(fitted), "curve": describe(fitted.curve)}
    text = yaml.safe_dump(facts, sort_keys=False, width=130)
    try:
        write_text(path, f"# fitted to recordings of {machine.name}\n{text}")
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error
