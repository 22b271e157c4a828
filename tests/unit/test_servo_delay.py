"""The delay of a position servo is that of its loop, whatever the lag of the loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import make_machine

from actuators.identify.dead_time import estimate_dead_times
from brokk_rl.record import Recording

RATE_HZ = 50.0
STEPS = 20
"""Steps of the integration in a period."""


def make_run(delay_s: float, seed: int) -> Recording:
    """Returns a servo of 20 rad/s, damping 0.9, behind a delay, under random steps."""
    rng = np.random.default_rng(seed)
    targets = np.repeat(rng.uniform(-0.8, 0.8, 40), 30)
    fine = np.repeat(targets, STEPS)
    late = np.concatenate([np.zeros(round(delay_s * RATE_HZ * STEPS)), fine])[: len(fine)]
    step_s, q, v, seen = 1.0 / RATE_HZ / STEPS, 0.0, 0.0, []
    for number, target in enumerate(late):
        if number % STEPS == 0:
            seen.append(q)
        v += step_s * (400.0 * (target - q) - 36.0 * v)
        q += step_s * v
    measured = np.array(seen) + rng.normal(0.0, 2e-4, len(seen))
    return Recording(
        machine="servo", joints=("a",), units=("rad",), rate_hz=RATE_HZ, t_s=np.arange(len(targets)) / RATE_HZ,
        u=(targets / 1.5).astype(np.float32)[:, None], q=measured.astype(np.float32)[:, None], extra={},
        metadata={"run": str(seed)},
    )  # fmt: skip


@pytest.mark.parametrize("delay_s", [0.0, 0.06, 0.2])
def test_the_delay_of_a_servo_is_found_within_a_sample(delay_s: float) -> None:
    machine = replace(make_machine("a"), period_s=1.0 / RATE_HZ)
    runs = [make_run(delay_s, seed) for seed in range(2)]
    found = estimate_dead_times(runs, machine, np.random.default_rng(0))["a"]
    assert found is not None and found.is_found
    assert found.value_s == pytest.approx(delay_s, abs=1.0 / RATE_HZ)
    assert found.explained > 0.99
