"""Mistakes of deployment code, each as a change of the replay that reproduces it.

A distortion has a kind (order, sign, scale, frame, rate, delay, stale, clip, default_pose, history,
filter, network), the field where it acts, and at most one number. Mistakes that signals and commands
share are listed once, for any `Place` on the way.
Axes: `T` rows, `R` rows that are asked for, `H` samples (oldest first), `C` columns, `J` joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm
from diagnosis.deployment.orders import Order, invert_order, list_orders, match_order
from diagnosis.deployment.replay import Change, Network, Transform
from diagnosis.deployment.transforms import (
    arrange_columns,
    arrange_scaled,
    clip_columns,
    delay_rows,
    freeze_columns,
    hold_rows,
    lay_out_by_column,
    rotate_frame,
    scale_columns,
    shift_column,
    shift_columns,
    shift_command,
    smooth_rows,
)

FACTORS = (-2.0, -0.5, 0.1, 0.25, 0.5, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0, 3.0, 10.0)
"""Factors at which a search for a wrong scale begins; it is refined from the best of them."""
UNIT_FACTORS = {
    "degrees for radians": 180.0 / np.pi,
    "radians for degrees": np.pi / 180.0,
    "thousandths for units": 1000.0,
    "units for thousandths": 0.001,
    "hundredths for units": 100.0,
}
LEVELS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.5, 2.0, 3.0)
"""Bounds at which a search for a clip begins."""
OFFSETS_STD = (-2.0, -1.0, -0.5, -0.2, -0.08, 0.08, 0.2, 0.5, 1.0, 2.0)
"""Offsets at which a search for a default pose begins, in standard deviations of the contract."""
OFFSETS_COMMAND = (-0.3, -0.1, -0.03, 0.03, 0.1, 0.3)
"""The same of commands, of full command."""
SMOOTHING = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
"""Weights of the newest value at which a search for a low-pass begins."""
ANGLES_RAD = tuple(np.deg2rad([*range(-165, 0, 15), -4, 4, *range(15, 181, 15)]))
"""Angles at which a search for a turned frame begins."""
SHIFTS_M = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
"""Shifts, both ways, at which a search for another origin begins, m."""
MAX_DELAY = 12
"""Longest delay that is tried, rows; half a second at 20 Hz is more than a history's dead time."""
MAX_HOLD = 5
"""Largest number of rows for which a value is held that is tried."""
DELAYS = tuple(float(number) for number in range(1, MAX_DELAY + 1))

Build = Callable[[float], Change]
Wrap = Callable[[Transform], Change]
"""Makes the change at a place from a transform of its values."""


@dataclass(frozen=True)
class Distortion:
    """A mistake that deployment code may have.

    Attributes:
        kind: Kind of mistake.
        field: Where: `q.q3`, `u`, `target.y`, `command.q2`, `observation`.
        text: The mistake in words; `{value}` stands for the number.
        build: Makes the change from the number.
        values: Numbers to try; one of no meaning where there is no number.
        is_continuous: The number is refined between those of `values`.
        parameter: Name of the number, with its unit; empty without one.
    """

    kind: str
    field: str
    text: str
    build: Build
    values: tuple[float, ...] = (0.0,)
    is_continuous: bool = False
    parameter: str = ""

    @property
    def term(self) -> str:
        """Part of the field before the point."""
        return self.field.partition(".")[0]

    @property
    def num_free(self) -> int:
        """Numbers that are fitted."""
        return int(bool(self.parameter))


def make_fixed(kind: str, field: str, text: str, change: Change) -> Distortion:
    """Return a mistake without a number."""
    return Distortion(kind, field, text, lambda _: change)


