"""A machine is made of a URDF or MJCF, and a check says what keeps it from training."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.machine_check import check_machine
from brokk_rl.sim.model import ASSETS
from brokk_rl.sim.model_import import import_model

INERTIA = '<inertia ixx="1" iyy="2" izz="2" ixy="0" ixz="0" iyz="0"/>'


def link(name: str, x_m: float, mass_kg: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{x_m} 0 0" rpy="0 0.3 0"/><mass value="{mass_kg}"/>{INERTIA}</inertial>'
        f'<collision><origin xyz="{x_m} 0 0"/><geometry><box size="{2 * x_m} 0.1 0.1"/></geometry></collision></link>'
    )


def joint(
    name: str, kind: str, parent: str, child: str, origin: str, axis: str = "1 0 0", limit: str = ""
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin {origin}/><axis xyz="{axis}"/><limit {limit}/></joint>'
    )


SLEW = 'lower="-2" upper="2" effort="3000" velocity="0.5"'
LIFT = 'lower="-1.2" upper="0.4" effort="4000" velocity="0.3"'
URDF = f"""<robot name="arm"><link name="base"/>{link("mast", 0.2, 40)}{link("boom", 0.5, 30)}
{link("stick", 0.4, 20)}{link("finger", 0.1, 2)}<link name="tool0"/>
{joint("slew", "revolute", "base", "mast", 'xyz="0 0 0.3"', "0 0 1", SLEW)}
{joint("lift", "revolute", "mast", "boom", 'xyz="0.1 0 0.4" rpy="0.2 0 0"', "0 1 0", LIFT)}
{joint("reach", "prismatic", "boom", "stick", 'xyz="1 0 0" rpy="0 0.5 0"', limit='lower="0" upper="0.8"')}
{joint("grip", "revolute", "mast", "finger", 'xyz="0 0.3 0"', "0 0 1", 'lower="0" upper="1"')}
{joint("flange", "fixed", "stick", "tool0", 'xyz="0.9 0 0"')}</robot>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return path


def test_a_urdf_becomes_a_machine_that_moves_as_mujoco_moves_it(urdf: Path) -> None:
    machine = import_model(urdf, "arm").build()
    assert machine.joint_names == ("slew", "lift", "reach")
    assert [one.kind for one in machine.joints] == ["hinge", "hinge", "slide"]
    spec = mujoco.MjSpec.from_file(str(urdf))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in ([0.0, 0.0, 0.0], [1.0, -0.7, 0.3], [-1.5, 0.3, 0.8]):
        for name, value in zip(machine.joint_names, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        tip = compute_tool_kinematics(machine, np.array(q)).tip_in_base_m
        assert tip == pytest.approx(data.body("tool0").xpos, abs=1e-5)


def test_limits_masses_and_guesses_of_a_urdf_are_told(urdf: Path) -> None:
    imported = import_model(urdf, "arm")
    slew, _, reach = imported.build().joints
    assert (slew.lower.value, slew.max_speed.value) == (-2.0, 0.5)
    assert slew.body and reach.body
    assert slew.body.mass_kg.value == 42.0, "the finger rides on the mast"
    assert slew.body.yield_force.value == 3000.0 and slew.body.yield_force.confidence == "medium"
    assert reach.max_speed.confidence == "low" and reach.body.yield_force.confidence == "low"
    remarks = " ".join(imported.remarks)
    for text in ("grip are not part of the longest chain", "reach has no speed", "frame 'tool0'"):
        assert text in remarks


def test_the_mjcf_of_an_import_has_the_inertia_of_its_source(urdf: Path, tmp_path: Path) -> None:
    imported = import_model(urdf, "arm")
    (tmp_path / "arm.xml").write_text(imported.mjcf)
    spec = mujoco.MjSpec.from_file(str(urdf))
    source, made = spec.compile(), mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    kept = [source.joint(name).dofadr[0] for name in ("slew", "lift", "reach")]
    full = []
    for model, q in ((source, [0.4, -0.6, 0.5, 0.0]), (made, [0.4, -0.6, 0.5])):
        data = mujoco.MjData(model)
        names = ("slew", "lift", "reach", "grip")[: len(q)]
        for name, value in zip(names, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        full.append(matrix)
    assert full[1] == pytest.approx(full[0][np.ix_(kept, kept)], rel=1e-4, abs=1e-4)


def test_our_own_mjcf_gives_our_own_machine(machine: Machine) -> None:
    assert machine.mjcf
    made = import_model(ASSETS / machine.mjcf, "again").build()
    for q in (machine.home, machine.lower, machine.upper):
        tips = [compute_tool_kinematics(one, q).tip_in_base_m for one in (machine, made)]
        assert tips[0] == pytest.approx(tips[1], abs=1e-5)
    masses = [[body.mass_kg.value for body in one.bodies] for one in (machine, made)]
    assert masses[1] == pytest.approx(masses[0])


@pytest.mark.parametrize(
    ("actuator", "interface", "force"),
    [
        ("", "speed", np.nan),
        ('<position joint="{}" kp="5"/>', "position", np.nan),
        ('<velocity joint="{}" kv="5"/>', "speed", np.nan),
        ('<motor joint="{}" gear="10" ctrlrange="-2 2"/>', "torque", 20.0),
    ],
)
def test_an_mjcf_says_what_commands_its_joints(
    actuator: str, interface: str, force: float, tmp_path: Path
) -> None:
    body = '<body><joint name="{}" axis="0 1 0"/><geom size="0.1"/>{}</body>'
    text = body.format("lift", body.format("tilt", ""))
    drives = "".join(actuator.format(name) for name in ("lift", "tilt"))
    path = tmp_path / "arm.xml"
    path.write_text(f"<mujoco><worldbody>{text}</worldbody><actuator>{drives}</actuator></mujoco>")
    found = import_model(path, "arm")
    assert found.build().interface == interface
    assert found.build().max_force == pytest.approx([force, force], nan_ok=True)
    assert any("valve is a guess" in remark for remark in found.remarks) == (not actuator)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<robot", "cannot read it"),
        (
            '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>',
            "neither a hinge",
        ),
        ("<mujoco><worldbody/></mujoco>", "no joint that moves"),
        (
            '<mujoco><worldbody><body><joint/><joint axis="1 0 0"/><geom size="1"/></body></worldbody></mujoco>',
            "a body of its own",
        ),
    ],
)
def test_a_model_that_is_no_chain_is_explained(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=told):
        import_model(path, "model")


