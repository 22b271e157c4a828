"""Pictures to train on: each frame becomes the two views at which the segmenter looks, with room to crop.

A sample is a function of the seed and its number alone, whichever process makes it, so a training goes on exactly where it stopped.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.progress import track
from torch.utils.data import Dataset

from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.spec import spec
from perception import dataset
from perception.augment import Augmentation, augmented
from perception.segment_network import SMALLEST_PIECE, THRESHOLD
from perception.segment_window import Window, around, block_box, whole

ROOM = 1.5
"""Size of a stored view over the network's picture: what a crop can take away without loss of detail."""
LOOKS = ("whole", "closer")


@spec
class Crop:
    """Which part of a view a sample shows.

    Attributes:
        width: Range of the part of the view's width; above 1 there is black around it.
        shift: Largest shift of its middle, as a part of the view's size.
        roll_rad: Largest turn about the line of sight.
        mirror: How often left and right are swapped.
    """

    width: tuple[float, float]
    shift: float
    roll_rad: float
    mirror: float

    def check(self) -> None:
        if not 0 < self.width[0] <= self.width[1]:
            raise ConfigError(f"training.crop.width: expected 0 < lowest <= highest, got {list(self.width)}")

    def drawn(
        self, picture: np.ndarray, shares: np.ndarray, size_px: tuple[int, int], generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the same random part of a picture `(H, W, 3)` and of what is known of it `(H, W, 2)`, each of size `size_px`."""
        height, width = picture.shape[:2]
        scale = generator.uniform(*self.width)
        middle = np.array([width, height]) * (0.5 + generator.uniform(-self.shift, self.shift, 2))
        box = (middle[0] - scale * width / 2.0, middle[1] - scale * height / 2.0, scale * width, scale * height)
        window = around(box, size_px, 0.0)
        both = [window.take(picture, size_px), window.take(shares, size_px)]
        roll_rad = generator.uniform(-self.roll_rad, self.roll_rad)
        if roll_rad:
            centre = ((size_px[0] - 1) / 2.0, (size_px[1] - 1) / 2.0)
            turn = cv2.getRotationMatrix2D(centre, float(np.degrees(roll_rad)), 1.0)
            both = [cv2.warpAffine(values, turn, size_px, flags=cv2.INTER_LINEAR) for values in both]
        if generator.random() < self.mirror:
            both = [values[:, ::-1] for values in both]
        return both[0], both[1]


@dataclass(frozen=True)
class Views:
    """Views of all frames, in memory.

    Attributes:
        pictures: `(F, 2, H, W, 3)` uint8, RGB: the whole frame, and the block with room around it.
        shares: How much of each pixel shows block and mouth, `(F, 2, H, W, 2)` uint8, 255 for all of it.
        conditions: Under what each frame was taken.
        names: Path of each frame without its endings.
    """

    pictures: np.ndarray
    shares: np.ndarray
    conditions: Sequence[str]
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.names)

    def part(self, chosen: np.ndarray) -> Views:
        """Returns the chosen frames, by index."""
        conditions, names = ([part[int(k)] for k in chosen] for part in (self.conditions, self.names))
        return Views(self.pictures[chosen], self.shares[chosen], tuple(conditions), tuple(names))


class Samples(Dataset):
    """Endless samples by number.

    Args:
        views: What they are cut from.
        crop: How.
        steps: What happens to them.
        size_px: Width and height of a sample.
        closer: How often a sample is cut from the closer view.
        seed: Of all draws.
    """

    def __init__(
        self, views: Views, crop: Crop, steps: Mapping[str, Augmentation], size_px: tuple[int, int], closer: float, seed: int
    ) -> None:
        self._views, self._crop, self._steps = views, crop, steps
        self._size_px, self._closer, self._seed = size_px, closer, seed

    def __getitem__(self, number: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns picture `(3, h, w)` and shares of block and mouth `(2, h, w)` of sample `number`, uint8."""
        generator = np.random.default_rng((self._seed, number))
        frame, look = int(generator.integers(len(self._views))), int(generator.random() < self._closer)
        picture, shares = self._crop.drawn(
            self._views.pictures[frame, look], self._views.shares[frame, look], self._size_px, generator
        )
        changed = augmented(picture.astype(np.float32) / np.float32(255.0), self._steps, generator)
        picture = (changed * 255.0 + 0.5).astype(np.uint8)
        return torch.from_numpy(picture.transpose(2, 0, 1).copy()), torch.from_numpy(shares.transpose(2, 0, 1).copy())


class Batches:
    """The numbers of the samples of each update, from one update on; a batch sampler for torch's loader."""

    def __init__(self, first: int, last: int, size: int) -> None:
        self._first, self._last, self._size = first, last, size

    def __iter__(self) -> Iterator[list[int]]:
        for update in range(self._first, self._last):
            yield list(range(update * self._size, (update + 1) * self._size))

    def __len__(self) -> int:
        return self._last - self._first


@contextmanager
def forkable() -> Iterator[None]:
    """Keeps OpenCV from threads of its own while processes are forked: in those it would wait for threads that are not there."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(0)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def frames(folders: Sequence[str]) -> list[Path]:
    """Returns the frames with a mask in some folders and those below them, as paths without endings, sorted.

    Raises:
        FrameError: a folder holds none.
    """
    stems: list[Path] = []
    for folder in folders:
        here = sorted(Path(folder).rglob(f"*{dataset.MASK}"))
        here = [path.with_name(path.name.removesuffix(dataset.MASK)) for path in here if not path.name.startswith(".")]
        if not here:
            raise FrameError(
                f"training.frames: no *{dataset.MASK} in '{folder}' (seen from {Path.cwd()}); `brokk mode=render` and "
                "`brokk mode=label` make frames with masks"
            )
        stems += here
    return stems


def read(stems: Sequence[Path], size_px: tuple[int, int], margin: float, seed: int) -> Views:
    """Reads frames, some at a time, and keeps their two views.

    Args:
        stems: Frames, paths without endings.
        size_px: Width and height of the network's picture.
        margin: Room around the block in the closer view, as a part of its box, before the room to crop.
        seed: Of the closer view of frames without a block, which shows any part of them.
    """
    width, height = (round(ROOM * side) for side in size_px)
    pictures = np.empty((len(stems), len(LOOKS), height, width, 3), np.uint8)
    shares = np.empty((len(stems), len(LOOKS), height, width, 2), np.uint8)

    def fill(number: int) -> str:
        picture, known, condition = _frame(stems[number])
        generator = np.random.default_rng((seed, number))
        for look, window in enumerate(_looks(known, (width, height), margin, generator)):
            pictures[number, look] = window.take(picture, (width, height))
            shares[number, look] = window.take(known, (width, height))
        return condition

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        work = pool.map(fill, range(len(stems)))
        conditions = list(track(work, "reading frames", total=len(stems), transient=True))
    return Views(pictures, shares, conditions, [str(stem) for stem in stems])


def _frame(stem: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns picture `(H, W, 3)`, shares `(H, W, 2)` and condition of one frame."""
    path = Path(f"{stem}{dataset.COLOR}")
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if picture is None:
        raise FrameError(f"{path}: {'no picture' if path.is_file() else 'there is no such file'}, but a mask lies beside it")
    label = dataset.read_label(stem)
    if label.block.shape != picture.shape[:2]:
        raise FrameError(f"{path}: {picture.shape[1::-1]} px, its mask {label.block.shape[::-1]} px")
    condition = dataset.read_truth(stem).scene if dataset.is_whole(stem) else "unknown"
    known = np.stack([label.block, label.mouth], axis=-1).astype(np.uint8) * np.uint8(255)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), known, condition


def _looks(known: np.ndarray, size_px: tuple[int, int], margin: float, generator: np.random.Generator) -> list[Window]:
    """Returns the windows of both views of a frame."""
    first = whole(known.shape, size_px)
    box = block_box(known[..., 0] / 255.0, THRESHOLD, SMALLEST_PIECE)
    if box is None:
        side = generator.uniform(0.2, 0.8) * np.array([known.shape[1], known.shape[0]])
        corner = generator.uniform(0.0, 1.0, 2) * (np.array([known.shape[1], known.shape[0]]) - side)
        box = (*corner, *side)
    return [first, around(box, size_px, (ROOM * (1.0 + 2.0 * margin) - 1.0) / 2.0)]
