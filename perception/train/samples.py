"""Training samples: each frame as the segmenter's two views, cropped and changed.

All of a batch is made by torch where the network is: a processor's cores took five times as long to
make a batch as a graphics card takes to learn from it.

Changes of brightness, sharpness and noise are the paper's blur, contrast, gamma and noise; crop, its
fifth, alone moves what is in the pictures. Rendered scenes vary light, dust and sensor by themselves.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
from annotated_types import Ge, MultipleOf
from torch.nn import functional

from brokk_rl.errors import FrameError
from brokk_rl.progress import track_items
from brokk_rl.spec import NonNegative, PositiveRange, Share, spec
from perception import dataset
from perception.segment.network import SMALLEST_PIECE, THRESHOLD
from perception.segment.window import Window, bound_block, center_window, cover_picture
from perception.sources.folder import read_picture
from perception.sources.validation import convert_color

ROOM = 1.5
"""Size of a stored view over the network's picture: room that a crop can use without loss of
detail."""
LOOKS = ("whole", "closer")
SEEN = (1.0, 1.0 / ROOM)
"""Part of the width of each view that the segmenter sees."""
FINER = 2
"""Places at which a pixel of a sample is looked at, in each direction: it may be larger than one of
the view."""
ENLARGED = 1.5
"""By how much a closer view is larger than its frame, at most: of a small one it shows more than
the block instead, as sharp as the segmenter sees one in a large frame."""
PART_OF_MEMORY = 0.5
"""Views that take no more of a device's free memory are kept there."""
PICTURES = (".png", ".jpg", ".jpeg")
"""Endings of pictures without a block."""
THREADS = 16
"""That read frames, at most: a machine may count more processors than it lends."""


@spec
class Crop:
    """Random crop of a sample around the segmenter's view.

    Attributes:
        width: Range of its width, as a part of the width that the segmenter sees; beyond the view
            it is black.
        shift: Largest shift of its middle, likewise.
        roll_rad: Largest turn about the line of sight.
        mirror: How often left and right are swapped.
    """

    width: PositiveRange
    shift: float
    roll_rad: float
    mirror: float

    def windows(self, seen: torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
        """Return random parts of views, `(B, 2, 3)`: maps from a sample's places to the view's.

        Both run from -1 to 1 from border to border, as `torch.nn.functional.affine_grid` wants
        them.

        Args:
            seen: Part of each view's width that the segmenter would see, `(B,)`.
            shape: Height and width of the views.
        """
        draw = torch.rand((5, len(seen)), device=seen.device)
        scale = seen * (self.width[0] + (self.width[1] - self.width[0]) * draw[0])
        shift = 2.0 * self.shift * seen * (2.0 * draw[1:3] - 1.0)
        roll_rad, slant = self.roll_rad * (2.0 * draw[3] - 1.0), shape[1] / shape[0]
        side = torch.where(draw[4] < self.mirror, -scale, scale)
        cos, sin = roll_rad.cos(), roll_rad.sin()
        rows = (
            (side * cos, -scale * sin / slant, shift[0]),
            (side * sin * slant, scale * cos, shift[1]),
        )
        return torch.stack([torch.stack(row, -1) for row in rows], 1)


@dataclass(frozen=True)
class TrainingViews:
    """Views of all frames, in memory.

    Attributes:
        layers: `(F, 2, 5, H, W)` uint8: of the whole frame, and of the block with room around it,
            RGB, and how much of each pixel shows block and mouth, 255 for all of it.
        conditions: Kind of scene of each frame.
        names: Path of each frame without its endings.
    """

    layers: torch.Tensor
    conditions: Sequence[str]
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.names)

    def part(self, chosen: slice) -> TrainingViews:
        """Return the chosen frames."""
        return TrainingViews(self.layers[chosen], self.conditions[chosen], self.names[chosen])


