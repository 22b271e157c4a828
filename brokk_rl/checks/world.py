"""Checker of simulated worlds."""

from __future__ import annotations

import torch

from brokk_rl.checks.exercise import NUM_ENVS, check_in_place, is_same, view_tensors
from brokk_rl.contracts.world import Simulator, World
from brokk_rl.machine import Machine

PLACED_M = 0.2
"""Distance by which a block is put farther away. Chosen by hand."""


def check_world(
    simulator: Simulator, machine: Machine, scenes: torch.Tensor, device: torch.device | str = "cpu"
) -> None:
    """Check a simulator against `World`.

    Args:
        simulator: The spec.
        machine: The machine.
        scenes: Valid scenes out of the arm's way at its home position, `(NUM_ENVS, S)`.
        device: Where to run.
    """
    device = torch.device(device)
    world = simulator.build(machine, device, NUM_ENVS)
    assert world.num_worlds == NUM_ENVS, f"num_worlds: expected {NUM_ENVS}, got {world.num_worlds}"
    place = view_tensors(_view_results(world, machine))
    home = torch.as_tensor(machine.home, dtype=torch.float32, device=device).repeat(NUM_ENVS, 1)
    everywhere, scenes = torch.ones(NUM_ENVS, dtype=torch.bool, device=device), scenes.to(device)
    reach = machine.max_speed * machine.period_s * 0.5
    steps = torch.as_tensor(reach, dtype=torch.float32, device=device).repeat(NUM_ENVS, 1)

    world.reset(everywhere, home, scenes)
    assert torch.allclose(world.q, home, atol=1e-4), "reset: q is not where the arm was put"
    assert not world.faults.any(), "reset: faults at rest at home"
    stored = world.state_dict()
    first = _push_joints(world, steps)
    assert first.isfinite().all(), "step: q is not finite"
    assert (first[-1] != home).any(), "step: the arm does not move"
    check_in_place(_view_results(world, machine), place, "step")
    # The order of additions on a GPU is not fixed.
    tolerance = 0.0 if device.type == "cpu" else 1e-5
    world.load_state_dict(stored)
    text = "load_state_dict: the same steps from the same state lead elsewhere"
    assert is_same(_push_joints(world, steps), first, tolerance), text
    world.load_state_dict(stored)
    altered = steps.clone()
    altered[0] = 0.0
    text = "step: what happens in world 0 changes the others"
    assert is_same(_push_joints(world, altered)[:, 1:], first[:, 1:], tolerance), text
    before, some = world.q.clone(), torch.arange(NUM_ENVS, device=device) == 0
    world.reset(some, home, scenes)
    assert is_same(world.q[1:], before[1:]), "reset: q changed in worlds outside the mask"
    text = "reset: the world of the mask is not where it was put"
    assert torch.allclose(world.q[0], home[0], atol=1e-4), text
    elsewhere = scenes.clone()
    elsewhere[:, 0] += PLACED_M
    before = world.q.clone()
    world.place(some, elsewhere)
    assert is_same(world.q, before), "place: the arm moved with the block"


def _view_results(world: World, machine: Machine) -> dict[str, torch.Tensor]:
    """Return the tensors that a world refreshes; check their shapes and kinds."""
    found = {"q": world.q, "contact_force_n": world.contact_force_n, "faults": world.faults}
    for name, value in found.items():
        shape = (NUM_ENVS, machine.num_joints) if name == "q" else (NUM_ENVS,)
        kind = torch.bool if name == "faults" else torch.float32
        text = f"{name}: expected {kind} of shape {shape}, got {value.dtype} {tuple(value.shape)}"
        assert value.dtype == kind and tuple(value.shape) == shape, text
    return found


def _push_joints(world: World, steps: torch.Tensor) -> torch.Tensor:
    """Return the positions over some control periods in which every joint advances, `(T, N, J)`."""
    found = []
    for _ in range(5):
        world.step(steps)
        found.append(world.q.clone())
    return torch.stack(found)
