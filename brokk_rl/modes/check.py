"""`brokk mode=check`: checks a machine with its task and actuator; makes one of a URDF or MJCF."""

import dataclasses
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from matplotlib.figure import Figure
from rich.console import Console

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.contracts.task import Task
from brokk_rl.errors import BrokkError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, ORANGE, make_figure, remove_frame
from brokk_rl.report import Report
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.sim.check_subject import CheckSubject
from brokk_rl.sim.machine_check import MachineCheck, check_machine
from brokk_rl.sim.model_import import import_model
from brokk_rl.spec import name_spec, spec

log = logging.getLogger(__name__)

CLASSES = {
    frozenset({"value", "source", "confidence"}): "Dimension",
    frozenset({"axis", "origin_m", "mass_kg", "com_m", "yield_force", "stiffness"}): "Body",
}
"""Class of a table of a machine's file by its keys; the others are the machine and its joints."""


@spec
class Check:
    """Check a machine with a task and an actuator; make a machine of a URDF or MJCF."""

    session: Session
    machine: Machine
    task: Task
    actuator: Actuator
    subject: CheckSubject

    def run(self) -> None:
        """Write `check.html`, `check.json` and `workspace.png`; with a model also YAML and MJCF.

        Raises:
            ConfigError: The model has no serial chain of hinges and slides.
            StorageError: A file could not be written.
        """
        machine, remarks = self._choose_machine()
        found = check_machine(machine, self.subject.num_poses, self.session.generator("check"))
        found.missing += remarks
        starts, targets_m = self._draw_starts(machine, found)
        self._try_actuator(machine, found)
        folder = self.session.folder
        facts = {
            "schema": 1,
            "machine": machine.name,
            "task": name_spec(self.task),
            "actuator": name_spec(self.actuator),
            "starts": starts,
            **found.to_json(),
        }
        write_json(folder / "check.json", facts)
        picture = _draw_workspace(machine, found, targets_m)
        if picture:
            picture.savefig(folder / "workspace.png", dpi=130)
        self._write_report(machine, found, starts, folder)
        _show(machine, found, starts)
        log.info("report: %s", folder / "check.html")

    def _choose_machine(self) -> tuple[Machine, list[str]]:
        """Return the machine to check and remarks about it; writes the files of a new one."""
        if self.subject.model is None:
            return self.machine, []
        path = Path(self.subject.model)
        name = self.subject.name or re.sub(r"\W+", "_", path.stem)
        imported = import_model(path, name)
        folder = self.session.folder
        write_text(folder / f"{name}.xml", imported.mjcf)
        values = yaml.safe_dump(
            _add_targets(imported.values), sort_keys=False, width=160, default_flow_style=None
        )
        write_text(folder / f"{name}.yaml", f"# {name}, made of {path.name}.\n{values}")
        log.info(
            "machine: %s beside its MJCF; machine=@%s",
            folder / f"{name}.yaml",
            folder / f"{name}.yaml",
        )
        mjcf = str((folder / f"{name}.xml").resolve())
        return dataclasses.replace(imported.build(), mjcf=mjcf), imported.remarks

    def _draw_starts(
        self, machine: Machine, found: MachineCheck
    ) -> tuple[dict[str, float], np.ndarray | None]:
        """Return the shares of starts that can be done, and targets of such, `(N, 3)` or `None`."""
        seed, count = self.session.stream("check"), self.subject.num_starts
        if not machine.has_bodies:
            return {}, None
        shares: dict[str, float] = {}
        try:
            process = self.task.build(machine, 1, torch.device("cpu"))
            if "count_starts" in process.offers:
                shares = process.count_starts(count, seed)
            drawn = process.starts(count, seed)
        except BrokkError as error:
            found.problems.append(str(error))
            return shares, None
        target_m = drawn.get("target_m")
        return shares, None if target_m is None else target_m.numpy()

    def _try_actuator(self, machine: Machine, found: MachineCheck) -> None:
        try:
            self.actuator.build(machine, 1, torch.device("cpu"))
        except BrokkError as error:
            found.problems.append(str(error))

    def _write_report(
        self, machine: Machine, found: MachineCheck, starts: dict[str, float], folder: Path
    ) -> None:
        tone = "bad" if found.problems else "good"
        page = Report(f"Check of {machine.name}", _summarise(found), tone)
        page.add_facts(
            {
                "machine": machine.title,
                "task": name_spec(self.task),
                "actuator": name_spec(self.actuator),
            }
        )
        if found.problems:
            page.add_heading("Problems")
            page.add_list(found.problems)
        if found.missing:
            page.add_heading("Missing or guessed")
            page.add_list(found.missing)
        if found.tips_m is not None:
            page.add_heading("Reach")
            page.add_picture(
                folder / "workspace.png", f"Tool points of {len(found.tips_m)} random poses"
            )
            page.add_facts(
                {
                    key.replace("_m", ", m").replace("_", " "): f"{value:.2f}"
                    for key, value in found.reach.items()
                }
            )
        if starts:
            page.add_heading("Starts of the task")
            page.add_facts(
                {f"{key}, of candidates": f"{share:.1%}" for key, share in starts.items()}
            )
        page.add_heading("Joints")
        columns = list(next(iter(found.joints.values())))
        rows = [[name, *figures.values()] for name, figures in found.joints.items()]
        page.add_table(
            ["joint", *(column.replace("_s", ", s").replace("_", " ") for column in columns)],
            rows,
            "rad, rad/s, Nm; of a sliding joint m, m/s, N. The yield force counts beyond the weight.",
            digits=5,
        )
        page.add_heading("Contact")
        page.add_text(
            f"These links may touch the block, and a touch sensor feels them: {', '.join(found.contact)}."
            if found.contact
            else "No link touches anything."
        )
        page.write(folder / "check.html")


