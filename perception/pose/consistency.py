"""Consistency of a hole with its surroundings: two measures of one thing must agree.

The ring around a hole lies on the plane that was fitted to its face, and a rim that is whole as an
ellipse is a circle on that plane.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts.vision import Ellipse, Rejection
from brokk_rl.signals import Frame
from perception.ellipse import conic
from perception.pose import plane, rim
from perception.pose.plane import FacePlane, FaceSupport

RING_KNOWN = "pixels with depth in the ring around it"
RING_ON_FACE = "part of the ring around it that lies on its face"
NEARER = "part of the inside that is nearer than the face"
STRETCH = "focal length by the roundness of the rim"
WHOLE, ONE_RIM, LEAST_SLOPE = 0.85, 0.6, 0.07
"""Visible part of an ellipse from which its shape is that of the rim; least part of a circle that
must be seen then, over that of the ellipse: 0.73 and more behind an arm and with chips, 0.42 with a
wrong focal length; squared slope of a face, 15 degrees, from which the shape tells that length."""
BESIDE = (1.15, 1.45)
"""Radii of an ellipse at which occluders of its rim are searched."""


def check_ring(
    points: FaceSupport,
    face: FacePlane,
    limits: tuple[float, float],
    is_aligned: bool,
    ellipse: Ellipse,
) -> Rejection | None:
    """Return why the innermost ring is not on the face, `None` where it is.

    A plane that was grown outwards may have left the ring where it began: the surroundings of a
    block, a belt, were taken for its face.

    Args:
        points: Depth around the ellipse.
        face: Its plane.
        limits: Outer radius of the ring in radii of the ellipse, and least part of it on the face.
        is_aligned: Both pictures agree on the plane, so that a ring without depth is no doubt.
        ellipse: The candidate.
    """
    ring = points.radii < limits[0]
    number = int(np.count_nonzero(ring))
    if number < plane.LEAST // 2:
        if is_aligned:
            return None
        return Rejection("pose", RING_KNOWN, float(number), plane.LEAST / 2, ellipse)
    off = np.abs(points.inverse[ring] - points.rays[ring] @ face.m)
    share = float(np.mean(off < plane.TUKEY * face.sigma))
    if share < limits[1]:
        return Rejection("pose", RING_ON_FACE, share, limits[1], ellipse)
    return None


def find_stretch(
    light: np.ndarray,
    camera_matrix: np.ndarray,
    face: FacePlane,
    row: np.ndarray,
    limits: tuple[float, float, float],
    least: float,
) -> float:
    """Return the focal length over that with which a whole rim is round on its face.

    A focal length that is too long by a factor stretches the depth of a pair by it, so that a round
    rim on a tilted face becomes longer along its slope. 1 where the tilt is too small to tell, or
    where no other focal length shows the circle.

    Args:
        light: Light, `(h, w)` float32.
        camera_matrix: With the focal length in doubt, `(3, 3)`.
        face: Plane of the face.
        row: The ellipse, `(5,)`.
        limits: Radius in m, its tolerance, and `center_px`; see `rim.fit_rim_circle`.
        least: Part of the circle that another focal length must show.
    """
    along, across = conic.measure_slope_axes(row, camera_matrix, face.m)
    ray = np.linalg.solve(camera_matrix, np.array([row[0], row[1], 1.0]))
    cosine = float(face.normal @ ray) / float(np.linalg.norm(ray))
    slope = 1.0 / cosine**2 - 1.0
    if slope < LEAST_SLOPE or not np.isfinite(along / across):
        return 1.0
    # The true slope is that of which a circle looks like this.
    true = (1.0 + slope) / (along / across) ** 2 - 1.0
    stretch = float(np.clip(np.sqrt(slope / max(true, 1e-6)), 0.1, 10.0))
    other = camera_matrix / np.array([[stretch], [stretch], [1.0]])
    other[:2, 2] = camera_matrix[:2, 2]
    circle = rim.fit_rim_circle(light, row, other, face.m * [1.0, 1.0, stretch], *limits)
    return stretch if circle is not None and circle.coverage > least else 1.0


def measure_hidden_part(face: FacePlane, row: np.ndarray, frame: Frame) -> float:
    """Return the part of a rim on a face, near an ellipse `(5,)`, that an occluder hides.

    Searched at two radii: the ellipse may be smaller than the rim, and depth is often unknown at
    the edge of an occluder.
    """
    height, width = frame.depth_m.shape
    # A step of 5 degrees. Chosen by hand; not searched.
    nearer = np.zeros(72, bool)
    for scale in BESIDE:
        points = conic.sample_ellipses(
            (row * [1.0, 1.0, scale, scale, 1.0])[None],
            np.linspace(0.0, 2 * np.pi, 72, endpoint=False),
        )[0][0]
        column, line = np.rint(points).astype(int).T
        on = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        depth = frame.depth_m[line.clip(0, height - 1), column.clip(0, width - 1)]
        rays = (
            np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(frame.camera_matrix).T
        )
        # Four standard deviations: of 72 points none is nearer by chance.
        # False where depth is unknown.
        nearer |= on & (1.0 / depth - rays @ face.m > 4 * face.sigma)
    return float(nearer.mean())
