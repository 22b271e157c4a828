"""Fit of `actuators.models.valve` in seconds: dead time, play and lags by a search, the rest linear.

`SpeedData` solves for curves, pose and pump at given dead times, plays and lags, which are searched
joint by joint.
"""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares

from actuators.identify.option_file import round_by_joint, write_option
from actuators.identify.speed_data import PLAYS, SpeedData
from actuators.models.valve import ValveActuator
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.progress import ItemProgress
from brokk_rl.record import Recording
from brokk_rl.spec import Count, Positive, spec

log = logging.getLogger(__name__)

NUM_DYNAMICS = 4
"""Dead time, play, lag of the valve, lag of the speed."""


@spec
class ValveFit:
    """Fits the valve curve and all other numbers of `actuator=valve`.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`, an option
            for `actuator=@…`.
        actuator: The model; its knots are kept.
        longest_lag_s: Upper bound of each lag.
        sweeps: Turns of curve, pose and pump.
        iterations: Steps of each of the two searches for dead time, play and lags, joint by joint;
            the second knows pose and pump.
    """

    name: str
    actuator: ValveActuator
    longest_lag_s: Positive
    sweeps: Count
    iterations: Count

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> ValveActuator:
        """Fit to all recordings and write `<name>.yaml` into `folder`; validation chooses nothing.

        Raises:
            RecordingError: a joint never moves.
            StorageError: the file could not be written.
        """
        del seed, device  # deterministic, numpy
        data = SpeedData([*train, *validation], machine, np.array(self.actuator.knots))
        data.check_motion()
        dynamics = np.zeros((machine.num_joints, NUM_DYNAMICS))
        with ItemProgress(f"{self.name}: dead times and lags", 2) as progress:
            known: list[list[np.ndarray]] | None = None
            limits = (self.longest_lag_s, self.iterations)
            for turn in range(2):
                if turn:
                    known = data.factors(data.statics(dynamics, self.sweeps), dynamics)
                dynamics = fit_all_dynamics(data, known, dynamics if turn else None, *limits)
                progress.advance()
        fitted = self._spec(data, dynamics)
        comment = f"fitted to {len(data.recordings)} recordings of {machine.name}"
        write_option(folder, self.name, fitted, comment)
        return fitted

    def _spec(self, data: SpeedData, dynamics: np.ndarray) -> ValveActuator:
        found = data.statics(dynamics, self.sweeps)
        machine, half = data.machine, len(self.actuator.knots) - 1
        curve = np.insert(np.maximum(found.curve, 0.0), [0, half], 0.0, axis=1)
        columns = {
            "dead_time_s": dynamics[:, 0],
            "play": dynamics[:, 1],
            "spool_s": dynamics[:, 2],
            "speed_s": dynamics[:, 3],
            "demand": found.demand,
            "curve_extend": curve[:, : half + 1],
            "curve_retract": curve[:, half + 1 :],
            "pose_extend": found.pose[:, 0],
            "pose_retract": found.pose[:, 1],
        }
        numbers = {name: round_by_joint(machine, column) for name, column in columns.items()}
        return dataclasses.replace(self.actuator, **numbers)  # pyright: ignore[reportArgumentType]


def fit_all_dynamics(
    data: SpeedData,
    known: Sequence[Sequence[np.ndarray]] | None,
    start: np.ndarray | None,
    longest_lag_s: float,
    iterations: int,
) -> np.ndarray:
    """Return the dynamics of all joints, `(J, 4)`; arguments as in `fit_dynamics`."""

    def fit(j: int) -> np.ndarray:
        factors, begin = known[j] if known else None, None if start is None else start[j]
        return fit_dynamics(data, j, factors, begin, longest_lag_s, iterations)

    return np.stack(list(map_parallel(fit, range(data.machine.num_joints))))


def fit_dynamics(
    data: SpeedData,
    j: int,
    known: Sequence[np.ndarray] | None,
    start: np.ndarray | None,
    longest_lag_s: float,
    iterations: int,
) -> np.ndarray:
    """Return the dead time, play, spool lag and speed lag that explain joint `j` best, `(4,)`.

    Args:
        data: The recordings.
        j: The joint.
        known: Factor on the speed, from pose and pump, of each recording; `None` while they are
            not known.
        start: Where the search begins; `None`: at the best dead time.
        longest_lag_s: Upper bound of each lag.
        iterations: Steps of the search.
    """
    machine = data.machine
    longest_s = (machine.num_history - 2) * machine.period_s
    most = np.array([longest_s, PLAYS[-1], longest_lag_s, longest_lag_s])

    def left(x: np.ndarray) -> np.ndarray:
        features, way = data.features(j, x, known), data.way[j]
        return (way - features @ data.curve(features, way)) / np.sqrt(data.scale[j])

    if start is None:
        delays = np.arange(0.0, most[0] + 1e-9, machine.period_s)
        losses = []
        for delay in delays:
            losses.append(float(np.square(left(np.array([delay, 0.01, 0.04, 0.0]))).sum()))
        start = np.array([delays[int(np.argmin(losses))], 0.02, 0.03, 0.02])
    inside = np.clip(start, 1e-6, most - 1e-6)
    step = np.array([0.1, 0.3, 0.3, 0.3])  # of `x_scale`: above the grain of the samples
    return least_squares(
        left,
        inside,
        bounds=(np.zeros(4), most),
        x_scale=np.array([0.02, 0.02, 0.02, 0.02]),
        diff_step=0.02 * step / np.maximum(inside, 1e-3) * 0.5,
        loss="soft_l1",
        f_scale=0.05,
        max_nfev=iterations,
    ).x
