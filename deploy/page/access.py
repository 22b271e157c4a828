"""Access rules of the page's server: pure functions, no I/O.

Any browser on a page of this server may watch. A request needs the token and, except for `stop`,
the dead-man: `stop` only ends a motion, as the dead-man does. A page of another origin cannot
connect (a stranger's site in the same browser), nor can a host name that is not this server's (DNS
rebinding).
"""

from __future__ import annotations

import hmac
import json
import re
from typing import Literal

from deploy.page.protocol import REQUEST_KINDS, OperatorRequest, PageState

RefusalReason = Literal[
    "token", "malformed", "deadman", "target", "nowhere", "busy", "unconfirmed", "replay", "live"
]
"""Why a request was refused: wrong token; no such request; the dead-man is not held; no such
target; nothing is measured where the person points; the loop does not take it; the guard does not
confirm the stop; a recording takes no requests to a machine; a machine none to a recording."""
LOCAL = ("localhost", "127.0.0.1", "[::1]")
ANY_ADDRESS = ("0.0.0.0", "::")
POINT = re.compile(r"0?\.\d{1,6},0?\.\d{1,6}")
"""A point of the picture: parts of its width and height, at neither edge."""
SECONDS = re.compile(r"\d{1,6}(\.\d{1,3})?")
SPEEDS = ("off", "0.25", "1", "4", "16")
"""Speeds of a recording that is played, over real time."""
LONGEST = 256
"""Bytes of a request. Chosen by hand: the page's own are below 100."""


def list_own_names(host: str, others: tuple[str, ...]) -> frozenset[str]:
    """Return the names in the `Host` header that are this server's."""
    every = {host, *others}
    if host in (*LOCAL, *ANY_ADDRESS):
        every |= set(LOCAL)
    return frozenset(every)


def is_own_host(host: str | None, mine: frozenset[str]) -> bool:
    """Return whether a `Host` header names this server.

    Its port may be any: behind a forwarded port (`ssh -L`) it is another one. Rebinding changes the
    name, not the port.
    """
    if host is None:
        return False
    name, _, port = host.rpartition(":")
    return host in mine or (name in mine and port.isdecimal())


def is_same_origin(origin: str | None, host: str | None, mine: frozenset[str]) -> bool:
    """Return whether a connection comes from a page of this server.

    A program that sends no `Origin` is no browser, and may watch.
    """
    return is_own_host(host, mine) and (origin is None or origin == f"http://{host}")


def compare_tokens(given: object, token: str) -> bool:
    """Compare tokens in a time that does not depend on where they differ."""
    return isinstance(given, str) and hmac.compare_digest(
        given.encode(errors="replace"), token.encode()
    )


def parse_request(text: str | bytes) -> OperatorRequest | None:
    """Return the request that a message holds, `None` where it holds none."""
    try:
        found = json.loads(text) if len(text) <= LONGEST else None
    except ValueError:
        return None
    if not isinstance(found, dict) or set(found) != {"kind", "value"}:
        return None
    kind, value = found["kind"], found["value"]
    if kind not in REQUEST_KINDS or not isinstance(value, str):
        return None
    fits = {
        "record": value in ("on", "off"),
        "target": bool(value),
        "point": bool(POINT.fullmatch(value)),
        "seek": bool(SECONDS.fullmatch(value)),
        "play": value in SPEEDS,
    }.get(kind, value == "")
    return OperatorRequest(kind, value) if fits else None


def find_refusal(request: OperatorRequest, state: PageState) -> RefusalReason | None:
    """Return why a request must not be passed on now, `None` where it may."""
    if (request.kind in ("seek", "play")) != (state.replay is not None):
        return "live" if state.replay is None else "replay"
    if request.kind in ("stop", "present", "seek", "play"):
        return None
    if not state.deadman:
        return "deadman"
    if request.kind == "target" and request.value not in {one.name for one in state.targets}:
        return "target"
    return None
