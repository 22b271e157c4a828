"""The search over sets of effects: joint by joint over subsets, then over the names of all joints.

A set is judged by its log-likelihood gain less its penalty, which depends on the gain of the same
effect on reference recordings, where there is nothing to find. A saturation may be worth its
penalty only beside a dead band, so each joint keeps the best few subsets of each number of effects.
An effect with one cause for all joints (a clock offset, a worn pump) is first sized joint by joint;
once it is chosen, the joints share its size within `SHARED_PLAY`.
Axes: `J` joints, `E` entries, `S` sizes of a growth path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product

import numpy as np

from brokk_rl.parallel import map_parallel
from diagnosis.residuals import ParameterRay, Residuals
from diagnosis.responses import (
    JointResiduals,
    Response,
    fit_faults,
    fit_joint_faults,
    fit_single_size,
    score_responses,
    simulate_effect,
    sum_responses,
)

# Chosen by hand; not searched.
MAX_EFFECTS = 4
"""Largest number of effects in a set; time grows with the subsets of `MAX_NAMES`."""
SHARED_START = 0.7
"""First guess of the size of an effect beside others, over its size alone."""
BEAM_WIDTH = 5
"""Subsets that a joint keeps for the next number of effects."""
MAX_NAMES = 12
"""Number of names among which whole sets are chosen; they make 793 sets of up to 4."""
MIN_SIZE = 0.15
"""Smallest size, over the typical one, that is named: simulators err by as much."""
SIMPLER_MARGIN = 1.0
"""Standard errors by which the gain of a set must exceed that of a simpler one: the one-standard-error
rule. It was 2.0 before; no comparison is recorded."""
MAX_PENALISED = 14
"""Subsets of each joint that are simulated on the reference too."""
ALREADY_THERE = 3.0
"""Log Bayes factor, all parts of the reference together, from which an effect is there already."""

Subset = frozenset[str]
PenaltyFunction = Callable[[int, Subset], float]
"""Penalty of a subset on a joint, by its number, nats."""


@dataclass
class SubsetScore:
    """Log-likelihood gain of a subset of effects on a joint.

    Attributes:
        gain: Entry by entry, `(E,)`.
        sizes: By effect, along each of its rays.
    """

    gain: np.ndarray
    sizes: dict[str, np.ndarray]

    @property
    def total(self) -> float:
        """Total log-likelihood gain, nats."""
        return float(self.gain.sum())


@dataclass
class SubsetTable:
    """Subsets of effects that were tried on one joint, and their log-likelihood gains.

    Attributes:
        joint: The joint's errors over the noise.
        shapes: By effect: one shape a ray; effects that do nothing to the joint are absent.
        block: Part of the recordings, the same for neighbours, of each entry.
        scores: Gains of the subsets that were tried.
        single: Best sizes of shapes by themselves, by their identity.
    """

    joint: JointResiduals
    shapes: dict[str, list[Response]]
    block: np.ndarray
    scores: dict[Subset, SubsetScore] = field(default_factory=dict)
    single: dict[int, float] = field(default_factory=dict)

    def score(self, subset: Subset) -> SubsetScore:
        """Return the log-likelihood gain of a subset."""
        if subset not in self.scores:
            names = sorted(subset)
            shapes = self._list_responses(names)
            if not shapes:
                return SubsetScore(np.zeros(len(self.joint.z)), {})
            found = [score_responses(self.joint, shapes, start) for start in self._starts(names)]
            gain, sizes = max(found, key=lambda one: one[0].sum())
            ends = np.cumsum([len(self.shapes[name]) for name in names])[:-1]
            self.scores[subset] = SubsetScore(
                gain, dict(zip(names, np.split(sizes, ends), strict=True))
            )
        return self.scores[subset]

    def _starts(self, names: Sequence[str]) -> list[np.ndarray]:
        """Return sizes at which a fit of several effects may begin: all somewhat smaller than alone, and the best smaller set.

        An effect with a threshold does nothing below it, and a fit that begins there stays there.
        So a fit also begins at the best set with one effect less. The further effect then begins at
        the size that explains most of the remaining residuals.
        """
        every = self._list_responses(names)
        # Effects share the residuals, so each is smaller beside the others.
        factor = 1.0 if len(every) == 1 else SHARED_START
        starts = [np.array([self.alone(shape) for shape in every]) * factor]
        if len(names) == 1:
            return starts
        # Pairs need their single effects; of larger subsets those suffice that were tried.
        tried = self.score if len(names) == 2 else self.scores.get
        best, new = None, ""
        for name in names:
            one = tried(frozenset(names) - {name})
            if one and (best is None or one.total > best.total):
                best, new = one, name
        if best:
            kept = sorted(best.sizes)
            sizes = np.concatenate([best.sizes[name] for name in kept])
            left = self.joint.z - sum_responses(self._list_responses(kept), sizes)
            added = [fit_single_size(left, shape) for shape in self.shapes[new]]
            parts = best.sizes | {new: np.array(added)}
            starts.append(np.concatenate([parts[name] for name in names]))
        return starts

    def _list_responses(self, names: Sequence[str]) -> list[Response]:
        found: list[Response] = []
        for name in names:
            found += self.shapes[name]
        return found

    def alone(self, shape: Response) -> float:
        """Return the size of a shape that explains the joint's errors best by itself."""
        if id(shape) not in self.single:
            self.single[id(shape)] = fit_single_size(self.joint.z, shape)
        return self.single[id(shape)]

    def explore(self, price: Mapping[str, float], most: int) -> None:
        """Try all single effects, and larger subsets that contain one of the best of the size below."""

        def net(subset: Subset) -> float:
            return self.score(subset).total - sum(price[name] for name in sorted(subset))

        single = sorted((frozenset({name}) for name in self.shapes), key=net, reverse=True)
        level = [a | b for a, b in combinations(single[: BEAM_WIDTH + 1], 2)]
        best = sorted([*single, *level], key=net, reverse=True)[:BEAM_WIDTH]
        if not best or net(best[0]) <= 0.0:
            return  # a joint without a gap
        for _ in range(2, most + 1):
            before = net(best[0])
            level = self._extend([one for one in best if len(one) < most])
            every = sorted({*best, *level}, key=sorted)
            best = sorted(every, key=net, reverse=True)[:BEAM_WIDTH]
            if net(best[0]) <= before:
                return

    def _extend(self, subsets: Sequence[Subset]) -> list[Subset]:
        """Return all subsets with one effect more, by name.

        Fits begin at what was scored before, so the order must not be that of a hash table.
        """
        larger: set[Subset] = set()
        for subset in subsets:
            for name in self.shapes:
                if name not in subset:
                    larger.add(subset | {name})
        return sorted(larger, key=sorted)


