"""Findings of a diagnosis as changes of an MJCF file: each changed element has a comment that names its finding.

What MJCF has no element for is returned by name.
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

from actuators.effects.simulator import EFFECTS
from brokk_rl.machine import Machine
from brokk_rl.session import write_text
from diagnosis.answer import Selected
from diagnosis.mjcf.plant import MjcfPlant

Rule = Callable[[float, float], float]
"""Returns a number of the file by the number that it was and that of a finding."""
Searched = dict[str, np.ndarray]
"""Changes of a plant, as `MjcfPlant.change_model` takes them."""


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
    """One joint and its drive in a spec, with the record of their changes.

    Args:
        spec: The file.
        plant: The same, compiled.
        finding: What is put into the file.
        joint: Where.
        searched: Changes of the plant by earlier findings, as `MjcfPlant.change_model` takes them.
    """

    def __init__(
        self, spec: Any, plant: MjcfPlant, finding: Selected, joint: str, searched: Searched
    ) -> None:
        self.plant, self.machine = plant, plant.machine
        self.finding, self.searched = finding, searched
        self.place = self.machine.joint_names.index(joint)
        self.joint = spec.joint(joint)
        self.drive = spec.actuators[int(plant.drives[self.place])]
        self.changes: list[MjcfChange] = []

    def list_sizes(self, number: str) -> list[float]:
        """Return a number of the finding and the ends of its interval, if it has one."""
        size = self.finding.parameters.get(number, {}).get(self.joint.name)
        if size is None:
            return [0.0]
        return [size.mean, *(size.ci95 if size.has_interval else ())]

    def read(self, model: mujoco.MjModel, element: str, attribute: str, index: int) -> float:
        """Return an attribute of the joint or its drive in a compiled model."""
        if element == "joint":
            values = getattr(model, f"dof_{attribute}")[self.plant.dofs[self.place]]
        else:
            values = getattr(model, f"actuator_{attribute}")[self.plant.drives[self.place]]
        return float(np.ravel(values)[index])

    def put(self, element: str, attribute: str, index: int, values: Sequence[float]) -> None:
        """Set an attribute to the first of some values; the others are those at the ends of the interval."""
        owner = self.joint if element == "joint" else self.drive
        held = np.array(getattr(owner, attribute), dtype=float)
        row = np.atleast_1d(held.copy())
        before, row[index] = float(row[index]), values[0]
        setattr(owner, attribute, row if held.ndim else float(row[0]))
        name = f"{attribute}[{index}]" if held.ndim else attribute
        interval = (min(values[1:]), max(values[1:])) if len(values) > 1 else None
        told = (self.finding.effect, self.joint.name, element, name)
        self.changes.append(MjcfChange(*told, before, float(values[0]), interval))

    def write(self, attribute: str, index: int, number: str, rule: Rule) -> None:
        """Set an attribute of the drive to `rule(before, value)`, with the value of a number of the finding."""
        before = float(np.ravel(getattr(self.drive, attribute))[index])
        values = [rule(before, one) for one in self.list_sizes(number)]
        self.put("actuator", attribute, index, values)


def write_changed_mjcf(
    source: Path, machine: Machine, findings: Sequence[Selected], path: Path
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
    searched: Searched = {}
    # Effects inside of the file come first: the others act on a joint that has them.
    for finding in sorted(findings, key=lambda one: one.effect not in EFFECTS):
        rule, interface = RULES.get(finding.effect), machine.interface
        if rule is None or interface not in INTERFACES.get(finding.effect, (interface,)):
            left[finding.effect] = REASONS.get(finding.effect, NO_ELEMENT)
            continue
        for joint in finding.joints or machine.joint_names:
            editor = _Editor(spec, plant, finding, joint, searched)
            if reason := rule(editor):
                left[f"{finding.effect} on {joint}"] = reason
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
            key = (child.tag, child.get("name"))
            if parent.tag == "actuator":
                key = ("actuator", child.get("joint"))
            named = [one for one in changes if (one.element, one.joint) == key]
            if not named:
                continue
            words = "; ".join(describe_change(one) for one in named)
            parent.insert(list(parent).index(child), ElementTree.Comment(f" {words} "))
    head = [f"{source.name} with the findings of a diagnosis."]
    head += [f"Not in this file: {name}: {reason}" for name, reason in left.items()]
    root.insert(0, ElementTree.Comment(" " + " ".join(head).replace("--", "-") + " "))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


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
SEARCHED = (
    ("joint", "frictionloss", 0), ("joint", "damping", 0), ("joint", "armature", 0), ("actuator", "gainprm", 0),
    ("actuator", "biasprm", 1), ("actuator", "biasprm", 2), ("actuator", "forcerange", 0), ("actuator", "forcerange", 1),
)  # fmt: skip
"""Attributes that `MjcfPlant.change_model` changes: element, name and place."""


def _change_as_in_search(to: _Editor) -> str | None:
    """Take over what the effect changed in the model that the search simulated."""
    kind = EFFECTS[to.finding.effect]
    ((number, quantity),) = kind.drives.items()
    neutral = np.full(to.machine.num_joints, kind.numbers[number].none)
    trials = []
    for size in to.list_sizes(number):
        row = to.searched.get(quantity, neutral).copy()
        row[to.place] = size
        trials.append({**to.searched, quantity: row})
    before = to.plant.change_model(to.searched)
    models = [to.plant.change_model(trial) for trial in trials]
    to.searched.update(trials[0])
    for element, attribute, index in SEARCHED:
        values = [to.read(one, element, attribute, index) for one in models]
        if values[0] != to.read(before, element, attribute, index):
            to.put(element, attribute, index, values)
    if not to.changes:
        return "its size changes no number of the file"
    if quantity == "limit":
        to.drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    return None


def _scale_command(to: _Editor) -> None:
    to.write("gainprm", 0, "gain", lambda old, new: old * new)


def _add_delay(to: _Editor) -> str | None:
    if to.list_sizes("dead_time_s")[0] < 0.0:
        return "the machine answers sooner than the file; lower its own delay"
    to.write("delay", 0, "dead_time_s", lambda old, new: old + max(0.0, new))
    to.drive.nsample = max(
        to.drive.nsample, math.ceil(to.drive.delay / to.plant.model.opt.timestep) + 2
    )
    to.drive.interp = 1  # a delay that is no multiple of the time step would be rounded up
    return None


def _add_lag(to: _Editor) -> str | None:
    if to.drive.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return "the drive has dynamics of its own; raise its time constant"
    to.drive.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    to.drive.dynprm = np.zeros_like(to.drive.dynprm)
    # The effect holds each period's last value, half a period ahead of a continuous filter.
    ahead_s = 0.5 * to.machine.period_s
    later = lambda old, new: max(new - ahead_s, to.plant.model.opt.timestep)  # noqa: E731
    to.write("dynprm", 0, "time_constant_s", later)
    return None


def _add_sag(to: _Editor) -> str | None:
    if "load_rad" in to.finding.parameters:
        return "the sag follows the weight; lower kp instead"
    middle = 0.5 * float(to.machine.lower[to.place] + to.machine.upper[to.place])
    stiffness = float(to.drive.gainprm[0] * to.drive.gear[0])
    slope = to.list_sizes("sag_slope")[0]
    to.write("biasprm", 0, "sag_rad", lambda old, new: old + stiffness * (middle * slope - new))
    to.write("gainprm", 0, "sag_slope", lambda old, new: old * (1.0 - new))
    return None


RULES: Mapping[str, Callable[[_Editor], str | None]] = {
    "flow_gain": _scale_command,
    "lag": _add_lag,
    "sag": _add_sag,
    "dead_time": _add_delay,
    **dict.fromkeys(EFFECTS, _change_as_in_search),
}
"""Change of the file for an effect."""
INTERFACES = {"flow_gain": ("speed",), "lag": ("position", "torque"), "sag": ("position",)}
"""Interfaces of machines on which an effect is a change of the file; all for the others."""
