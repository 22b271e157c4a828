"""Choices of what is taken of a URDF or MJCF."""

from __future__ import annotations

from typing import Literal

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


@spec
class ModelChoices:
    """Choices of what is taken of a model file.

    Attributes:
        chain: Last joint or link of the arm, or its first and last; `None` for the longest chain.
        tip: Site or link of the tool point; `None`: a frame named so, else the far end.
        gripper: Whether the first joint of the gripper is the last one of the machine.
        drive: What moves the joints; `auto` reads it off the model.
        command: Quantity that commands set; `auto`: that of the model's actuators.
        packages: Folders in which meshes of `package://…` are searched first.
    """

    chain: str | tuple[str, ...] | None
    tip: str | None
    gripper: bool
    drive: Literal["auto", "electric", "hydraulic"]
    command: Literal["auto", "valve", "velocity", "position", "torque"]
    packages: tuple[str, ...]

    @property
    def chain_names(self) -> tuple[str, ...]:
        """Ends of `chain`; none for the longest."""
        return (self.chain,) if isinstance(self.chain, str) else self.chain or ()

    def check(self) -> None:
        if len(self.chain_names) > 2:
            raise ConfigError(
                f"chain: expected the last joint or link, or [first, last], got {len(self.chain_names)} names"
            )
