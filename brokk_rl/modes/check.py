"""`brokk mode=check`: checks a machine with its task and actuator; makes one of a URDF or MJCF."""

from __future__ import annotations

import dataclasses
import logging
import math
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from brokk_rl.checks import ProportionalModel, build_rest_history
from brokk_rl.commands import accept_speeds
from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Actuator, ActuatorModel
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import BrokkError
from brokk_rl.kinematics import Gravity, compute_tool_kinematics
from brokk_rl.machine import Body, Dimension, Joint, Machine
from brokk_rl.session import Session, write_bytes, write_json, write_text
from brokk_rl.sim.check_subject import CheckSubject
from brokk_rl.sim.model import FASTEST_MODE, find_fastest_mode, list_touching
from brokk_rl.sim.model_import import import_model
from brokk_rl.sim.scene import make_empty_scenes
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)

LARGEST_REACH_M = 80.0
"""Reach beyond which lengths are doubted: the longest booms of concrete pumps have some 70 m."""
TRIAL_S = 1.0
"""Simulated time, s: commands of full size reach the ends of travel in it."""
MOST_FAULTS = 5e-4
"""Share of control steps that may end in a fault: half of what a training endures
(`rl.max_fault_rate`)."""
JOINT_UNITS = "rad, rad/s, Nm; of a slide m, m/s, N. The yield force counts beyond the weight."


@dataclass
class MachineCheck:
    """Result of a check.

    Attributes:
        problems: Conditions under which the machine cannot be simulated or trained.
        unfit: What the task or the actuator has against this machine.
        missing: Numbers and parts that the file lacks, guesses or does not know well.
        joints: Limits, home, speed, time from end to end (`travel_s`), weight in the worst pose and
            yield force of each joint by name; without bodies neither of the last two.
        reach: Extent of the tool point over random poses, m; empty where it is not known.
        contact: Links that may touch something; empty where there is no model.
        starts: Shares of starts of the task that can be done.
    """

    problems: list[str] = field(default_factory=list)
    unfit: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    joints: dict[str, dict[str, float]] = field(default_factory=dict)
    reach: dict[str, float] = field(default_factory=dict)
    contact: list[str] = field(default_factory=list)
    starts: dict[str, float] = field(default_factory=dict)

    def summarise(self) -> str:
        """Return the verdict in a sentence."""
        if self.problems:
            return f"It cannot be simulated or trained; problems: {len(self.problems)}."
        if self.unfit:
            return "It can be simulated, but not trained with this task and actuator."
        return f"It can be simulated and trained. Missing, guessed or mended: {len(self.missing)}."


@spec
class Check:
    """Check a machine with a task and an actuator; make a machine of a URDF or MJCF.

    Attributes:
        session: Folder, seed, device.
        machine: The machine, where no model is given.
        sim: Physics of the trial.
        task: Its starts are drawn; a new machine is checked without one.
        actuator: How commands become motion.
        subject: What to check.
    """

    session: Session
    machine: Machine
    sim: Simulator
    task: Task
    actuator: Actuator
    subject: CheckSubject

    def run(self) -> None:
        """Print the check and write `check.json`; with a model also YAML and MJCF.

        Raises:
            ConfigError: The model has no serial chain of hinges and slides.
            StorageError: A file could not be written.
        """
        folder = self.session.folder
        is_new = self.subject.model is not None
        machine, remarks = self._import_model() if is_new else (self.machine, [])
        found = check_machine(machine, self.subject.num_poses, self.session.generator("check"))
        found.missing += remarks
        drawn = None if is_new else self._draw_starts(machine, found)
        if machine.has_bodies and machine.mjcf is not None:
            self._try_simulation(machine, found, drawn)
        facts = {
            "schema": 1,
            "machine": machine.name,
            "task": None if is_new else name_spec(self.task),
            "actuator": name_spec(self.actuator),
            **asdict(found),
        }
        write_json(folder / "check.json", facts)
        _show(machine, found)
        if is_new:
            file = folder / f"{machine.name}.yaml"
            log.info("machine: %s, beside its MJCF and meshes", file)
            actuator = "servo" if machine.interface == "position" else "lag"
            parts = f"machine=@{file} actuator={actuator}"
            print_text("next, with the package of docs/tutorials/your_machine.md:")
            print_text(f"brokk mode=check task=my_trace {parts}")
            print_text(f"brokk experiment=my_trace {parts} session.out={folder}_trace")
        log.info("the same as data: %s", folder / "check.json")

    def _import_model(self) -> tuple[Machine, list[str]]:
        """Return the machine of the model and remarks about it; writes its files."""
        path = Path(self.subject.model or "")
        name = self.subject.name or re.sub(r"\W+", "_", path.stem)
        imported = import_model(path, name, self.subject)
        folder = self.session.folder
        for file, data in imported.meshes.items():
            write_bytes(folder / file, data)
        write_text(folder / f"{name}.xml", imported.mjcf)
        write_text(folder / f"{name}.yaml", imported.format_yaml())
        mjcf = str((folder / f"{name}.xml").resolve())
        return dataclasses.replace(imported.build(), mjcf=mjcf), imported.remarks

    def _draw_starts(self, machine: Machine, found: MachineCheck) -> dict[str, torch.Tensor] | None:
        """Return starts of the task, `None` where it has none for this machine."""
        if not machine.has_bodies:
            return None
        count = self.subject.num_starts
        seed = self.session.stream("check")
        try:
            process = self.task.build(machine, 1, torch.device("cpu"))
            if "count_starts" in process.offers:
                found.starts = process.count_starts(count, seed)
            return process.starts(count, seed)
        except BrokkError as error:
            found.unfit.append(str(error))
            return None

    def _try_simulation(
        self, machine: Machine, found: MachineCheck, drawn: dict[str, torch.Tensor] | None
    ) -> None:
        """Simulate a second of full commands from drawn starts, and say which joint diverges."""
        num = self.subject.num_starts
        cpu = torch.device("cpu")
        actuator: ActuatorModel | None = None
        try:
            with torch.random.fork_rng([]):
                torch.manual_seed(self.session.stream("check"))
                actuator = accept_speeds(self.actuator.build(machine, num, cpu), machine, num, cpu)
        except BrokkError as error:
            found.unfit.append(str(error))
        try:
            world: Any = self.sim.build(machine, cpu, num)
        except (BrokkError, ValueError) as error:
            found.problems.append(str(error))
            return
        found.contact = list_touching(world.model)
        if not found.contact:
            found.missing.append(
                "no link can touch anything: contact forces stay 0; give the tool's geoms contype"
            )
        fault, is_endured = try_machine(machine, world, actuator, drawn)
        if fault:
            (found.missing if is_endured else found.problems).append(fault)