@dataclass(frozen=True)
class EffectSet:
    """A set of effects, joint by joint.

    Attributes:
        subsets: Effects of each joint.
        net_gain: Their gain in all, less their penalties.
    """

    subsets: tuple[Subset, ...]
    net_gain: float

    @property
    def names(self) -> Subset:
        """All effects of the set."""
        return frozenset().union(*self.subsets)


def choose_set(
    tables: Sequence[SubsetTable],
    price: PenaltyFunction,
    name_price: float,
    share: float,
    shared: Subset = frozenset(),
    partial: float = 0.0,
    least: float = 0.0,
) -> EffectSet:
    """Return the set with the largest net gain, or a simpler one whose net gain is not surely smaller.

    Args:
        tables: Scores of the subsets of each joint.
        price: Penalty of a subset on a joint.
        name_price: Penalty of each effect as such, however many joints have it.
        share: Least part of the gain of a joint's subset that each of its effects must add.
        shared: Effects with one cause for all joints; they have the penalty `name_price` only.
        partial: Penalty of such an effect for each joint that could show it and does not.
        least: Least penalty on a joint of an effect that is not shared; subsets with a smaller gain
            are not tried on the reference.
    """
    worth: list[dict[Subset, float]] = []
    for j, table in enumerate(tables):
        worth.append({})
        for subset in list_promising_subsets(table, least, share, shared):
            value = table.scores[subset].total - price(j, subset)
            # A shared effect may lose on one joint and gain in all.
            if value > 0 or subset <= shared:
                worth[j][subset] = value
    felt = [shared & table.shapes.keys() for table in tables]
    terms = _SetPenalties(felt, name_price, partial, share)
    best = _find_best_set(worth, terms)
    while simpler := _find_simpler_set(best, worth, tables, terms):
        best = simpler
    return best


