"""Mistakes of deployment code, each as a change of the replay that reproduces it.

A distortion has a kind (order, sign, scale, frame, rate, delay, stale, clip, default_pose, history,
filter, network), the field where it acts, and at most one number.
Axes: `T` rows, `R` rows that are asked for, `H` samples (oldest first), `C` columns, `J` joints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.deployment.contract import LoadedPolicy, ObservationTerm
from diagnosis.deployment.orders import Order, list_orders, match_order
from diagnosis.deployment.replay import Change, Transform
from diagnosis.deployment.transforms import (
    arrange_columns,
    arrange_scaled,
    delay_rows,
    freeze_columns,
    hold_rows,
    lay_out_by_column,
    scale_columns,
    shift_columns,
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
SMOOTHING = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
"""Weights of the newest value at which a search for a low-pass begins."""
MAX_DELAY = 12
"""Longest delay that is tried, rows; half a second at 20 Hz is more than a history's dead time."""
MAX_HOLD = 5
"""Largest number of rows for which a value is held that is tried."""

Build = Callable[[float], Change]


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


def list_input_distortions(
    policy: LoadedPolicy, signals: Mapping[str, np.ndarray], rows: tuple[int, ...]
) -> list[Distortion]:
    """Return mistakes between log and observation vector.

    Args:
        policy: The policy.
        signals: The log's values by term, `(T, C)`.
        rows: Rows at which something may have begun to be stale.
    """
    contract, found = policy.contract, list[Distortion]()
    for term in contract.terms:
        names = [_shorten(term, column) for column in term.columns]
        found += _list_scalings(term, names)
        found += _list_timings(term, names, signals[term.name], rows)
        if term.name != "target" and len(names) > 1:
            found += _list_orders((term,), names)
        if term.samples > 1:
            found += _list_history_mistakes(term)
    found += _list_joint_mistakes(policy)
    found += _list_vector_mistakes(policy)
    return found


def list_factors(
    place: str, columns: list[int], make: Callable[[Callable[[float], Transform]], Build]
) -> list[Distortion]:
    """Return a wrong sign, a wrong scale and a missing value of some columns.

    Args:
        place: Field of the distortions.
        columns: The columns.
        make: Makes the change from a transform by its number.
    """
    turned = make(keep_fixed(scale_columns(columns, -1.0)))
    missing = make(keep_fixed(scale_columns(columns, 0.0)))

    def scale(value: float) -> Transform:
        return scale_columns(columns, value)

    multiplied = f"{place} is multiplied by {{value}}"
    return [
        Distortion("sign", place, f"{place} has the wrong sign", turned),
        Distortion("scale", place, multiplied, make(scale), FACTORS, True, "factor"),
        Distortion("stale", place, f"{place} is always zero", missing),
    ]


def _list_scalings(term: ObservationTerm, names: list[str]) -> list[Distortion]:
    """Return wrong signs, scales, offsets and bounds of a term."""
    found = []

    def make(transform: Callable[[float], Transform]) -> Build:
        return lambda value: Change(signals={term.name: transform(value)})

    for columns, label in list_groups(names):
        place = term.name + label
        found += list_factors(place, columns, make)
        for unit, factor in UNIT_FACTORS.items():
            found.append(
                Distortion(
                    "scale",
                    place,
                    f"{place} is in {unit}",
                    make(keep_fixed(scale_columns(columns, factor))),
                )
            )
        found.append(
            Distortion(
                "default_pose",
                place,
                f"{{value}} standard deviations are added to {place}",
                make(lambda value, columns=columns: shift_columns(term, columns, value)),
                OFFSETS_STD,
                True,
                "offset_std",
            )
        )
    found += _list_normalisations(term)
    return found


