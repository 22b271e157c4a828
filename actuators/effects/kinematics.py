"""Effects on geometry: link lengths, base tilt and camera pose that differ from the drawings."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import ANY_INTERFACE, EffectSpec
from actuators.effects.ranges import EffectNumber
from actuators.models.machine_tensors import MachineTensors
from brokk_rl.spec import spec


def _describe_angle(typical_rad: float) -> EffectNumber:
    return EffectNumber("rad", none=0.0, typical=typical_rad, bounds=(-0.3, 0.3), per_joint=False)


def _describe_shift(typical_m: float) -> EffectNumber:
    return EffectNumber(
        "m", none=0.0, typical=typical_m, bounds=(-0.5, 0.5), per_joint=False, scale="reach"
    )


class GeometryEffect(EffectSpec):
    """An effect on where the tool is, or where the camera sees a point."""

    side = "kinematics"
    stage = "kinematics"
    interfaces = ANY_INTERFACE


@spec
class LinkLength(GeometryEffect):
    """Links are longer or shorter than drawn.

    Attributes:
        joints: Joints whose links differ, or `all`.
        extra_m: How much farther than drawn the next joint, or the tool's tip, lies from this
            joint.
    """

    numbers: ClassVar = {
        "extra_m": EffectNumber("m", none=0.0, typical=0.01, bounds=(-0.3, 0.3), scale="reach")
    }

    def tool(
        self,
        point_m: torch.Tensor,
        q: torch.Tensor,
        value: dict[str, torch.Tensor],
        plant: MachineTensors,
    ) -> torch.Tensor:
        """Move the point along each link by the link's excess length."""
        pose = plant.kinematics.pose(q)
        ends = torch.cat((pose.joints_in_base_m, pose.tip_in_base_m[:, None]), 1)
        links = ends[:, 1:] - ends[:, :-1]
        along = links / links.norm(dim=2, keepdim=True).clamp(min=1e-9)
        return point_m + (value["extra_m"][..., None] * along).sum(1)


@spec
class BaseTilt(GeometryEffect):
    """The machine does not stand level, as instruments and site drawings do.

    Camera and arm tilt together: the controller does not notice, outside instruments do. The weight
    is not turned with the machine.

    Attributes:
        roll_rad: Turn about x, forward; positive lifts the left side.
        pitch_rad: Turn about y, to the left; positive lowers the front.
    """

    numbers: ClassVar = {"roll_rad": _describe_angle(0.03), "pitch_rad": _describe_angle(0.03)}

    def tool(
        self,
        point_m: torch.Tensor,
        q: torch.Tensor,
        value: dict[str, torch.Tensor],
        plant: MachineTensors,
    ) -> torch.Tensor:
        """Turn the point with the base."""
        roll_rad, pitch_rad = value["roll_rad"], value["pitch_rad"]
        return rotate_points(point_m, roll_rad, pitch_rad, torch.zeros_like(roll_rad))

    def target(self, point_m: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Turn it back: the camera stands on the base."""
        none = torch.zeros_like(value["roll_rad"])
        levelled_m = rotate_points(point_m, none, -value["pitch_rad"], none)
        return rotate_points(levelled_m, -value["roll_rad"], none, none)


@spec
class Extrinsics(GeometryEffect):
    """The camera pose is wrong: seen points are rotated about the base and displaced.

    Attributes:
        x_m: Displacement of seen points, forward.
        y_m: To the left.
        z_m: Up.
        roll_rad: Rotation of seen points about x.
        pitch_rad: About y.
        yaw_rad: About z.
    """

    stage = "perception"
    numbers: ClassVar = {name: _describe_shift(0.02) for name in ("x_m", "y_m", "z_m")} | {
        name: _describe_angle(0.01) for name in ("roll_rad", "pitch_rad", "yaw_rad")
    }

    def target(self, point_m: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
        """Turn the point about the base and displaces it."""
        shift_m = torch.cat((value["x_m"], value["y_m"], value["z_m"]), 1)
        angles_rad = (value[name] for name in ("roll_rad", "pitch_rad", "yaw_rad"))
        return rotate_points(point_m, *angles_rad) + shift_m


def rotate_points(
    point_m: torch.Tensor, roll_rad: torch.Tensor, pitch_rad: torch.Tensor, yaw_rad: torch.Tensor
) -> torch.Tensor:
    """Return points `(N, 3)` rotated about fixed x, then y, then z, by angles `(N, 1)`.

    Exact for angles of zero.
    """
    x, y, z = point_m.split(1, 1)
    y, z = _rotate_plane(y, z, roll_rad)
    z, x = _rotate_plane(z, x, pitch_rad)
    x, y = _rotate_plane(x, y, yaw_rad)
    return torch.cat((x, y, z), 1)


def _rotate_plane(
    a: torch.Tensor, b: torch.Tensor, angle_rad: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    cos, sin = torch.cos(angle_rad), torch.sin(angle_rad)
    return cos * a - sin * b, sin * a + cos * b
