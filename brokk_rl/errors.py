"""The errors that a person can act on.

Every message says what was expected, what came, and where to change it. Anything that is not a
`BrokkError` is our own bug and keeps its traceback.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class BrokkError(Exception):
    """Something the user can mend; the command prints the message without a traceback."""


class ConfigError(BrokkError):
    """A value in the configuration does not make sense."""


class DeviceError(BrokkError):
    """A device was asked for that is not there or cannot do the work."""


class RecordingError(BrokkError):
    """A recording cannot be used; names file, row and column."""


class FrameError(BrokkError):
    """A camera frame cannot be used; names the file or the camera, and what is wrong with it."""


class CheckpointError(BrokkError):
    """A checkpoint or policy bundle is missing, corrupt, or made for another machine."""


class SimulationError(BrokkError):
    """The simulation lost too many worlds to divergence or overflow."""


class DistributedError(BrokkError):
    """Processes that train together lost each other, or no longer hold the same policy."""


class LinkError(BrokkError):
    """The link to a machine fell silent or said something that makes no sense."""


class StorageError(BrokkError):
    """A file could not be written; nothing half-written is left behind."""


def list_choices(name: str, known: Iterable[str]) -> str:
    """Returns the tail of a message about an unknown name: the nearest choices first, then all of them."""
    names = sorted(known)
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"{hint}choices: {', '.join(names) or 'none'}"
