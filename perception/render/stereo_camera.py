"""The stereo camera: from light to pictures (air, lens, sensor, processing), and geometry of the pair.

`LinearSensor` is an ideal camera: every pixel sees all three colours. `MosaicSensor` is a colour
camera as it is built: two lenses and exposures, one colour at a photosite, photon and read noise
(EMVA 1288, release 4.0), and then white balance, demosaicing, tone curve, sharpening and JPEG. Those
steps spread the noise over neighbours, so that it no longer averages out as that of pixels does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Interval

from brokk_rl.spec import NonNegativeRange, Ordered, Positive, PositiveRange, spec
from perception.camera import CameraModel
from perception.render.ray_tracer import Pinhole

Percent = Annotated[int, Interval(ge=1, le=100)]

_SHARPENING_PX = 1.0
"""Standard deviation of the unsharp mask, as in common image processors; chosen by hand."""


@dataclass(frozen=True)
class CameraExposure:
    """Settings of one picture of a scene.

    Attributes:
        gain: Signal for unit radiance; 1 saturates.
        extinction_per_m: Of the dusty air: the transmitted part of the light after z metres is
            exp(-extinction z).
        airlight: Radiance of the dust itself.
        patchiness: Standard deviation of the dust's density over the picture, relative; it drifts
            before the block.
        blur_px: Standard deviation of the point spread.
        full_well_e: Electrons at saturation of a linear sensor; decides the shot noise.
        read_noise_e: Noise of a linear sensor in the dark, electrons.
        gamma: Exponent of a linear sensor's response; 1 is linear, 2.2 that of most cameras.
        vignetting: Part of the light that is missing in the corners.
    """

    gain: float
    extinction_per_m: float
    airlight: float
    patchiness: float
    blur_px: float
    full_well_e: float
    read_noise_e: float
    gamma: float
    vignetting: float


class LinearCamera:
    """A camera without colour filters: noise of each colour at each pixel is independent."""

    def develop(
        self, light: np.ndarray, exposure: CameraExposure, generator: np.random.Generator
    ) -> np.ndarray:
        """Return the picture, RGB, `(h, w, 3)` uint8, of light, `(h, w, 3)` float32."""
        signal = np.clip(light * np.float32(exposure.gain), 0.0, 1.0)
        spread = np.sqrt(
            signal / np.float32(exposure.full_well_e)
            + np.float32((exposure.read_noise_e / exposure.full_well_e) ** 2)
        )
        signal = np.clip(
            signal + spread * generator.standard_normal(signal.shape, np.float32), 0.0, 1.0
        )
        if exposure.gamma != 1.0:
            signal = signal ** np.float32(1.0 / exposure.gamma)
        return (255.0 * signal + 0.5).astype(np.uint8)


@spec
class LinearSensor:
    """Two equal cameras without colour filters; the scene gives noise and response."""

    @property
    def usual_gamma(self) -> float:
        """Exponent of the tone curve: a user of the pictures takes them for linear."""
        return 1.0

    def draw_pair(self, generator: np.random.Generator) -> tuple[LinearCamera, LinearCamera]:
        """Return the left and the right camera; nothing about them is drawn."""
        del generator
        return LinearCamera(), LinearCamera()


@dataclass(frozen=True)
class MosaicCamera:
    """One colour camera of a pair, drawn.

    Attributes:
        gain: Exposure relative to the one that the scene asks for.
        color_gain: Gains of the white balance, RGB; a photosite sees a colour so much weaker.
        color_error: Error of these gains, RGB, about 1.
        focus_px: Standard deviation of the defocus.
        motion_px: Way of the picture during the exposure, right and down.
        full_well_e: Electrons at saturation.
        read_noise_e: Noise in the dark, electrons.
        photo_response: Standard deviation of the photosites' sensitivity (PRNU), relative.
        bits: Of the converter.
        gamma: Exponent of the tone curve.
        sharpening: Strength of the unsharp mask.
        jpeg_quality: Of the file, 1 to 100.
        pattern: Seed of the photosites' sensitivity.
    """

    gain: float
    color_gain: tuple[float, float, float]
    color_error: tuple[float, float, float]
    focus_px: float
    motion_px: tuple[float, float]
    full_well_e: float
    read_noise_e: float
    photo_response: float
    bits: int
    gamma: float
    sharpening: float
    jpeg_quality: int
    pattern: int

    def develop(
        self, light: np.ndarray, exposure: CameraExposure, generator: np.random.Generator
    ) -> np.ndarray:
        """Return the picture, RGB, `(h, w, 3)` uint8, of light, `(h, w, 3)` float32."""
        light = blur_motion(light, self.motion_px)
        if self.focus_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), self.focus_px)
        raw = self.read_out(light * np.float32(exposure.gain * self.gain), generator)
        picture = self._balance(raw)
        picture = picture ** np.float32(1.0 / self.gamma)
        if self.sharpening > 0:
            soft = cv2.GaussianBlur(picture, (0, 0), _SHARPENING_PX)
            picture = picture + np.float32(self.sharpening) * (picture - soft)
        picture = (255.0 * np.clip(picture, 0.0, 1.0) + 0.5).astype(np.uint8)
        # OpenCV writes blue, green, red, with colours at half the resolution (4:2:0).
        _, file = cv2.imencode(
            ".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality]
        )
        return np.ascontiguousarray(np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR))[..., ::-1])

    def read_out(self, signal: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        """Return the photosites' values of a colour mosaic, `(h, w)` float32 in [0, 1].

        Args:
            signal: Light of each colour at each photosite, 1 saturates, `(h, w, 3)`.
            generator: Source of photon and read noise.
        """
        mosaic = np.empty(signal.shape[:2], np.float32)
        # Red, green / green, blue, from the upper left corner.
        for row, column, color in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
            sees = signal[row::2, column::2, color] / np.float32(self.color_gain[color])
            mosaic[row::2, column::2] = sees
        if self.photo_response > 0:
            pattern = np.random.default_rng(self.pattern)
            uneven = pattern.standard_normal(mosaic.shape, np.float32)
            mosaic = mosaic * (1.0 + np.float32(self.photo_response) * uneven)
        electrons = np.clip(mosaic, 0.0, 1.0) * np.float32(self.full_well_e)
        # Hundreds of photons: their Poisson distribution is normal to a percent.
        spread = np.sqrt(electrons + np.float32(self.read_noise_e**2))
        electrons += spread * generator.standard_normal(mosaic.shape, np.float32)
        steps = np.float32((1 << self.bits) - 1)
        values = np.round(np.clip(electrons / np.float32(self.full_well_e), 0.0, 1.0) * steps)
        return values / steps

    def _balance(self, raw: np.ndarray) -> np.ndarray:
        """Return all colours at all pixels, white where it should be, `(h, w, 3)` in [0, 1]."""
        gains = np.array(self.color_gain) * self.color_error
        balanced = np.empty(raw.shape, np.float32)
        for row, column, color in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
            balanced[row::2, column::2] = raw[row::2, column::2] * np.float32(gains[color])
        whole = (np.clip(balanced, 0.0, 1.0) * 65535.0 + 0.5).astype(np.uint16)
        # Edge-aware: it interpolates along edges, as the processors of cameras do.
        found = np.asarray(cv2.cvtColor(whole, cv2.COLOR_BayerRGGB2RGB_EA))
        return found.astype(np.float32) / 65535.0


CameraProcess = LinearCamera | MosaicCamera
"""One camera of a pair: makes a picture of the light behind its lens."""


@spec
class MosaicSensor:
    """A pair of colour cameras whose lenses, exposures and colours differ a little.

    Its noise and tone curve count instead of those of the scene.

    Attributes:
        full_well_e: Electrons at saturation.
        read_noise_e: Noise in the dark, electrons.
        photo_response: Standard deviation of the photosites' sensitivity (PRNU), relative.
        bits: Of the converter.
        red_gain: White balance of red: green photosites see so much more.
        blue_gain: Likewise of blue.
        exposure: Exposure of both cameras relative to the one that the scene asks for.
        gain_std: Standard deviation of each camera's exposure, relative.
        color_std: Standard deviation of each camera's gains of red and blue, relative.
        focus_px: Standard deviation of the defocus of each lens.
        motion_px: Way of the picture during the exposure, in any direction; of both alike.
        gamma: Exponent of the tone curve.
        sharpening: Strength of the unsharp mask.
        jpeg_quality: Of the files, 1 to 100.
        seed: `null`: another pair for each frame. A number draws one pair for all of them.
    """

    full_well_e: PositiveRange
    read_noise_e: NonNegativeRange
    photo_response: float
    bits: Annotated[int, Interval(ge=6, le=16)]
    red_gain: PositiveRange
    blue_gain: PositiveRange
    exposure: PositiveRange
    gain_std: float
    color_std: float
    focus_px: NonNegativeRange
    motion_px: NonNegativeRange
    gamma: PositiveRange
    sharpening: NonNegativeRange
    jpeg_quality: Annotated[tuple[Percent, Percent], Ordered()]
    seed: int | None

    @property
    def usual_gamma(self) -> float:
        """Exponent of the tone curve that a user of the pictures expects."""
        return (self.gamma[0] + self.gamma[1]) / 2

    def draw_pair(self, generator: np.random.Generator) -> tuple[MosaicCamera, MosaicCamera]:
        """Return the left and the right camera for one frame.

        Args:
            generator: Source of the frame's motion, and of the pair where there is no seed.
        """
        pair = generator if self.seed is None else np.random.default_rng(self.seed)
        shared = {
            "color_gain": (pair.uniform(*self.red_gain), 1.0, pair.uniform(*self.blue_gain)),
            "full_well_e": pair.uniform(*self.full_well_e),
            "read_noise_e": pair.uniform(*self.read_noise_e),
            "photo_response": self.photo_response,
            "bits": self.bits,
            "gamma": pair.uniform(*self.gamma),
            "sharpening": pair.uniform(*self.sharpening),
            "jpeg_quality": int(pair.integers(self.jpeg_quality[0], self.jpeg_quality[1] + 1)),
        }
        # How bright a picture is depends on the scene, whichever camera takes it.
        exposure = generator.uniform(*self.exposure)
        own = []
        for _ in range(2):
            error = np.exp(self.color_std * pair.standard_normal(2))
            own.append(
                {
                    "gain": exposure * float(np.exp(self.gain_std * pair.standard_normal())),
                    "color_error": (float(error[0]), 1.0, float(error[1])),
                    "focus_px": pair.uniform(*self.focus_px),
                    "pattern": int(pair.integers(1 << 31)),
                }
            )
        # The rig shakes as one: both pictures move alike.
        angle, way = generator.uniform(-np.pi, np.pi), generator.uniform(*self.motion_px)
        motion_px = (way * float(np.cos(angle)), way * float(np.sin(angle)))
        left, right = (MosaicCamera(motion_px=motion_px, **shared, **one) for one in own)
        return left, right


def blur_motion(light: np.ndarray, motion_px: tuple[float, float]) -> np.ndarray:
    """Return light that moved evenly by `motion_px`, right and down, about its place."""
    way = float(np.hypot(*motion_px))
    if way == 0.0:
        return light
    # A line from end to end, spread over the pixels that it passes.
    reach = int(np.ceil(way / 2)) + 1
    side = 2 * reach + 1
    kernel = np.zeros((side, side), np.float32)
    for part in np.linspace(-0.5, 0.5, 16 * side):
        x, y = reach + part * motion_px[0], reach + part * motion_px[1]
        column, row = int(x), int(y)
        right, down = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer((1 - down, down), (1 - right, right))
    return cv2.filter2D(light, -1, kernel / kernel.sum())


def take_picture(
    radiance: np.ndarray,
    depth_m: np.ndarray,
    exposure: CameraExposure,
    density: np.ndarray,
    camera: CameraProcess,
    generator: np.random.Generator,
) -> np.ndarray:
    """Return the picture that a camera takes of a view, RGB, `(h, w, 3)` uint8.

    Args:
        radiance: Linear light, `(h, w, 3)` float32.
        depth_m: `(h, w)`, NaN where nothing is.
        exposure: How it is taken.
        density: Small picture of the dust's density, about 1; see `draw_dust`.
        camera: Makes the picture of the light.
        generator: Source of the noise.
    """
    height, width = depth_m.shape
    light = radiance
    if exposure.extinction_per_m > 0:
        thick = cv2.resize(density, (width, height), interpolation=cv2.INTER_CUBIC)
        way = np.nan_to_num(depth_m, nan=1e3) * exposure.extinction_per_m * np.maximum(thick, 0.0)
        left = np.exp(-way)[..., None].astype(np.float32)
        light = light * left + np.float32(exposure.airlight) * (1.0 - left)
    if exposure.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), exposure.blur_px)
    if exposure.vignetting > 0:
        x = np.linspace(-1, 1, width, dtype=np.float32)
        y = np.linspace(-1, 1, height, dtype=np.float32)
        lost = np.float32(exposure.vignetting / 2) * (x[None] ** 2 + y[:, None] ** 2)
        light = light * (1.0 - lost)[..., None]
    return camera.develop(light, exposure, generator)


def draw_dust(patchiness: float, generator: np.random.Generator) -> np.ndarray:
    """Return the density of drifting dust over a picture, `(6, 10)` float32, mean about 1."""
    return (1.0 + patchiness * generator.standard_normal((6, 10))).astype(np.float32)


@spec
class PairMisalignment:
    """Departure of the right camera from its place beside the left one, after rectification.

    Attributes:
        turn_rad: Pitch, yaw and roll: turns about its x, y and z axes.
        focal: Relative difference of its focal length.
        offset_px: Shift of its picture to the right and down.
        distortion_px: Radial shift at the middle of the picture's left and right border, growing
            with the cube of the distance from the centre.
        seed: `null`: a rig with exactly these errors. A number draws one rig, with these as the
            standard deviations of normal errors.
    """

    turn_rad: tuple[float, float, float]
    focal: float
    offset_px: tuple[float, float]
    distortion_px: float
    seed: int | None

    @property
    def is_none(self) -> bool:
        """The pair is perfect."""
        return not any((*self.turn_rad, self.focal, *self.offset_px, self.distortion_px))

    def draw(self) -> PairMisalignment:
        """Return the errors of one rig: these, or those drawn by the seed."""
        if self.seed is None:
            return self
        std = np.array([*self.turn_rad, self.focal, *self.offset_px, self.distortion_px])
        chance = (std * np.random.default_rng(self.seed).standard_normal(7)).tolist()
        *turn_rad, focal, right_px, down_px, distortion_px = chance
        drawn = {"turn_rad": turn_rad, "focal": focal, "offset_px": (right_px, down_px)}
        return PairMisalignment(**drawn, distortion_px=distortion_px, seed=None)


@dataclass(frozen=True)
class MisalignedPinhole(Pinhole):
    """The right camera of a pair that is not perfect.

    Attributes:
        error: Its errors, drawn.
    """

    error: PairMisalignment

    def rays(self, pixel: np.ndarray) -> np.ndarray:
        """Return directions with z = 1, `(M, 3)` float32, through pixels, `(M, 2)`."""
        error, half_px = self.error, self.width / 2
        away = pixel - self.matrix[:2, 2] - error.offset_px
        # The shift is a fraction of a pixel: to undo it, first order is exact to 1e-4 px.
        square = (away**2).sum(1, keepdims=True) / half_px**2
        away = away * (1.0 - error.distortion_px / half_px * square)
        flat = away / (self.focal_px * (1.0 + error.focal))
        turn = np.asarray(cv2.Rodrigues(np.asarray(error.turn_rad))[0])
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ turn.T
        return (rays / rays[:, 2:]).astype(np.float32)


@spec
class StereoRig:
    """A stereo camera, fixed to the machine.

    Attributes:
        width: Pixels.
        height: Pixels.
        focal_px: Focal length.
        baseline_m: From the left camera to the right one.
        position_in_base_m: Left camera's centre of projection in the base frame.
        yaw_rad: Turn of the view about the vertical, from base x towards y.
        pitch_rad: How far it looks down.
        error: Departure of the pair from perfect rectification.
        sensor: Makes the pictures of both cameras from light.
    """

    width: Annotated[int, Ge(16)]
    height: Annotated[int, Ge(16)]
    focal_px: Positive
    baseline_m: Positive
    position_in_base_m: tuple[float, float, float]
    yaw_rad: float
    pitch_rad: float
    error: PairMisalignment
    sensor: LinearSensor | MosaicSensor

    @property
    def left(self) -> Pinhole:
        """The camera in whose coordinates everything is told."""
        return Pinhole(self.width, self.height, self.focal_px, np.zeros(3))

    @property
    def right(self) -> Pinhole:
        """Its partner."""
        place = self.width, self.height, self.focal_px, np.array([self.baseline_m, 0.0, 0.0])
        return (
            Pinhole(*place) if self.error.is_none else MisalignedPinhole(*place, self.error.draw())
        )

    @property
    def base_from_camera(self) -> np.ndarray:
        """Pose of the left camera in the base frame, `(4, 4)`: x right, y down, z forward."""
        return build_camera_pose(self.position_in_base_m, self.yaw_rad, self.pitch_rad)

    @property
    def model(self) -> CameraModel:
        """The pair as its user knows it: nobody has told him an error that it has."""
        return CameraModel(
            self.left.matrix,
            baseline_m=self.baseline_m,
            size_px=(self.width, self.height),
            base_from_camera=self.base_from_camera,
            disparity_std_px=0.0 if self.error.is_none else None,
            gamma=self.sensor.usual_gamma,
        )

    @property
    def down_in_camera(self) -> np.ndarray:
        """Direction of gravity, `(3,)`, camera coordinates."""
        return -self.base_from_camera[2, :3]


def build_camera_pose(position_m: Sequence[float], yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """Return the pose of a level camera, `(4, 4)`: x right, y down, z forward.

    Args:
        position_m: Centre of projection in a frame with x forward, y left and z up.
        yaw_rad: Turn of the view about the vertical, from x towards y.
        pitch_rad: How far it looks down.
    """
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    down, ahead = math.sin(pitch_rad), math.cos(pitch_rad)
    forward = np.array([cos * ahead, sin * ahead, -down])
    right = np.array([sin, -cos, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position_m
    return pose


def measure_disparity_error(rig: StereoRig) -> tuple[float, float, float]:
    """Return the error of a pair's disparity: constant, and slopes over x/z and y/z, px.

    It is fitted to rays over the middle half of the right picture: near the border distortion bends
    it. Measured disparity less this error is the true one.
    """
    ideal = rig.left
    columns, rows = np.meshgrid(
        np.linspace(0.25, 0.75, 32) * (rig.width - 1),
        np.linspace(0.25, 0.75, 18) * (rig.height - 1),
    )
    pixel = np.stack([columns.ravel(), rows.ravel()], 1)
    wrong_px = ideal.project(rig.right.rays(pixel).astype(float))[:, 0] - pixel[:, 0]
    flat = (pixel - ideal.matrix[:2, 2]) / rig.focal_px
    design = np.column_stack([np.ones(len(flat)), flat])
    constant, across, down = np.linalg.lstsq(design, wrong_px, rcond=None)[0]
    return float(constant), float(across), float(down)
