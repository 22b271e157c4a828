"""Inverse dynamics of joints commanded by force: mass, friction and offset by least squares.

The force is linear in mass, viscous and Coulomb friction and offset. Accelerations and speeds are
derivatives of the positions after a low-pass filter without phase; force and regressors then go through a
second one, the same for both, as in Gautier, Janot and Vandanjon, "A New Closed-Loop Output Error Method for
Parameter Identification of Robot Dynamics", 2013, section II. A logged force is averaged over each period.
Other terms are tried beside these four, see `actuators.identify.drive_regression`.
"""

import numpy as np
import torch

from actuators.contracts import FitTask
from actuators.identify.drive_regression import TERMS, DriveMotion, filter_low_pass, fit_drive
from actuators.identify.option_file import write_numbers
from actuators.models.force_drive import ForceDrive
from actuators.models.friction import STRIBECK_SPEED
from actuators.models.parameters import expand_per_joint
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import Positive, spec

EDGE_S = 0.3
"""Time at either end of a recording that is left out: filters begin and end there."""
STANDSTILL = 0.01
"""Speed over the machine's `max_speed` below which a joint counts as standing."""


@spec
class ForceFit:
    """Fits `actuator=force` by inverse dynamics.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`.
        actuator: The model; its dead time is kept.
        motion_hz: Cut-off of the filter on positions, above what the joint can do.
        force_hz: Cut-off of the filter on force and regressors; rows are kept at twice its rate.
        terms: Terms that may be taken beside mass, viscous and Coulomb friction and offset, of
            `drive_regression.TERMS`.
    """

    name: str
    actuator: ForceDrive
    motion_hz: float
    force_hz: Positive
    terms: tuple[str, ...]

    def check(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise ConfigError(f"terms: '{term}' is no term; {list_choices(term, TERMS)}")
        if self.force_hz > self.motion_hz:
            raise ConfigError(
                f"force_hz: expected motion_hz={self.motion_hz} or less, got {self.force_hz}"
            )

    def fit(self, task: FitTask) -> ForceDrive:
        """Fit to all recordings; write `<name>.yaml` and `<name>.json` with standard errors.

        Raises:
            ConfigError: the machine is not commanded by torque, or sampled too slowly.
            RecordingError: the recordings are too short, or a joint never moves.
            StorageError: a file could not be written.
        """
        machine = task.machine
        if machine.interface != "torque":
            raise ConfigError(
                f"fit={self.name}: machine '{machine.name}' is commanded by {machine.interface}, not by torque"
            )
        if self.motion_hz >= 0.45 / machine.period_s:
            raise ConfigError(
                f"fit.motion_hz: {self.motion_hz:g} Hz cannot be filtered at a period of {machine.period_s:g} s; lower it"
            )
        self.actuator.build(machine, 1, torch.device("cpu"))  # refuses numbers that make no sense
        given = self.actuator.dead_time_s
        delays_s = expand_per_joint(
            machine.dead_time_s if given is None else given, machine, "fit.actuator.dead_time_s"
        )
        least = 4 * round(EDGE_S / machine.period_s)
        long = [one for one in task.recordings if one.num_samples >= least]
        found = {}
        for j, joint in enumerate(machine.joint_names):
            motions = [self._read_motion(machine, one, j, delays_s[j]) for one in long]
            found[joint] = fit_drive(machine, j, motions, self.terms)
        tried = {joint: one.tried for joint, one in found.items()}
        numbers, errors = {}, {}
        for name in dict.fromkeys(key for one in found.values() for key in one.value):
            # joints that lack a term of another one
            off = STRIBECK_SPEED * machine.max_speed * (name == "stribeck_m_s")
            pairs = zip(found.values(), off, strict=True)
            numbers[name] = np.array([one.value.get(name, none) for one, none in pairs])
            errors[name] = np.array([one.error.get(name, np.nan) for one in found.values()])
        return write_numbers(
            task.folder, self.name, self.actuator, machine, numbers, errors, terms=tried
        )

    def _read_motion(
        self, machine: Machine, recording: Recording, j: int, delay_s: float
    ) -> DriveMotion:
        """Return the motion of joint `j` in a recording."""
        period_s = machine.period_s
        q = filter_low_pass(recording.q[:, j].astype(float), 4, self.motion_hz, period_s)
        force = filter_low_pass(recording.u[:, j].astype(float), 4, self.motion_hz, period_s)
        rows = np.arange(len(q))
        # A command that is held over a period acts at its middle.
        force = np.interp(rows, rows + 0.5 + delay_s / period_s, force * machine.max_force[j])
        speed = np.gradient(q, period_s)
        edge = round(EDGE_S / period_s)
        moves = np.abs(speed) > STANDSTILL * machine.max_speed[j]
        acceleration = np.gradient(speed, period_s)
        return DriveMotion(q, speed, acceleration, force, self.force_hz, period_s, edge, moves)
