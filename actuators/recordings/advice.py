"""Advice of messages about logs: the key that reads a log, written as it is typed.

A test follows each entry: with the key the same log is read, or refused for another reason.
"""

from __future__ import annotations

ADVICE = {
    "damaged": "log.damaged=skip, or damaged: skip in the column map, reads what is whole",
    "rate": "log.rate_hz={rate_hz:g} takes the rows as equally spaced",
    "time": "if it is the time, give 'log.time=[{columns}]'; two columns are seconds and nanoseconds",
    "joints": "name the columns of each joint: 'log.joints={{{joints}}}'",
    "channel": "choose one: log.channel={channel}",
    "offset": "if they began together, give 'log.clock_offset_s={{{table}: {offset_s:.12g}}}'",
    "dbc": "log.dbc=<file>, or a column map that names it",
    "wraps": "log.wraps={modulus:g} unwraps it, a negative number reads that sign bit, log.wraps=0 takes it as it is",
    "unit": "give it, log.position_unit=deg, mm or, for a count of an encoder, '0.00153 rad'",
    "command": "give it, log.command=velocity, position or torque",
}
"""Texts by the key that they advise; numbers and names are filled in."""


def advise(key: str, **values: object) -> str:
    """Return the advice of a key with its values."""
    return ADVICE[key].format(**values)


def format_joints(pairs: dict[str, tuple[str, str]]) -> str:
    """Return joints with their columns as `log.joints` takes them, without the outer braces."""
    return ", ".join(f'{joint}: ["{u}", "{q}"]' for joint, (u, q) in pairs.items())
