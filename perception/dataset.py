"""Frames on disk with their masks, and the truth of rendered ones.

A folder holds `camera.yaml` (`perception.camera`) and for each frame `<stem>.color.png`, `<stem>.depth.npy` (float32, m,
NaN unknown) or `<stem>.depth.png` (16 bits, mm, 0 unknown), and where there is a pair
`<stem>.right.png`. Truth of a rendered frame:

* `<stem>.truth.json`: `scene`, `conditions`, `holes` (`center_m`, `axis` and `center_in_base_m`,
  `axis_in_base`, `radius_m`, `depth_m`, `hidden`: the part of the rim that cannot be seen,
  `in_view`), `decoys` (likewise), `block` (`center_m`, `rotation`, `half_m`). Axes point out of the
  hole; coordinates without a frame in their name are the left camera's.
* `<stem>.mask.png`: bits of `BLOCK` (with its holes), `HOLE_MASK` (all that is seen through the rim
  of a hole), `ARM`.
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import TypeAdapter, ValidationError

from brokk_rl.errors import FrameError, StorageError
from brokk_rl.session import write_bytes, write_json

BLOCK, HOLE_MASK, ARM = 1, 2, 4
COLOR, RIGHT, DEPTH, DEPTH_MM, TRUTH, MASK = (
    ".color.png", ".right.png", ".depth.npy", ".depth.png", ".truth.json", ".mask.png",
)  # fmt: skip


@dataclass(frozen=True)
class TrueCircle:
    """True pose of a rim, or of a flat disc.

    Attributes:
        center_m: Centre, `(3,)`, left camera's coordinates.
        axis: Unit normal out of the block, `(3,)`.
        center_in_base_m: Centre in the base frame.
        axis_in_base: Axis in the base frame.
        radius_m: Radius.
        depth_m: Depth of the hole; 0 for a disc.
        hidden: Part of the rim that cannot be seen from the left camera, in [0, 1].
        in_view: The whole rim lies within the picture.
    """

    center_m: tuple[float, ...]
    axis: tuple[float, ...]
    center_in_base_m: tuple[float, ...]
    axis_in_base: tuple[float, ...]
    radius_m: float
    depth_m: float
    hidden: float
    in_view: bool

    @classmethod
    def place(
        cls, center_m: np.ndarray, axis: np.ndarray, base: np.ndarray, radius_m: float, **told: Any
    ) -> TrueCircle:
        """Return a circle at a place in the camera, whose pose in the base is `base`, `(4, 4)`."""
        places = (center_m, axis, base[:3, :3] @ center_m + base[:3, 3], base[:3, :3] @ axis)
        return cls(*(tuple(place.tolist()) for place in places), radius_m=float(radius_m), **told)


@dataclass(frozen=True)
class SceneTruth:
    """Content of a rendered frame.

    Attributes:
        scene: Kind of scene.
        conditions: Sampled conditions by name.
        holes: All holes; the camera points at the first one.
        decoys: Flat discs.
        block: `center_m`, `rotation`, `half_m`; empty where there is no block.
    """

    scene: str
    conditions: dict[str, float]
    holes: tuple[TrueCircle, ...]
    decoys: tuple[TrueCircle, ...]
    block: dict[str, Any]


@dataclass(frozen=True)
class FrameLabel:
    """Masks of a frame, `(h, w)` bool: block with its holes, inside of the holes, arm."""

    block: np.ndarray
    hole_mask: np.ndarray
    arm: np.ndarray


def list_stems(folder: Path) -> list[Path]:
    """Return the frames of a folder, sorted, as paths without endings.

    Raises:
        FrameError: there is no such folder, or no frame in it.
    """
    if not folder.is_dir():
        raise FrameError(f"{folder}: no such folder")
    found = []
    for path in sorted(folder.glob(f"[!.]*{COLOR}")):
        found.append(path.with_name(path.name.removesuffix(COLOR)))
    if not found:
        raise FrameError(f"{folder}: no frames; expected files <stem>{COLOR}")
    return found


def read_truth(stem: Path) -> SceneTruth:
    """Return the truth of the rendered frame at `stem`.

    Raises:
        FrameError: it has none, or one that cannot be read.
    """
    path = _build_path(stem, TRUTH)
    try:
        return TypeAdapter(SceneTruth).validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise FrameError(f"{path}: no truth; only rendered frames have it") from error
    except ValidationError as error:
        raise FrameError(f"{path}: not a truth file of this version ({error})") from error


def read_label(stem: Path) -> FrameLabel:
    """Return the masks of the rendered frame at `stem`.

    Raises:
        FrameError: it has none, or one that cannot be read.
    """
    path = _build_path(stem, MASK)
    bits = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if bits is None or bits.ndim != 2:
        raise FrameError(f"{path}: no mask; rendered and labelled frames have one")
    bits = np.asarray(bits, np.uint8)
    return FrameLabel((bits & BLOCK) > 0, (bits & HOLE_MASK) > 0, (bits & ARM) > 0)


def encode_mask(label: FrameLabel) -> np.ndarray:
    """Return the bits of the masks for the file, `(h, w)` uint8."""
    return (BLOCK * label.block + HOLE_MASK * label.hole_mask + ARM * label.arm).astype(np.uint8)


def write_frame(
    stem: Path,
    color: np.ndarray,
    depth_m: np.ndarray | None,
    right: np.ndarray | None = None,
    label: FrameLabel | None = None,
    truth: SceneTruth | None = None,
) -> None:
    """Write a frame, the truth last: where that stands, all of it does.

    Raises:
        StorageError: a file could not be written.
    """
    write_picture(_build_path(stem, COLOR), color[..., ::-1])
    if right is not None:
        write_picture(_build_path(stem, RIGHT), right[..., ::-1])
    if depth_m is not None:
        content = io.BytesIO()
        np.save(content, depth_m.astype(np.float32))
        write_bytes(_build_path(stem, DEPTH), content.getvalue())
    if label is not None:
        write_picture(_build_path(stem, MASK), encode_mask(label))
    if truth is not None:
        write_json(_build_path(stem, TRUTH), asdict(truth))


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a picture, grey or BGR, as PNG.

    Raises:
        StorageError: it could not be written.
    """
    done, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise StorageError(f"{path}: a picture of shape {picture.shape} cannot be encoded")
    write_bytes(path, data.tobytes())


def is_whole(stem: Path) -> bool:
    """Return whether a rendered frame has been written to its end."""
    return _build_path(stem, TRUTH).is_file()


def _build_path(stem: Path, ending: str) -> Path:
    return stem.with_name(stem.name + ending)
