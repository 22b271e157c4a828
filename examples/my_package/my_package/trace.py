"""A task: follow a line at constant speed, as a tool does that cleans a wall."""

from brokk_rl.spec import spec
from tasks.term_task import TermTask


@spec
class Trace(TermTask):
    """Follow a line; all of its particulars are terms."""


def position_error(state):
    """Return how far the tool is from where it should be now, (N, 3), m."""
    way_m = state.time_s[:, None] * state.start["velocity_m_s"]
    return state.tip_m - (state.start["tip_m"] + way_m)


def closeness(state, scale_m: float):
    """Return 1 on the line, and 1/e at a distance of `scale_m`, (N,)."""
    return (-position_error(state).norm(dim=1) / scale_m).exp()


def is_on_line(state, tolerance_m: float):
    """Return where the tool is near its place, (N,) bool."""
    return position_error(state).norm(dim=1) < tolerance_m


def has_strayed(state, largest_m: float):
    """Return where the tool is farther from its place, (N,) bool."""
    return position_error(state).norm(dim=1) > largest_m
