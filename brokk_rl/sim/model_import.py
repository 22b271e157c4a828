"""A machine and its MJCF from the URDF or MJCF of an arm: limits, drives and guesses."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from brokk_rl.machine import Machine
from brokk_rl.sim.arm_model import LEAST_KG, TIP, ArmModel, normalise_axis
from brokk_rl.sim.check_subject import CheckSubject
from brokk_rl.sim.model import FASTEST_MODE, compute_inertia, find_fastest_mode
from brokk_rl.sim.model_source import KINDS, UNITS

HYDRAULIC_NAMES = re.compile("boom|stick|bucket|dipper|cylinder", re.IGNORECASE)
"""Names of joints and links of machines that are moved by cylinders."""
NUM_POSES = 512
"""Random poses in which weights and the fastest mode are looked for."""
SUBSTEPS = 5
"""Substeps of a control period, as in `sim=native`."""
GUESSED_TRAVEL = {"hinge": (-math.pi, math.pi), "slide": (-1.0, 1.0)}
"""Ends of travel where the file has none, rad and m: one turn, and the length of an arm."""
CLEARANCE_M = 0.02
"""Height of all that touches above the ground at home."""


@dataclass(frozen=True)
class DriveGuess:
    """Numbers of a drive of which nothing is measured.

    Attributes:
        command: What commands set.
        period_s: Control period.
        dead_time_s: From command to first motion.
        speed: Speed at full command where the file has none, rad/s and m/s.
        mode_hz: First mode of the drive that holds the joint.
        mode_source: Its source.
    """

    command: str
    period_s: float
    dead_time_s: float
    speed: dict[str, float]
    mode_hz: float
    mode_source: str


DRIVES = {
    # the paper's 20 Hz and two periods of dead time; speeds and mode between those of `brokk170`
    "hydraulic": DriveGuess(
        "valve", 0.05, 0.1, {"hinge": 0.3, "slide": 0.1}, 6.0, "closed cylinder"
    ),
    # servo drives that follow a speed within a few milliseconds; 1 rad/s is the collaborative speed of arms
    "electric": DriveGuess("velocity", 0.02, 0.02, {"hinge": 1.0, "slide": 0.25}, 15.0, "servo"),
}
NUM_HISTORY = 5
"""Samples of history: twice the dead time and more."""
FORCE_GUESS = "three times the largest weight, and full speed within 0.1 s"
YIELD_FACTOR, ACCELERATION_S = 3.0, 0.1
"""Guessed yield force: this multiple of the largest weight, as in `brokk170`, and the torque that
reaches full speed in this time, s."""


@dataclass(frozen=True)
class ImportedMachine:
    """A machine from a model file.

    Attributes:
        values: The machine as plain data: its fields, without classes.
        mjcf: Text of its MJCF.
        meshes: Files beside the MJCF, by their path from it.
        remarks: Guesses and simplifications, one sentence each.
    """

    values: dict[str, Any]
    mjcf: str
    meshes: dict[str, bytes]
    remarks: list[str]

    def build(self) -> Machine:
        """Return the machine."""
        return Machine(**self.values)

    def format_yaml(self) -> str:
        """Return the text of the machine's file."""
        values = {"_target_": "brokk_rl.machine.Machine"} | self.values
        text = yaml.safe_dump(values, sort_keys=False, width=160, default_flow_style=None)
        return f"# {self.values['title']}.\n{text}"


def import_model(path: Path, name: str, choices: CheckSubject) -> ImportedMachine:
    """Return the machine `name` of a URDF or MJCF.

    Raises:
        ConfigError: The file is missing or invalid, or has no serial chain of hinges and slides.
    """
    return _MachineDescription(path, name, choices).read()