def _summarise(found: MachineCheck) -> str:
    if found.problems:
        return f"It cannot be trained with this task and actuator; problems: {len(found.problems)}."
    return f"It can be simulated and trained. Missing or guessed: {len(found.missing)}."


def _show(machine: Machine, found: MachineCheck, starts: dict[str, float]) -> None:
    """Print the result."""
    console = Console(highlight=False)
    reach = found.reach
    lines = [f"{machine.name}: {_summarise(found)}"]
    if reach:
        lines.append(
            f"  reach {reach['nearest_m']:.2f} to {reach['furthest_m']:.2f} m, "
            f"height {reach['lowest_m']:.2f} to {reach['highest_m']:.2f} m"
        )
    if starts:
        lines.append(
            "  starts: " + ", ".join(f"{name} {share:.1%}" for name, share in starts.items())
        )
    lines.append(f"  touches: {', '.join(found.contact) or 'nothing'}")
    lines += [f"  problem: {text}" for text in found.problems]
    lines += [f"  remark: {text}" for text in found.missing]
    for line in lines:
        console.print(line, soft_wrap=True, markup=False)


def _draw_workspace(
    machine: Machine, found: MachineCheck, targets_m: np.ndarray | None
) -> Figure | None:
    """Draw tool points, targets and the arm at home from the side and from above."""
    if found.tips_m is None:
        return None
    pose = compute_tool_kinematics(machine, machine.home)
    arm = np.concatenate((np.zeros((1, 3)), pose.joints_in_base_m, pose.tip_in_base_m[None]))
    figure = make_figure(11.0, 5.0)
    side, top = figure.subplots(1, 2)

    def flatten(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.hypot(points[:, 0], points[:, 1]), points[:, 2]

    def look_down(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points[:, 0], points[:, 1]

    for axis, project in ((side, flatten), (top, look_down)):
        axis.plot(
            *project(found.tips_m),
            ".",
            color=GREY,
            markersize=1.5,
            label="tool point",
            rasterized=True,
        )
        if targets_m is not None:
            axis.plot(
                *project(targets_m),
                ".",
                color=ORANGE,
                markersize=4,
                label="target that can be reached",
            )
        axis.plot(*project(arm), "-o", color=BLUE, linewidth=3, label="arm at home")
        axis.set_aspect("equal", adjustable="datalim")
        remove_frame(axis)
    side.axhline(0.0, color="black", linewidth=0.8)
    side.set(title="from the side", xlabel="distance from the base's axis, m", ylabel="height, m")
    top.set(title="from above", xlabel="x, m", ylabel="y, m")
    side.legend(frameon=False, fontsize=8)
    return figure


def _add_targets(values: Any) -> Any:
    """Return a machine's plain data with the class of each table, as its YAML has them."""
    if isinstance(values, list):
        return [_add_targets(value) for value in values]
    if not isinstance(values, dict):
        return values
    name = CLASSES.get(frozenset(values), "Machine" if "joints" in values else "Joint")
    target = {"_target_": f"brokk_rl.machine.{name}"}
    return target | {key: _add_targets(value) for key, value in values.items()}
