"""Share of the time with a finding about a joint, on sound and on broken servo logs.

    python benchmarks/logs/remark_limits.py <out.json>

Chooses the limits of `does not obey` and `jumps` in `diagnosis.gates`: above what sound logs show, below
what a broken one shows. Sound are 60 servos with lag, sag, play, a limit of their speed and noise.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import yaml

from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import examine_recordings
from brokk_rl import extensions
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("does not obey", "jumps")
BROKEN = (0.01, 0.02, 0.05, 0.1, 0.3)
"""Parts of the time in which the drive of a joint is off, or after which its angle jumps."""


def simulate(machine: Machine, rng: np.random.Generator, off: float, is_reset: bool) -> Recording:
    """Returns a log of 60 s; the first joint is broken for a part of it."""
    num, period_s = round(60.0 / machine.period_s), machine.period_s
    half = (machine.upper - machine.lower) / 2.0
    goals = rng.uniform(-0.7, 0.7, (num // 30 + 1, machine.num_joints)).repeat(30, 0)[:num]
    u, q, at = np.zeros_like(goals), np.zeros_like(goals), goals[0]
    lag_s, sag, play = rng.uniform(0.02, 0.4), rng.uniform(0.0, 0.03), rng.uniform(0.0, 0.02)
    speed = rng.uniform(0.5, 3.0) * period_s
    is_off = np.zeros(num, dtype=bool)
    begin = int(rng.integers(num // 10, num // 2))
    is_off[begin : begin + int(off * num)] = True
    for k in range(num):
        u[k] = goals[k] if k == 0 else u[k - 1] + np.clip(goals[k] - u[k - 1], -speed, speed)
        wanted = (u[k] - at) * (1.0 - np.exp(-period_s / lag_s))
        wanted[np.abs(u[k] - at) < play] = 0.0
        at = at + np.where(is_off[k] & (np.arange(len(at)) == 0) & (not is_reset), 0.0, wanted)
        q[k] = at - sag * np.cos(at)
    if is_reset:
        q[is_off, 0] -= 0.5
    middle = (machine.upper + machine.lower) / 2.0
    noisy = middle + half * q + rng.normal(0.0, 2e-4, q.shape)
    return make_motion(machine, "made", np.arange(num) * period_s, u, noisy)


def main(out: Path) -> None:
    """Writes the largest share on sound logs, and the smallest by the part that is broken."""
    machine = extensions.load_option("machine", "so101")
    numbers = yaml.safe_load((ROOT / "conf/thresholds.yaml").read_text())
    del numbers["_target_"]
    thresholds = InspectionThresholds(**numbers)
    rng, found = np.random.default_rng(0), {}
    for name in NAMES:
        for part in (0.0, *BROKEN):
            shares = []
            for _ in range(60 if part == 0.0 else 20):
                log = simulate(machine, rng, part, name == "jumps")
                remarks = examine_recordings([log], machine, thresholds)
                shares.append(sum(one.share for one in remarks if one.name == name))
            ends = [float(np.min(shares)), float(np.median(shares)), float(np.max(shares))]
            found.setdefault(name, {})[str(part)] = ends
    out.write_text(json.dumps({"min_median_max": found}, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