def check_machine(machine: Machine, num_poses: int, generator: np.random.Generator) -> MachineCheck:
    """Check a machine on `num_poses` random poses within its joint limits."""
    found = MachineCheck()
    q = generator.uniform(machine.lower, machine.upper, (num_poses, machine.num_joints))
    figures: dict[str, np.ndarray] = {
        "lower": machine.lower,
        "upper": machine.upper,
        "home": machine.home,
        "max_speed": machine.max_speed,
        "travel_s": (machine.upper - machine.lower) / machine.max_speed,
    }
    if machine.has_bodies:
        x_m, y_m, height_m = compute_tool_kinematics(machine, q).tip_in_base_m.T
        distance_m = np.hypot(x_m, y_m)
        found.reach = {
            "furthest_m": float(distance_m.max()),
            "nearest_m": float(distance_m.min()),
            "highest_m": float(height_m.max()),
            "lowest_m": float(height_m.min()),
            "share_above_ground": float((height_m > 0.0).mean()),
        }
        if distance_m.max() > LARGEST_REACH_M:
            found.missing.append(
                f"a reach of {distance_m.max():.3g} m is doubted: lengths count in m, not mm"
            )
        figures["largest_weight"] = load = np.abs(Gravity(machine).load(q)).max(0)
        yields = np.array([body.yield_force.value for body in machine.bodies])
        figures["yield_force"] = yields
        if weak := np.array(machine.joint_names)[yields < load].tolist():
            found.missing.append(
                f"{', '.join(weak)}: the yield force is less than the weight in the worst pose. The drive counts it "
                "beyond the weight, so this is allowed; look at masses (kg) and force limits"
            )
    found.joints = pd.DataFrame(figures, index=machine.joint_names).to_dict("index")
    if not machine.has_bodies or machine.mjcf is None:
        found.missing.append(
            "without joints[].body, tool_m and mjcf it can be recorded and identified, not simulated"
        )
    guessed = list(_list_guesses(machine.tool_m, "tool_m"))
    for joint in machine.joints:
        guessed += _list_guesses(joint, joint.name)
    if guessed:
        found.missing.append(
            f"{len(guessed)} numbers of low confidence, to measure or to randomise widely: {', '.join(guessed)}"
        )
    if not machine.levers and machine.joints[0].command == "valve":
        found.missing.append(
            "levers: guidance of a person (mode=deploy) needs the lever of each joint"
        )
    return found


