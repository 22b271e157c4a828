"""The Warp world on a CPU against the native world; kernels compile for half a minute at first use."""

import dataclasses

import mujoco_warp
import pytest
import torch

from brokk_rl.errors import ConfigError, DeviceError
from brokk_rl.sim.model import ASSETS
from brokk_rl.sim.native_world import NativeWorld
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import AutoSimulator, NativeSimulator, WarpSimulator

NUM_WORLDS = 8
WARP = WarpSimulator(
    num_worlds=NUM_WORLDS,
    substeps=5,
    num_contacts=16,
    num_constraints=40,
    iterations=12,
    linesearch_iterations=8,
    tolerance=1e-6,
    parity_worlds=0,
)
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
    largest, pressed = torch.zeros(NUM_WORLDS), torch.zeros(NUM_WORLDS)
    for increment in _motion(machine, steps=100, push=0.004):
        for world in worlds:
            world.step(increment)
        native, warp = worlds
        largest = torch.maximum(largest, (native.q - warp.q).abs().amax(1))
        pressed = torch.maximum(pressed, native.contact_force_n)
        untouched = pressed == 0.0
        assert (largest[untouched] < 1e-5).all()
    assert (pressed > 1_000).sum() >= 3
    assert not any(world.faults.any() for world in worlds)
    # contact amplifies rounding: a stop that is met edge on may be passed on either side, so not
    # every world must agree
    assert (largest < 5e-3).sum() >= NUM_WORLDS - 1


@pytest.mark.slow
def test_a_peak_of_force_is_the_same_in_both_worlds(machine):
    native, warp = (spec.build(machine, "cpu") for spec in (NATIVE, WARP))
    down = torch.zeros(NUM_WORLDS, machine.num_joints)
    down[:, 1] = 0.003
    peaks = [torch.zeros(NUM_WORLDS), torch.zeros(NUM_WORLDS)]
    for _ in range(60):
        for world, peak in zip((native, warp), peaks, strict=True):
            world.step(down)
            torch.maximum(peak, world.contact_force_n, out=peak)
    assert (peaks[0] > 1_000).all()
    torch.testing.assert_close(peaks[1], peaks[0], rtol=1e-2, atol=1.0)


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


@pytest.mark.slow
def test_a_masked_reset_and_a_restored_state_are_exact(machine):
    world = WARP.build(machine, "cpu")
    for increment in _motion(machine, steps=10, push=0.0):
        world.step(increment)
    before = world.state_dict()
    mask = torch.zeros(NUM_WORLDS, dtype=torch.bool)
    mask[2] = True
    scene = make_nominal_scenes(NUM_WORLDS)
    scene[:, 4] = 1.1
    world.reset(mask, torch.zeros(NUM_WORLDS, machine.num_joints), scene)
    after = world.state_dict()
    for name, tensor in before.items():
        assert torch.equal(tensor[~mask], after[name][~mask]), name
    assert (world.q[2] == 0.0).all()
    world.load_state_dict(before)
    finals = []
    for _ in range(2):
        world.load_state_dict(before)
        for increment in _motion(machine, steps=5, push=0.0):
            world.step(increment)
        finals.append(world.q.clone())
    assert torch.equal(*finals)


@pytest.mark.slow
def test_nan_and_a_full_buffer_are_faults_of_their_worlds_alone(machine):
    world = dataclasses.replace(WARP, num_worlds=3, num_constraints=2).build(machine, "cpu")
    start, scene = world.q.clone(), make_nominal_scenes(3)
    start[2] = torch.tensor([0.0, 0.0, 0.9, 1.0, -0.329])  # deep in the ground: more rows than two
    world.reset(torch.ones(3, dtype=torch.bool), start, scene)
    increment = torch.zeros(3, machine.num_joints)
    increment[1, 0] = float("nan")
    world.step(increment)
    assert world.faults.tolist() == [False, True, True]


def test_what_the_launches_leave_out_is_refused_by_name(machine, tmp_path):
    text = (ASSETS / machine.mjcf).read_text()
    drawn = '<joint name="q3"'
    assert drawn in text
    (tmp_path / "other.xml").write_text(text.replace(drawn, f'{drawn} frictionloss="5"'))
    with pytest.raises(ConfigError, match="friction in joints"):
        WARP.build(dataclasses.replace(machine, mjcf=str(tmp_path / "other.xml")), "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_an_error_that_says_what_to_do(machine):
    for spec in (WARP, AutoSimulator(native=NATIVE, warp=WARP)):
        with pytest.raises(DeviceError, match="sim=native"):
            spec.build(machine, "cuda")


def test_auto_takes_the_threads_on_a_cpu(machine):
    world = AutoSimulator(native=NATIVE, warp=WARP).build(machine, "cpu", num_worlds=3)
    assert isinstance(world, NativeWorld) and world.num_worlds == 3
