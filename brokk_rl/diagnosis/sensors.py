"""Noise and coarse steps of a sensor: too small for free runs to show, plain in how the samples scatter.

Each recording is summed up by a few statistics a joint. An effect is put onto recordings of the reference, at several sizes; the
size whose statistics are nearest to those of the field is the most likely one.
Axes: `T` time, `J` joints, `P` parts of the reference, `F` statistics.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from brokk_rl.diagnosis.answer import Estimate
from brokk_rl.diagnosis.case import Case, parts
from brokk_rl.diagnosis.found import Found, interval
from brokk_rl.diagnosis.library import Kind, Still
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

SIZES = np.geomspace(0.05, 6.0, 25)
AT_REST, MOVING = 0.01, 0.08
"""Mean speed over a second, of full speed, below which a joint rests and above which it moves."""
BLUR = np.array([0.08, 0.08, 0.03, 0.03])
"""Differences in the statistics that say nothing: sensors are not quite the same from day to day."""
MOST = 60.0
"""Evidence is not counted beyond this: the statistics are no exact likelihood."""
TINY = 2e-6
"""Noise that float32 cannot hold, rad or m."""


def statistics(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Returns, by joint, the log scatter of second differences at rest and in motion, and the share of equal neighbours in both."""
    second = max(2, round(1.0 / machine.period_s))
    speed = np.zeros_like(q)
    speed[second // 2 : second // 2 + len(q) - second] = (q[second:] - q[:-second]) / second
    speed = np.abs(speed) / (machine.max_speed * machine.period_s)
    bend, step = np.abs(np.diff(q, 2, axis=0)), np.abs(np.diff(q, axis=0))[1:]
    found = np.full((q.shape[1], 4), np.nan)
    for j in range(q.shape[1]):
        for place, rows in enumerate((speed[1:-1, j] < AT_REST, speed[1:-1, j] > MOVING)):
            if rows.sum() >= 3 * second:
                cut = np.minimum(bend[rows, j], 6 * np.median(bend[rows, j]) + TINY)
                found[j, place] = np.log(np.sqrt(np.mean(cut**2)) + TINY)
                found[j, 2 + place] = np.mean(step[rows, j] < TINY / 2)
    return found


def search(case: Case, kinds: Sequence[Kind], price: float, name_price: float) -> list[Found]:
    """Returns the effects on sensors that the scatter of the field's samples shows."""
    field, reference, machine = case.field, parts(case.reference), case.machine
    if len(reference) < 2:
        return []
    kinds = [kind for kind in kinds if kind.target.side == "measurement" and (kind.target.stochastic or not kind.target.smooth)]
    seen = np.nanmean([statistics(r.q.astype(float), machine) for r in field], 0)
    plain = np.stack([statistics(r.q.astype(float), machine) for r in reference])  # (P, J, F)
    spread = np.sqrt(np.nanvar(plain, 0, ddof=1) * (1.0 + 1.0 / len(reference)) + BLUR**2)
    none = _likelihood(seen, plain, spread)
    likelihood = {}
    for kind in kinds:
        likelihood[kind.name] = np.stack([_likelihood(seen, _with(kind, s, reference, machine), spread) for s in SIZES])
    gain = {name: np.minimum(values.max(0) - none, MOST) for name, values in likelihood.items()}
    best = [max(gain, key=lambda name: gain[name][j]) for j in range(machine.num_joints)] if gain else []
    found = []
    for kind in kinds:
        mask = np.array([best[j] == kind.name and gain[kind.name][j] > price for j in range(machine.num_joints)])
        worth = float((gain[kind.name][mask] - price).sum()) - name_price
        if worth <= 0:
            continue
        parameters: dict[str, dict[str, Estimate]] = {}
        for j in np.flatnonzero(mask):
            ends = np.array(interval(SIZES, likelihood[kind.name][:, j]))
            for name in kind.fitted:
                mean, low, high = kind.numbers[name].none + kind.size(name) * ends
                parameters.setdefault(name, {})[machine.joint_names[j]] = Estimate(float(mean), (float(low), float(high)))
        rivals = {name: float(gain[name][mask].sum()) for name in gain if name != kind.name}
        fit = np.stack([likelihood[kind.name][:, j].max() for j in np.flatnonzero(mask)])
        closed = float(np.clip(1.0 - np.mean(fit / np.minimum(none[mask], -1e-9)), 0.0, 1.0))
        found.append(Found(kind, mask, parameters, worth, float(gain[kind.name][mask].sum()), closed, rivals))
    return found


def _likelihood(seen: np.ndarray, drawn: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Returns the log likelihood of the field's statistics `(J, F)` where those of the parts `(P, J, F)` are typical, `(J,)`."""
    off = (seen - np.nanmean(drawn, 0)) / spread
    return -0.5 * np.nansum(np.square(off), 1)


def _with(kind: Kind, size: float, reference: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Returns the statistics of the reference with an effect on all joints, `(P, J, F)`."""
    found = []
    for recording in reference:
        q = torch.as_tensor(recording.q, dtype=torch.float32)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            model = kind.wrap(Still(), machine, len(q), torch.device("cpu"))
        for name in kind.fitted:
            value = kind.clipped(name, np.array(kind.numbers[name].none + size * kind.size(name)))
            model.parameters[name].fill_(float(value))
        with torch.inference_mode():
            found.append(statistics(model.measure(q).numpy().astype(float), machine))
    return np.stack(found)
