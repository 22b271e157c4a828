"""Check of a camera by what it shows: order, turn and rectification of a pair, and the scale of depth.

The rows of a rectified pair correspond, and what it shows lies farther right in its left picture.
Features are matched without any depth, because the depth of a bad pair is the first to fail. A
shift across alone shows nothing here: a board at known distances measures it.

A wrong baseline, unit of depth or focal length makes every rim too large or too small by one
factor. The finder then finds nothing, since it searches rims of the right size alone: `RimScale`
compares dark rims of any size with the holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge

from brokk_rl.contracts.vision import Ellipse, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, NonNegative, Positive, Share, spec
from perception.ellipse import conic
from perception.ellipse.detector import ContourArcs
from perception.robust_fit import compute_biweight, estimate_spread, fit_linear

FEW = "matched features of the pair"
ORDER = "part of the features that lie farther right in the left picture"
TURN = "vertical over horizontal distance of matched features"
ROWS = "vertical disparity of the pair, px"
UNSURE = "standard deviation of the vertical disparity, px"
CANNOT_TELL = (FEW, UNSURE)
"""Reasons that say nothing of the pair."""
RANGE = "median depth of the pair's features, m"
SCALE = "depth by disparity over the depth told"
OF_PAIR = "size of dark rims over that of the holes, by the pair"
OF_DEPTH = "size of dark rims over that of the holes, by depth"
EXPLANATIONS = {
    ROWS: "the rows of the pictures do not correspond. Rectify them, or calibrate the camera pair.",
    ORDER: "the pictures are swapped: .color.png is the left one, .right.png the right one.",
    TURN: "the pictures are turned. Turn them, K and dist: the cameras stand side by side.",
    FEW: "the pictures share too few features. The same moment, light, no lens covered?",
    UNSURE: "shared features are too uncertain to judge rectification. Light? Sharp pictures?",
    RANGE: "the pair sees an impossible depth. K or baseline_m is far off: is baseline_m in m?",
    SCALE: "depth and pair disagree: by 10, 100 or 1000 its unit; else K or baseline_m is wrong.",
    OF_PAIR: "dark rims have the size of a hole by this factor: baseline_m, or perception.radius_m?",
    OF_DEPTH: "dark rims have that size by this factor: unit of depth, K, or perception.radius_m?",
}
"""Explanation and remedy for each reason."""


@dataclass(frozen=True)
class PairMatches:
    """Places of the same features in both pictures of a pair, px.

    Attributes:
        left: `(n, 2)`.
        right: `(n, 2)`.
        texture: Least eigenvalue of the gradient around each, `(n,)`: the variance of its place
            is proportional to the inverse.
    """

    left: np.ndarray
    right: np.ndarray
    texture: np.ndarray


@dataclass(frozen=True)
class PairAlignment:
    """Vertical disparity of a pair: `pitch (1 + y²) + roll x + focal y`.

    `x` and `y` are coordinates at depth 1. All are what the right picture shows lower, px.

    Attributes:
        numbers_px: `(pitch, roll, focal)`: by a turn about the x axis or a shift of the picture, by a
            turn about the optical axis, and by another focal length; angles times focal length.
        rms_px: Root mean square over the matched features, less what noise alone gives.
        std_px: Standard deviation of `rms_px`.
    """

    numbers_px: np.ndarray
    rms_px: float
    std_px: float


@spec
class PairCheck:
    """Refuse frames whose pair is swapped, turned, not rectified, or at odds with its depth.

    Attributes:
        width_px: Width of the pictures in which features are searched.
        num_features: Most features of a picture.
        window_px: Side of the window that registers a feature (Lucas and Kanade 1981).
        contrast: Largest gain of contrast before the search (CLAHE).
        corner: Least step of brightness of a corner, grey levels.
        cell_px: Side of the squares of the small picture of which one feature counts.
        return_px: Largest error of a match on the way there and back, in the small picture.
        common_px: Departure from the commonest vertical shift within which partners are searched,
            in the small picture.
        alike: Side of the squares of the picture, as a part of its width, within which features
            share the error of the lens.
        least_matches: Matches below which nothing can be told; such a frame is refused unless the
            pair was found good before.
        least_ahead: Least part of the features that lie farther right in the left picture.
        most_turn: Largest quotient of vertical and horizontal distance of matched features.
        limit_px: Largest root mean square of the vertical disparity over the features.
        num_sigma: Standard deviations by which it must exceed the limit.
        most_std_px: Standard deviation of that, from which nothing can be told.
        range_m: Median depth of the features between which it is possible.
        scale: Largest departure from 1 of depth by disparity over a depth that was measured.
        every: Frames of the same pair of which one is checked.
    """

    width_px: Count
    num_features: Count
    window_px: Count
    contrast: Positive
    corner: Count
    cell_px: Positive
    return_px: Positive
    common_px: Positive
    alike: Share
    least_matches: Count
    least_ahead: Share
    most_turn: Positive
    limit_px: Positive
    num_sigma: NonNegative
    most_std_px: Positive
    range_m: tuple[Positive, Positive]
    scale: Share
    every: Count

    def build(self) -> PairWatch:
        """Return a watch that has seen no frame yet."""
        return PairWatch(self)

    def find_fault(self, frame: Frame) -> Rejection | None:
        """Return why the pair of a frame is refused; `None` for a good pair, or a single picture."""
        if frame.right is None or frame.right.shape != frame.color.shape:
            return None
        matches = self.match_features(frame.color, frame.right)
        if len(matches.left) < self.least_matches:
            return Rejection("frame", FEW, float(len(matches.left)), float(self.least_matches))
        ahead_px = matches.left - matches.right
        across_px, down_px = np.abs(np.median(ahead_px, axis=0))
        turn = float(down_px / max(across_px, 1.0))
        if turn > self.most_turn:
            return Rejection("frame", TURN, turn, self.most_turn)
        share = float(np.mean(ahead_px[:, 0] > 0))
        if share < self.least_ahead:
            return Rejection("frame", ORDER, share, self.least_ahead)
        found = fit_alignment(matches, frame, self.alike)
        if found.rms_px - self.num_sigma * found.std_px > self.limit_px:
            return Rejection("frame", ROWS, found.rms_px, self.limit_px)
        if found.std_px > self.most_std_px:
            return Rejection("frame", UNSURE, found.std_px, self.most_std_px)
        depth_m = measure_depth(matches, frame)
        if depth_m is not None and not self.range_m[0] <= depth_m <= self.range_m[1]:
            limit_m = self.range_m[0] if depth_m < self.range_m[0] else self.range_m[1]
            return Rejection("frame", RANGE, depth_m, limit_m)
        scale = measure_depth_scale(matches, frame, self.least_matches)
        if scale is not None and abs(np.log(scale)) > np.log1p(self.scale):
            return Rejection("frame", SCALE, scale, 1.0)
        return None

    def match_features(self, left: np.ndarray, right: np.ndarray) -> PairMatches:
        """Return the features that both pictures, RGB `(h, w, 3)`, show.

        ORB finds partners anywhere, and again near the commonest vertical shift: of a repeated
        pattern most of the first ones are wrong. Lucas and Kanade's registration places them. Both
        work in smaller pictures of equalised contrast, in which dust and dark hide least.
        """
        shrink = max(1, round(left.shape[1] / self.width_px))
        equalizer = cv2.createCLAHE(self.contrast, (8, 8))
        pictures = []
        for picture in (left, right):
            gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
            size = gray.shape[1] // shrink, gray.shape[0] // shrink
            small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
            pictures.append(np.asarray(equalizer.apply(small)))
        detector = cv2.ORB.create(self.num_features, fastThreshold=self.corner)
        mine, my_words = detector.detectAndCompute(pictures[0], None)
        theirs, their_words = detector.detectAndCompute(pictures[1], None)
        nothing = PairMatches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
        if not mine or not theirs:
            return nothing
        my_px, their_px = cv2.KeyPoint.convert(mine), cv2.KeyPoint.convert(theirs)
        apart_px = their_px[None, :, 1] - my_px[:, None, 1]
        allowed = np.ones(apart_px.shape, bool)
        for _ in range(2):
            first, second = _match_words(my_words, their_words, allowed)
            if not len(first):
                return nothing
            shift_px = apart_px[first, second]
            votes = compute_biweight(shift_px[:, None] - shift_px, self.common_px).sum(1)
            allowed = np.abs(apart_px - shift_px[np.argmax(votes)]) < self.common_px
        start, end = my_px[first], their_px[second]
        # Features of several scales at one place share their error: one of each cell counts.
        cell = np.floor(start / self.cell_px)
        alone = np.unique(cell[:, 0] * 10_000 + cell[:, 1], return_index=True)[1]
        start, end = start[alone], end[alone]
        there, texture = self._register(pictures[0], pictures[1], start, end)
        back, _ = self._register(pictures[1], pictures[0], there, start)
        good = np.linalg.norm(back - start, axis=1) < self.return_px
        # Pixel centres: a shrunk pixel's centre lies between those it covers.
        left_px = (start[good].astype(float) + 0.5) * shrink - 0.5
        right_px = (there[good].astype(float) + 0.5) * shrink - 0.5
        return PairMatches(left_px, right_px, texture[good])

    def _register(
        self, one: np.ndarray, other: np.ndarray, start: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the places in another picture of features at `start`, near `guess`, `(n, 2)`.

        Also return the least eigenvalue of the gradient around each, `(n,)`.
        """
        window = (self.window_px, self.window_px)
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS
        places, _, texture = cv2.calcOpticalFlowPyrLK(
            one, other, start, guess.copy(), winSize=window, maxLevel=1, flags=flags
        )
        return places, texture.ravel().astype(float)