@dataclass(frozen=True)
class _SetPenalties:
    """Penalties of whole sets; see `choose_set`.

    Attributes:
        felt: Shared effects that each joint could show.
        name: Penalty of each effect as such, nats.
        partial: Penalty of a shared effect for each joint that lacks it, nats.
        share: Least part of the gain that each effect must add.
    """

    felt: Sequence[Subset]
    name: float
    partial: float
    share: float


def _find_best_set(worth: Sequence[Mapping[Subset, float]], terms: _SetPenalties) -> EffectSet:
    """Return the set of at most `MAX_EFFECTS` with the largest net gain; each joint takes its best subset."""
    known: set[str] = set()
    for by_subset in worth:
        for subset in by_subset:
            for name in subset:
                known.add(name)
    names = sorted(known, key=lambda name: -_sum_best(worth, name))[:MAX_NAMES]
    best = EffectSet((frozenset(),) * len(worth), 0.0)
    for size in range(1, MAX_EFFECTS + 1):
        for chosen in combinations(names, size):
            among = frozenset(chosen)
            total, subsets = -terms.name * size, []
            for w, every in zip(worth, terms.felt, strict=True):
                lacking = among & every
                net = {s: w[s] - terms.partial * len(lacking - s) for s in w if s <= among}
                net[frozenset()] = -terms.partial * len(lacking)
                subsets.append(max(net, key=net.__getitem__))
                total += net[subsets[-1]]
            # A set with a name that no joint takes is a smaller set, which is tried by itself.
            if total > best.net_gain and frozenset().union(*subsets) == among:
                best = EffectSet(tuple(subsets), total)
    return best


def _find_simpler_set(
    best: EffectSet,
    worth: Sequence[Mapping[Subset, float]],
    tables: Sequence[SubsetTable],
    terms: _SetPenalties,
) -> EffectSet | None:
    """Return a set with fewer names whose loss is within the scatter between blocks, or a small part of the whole."""
    for name in sorted(best.names):
        rest = [{s: w[s] for s in w if name not in s} for w in worth]
        other = _find_best_set(rest, terms)
        if len(other.names) >= len(best.names) or not other.names:
            continue
        lost, whole, blocks = 0.0, 0.0, np.zeros(int(tables[0].block.max()) + 1)
        for table, mine, others in zip(tables, best.subsets, other.subsets, strict=True):
            if mine != others:
                difference = table.score(mine).gain - table.score(others).gain
                lost, whole = lost + difference.sum(), whole + table.score(mine).total
                blocks += np.bincount(table.block, difference, len(blocks))
        # Entries of a block depend on each other, so the standard error is taken over blocks.
        error = blocks.std() * np.sqrt(len(blocks))
        if lost < max(SIMPLER_MARGIN * error, terms.share * whole):
            return other
    return None


def list_promising_subsets(
    table: SubsetTable, least: float, share: float, shared: Subset = frozenset()
) -> list[Subset]:
    """Return the subsets of a joint that are worth pricing: effects that pay by themselves, and the larger ones that earn most.

    An effect that is `shared` by all joints may earn little on each.
    """

    def pays(subset: Subset) -> bool:
        own = subset - shared
        return table.scores[subset].total > least * len(own) and _has_each_gain(
            subset, own, table, share
        )

    paying = [subset for subset in list(table.scores) if subset and pays(subset)]
    paying.sort(key=lambda s: table.scores[s].total, reverse=True)
    return [s for place, s in enumerate(paying) if place < MAX_PENALISED or len(s) == 1]