def test_a_check_makes_the_files_of_a_machine_that_other_modes_take(
    urdf: Path, brokk: Callable[..., Any]
) -> None:
    few = "subject.num_poses=200"
    done = brokk("mode=check", f"subject.model={urdf}", few, "session.out=made")
    assert done.code == 0, done.err
    assert "actuator=lag" in done.out and "nearly no start" in done.out
    again = brokk("mode=check", "machine=@made/arm.yaml", "actuator=lag", few, "session.out=again")
    assert again.code == 0, again.err
    assert "weights" not in again.out
    first, second = (json.loads(Path(run, "check.json").read_text()) for run in ("made", "again"))
    assert first["joints"] == second["joints"] and second["contact"] == ["reach_link"]
    assert Path("again/workspace.png").stat().st_size > 10_000
    assert "Missing or guessed" in Path("again/check.html").read_text()


def test_the_shipped_machine_can_be_trained(brokk: Callable[..., Any]) -> None:
    done = brokk("mode=check", "subject.num_starts=64", "session.out=run")
    assert done.code == 0, done.err
    found = json.loads(Path("run/check.json").read_text())
    assert found["problems"] == []
    assert 5.0 < found["reach"]["furthest_m"] < 5.25, "reach about 5.2 m"
    assert 0.2 < found["starts"]["can be done"] < 0.4
    assert found["contact"] == ["q4_link", "q5_link"]


def test_a_machine_that_is_known_by_its_joints_only_is_no_error() -> None:
    found = check_machine(option("machine", "mini_excavator"), 10, np.random.default_rng(0))
    assert found.problems == [] and found.reach == {}
    assert any("recorded and identified" in text for text in found.missing)


def test_a_joint_without_travel_is_a_problem(machine: Machine) -> None:
    first = machine.joints[0]
    stuck = dataclasses.replace(
        first,
        lower=dataclasses.replace(first.lower, value=0.0),
        upper=dataclasses.replace(first.upper, value=0.0),
        home=0.0,
    )
    broken = dataclasses.replace(machine, joints=(stuck, *machine.joints[1:]))
    found = check_machine(broken, 10, np.random.default_rng(0))
    assert any("upper must be above lower" in text for text in found.problems)
