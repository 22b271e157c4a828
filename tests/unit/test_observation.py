"""The policy's vector: order, scale, size, and the same numbers in numpy and torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brokk_rl.machine import Machine
from brokk_rl.observation import ObservationEncoder, TargetScaling, compute_size

SCALING = TargetScaling(
    target_mean_m=(2.5, 0.0, 0.75), target_std_m=(0.5, 1.0, 0.1), pitch_rad=None
)
WITH_PITCH = TargetScaling(
    target_mean_m=(2.5, 0.0, 0.75), target_std_m=(0.5, 1.0, 0.1), pitch_rad=(1.4, 0.35)
)


def samples(
    machine: Machine, count: int = 4
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    target = generator.uniform((2, -1, 0.6), (3, 1, 0.9), (count, 3))
    q = generator.uniform(
        machine.lower, machine.upper, (count, machine.num_history, machine.num_joints)
    )
    u = generator.uniform(-1, 1, q.shape)
    return (
        target.astype(np.float32),
        q.astype(np.float32),
        u.astype(np.float32),
        generator.uniform(0.6, 2, count).astype(np.float32),
    )


def in_torch(machine: Machine, scaling: TargetScaling) -> ObservationEncoder:
    return ObservationEncoder(
        machine, scaling, lambda values: torch.as_tensor(values, dtype=torch.float32), torch.cat
    )


def test_it_has_the_133_numbers_of_the_papers_table(machine: Machine) -> None:
    assert compute_size(machine) == 3 + 13 * 5 + 13 * 5 == 133
    assert ObservationEncoder(machine, SCALING).encode(*samples(machine)[:3]).shape == (4, 133)


def test_target_then_positions_then_commands_each_oldest_first(machine: Machine) -> None:
    q, u = np.zeros((1, 13, 5), np.float32), np.zeros((1, 13, 5), np.float32)
    q[0, 0, 1] = (
        0.05  # oldest sample of q2: travel -1.4 to 0.05, middle -0.675, quarter 0.3625, so (0.05 + 0.675) / 0.3625 = 2
    )
    q[0, 12, 4] = 2.2  # newest sample of q5, at its upper limit: 2 as well
    u[0, 0, 1], u[0, 12, 4] = 0.25, -0.5
    vector = ObservationEncoder(machine, SCALING).encode(
        np.array([[3.0, -1.0, 0.85]], np.float32), q, u
    )[0]
    assert vector[:3] == pytest.approx([1.0, -1.0, 1.0], abs=1e-5)
    assert vector[3 + 1] == pytest.approx(2.0, abs=1e-5) and vector[
        3 + 12 * 5 + 4
    ] == pytest.approx(2.0, abs=1e-5)
    assert vector[3 + 65 + 1] == 0.25 and vector[132] == -0.5


def test_decoding_inverts_encoding(machine: Machine) -> None:
    target, q, u, pitch = samples(machine)
    for scaling, rest in ((SCALING, ()), (WITH_PITCH, (pitch,))):
        encoder = ObservationEncoder(machine, scaling)
        vector = encoder.encode(target, q, u, *rest)
        for found, expected in zip(encoder.decode(vector), (target, q, u), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-6)
        if rest:
            np.testing.assert_allclose(encoder.decode_pitch(vector), pitch, atol=1e-6)


@pytest.mark.parametrize("scaling", [SCALING, WITH_PITCH], ids=["paper", "with pitch"])
def test_numpy_and_torch_say_the_same(machine: Machine, scaling: TargetScaling) -> None:
    parts = samples(machine)
    by_numpy = ObservationEncoder(machine, scaling).encode(*parts)
    by_torch = in_torch(machine, scaling).encode(*map(torch.from_numpy, parts))
    assert by_numpy.dtype == np.float32 and by_torch.dtype == torch.float32
    np.testing.assert_allclose(by_numpy, by_torch.numpy(), rtol=0, atol=1e-6)


def test_a_wanted_pitch_is_one_more_number_behind_those_of_the_paper(machine: Machine) -> None:
    target, q, u, _ = samples(machine, 1)
    with_pitch = ObservationEncoder(machine, WITH_PITCH).encode(
        target, q, u, np.array([1.75], np.float32)
    )
    assert with_pitch.shape == (1, compute_size(machine, with_pitch=True)) == (1, 134)
    np.testing.assert_array_equal(
        with_pitch[:, :133], ObservationEncoder(machine, SCALING).encode(target, q, u)
    )
    assert with_pitch[0, 133] == pytest.approx(1.0)  # (1.75 - 1.4) / 0.35


def test_the_contract_tells_size_order_and_scale(machine: Machine) -> None:
    paper, pitch = (
        ObservationEncoder(machine, SCALING).describe(),
        ObservationEncoder(machine, WITH_PITCH).describe(),
    )
    assert paper["size"] == 133 and len(paper["order"]) == 3 and "pitch" not in paper
    assert pitch["size"] == 134 and pitch["order"][3] == "pitch_rad (1)"
    assert pitch["pitch"] == {"mean_rad": 1.4, "std_rad": 0.35}
    assert paper["q"]["mean"][1] == pytest.approx(-0.675) and paper["q"]["std"][1] == pytest.approx(
        0.3625
    )