def _list_normalisations(term: ObservationTerm) -> list[Distortion]:
    """Return missing steps of the normalisation; clipped values."""
    mean, std, found = term.mean, term.std, []
    name = term.name
    if np.abs(std - 1.0).max() > 0 or np.abs(mean).max() > 0:
        raw = Change(windows={name: lambda x: x * std + mean})
        found.append(Distortion("scale", name, f"{name} is not normalised", make_fixed(raw)))
        found.append(
            Distortion(
                "stale",
                name,
                f"{name} is missing: zero after scaling",
                lambda _: Change(windows={name: lambda x: np.broadcast_to(mean, x.shape)}),
            )
        )
    if np.abs(mean).max() > 0:
        shifted = Change(windows={name: lambda x: x + mean})
        found.append(
            Distortion(
                "default_pose", name, f"the mean of {name} is not subtracted", make_fixed(shifted)
            )
        )
    if np.abs(std - 1.0).max() > 0:
        unscaled = Change(windows={name: lambda x: (x - mean) * std + mean})
        found.append(
            Distortion(
                "scale",
                name,
                f"{name} is not divided by its standard deviation",
                make_fixed(unscaled),
            )
        )

    def clip(value: float) -> Change:
        return Change(windows={name: lambda x: ((x - mean) / std).clip(-value, value) * std + mean})

    found.append(
        Distortion(
            "clip",
            name,
            f"{name} is clipped at ±{{value}} after scaling",
            clip,
            LEVELS,
            True,
            "bound",
        )
    )
    return found


def _list_timings(
    term: ObservationTerm, names: list[str], values: np.ndarray, rows: tuple[int, ...]
) -> list[Distortion]:
    """Return delays, held and stale values of a term."""
    found = []

    def make(transform: Callable[[float], Transform]) -> Build:
        return lambda value: Change(signals={term.name: transform(value)})

    delays = tuple(float(number) for number in range(1, MAX_DELAY + 1))
    place = term.name
    found.append(
        Distortion(
            "delay",
            place,
            f"{place} is {{value}} periods old",
            make(delay_rows),
            delays,
            False,
            "periods",
        )
    )
    if term.newest < 0:
        ahead = make(keep_fixed(lambda x: np.concatenate([x[1:], x[-1:]])))
        found.append(Distortion("delay", place, f"{place} is a period too new", ahead))
    for hold in range(2, MAX_HOLD + 1):
        for phase in range(hold):
            text = f"{place} is refreshed every {hold} periods only"
            found.append(Distortion("rate", place, text, make(keep_fixed(hold_rows(hold, phase)))))
    for columns, label in list_groups(names):
        if not np.ptp(values[:, columns], axis=0).any():
            continue  # what never changes cannot be seen to be stale
        frozen = tuple(float(row) for row in rows)
        found.append(
            Distortion(
                "stale",
                term.name + label,
                f"{term.name}{label} is stale from row {{value}} on",
                make(lambda row, columns=columns: freeze_columns(columns, int(row))),
                frozen,
                False,
                "row",
            )
        )
    found.append(
        Distortion(
            "filter",
            place,
            f"{place} is low-pass filtered, newest weighs {{value}}",
            make(smooth_rows),
            SMOOTHING,
            True,
            "weight",
        )
    )
    return found


def _list_orders(terms: Sequence[ObservationTerm], names: list[str]) -> list[Distortion]:
    found = []
    for order in list_orders(names):
        found += make_orders(terms, names, order)
    return found


def make_orders(
    terms: Sequence[ObservationTerm], names: list[str], order: Order
) -> list[Distortion]:
    """Return the mistake that terms of the observation are in another order.

    The mean that is subtracted may be in that order too, or in the one of the contract.
    """
    listed = " and ".join(
        filter(None, (", ".join(term.name for term in terms[:-1]), terms[-1].name))
    )
    verb, place = ("is", terms[0].name) if len(terms) == 1 else ("are", "joints")
    text = f"{listed} {verb} in another order: {describe_order(names, order)}"
    raw = Change(signals={term.name: arrange_columns(order) for term in terms})
    found = [Distortion("order", place, text, make_fixed(raw))]
    if any(np.ptp(term.mean) > 0 or np.ptp(term.std) > 0 for term in terms):
        scaled = Change(windows={term.name: arrange_scaled(term, order) for term in terms})
        found.append(Distortion("order", place, text, make_fixed(scaled)))
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
        names = [_shorten(term, column) for column in term.columns]
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