def _has_each_gain(subset: Subset, own: Subset, table: SubsetTable, share: float) -> bool:
    """Return True where each of the effects `own` has a size worth naming and adds its share: else it mends the form of another."""
    total, sizes = table.scores[subset].total, table.scores[subset].sizes
    if any(np.abs(sizes[name]).max() < MIN_SIZE for name in own):
        return False
    if len(subset) == 1:
        return True
    return all(total - table.score(subset - {name}).total >= share * total for name in own)


def _sum_best(worth: Sequence[Mapping[Subset, float]], name: str) -> float:
    """Return the most that a subset with `name` is worth, summed over joints."""
    best = []
    for by_subset in worth:
        values = [value for subset, value in by_subset.items() if name in subset]
        best.append(max(values, default=0.0))
    return sum(best)


@dataclass
class ReferenceScores:
    """Log-likelihood gains of sets of effects on reference recordings, simulated on first use.

    Attributes:
        parts: The simulator against parts of the reference that it was not fitted to.
        num_entries: Entries of the field, `E`.
        rays: Ways in which each effect grows, at small sizes.
        grown: The same as they are simulated in the field.
        joints: Residuals of each joint in the field.
        shapes: Responses of each joint to each effect in the field.
        shared: Effects with one cause for all joints.
        tables: Of each part and joint.
        known: Effects that were simulated on the reference.
    """

    parts: Sequence[Residuals]
    num_entries: int
    rays: Mapping[str, Sequence[ParameterRay]]
    grown: Mapping[str, Sequence[ParameterRay]]
    joints: Sequence[JointResiduals]
    shapes: Sequence[Mapping[str, Sequence[Response]]]
    shared: frozenset[str]
    tables: list[list[SubsetTable]] = field(default_factory=list)
    known: set[str] = field(default_factory=set)

    def _scored(self, j: int, subset: frozenset[str]) -> list[tuple[SubsetScore, float]]:
        """Return the gain of the subset on joint `j` in each part of the reference, and the length of the field over the part's."""
        self.simulate(subset)
        found = []
        for tables in self.tables:
            mine = tables[j]
            usable = frozenset(subset & mine.shapes.keys())
            found.append((mine.score(usable), self.num_entries / len(mine.joint.z)))
        return found

    def simulate(self, names: Subset) -> None:
        """Simulate effects on all parts, unless they are known."""
        if not self.tables:
            for part in self.parts:
                joints = fit_joint_faults(part)
                self.tables.append([SubsetTable(joint, {}, part.block) for joint in joints])
        todo = list(product(sorted(names - self.known), range(len(self.parts))))

        def respond(one: tuple[str, int]) -> list[dict[str, list[Response]]]:
            name, number = one
            # The field chose the values of numbers that only shape the effect.
            shape = self.grown[name][0].shape
            ways = [replace(ray, shape=shape) for ray in self.rays[name]]
            return simulate_effect(ways, self.parts[number])[1]

        for (_, number), own in zip(todo, map_parallel(respond, todo), strict=True):
            for table, added in zip(self.tables[number], own, strict=True):
                table.shapes.update(added)
        self.known |= names

    def earned(self, j: int, subset: frozenset[str]) -> float:
        """Return the most that the subset earns on joint `j` in any part of the reference, at the length of the field.

        Of a cause that all joints share the mean: its price adds up over the joints, and the most
        of each adds up to too much.
        """
        found = [max(0.0, scored.total * part) for scored, part in self._scored(j, subset)]
        return float((np.mean if subset <= self.shared else max)(found)) if found else 0.0

    def repeated(self, j: int, subset: frozenset[str]) -> float:
        """Return the gain of the subset in the field at its sizes on the reference; 0 where it has none there."""
        parts = [scored for scored, _ in self._scored(j, subset)]
        if not parts or sum(scored.total for scored in parts) < ALREADY_THERE:
            return 0.0
        joint, change = self.joints[j], np.zeros(len(self.joints[j].z))
        for name in subset & self.shapes[j].keys():
            if sizes := [scored.sizes[name] for scored in parts if name in scored.sizes]:
                change = change + sum_responses(self.shapes[j][name], np.mean(sizes, 0))
        left = fit_faults(joint.z - change, joint.faults)
        return max(0.0, float(joint.loss.sum() - left.loss.sum()) + joint.price - left.price)


