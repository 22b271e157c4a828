"""A recorded fault played through MuJoCo C, and what began it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from brokk_rl.contracts.world import PROPERTIES, TRACE, Property
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.drive import MAX_SPEED
from brokk_rl.sim.fault_recorder import Fault
from brokk_rl.sim.native_world import NativeWorld

WORDS = {
    "increment": "the actuator model's increment",
    "reference": "the drive's reference",
    "q": "the position",
    "speed": "the speed",
    "acceleration": "the acceleration",
}
"""Quantities in the order in which a step computes them."""

BAD_STATES = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
"""Warnings whose `lastinfo` is the joint: each joint of a machine has one degree of freedom."""


@dataclass(frozen=True)
class PlayedStep:
    """One control step as MuJoCo C plays it.

    Attributes:
        q: Joint positions after it, `(J,)`.
        difference: Largest distance from the recorded positions, rad or m; NaN where those are.
        top_speed: Largest joint speed after it, rad/s or m/s.
        contact_force_n: Peak contact force.
        is_fault: Whether the world is a fault.
    """

    q: np.ndarray
    difference: float
    top_speed: float
    contact_force_n: float
    is_fault: bool


def play_fault(fault: Fault, machine: Machine) -> list[PlayedStep]:
    """Return the recorded control steps as MuJoCo C plays them, from the first recorded state.

    Raises:
        ConfigError: The fault was recorded with another machine.
    """
    world = _restore_world(fault, machine, 0)
    played = []
    for index, increment in enumerate(fault.increment):
        world.step(torch.from_numpy(increment[None].copy()))
        q = world.trace["q"][0].numpy().copy()
        played.append(
            PlayedStep(
                q=q,
                difference=float(np.abs(q - fault.states["q"][index + 1]).max()),
                top_speed=float(world.trace["speed"].abs().max()),
                contact_force_n=float(world.contact_force_n[0]),
                is_fault=bool(world.faults[0]),
            )
        )
    return played


def describe_cause(fault: Fault, machine: Machine) -> str:
    """Return what began a fault: the term, joint, contact or buffer by name.

    Raises:
        ConfigError: The fault was recorded with another machine.
    """
    names = machine.joint_names
    if fault.terms:
        return f"the reward term {', '.join(fault.terms)} was not finite"
    for step, increment in enumerate(fault.increment):
        quantities = {"increment": increment}
        for name in ("reference", "q", "speed"):
            quantities[name] = fault.states[name][step]
        for name, values in quantities.items():
            if not np.isfinite(values).all():
                joint = names[int(np.argmin(np.isfinite(values)))]
                left = len(fault.increment) - step
                return (
                    f"{WORDS[name]} of {joint} was not finite, {left} control steps before the end"
                )
    return "; ".join([*fault.alarms, _describe_last_step(fault, machine)])


def _restore_world(fault: Fault, machine: Machine, step: int) -> NativeWorld:
    """Return one native world in the state before a recorded step."""
    if fault.machine != machine.name:
        raise ConfigError(
            f"the fault was recorded with machine={fault.machine}, but machine={machine.name} "
            "was chosen"
        )
    varied: list[Property] = [name for name in PROPERTIES if name in fault.properties]
    world = NativeWorld(machine, 1, fault.substeps, 1, tuple(varied))
    for name in varied:
        world.properties[name].copy_(torch.from_numpy(fault.properties[name])[None])
    world.apply_properties()
    scene = torch.from_numpy(fault.scene.astype(np.float32))[None]
    world.reset(torch.ones(1, dtype=torch.bool), world.q.clone(), scene)
    for name in TRACE:
        world.trace[name].copy_(torch.from_numpy(fault.states[name][step].copy())[None])
    return world


def _describe_last_step(fault: Fault, machine: Machine) -> str:
    """Return which joint was bad first in the last step, and the strongest contact then."""
    names, before = machine.joint_names, np.abs(fault.states["speed"][-2])
    if before.max() > MAX_SPEED:
        return f"the speed of {names[int(before.argmax())]} was {before.max():,.0f} before the step"
    world = _restore_world(fault, machine, len(fault.increment) - 1)
    text, contact = "", ""
    for model, data in world.watch_step(torch.from_numpy(fault.increment[-1:].copy())):
        speed = np.abs(data.qvel)
        # MuJoCo puts a world that it finds bad back to its first state
        resets = [data.warning[kind] for kind in BAD_STATES if data.warning[kind].number]
        if resets:
            text = f"{names[resets[0].lastinfo]} was not finite or huge"
            break
        contact = _describe_contact(model, data) or contact
        if speed.max() > MAX_SPEED:
            text = f"the speed of {names[int(speed.argmax())]} passed {MAX_SPEED:g}"
            break
    if not text:
        after = np.abs(fault.states["speed"][-1])
        fast = np.where(np.isnan(after), np.inf, after)
        text = "MuJoCo C plays the last step soundly"
        if fast.max() > MAX_SPEED:
            text = f"the speed of {names[int(fast.argmax())]} passed {MAX_SPEED:g}; {text}"
    return f"{text}, {contact}" if contact else f"{text}, without contact"


def _describe_contact(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """Return the contact with the largest normal force; nothing where nothing touches."""
    strongest, text, force = 0.0, "", np.zeros(6)
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, force)
        if abs(force[0]) > strongest:
            strongest = abs(force[0])
            geoms = [model.geom(int(geom)) for geom in data.contact[index].geom]
            names = []
            for geom in geoms:
                names.append(geom.name or model.body(int(geom.bodyid[0])).name)
            text = f"contact of {names[0]} and {names[1]} with {strongest / 1000:,.0f} kN"
    return text
