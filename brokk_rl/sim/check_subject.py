"""Subject of a check: which machine, and what is taken of a URDF or MJCF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval, MaxLen
from pydantic import StringConstraints

from brokk_rl.errors import ConfigError
from brokk_rl.plain_files import parse_model
from brokk_rl.spec import WorldCount, spec


@spec
class CheckSubject:
    """Subject and size of a check.

    Attributes:
        model: URDF or MJCF of a new machine; `None` checks `machine=…`.
        name: Name of the new machine; `None`: that of its file.
        chain: Last joint or link of the arm, or its first and last; `None` for the longest chain.
        tip: Site or link of the tool point; `None`: a frame named so, else the far end.
        drive: What moves the joints; `auto` reads it off the model.
        command: Quantity that commands set; `auto`: that of the model's actuators.
        packages: Folders in which meshes of `package://…` are searched first.
        num_poses: Random poses from which the reach is read.
        num_starts: Starts of the task that are drawn, and worlds that are simulated.
    """

    model: str | None
    name: Annotated[str, StringConstraints(pattern=r"^\w+$")] | None
    chain: Annotated[tuple[str, ...], MaxLen(2)] | str | None
    tip: str | None
    drive: Literal["auto", "electric", "hydraulic"]
    command: Literal["auto", "valve", "velocity", "position", "torque"]
    packages: tuple[str, ...]
    num_poses: Annotated[int, Interval(ge=1, le=10**7)]
    num_starts: WorldCount

    @property
    def chain_names(self) -> tuple[str, ...]:
        """Ends of `chain`; none for the longest."""
        return (self.chain,) if isinstance(self.chain, str) else self.chain or ()

    def check(self) -> None:
        if self.model is not None:
            parse_model(Path(self.model))
        if self.model is None and (self.chain or self.tip or self.name):
            raise ConfigError("model: expected the file of a robot beside name, chain and tip")
