"""Who may ask the page's server for what: pure rules, no I/O.

Watching is free for browsers of this page. Whoever wants something done shows the token first, and
is refused without the dead-man,
except for `stop`: it can only end what a dead-man is there for. A page of another origin cannot
connect (a stranger's site in the same browser), nor can a name that is not this server's (DNS
rebinding).
"""

from __future__ import annotations

import hmac
import json
import re
from typing import Literal

from deploy.page.protocol import REQUEST_KINDS, OperatorRequest, PageState

RefusalReason = Literal["token", "malformed", "deadman", "target", "nowhere", "busy"]
"""Why a wish was refused: wrong token; no such wish; the dead-man is not held; no such target;
nothing is measured where the person points; the loop does not take it."""
LOCAL = ("localhost", "127.0.0.1", "[::1]")
POINT = re.compile(r"0?\.\d{1,6},0?\.\d{1,6}")
"""A place in the picture: parts of its width and height, at neither edge."""
LONGEST = 256
"""Bytes of a wish."""


def list_own_hosts(host: str, port: int, others: tuple[str, ...]) -> frozenset[str]:
    """Returns the values of the `Host` header that are this server's."""
    every = {host, *others, *(LOCAL if host in (*LOCAL, "0.0.0.0", "::") else ())}
    return frozenset(f"{name}:{port}" for name in every)


def is_same_origin(origin: str | None, host: str | None, mine: frozenset[str]) -> bool:
    """Says whether a connection comes from a page of this server; programs that send no `Origin` are no browser, and may watch."""
    return host in mine and (origin is None or origin == f"http://{host}")


def matches_token(given: object, token: str) -> bool:
    """Compares in a time that says nothing about where they differ."""
    return isinstance(given, str) and hmac.compare_digest(given.encode(), token.encode())


def parse_request(text: str | bytes) -> OperatorRequest | None:
    """Returns the wish that a message holds, `None` where it holds none."""
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
    }.get(kind, value == "")
    return OperatorRequest(kind, value) if fits else None


def find_refusal(wish: OperatorRequest, shown: PageState) -> RefusalReason | None:
    """Returns why a wish must not be handed on now, `None` where it may."""
    if wish.kind == "stop":
        return None
    if not shown.deadman:
        return "deadman"
    if wish.kind == "target" and wish.value not in {target.name for target in shown.targets}:
        return "target"
    return None
