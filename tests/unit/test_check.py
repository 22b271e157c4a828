"""A machine is made of a URDF or MJCF, and a check says what keeps it from training."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_mode
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.modes.check import check_machine, try_machine
from brokk_rl.sim.check_subject import CheckSubject
from brokk_rl.sim.model import ASSETS
from brokk_rl.sim.model_import import ImportedMachine, import_model
from brokk_rl.sim.scene import make_empty_scenes

INERTIA = '<inertia ixx="1" iyy="2" izz="2" ixy="0" ixz="0" iyz="0"/>'


def link(name: str, x_m: float, mass_kg: float, inertia: str = INERTIA) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{x_m} 0 0" rpy="0 0.3 0"/><mass value="{mass_kg}"/>{inertia}</inertial>'
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
URDF = f"""<robot name="arm"><link name="base"/>{link("mast", 0.2, 40)}{link("beam", 0.5, 30)}
{link("pole", 0.4, 20)}{link("lamp", 0.1, 2)}<link name="tool0"/>
{joint("slew", "revolute", "base", "mast", 'xyz="0 0 0.3"', "0 0 1", SLEW)}
{joint("lift", "revolute", "mast", "beam", 'xyz="0.1 0 0.4" rpy="0.2 0 0"', "0 1 0", LIFT)}
{joint("reach", "prismatic", "beam", "pole", 'xyz="1 0 0" rpy="0 0.5 0"', limit='lower="0" upper="0.8"')}
{joint("turn", "revolute", "mast", "lamp", 'xyz="0 0.3 0"', "0 0 1", 'lower="0" upper="1"')}
{joint("flange", "fixed", "pole", "tool0", 'xyz="0.9 0 0"')}</robot>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return path


def read(text: str, folder: Path, **changes: Any) -> ImportedMachine:
    path = folder / ("model.urdf" if "<robot" in text else "model.xml")
    path.write_text(text)
    return import_file(path, **changes)


def import_file(path: Path, **changes: Any) -> ImportedMachine:
    counts = dict.fromkeys(("num_poses", "num_starts"), 1)
    choices = dict.fromkeys(("chain", "tip", "name")) | counts
    choices |= {"model": str(path), "packages": (), "drive": "auto", "command": "auto"} | changes
    return import_model(path, "model", CheckSubject(**choices))


def test_a_urdf_becomes_a_machine_that_moves_as_mujoco_moves_it(urdf: Path) -> None:
    machine = import_file(urdf).build()
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
    imported = import_file(urdf)
    slew, _, reach = imported.build().joints
    assert (slew.lower.value, slew.max_speed.value, slew.command) == (-2.0, 0.5, "velocity")
    assert slew.body and reach.body
    assert slew.body.mass_kg.value == 42.0, "the lamp rides on the mast"
    assert slew.body.yield_force.value == 3000.0 and slew.body.yield_force.confidence == "medium"
    assert reach.max_speed.confidence == "low" and reach.body.yield_force.confidence == "low"
    remarks = " ".join(imported.remarks)
    for text in ("turn: not part of the chain", "no speed at full command", "frame 'tool0'"):
        assert text in remarks


