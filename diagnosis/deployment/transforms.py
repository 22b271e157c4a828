"""Changes of signals, histories and commands by which mistakes are reproduced."""

from __future__ import annotations

import numpy as np

from diagnosis.deployment.contract import ObservationTerm
from diagnosis.deployment.replay import Transform


def change_columns(columns: list[int], change: Transform) -> Transform:
    """Return the change of some columns by a function of their values."""

    def transform(values: np.ndarray) -> np.ndarray:
        changed = values.copy()
        changed[:, columns] = change(changed[:, columns])
        return changed

    return transform


def scale_columns(columns: list[int], factor: float) -> Transform:
    """Return the change that multiplies columns by a factor."""
    return change_columns(columns, lambda x: x * factor)


def clip_columns(columns: list[int], bound: float) -> Transform:
    """Return the change that clips columns at plus and minus a bound."""
    return change_columns(columns, lambda x: x.clip(-bound, bound))


def shift_columns(term: ObservationTerm, columns: list[int], offset_std: float) -> Transform:
    """Return the change that adds so many of a term's standard deviations to columns."""
    return change_columns(columns, lambda x: x + offset_std * term.std[columns])


def shift_column(column: int, offset: float) -> Transform:
    """Return the change that adds an offset to a column."""
    return change_columns([column], lambda x: x + offset)


def shift_command(columns: list[int], offset: float) -> Transform:
    """Return the change that adds an offset to commands, within full command."""
    return change_columns(columns, lambda x: (x + offset).clip(-1.0, 1.0))


def arrange_columns(order: tuple[int, ...]) -> Transform:
    """Return the change that puts columns into another order."""
    return lambda values: values[:, list(order)]


def arrange_scaled(term: ObservationTerm, order: tuple[int, ...]) -> Transform:
    """Return the change that puts columns of a history, `(R, H, C)`, into another order after scaling."""

    def transform(window: np.ndarray) -> np.ndarray:
        scaled = (window - term.mean) / term.std
        return scaled[..., list(order)] * term.std + term.mean

    return transform


def delay_rows(periods: float) -> Transform:
    """Return the change that delays all columns by whole rows; the first row stands before."""
    count = int(periods)
    return lambda values: np.concatenate([np.repeat(values[:1], count, 0), values[:-count]])


def hold_rows(every: int, phase: int) -> Transform:
    """Return the change that refreshes values only every few rows, at a phase."""

    def transform(values: np.ndarray) -> np.ndarray:
        rows = np.arange(len(values))
        return values[np.maximum(rows - (rows - phase) % every, 0)]

    return transform


def freeze_columns(columns: list[int], row: float) -> Transform:
    """Return the change that keeps the values of columns from a row on."""
    first = int(row)

    def transform(values: np.ndarray) -> np.ndarray:
        changed = values.copy()
        changed[first:, columns] = values[first, columns]
        return changed

    return transform


def smooth_rows(weight: float) -> Transform:
    """Return a first-order low-pass; `weight` is that of the newest value."""

    def transform(values: np.ndarray) -> np.ndarray:
        smoothed = values.copy()
        for row in range(1, len(values)):
            smoothed[row] = weight * values[row] + (1.0 - weight) * smoothed[row - 1]
        return smoothed

    return transform


def lay_out_by_column(window: np.ndarray) -> np.ndarray:
    """Return history `(R, H, C)` as one that was flattened column by column reads."""
    return window.transpose(0, 2, 1).reshape(window.shape)


def rotate_frame(axis: int, angle_rad: float) -> np.ndarray:
    """Return the matrix of a turn about axis 0, 1 or 2, `(3, 3)`."""
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[one, one] = turn[other, other] = np.cos(angle_rad)
    turn[one, other], turn[other, one] = -np.sin(angle_rad), np.sin(angle_rad)
    return turn