@dataclass(frozen=True)
class Place:
    """Columns on the way from log to valve that code may spoil.

    Attributes:
        name: `q`, `u`, `target` or `command`.
        columns: Names of its columns.
        wrap: Makes the change from a transform of its values, `(T, C)`.
    """

    name: str
    columns: list[str]
    wrap: Wrap

    def list_groups(self) -> Iterator[tuple[list[int], str]]:
        """Yield all columns together, then each, with the field that they are."""
        yield list(range(len(self.columns))), self.name
        if len(self.columns) > 1:
            for column, name in enumerate(self.columns):
                yield [column], f"{self.name}.{name}"

    def fix(self, kind: str, field: str, text: str, transform: Transform) -> Distortion:
        """Return a mistake without a number."""
        return make_fixed(kind, field, text, self.wrap(transform))

    def vary(
        self,
        kind: str,
        field: str,
        text: str,
        make: Callable[[float], Transform],
        values: tuple[float, ...],
        parameter: str,
        is_continuous: bool = True,
    ) -> Distortion:
        """Return a mistake with a number."""
        build = lambda value: self.wrap(make(value))  # noqa: E731
        return Distortion(kind, field, text, build, values, is_continuous, parameter)

    def list_factors(self, columns: list[int], field: str) -> Iterator[Distortion]:
        """Yield a wrong sign, a wrong scale and a missing value of some columns."""
        yield self.fix("sign", field, f"{field} has the wrong sign", scale_columns(columns, -1.0))
        text = f"{field} is multiplied by {{value}}"
        yield self.vary("scale", field, text, partial(scale_columns, columns), FACTORS, "factor")
        yield self.fix("stale", field, f"{field} is always zero", scale_columns(columns, 0.0))

    def list_holds(self, text: str) -> Iterator[Distortion]:
        """Yield values that are held for several periods; `{hold}` in the text is their number."""
        for hold in range(2, MAX_HOLD + 1):
            for phase in range(hold):
                change = hold_rows(hold, phase)
                yield self.fix("rate", self.name, text.format(hold=hold), change)


def _watch_term(term: ObservationTerm) -> Place:
    """Return the values of a term as a place."""
    names = [_shorten(term, column) for column in term.columns]
    return Place(term.name, names, lambda change: Change(signals={term.name: change}))


def list_input_distortions(
    policy: LoadedPolicy, signals: Mapping[str, np.ndarray], rows: tuple[int, ...]
) -> list[Distortion]:
    """Return mistakes between log and observation vector.

    Args:
        policy: The policy.
        signals: The log's values by term, `(T, C)`.
        rows: Rows at which something may have begun to be stale.
    """
    found = list[Distortion]()
    for term in policy.contract.terms:
        place = _watch_term(term)
        found += _list_scalings(term, place)
        found += _list_normalisations(term)
        found += _list_timings(term, place, signals[term.name], rows)
        if term.name != "target" and len(place.columns) > 1:
            for order in list_orders(place.columns):
                found += make_orders((term,), place.columns, order)
        if term.samples > 1:
            found += _list_history_mistakes(term)
    found += _list_joint_mistakes(policy)
    found += _list_vector_mistakes(policy)
    return found


def _list_scalings(term: ObservationTerm, place: Place) -> Iterator[Distortion]:
    """Yield wrong signs, scales, units and offsets of a term."""
    for columns, field in place.list_groups():
        yield from place.list_factors(columns, field)
        for unit, factor in UNIT_FACTORS.items():
            text = f"{field} is in {unit}"
            yield place.fix("scale", field, text, scale_columns(columns, factor))
        text = f"{{value}} standard deviations are added to {field}"
        make = partial(shift_columns, term, columns)
        yield place.vary("default_pose", field, text, make, OFFSETS_STD, "offset_std")


