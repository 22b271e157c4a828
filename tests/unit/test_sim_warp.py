"""The Warp world on a CPU against the native world; kernels compile for half a minute at first use."""

from dataclasses import replace

import mujoco_warp
import pytest
import torch
from composed import option

from brokk_rl.errors import DeviceError
from brokk_rl.sim.native_world import NativeWorld
from brokk_rl.sim.simulator import AutoSimulator, NativeSimulator

NUM_WORLDS = 8
WARP = replace(option("sim", "warp"), num_worlds=NUM_WORLDS, parity_worlds=0)
NATIVE = NativeSimulator(num_worlds=NUM_WORLDS, substeps=5, num_threads=2)


def _motion(machine, steps, push):
    """Yields smooth random increments; `push` lowers the second joint all the while."""
    generator = torch.Generator().manual_seed(0)
    velocity = torch.zeros(NUM_WORLDS, machine.num_joints)
    speed = 1.5 * torch.tensor(machine.max_speed, dtype=torch.float32)
    for _ in range(steps):
        velocity = 0.9 * velocity + 0.1 * speed * torch.randn(velocity.shape, generator=generator)
        velocity[:, 1] += push
        yield velocity * machine.period_s


@pytest.mark.slow
def test_five_seconds_of_motion_and_contact_agree_with_the_native_world(machine):
    worlds = [spec.build(machine, "cpu") for spec in (NATIVE, WARP)]
    largest, pressed, felt = torch.zeros(3, NUM_WORLDS)
    for increment in _motion(machine, steps=100, push=0.004):
        for world in worlds:
            world.step(increment)
        native, warp = worlds
        largest = torch.maximum(largest, (native.q - warp.q).abs().amax(1))
        pressed = torch.maximum(pressed, native.contact_force_n)
        felt = torch.maximum(felt, warp.contact_force_n)
        untouched = pressed == 0.0
        assert (largest[untouched] < 1e-5).all()
    assert (pressed > 1_000).sum() >= 3
    assert not any(world.faults.any() for world in worlds)
    # contact amplifies rounding: a stop that is met edge on may be passed on either side, so not
    # every world must agree
    alike = largest < 5e-3
    assert alike.sum() >= NUM_WORLDS - 1
    torch.testing.assert_close(felt[alike], pressed[alike], rtol=1e-2, atol=1.0)


@pytest.mark.slow
def test_a_control_step_is_that_of_mujoco_warp(machine):
    """From the same state, in the air and pressed onto the ground."""
    ours, whole = WARP.build(machine, "cpu"), WARP.build(machine, "cpu")
    whole._substep = lambda: mujoco_warp.step(whole._model, whole._data)
    pressed = 0.0
    for increment in _motion(machine, steps=40, push=0.006):
        whole.load_state_dict(ours.state_dict())
        ours.step(increment)
        whole.step(increment)
        pressed = max(pressed, float(ours.contact_force_n.amax()))
        torch.testing.assert_close(ours.q, whole.q, rtol=0.0, atol=2e-5)
    assert pressed > 1_000.0


def test_a_device_that_a_simulator_cannot_use_is_an_error_that_says_what_to_do(machine):
    auto = AutoSimulator(native=NATIVE, warp=WARP)
    with pytest.raises(DeviceError, match="sim=warp"):
        NATIVE.build(machine, torch.device("cuda"))
    for spec in (WARP, auto) * (not torch.cuda.is_available()):
        with pytest.raises(DeviceError, match="sim=native"):
            spec.build(machine, "cuda")
    assert isinstance(auto.build(machine, "cpu", num_worlds=3), NativeWorld)
