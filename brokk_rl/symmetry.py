"""Left-right symmetry of a machine: joints, observations and actions seen in a mirror.

The mirror is the plane of x and z: y changes its sign, and with it every joint that turns the arm
to the side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDict

TOLERANCE = 1e-6
"""Up to which lengths (m) and angles (rad) of both sides are alike: rounding of a YAML's numbers."""


@dataclass(frozen=True)
class Mirror:
    """Mirror of observations and actions: a factor and a shift for each number.

    Attributes:
        groups: By observation group factor and shift, `(O,)` each: `mirrored = factor * x + shift`.
        action: Factors of the action, `(A,)`.
    """

    groups: Mapping[str, tuple[torch.Tensor, torch.Tensor]]
    action: torch.Tensor

    def apply(self, group: str, values: torch.Tensor) -> torch.Tensor:
        """Return the values of a group, `(…, O)`, as the mirrored machine observes them."""
        factor, shift = self.groups[group]
        return values * factor + shift

    def augment(
        self, env: object, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Return steps and then their mirror images, as rsl-rl's `data_augmentation_func` does."""
        import torch

        if obs is not None:
            mirrored: Any = obs.clone()
            for name, value in list(mirrored.items()):
                mirrored[name] = self.apply(name, value)
            obs = cast("TensorDict", torch.cat((obs, mirrored)))
        if actions is not None:
            actions = torch.cat((actions, actions * self.action))
        return obs, actions


def compute_joint_signs(machine: Machine) -> np.ndarray:
    """Return -1 for each joint that moves to the other side in the mirror, else 1, `(J,)`.

    Raises:
        ConfigError: The machine is not left-right symmetric, or its links are not known.
    """
    signs = []
    for joint, body in zip(machine.joints, machine.bodies, strict=True):
        x, y, z = body.axis
        is_level, is_across = np.hypot(x, z) < TOLERANCE, abs(y) < TOLERANCE
        if not (is_level or is_across):
            _refuse(machine, f"the axis of {joint.name} is oblique, {body.axis}")
        for name, across_m in (("origin_m", body.origin_m[1].value), ("com_m", body.com_m[1])):
            if abs(across_m) > TOLERANCE:
                _refuse(machine, f"{name} of {joint.name} lies {across_m:g} m off the plane")
        # a turn about y stays in the mirror; a slide along y does not
        sign = 1.0 if is_level == (joint.kind == "hinge") else -1.0
        if sign < 0 and abs(joint.lower.value + joint.upper.value) > TOLERANCE:
            ends = f"[{joint.lower.value:g}, {joint.upper.value:g}]"
            _refuse(machine, f"the travel of {joint.name}, {ends}, differs on both sides")
        signs.append(sign)
    if abs(float(machine.tip_m[1])) > TOLERANCE:
        _refuse(machine, f"the tool point lies {machine.tip_m[1]:g} m off the plane")
    return np.array(signs, np.float32)


def _refuse(machine: Machine, reason: str) -> None:
    raise ConfigError(
        f"rl.symmetry: machine {machine.name} is not left-right symmetric: {reason}; give "
        "rl.symmetry=false"
    )
