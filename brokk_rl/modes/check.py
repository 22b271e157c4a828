"""`brokk mode=check`: checks a machine with its task and actuator; makes one of a URDF or MJCF."""

from __future__ import annotations

import dataclasses
import logging
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Interval

from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.kinematics import Gravity, compute_tool_kinematics
from brokk_rl.machine import Dimension, Machine
from brokk_rl.plain_files import parse_model
from brokk_rl.session import Session, write_bytes, write_json, write_text
from brokk_rl.spec import WorldCount, name_spec, spec

if TYPE_CHECKING:
    import torch

    from brokk_rl.contracts.actuator import ActuatorModel

log = logging.getLogger(__name__)

JOINT_COLUMNS = {
    "lower": "lower",
    "upper": "upper",
    "home": "home",
    "max_speed": "max speed",
    "travel_s": "travel, s",
    "largest_weight": "weight",
    "yield_force": "yield force",
}
"""Figures of a joint in the table."""
JOINT_UNITS = "rad, rad/s, Nm; of a slide m, m/s, N. The yield force counts beyond the weight."


@spec
class CheckSubject:
    """Subject and size of a check.

    Attributes:
        model: URDF or MJCF of a new machine; `None` checks `machine=…`.
        name: Name of the new machine; `None`: that of its file.
        chain: Last joint or link of the arm in it, its first and last link, or all its joints; `None`
            for the longest chain.
        tip: Site or link of the tool point; `None`: a frame named so, else the far end.
        gripper: Whether the first joint of the gripper is the last one of the machine.
        drive: What moves the joints; `auto` reads it off the model.
        command: Quantity that commands set; `auto`: that of the model's actuators.
        packages: Folders in which meshes of `package://…` are searched first.
        num_poses: Random poses from which the reach is read.
        num_starts: Starts of the task that are drawn, and worlds that are simulated.
    """

    model: str | None
    name: str | None
    chain: str | tuple[str, ...] | None
    tip: str | None
    gripper: bool
    drive: Literal["auto", "electric", "hydraulic"]
    command: Literal["auto", "valve", "velocity", "position", "torque"]
    packages: tuple[str, ...]
    num_poses: Annotated[int, Interval(ge=1, le=10**7)]
    num_starts: WorldCount

    def check(self) -> None:
        if self.model is not None:
            parse_model(Path(self.model))
        if self.model is None and (self.chain or self.tip or self.name):
            raise ConfigError("model: expected the file of a robot beside name, chain and tip")
        if self.name is not None and not re.fullmatch(r"\w+", self.name):
            raise ConfigError(
                f"name: expected letters, digits and _, got '{self.name}'; it names files and recordings"
            )

    @property
    def chain_names(self) -> tuple[str, ...]:
        """Names of `chain`; none for the longest."""
        if isinstance(self.chain, str):
            return (self.chain,)
        return self.chain or ()


