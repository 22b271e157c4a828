"""Fit of `actuators.models.valve` in seconds: dead time, play and lags by a search, the rest linear.

`SpeedData` solves for curves, pose and pump at given dead times, plays and lags, which are searched
joint by joint.
"""

import dataclasses
import json
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import yaml
from scipy.optimize import least_squares

from actuators.identify.speed_data import PLAYS, SpeedData
from actuators.models.valve import ValveActuator
from brokk_rl.errors import StorageError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.progress import ItemProgress
from brokk_rl.record import Recording
from brokk_rl.session import write_text
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
        # through JSON, which makes lists of tuples as YAML wants them
        facts = json.loads(json.dumps(dataclasses.asdict(fitted)))  # pyright: ignore[reportArgumentType]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            text = yaml.safe_dump(
                {"_target_": f"{ValveActuator.__module__}.{ValveActuator.__name__}", **facts},
                sort_keys=False,
                width=130,
            )
            write_text(
                folder / f"{self.name}.yaml",
                f"# fitted to {len(data.recordings)} recordings of {machine.name}\n{text}",
            )
        except OSError as error:
            raise StorageError(f"cannot write into {folder}: {error.strerror or error}") from error
        return fitted

    def refit(
        self, fitted: ValveActuator, machine: Machine, recordings: Sequence[Recording]
    ) -> ValveActuator:
        """Return `fitted` with curves, pose and pump refitted; the dynamics stay."""
        columns = [getattr(fitted, name) for name in ("dead_time_s", "play", "spool_s", "speed_s")]
        by_joint = []
        for name in machine.joint_names:
            by_joint.append([column[name] for column in columns])
        dynamics = np.array(by_joint)
        assert isinstance(fitted.demand, dict), "a fitted actuator has numbers by joint"
        demand = np.array([fitted.demand[name] for name in machine.joint_names])
        data = SpeedData(recordings, machine, np.array(self.actuator.knots))
        data.check_motion()
        return self._spec(data, dynamics, demand)

    def _spec(
        self, data: SpeedData, dynamics: np.ndarray, demand: np.ndarray | None = None
    ) -> ValveActuator:
        found = data.statics(
            dynamics, self.sweeps if demand is None else max(1, self.sweeps // 2), demand
        )
        names, half = data.machine.joint_names, len(self.actuator.knots) - 1

        def table(values: np.ndarray) -> dict[str, float]:
            return {name: float(f"{value:.5g}") for name, value in zip(names, values, strict=True)}

        def rows(values: np.ndarray) -> dict[str, tuple[float, ...]]:
            rounded = {}
            for name, row in zip(names, values, strict=True):
                rounded[name] = tuple(float(f"{v:.5g}") for v in row)
            return rounded

        zero = np.zeros((len(names), 1))
        return dataclasses.replace(  # pyright: ignore[reportArgumentType]
            self.actuator,  # pyright: ignore[reportArgumentType]
            dead_time_s=table(dynamics[:, 0]),
            play=table(dynamics[:, 1]),
            spool_s=table(dynamics[:, 2]),
            speed_s=table(dynamics[:, 3]),
            demand=table(found.demand),
            curve_extend=rows(np.hstack([zero, np.maximum(found.curve[:, :half], 0.0)])),
            curve_retract=rows(np.hstack([zero, np.maximum(found.curve[:, half:], 0.0)])),
            pose_extend=rows(found.pose[:, 0]),
            pose_retract=rows(found.pose[:, 1]),
        )


def fit_all_dynamics(
    data: SpeedData,
    known: Sequence[Sequence[np.ndarray]] | None,
    start: np.ndarray | None,
    longest_lag_s: float,
    iterations: int,
    joints: Sequence[int] | None = None,
) -> np.ndarray:
    """Return the dynamics of all `joints`, 0 for others, `(J, 4)`; arguments as in `fit_dynamics`."""
    joints = range(data.machine.num_joints) if joints is None else joints
    found = np.zeros((data.machine.num_joints, NUM_DYNAMICS))

    def fit(j: int) -> np.ndarray:
        factors, begin = known[j] if known else None, None if start is None else start[j]
        return fit_dynamics(data, j, factors, begin, longest_lag_s, iterations)

    for j, row in zip(joints, map_parallel(fit, joints), strict=True):
        found[j] = row
    return found


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
        features, way = data.features(j, x, known)[data.known], data.way[j][data.known]
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
