"""A simulator that leaves out a part of an MJCF is seen by its motion, or refused by name."""

import dataclasses
from typing import Any

import pytest
import torch
from composed import MACHINE, option

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.model import ASSETS, check_simulated, compile_model
from brokk_rl.sim.parity import POSITION_TOLERANCE, check_parity, measure_parity
from brokk_rl.sim.simulator import NativeSimulator

SUBSTEPS = 5
NUM_WORLDS = 32
NATIVE = NativeSimulator(num_worlds=NUM_WORLDS, substeps=SUBSTEPS, num_threads=0)
JOINT, TOOL = '<joint name="q3"', '<geom name="chisel" class="chisel_contact"'
OPTIONS = '<compiler angle="radian" autolimits="true"/>'

CHANGES: dict[str, tuple[str, str]] = {
    "effort limit": (JOINT, '<joint actuatorfrcrange="-4000 4000" name="q3"'),
    "damping": (JOINT, '<joint damping="90000" name="q3"'),
    "polynomial damping": (JOINT, '<joint damping="0 300000 0" name="q3"'),
    "stiffness": (JOINT, '<joint stiffness="500000" name="q3"'),
    "polynomial stiffness": (JOINT, '<joint stiffness="0 500000 0" name="q3"'),
    "friction": (JOINT, '<joint frictionloss="9000" name="q3"'),
    "armature": (JOINT, '<joint armature="900" name="q3"'),
    "soft limits": (JOINT, '<joint solreflimit="0.2 1" margin="0.05" name="q3"'),
    "adhesion": (TOOL, f'{TOOL} adhesion="9000"'),
    "surface velocity": (TOOL, f'{TOOL} surfacevel="0.9 0.4 0"'),
    "torsional friction": (TOOL, f'{TOOL} condim="4"'),
    "soft contact": (TOOL, f'{TOOL} solref="0.2 1" priority="1"'),
    "margin": (TOOL, f'{TOOL} margin="0.03"'),
    "no actuation": (OPTIONS, f'{OPTIONS}<option><flag actuation="disable"/></option>'),
    "no contact": (OPTIONS, f'{OPTIONS}<option><flag contact="disable"/></option>'),
    "no limits": (OPTIONS, f'{OPTIONS}<option><flag limit="disable"/></option>'),
    "water": (OPTIONS, f'{OPTIONS}<option density="9000" viscosity="90"/>'),
    "friction cone": (OPTIONS, f'{OPTIONS}<option impratio="20"/>'),
    "fixed length": (
        "</worldbody>",
        '</worldbody><tendon><fixed name="t" stiffness="900000"><joint joint="q3" coef="1"/></fixed></tendon>',
    ),
    "coupled joints": (
        "</worldbody>",
        '</worldbody><equality><joint joint1="q3" joint2="q4" polycoef="0 1 0 0 0"/></equality>',
    ),
}
"""Parts that an MJCF may have: the text of the shipped one, and what stands there instead."""


def change_mjcf(folder, change: tuple[str, str]) -> Machine:
    """Return the machine with a changed MJCF."""
    text = (ASSETS / MACHINE.mjcf).read_text()
    assert change[0] in text
    (folder / "changed.xml").write_text(text.replace(*change))
    return dataclasses.replace(MACHINE, mjcf=str(folder / "changed.xml"))


def make_warp():
    """Return worlds of `sim=warp` on the CPU, not yet compared, with a solver that goes to its end."""
    simulator = dataclasses.replace(
        option("sim", "warp"), parity_worlds=0, iterations=50, linesearch_iterations=50
    )
    return simulator.build(MACHINE, "cpu", NUM_WORLDS)


@pytest.mark.parametrize("name", CHANGES)
def test_each_part_matters_so_that_leaving_it_out_would_be_seen(tmp_path, name):
    """MuJoCo C with the part in place of the simulator, and without it as the reference."""
    changed = change_mjcf(tmp_path, CHANGES[name])
    try:
        world = NATIVE.build(changed, "cpu")
    except ConfigError:
        return
    result = measure_parity(world, MACHINE, SUBSTEPS)
    assert not result.is_alike, result.describe()


@pytest.mark.slow
def test_the_shipped_machine_is_alike_in_all_worlds():
    result = check_parity(make_warp(), MACHINE, SUBSTEPS)
    assert result.num_different == 0 and result.num_touching >= 10
    assert result.position_error.max() < POSITION_TOLERANCE / 5


class Spoiled:
    """A native world of which one thing is wrong."""

    def __init__(self, fault: str) -> None:
        self._world, self._fault = NATIVE.build(MACHINE, "cpu"), fault
        self.num_worlds, self.device = NUM_WORLDS, torch.device("cpu")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    @property
    def contact_force_n(self) -> torch.Tensor:
        return self._world.contact_force_n * (0.9 if self._fault == "force" else 1.0)

    def step(self, increment: torch.Tensor) -> None:
        self._world.step(increment * (1.02 if self._fault == "motion" else 1.0))
        if self._fault == "nan":
            self._world.q[0:4] = torch.nan
        if self._fault == "fault":
            self.faults = self._world.faults | (torch.arange(NUM_WORLDS) < 4)


@pytest.mark.parametrize("fault", ["motion", "force", "nan", "fault", ""])
def test_a_simulator_that_is_wrong_is_refused_with_figures(fault):
    if not fault:
        result = check_parity(Spoiled(""), MACHINE, SUBSTEPS)
        assert result.num_different == 0 and result.position_error.max() == 0.0
        return
    with pytest.raises(ConfigError, match=r"as MuJoCo C does: 32 random states"):
        check_parity(Spoiled(fault), MACHINE, SUBSTEPS)


def test_refusals_name_only_backends_that_simulate_the_part(tmp_path):
    def refuse(name: str) -> str:
        model = compile_model(change_mjcf(tmp_path, CHANGES[name]), 0.01)
        with pytest.raises(ConfigError) as refusal:
            check_simulated(model, "brokk170", is_warp=True)
        return str(refusal.value)

    assert refuse("friction").endswith("choose sim=native")
    assert refuse("no actuation").endswith("from the MJCF")
    with pytest.raises(ConfigError, match=r"sim=native.*actuation=disable"):
        NATIVE.build(change_mjcf(tmp_path, CHANGES["no actuation"]), "cpu", 1)


def test_actuators_in_an_mjcf_are_refused(tmp_path):
    own = "</worldbody>", '</worldbody><actuator><motor name="winch" joint="q3"/></actuator>'
    with pytest.raises(ConfigError, match=r"has actuators \(winch\)"):
        compile_model(change_mjcf(tmp_path, own), 0.01)


@pytest.mark.parametrize(
    ("joint", "change"),
    [
        ("q3", (JOINT, '<joint ref="0.4" name="q3"')),
        ("q4", ('<body name="q4_link"', '<body euler="0 0.3 0" name="q4_link"')),
        ("q5", ('<body name="q5_link"', '<body quat="0.99 0.1 0 0" name="q5_link"')),
        ("q1", ('<body name="undercarriage"', '<body pos="0 0 0.1" name="undercarriage"')),
    ],
)
def test_an_arm_that_does_not_stand_where_the_yaml_has_it_is_refused_by_its_joint(
    tmp_path, joint, change
):
    with pytest.raises(ConfigError, match=rf"m away in random poses: joint {joint} "):
        compile_model(change_mjcf(tmp_path, change), 0.01)
