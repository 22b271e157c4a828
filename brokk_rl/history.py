"""Memory of actuator models and policies: the last `H` commands and positions.

Worked trace (H = 3), one control step at time t:

    observe   q = [q(t-2), q(t-1), q(t)]     u = [u(t-3), u(t-2), u(t-1)]
    push_u    q = [q(t-2), q(t-1), q(t)]     u = [u(t-2), u(t-1), u(t)]     actuator input
    push_q    q = [q(t-1), q(t), q(t+1)]     u = [u(t-2), u(t-1), u(t)]     next observation

After `push_u` the rows pair up as in a recording.

"""

from dataclasses import dataclass
from typing import Any


@dataclass
class History:
    """Ring of the last `H` samples, oldest first, kept in order so that reading costs nothing.

    Attributes:
        q: Joint positions, shape `(N, H, J)`, rad or m.
        u: Commands in force, shape `(N, H, J)`, in [-1, 1].

    Works on torch tensors; every update is in place, so that a captured CUDA graph keeps its
    addresses.
    """

    q: Any
    u: Any

    def push_u(self, u: Any) -> None:
        """Append the commands in force from now on, shape `(N, J)`."""
        self.u.copy_(self.u.roll(-1, 1))
        self.u[:, -1] = u

    def push_q(self, q: Any) -> None:
        """Append newly measured positions, shape `(N, J)`."""
        self.q.copy_(self.q.roll(-1, 1))
        self.q[:, -1] = q

    def reset(self, mask: Any, q: Any, u: Any = None) -> None:
        """Put environments at rest, without commands, over the whole history.

        Args:
            mask: Environments, shape `(N,)` bool.
            q: Positions, shape `(N, J)`.
            u: Commands under which they rest, shape `(N, J)`; `None` for 0. Joints that are
                commanded by position rest at a target.
        """
        rows = mask[:, None, None]
        self.q.copy_(q[:, None, :].where(rows, self.q))
        if u is None:
            self.u.masked_fill_(rows, 0.0)
        else:
            self.u.copy_(u[:, None, :].where(rows, self.u))