def try_machine(
    machine: Machine,
    world: Any,
    actuator: ActuatorModel | None,
    drawn: dict[str, torch.Tensor] | None,
) -> tuple[str | None, bool]:
    """Simulate a second; return what diverged and what to change, and whether a training endures it.

    Nothing diverged where the text is `None`.

    The worlds get new random commands in each period, as a policy at the start of a training gives
    them; where nothing can be touched, half of them get full commands that stay.

    Args:
        machine: The machine.
        world: Its world, as `sim=native` builds it.
        actuator: How speeds become motion; `None`: the joints move as they are asked to.
        drawn: Starts of the task; `None`: random poses with nothing to touch.
    """
    generator = torch.Generator().manual_seed(0)
    num_worlds = world.num_worlds
    everywhere = torch.ones(num_worlds, dtype=torch.bool)
    if drawn is None:
        lower, upper = (torch.tensor(end) for end in (machine.lower, machine.upper))
        share = torch.rand(num_worlds, machine.num_joints, generator=generator)
        q = (lower + (upper - lower) * share).float()
        scene = make_empty_scenes(num_worlds)
    else:
        q = drawn["q"]
        scene = drawn["scene"]
    history = build_rest_history(machine, world.device, q)
    model = actuator or ProportionalModel(machine, world.device)
    model.reset(everywhere)
    world.reset(everywhere, q, scene)
    cause = ""
    is_touching = torch.zeros(num_worlds, dtype=torch.bool)
    held = torch.randn(q.shape, generator=generator).sign()
    with torch.inference_mode():
        for step in range(math.ceil(TRIAL_S / machine.period_s)):
            u = torch.rand(q.shape, generator=generator) * 2.0 - 1.0
            if drawn is None:  # a task would end such episodes before they hit the ground
                u[::2] = held[::2]
            history.push_u(u)
            world.step(model.step(history) - history.q[:, -1])
            if step == 0:
                is_touching = world.contact_force_n > 0.0
            if not cause and world.faults.any():
                cause = world.explain_faults()
            history.push_q(world.q)
    if not cause:
        return None, True
    num_faults = int(world.faults.sum())
    is_endured = num_faults <= MOST_FAULTS * num_worlds * math.ceil(TRIAL_S / machine.period_s)
    said = f"{num_faults} of {num_worlds} worlds diverged in a simulated second: {cause}. "
    if is_touching[world.faults][0]:
        said += (
            "It began in contact with the block, the ground or itself: let the task draw other starts, "
            "or take block and ground away (scene: brokk_rl.sim.scene.make_empty_scenes)"
        )
    else:
        said += _suggest_stiffness(machine, world.model, q.numpy())
    return said, is_endured


def _suggest_stiffness(machine: Machine, model: Any, poses: np.ndarray) -> str:
    """Return what to change so that the drives are as calm as those of a new machine."""
    stiffness = np.array([body.stiffness.value for body in machine.bodies])
    mode_rad_s, joint = find_fastest_mode(model, stiffness, poses)
    phase = mode_rad_s * model.opt.timestep
    name = machine.joint_names[joint]
    if phase <= FASTEST_MODE:
        return f"Look at max_speed, stiffness and mass of {name}, or give more sim.substeps"
    calm = float(stiffness[joint]) * (FASTEST_MODE / phase) ** 2
    return (
        f"The drives are too stiff for substeps of {1000.0 * model.opt.timestep:.3g} ms; {name} swings fastest, "
        f"at {mode_rad_s / (2.0 * math.pi):.3g} Hz: lower its body.stiffness from {stiffness[joint]:.4g} to "
        f"{calm:.3g}, or raise sim.substeps by a factor of {math.ceil(phase / FASTEST_MODE)}"
    )


def _list_guesses(value: object, name: str) -> Iterator[str]:
    """Yield the numbers of low confidence by their keys in the machine's file."""
    if isinstance(value, Dimension):
        if value.confidence == "low":
            yield name
    elif isinstance(value, tuple):
        for axis, one in zip("xyz", value, strict=False):
            yield from _list_guesses(one, f"{name}.{axis}")
    elif isinstance(value, Joint | Body):
        for key, one in vars(value).items():
            yield from _list_guesses(one, f"{name}.{key}")


def _show(machine: Machine, found: MachineCheck) -> None:
    """Print the verdict, the joints, and every remark."""
    print_text(f"{machine.name}: {found.summarise()}")
    figures = pd.DataFrame.from_dict(found.joints, "index").round(9).map("{:.4g}".format)
    headings = [name.replace("_", " ") for name in figures]
    print_table(["joint", *headings], figures.reset_index().to_numpy().tolist())
    print_text(JOINT_UNITS)
    if reach := found.reach:
        print_text(
            f"reach: {reach['nearest_m']:.2f} to {reach['furthest_m']:.2f} m; height: {reach['lowest_m']:.2f} to "
            f"{reach['highest_m']:.2f} m; above the ground in {reach['share_above_ground']:.0%} of random poses"
        )
    print_text(f"touches, and feels it: {', '.join(found.contact) or 'nothing'}")
    if found.starts:
        shares = [f"{name} {share:.1%}" for name, share in found.starts.items()]
        print_text(f"starts of the task, of candidates: {', '.join(shares)}")
    kinds = {"problem": found.problems, "not fitting": found.unfit, "remark": found.missing}
    remarks = []
    for kind, texts in kinds.items():
        remarks += [(kind, text) for text in texts]
    if remarks:
        print_table([], remarks)