@dataclass
class ReferencePenalty:
    """Penalty of a subset of effects on a joint, with its gain on reference recordings.

    Attributes:
        known: Gains on the reference.
        joint: Penalty of each effect on each joint, unless one cause is behind it on all, nats.
        factor: On the gain on the reference.
        values: Penalties by joint and subset.
    """

    known: ReferenceScores
    joint: float
    factor: float
    values: dict[tuple[int, Subset], float] = field(default_factory=dict)

    def __call__(self, j: int, subset: Subset) -> float:
        """Return the penalty, nats."""
        if (j, subset) not in self.values:
            earned = self.factor * self.known.earned(j, subset)
            there = max(earned, self.known.repeated(j, subset))
            self.values[j, subset] = self.joint * len(subset - self.known.shared) + there
        return self.values[j, subset]

    def prepare(self, subsets: Sequence[Sequence[Subset]]) -> None:
        """Compute the penalties of the subsets of each joint."""
        self.known.simulate(frozenset().union(*(one for joint in subsets for one in joint)))

        def compute(j: int) -> list[float]:
            return [self(j, subset) for subset in subsets[j]]

        joints = range(len(subsets))
        for j, values in zip(joints, map_parallel(compute, joints), strict=True):
            for subset, value in zip(subsets[j], values, strict=True):
                self.values[j, subset] = value


SHARED_PLAY = 0.3
"""Relative difference of a joint's size from the shared one: forms differ between joints. Chosen by
hand; not searched."""

Rays = Mapping[str, Sequence[ParameterRay]]
Shapes = Sequence[Mapping[str, Sequence[Response]]]


def bind_shared_sizes(
    names: Subset, tables: Sequence[SubsetTable], grown: Rays, shapes: Shapes
) -> tuple[dict[str, list[ParameterRay]], list[dict[str, list[Response]]]]:
    """Return rays and shapes with those of the effects `names` bounded to about the size that the joints agree on."""
    rays = {name: list(ways) for name, ways in grown.items()}
    narrow: list[dict[str, list[Response]]] = []
    for mine in shapes:
        narrow.append({name: list(own) for name, own in mine.items()})
    for name in names:
        scored = [table.score(frozenset({name})) for table in tables if name in table.shapes]
        for place, ray in enumerate(rays[name]):
            size = np.array([one.sizes[name][place] for one in scored])
            # Gain over squared size is the information that a joint has about the size.
            gain = np.array([max(one.total, 0.0) for one in scored])
            told = gain / np.maximum(np.square(size), 1e-6)
            common = find_weighted_median(size, told)
            if common == 0.0:
                continue
            ends = np.sort(common * np.array([1.0 - SHARED_PLAY, 1.0, 1.0 + SHARED_PLAY]))
            rays[name][place] = replace(ray, sizes=ends, is_tied=True)
            for mine in narrow:
                if name in mine:
                    shape = mine[name][place]
                    changes = [shape.at(float(size))[0] for size in ends]
                    mine[name][place] = Response(ends, np.stack(changes))
    return rays, narrow


def find_weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the weighted median: a joint that has another effect too is far off."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])]) if below[-1] > 0 else 0.0
