"""Mistakes of deployment code: one table of distortions, each put at its places on the way from log to valve.

A distortion is a kind (order, sign, scale, frame, rate, delay, stale, clip, default_pose, filter, network), a
function that spoils values, and at most one number. `diagnosis.deployment.replay` names the places and runs a
policy with it.
Axes: `T` rows, `R` rows that are asked for, `H` samples (oldest first), `C` columns, `J` joints.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm, PolicyContract
from diagnosis.deployment.orders import Order, invert_order, list_orders, match_order
from diagnosis.deployment.replay import Change

POINTS = ("log", "signal", "scaled", "vector", "network", "answer", "command")
"""Points of the way, by the first word of their name; a log begins it."""
Spoil = Callable[[np.ndarray, float], np.ndarray]
"""Makes wrong values of right ones by a number."""


@dataclass(frozen=True)
class Distortion:
    """A mistake: a row of the table, and where the code makes it.

    Attributes:
        kind: Kind of mistake.
        text: The mistake in words; `{field}` stands for the field, `{value}` for the number.
        spoil: Makes wrong values of right ones.
        values: Numbers to try; one of no meaning where there is no number. None: rows from shortly before the
            first departure on.
        parameter: Name of the number, with its unit; empty where it is not told.
        is_continuous: The number is refined between those of `values`.
        field: Where it acts, in words: `q.q3`, `u`, `target.y`, `command.q2`, `observation`.
        changes: What it spoils, by point of the way (`diagnosis.deployment.replay`).
    """

    kind: str
    text: str
    spoil: Spoil
    values: tuple[float, ...] = (0.0,)
    parameter: str = ""
    is_continuous: bool = False
    field: str = ""
    changes: Mapping[str, Spoil] = dataclasses.field(default_factory=dict)

    def put(self, field: str, *points: str, columns: Sequence[int] = ()) -> Distortion:
        """Return the mistake at some points of the way, on some of their columns; none: on all."""
        spoil = (
            partial(change_columns, spoil=self.spoil, columns=columns) if columns else self.spoil
        )
        text = self.text.replace("{field}", field)
        return replace(self, text=text, field=field, changes=dict.fromkeys(points, spoil))

    def acts_between(self, begin: str, end: str) -> bool:
        """Return whether it acts behind one point of the way, and at another one or before."""
        first = min(POINTS.index(point.split()[0]) for point in self.changes)
        return POINTS.index(begin) < first <= POINTS.index(end)

    def build(self, number: float) -> Change:
        """Return the change of the replay with this number."""
        changes = {}
        for point, spoil in self.changes.items():
            changes[point] = lambda values, spoil=spoil: spoil(values, number)
        return changes


def change_columns(
    values: np.ndarray, number: float, spoil: Spoil, columns: Sequence[int]
) -> np.ndarray:
    """Return values with wrong ones in some columns."""
    changed = values.copy()
    changed[..., columns] = spoil(values[..., columns], number)
    return changed


def permute(values: np.ndarray, number: float, order: Order) -> np.ndarray:
    """Return right values in another order of columns."""
    return values[..., list(order)]


def scale(values: np.ndarray, factor: float) -> np.ndarray:
    """Return values times a factor."""
    return factor * values


def shift(values: np.ndarray, offset: float) -> np.ndarray:
    """Return values with an offset."""
    return values + offset


def shift_command(values: np.ndarray, offset: float) -> np.ndarray:
    """Return commands with an offset, within full command."""
    return (values + offset).clip(-1.0, 1.0)


def clip(values: np.ndarray, bound: float) -> np.ndarray:
    """Return values clipped at plus and minus a bound."""
    return values.clip(-bound, bound)


def delay(values: np.ndarray, periods: float) -> np.ndarray:
    """Return values that are whole rows late; the first row stands before. Fewer than 0: early."""
    return values[np.clip(np.arange(len(values)) - int(periods), 0, len(values) - 1)]


def freeze(values: np.ndarray, row: float) -> np.ndarray:
    """Return values that stay as they are from a row on."""
    return values[np.minimum(np.arange(len(values)), int(row))]


def hold(values: np.ndarray, phase: float, every: int) -> np.ndarray:
    """Return values that are refreshed only every few rows."""
    rows = np.arange(len(values))
    return values[np.maximum(rows - (rows - int(phase)) % every, 0)]


def smooth(values: np.ndarray, weight: float) -> np.ndarray:
    """Return values behind a first-order low-pass; `weight` is that of the newest value."""
    begin = (1.0 - weight) * values[:1]
    return lfilter([weight], [1.0, weight - 1.0], values, axis=0, zi=begin)[0]


def mirror(points: np.ndarray, number: float, axes: np.ndarray) -> np.ndarray:
    """Return points `(T, 3)` in a frame with other `axes`, `(3, 3)`."""
    return points @ axes.T


def turn(points: np.ndarray, angle_rad: float, axis: str) -> np.ndarray:
    """Return points `(T, 3)` turned about `x`, `y` or `z`."""
    return Rotation.from_euler(axis, angle_rad).apply(points)


def turn_round(window: np.ndarray, number: float) -> np.ndarray:
    """Return a history `(R, H, C)` with the newest sample first."""
    return window[:, ::-1]


def lay_out_by_joint(window: np.ndarray, number: float) -> np.ndarray:
    """Return a history `(R, H, C)` whose numbers stand joint by joint."""
    return window.transpose(0, 2, 1).reshape(window.shape)


def fill_early(window: np.ndarray, times: float) -> np.ndarray:
    """Return a history `(R, H, C)` into which each sample was put several times."""
    samples = window.shape[1]
    return window[:, samples - 1 - np.arange(samples)[::-1] // int(times)]


# Numbers at which a search begins were chosen by hand: it is refined between them.
MAX_DELAY = 12
"""Longest delay that is tried, rows; half a second at 20 Hz is more than a history's dead time."""
DELAYS = tuple(float(number) for number in range(1, MAX_DELAY + 1))
LEVELS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.5, 2.0, 3.0)
FACTORS = (-2.0, -0.5, 0.1, 0.25, 0.5, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0, 3.0, 10.0)
OFFSETS_STD = (-2.0, -1.0, -0.5, -0.2, -0.08, 0.08, 0.2, 0.5, 1.0, 2.0)
OFFSETS_COMMAND = (-0.3, -0.1, -0.03, 0.03, 0.1, 0.3)
SMOOTHING = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
DISTANCES_M = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
SHIFTS_M = (*(-distance for distance in DISTANCES_M[::-1]), *DISTANCES_M)
ANGLES_RAD = tuple(np.deg2rad([*range(-165, 0, 15), -4, 4, *range(15, 181, 15)]))