def _list_normalisations(term: ObservationTerm) -> Iterator[Distortion]:
    """Yield missing steps of the normalisation; clipped values."""
    mean, std, name = term.mean, term.std, term.name
    has_mean, has_std = np.abs(mean).max() > 0, np.abs(std - 1.0).max() > 0

    def fix(kind: str, text: str, transform: Transform) -> Distortion:
        return make_fixed(kind, name, text, Change(windows={name: transform}))

    if has_mean or has_std:
        yield fix("scale", f"{name} is not normalised", lambda x: x * std + mean)
        zero = lambda x: np.broadcast_to(mean, x.shape)  # noqa: E731
        yield fix("stale", f"{name} is missing: zero after scaling", zero)
    if has_mean:
        yield fix("default_pose", f"the mean of {name} is not subtracted", lambda x: x + mean)
    if has_std:
        text = f"{name} is not divided by its standard deviation"
        yield fix("scale", text, lambda x: (x - mean) * std + mean)

    def clip(value: float) -> Change:
        return Change(windows={name: lambda x: ((x - mean) / std).clip(-value, value) * std + mean})

    text = f"{name} is clipped at ±{{value}} after scaling"
    yield Distortion("clip", name, text, clip, LEVELS, True, "bound")


def _list_timings(
    term: ObservationTerm, place: Place, values: np.ndarray, rows: tuple[int, ...]
) -> Iterator[Distortion]:
    """Yield delays, held and stale values of a term."""
    name = term.name
    text = f"{name} is {{value}} periods old"
    yield place.vary("delay", name, text, delay_rows, DELAYS, "periods", False)
    if term.newest < 0:
        ahead = lambda x: np.concatenate([x[1:], x[-1:]])  # noqa: E731
        yield place.fix("delay", name, f"{name} is a period too new", ahead)
    yield from place.list_holds(f"{name} is refreshed every {{hold}} periods only")
    for columns, field in place.list_groups():
        if np.ptp(
            values[:, columns], axis=0
        ).any():  # what never changes cannot be seen to be stale
            text = f"{field} is stale from row {{value}} on"
            make = partial(freeze_columns, columns)
            begins = tuple(float(row) for row in rows)
            yield place.vary("stale", field, text, make, begins, "row", False)
    text = f"{name} is low-pass filtered, newest weighs {{value}}"
    yield place.vary("filter", name, text, smooth_rows, SMOOTHING, "weight")


def make_orders(
    terms: Sequence[ObservationTerm], names: list[str], order: Order, network: Network | None = None
) -> list[Distortion]:
    """Return the mistake that terms of the observation are in another order.

    The mean that is subtracted may be in that order too, or in the one of the contract.

    Args:
        terms: The terms.
        names: Names of their columns.
        order: The other order.
        network: The policy's network, where its commands are taken to be in that order too.
    """
    *others, last = [term.name for term in terms]
    listed = f"{', '.join(others)} and {last}" if others else last
    verb, place = ("are", "joints") if others else ("is", last)
    shown = describe_order(names, order)
    text = f"{listed} {verb} in another order: {shown}"
    answer = None
    if network is not None:
        listed = ", ".join([*others, last])
        text = f"{listed} and the commands are in another order: {shown}"
        back = list(invert_order(order))
        answer = lambda vectors: network(vectors)[:, back]  # noqa: E731
    raw = Change(signals={term.name: arrange_columns(order) for term in terms}, network=answer)
    found = [make_fixed("order", place, text, raw)]
    if any(np.ptp(term.mean) > 0 or np.ptp(term.std) > 0 for term in terms):
        windows = {term.name: arrange_scaled(term, order) for term in terms}
        scaled = Change(windows=windows, network=answer)
        found.append(make_fixed("order", place, text, scaled))
    return found