class PairWatch:
    """Check of the frames of one camera: a good pair is checked once in `every` frames."""

    def __init__(self, settings: PairCheck) -> None:
        self._settings = settings
        self._rig: tuple[object, ...] = ()
        self._is_good = False
        self._num_unchecked = 0

    def find_fault(self, frame: Frame) -> Rejection | None:
        """Return why the pair of a frame is refused; see `PairCheck.find_fault`.

        A frame that shows too few features is judged as the last one of the same camera that showed
        enough; without one it is refused.
        """
        rig = (frame.camera_matrix.tobytes(), frame.baseline_m, frame.color.shape)
        if rig != self._rig:
            self._rig, self._is_good = rig, False
        self._num_unchecked += 1
        if self._is_good and self._num_unchecked < self._settings.every:
            return None
        fault = self._settings.find_fault(frame)
        if fault is not None and fault.reason in CANNOT_TELL and self._is_good:
            return None
        self._num_unchecked, self._is_good = 0, fault is None
        return fault


def _match_words(
    mine: np.ndarray, theirs: np.ndarray, allowed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of descriptors that are each other's best partner among `allowed`, `(n, m)`."""
    matcher, mask = cv2.BFMatcher(cv2.NORM_HAMMING), allowed.astype(np.uint8)
    back = {}
    for one in matcher.match(theirs, mine, np.ascontiguousarray(mask.T)):
        back[one.queryIdx] = one.trainIdx
    pairs = []
    for one in matcher.match(mine, theirs, mask):
        if back.get(one.trainIdx) == one.queryIdx:
            pairs.append((one.queryIdx, one.trainIdx))
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second


def fit_alignment(matches: PairMatches, frame: Frame, alike: float) -> PairAlignment:
    """Return the vertical disparity of a pair: three numbers, fitted robustly.

    What a calibration leaves of the lenses is alike within squares of a part `alike` of the width.
    """
    shift_px = (matches.right - matches.left)[:, 1]
    matrix = frame.camera_matrix
    x, y = ((matches.right - matrix[:2, 2]) / np.diag(matrix)[:2]).T
    design = np.stack([1.0 + y**2, x, y], axis=1)
    # A hundredth of a pixel: pictures drawn without noise would leave no scale.
    precision = np.sqrt(matches.texture / np.median(matches.texture))
    square = np.floor(matches.left / (alike * frame.color.shape[1]))
    cell = square[:, 0] * 1000 + square[:, 1]
    solution, cov = fit_linear(design * precision[:, None], shift_px * precision, 0.01, cell=cell)
    # Where something was matched: beyond, three numbers of few features say anything.
    gram = design.T @ design / len(design)
    noise = float(np.trace(gram @ cov)) if np.isfinite(cov).all() else np.inf
    rms_px = float(np.sqrt(max(float(solution @ gram @ solution) - noise, 0.0)))
    return PairAlignment(solution, rms_px, float(np.sqrt(noise)))


def measure_depth(matches: PairMatches, frame: Frame) -> float | None:
    """Return the median depth of the matches, m; `None` without a baseline."""
    disparity_px = float(np.median((matches.left - matches.right)[:, 0]))
    if frame.baseline_m is None or disparity_px <= 0:
        return None
    return float(frame.camera_matrix[0, 0]) * frame.baseline_m / disparity_px


def measure_depth_scale(matches: PairMatches, frame: Frame, least: int) -> float | None:
    """Return depth by disparity over the depth of the frame, the median of the matches.

    Returns:
        `None` where fewer than `least` matches have depth, or do not agree.
    """
    if frame.baseline_m is None:
        return None
    column, row = np.rint(matches.left).astype(int).T
    told_m = frame.depth_m[row, column]
    disparity_px = (matches.left - matches.right)[:, 0]
    known = np.isfinite(told_m) & (disparity_px > 0)
    if np.count_nonzero(known) < least:
        return None
    pull_px = float(frame.camera_matrix[0, 0]) * frame.baseline_m
    logarithm = np.log(pull_px / disparity_px[known] / told_m[known])
    middle = float(np.median(logarithm))
    # Half of the matches lie within a tenth, or depth and pair show different things.
    if estimate_spread(logarithm - middle) > 0.1:
        return None
    return float(np.exp(middle))


RING = 1.25, 1.8
"""Radii of the ring around a rim in which its depth is read."""


@spec
class RimScale:
    """Compare the size of round, dark, whole rims with that of the holes.

    Attributes:
        width_px: Width of the picture in which rims of any size are searched.
        coverage: Least visible part of such a rim.
        darkness: Largest brightness inside over that of the ring around it.
        least: Factor on the size from which the scale is in doubt.
    """

    width_px: Count
    coverage: Share
    darkness: Share
    least: Annotated[float, Ge(1)]

    def measure_scale(
        self, frame: Frame, detector: ContourArcs, radius_m: float
    ) -> tuple[float, float] | None:
        """Return the size of the surest rim over that of the holes, and its score.

        Returns:
            `None` where nothing is in doubt.
        """
        shrink = max(1, round(frame.color.shape[1] / self.width_px))
        small = frame.color[::shrink, ::shrink]
        if shrink > 1:
            size = frame.color.shape[1] // shrink, frame.color.shape[0] // shrink
            small = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        depth_m = frame.depth_m[shrink // 2 :: shrink, shrink // 2 :: shrink]
        focal_px = float(frame.camera_matrix[0, 0]) / shrink
        for one in detector.detect(gray, None, None):
            ring_m = self._measure_depth(one, gray, depth_m)
            if one.coverage >= self.coverage and ring_m is not None:
                scale = one.a * ring_m / (focal_px * radius_m)
                return (scale, one.score) if abs(np.log(scale)) > np.log(self.least) else None
        return None

    def _measure_depth(self, one: Ellipse, gray: np.ndarray, depth_m: np.ndarray) -> float | None:
        """Return the depth around a rim, m; `None` for one that is not dark, or without depth."""
        shape = min(len(gray), len(depth_m)), min(len(gray[0]), len(depth_m[0]))
        row = conic.as_row(one)
        part = conic.bound_ellipse(row, RING[1] * one.a, shape)
        rows, columns = np.ogrid[part]
        radii = conic.measure_radii(row, columns, rows)
        ring = (radii > RING[0]) & (radii < RING[1])
        inside = radii < 0.8
        if not ring.any() or not inside.any():
            return None
        bright = float(np.median(gray[part][ring]))
        if float(np.median(gray[part][inside])) > self.darkness * bright:
            return None
        around_m = depth_m[part][ring]
        known_m = around_m[np.isfinite(around_m)]
        return float(np.median(known_m)) if len(known_m) > 0.5 * len(around_m) else None
