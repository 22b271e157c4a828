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
from brokk_rl.sim.arm_model import TIP, ArmModel, ModelChoices, normalise_axis
from brokk_rl.sim.model import FASTEST_MODE, compute_inertia, find_fastest_mode
from brokk_rl.sim.model_source import KINDS, UNITS, JointLimits

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


def import_model(path: Path, name: str, choices: ModelChoices | None = None) -> ImportedMachine:
    """Return the machine `name` of a URDF or MJCF.

    Raises:
        ConfigError: The file is missing or invalid, or has no serial chain of hinges and slides.
    """
    return _MachineDescription(path, name, choices or ModelChoices()).read()


class _MachineDescription:
    """Numbers of a machine from an arm of a model."""

    def __init__(self, path: Path, name: str, choices: ModelChoices) -> None:
        self._path, self._name, self._choices = path, name, choices
        self._arm = ArmModel(path, choices)
        self._remarks = self._arm.remarks
        self._guesses: dict[tuple[str, str], list[str]] = {}
        self._drive_name = self._choose_drive()
        self._drive = DRIVES[self._drive_name]

    def read(self) -> ImportedMachine:
        """Return the machine."""
        tool_m = self._arm.find_tool()
        made, mjcf, meshes = self._arm.write(self._name, tool_m)
        self._measure_poses(made)
        joints = [self._describe_joint(row) for row in range(made.nq)]
        for (what, guess), names in self._guesses.items():
            self._remarks.append(
                f"No {what} in {self._path.name} of {', '.join(names)}; {guess} is a guess, measure it."
            )
        self._describe_commands(joints)
        source = self._path.name
        values = {
            "name": self._name,
            "title": f"{self._name}, from {source}",
            "mjcf": f"{self._name}.xml",
            "period_s": self._drive.period_s,
            "dead_time_s": self._drive.dead_time_s,
            "num_history": NUM_HISTORY,
            "joints": joints,
            "tool_m": [_make_dimension(value, source, "high") for value in tool_m],
            "exclusive": [],
            "levers": [],
        }
        self._remarks.append(
            f"The drive counts as {self._drive_name} (subject.drive): its control period ({self._drive.period_s:g} s), "
            f"dead time ({self._drive.dead_time_s:g} s) and stiffness are guesses; mode=identify measures the dead time."
        )
        self._remarks.append(
            "Only the last link touches anything; give other links contype in the MJCF."
        )
        return ImportedMachine(values, mjcf, meshes, self._remarks)

    def _measure_poses(self, made: mujoco.MjModel) -> None:
        """Measure weights and inertias of the arm, its home, and its fastest mode with equal drives."""
        data, generator = mujoco.MjData(made), np.random.default_rng(0)
        lower, upper = np.array([self._get_travel(row) for row in range(made.nq)]).T
        poses = generator.uniform(lower, upper, (NUM_POSES, made.nq))
        poses[0] = self._read_home(lower, upper)
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
        if lowest_m[0] < CLEARANCE_M and lowest_m.max() >= CLEARANCE_M:
            away = (((poses - poses[0]) / (upper - lower)) ** 2).sum(1)
            self._home = poses[np.where(lowest_m >= CLEARANCE_M, away, np.inf).argmin()]
            self._remarks.append(
                "At zero the arm reaches into the ground; home is the nearest of some random poses above it."
            )
        self._inertia = compute_inertia(made, self._home).diagonal()
        self._mode_rad_s, _ = find_fastest_mode(made, self._inertia, poses)

    def _read_home(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the first keyframe of the model, else zero or the middle of the travel, `(J,)`."""
        model, chain = self._arm.model, self._arm.chain
        middle = np.where((lower <= 0.0) & (upper >= 0.0), 0.0, (lower + upper) / 2.0)
        if not model.nkey:
            return middle
        places = model.jnt_qposadr[chain]
        return np.clip(model.key_qpos[0, places] - model.qpos0[places], lower, upper)

    def _get_travel(self, row: int) -> tuple[float, float]:
        """Return the ends of travel of a joint seen from zero; a guess where the model has none."""
        joint = self._arm.chain[row]
        kind = KINDS[int(self._arm.model.jnt_type[joint])]
        zero = float(self._arm.model.qpos0[self._arm.model.jnt_qposadr[joint]])
        if travel := self._get_limits(row).travel:
            return travel[0] - zero, travel[1] - zero
        return GUESSED_TRAVEL[kind]

    def _get_limits(self, row: int) -> JointLimits:
        name = self._arm.model.joint(self._arm.chain[row]).name
        return self._arm.source.limits.get(name, JointLimits())

    def _choose_drive(self) -> str:
        if self._choices.drive != "auto":
            return self._choices.drive
        model, names = self._arm.model, []
        for joint in self._arm.chain:
            link = model.body(int(model.jnt_bodyid[joint])).name
            names.append(f"{model.joint(joint).name} {link}")
        is_named = sum(bool(HYDRAULIC_NAMES.search(name)) for name in names) > 1
        return "hydraulic" if is_named or self._arm.tree.has_cylinders else "electric"

    def _describe_joint(self, row: int) -> dict[str, Any]:
        """Return a joint and its link as plain data."""
        model, joint, source = self._arm.model, self._arm.chain[row], self._path.name
        name, kind = self._arm.names[row], KINDS[int(model.jnt_type[joint])]
        limits = self._get_limits(row)
        lower, upper = self._get_travel(row)
        travel = (source, "low" if limits.is_doubted else "high")
        if not limits.travel:
            travel = (f"guess: {source} has no limits", "low")
            self._guess("limits", name, f"{lower:.4g} to {upper:.4g} {UNITS[kind]}")
        speed = limits.speed or self._drive.speed[kind]
        if not limits.speed:
            self._guess("speed at full command", name, f"{speed:g} {UNITS[kind]}/s")
        force = self._describe_force(row, speed)
        if not limits.effort:
            self._guess("force limit", name, FORCE_GUESS)
        mass_kg, com_m, _ = self._arm.sum_masses(row)
        origin_m = self._arm.anchors[row] - (self._arm.anchors[row - 1] if row else 0.0)
        return {
            "name": name,
            "part": None,
            "kind": kind,
            "lower": _make_dimension(lower, *travel),
            "upper": _make_dimension(upper, *travel),
            "home": float(np.clip(float(f"{self._home[row]:.4g}"), lower, upper)),
            "max_speed": _make_dimension(speed, f"velocity limit in {source}", "medium")
            if limits.speed
            else _make_dimension(speed, "guess", "low"),
            "body": {
                "axis": normalise_axis(self._arm.data.xaxis[joint]),
                "origin_m": [_make_dimension(value, source, "high") for value in origin_m],
                "mass_kg": _make_dimension(mass_kg, source, "medium"),
                "com_m": [round(float(value), 6) for value in com_m],
                "yield_force": force,
                "stiffness": self._describe_stiffness(row),
            },
        }

    def _describe_force(self, row: int, speed: float) -> dict[str, Any]:
        if effort := self._get_limits(row).effort:
            return _make_dimension(effort, f"effort limit in {self._path.name}", "medium")
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
        found = [self._read_command(joint) for joint in self._arm.chain]
        commands = {command for command, _ in found}
        command = self._drive.command
        if self._choices.command != "auto":
            command = self._choices.command
        elif len(commands) == 1 and None not in commands:
            command = str(commands.pop())
            if command == "torque":
                command = "velocity"
                self._remarks.append(
                    "The model's actuators are torques, and a policy commands speeds: command: velocity stands for a "
                    "controller of the joints; subject.command=torque keeps torques, for recordings."
                )
        else:
            self._remarks.append(
                f"command: {command} is a guess; subject.command=… or the machine's file changes it."
            )
        for values, (_, force) in zip(joints, found, strict=True):
            values["command"] = command
            if command == "torque":
                force = force or float(values["body"]["yield_force"]["value"])
                values["max_force"] = _make_dimension(force, self._path.name, "medium")

    def _read_command(self, joint: int) -> tuple[str | None, float]:
        """Return what the actuator of a joint is commanded by, `None` without one, and its force."""
        model = self._arm.model
        for actuator in range(model.nu):
            is_own = model.actuator_trnid[actuator, 0] == joint
            if not is_own or model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
                continue
            stiffness, damping = -model.actuator_biasprm[actuator, 1:3]
            if stiffness > 0:
                return "position", 0.0
            if damping > 0:
                return "velocity", 0.0
            gain = model.actuator_gainprm[actuator, 0] * model.actuator_gear[actuator, 0]
            return "torque", abs(gain) * float(model.actuator_ctrlrange[actuator, 1])
        return None, 0.0

    def _guess(self, what: str, name: str, guess: str) -> None:
        """Note a guess for a joint; one sentence tells of all joints that share it."""
        self._guesses.setdefault((what, guess), []).append(name)


def _make_dimension(value: float, source: str, confidence: str) -> dict[str, Any]:
    return {"value": float(f"{float(value):.6g}"), "source": source, "confidence": confidence}