def list_matched_orders(
    policy: LoadedPolicy, signals: Mapping[str, np.ndarray], observed: np.ndarray
) -> list[Distortion]:
    """Return the orders of terms that a logged observation vector shows, whatever they are.

    Args:
        policy: The policy.
        signals: The log's values by term, `(T, C)`.
        observed: The vector as the network got it, `(T, O)`.
    """
    contract, shared = policy.contract, dict[Order, list[ObservationTerm]]()
    found = list[Distortion]()
    for term in contract.terms:
        if len(term.columns) < 2:
            continue
        block = observed[:, contract.term_slices[term.name]]
        seen = block.reshape(len(observed), term.samples, -1)[:, -1]
        known = signals[term.name][np.clip(np.arange(len(observed)) + term.newest, 0, None)]
        names = _watch_term(term).columns
        by_scaled = match_order((known - term.mean) / term.std, seen)
        by_raw = match_order(known, seen * term.std + term.mean)
        for order in dict.fromkeys(one for one in (by_scaled, by_raw) if one is not None):
            found += make_orders((term,), names, order)
            if names == list(contract.joints):
                shared.setdefault(order, []).append(term)
    for order, terms in shared.items():
        if len(terms) > 1:
            found += make_orders(terms, list(contract.joints), order)
    return found


