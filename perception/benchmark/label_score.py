"""Labels of a block beside the truth of rendered frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception import dataset


def compare_corners(labelled: Path, true: Path) -> float:
    """Return the largest distance of a labelled block's corner from the nearest true one, m."""
    found, expected = (_list_corners(dataset.read_truth(stem).block) for stem in (labelled, true))
    away = np.linalg.norm(found[:, None] - expected[None], axis=-1)
    return float(away.min(1).max())


def _list_corners(block: Mapping[str, Any]) -> np.ndarray:
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    local = signs * np.array(block["half_m"])
    return local @ np.array(block["rotation"]).T + np.array(block["center_m"])


def compute_overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Return the intersection over the union of two masks."""
    return float((one & other).sum() / max((one | other).sum(), 1))
