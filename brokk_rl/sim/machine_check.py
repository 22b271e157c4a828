"""Check of a machine: reach, limits, weights and contact, as far as its file tells."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from brokk_rl.errors import BrokkError
from brokk_rl.gravity import Gravity
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Dimension, Machine
from brokk_rl.sim.model import compile_model


@dataclass
class MachineCheck:
    """Result of `check_machine`.

    Attributes:
        problems: Conditions under which the machine cannot be simulated or trained.
        missing: Numbers and parts that the file lacks or does not know well.
        joints: Limits, speed and weight of each joint by name.
        reach: Extent of the tool point over random poses, m; empty where it is not known.
        contact: Links that may touch something; empty where there is no model.
        tips_m: Tool points of the random poses, `(P, 3)`; `None` where they are not known.
    """

    problems: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    joints: dict[str, dict[str, float | None]] = field(default_factory=dict)
    reach: dict[str, float] = field(default_factory=dict)
    contact: list[str] = field(default_factory=list)
    tips_m: np.ndarray | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as plain JSON data, without the points."""
        return {key: value for key, value in asdict(self).items() if key != "tips_m"}


def check_machine(machine: Machine, num_poses: int, generator: np.random.Generator) -> MachineCheck:
    """Check a machine on `num_poses` random poses within its joint limits."""
    result = MachineCheck()
    q = generator.uniform(machine.lower, machine.upper, (num_poses, machine.num_joints))
    load = None
    if machine.has_bodies:
        result.tips_m = compute_tool_kinematics(machine, q).tip_in_base_m
        result.reach = _measure_reach(result.tips_m)
        gravity = Gravity(machine, torch.device("cpu"))
        load = gravity.load(torch.as_tensor(q, dtype=torch.float32)).abs().amax(0).numpy()
    _check_joints(machine, load, result)
    _check_model(machine, result)
    _list_missing(machine, result)
    return result


def _measure_reach(tips_m: np.ndarray) -> dict[str, float]:
    distance_m = np.hypot(tips_m[:, 0], tips_m[:, 1])
    return {
        "furthest_m": float(distance_m.max()),
        "nearest_m": float(distance_m.min()),
        "highest_m": float(tips_m[:, 2].max()),
        "lowest_m": float(tips_m[:, 2].min()),
        "share_above_ground": float((tips_m[:, 2] > 0.0).mean()),
    }


def _check_joints(machine: Machine, load: np.ndarray | None, result: MachineCheck) -> None:
    """Fill in the joints, and name those whose limits, speed or force cannot be right."""
    for j, joint in enumerate(machine.joints):
        travel, speed = joint.upper.value - joint.lower.value, joint.max_speed.value
        yield_force = joint.body.yield_force.value if joint.body else None
        result.joints[joint.name] = {
            "lower": joint.lower.value,
            "upper": joint.upper.value,
            "home": joint.home,
            "max_speed": speed,
            "travel_s": travel / speed if speed > 0 else None,
            "largest_weight": None if load is None else float(load[j]),
            "yield_force": yield_force,
        }
        if travel <= 0:
            result.problems.append(f"{joint.name}: upper must be above lower")
        if speed <= 0:
            result.problems.append(f"{joint.name}: max_speed must be above 0, got {speed:g}")
        if load is not None and yield_force is not None and yield_force < load[j]:
            result.missing.append(
                f"{joint.name}: yield_force {yield_force:g} is less than the weight it carries in its "
                f"worst pose, {load[j]:.3g}; the drive counts it beyond the weight, so this is allowed"
            )


def _check_model(machine: Machine, result: MachineCheck) -> None:
    """Compile the MJCF with the machine's numbers, and list the links that touch."""
    if not machine.has_bodies or machine.mjcf is None:
        result.missing.append(
            "without joints[].body, tool_m and mjcf it can be recorded and identified, not simulated"
        )
        return
    try:
        model = compile_model(machine, machine.period_s / 10.0)
    except (BrokkError, ValueError) as error:
        result.problems.append(str(error))
        return
    can_touch = (model.geom_contype | model.geom_conaffinity) != 0
    moving = {
        int(body)
        for body in model.geom_bodyid[can_touch]
        if model.body_dofnum[model.body_weldid[body]]
    }
    result.contact = [model.body(body).name for body in sorted(moving)]
    if not moving:
        result.missing.append(
            "no link can touch anything: contact forces stay 0; give the tool's geoms contype and a <touch> sensor"
        )


def _list_missing(machine: Machine, result: MachineCheck) -> None:
    """Name the numbers of low confidence, and the parts that only some modes need."""
    guessed = []
    for joint in machine.joints:
        numbers = {"lower": joint.lower, "upper": joint.upper, "max_speed": joint.max_speed}
        if joint.body:
            body = joint.body
            numbers |= {
                "mass_kg": body.mass_kg,
                "yield_force": body.yield_force,
                "stiffness": body.stiffness,
            }
            numbers |= dict(
                zip(("origin_m.x", "origin_m.y", "origin_m.z"), body.origin_m, strict=True)
            )
        guessed += [f"{joint.name}.{name}" for name, one in numbers.items() if _is_guessed(one)]
    for axis, one in zip("xyz", machine.tool_m or (), strict=False):
        if _is_guessed(one):
            guessed.append(f"tool_m.{axis}")
    if guessed:
        result.missing.append(
            f"{len(guessed)} numbers of low confidence, to measure or to randomise widely: {', '.join(guessed)}"
        )
    if not machine.levers:
        result.missing.append(
            "levers: guidance of a person (mode=deploy) needs the lever of each joint"
        )


def _is_guessed(dimension: Dimension) -> bool:
    return dimension.confidence == "low"