class _MachineDescription:
    """Numbers of a machine from an arm of a model."""

    def __init__(self, path: Path, name: str, choices: CheckSubject) -> None:
        self._file, self._name, self._choices = path.name, name, choices
        self._arm = ArmModel(path, name, choices)
        self._made, self._source = self._arm.model, self._arm.source
        self._model, self._joints = self._source.model, self._arm.joints
        self._travel = np.array([self._read_travel(row) for row in range(self._made.nq)])
        self._drive_name = self._choose_drive()
        self._drive = DRIVES[self._drive_name]

    def read(self) -> ImportedMachine:
        """Return the machine."""
        self._measure_poses()
        joints = [self._describe_joint(row) for row in range(self._made.nq)]
        self._describe_commands(joints)
        values = {
            "name": self._name,
            "title": f"{self._name}, from {self._file}",
            "mjcf": f"{self._name}.xml",
            "period_s": self._drive.period_s,
            "dead_time_s": self._drive.dead_time_s,
            "num_history": NUM_HISTORY,
            "joints": joints,
            "tool_m": self._describe_place(self._made.site(TIP).pos),
            "exclusive": [],
            "levers": [],
        }
        self._source.remark(
            f"The drive counts as {self._drive_name} (subject.drive): its control period ({self._drive.period_s:g} s), "
            f"dead time ({self._drive.dead_time_s:g} s) and stiffness are guesses; mode=identify measures the dead time."
        )
        self._source.remark(
            "Only the last link touches anything; give other links contype in the MJCF."
        )
        return ImportedMachine(values, self._arm.mjcf, self._arm.meshes, self._source.remarks)

    def _measure_poses(self) -> None:
        """Measure weights and inertias of the arm, its home, and its fastest mode with equal drives."""
        made = self._made
        data, generator = mujoco.MjData(made), np.random.default_rng(0)
        lower, upper = self._travel.T
        poses = generator.uniform(lower, upper, (NUM_POSES, made.nq))
        poses[0] = self._read_home()
        lowest_m = np.zeros(len(poses))
        self._weights = np.zeros(made.nv)
        touching = np.flatnonzero(made.geom_contype)
        for number, pose in enumerate(poses):
            data.qpos[:] = pose
            mujoco.mj_forward(made, data)
            self._weights = np.maximum(self._weights, np.abs(data.qfrc_bias))
            bottom_m = data.geom_xpos[touching, 2] - made.geom_rbound[touching]
            lowest_m[number] = min(*data.xpos[1:, 2], data.site(TIP).xpos[2], *bottom_m)
        self._home = poses[0]
        if lowest_m.max() < CLEARANCE_M:
            self._source.remark(
                "No pose lies above the ground, z = 0: raise the base of the robot."
            )
        elif lowest_m[0] < CLEARANCE_M:
            away = (((poses - poses[0]) / (upper - lower)) ** 2).sum(1)
            self._home = poses[np.where(lowest_m >= CLEARANCE_M, away, np.inf).argmin()]
            self._source.remark(
                "At zero the arm reaches into the ground; home is the nearest of some random poses above it."
            )
        self._inertia = compute_inertia(made, self._home).diagonal()
        carried_kg = made.body_mass[:0:-1].cumsum()[::-1]
        for row in np.flatnonzero(carried_kg < LEAST_KG):
            raise self._source.refuse(
                f"nothing that joint '{made.joint(row).name}' moves has a mass; give its link an <inertial>"
            )
        self._mode_rad_s, _ = find_fastest_mode(made, self._inertia, poses)

    def _read_home(self) -> np.ndarray:
        """Return the first keyframe of the model, else zero or the middle of the travel, `(J,)`."""
        model, (lower, upper) = self._model, self._travel.T
        if not model.nkey:
            return np.where((lower <= 0.0) & (upper >= 0.0), 0.0, (lower + upper) / 2.0)
        places = model.jnt_qposadr[self._joints]
        return np.clip(model.key_qpos[0, places] - model.qpos0[places], lower, upper)

    def _read_travel(self, row: int) -> tuple[float, float]:
        """Return the ends of travel of a joint seen from zero; a guess where the model has none."""
        model, joint = self._model, self._joints[row]
        kind = KINDS[int(model.jnt_type[joint])]
        if model.jnt_limited[joint]:
            lower, upper = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]
            return float(lower), float(upper)
        lower, upper = GUESSED_TRAVEL[kind]
        self._guess("limits", row, f"{lower:.4g} to {upper:.4g} {UNITS[kind]}")
        return lower, upper

    def _choose_drive(self) -> str:
        if self._choices.drive != "auto":
            return self._choices.drive
        num_named = 0
        for joint in self._joints:
            link = self._model.body(int(self._model.jnt_bodyid[joint])).name
            num_named += bool(HYDRAULIC_NAMES.search(f"{self._model.joint(joint).name} {link}"))
        return "hydraulic" if num_named > 1 or self._arm.tree.has_cylinders else "electric"

    def _describe_joint(self, row: int) -> dict[str, Any]:
        """Return a joint and its link as plain data."""
        made, source, joint = self._made, self._source, self._joints[row]
        name, kind = made.joint(row).name, KINDS[int(made.jnt_type[row])]
        lower, upper = self._travel[row]
        travel = (self._file, "low" if joint in source.doubted else "high")
        if not self._model.jnt_limited[joint]:
            travel = (f"guess: {self._file} has no limits", "low")
        speed = source.speeds.get(self._model.joint(joint).name)
        max_speed = (f"velocity limit in {self._file}", "medium")
        if not speed:
            speed, max_speed = self._drive.speed[kind], ("guess", "low")
            self._guess("speed at full command", row, f"{speed:g} {UNITS[kind]}/s")
        return {
            "name": name,
            "part": None,
            "kind": kind,
            "lower": _make_dimension(lower, *travel),
            "upper": _make_dimension(upper, *travel),
            "home": float(np.clip(float(f"{self._home[row]:.4g}"), lower, upper)),
            "max_speed": _make_dimension(speed, *max_speed),
            "body": {
                "axis": normalise_axis(made.jnt_axis[row]),
                "origin_m": self._describe_place(made.body_pos[row + 1]),
                "mass_kg": _make_dimension(made.body_mass[row + 1], self._file, "medium"),
                "com_m": [round(float(value), 6) for value in made.body_ipos[row + 1]],
                "yield_force": self._describe_force(row, speed),
                "stiffness": self._describe_stiffness(row),
            },
        }

    def _describe_place(self, place_m: np.ndarray) -> list[dict[str, Any]]:
        return [_make_dimension(value, self._file, "high") for value in place_m]

    def _describe_force(self, row: int, speed: float) -> dict[str, Any]:
        effort = self._read_effort(self._joints[row])
        if effort:
            return _make_dimension(effort, f"effort limit in {self._file}", "medium")
        self._guess("force limit", row, FORCE_GUESS)
        weight = YIELD_FACTOR * self._weights[row]
        force = max(weight + self._inertia[row] * speed / ACCELERATION_S, 1.0)
        return _make_dimension(force, f"guess: {FORCE_GUESS}", "low")

    def _describe_stiffness(self, row: int) -> dict[str, Any]:
        """Return a stiffness with which the coupled joints stay calm in a substep."""
        wanted = 2.0 * math.pi * self._drive.mode_hz
        calm = FASTEST_MODE * SUBSTEPS / (self._drive.period_s * self._mode_rad_s)
        mode = min(wanted, calm)
        source = (
            f"guess: first mode of the {self._drive.mode_source} at {mode / (2 * math.pi):.3g} Hz"
        )
        return _make_dimension(mode**2 * float(self._inertia[row]), source, "low")

    def _describe_commands(self, joints: list[dict[str, Any]]) -> None:
        """Add `command` to each joint: as asked, else that of the actuators, else of the drive."""
        found = {self._read_command(joint) for joint in self._joints}
        command = self._drive.command
        if self._choices.command != "auto":
            command = self._choices.command
        elif found == {"torque"}:
            command = "velocity"
            self._source.remark(
                "The model's actuators are torques, and a policy commands speeds: command: velocity stands for a "
                "controller of the joints; subject.command=torque keeps torques, for recordings."
            )
        elif len(found) == 1 and None not in found:
            command = str(found.pop())
        else:
            self._source.remark(
                f"command: {command} is a guess; subject.command=… or the machine's file changes it."
            )
        for joint in joints:
            joint["command"] = command
            if command == "torque":
                joint["max_force"] = joint["body"]["yield_force"]

    def _find_actuator(self, joint: int) -> int | None:
        """Return the actuator of a joint."""
        is_own = self._model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        is_own &= self._model.actuator_trnid[:, 0] == joint
        return int(is_own.argmax()) if is_own.any() else None

    def _read_command(self, joint: int) -> str | None:
        """Return what the actuator of a joint is commanded by."""
        actuator = self._find_actuator(joint)
        if actuator is None:
            return None
        stiffness, damping = -self._model.actuator_biasprm[actuator, 1:3]
        if stiffness > 0:
            return "position"
        return "velocity" if damping > 0 else "torque"

    def _read_effort(self, joint: int) -> float:
        """Return the force limit of a joint, of its drive, or of a motor at full command; 0 without one."""
        model, actuator = self._model, self._find_actuator(joint)
        if model.jnt_actfrclimited[joint]:
            return float(model.jnt_actfrcrange[joint, 1])
        if actuator is None:
            return 0.0
        gear = abs(float(model.actuator_gear[actuator, 0]))
        if model.actuator_forcelimited[actuator]:
            return gear * float(model.actuator_forcerange[actuator, 1])
        if self._read_command(joint) != "torque" or not model.actuator_ctrllimited[actuator]:
            return 0.0
        full = gear * model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator]
        return float(np.abs(full).max())

    def _guess(self, what: str, row: int, guess: str) -> None:
        self._source.note(
            self._made.joint(row).name, f"no {what} in the file; {guess} is a guess, measure it."
        )


def _make_dimension(value: float, source: str, confidence: str) -> dict[str, Any]:
    return {"value": float(f"{float(value):.6g}"), "source": source, "confidence": confidence}