def _slow_history(samples: int, step: int) -> Transform:
    """Return the change of a history that is filled several times a period."""
    index = np.maximum(samples - 1 - np.arange(samples)[::-1] // step, 0)
    return lambda x: x[:, index]


def _list_history_mistakes(term: ObservationTerm) -> Iterator[Distortion]:
    """Yield histories that are turned round, sampled at another rate, or laid out otherwise."""
    name, samples = term.name, term.samples
    mistakes: list[tuple[str, str, Transform]] = [
        ("order", f"the history of {name} has the newest sample first", lambda x: x[:, ::-1]),
        ("order", f"{name} is laid out joint by joint, not sample by sample", lay_out_by_column),
    ]
    for step in (2, 3):
        text = f"the history of {name} is filled {step} times a period"
        mistakes.append(("rate", text, _slow_history(samples, step)))
    for kind, text, transform in mistakes:
        yield make_fixed(kind, name, text, Change(windows={name: transform}))


def _list_joint_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield mistakes that positions and commands share, and those of the start."""
    terms, names = policy.contract.terms, list(policy.contract.joints)
    by_joint = [term for term in terms if _watch_term(term).columns == names]
    if len(by_joint) > 1:
        for order in list_orders(names):
            yield from make_orders(by_joint, names, order)
            yield from make_orders(by_joint, names, order, policy.network.answer)

        def change_all(transform: Transform) -> Change:
            return Change(signals={term.name: transform for term in by_joint})

        joints = Place("joints", names, change_all)
        for columns, field in joints.list_groups():
            text = f"{field} are observed with the wrong sign"
            yield joints.fix("sign", field, text, scale_columns(columns, -1.0))
        for step in (2, 3):
            windows = {
                term.name: _slow_history(term.samples, step) for term in terms if term.samples > 1
            }
            text = f"the history is filled {step} times a period: the loop runs at {step} times its rate"
            yield make_fixed("rate", "observation", text, Change(windows=windows))

        def delay_all(value: float) -> Change:
            return Change(signals={term.name: delay_rows(value) for term in terms})

        text = "the whole observation is {value} periods old"
        yield Distortion("delay", "observation", text, delay_all, DELAYS, False, "periods")
    for before, text in (("zero", "zeros"), ("normalised", "zeros after scaling")):
        change = Change(before=before)
        yield make_fixed("history", "observation", f"the history begins with {text}", change)


def _list_vector_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield wrong orders of the terms, and a clipped vector."""
    slices = policy.contract.term_slices
    for order in itertools.permutations(slices):
        if list(order) != list(slices):
            places = [np.arange(slices[name].start, slices[name].stop) for name in order]
            index = np.concatenate(places)
            change = Change(vector=lambda x, index=index: x[:, index])
            text = f"the terms are in the order {', '.join(order)}"
            yield make_fixed("order", "observation", text, change)

    def clip(value: float) -> Change:
        return Change(vector=lambda x: x.clip(-value, value))

    text = "the observation is clipped at ±{value}"
    yield Distortion("clip", "observation", text, clip, LEVELS, True, "bound")


def list_frame_distortions(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield turned, swapped and shifted frames of the target."""
    terms = {term.name: term for term in policy.contract.terms}
    if "target" not in terms or len(terms["target"].columns) != 3:
        return
    target = _watch_term(terms["target"])
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if order == (0, 1, 2) and sum(sign < 0 for sign in signs) < 2:
                continue  # no change, or the wrong sign of one axis
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            letters = zip(signs, order, strict=True)
            axes = " ".join(f"{'-' if sign < 0 else '+'}{'xyz'[axis]}" for sign, axis in letters)
            kind, text = "frame", f"target is in a frame with the axes {axes}"
            if min(signs) > 0:
                kind, text = "order", f"target has its axes in the order {axes}"
            yield target.fix(kind, "target", text, lambda x, turn=turn: x @ turn.T)
    for axis, letter in enumerate("xyz"):

        def turn_about(angle: float, axis: int = axis) -> Transform:
            return lambda x: x @ rotate_frame(axis, angle).T

        text = f"target is in a frame turned by {{value}} rad about {letter}"
        yield target.vary("frame", "target", text, turn_about, ANGLES_RAD, "angle_rad")
        text = f"target is in a frame shifted by {{value}} m along {letter}"
        shifts = (*(-shift for shift in reversed(SHIFTS_M)), *SHIFTS_M)
        make = partial(shift_column, axis)
        yield target.vary("frame", f"target.{letter}", text, make, shifts, "shift_m")


def make_command_order(names: list[str], order: Order) -> Distortion:
    """Return the mistake that commands reach the joints in another order."""
    text = "commands reach the joints in another order: " + describe_order(names, order)
    return make_fixed("order", "command", text, Change(command=arrange_columns(order)))


def list_command_distortions(policy: LoadedPolicy) -> list[Distortion]:
    """Return mistakes between network and valve."""
    names = list(policy.contract.joints)
    found = [make_command_order(names, order) for order in list_orders(names)]
    place = Place("command", names, lambda change: Change(command=change))
    inside = tuple(level for level in LEVELS if level < 1.0)
    for columns, field in place.list_groups():
        found += place.list_factors(columns, field)
        text = f"{field} is clipped at ±{{value}}"
        found.append(
            place.vary("clip", field, text, partial(clip_columns, columns), inside, "bound")
        )
        text = f"{{value}} is added to {field}"
        make = partial(shift_command, columns)
        found.append(place.vary("default_pose", field, text, make, OFFSETS_COMMAND, "offset"))
    text = "the command is {value} periods late"
    found.append(place.vary("delay", "command", text, delay_rows, DELAYS, "periods", False))
    text = "a command is held for {hold} periods: the policy runs at 1/{hold} of its rate"
    found += place.list_holds(text)
    text = "the command is low-pass filtered, newest weighs {value}"
    found.append(place.vary("filter", "command", text, smooth_rows, SMOOTHING, "weight"))
    return found


def list_network_distortions(
    policy: LoadedPolicy, others: Mapping[str, LoadedPolicy]
) -> list[Distortion]:
    """Return the mistake of having deployed each of the other policies, where it would run at all."""
    found = []
    for name, other in others.items():
        if other.contract.size == policy.contract.size:
            change = Change(network=other.network.answer)
            text = f"the network is that of {name}"
            found.append(make_fixed("network", "network", text, change))
    return found


def describe_order(names: list[str], order: Order) -> str:
    """Return an order in words."""
    return ", ".join(names[column] for column in order)


def _shorten(term: ObservationTerm, column: str) -> str:
    """Return the name of a column within its term: `q3` for `q_q3_rad`."""
    if term.name == "target":
        return column.split("_")[1]
    for prefix in (f"{term.name}_", "q_", "u_", "advice_"):
        column = column.removeprefix(prefix)
    for unit in ("_rad", "_m"):
        column = column.removesuffix(unit)
    return column
