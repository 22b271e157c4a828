"""The policy's vector: order, scale, size, and the same numbers in numpy and torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from brokk_rl import observation
from brokk_rl.machine import Machine
from brokk_rl.observation import ObservationEncoder, TargetScaling, list_pose_parts

PLACE: dict[str, Any] = {"target_mean_m": (2.5, 0.0, 0.75), "target_std_m": (0.5, 1.0, 0.1)}
SCALING = TargetScaling(**PLACE, pitch_rad=None)
WITH_PITCH = TargetScaling(**PLACE, pitch_rad=(1.4, 0.35))


def make_values(machine: Machine, count: int = 4) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    shape = (count, machine.num_history, machine.num_joints)
    values = {
        "target_in_base_m": generator.uniform((2, -1, 0.6), (3, 1, 0.9), (count, 3)),
        "q": generator.uniform(machine.lower, machine.upper, shape),
        "u": generator.uniform(-1, 1, shape),
        "pitch_rad": generator.uniform(0.6, 2, count),
    }
    return {name: value.astype(np.float32) for name, value in values.items()}


def make_encoder(machine: Machine, scaling: TargetScaling) -> ObservationEncoder:
    return ObservationEncoder(list_pose_parts(machine, scaling))


def test_target_then_positions_then_commands_each_oldest_first(machine: Machine) -> None:
    q, u = np.zeros((1, 13, 5), np.float32), np.zeros((1, 13, 5), np.float32)
    # oldest sample of q2: travel -1.4 to 0.05, middle -0.675, quarter 0.3625, so
    # (0.05 + 0.675) / 0.3625 = 2; newest sample of q5, at its upper limit: 2 as well
    q[0, 0, 1], q[0, 12, 4] = 0.05, 2.2
    u[0, 0, 1], u[0, 12, 4] = 0.25, -0.5
    target_m = np.array([[3.0, -1.0, 0.85]], np.float32)
    encoder = make_encoder(machine, SCALING)
    vector = encoder.encode({"target_in_base_m": target_m, "q": q, "u": u})[0]
    assert vector.shape == (133,) and encoder.size == 3 + 13 * 5 + 13 * 5 == 133
    assert vector[:3] == pytest.approx([1.0, -1.0, 1.0], abs=1e-5)
    assert vector[[3 + 1, 3 + 12 * 5 + 4]] == pytest.approx([2.0, 2.0], abs=1e-5)
    assert vector[3 + 65 + 1] == 0.25 and vector[132] == -0.5


@pytest.mark.parametrize("scaling", [SCALING, WITH_PITCH], ids=["paper", "with pitch"])
def test_numpy_and_torch_say_the_same_and_decoding_inverts_it(
    machine: Machine, scaling: TargetScaling
) -> None:
    values, encoder = make_values(machine), make_encoder(machine, scaling)
    vector = encoder.encode(values)
    for name, found in encoder.decode(vector).items():
        np.testing.assert_allclose(found, values[name], atol=1e-6)
    in_torch = ObservationEncoder(list_pose_parts(machine, scaling), torch.as_tensor, torch.cat)
    by_torch = in_torch.encode({name: torch.as_tensor(value) for name, value in values.items()})
    assert vector.dtype == np.float32 and by_torch.dtype == torch.float32
    np.testing.assert_allclose(vector, by_torch.numpy(), rtol=0, atol=1e-6)


def test_a_wanted_pitch_is_one_more_number_behind_those_of_the_paper(machine: Machine) -> None:
    values = make_values(machine, 1) | {"pitch_rad": np.array([1.75], np.float32)}
    with_pitch, paper = (make_encoder(machine, one).encode(values) for one in (WITH_PITCH, SCALING))
    assert with_pitch.shape == (1, 134)
    np.testing.assert_array_equal(with_pitch[:, :133], paper)
    assert with_pitch[0, 133] == pytest.approx(1.0)  # (1.75 - 1.4) / 0.35


def test_the_contract_tells_size_order_and_scale_and_gives_the_encoder_back(
    machine: Machine,
) -> None:
    paper, pitch = (make_encoder(machine, one).describe() for one in (SCALING, WITH_PITCH))
    assert paper["size"] == 133 and len(paper["order"]) == 3 and "pitch" not in paper
    assert pitch["size"] == 134 and pitch["order"][3] == "pitch_rad (1)"
    assert pitch["pitch"] == {"mean_rad": 1.4, "std_rad": 0.35}
    assert paper["q"]["mean"][1] == pytest.approx(-0.675)
    assert paper["q"]["std"][1] == pytest.approx(0.3625)
    assert observation.restore_encoder(machine, pitch).describe() == pitch


def test_ranges_are_those_of_the_values_in_their_units(machine: Machine) -> None:
    values, encoder = make_values(machine), make_encoder(machine, SCALING)
    found = observation.measure_ranges(encoder, encoder.encode(values), machine.joint_names)
    q1, x, y = values["q"][:, :, 0], *values["target_in_base_m"][:, :2].T
    assert found["q.q1"] == pytest.approx((q1.min(), q1.max()), abs=1e-6)
    assert found["target.x"] == pytest.approx((x.min(), x.max()), abs=1e-6)
    distance_m = np.hypot(x, y)
    expected = pytest.approx((distance_m.min(), distance_m.max()), abs=1e-6)
    assert found[observation.TARGET_DISTANCE] == expected
