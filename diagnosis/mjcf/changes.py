"""Findings of a diagnosis as changes of an MJCF file: each changed element has a comment that names its finding.

A finding is an effect with its numbers by joint. What MJCF has no element for is returned by name.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.session import write_text
from diagnosis.closure import Estimate
from diagnosis.mjcf.plant import MjcfPlant, limit_force_range


@dataclass(frozen=True)
class JointFinding:
    """An effect on one joint.

    Attributes:
        effect: Its name, such as `dead_time`.
        joint: The joint.
        sizes: Size of each number, in its own unit.
    """

    effect: str
    joint: str
    sizes: Mapping[str, Estimate]


@dataclass(frozen=True)
class MjcfChange:
    """A change of one attribute.

    Attributes:
        effect: The finding behind it.
        joint: The joint.
        element: `joint` or `actuator`.
        attribute: Attribute of the element, as in the MJCF reference.
        before: Value in the file as it was.
        after: Value now.
        interval: 95 % interval of the value; `None` where the finding has none.
    """

    effect: str
    joint: str
    element: str
    attribute: str
    before: float
    after: float
    interval: tuple[float, float] | None


class _Editor:
    """One joint and its drive in a spec, with the record of their changes."""

    def __init__(
        self, spec: Any, plant: MjcfPlant, machine: Machine, finding: JointFinding
    ) -> None:
        place = machine.joint_names.index(finding.joint)
        self.finding, self.machine, self.place = finding, machine, place
        self.unit = {name: float(row[place]) for name, row in plant.read_references().items()}
        self.joint = spec.joint(finding.joint)
        self.drive = spec.actuators[int(plant.drives[place])]
        self.is_limited = bool(plant.model.actuator_forcelimited[plant.drives[place]])
        self.timestep_s = float(plant.model.opt.timestep)
        self.changes: list[MjcfChange] = []

    def get(self, number: str) -> float:
        size = self.finding.sizes.get(number)
        return 0.0 if size is None else size.mean

    def write(
        self,
        element: str,
        attribute: str,
        index: int | None,
        number: str,
        rule: Callable[[float, float], float],
    ) -> None:
        """Set an attribute to `rule(before, value)`, where the value is that of a number of the finding."""
        owner = self.joint if element == "joint" else self.drive
        held = getattr(owner, attribute)
        before = float(held if index is None else held[index])
        after = rule(before, self.get(number))
        size = self.finding.sizes.get(number)
        interval = None
        if size is not None and size.has_interval:
            low, high = sorted(rule(before, end) for end in size.ci95)
            interval = (low, high)
        if index is None:
            setattr(owner, attribute, after)
        else:
            row = np.array(held)
            row[index] = after
            setattr(owner, attribute, row)
        name = attribute if index is None else f"{attribute}[{index}]"
        self.changes.append(
            MjcfChange(
                self.finding.effect, self.finding.joint, element, name, before, after, interval
            )  # pyright: ignore[reportArgumentType]
        )


def write_changed_mjcf(
    source: Path, machine: Machine, findings: Sequence[JointFinding], path: Path
) -> tuple[list[MjcfChange], dict[str, str]]:
    """Write the file with its changes; return them, and the reason for each effect that has none.

    Raises:
        ConfigError: The file cannot be used with the machine.
        StorageError: The new file could not be written.
    """
    plant = MjcfPlant(source, machine)
    spec = mujoco.MjSpec.from_file(str(source))
    if spec.meshes:  # seen from the new file's folder
        spec.meshdir = str((source.parent / (spec.meshdir or ".")).resolve())
    if spec.textures:
        spec.texturedir = str((source.parent / (spec.texturedir or ".")).resolve())
    changes, left = [], {}
    for finding in findings:
        rule = RULES.get((finding.effect, machine.interface))
        if rule is None:
            left[finding.effect] = REASONS.get(finding.effect, NO_ELEMENT)
            continue
        editor = _Editor(spec, plant, machine, finding)
        reason = rule(editor)
        if reason:
            left[f"{finding.effect} on {finding.joint}"] = reason
        changes += editor.changes
    spec.compile()
    write_text(path, _comment(spec.to_xml(), source, changes, left))
    return changes, left


def _comment(
    text: str, source: Path, changes: Sequence[MjcfChange], left: Mapping[str, str]
) -> str:
    """Return the file with a comment before each changed element and one at its head."""
    root = ElementTree.fromstring(text)
    for parent in list(root.iter()):
        for child in list(parent):
            named = [one for one in changes if _is_element(child, parent, one)]
            if not named:
                continue
            words = "; ".join(describe_change(one) for one in named)
            parent.insert(list(parent).index(child), ElementTree.Comment(f" {words} "))
    head = [f"{source.name} with the findings of a diagnosis."]
    head += [f"Not in this file: {name}: {reason}" for name, reason in left.items()]
    root.insert(0, ElementTree.Comment(" " + " ".join(head).replace("--", "-") + " "))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _is_element(child: ElementTree.Element, parent: ElementTree.Element, one: MjcfChange) -> bool:
    if one.element == "joint":
        return child.tag == "joint" and child.get("name") == one.joint
    return parent.tag == "actuator" and child.get("joint") == one.joint


def describe_change(one: MjcfChange) -> str:
    """Return a change in words, such as `dead_time: delay 0 to 0.06 [0.05, 0.07]`."""
    ends = "" if one.interval is None else f" [{one.interval[0]:.4g}, {one.interval[1]:.4g}]"
    return f"{one.effect}: {one.attribute} {one.before:.4g} to {one.after:.4g}{ends}"


NO_ELEMENT = "MJCF has no element for it; put it around the simulator (effects.yaml)"
REASONS = {
    "backlash": "MJCF has no play on a target; friction looks alike: frictionloss of half the gap times kp",
    "rate_limit": "MJCF has no limit on the slope of a command; limit it where targets are sent",
    "delay_jitter": "MJCF delays are constant; draw them where commands are sent",
    "frame_loss": "MJCF loses no commands; hold them where they are sent",
    "sensor_noise": "noise belongs where observations are made",
    "quantisation": "it belongs where observations are made",
}
"""Reasons why an effect is no change of the file."""


def _add_friction(to: _Editor) -> None:
    to.write(
        "joint", "frictionloss", None, "part", lambda old, new: old + new * to.unit["friction"]
    )


def _add_damping(to: _Editor) -> str | None:
    index = 0 if np.ndim(to.joint.damping) else None
    held = float(np.ravel(to.joint.damping)[0])
    unit = to.unit["damping"]
    if held + to.get("part") * unit >= 0.0:
        to.write("joint", "damping", index, "part", lambda old, new: old + new * unit)
        return None
    if to.machine.interface == "torque":
        return "less damping than the joint has in the file was found, and the drive has none"
    # A joint has no damping below 0; the drive has the rest of it.
    gear = float(to.drive.gear[0])
    to.write("actuator", "biasprm", 2, "part", lambda old, new: old - new * unit / gear**2)
    return None


def _add_armature(to: _Editor) -> None:
    to.write("joint", "armature", None, "part", lambda old, new: old + new * to.unit["armature"])


def _scale_drive(to: _Editor) -> None:
    to.write("actuator", "gainprm", 0, "gain", lambda old, new: old * new)
    to.write("actuator", "biasprm", 1, "gain", lambda old, new: old * new)
    if to.machine.interface == "speed":
        to.write("actuator", "biasprm", 2, "gain", lambda old, new: old * new)


def _limit_force(to: _Editor) -> str | None:
    shortage = to.get("shortage")
    if shortage <= 0.0:
        return "no limit was found there"
    limited = to.is_limited
    if not limited:  # MJCF: a range of 0 is none
        to.drive.forcerange = np.zeros(2)

    def narrow(side: int) -> Callable[[float, float], float]:
        def rule(old: float, new: float) -> float:
            most = to.unit["limit"] / max(new, 1e-9)
            held = (-np.inf, np.inf) if not limited else (old, old)
            return float(limit_force_range(held, most)[side])

        return rule

    for side in (0, 1):
        held = float(to.drive.forcerange[side])
        if not limited or narrow(side)(held, shortage) != held:
            to.write("actuator", "forcerange", side, "shortage", narrow(side))
    to.drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    return None


def _scale_command(to: _Editor) -> None:
    to.write("actuator", "gainprm", 0, "gain", lambda old, new: old * new)


def _add_delay(to: _Editor) -> str | None:
    if to.get("dead_time_s") < 0.0:
        return "the machine answers sooner than the file; lower its own delay"
    to.write("actuator", "delay", None, "dead_time_s", lambda old, new: old + max(0.0, new))
    to.drive.nsample = max(to.drive.nsample, math.ceil(to.drive.delay / to.timestep_s) + 2)
    to.drive.interp = 1  # a delay that is no multiple of the time step would be rounded up
    return None


def _add_lag(to: _Editor) -> str | None:
    if to.drive.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return "the drive has dynamics of its own; raise its time constant"
    to.drive.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    to.drive.dynprm = np.zeros_like(to.drive.dynprm)
    # The effect holds each period's last value, half a period ahead of a continuous filter.
    ahead_s = 0.5 * to.machine.period_s
    to.write(
        "actuator",
        "dynprm",
        0,
        "time_constant_s",
        lambda old, new: max(new - ahead_s, to.timestep_s),
    )
    return None


def _add_sag(to: _Editor) -> str | None:
    if "load_rad" in to.finding.sizes:
        return "the sag follows the weight; lower kp instead"
    lower, upper = (limit[to.place] for limit in (to.machine.lower, to.machine.upper))
    stiffness = float(to.drive.gainprm[0])
    gear = float(to.drive.gear[0])
    middle = 0.5 * (lower + upper) * gear * stiffness * to.get("sag_slope")
    to.write(
        "actuator", "biasprm", 0, "sag_rad", lambda old, new: old + middle - stiffness * gear * new
    )
    to.write("actuator", "gainprm", 0, "sag_slope", lambda old, new: old * (1.0 - new))
    return None


RULES: Mapping[tuple[str, str], Callable[[_Editor], str | None]] = {
    ("flow_gain", "speed"): _scale_command,
    ("lag", "position"): _add_lag,
    ("lag", "torque"): _add_lag,
    ("sag", "position"): _add_sag,
    **{("joint_friction", kind): _add_friction for kind in ("speed", "position", "torque")},
    **{("joint_damping", kind): _add_damping for kind in ("speed", "position", "torque")},
    **{("joint_armature", kind): _add_armature for kind in ("speed", "position", "torque")},
    **{("drive_gain", kind): _scale_drive for kind in ("speed", "position", "torque")},
    **{("drive_limit", kind): _limit_force for kind in ("speed", "position", "torque")},
    **{("dead_time", kind): _add_delay for kind in ("speed", "position", "torque")},
}
"""Change of the file for an effect on machines of an interface."""
