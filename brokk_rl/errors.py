"""Errors that the user can act on.

Each message names the expected value, the given value, and the place to change it. Any other
exception is a defect of this package and keeps its traceback.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches


class BrokkError(Exception):
    """Base of errors that the user can correct; the command prints them without a traceback."""


class ConfigError(BrokkError):
    """A value of the configuration is invalid."""


class DeviceError(BrokkError):
    """The requested device is missing or cannot run the job."""


class RecordingError(BrokkError):
    """A recording is invalid; the message names file, row and column."""


class FrameError(BrokkError):
    """A camera frame is invalid; the message names the file or camera and the defect."""


class CheckpointError(BrokkError):
    """A checkpoint or policy bundle is missing, corrupt, or made for another machine."""


class SimulationError(BrokkError):
    """The simulation lost too many worlds to divergence or overflow."""


class TrainingError(BrokkError):
    """A loss, a gradient or a weight of a training is not finite; its checkpoints are whole."""


class DistributedError(BrokkError):
    """Processes of one training lost contact, or their policies differ."""


class LinkError(BrokkError):
    """The link to a machine is silent, or sent an invalid message."""


class StorageError(BrokkError):
    """A file could not be written; no partial file remains."""


MAX_CHOICES = 60
"""More names than this hide the nearest one; they are listed only where none is near."""


def list_choices(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the nearest choice, then all choices."""
    names = sorted(known)
    near = get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    if near and len(names) > MAX_CHOICES:
        return hint.rstrip()
    return f"{hint}choices: {', '.join(names) or 'none'}"


def group_by_reason(reasons: Mapping[str, str]) -> str:
    """Return names and their reasons in one line: `a, b (reason); c (another)`."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return "; ".join(f"{', '.join(group)} ({reason})" for reason, group in names.items())
