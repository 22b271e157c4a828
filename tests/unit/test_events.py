"""Properties that differ from world to world, and the events that draw them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, every, option
from promises import NUM_ENVS, check_world

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.events import Event
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import NativeSimulator, list_events

NUM = 4
ALL = ("mass", "friction", "stiffness", "yield_force")
CPU = torch.device("cpu")
NATIVE = NativeSimulator(num_worlds=NUM, substeps=5, num_threads=1)
FACTORS = {
    "mass": torch.tensor([[1.0] * 5, [2.0] * 5, [1.0, 0.5, 1.5, 2.0, 0.7], [1.0] * 5]),
    "friction": torch.tensor([[1.0], [0.5], [1.0], [2.0]]),
    "stiffness": torch.tensor([[1.0] * 5, [0.5] * 5, [1.0, 2.0, 0.7, 1.0, 1.4], [1.0] * 5]),
    "yield_force": torch.tensor([[1.0] * 5, [1.0] * 5, [0.8] * 5, [0.3] * 5]),
}


def event(name: str, **changes: Any) -> Event:
    return dataclasses.replace(option("event", name), **changes)


FIELDS = (
    "body_mass", "body_inertia", "geom_friction", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange",
)  # fmt: skip
FIXED = tuple(event(name, when="startup", factor=(1.0, 1.0)) for name in ALL)
"""Events that change nothing by themselves."""


def vary(world: Any) -> Any:
    for name, factor in FACTORS.items():
        world._properties.factors[name].copy_(factor)
    world._properties.apply()
    return world


def drive_into_the_ground(worlds: list[Any]) -> list[list[np.ndarray]]:
    """Returns positions and forces of every world over time."""
    increment = torch.zeros(NUM, MACHINE.num_joints)
    increment[:, 1], increment[:, 0] = 0.006, 0.01
    found: list[list[np.ndarray]] = [[] for _ in worlds]
    for step in range(50):
        for path, world in zip(found, worlds, strict=True):
            world.step(increment if step > 5 else torch.zeros_like(increment))
            force = world.contact_force_n[:, None] / 1e6
            path.append(torch.cat((world.q, force), 1).numpy().copy())
    return found


def test_each_world_is_plain_mujoco_with_edited_numbers() -> None:
    world: Any = vary(NATIVE.build(MACHINE, "cpu", None, events=FIXED))
    home = torch.tensor(MACHINE.home).float().repeat(NUM, 1)
    world.reset(torch.ones(NUM, dtype=torch.bool), home, make_nominal_scenes(NUM))
    for i in range(NUM):
        edited = compile_model(MACHINE, 0.01)
        for j, name in enumerate(MACHINE.joint_names):
            body = edited.joint(name).bodyid[0]
            edited.body_mass[body] *= float(FACTORS["mass"][i, j])
            edited.body_inertia[body] *= float(FACTORS["mass"][i, j])
            stiff = float(FACTORS["stiffness"][i, j])
            edited.actuator_gainprm[j, 0] *= stiff
            edited.actuator_biasprm[j, 1] *= stiff
            edited.actuator_biasprm[j, 2] *= np.sqrt(stiff)
            edited.actuator_forcerange[j] *= float(FACTORS["yield_force"][i, j])
        edited.geom_friction[:] *= float(FACTORS["friction"][i, 0])
        used = world._batch.get_model(i)
        for field in FIELDS:
            np.testing.assert_allclose(getattr(used, field), getattr(edited, field), rtol=1e-6)
        np.testing.assert_allclose(used.body_subtreemass[0], edited.body_mass.sum(), rtol=1e-6)


@pytest.mark.slow
def test_warp_worlds_with_the_same_factors_agree_with_the_native_ones() -> None:
    sim = dataclasses.replace(option("sim", "warp"), num_worlds=NUM)
    worlds = [vary(spec.build(MACHINE, "cpu", NUM, events=FIXED)) for spec in (NATIVE, sim)]
    native, warp = (np.array(path) for path in drive_into_the_ground(worlds))
    assert native[..., -1].max() > 0
    free = native[:12]
    np.testing.assert_allclose(warp[:12], free, atol=2e-5)
    np.testing.assert_allclose(warp[..., :-1], native[..., :-1], atol=2e-3)
    # the factors show: heavy, soft or yielding arms go other ways
    assert np.abs(native[-1, 1:, :-1] - native[-1, 0, :-1]).max() > 5e-4


@every("event")
def test_every_event_keeps_a_world_a_world(name: str) -> None:
    class Varied:
        def build(self, machine: Machine, device: Any, num_worlds: int | None = None) -> Any:
            return NATIVE.build(machine, CPU, num_worlds, events=(option("event", name),))

    check_world(Varied(), MACHINE, make_nominal_scenes(NUM_ENVS), "cpu")


def test_an_event_draws_when_it_says() -> None:
    def build(**changes: Any) -> Any:
        return NATIVE.build(MACHINE, CPU, NUM, events=(event("mass", **changes),))

    def look(world: Any) -> torch.Tensor:
        return world._properties.factors["mass"].clone()

    still = torch.zeros(NUM, MACHINE.num_joints)
    home = torch.tensor(MACHINE.home).float().repeat(NUM, 1)
    first = torch.tensor([True, False, False, False])
    torch.manual_seed(1)
    startup, reset = build(when="startup"), build(when="reset")
    for world, changed in ((startup, False), (reset, True)):
        before = look(world)
        assert ((before >= 0.8) & (before <= 1.2)).all()
        assert before.std() > 0.02
        world.step(still)
        assert torch.equal(look(world), before)
        world.reset(first, home, make_nominal_scenes(NUM))
        assert (look(world)[0] != before[0]).all() == changed
        assert torch.equal(look(world)[1:], before[1:])


def test_a_restored_state_keeps_its_properties() -> None:
    world: Any = NATIVE.build(MACHINE, CPU, NUM, events=(event("mass"), event("yield_force")))
    state = world.state_dict()
    kept = world._properties.factors["mass"].clone()
    home = torch.tensor(MACHINE.home).float().repeat(NUM, 1)
    world.reset(torch.ones(NUM, dtype=torch.bool), home, make_nominal_scenes(NUM))
    assert not torch.equal(world._properties.factors["mass"], kept)
    world.load_state_dict(state)
    assert torch.equal(world._properties.factors["mass"], kept)


def test_what_cannot_be_varied_is_refused_by_name() -> None:
    class Plain:
        def build(self, machine: Machine, device: Any, num_worlds: int | None = None) -> Any: ...

    with pytest.raises(ConfigError, match=r"event=mass: sim=.*cannot vary"):
        list_events({"mass": event("mass")}, Plain())
    with pytest.raises(ConfigError, match="two of mass, heavy change mass"):
        list_events({"mass": event("mass"), "heavy": event("mass")}, NATIVE)