@dataclass
class MachineCheck:
    """Result of a check.

    Attributes:
        problems: Conditions under which the machine cannot be simulated or trained.
        unfit: What the task or the actuator has against this machine.
        missing: Numbers and parts that the file lacks, guesses or does not know well.
        joints: Limits, speed and weight of each joint by name.
        reach: Extent of the tool point over random poses, m; empty where it is not known.
        contact: Links that may touch something; empty where there is no model.
        starts: Shares of starts of the task that can be done.
    """

    problems: list[str] = field(default_factory=list)
    unfit: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    joints: dict[str, dict[str, float | None]] = field(default_factory=dict)
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

    def group_remarks(self) -> dict[str, list[str]]:
        """Return all findings by their kind, where there are some."""
        kinds = {"problem": self.problems, "not fitting": self.unfit, "remark": self.missing}
        return {kind: texts for kind, texts in kinds.items() if texts}

    def list_joints(self) -> list[list[str | None]]:
        """Return the rows of the table of joints."""
        rows = []
        for name, figures in self.joints.items():
            values = [figures[key] for key in JOINT_COLUMNS]
            rows.append(
                [name, *(None if one is None else f"{round(one, 9):.4g}" for one in values)]
            )
        return rows

    def list_facts(self) -> dict[str, str]:
        """Return reach, contact and starts in words."""
        facts = {}
        if reach := self.reach:
            facts["reach"] = f"{reach['nearest_m']:.2f} to {reach['furthest_m']:.2f} m"
            facts["height"] = f"{reach['lowest_m']:.2f} to {reach['highest_m']:.2f} m"
            facts["above the ground"] = f"{reach['share_above_ground']:.0%} of random poses"
        facts["touches, and feels it"] = ", ".join(self.contact) or "nothing"
        if self.starts:
            shares = [f"{name} {share:.1%}" for name, share in self.starts.items()]
            facts["starts of the task, of candidates"] = ", ".join(shares)
        return facts


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
        if machine.has_bodies and not found.problems:
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
            print_text(
                f"next, with a task: brokk mode=check machine=@{file} task=… actuator={actuator}"
            )
        log.info("the same as data: %s", folder / "check.json")

    def _import_model(self) -> tuple[Machine, list[str]]:
        """Return the machine of the model and remarks about it; writes its files."""
        from brokk_rl.sim.arm_model import ModelChoices
        from brokk_rl.sim.model_import import import_model

        subject = self.subject
        path = Path(subject.model or "")
        name = subject.name or re.sub(r"\W+", "_", path.stem)
        choices = ModelChoices(
            chain=subject.chain_names,
            tip=subject.tip,
            gripper=subject.gripper,
            drive=subject.drive,
            command=subject.command,
            packages=subject.packages,
        )
        imported = import_model(path, name, choices)
        folder = self.session.folder
        for file, data in imported.meshes.items():
            write_bytes(folder / file, data)
        write_text(folder / f"{name}.xml", imported.mjcf)
        write_text(folder / f"{name}.yaml", imported.format_yaml())
        mjcf = str((folder / f"{name}.xml").resolve())
        return dataclasses.replace(imported.build(), mjcf=mjcf), imported.remarks

    def _draw_starts(self, machine: Machine, found: MachineCheck) -> dict[str, torch.Tensor] | None:
        """Return starts of the task, `None` where it has none for this machine."""
        import torch

        if not machine.has_bodies:
            return None
        seed, count = self.session.stream("check"), self.subject.num_starts
        try:
            process = self.task.build(machine, 1, torch.device("cpu"))
            if "count_starts" in process.offers:
                found.starts = process.count_starts(count, seed)
            drawn = process.starts(count, seed)
        except BrokkError as error:
            found.unfit.append(str(error))
            return None
        return drawn

    def _try_simulation(
        self, machine: Machine, found: MachineCheck, drawn: dict[str, torch.Tensor] | None
    ) -> None:
        """Simulate a second of full commands from drawn starts, and say which joint diverges."""
        import torch

        from brokk_rl.commands import accept_speeds
        from brokk_rl.sim.machine_trial import try_machine

        num, cpu = self.subject.num_starts, torch.device("cpu")
        actuator: ActuatorModel | None = None
        try:
            with torch.random.fork_rng([]):
                torch.manual_seed(self.session.stream("check"))
                actuator = accept_speeds(self.actuator.build(machine, num, cpu), machine, num, cpu)
        except BrokkError as error:
            found.unfit.append(str(error))
        try:
            fault, is_endured = try_machine(machine, self.sim, actuator, num, drawn)
            if fault:
                (found.missing if is_endured else found.problems).append(fault)
        except BrokkError as error:
            found.problems.append(str(error))


def check_machine(machine: Machine, num_poses: int, generator: np.random.Generator) -> MachineCheck:
    """Check a machine on `num_poses` random poses within its joint limits."""
    found = MachineCheck()
    q = generator.uniform(machine.lower, machine.upper, (num_poses, machine.num_joints))
    load = None
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
        load = np.abs(Gravity(machine).load(q)).max(0)
    _check_joints(machine, load, found)
    _check_model(machine, found)
    _list_missing(machine, found)
    return found


