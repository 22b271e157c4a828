"""Guards of a collection: bounds that no program can exceed. They do not replace the machine's own guard."""

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Guards:
    """What commands may do at most.

    Attributes:
        max_command: Largest command.
        max_tool_speed_m_s: Largest speed of the tool point, predicted from the machine's nominal
            speeds; commands that would
            exceed it are scaled down together. `null`: no bound. Needs a machine whose geometry is
                known.
    """

    max_command: float
    max_tool_speed_m_s: float | None

    def check(self) -> None:
        if not 0 < self.max_command <= 1:
            raise ConfigError(
                f"collect.guards.max_command: expected (0, 1], got {self.max_command}"
            )
        if self.max_tool_speed_m_s is not None and self.max_tool_speed_m_s <= 0:
            raise ConfigError(
                f"collect.guards.max_tool_speed_m_s: expected more than 0 or null, got {self.max_tool_speed_m_s}"
            )


class ToolSpeed:
    """Speed of the tool point; needs torch, as all kinematics does.

    Raises:
        ConfigError: the machine's geometry is not known, or torch is not installed.
    """

    def __init__(self, machine: Machine) -> None:
        if not machine.has_bodies:
            raise ConfigError(
                f"collect.guards.max_tool_speed_m_s: the geometry of machine '{machine.name}' is not known; give null, or bodies "
                "and tool_m in its file"
            )
        try:
            import torch

            from brokk_rl.kinematics import Kinematics
        except ImportError as error:
            raise ConfigError(
                "collect.guards.max_tool_speed_m_s: needs torch, which is not installed; give null, or a max_command"
            ) from error
        self._kinematics, self._tensor = Kinematics(machine), torch.as_tensor

    def of(self, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Returns the speed of the tool point in m/s, `(N,)`, for joints at `q` that move with `speed`, each `(N, J)`."""
        tip = self._kinematics.jacobian(self._tensor(q.astype(np.float32))).tip.numpy()
        return np.linalg.norm((tip @ speed[..., None])[..., 0], axis=-1)


def predicted_tool_speed(machine: Machine, q: np.ndarray) -> np.ndarray | None:
    """Returns the speed of the tool point in m/s along a path `q`, `(T, J)`: `(T,)`; `None` where geometry or torch are missing."""
    if not machine.has_bodies:
        return None
    try:
        import torch

        from brokk_rl.kinematics import Kinematics
    except ImportError:
        return None
    tip_m = Kinematics(machine).pose(torch.as_tensor(q.astype(np.float32))).tip_in_base_m.numpy()
    return np.linalg.norm(np.gradient(tip_m, axis=0), axis=-1) / machine.period_s