@dataclass
class Samples:
    """Endless batches, cut and changed where the network is trained.

    Attributes:
        views: They are cut from these; kept on the device where it has room for them, else in the
            computer's memory.
        crop: How.
        change: Changes pictures, `(B, 3, h, w)`.
        size_px: Width and height of a sample.
        closer: How often a sample is cut from the closer view.
        device: Where samples are made.
    """

    views: TrainingViews
    crop: Crop
    change: torch.nn.Module
    size_px: tuple[int, int]
    closer: float
    device: torch.device

    def __post_init__(self) -> None:
        self._layers = self.views.layers
        if self.device.type == "cuda":
            free_bytes, _ = torch.cuda.mem_get_info(self.device)
            if self._layers.nbytes < PART_OF_MEMORY * free_bytes:
                self._layers = self._layers.to(self.device)

    def draw(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return pictures, `(count, 3, h, w)`, and shares of block and mouth, `(count, 2, h, w)`."""
        frame = torch.randint(len(self._layers), (count,))
        look = (torch.rand(count) < self.closer).long()
        # Nothing here waits until the device has taken something.
        place = (index.to(self._layers.device, non_blocking=True) for index in (frame, look))
        taken = self._layers[tuple(place)].to(self.device, non_blocking=True)
        seen = torch.tensor(SEEN)[look].to(self.device, non_blocking=True)
        windows = self.crop.windows(seen, (taken.shape[2], taken.shape[3]))
        layers = cut_windows(taken, windows, self.size_px)
        return self.change(layers[:, :3]).clamp(0.0, 1.0), layers[:, 3:]


def cut_windows(
    layers: torch.Tensor, windows: torch.Tensor, size_px: tuple[int, int]
) -> torch.Tensor:
    """Return parts of pictures, `(B, C, H, W)` uint8, as samples, `(B, C, h, w)` float32 in [0, 1].

    Args:
        layers: Pictures.
        windows: Which part, `(B, 2, 3)`, see `Crop.windows`; black beyond the picture.
        size_px: Width and height.
    """
    width, height = size_px
    fine = [len(layers), layers.shape[1], FINER * height, FINER * width]
    grid = functional.affine_grid(windows, fine, align_corners=False)
    seen = functional.grid_sample(layers.float() / 255.0, grid, align_corners=False)
    return functional.avg_pool2d(seen, FINER)


def list_files(folders: str | Sequence[str], endings: tuple[str, ...], where: str) -> list[Path]:
    """Return the files in and below folders that end so, sorted; `where` names the folders.

    Raises:
        FrameError: a folder holds none.
    """
    found: list[Path] = []
    for folder in (folders,) if isinstance(folders, str) else folders:
        here = []
        for path in sorted(Path(folder).rglob("*")):
            if path.name.lower().endswith(endings) and path.name[0] != ".":
                here.append(path)
        if not here:
            raise FrameError(
                f"{where}: no *{', *'.join(endings)} in '{folder}' (seen from {Path.cwd()}); frames "
                "with masks come from `brokk mode=render` and `mode=label`, negatives are photographs"
            )
        found += here
    return found


def list_frames(folders: str | Sequence[str], where: str) -> list[Path]:
    """Return the frames with a mask in and below folders, as paths without endings.

    Raises:
        FrameError: a folder holds none.
    """
    masks = list_files(folders, (dataset.MASK,), where)
    return [path.with_name(path.name.removesuffix(dataset.MASK)) for path in masks]


def read_views(
    paths: Sequence[Path], size_px: tuple[int, int], margin: float, seed: int
) -> TrainingViews:
    """Read frames, some at a time, and keep their two views.

    Args:
        paths: Frames, paths without endings; pictures without a block, paths of files.
        size_px: Width and height of the network's picture.
        margin: Room around the block in the closer view, as a part of its box, before the room to
            crop.
        seed: Of the closer view of frames without a block, which shows any part of them.

    Raises:
        FrameError: a picture or a mask cannot be read.
    """
    width, height = (round(ROOM * side) for side in size_px)
    layers = np.empty((len(paths), len(LOOKS), 5, height, width), np.uint8)

    def fill(number: int) -> str:
        picture, known, condition = _read_frame(paths[number])
        generator = np.random.default_rng((seed, number))
        for look, window in enumerate(_choose_windows(known, (width, height), margin, generator)):
            layers[number, look, :3] = window.take(picture, (width, height)).transpose(2, 0, 1)
            layers[number, look, 3:] = window.take(known, (width, height)).transpose(2, 0, 1)
        return condition

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # on each of many threads as many again would get in each other's way
    try:
        with ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1)) as pool:
            work = pool.map(fill, range(len(paths)))
            conditions = list(track_items(work, "reading frames", len(paths)))
    finally:
        cv2.setNumThreads(threads)
    names = tuple(str(path) for path in paths)
    return TrainingViews(torch.from_numpy(layers), tuple(conditions), names)


def _read_frame(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Return picture `(H, W, 3)`, shares `(H, W, 2)` and condition of one frame, or of one picture.

    A file is a picture without a block, and needs no mask.
    """
    is_negative = path.suffix.lower() in PICTURES
    color = path if is_negative else Path(f"{path}{dataset.COLOR}")
    picture = convert_color(read_picture(color), str(color))
    if is_negative:
        return picture, np.zeros((*picture.shape[:2], 2), np.uint8), "negative"
    label = dataset.read_label(path)
    if label.block.shape != picture.shape[:2]:
        raise FrameError(f"{color}: {picture.shape[1::-1]} px, mask {label.block.shape[::-1]} px")
    condition = dataset.read_truth(path).scene if dataset.is_whole(path) else "unknown"
    known = np.stack([label.block, label.hole_mask], axis=-1).astype(np.uint8) * np.uint8(255)
    return picture, known, condition


def _choose_windows(
    known: np.ndarray, size_px: tuple[int, int], margin: float, generator: np.random.Generator
) -> list[Window]:
    """Return the windows of both views of a frame."""
    first = cover_picture(known.shape, size_px)
    box = bound_block(known[..., 0] / 255.0, THRESHOLD, SMALLEST_PIECE)
    if box is None:
        size = np.array([known.shape[1], known.shape[0]])
        side = generator.uniform(0.2, 0.8) * size
        box = (*(generator.uniform(0.0, 1.0, 2) * (size - side)), *side)
    room = ROOM * (1.0 + 2.0 * margin)
    closer = center_window(box, size_px, (room - 1.0) / 2.0)
    room *= max(1.0, size_px[0] / ENLARGED / closer.width)
    return [first, center_window(box, size_px, (room - 1.0) / 2.0)]


@spec
class Augmentation:
    """Changes of pictures by kornia, each drawn for itself.

    Attributes:
        probability: Share of the pictures that each change meets.
        brightness: Range of the added brightness plus 1: 1 changes nothing.
        contrast: Range of the factor on the brightness.
        gamma: Range of the exponent of the tone curve.
        blur_px: Range of the standard deviation of the blur, px of the network's picture.
        motion_px: Way of the camera while the shutter was open, px.
        noise: Standard deviation of the noise, of full scale.
    """

    probability: Share
    brightness: PositiveRange
    contrast: PositiveRange
    gamma: PositiveRange
    blur_px: PositiveRange
    motion_px: Annotated[int, Ge(4), MultipleOf(2)]
    noise: NonNegative

    def build(self) -> torch.nn.Module:
        """Return the changes of RGB pictures in [0, 1], `(B, 3, h, w)`; they draw from torch."""
        from kornia import augmentation

        share = self.probability
        side_px = 2 * math.ceil(3.0 * self.blur_px[1]) + 1
        return torch.nn.Sequential(
            augmentation.RandomBrightness(self.brightness, p=share),
            augmentation.RandomContrast(self.contrast, p=share),
            augmentation.RandomGamma(self.gamma, p=share),
            augmentation.RandomGaussianBlur((side_px, side_px), self.blur_px, p=share),
            augmentation.RandomMotionBlur(self.motion_px + 1, 180.0, 0.0, p=share),
            augmentation.RandomGaussianNoise(0.0, self.noise, p=share),
        )
