"""Mistakes of deployment code, each as a change of the replay that reproduces it.

What code may do to the values of any `Place` on the way stands in the tables of `mistakes`. A `Distortion`
is such a mistake at its place: a kind (order, sign, scale, frame, rate, delay, stale, clip, default_pose,
history, filter, network), the field where it acts, and at most one number.
Axes: `T` rows, `R` rows that are asked for, `H` samples (oldest first), `C` columns, `J` joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm
from diagnosis.deployment.mistakes import (
    ANGLES_RAD,
    DELAYS,
    EARLY,
    LEVELS,
    ON_COMMANDS,
    ON_ROWS,
    ON_SIGNALS,
    SHIFTS_M,
    SIGN,
    Mistake,
    delay,
    freeze,
    make_turn,
    shift,
)
from diagnosis.deployment.orders import Order, invert_order, list_orders, match_order
from diagnosis.deployment.replay import Change, Network, Transform

Build = Callable[[float], Change]
Wrap = Callable[[Transform], Change]
"""Makes the change at a place from a transform of its values."""


@dataclass(frozen=True)
class Distortion:
    """A mistake at its place.

    Attributes:
        kind: Kind of mistake.
        field: Where: `q.q3`, `u`, `target.y`, `command.q2`, `observation`.
        text: The mistake in words; `{value}` stands for the number.
        build: Makes the change from the number.
        values: Numbers to try; one of no meaning where there is no number.
        parameter: Name of the number, with its unit; empty where it is not told.
        is_continuous: The number is refined between those of `values`.
    """

    kind: str
    field: str
    text: str
    build: Build
    values: tuple[float, ...] = (0.0,)
    parameter: str = ""
    is_continuous: bool = False

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
        unit: Unit of each column in which offsets are tried, `(C,)`.
        wrap: Makes the change from a transform of its values, `(T, C)`.
    """

    name: str
    columns: list[str]
    unit: np.ndarray
    wrap: Wrap

    def list_groups(self) -> Iterator[tuple[list[int], str]]:
        """Yield all columns together, then each, with the field that they are."""
        yield list(range(len(self.columns))), self.name
        if len(self.columns) > 1:
            for column, name in enumerate(self.columns):
                yield [column], f"{self.name}.{name}"

    def spoil(self, mistake: Mistake, columns: list[int], field: str) -> Distortion:
        """Return a mistake of some columns."""

        def build(value: float) -> Change:
            def transform(values: np.ndarray) -> np.ndarray:
                changed = values.copy()
                changed[:, columns] = mistake.spoil(values[:, columns], value, self.unit[columns])
                return changed

            return self.wrap(transform)

        text = mistake.text.replace("{field}", field)
        return Distortion(
            mistake.kind, field, text, build, mistake.values, mistake.parameter, mistake.is_continuous
        )  # fmt: skip

    def spoil_each(self, mistakes: Sequence[Mistake]) -> Iterator[Distortion]:
        """Yield each mistake of all columns together and of each."""
        for columns, field in self.list_groups():
            for mistake in mistakes:
                yield self.spoil(mistake, columns, field)

    def spoil_all(self, mistakes: Iterable[Mistake]) -> Iterator[Distortion]:
        """Yield each mistake of all columns together."""
        columns, field = next(self.list_groups())
        for mistake in mistakes:
            yield self.spoil(mistake, columns, field)


def _watch_terms(terms: Sequence[ObservationTerm], name: str) -> Place:
    """Return the values of terms that have the same columns as a place."""

    def wrap(transform: Transform) -> Change:
        return Change(signals={term.name: transform for term in terms})

    names = [_shorten(terms[0], column) for column in terms[0].columns]
    return Place(name, names, terms[0].std, wrap)


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
    begins = tuple(float(row) for row in rows)
    stale = Mistake("stale", "{field} is stale from row {value} on", freeze, begins, "row")
    for term in policy.contract.terms:
        place = _watch_terms([term], term.name)
        found += place.spoil_each(ON_SIGNALS)
        found += _list_normalisations(term)
        found += place.spoil_all(ON_ROWS if term.newest >= 0 else (EARLY, *ON_ROWS))
        for columns, field in place.list_groups():
            # What never changes cannot be seen to be stale.
            if np.ptp(signals[term.name][:, columns], axis=0).any():
                found.append(place.spoil(stale, columns, field))
        if term.name != "target" and len(place.columns) > 1:
            for order in list_orders(place.columns):
                found += make_orders((term,), place.columns, order)
        if term.samples > 1:
            found += _list_history_mistakes(term)
    found += _list_joint_mistakes(policy)
    found += _list_vector_mistakes(policy)
    return found


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

    def clip_scaled(value: float) -> Change:
        return Change(windows={name: lambda x: ((x - mean) / std).clip(-value, value) * std + mean})

    text = f"{name} is clipped at ±{{value}} after scaling"
    yield Distortion("clip", name, text, clip_scaled, LEVELS, "bound", True)


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


def arrange_columns(order: Order) -> Transform:
    """Return the change that puts columns into another order."""
    return lambda values: values[:, list(order)]