SIGN = Distortion("sign", "{field} has the wrong sign", scale, (-1.0,))
ON_COLUMNS = (
    SIGN,
    Distortion("scale", "{field} is multiplied by {value}", scale, FACTORS, "factor", True),
    Distortion("stale", "{field} is always zero", scale, (0.0,)),
)
ON_SIGNALS = (
    *ON_COLUMNS,
    Distortion("scale", "{field} is in degrees for radians", scale, (180.0 / np.pi,)),
    Distortion("scale", "{field} is in radians for degrees", scale, (np.pi / 180.0,)),
    Distortion("scale", "{field} is in thousandths for units", scale, (1000.0,)),
    Distortion("scale", "{field} is in units for thousandths", scale, (0.001,)),
    Distortion("scale", "{field} is in hundredths for units", scale, (100.0,)),
    Distortion("stale", "{field} is stale from row {value} on", freeze, (), "row"),
)  # fmt: skip
ON_COMMANDS = (
    *ON_COLUMNS,
    Distortion("clip", "{field} is clipped at ±{value}", clip, LEVELS[:6], "bound", True),
    Distortion("default_pose", "{value} is added to {field}", shift_command, OFFSETS_COMMAND, "offset", True),
)  # fmt: skip
CLIPPED = Distortion(
    "clip", "{field} is clipped at ±{value} after scaling", clip, LEVELS, "bound", True
)
ON_SCALED = (Distortion("stale", "{field} is missing: zero after scaling", scale, (0.0,)), CLIPPED)
OFFSET = Distortion(
    "default_pose", "{value} standard deviations are added to {field}", shift, OFFSETS_STD, "offset_std", True
)  # fmt: skip
EARLY = Distortion("delay", "{field} is a period too new", delay, (-1.0,))
LATE = Distortion("delay", "{field} is {value} periods old", delay, DELAYS, "periods")
HELD = tuple(
    Distortion("rate", f"{{field}} is refreshed every {every} periods only", partial(hold, every=every),
               tuple(float(phase) for phase in range(every)))
    for every in range(2, 6)
)  # fmt: skip
FILTERED = Distortion(
    "filter", "{field} is low-pass filtered, newest weighs {value}", smooth, SMOOTHING, "weight", True
)  # fmt: skip
ON_ROWS = (LATE, *HELD, FILTERED)
ON_HISTORIES = (
    Distortion("order", "the history of {field} has the newest sample first", turn_round),
    Distortion("order", "{field} is laid out joint by joint, not sample by sample", lay_out_by_joint),
    Distortion("rate", "the history of {field} is filled {value} times a period", fill_early, (2.0, 3.0)),
)  # fmt: skip
ALL_FILLED = Distortion(
    "rate", "the history is filled {value} times a period: the loop runs at {value} times its rate", fill_early, (2.0, 3.0)
)  # fmt: skip
ALL_LATE = replace(LATE, text="the whole {field} is {value} periods old")
ALL_CLIPPED = replace(CLIPPED, text="the {field} is clipped at ±{value}")


