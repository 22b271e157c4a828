"""The link to the machine's valves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    from brokk_rl.machine import Machine
    from brokk_rl.session import Session
    from brokk_rl.signals import Command, JointState


@runtime_checkable
class Link(Protocol):
    """The open connection to a machine, real or simulated; a context manager.

    Arrays are `(J,)`, or `(N, J)` where a simulated link drives `N > 1` machines side by side.
    Leaving the context brings the machine to a standstill. A link may have `extra() -> dict[str,
    float | array (N,)]`: more columns of the recording (`oil_c`).
    """

    def read(self) -> JointState:
        """Return the newest measured state; its `t_s` is the clock of the control periods."""
        ...

    def send(self, command: Command) -> Command:
        """Send a command and returns the command that was really sent."""
        ...

    def __enter__(self) -> Link: ...

    def __exit__(self, *exc: Any) -> None: ...


class Connection(Protocol):
    """A spec in `conf/link`: how to reach a machine."""

    @property
    def source(self) -> str:
        """Source that recordings name."""
        ...

    def build(self, machine: Machine, num_runs: int, session: Session) -> Link:
        """Return a link, not yet opened, to `num_runs` machines side by side.

        Its random numbers come from the session's streams.

        Raises:
            ConfigError: there are not as many machines.
        """
        ...