def _check_joints(machine: Machine, load: np.ndarray | None, found: MachineCheck) -> None:
    """Fill in the joints, and name those whose limits, speed or force cannot be right."""
    for j, joint in enumerate(machine.joints):
        travel, speed = joint.upper.value - joint.lower.value, joint.max_speed.value
        yield_force = joint.body.yield_force.value if joint.body else None
        found.joints[joint.name] = {
            "lower": joint.lower.value,
            "upper": joint.upper.value,
            "home": joint.home,
            "max_speed": speed,
            "travel_s": travel / speed if speed > 0 else None,
            "largest_weight": None if load is None else float(load[j]),
            "yield_force": yield_force,
        }
        if travel <= 0:
            found.problems.append(f"{joint.name}: upper must be above lower")
        if speed <= 0:
            found.problems.append(f"{joint.name}: max_speed must be above 0, got {speed:g}")
        if load is not None and yield_force is not None and yield_force < load[j]:
            found.missing.append(
                f"{joint.name}: yield_force {yield_force:g} is less than the weight it carries in its "
                f"worst pose, {load[j]:.3g}; the drive counts it beyond the weight, so this is allowed"
            )


def _check_model(machine: Machine, found: MachineCheck) -> None:
    """Compile the MJCF with the machine's numbers, and list the links that touch."""
    from brokk_rl.sim.model import compile_model, list_touching

    if not machine.has_bodies or machine.mjcf is None:
        found.missing.append(
            "without joints[].body, tool_m and mjcf it can be recorded and identified, not simulated"
        )
        return
    try:
        model = compile_model(machine, machine.period_s / 10.0)
    except (BrokkError, ValueError) as error:
        found.problems.append(str(error))
        return
    found.contact = [model.body(body).name for body in list_touching(model)]
    if not found.contact:
        found.missing.append(
            "no link can touch anything: contact forces stay 0; give the tool's geoms contype"
        )


def _list_missing(machine: Machine, found: MachineCheck) -> None:
    """Name the numbers of low confidence, and the parts that only some modes need."""
    guessed = []
    for joint in machine.joints:
        numbers = {"lower": joint.lower, "upper": joint.upper, "max_speed": joint.max_speed}
        if body := joint.body:
            numbers |= {
                "mass_kg": body.mass_kg,
                "yield_force": body.yield_force,
                "stiffness": body.stiffness,
            }
            numbers |= {f"origin_m.{axis}": body.origin_m[i] for i, axis in enumerate("xyz")}
        guessed += [f"{joint.name}.{name}" for name, one in numbers.items() if _is_guessed(one)]
    for axis, one in zip("xyz", machine.tool_m or (), strict=False):
        if _is_guessed(one):
            guessed.append(f"tool_m.{axis}")
    if guessed:
        found.missing.append(
            f"{len(guessed)} numbers of low confidence, to measure or to randomise widely: {', '.join(guessed)}"
        )
    if not machine.levers and machine.joints[0].command == "valve":
        found.missing.append(
            "levers: guidance of a person (mode=deploy) needs the lever of each joint"
        )


def _is_guessed(dimension: Dimension) -> bool:
    return dimension.confidence == "low"


def _show(machine: Machine, found: MachineCheck) -> None:
    """Print the verdict, the joints, and every remark."""
    print_text(f"{machine.name}: {found.summarise()}")
    print_table(["joint", *JOINT_COLUMNS.values()], found.list_joints())
    print_text(JOINT_UNITS)
    for name, text in found.list_facts().items():
        print_text(f"{name}: {text}")
    remarks = []
    for kind, texts in found.group_remarks().items():
        remarks += [(kind, text) for text in texts]
    if remarks:
        print_table([], remarks)