def test_the_mjcf_of_an_import_has_the_inertia_of_its_source(urdf: Path, tmp_path: Path) -> None:
    made = mujoco.MjModel.from_xml_string(import_file(urdf).mjcf)
    source = mujoco.MjSpec.from_file(str(urdf)).compile()
    kept = [source.joint(name).dofadr[0] for name in ("slew", "lift", "reach")]
    full = []
    for model, q in ((source, [0.4, -0.6, 0.5, 0.0]), (made, [0.4, -0.6, 0.5])):
        data = mujoco.MjData(model)
        names = ("slew", "lift", "reach", "turn")[: len(q)]
        for name, value in zip(names, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        full.append(matrix)
    assert full[1] == pytest.approx(full[0][np.ix_(kept, kept)], rel=1e-4, abs=1e-4)


def test_our_own_mjcf_gives_our_own_machine(machine: Machine) -> None:
    assert machine.mjcf
    made = import_file(ASSETS / machine.mjcf).build()
    for q in (machine.home, machine.lower, machine.upper):
        tips = [compute_tool_kinematics(one, q).tip_in_base_m for one in (machine, made)]
        assert tips[0] == pytest.approx(tips[1], abs=1e-5)
    assert made.lower == pytest.approx(machine.lower) and made.upper == pytest.approx(machine.upper)
    masses = [[body.mass_kg.value for body in one.bodies] for one in (machine, made)]
    assert masses[1] == pytest.approx(masses[0])


# --- numbers as people write them ---


def edit(old: str, new: str) -> str:
    assert old in URDF
    return URDF.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "lower", "upper", "speed", "told"),
    [
        (edit(SLEW, SLEW.replace("0.5", "1,8")), -2.0, 2.0, 1.8, ""),
        (edit('velocity="0.5"', 'velocity="inf"'), -2.0, 2.0, 1.0, "no speed at full command"),
        (edit('velocity="0.5"', 'velocity="1e9"'), -2.0, 2.0, 1.0, "is doubted"),
        (edit('lower="-2" upper="2"', 'lower="2" upper="-2"'), -2.0, 2.0, 0.5, "swapped"),
        (edit('lower="-2" upper="2"', ""), -np.pi, np.pi, 0.5, "no limits"),
        (edit('lower="-2" upper="2"', 'lower="0" upper="0"'), -np.pi, np.pi, 0.5, "no limits"),
        (
            edit(SLEW, SLEW.replace('-2" upper="2', '-90" upper="70').replace("0.5", "90")),
            np.radians(-90), np.radians(70), np.pi / 2, "read as degrees",
        ),
        (edit(INERTIA, INERTIA.replace("1", "9")), -2.0, 2.0, 0.5, "link 'mast': no inertia that a body has"),
        (edit('lower="-2" upper="2"', 'upper="2"'), 0.0, 2.0, 0.5, ""),
        (edit('xyz="0 0 0.3"', 'xyz="0 0 -9"'), -2.0, 2.0, 0.5, "No pose lies above the ground"),
        (edit(INERTIA, INERTIA.replace("1", "0")), -2.0, 2.0, 0.5, "link 'mast': no inertia that a body has"),
        (edit('<mass value="30"/>', '<mass value="0"/>'), -2.0, 2.0, 0.5, "beam: no mass"),
    ],
)  # fmt: skip
def test_odd_numbers_of_a_urdf_are_read_with_a_remark(
    text: str, lower: float, upper: float, speed: float, told: str, tmp_path: Path
) -> None:
    found = read(text, tmp_path)
    slew = found.build().joints[0]
    assert told in " ".join(found.remarks)
    assert (slew.lower.value, slew.upper.value) == pytest.approx((lower, upper), rel=1e-4)
    assert slew.max_speed.value == pytest.approx(speed, rel=1e-4)


SCENE = "<mujoco><worldbody>{}</worldbody>{}</mujoco>"
BALL = '<geom size="0.1"/>'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<robot", "cannot read it"),
        ('<sdf version="1.6"/>', "expected a URDF"),
        (edit('velocity="0.5"', 'velocity="${max}"'), "xacro arm.urdf|xacro model.urdf"),
        (edit('<link name="base"/>', '<link name="base"/><x:if xmlns:x="http://ros.org/wiki/xacro"/>'), "xacro"),
        (edit('<child link="beam"/>', '<child link="bean"/>'), "joint parent or child missing\nElement 'joint', line"),
        (edit('xyz="0 0 0.3"', 'xyz="0 0 nan"'), "is not finite"),
        (edit('<mass value="40"/>', '<mass value="-40"/>'), "link 'mast'.*mass of -40"),
        (edit(INERTIA, INERTIA.replace('"1"', '"-1"')), "link 'mast' has a principal inertia"),
        (SCENE.format(f"<body><freejoint/>{BALL}</body>", ""), "neither a hinge"),
        (SCENE.format("", ""), "no joint that moves"),
        (
            SCENE.format(2 * f'<body pos="0 0 1"><joint/>{BALL}<body pos="1 0 0"><joint/>{BALL}</body></body>', ""),
            "2 chains of 2 joints are alike",
        ),
        (
            SCENE.format(f"<body name='trunk'><freejoint/>{BALL}" + 4 * (
                f'<body pos="1 0 0"><joint axis="0 1 0"/>{BALL}<body pos="1 0 0"><joint axis="0 1 0"/>{BALL}</body></body>'
            ) + "</body>", ""),
            "4 chains of 2 joints are alike.*a robot that walks",
        ),
    ],
)  # fmt: skip
def test_a_model_that_cannot_be_read_is_refused_by_name(
    text: str, told: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=told):
        read(text, tmp_path)


# --- which joints are the arm ---


def nest(*names: str, inside: str = "") -> str:
    text = inside
    for name in reversed(names):
        kind = 'type="slide" range="0 0.4"' if name.startswith("slide") else 'range="-60 60"'
        text = f'<body name="{name}_link" pos="0.5 0 0"><joint name="{name}" axis="0 1 0" {kind}/>{BALL}{text}</body>'
    return text


FINGERS = nest("left_finger") + nest("right_finger")
ARM = ("a", "b", "c")
MOTORS = "<actuator>" + "".join(f'<motor joint="{name}"/>' for name in ARM) + "</actuator>"
TABLE = '<joint name="x" type="slide"/><joint name="y" type="slide" axis="0 1 0"/>'
WELD = '<equality><weld body1="c_link" body2="rod_link"/></equality>'
LOOP = '<equality><connect body1="slide_link" body2="a_link" anchor="0 0 0"/></equality>'