def _list_history_mistakes(term: ObservationTerm) -> list[Distortion]:
    """Return histories that are turned round, sampled at another rate, or laid out otherwise."""
    name, samples = term.name, term.samples
    found = [
        Distortion(
            "order",
            name,
            f"the history of {name} has the newest sample first",
            lambda _: Change(windows={name: lambda x: x[:, ::-1]}),
        ),
        Distortion(
            "order",
            name,
            f"{name} is laid out joint by joint, not sample by sample",
            lambda _: Change(windows={name: lay_out_by_column}),
        ),
    ]
    for step in (2, 3):
        index = np.maximum(samples - 1 - np.arange(samples)[::-1] // step, 0)
        slow = Change(windows={name: lambda x, index=index: x[:, index]})
        found.append(
            Distortion(
                "rate",
                name,
                f"the history of {name} is filled {step} times a period",
                make_fixed(slow),
            )
        )
    return found


def _list_joint_mistakes(policy: LoadedPolicy) -> list[Distortion]:
    """Return mistakes that positions and commands share, and those of the start."""
    contract, found = policy.contract, list[Distortion]()
    names, by_joint = list(contract.joints), list[ObservationTerm]()
    for term in contract.terms:
        if [_shorten(term, column) for column in term.columns] == names:
            by_joint.append(term)
    shared = [term.name for term in by_joint]
    if len(shared) > 1:
        found += _list_orders(by_joint, names)
        for columns, label in list_groups(names):
            change = Change(signals={name: scale_columns(columns, -1.0) for name in shared})
            found.append(
                Distortion(
                    "sign",
                    "joints" + label,
                    f"joints{label} are observed with the wrong sign",
                    make_fixed(change),
                )
            )
        for step in (2, 3):
            found.append(_make_slow_history(contract.terms, step))
        delays = tuple(float(number) for number in range(1, MAX_DELAY + 1))

        def delay_all(value: float) -> Change:
            return Change(signals={term.name: delay_rows(value) for term in contract.terms})

        found.append(
            Distortion(
                "delay",
                "observation",
                "the whole observation is {value} periods old",
                delay_all,
                delays,
                False,
                "periods",
            )
        )
    for before, text in (("zero", "zeros"), ("normalised", "zeros after scaling")):
        change = Change(before=before)
        found.append(
            Distortion(
                "history", "observation", f"the history begins with {text}", make_fixed(change)
            )
        )
    return found


def _make_slow_history(terms: tuple[ObservationTerm, ...], step: int) -> Distortion:
    windows: dict[str, Transform] = {}
    for term in terms:
        if term.samples > 1:
            index = np.maximum(term.samples - 1 - np.arange(term.samples)[::-1] // step, 0)
            windows[term.name] = lambda x, index=index: x[:, index]
    change = Change(windows=windows)
    text = f"the history is filled {step} times a period: the loop runs at {step} times its rate"
    return Distortion("rate", "observation", text, make_fixed(change))


def _list_vector_mistakes(policy: LoadedPolicy) -> list[Distortion]:
    """Return wrong orders of the terms, and a clipped vector."""
    slices, found = policy.contract.term_slices, list[Distortion]()
    for order in itertools.permutations(slices):
        if list(order) == list(slices):
            continue
        index = np.concatenate([np.arange(slices[name].start, slices[name].stop) for name in order])
        change = Change(vector=lambda x, index=index: x[:, index])
        found.append(
            Distortion(
                "order",
                "observation",
                f"the terms are in the order {', '.join(order)}",
                make_fixed(change),
            )
        )
    found.append(
        Distortion(
            "clip",
            "observation",
            "the observation is clipped at ±{value}",
            lambda value: Change(vector=lambda x: x.clip(-value, value)),
            LEVELS,
            True,
            "bound",
        )
    )
    return found


def list_groups(names: list[str]) -> Iterator[tuple[list[int], str]]:
    """Yield the columns of all names together, then of each, with the end of the field's name."""
    yield list(range(len(names))), ""
    if len(names) > 1:
        for column, name in enumerate(names):
            yield [column], f".{name}"


def describe_order(names: list[str], order: tuple[int, ...]) -> str:
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


def make_fixed(change: Change) -> Build:
    """Return the maker of a change without a number."""
    return lambda _: change


def keep_fixed(transform: Transform) -> Callable[[float], Transform]:
    """Return the maker of a transform without a number."""
    return lambda _: transform