def arrange_scaled(term: ObservationTerm, order: Order) -> Transform:
    """Return the change that puts columns of a history, `(R, H, C)`, into another order after scaling."""

    def transform(window: np.ndarray) -> np.ndarray:
        scaled = (window - term.mean) / term.std
        return scaled[..., list(order)] * term.std + term.mean

    return transform


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
        names = _watch_terms([term], term.name).columns
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


def _list_history_mistakes(term: ObservationTerm) -> Iterator[Distortion]:
    """Yield histories that are turned round, sampled at another rate, or laid out otherwise."""
    name, samples = term.name, term.samples
    mistakes: list[tuple[str, str, Transform]] = [
        ("order", f"the history of {name} has the newest sample first", lambda x: x[:, ::-1]),
        (
            "order",
            f"{name} is laid out joint by joint, not sample by sample",
            lambda x: x.transpose(0, 2, 1).reshape(x.shape),
        ),
    ]
    for step in (2, 3):
        text = f"the history of {name} is filled {step} times a period"
        mistakes.append(("rate", text, _slow_history(samples, step)))
    for kind, text, transform in mistakes:
        yield make_fixed(kind, name, text, Change(windows={name: transform}))


def _slow_history(samples: int, step: int) -> Transform:
    """Return the change of a history that is filled several times a period."""
    index = np.maximum(samples - 1 - np.arange(samples)[::-1] // step, 0)
    return lambda x: x[:, index]


def _list_joint_mistakes(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield mistakes that positions and commands share, and those of the start."""
    terms, names = policy.contract.terms, list(policy.contract.joints)
    by_joint = [term for term in terms if _watch_terms([term], "").columns == names]
    if len(by_joint) > 1:
        for order in list_orders(names):
            yield from make_orders(by_joint, names, order)
            yield from make_orders(by_joint, names, order, policy.network.answer)
        yield from _watch_terms(by_joint, "joints").spoil_each([SIGN])
        for step in (2, 3):
            windows = {
                term.name: _slow_history(term.samples, step) for term in terms if term.samples > 1
            }
            text = f"the history is filled {step} times a period: the loop runs at {step} times its rate"
            yield make_fixed("rate", "observation", text, Change(windows=windows))

        def delay_all(value: float) -> Change:
            late = lambda x: delay(x, value, np.ones(1))  # noqa: E731
            return Change(signals={term.name: late for term in terms})

        text = "the whole observation is {value} periods old"
        yield Distortion("delay", "observation", text, delay_all, DELAYS, "periods")
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

    def clip_vector(value: float) -> Change:
        return Change(vector=lambda x: x.clip(-value, value))

    text = "the observation is clipped at ±{value}"
    yield Distortion("clip", "observation", text, clip_vector, LEVELS, "bound", True)


def list_frame_distortions(policy: LoadedPolicy) -> Iterator[Distortion]:
    """Yield turned, swapped and shifted frames of the target."""
    terms = {term.name: term for term in policy.contract.terms}
    if "target" not in terms or len(terms["target"].columns) != 3:
        return
    target = replace(_watch_terms([terms["target"]], "target"), unit=np.ones(3))
    yield from target.spoil_all(_list_turned_axes())
    text = "target is in a frame shifted by {value} m along "
    for axis, letter in enumerate("xyz"):
        about = f"target is in a frame turned by {{value}} rad about {letter}"
        turned = Mistake("frame", about, make_turn(axis), ANGLES_RAD, "angle_rad", True)
        yield from target.spoil_all([turned])
        shifted = Mistake("frame", text + letter, shift, SHIFTS_M, "shift_m", True)
        yield target.spoil(shifted, [axis], f"target.{letter}")


def _list_turned_axes() -> Iterator[Mistake]:
    """Yield the points in frames whose axes are those of the base in another order or sense."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if order == (0, 1, 2) and sum(sign < 0 for sign in signs) < 2:
                continue  # no change, or the wrong sign of one axis
            letters = zip(signs, order, strict=True)
            axes = " ".join(f"{'-' if sign < 0 else '+'}{'xyz'[axis]}" for sign, axis in letters)
            kind, text = "frame", f"target is in a frame with the axes {axes}"
            if min(signs) > 0:
                kind, text = "order", f"target has its axes in the order {axes}"
            columns, factors = list(order), np.array(signs)
            yield Mistake(kind, text, lambda x, _, unit, c=columns, f=factors: x[:, c] * f)


def make_command_order(names: list[str], order: Order) -> Distortion:
    """Return the mistake that commands reach the joints in another order."""
    text = "commands reach the joints in another order: " + describe_order(names, order)
    return make_fixed("order", "command", text, Change(command=arrange_columns(order)))


def list_command_distortions(policy: LoadedPolicy) -> list[Distortion]:
    """Return mistakes between network and valve."""
    names = list(policy.contract.joints)
    found = [make_command_order(names, order) for order in list_orders(names)]
    place = Place("command", names, np.ones(len(names)), lambda change: Change(command=change))
    return [*found, *place.spoil_each(ON_COMMANDS), *place.spoil_all(ON_ROWS)]


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
