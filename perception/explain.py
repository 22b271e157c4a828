"""Refusals in words."""

from __future__ import annotations

import math

from brokk_rl.contracts.vision import Rejection

WORDS = {
    "part of the picture that is block": (
        "too little of the picture is block",
        "Is the block in sight, the segmenter the right one?",
    ),
    "ellipses of a possible size on the block": (
        "nothing on the block looks like a rim of the right size",
        "",
    ),
    "pixels of the face with depth": (
        "the face around it has hardly any depth",
        "Too dark, too near, or no texture to match.",
    ),
    "depth noise on the face, 1/m": (
        "the face around it is no plane",
        "Is it on the block's edge, or is the depth that noisy?",
    ),
    "tilt of the face, rad": (
        "the camera sees the face at too flat an angle",
        "Another place for the camera would see it better.",
    ),
    "axis ratio on the face": ("on the face it is no circle", "A shadow, a stain, or an edge."),
    "part of a circle on the face with a rim": (
        "too little of a rim is seen",
        "What hides it? Another place would see it better.",
    ),
    "radius, m": (
        "on the face it does not have the size of a hole",
        "Look at perception.pose.estimator.radius_m if the holes are of another size.",
    ),
    "brightness inside over outside": (
        "it is not dark inside",
        "A ring, a filled hole, or a lamp in it.",
    ),
    "contrast to the grain of the face": (
        "it is hardly darker than the spots of the face",
        "A stain or a shadow.",
    ),
    "mouth probability inside": (
        "the network does not take it for the mouth of a hole",
        "A flat dark disc looks like this.",
    ),
    "evidence of depth inside": (
        "it is evenly dark, and as deep as the face",
        "A flat dark disc looks like this.",
    ),
    "distance to a larger rim, m": (
        "it lies within a larger rim",
        "The far rim or the floor of a hole.",
    ),
    "known depth at the centre": (
        "the depth at its centre is unknown",
        "The interior of a hole is; perception=plane_conic needs none.",
    ),
    "local normals around the rim": ("there is too little depth around it for normals", ""),
    "angle between local normals, rad": ("the normals around it do not agree", ""),
    "known pose of the camera": ("nobody knows where the camera is", "Run mode=calibrate."),
    "angle to the expected normal, rad": (
        "seen as a circle, its face looks elsewhere than expected",
        "",
    ),
}


def words(rejection: Rejection) -> str:
    """Returns a sentence with what was refused, the figure and its limit, and what could be done."""
    place = rejection.ellipse
    where = (
        "the frame"
        if place is None
        else f"the ellipse at ({place.x:.0f}, {place.y:.0f}), {place.a:.0f} x {place.b:.0f} px"
    )
    reason, advice = WORDS.get(rejection.reason, ("it was refused", ""))
    figure = "unknown" if math.isnan(rejection.value) else f"{rejection.value:.4g}"
    return f"{where}: {reason} ({rejection.reason}: {figure}, limit {rejection.limit:.4g}). {advice}".rstrip()