def spread(
    rows: Sequence[Distortion], field: str, names: Sequence[str], *points: str
) -> Iterator[Distortion]:
    """Yield each row on all columns of points together, then on each column, whose name joins the field."""
    for row in rows:
        yield row.put(field, *points)
    for column, name in enumerate(names if len(names) > 1 else ()):
        for row in rows:
            yield row.put(f"{field}.{name}", *points, columns=[column])


def list_distortions(policy: LoadedPolicy, others: Mapping[str, LoadedPolicy]) -> list[Distortion]:
    """Return the mistakes that are known, but for orders that only a log tells.

    Args:
        policy: The policy.
        others: Further policies that may have run instead, by folder.
    """
    found = list(_list_frame_mistakes(policy))
    for term in policy.contract.terms:
        found += _list_term_mistakes(term)
    found += _list_shared_mistakes(policy)
    found += _list_vector_mistakes(policy)
    for name, other in others.items():
        if other.contract.size == policy.contract.size:
            network = lambda vectors, _, other=other: other.network.answer(vectors)  # noqa: E731
            row = Distortion("network", f"the network is that of {name}", network)
            found.append(row.put("network", "network"))
    joints = policy.contract.joints
    found += [_make_command_order(joints, order) for order in list_orders(joints)]
    found += spread(ON_COMMANDS, "command", joints, "command")
    found += [row.put("command", "command") for row in ON_ROWS]
    return found


def _list_term_mistakes(term: ObservationTerm) -> Iterator[Distortion]:
    """Yield mistakes of one term."""
    name, names = term.name, name_columns(term)
    signal, scaled = f"signal {name}", f"scaled {name}"
    yield from spread(ON_SIGNALS, name, names, signal)
    yield from spread([OFFSET], name, names, scaled)
    for row in (*_list_normalisations(term.mean, term.std), *ON_SCALED):
        yield row.put(name, scaled)
    for row in ON_ROWS if term.newest >= 0 else (EARLY, *ON_ROWS):
        yield row.put(name, signal)
    if name != "target" and len(names) > 1:
        for order in list_orders(names):
            yield from _make_orders([term], names, order)
    if term.samples > 1:
        for row in ON_HISTORIES:
            yield row.put(name, scaled)


def _list_normalisations(mean: np.ndarray, std: np.ndarray) -> Iterator[Distortion]:
    """Yield missing steps of the normalisation; a step that is none explains nothing."""
    yield Distortion("scale", "{field} is not normalised", lambda x, _: x * std + mean)
    text = "the mean of {field} is not subtracted"
    yield Distortion("default_pose", text, lambda x, _: x + mean / std)
    text = "{field} is not divided by its standard deviation"
    yield Distortion("scale", text, lambda x, _: x * std)


def _make_orders(
    terms: Sequence[ObservationTerm], names: Sequence[str], order: Order, after: bool = False
) -> Iterator[Distortion]:
    """Yield the mistake that terms of the observation are in another order.

    The mean that is subtracted may be in that order too, or in the one of the contract.

    Args:
        terms: The terms.
        names: Names of their columns.
        order: The other order.
        after: Commands are taken to be in that order too.
    """
    words = [term.name for term in terms] + ["the commands"] * after
    listed = " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
    verb = "are" if len(words) > 1 else "is"
    text = f"{listed} {verb} in another order: {describe_order(names, order)}"
    row = Distortion("order", text, partial(permute, order=order))
    undone = {"answer": partial(permute, order=invert_order(order))} if after else {}
    field = "joints" if len(terms) > 1 else terms[0].name
    is_scaled = any(np.ptp(term.mean) > 0 or np.ptp(term.std) > 0 for term in terms)
    for point in ("signal", "scaled") if is_scaled else ("signal",):
        put = row.put(field, *(f"{point} {term.name}" for term in terms))
        yield replace(put, changes={**put.changes, **undone})