@pytest.mark.parametrize(
    ("text", "choices", "joints", "told"),
    [
        (SCENE.format(nest(*ARM, inside=FINGERS), ""), {}, ARM, "left_finger, right_finger: not part"),
        (SCENE.format(nest(*ARM, inside=FINGERS), ""), {"chain": ("b",)}, ("a", "b"), "c, left_finger, right_finger: not part"),
        (SCENE.format(nest(*ARM), ""), {"chain": ("a_link", "c_link")}, ("b", "c"), "a: not part"),
        (SCENE.format(nest(*ARM), ""), {"chain": ("b", "c")}, ("b", "c"), "a: not part"),
        (SCENE.format(nest(*ARM) + nest("door") + nest("drawer"), MOTORS), {}, ARM, "drawer_link, door_link: not of the robot"),
        (SCENE.format(nest(*ARM, inside='<site name="x" pos="1 0 0"/>'), ""), {"tip": "x"}, ARM, ""),
        (
            SCENE.format(nest(*ARM), '<equality><joint joint1="c" joint2="b"/></equality>'),
            {}, ("a", "b"), "c: follows b",
        ),
        (
            SCENE.format(nest(*ARM) + f'<body name="box" pos="3 0 0"><freejoint/>{BALL}</body>', ""),
            {}, ARM, "box: not of the robot",
        ),
        (SCENE.format(nest("swing", "slide") + nest("a", "b"), LOOP), {}, ("a", "b"), "closes a loop of swing, slide"),
        (SCENE.format(nest(*ARM) + nest("rod"), WELD), {}, ARM, "closes a loop of rod"),
        (
            SCENE.format(f'<body>{TABLE}{BALL}{nest("a")}</body>', ""),
            {}, ("x", "y", "a"), "no limits",
        ),
    ],
)  # fmt: skip
def test_the_arm_is_found_among_other_joints(
    text: str, choices: Any, joints: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    found = read(text, tmp_path, **choices)
    machine = found.build()
    assert machine.joint_names == joints
    assert told in " ".join(found.remarks)
    assert {one.command for one in machine.joints} == {"valve" if LOOP in text else "velocity"}


def test_home_is_above_the_ground(tmp_path: Path) -> None:
    low = nest("a", "b").replace('pos="0.5 0 0"', 'pos="0 0 0.05"', 1)
    machine = read(SCENE.format(low, ""), tmp_path).build()
    assert machine.home[0] < 0.0, "a positive turn about y lowers the arm"
    text = SCENE.format(low, '<keyframe><key qpos="-0.5 0.1"/></keyframe>')
    assert read(text, tmp_path).build().home == pytest.approx([-0.5, 0.1])


def test_a_robot_in_a_scene_stands_at_the_origin(tmp_path: Path) -> None:
    turned = nest("a").replace('pos="0.5 0 0"', 'pos="3 4 0.2" euler="0 0 90"')
    machine = read(SCENE.format(turned, ""), tmp_path).build()
    (body,) = machine.bodies
    assert [one.value for one in body.origin_m] == pytest.approx([0.0, 0.0, 0.2])
    assert body.axis == pytest.approx((0.0, 1.0, 0.0))


MOTOR = '<motor joint="{}" gear="10" ctrlrange="-2 2"/>'


@pytest.mark.parametrize(
    ("actuator", "choices", "interface", "force"),
    [
        ('<position joint="{}" kp="5" forcerange="-3 3"/>', {}, "position", 3.0),
        ('<velocity joint="{}" kv="5" forcerange="-3 3"/>', {}, "speed", 3.0),
        (MOTOR, {}, "speed", 20.0),
        (MOTOR, {"command": "torque"}, "torque", 20.0),
    ],
)
def test_an_mjcf_says_what_commands_its_joints_and_how_strongly(
    actuator: str, choices: Any, interface: str, force: float, tmp_path: Path
) -> None:
    drives = "".join(actuator.format(name) for name in ("lift", "tilt"))
    text = SCENE.format(nest("lift", "tilt"), f"<actuator>{drives}</actuator>")
    machine = read(text, tmp_path, **choices).build()
    assert machine.interface == interface
    assert [body.yield_force.value for body in machine.bodies] == [force, force]
    if interface == "torque":
        assert machine.max_force.tolist() == [force, force]


def test_joints_without_names_keep_their_own_limits_and_equal_names_are_told_apart(
    tmp_path: Path,
) -> None:
    text = re.sub(' name="[^"]*"', "", nest("a", "b")).replace("-60 60", "-30 30", 1)
    first, second = read(SCENE.format(text, ""), tmp_path).build().joints
    assert (first.name, second.name) == ("q1", "q2")
    assert first.upper.value == pytest.approx(np.pi / 6, rel=1e-4)
    assert second.upper.value == pytest.approx(np.pi / 3, rel=1e-4)
    clash = edit('name="lift"', 'name="a b"').replace('name="reach"', 'name="a_b"')
    assert read(clash, tmp_path).build().joint_names == ("slew", "a_b", "a_b_")


@pytest.mark.parametrize("where", ["package", "variable", "key"])
def test_meshes_of_a_package_are_found_and_kept(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "elsewhere" / "arm_description"
    file = tmp_path / "arm_description" / "urdf" / "arm.urdf"
    file.parent.mkdir(parents=True)
    mesh = (folder if where != "package" else file.parent.parent) / "meshes" / "the mast.stl"
    mesh.parent.mkdir(parents=True)
    trimesh.creation.box((0.2, 0.1, 0.3)).export(mesh)
    if where == "variable":
        monkeypatch.setenv("ROS_PACKAGE_PATH", str(folder.parent))
    shape = '<visual><geometry><mesh filename="package://arm_description\\meshes/the%20mast.stl"/></geometry></visual>'
    file.write_text(edit('<link name="mast">', f'<link name="mast">{shape}'))
    packages = (str(folder.parent),) if where == "key" else ()
    found = import_file(file, packages=packages)
    (name,) = found.meshes
    assert f'file="{name}"' in found.mjcf
    spec = mujoco.MjSpec.from_string(found.mjcf)
    spec.assets = found.meshes
    # MuJoCo turns a mesh to its principal axes
    size_m = np.ptp(spec.compile().mesh_vert, axis=0)
    assert sorted(size_m) == pytest.approx([0.1, 0.2, 0.3], abs=1e-4)


def test_a_mesh_that_is_missing_is_left_out_with_a_remark(tmp_path: Path) -> None:
    shape = '<visual><geometry><mesh filename="package://x/y.stl"/></geometry></visual>'
    found = read(edit('<link name="mast">', f'<link name="mast">{shape}'), tmp_path)
    assert "package://x/y.stl" in " ".join(found.remarks) and not found.meshes


# --- the check ---


def test_a_check_makes_the_files_of_a_machine_that_other_modes_take(
    urdf: Path, brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.starts.MIN_CANDIDATES", 1024)  # a task of another machine
    few = ("subject.num_poses=200", "subject.num_starts=16", "actuator=lag")
    done = brokk("mode=check", f"subject.model={urdf}", *few, "session.out=made")
    assert done.code == 0, done.err
    assert "It can be simulated and trained" in done.out and "machine=@made/arm.yaml" in done.out
    again = brokk("mode=check", "machine=@made/arm.yaml", *few, "session.out=again")
    assert again.code == 0, again.err
    assert "nearly no start" in again.out, "the task is one of a Brokk"
    first, second = (json.loads(Path(run, "check.json").read_text()) for run in ("made", "again"))
    assert first["joints"] == second["joints"] and second["contact"] == ["reach_link"]
    assert (first["problems"], first["unfit"], second["problems"]) == ([], [], [])
    for text in first["missing"]:
        assert text in done.out


def test_drives_that_are_too_stiff_are_named_with_a_stiffness_that_is_not(machine: Machine) -> None:
    def simulate(stiffness: float) -> str | None:
        joints = list(machine.joints)
        body = machine.bodies[3]
        numbers = {"stiffness": replace(body.stiffness, value=stiffness)}
        numbers["yield_force"] = replace(body.yield_force, value=1e7)
        joints[3] = replace(joints[3], body=replace(body, **numbers))
        strong = replace(machine, joints=tuple(joints))
        q = torch.tensor(machine.home, dtype=torch.float32).repeat(64, 1)
        drawn = {"q": q, "scene": make_empty_scenes(64)}
        world = option("sim", "native").build(strong, torch.device("cpu"), 64)
        return try_machine(strong, world, None, drawn)[0]

    text = simulate(1e8)
    assert text and "q4 swings fastest" in text
    calm = float(text.split(" to ")[-1].split(",")[0])
    assert simulate(calm) is None


def test_missing_links_and_lengths_and_forces_of_another_unit_are_told(tmp_path: Path) -> None:
    mode = load_mode("mode=check", "machine=mini_excavator", "session.out=unused")
    found = check_machine(mode.machine, 10, np.random.default_rng(0))
    assert found.problems == [] and found.reach == {}
    assert any("recorded and identified" in text for text in found.missing)
    in_mm = read(edit('xyz="1 0 0"', 'xyz="1000 0 0"'), tmp_path).build()
    told = " ".join(check_machine(in_mm, 10, np.random.default_rng(0)).missing)
    assert "m is doubted" in told and "lift: the yield force is less than the weight" in told
