"""A case of the exam as a rival reads it, and the answer that it leaves.

Axes: `W` windows, `K` control periods of a window, `J` joints.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

WINDOW_S = 5.0
"""Length of the free runs, s: as the exam's examiner has them."""
HISTORY_S = 1.2
"""Commands known before a window begins, s: longer than dead time and lag together."""
FIELD_STRIDE_S, REFERENCE_STRIDE_S = 5.0, 15.0
"""Distance of windows, s: the reference is three times as long as the field."""


@dataclass(frozen=True)
class Arm:
    """The facts about the machine that a rival gets.

    Attributes:
        joints: Names.
        period_s: Control period, s.
        middle: Middle of the travel, `(J,)` rad.
        half_travel: Half of the travel, `(J,)` rad.
        max_speed: Nominal speed at full command, `(J,)` rad/s.
        yield_force: Torque that the drives hold, `(J,)` N m; NaN where it is not known.
        tip_m: Tool point in the frame of the last body, `(3,)` m; NaN where it is not known.
    """

    joints: tuple[str, ...]
    period_s: float
    middle: np.ndarray
    half_travel: np.ndarray
    max_speed: np.ndarray
    yield_force: np.ndarray
    tip_m: np.ndarray


@dataclass(frozen=True)
class Windows:
    """Windows of one half of a case.

    Attributes:
        u: Commands from `HISTORY_S` before a window to its end, `(W, H + K, J)`.
        q: Measured positions from the start of a window on, `(W, K + 1, J)` rad.
        ee: Measured tool points `(W, K + 1, 3)` m, or `None`.
    """

    u: np.ndarray
    q: np.ndarray
    ee: np.ndarray | None


def read_arm(path: Path) -> Arm:
    """Return the machine from the file that the exam hands to a program."""
    node = yaml.safe_load(path.read_text())
    joints, tool = node["joints"], node["tool_m"] or [{"value": np.nan}] * 3
    lower, upper = (
        np.array([joint[side]["value"] for joint in joints]) for side in ("lower", "upper")
    )
    held = [joint["body"]["yield_force"]["value"] if joint["body"] else np.nan for joint in joints]
    return Arm(
        joints=tuple(joint["name"] for joint in joints),
        period_s=node["period_s"],
        middle=(lower + upper) / 2,
        half_travel=(upper - lower) / 2,
        max_speed=np.array([joint["max_speed"]["value"] for joint in joints]),
        yield_force=np.array(held),
        tip_m=np.array([dimension["value"] for dimension in tool]),
    )


def read_windows(folder: Path, arm: Arm, stride_s: float) -> Windows:
    """Return the windows of all recordings in a folder."""
    history, steps = round(HISTORY_S / arm.period_s), round(WINDOW_S / arm.period_s)
    u, q, ee = [], [], []
    for path in sorted(folder.glob("*.parquet")):
        table = pq.read_table(path)
        names = set(table.column_names)
        commands = np.stack([table[f"u_{name}"].to_numpy() for name in arm.joints], 1)
        positions = np.stack([table[f"q_{name}_rad"].to_numpy() for name in arm.joints], 1)
        tool = None
        if "ee_x_m" in names:
            tool = np.stack([table[f"ee_{axis}_m"].to_numpy() for axis in "xyz"], 1)
        for begin in range(
            history, len(q_rows := positions) - steps, round(stride_s / arm.period_s)
        ):
            u.append(commands[begin - history : begin + steps])
            q.append(q_rows[begin : begin + steps + 1])
            if tool is not None:
                ee.append(tool[begin : begin + steps + 1])
    measured = np.stack(ee).astype(float) if ee else None
    return Windows(np.stack(u).astype(float), np.stack(q).astype(float), measured)


def delay_commands(speed: np.ndarray, delay_s: np.ndarray, period_s: float) -> np.ndarray:
    """Return speeds behind a dead time, the mean over each control period.

    Args:
        speed: Speeds asked for by the commands, `(..., H + K, J)`.
        delay_s: Dead time, broadcast over `(..., J)`.
        period_s: Control period, s.
    """
    periods = np.asarray(delay_s) / period_s
    whole = np.floor(periods).astype(int)
    part = (periods - whole)[..., None, :]
    rows = np.arange(speed.shape[-2])[:, None]
    later = np.clip(rows - whole[..., None, :], 0, None)
    earlier = np.clip(later - 1, 0, None)
    shape = np.broadcast_shapes(speed.shape, later.shape)
    full = np.broadcast_to(speed, shape)
    return part * np.take_along_axis(full, np.broadcast_to(earlier, shape), -2) + (
        1.0 - part
    ) * np.take_along_axis(full, np.broadcast_to(later, shape), -2)


@dataclass(frozen=True)
class Change:
    """A fitted change of one number of one joint, in the words of the effect library.

    Attributes:
        effect: The effect that has the number.
        parameter: Its name there.
        joint: The joint.
        value: The number with the change.
        change: Its distance from the value that changes nothing.
        error: Standard error of the change by the rival's own account; 1 where it gives none.
    """

    effect: str
    parameter: str
    joint: str
    value: float
    change: float
    error: float


def write_changes(changes: list[Change], out: Path) -> None:
    """Write all fitted changes, whatever is named of them."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for change in changes:
        numbers = {name: float(getattr(change, name)) for name in ("value", "change", "error")}
        rows.append({**vars(change), **numbers})
    (out / "changes.json").write_text(json.dumps(rows, indent=1) + "\n")


def read_changes(path: Path) -> list[Change]:
    """Return the fitted changes of an answer."""
    return [Change(**row) for row in json.loads(path.read_text())]