def list_matched_orders(
    contract: PolicyContract, point: str, known: np.ndarray, seen: np.ndarray
) -> list[Distortion]:
    """Return the orders in which the numbers at a point come out as they were logged, whatever they are.

    Args:
        contract: The policy's contract.
        point: `vector` or `command`.
        known: What the contract says, `(T, O)` or `(T, J)`.
        seen: What was logged.
    """
    if point == "command":
        order = match_order(known, seen)
        return [] if order is None else [_make_command_order(contract.joints, order)]
    found, shared = list[Distortion](), dict[Order, list[ObservationTerm]]()
    for term in contract.terms:
        if len(term.columns) < 2:
            continue
        end = contract.term_slices[term.name].stop
        newest, names = slice(end - len(term.columns), end), name_columns(term)
        by_scaled = match_order(known[:, newest], seen[:, newest])
        by_raw = match_order(*(one[:, newest] * term.std + term.mean for one in (known, seen)))
        for order in dict.fromkeys(one for one in (by_scaled, by_raw) if one is not None):
            found += _make_orders([term], names, order)
            if names == list(contract.joints):
                shared.setdefault(order, []).append(term)
    for order, terms in shared.items():
        if len(terms) > 1:
            found += _make_orders(terms, contract.joints, order)
    return found


def _list_shared_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield mistakes that several terms share."""
    terms, names = policy.contract.terms, list(policy.contract.joints)
    by_joint = [term for term in terms if name_columns(term) == names]
    if len(by_joint) < 2:
        return
    for order in list_orders(names):
        yield from _make_orders(by_joint, names, order)
        yield from _make_orders(by_joint, names, order, after=True)
    yield from spread([SIGN], "joints", names, *(f"signal {term.name}" for term in by_joint))
    long = [f"scaled {term.name}" for term in terms if term.samples > 1]
    if long:
        yield ALL_FILLED.put("observation", *long)
    yield ALL_LATE.put("observation", *(f"signal {term.name}" for term in terms))


def _list_vector_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield wrong orders of the terms, and a clipped vector."""
    slices = policy.contract.term_slices
    for order in itertools.permutations(slices):
        if list(order) != list(slices):
            places = [np.arange(slices[name].start, slices[name].stop) for name in order]
            text = f"the terms are in the order {', '.join(order)}"
            row = Distortion("order", text, partial(permute, order=tuple(np.concatenate(places))))
            yield row.put("observation", "vector")
    yield ALL_CLIPPED.put("observation", "vector")


def _list_frame_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield turned, swapped and shifted frames of the target."""
    terms = {term.name: term for term in policy.contract.terms}
    if "target" not in terms or len(terms["target"].columns) != 3:
        return
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if order == (0, 1, 2) and sum(sign < 0 for sign in signs) < 2:
                continue  # no change, or the wrong sign of one axis
            letters = zip(signs, order, strict=True)
            named = " ".join(f"{'-' if sign < 0 else '+'}{'xyz'[axis]}" for sign, axis in letters)
            kind, text = "frame", f"target is in a frame with the axes {named}"
            if min(signs) > 0:
                kind, text = "order", f"target has its axes in the order {named}"
            axes = np.diag(signs) @ np.eye(3)[list(order)]
            yield Distortion(kind, text, partial(mirror, axes=axes)).put("target", "signal target")
    for axis, letter in enumerate("xyz"):
        text = f"target is in a frame turned by {{value}} rad about {letter}"
        about = partial(turn, axis=letter)
        row = Distortion("frame", text, about, ANGLES_RAD, "angle_rad", True)
        yield row.put("target", "signal target")
        text = f"target is in a frame shifted by {{value}} m along {letter}"
        row = Distortion("frame", text, shift, SHIFTS_M, "shift_m", True)
        yield row.put(f"target.{letter}", "signal target", columns=[axis])


def _make_command_order(names: Sequence[str], order: Order) -> Distortion:
    """Return the mistake that commands reach the joints in another order."""
    text = "commands reach the joints in another order: " + describe_order(names, order)
    return Distortion("order", text, partial(permute, order=order)).put("command", "command")


def describe_order(names: Sequence[str], order: Order) -> str:
    """Return an order in words."""
    return ", ".join(names[column] for column in order)


def name_columns(term: ObservationTerm) -> list[str]:
    """Return the names of a term's columns within it: `q3` for `q_q3_rad`, `x` for `target_x_m`."""
    around = re.compile(rf"^({re.escape(term.name)}|q|u|advice)_|_(rad|m)$")
    return [around.sub("", column) for column in term.columns]
