"""Termination terms: specs that say when an episode ends.

A task lists its terms by name in its YAML (`task.termination`). `null` switches a term off. The
names are counted in `evaluation.json` and in the logs of a training. Where several terms hold in
one step, the first one counts; a time limit counts last.

A term of one's own is a spec with `outcome` and `__call__`, or a function under `TerminationTerm`.
This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

from brokk_rl.bounds import require_number, require_range
from brokk_rl.contracts.task import FAULT
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from tasks.step_state import StepState

if TYPE_CHECKING:
    import torch

Outcome = Literal["success", "failure", "void", "time"]
"""Meaning of an ending. `success`: the task is done. `failure`: reward terms see `failed`. `void`:
the episode counts for nothing, and its last step has no reward. `time`: the learner estimates what
would have followed, as `time_out` does in other libraries."""


class Termination(Protocol):
    """A termination term."""

    @property
    def outcome(self) -> str:
        """An `Outcome`; most terms have it as a class attribute."""
        ...

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the episode ends, `(N,)` bool; no host synchronisation."""
        ...


@spec
class Succeeded:
    """The task's strict criterion holds."""

    outcome = "success"

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the criterion holds; see `Termination`."""
        return state.success


@spec
class JointLimit:
    """A joint comes near its limit.

    Attributes:
        margin: Distance from the limit at which the episode ends, rad or m.
    """

    margin: float

    outcome = "failure"

    def check(self) -> None:
        require_number("margin of the termination JointLimit", self.margin)

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where a joint is that near; see `Termination`."""
        lower, upper = state.lower + self.margin, state.upper - self.margin
        return ((state.q < lower) | (state.q > upper)).any(1)


@spec
class StartInContact:
    """The arm touches something in the first step: the start was not valid."""

    outcome = "void"

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the first step has a contact; see `Termination`."""
        return state.is_first & (state.contact_force_n > 0)


@spec
class ContactForce:
    """The tool presses harder than it may.

    Attributes:
        largest_n: Peak contact force beyond which the episode ends.
    """

    largest_n: float

    outcome = "failure"

    def check(self) -> None:
        require_number("largest_n of the termination ContactForce", self.largest_n, above=0)

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the force is larger; see `Termination`."""
        return state.contact_force_n > self.largest_n


@spec
class TipLeft:
    """The tool point leaves a box in the base frame.

    Attributes:
        x_m: Range of the box along x, (lowest, highest).
        y_m: Range along y.
        z_m: Range along z.
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    z_m: tuple[float, float]

    outcome = "failure"

    def check(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            require_range(f"{name} of the termination TipLeft", getattr(self, name))

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the tool point is outside; see `Termination`."""
        outside = state.is_first & False
        for axis, (low, high) in enumerate((self.x_m, self.y_m, self.z_m)):
            along = state.tip_m[:, axis]
            outside = outside | (along < low) | (along > high)
        return outside


@spec
class TimeLimit:
    """The time of the episode, `task.episode_s`, is over."""

    outcome = "time"

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the time is over; see `Termination`."""
        return state.steps >= state.max_steps


@spec
class TerminationTerm:
    """A function of one's own.

    Attributes:
        function: `package.module:function` from `StepState` to `(N,)` bool.
        outcome: Meaning of the ending; see `Outcome`.
    """

    function: str
    outcome: Outcome

    def check(self) -> None:
        require_function("termination term", self.function)

    def __call__(self, state: StepState) -> torch.Tensor:
        """Return where the function holds; see `Termination`."""
        return resolve_name(self.function)(state)


def require_function(kind: str, function: str) -> None:
    """Refuse a name that is not `package.module:function`; `kind` names the term in the message."""
    try:
        found = resolve_name(function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"{kind} '{function}' cannot be found ({error}); expected package.module:function"
        ) from error
    if not callable(found):
        raise ConfigError(f"{kind} '{function}' is no function; expected package.module:function")


def check_terminations(terms: Mapping[str, Termination | None]) -> None:
    """Refuse terms without an outcome or a call, the name `fault`, and a task without a time limit."""
    outcomes = set()
    for name, term in terms.items():
        if term is None:
            continue
        outcome = getattr(term, "outcome", None)
        if outcome not in get_args(Outcome) or not callable(term):
            raise ConfigError(
                f"task.termination.{name}: {type(term).__name__} is no termination term; expected a "
                "spec with `outcome` and `__call__`, see tasks.termination"
            )
        outcomes.add(outcome)
    if FAULT in terms:
        raise ConfigError(f"task.termination.{FAULT}: the simulator's own faults have this name")
    if "time" not in outcomes:
        raise ConfigError(
            "task.termination: expected a time limit; give "
            "task.termination.time_limit={_target_: tasks.termination.TimeLimit}"
        )


@dataclass(frozen=True)
class Endings:
    """Endings of one control step, all of shape `(N,)`.

    Attributes:
        terminated: The episode ended by an event, bool.
        timed_out: The episode ended by time only, bool.
        is_sound: The step counts: neither a fault nor a void episode, bool.
        reason: Index into `EpisodeTerms.reasons`, -1 while the episode goes on.
    """

    terminated: torch.Tensor
    timed_out: torch.Tensor
    is_sound: torch.Tensor
    reason: torch.Tensor


class EpisodeTerms:
    """Terms of a task, in the order in which they count.

    Attributes:
        terms: By name, those that are switched on.
        reasons: Names of all endings: events in the order of the YAML, faults of the world, time.
    """

    def __init__(self, terms: Mapping[str, Termination | None]) -> None:
        self.terms = {name: term for name, term in terms.items() if term is not None}
        # found once: a compiled step cannot import
        self._functions: dict[str, Callable[[Any], torch.Tensor]] = {}
        for name, term in self.terms.items():
            is_named = isinstance(term, TerminationTerm)
            self._functions[name] = resolve_name(term.function) if is_named else term
        events = tuple(name for name, term in self.terms.items() if term.outcome != "time")
        self.reasons = (*events, FAULT, *(name for name in self.terms if name not in events))

    def judge(self, state: StepState, faults: torch.Tensor) -> Endings:
        """Return the endings; completes `state.success` and `state.failed`.

        Args:
            state: After the step; `success` is the criterion alone.
            faults: Worlds that diverged, `(N,)` bool.
        """
        held = {FAULT: faults}
        unsound = faults
        for name, _ in self._having("void"):
            held[name] = self._functions[name](state)
            unsound = unsound | held[name]
        state.success = state.success & ~unsound
        terminated, timed_out = unsound, unsound & False
        failed = timed_out
        for name, term in self._having("success", "failure", "time"):
            held[name] = self._functions[name](state)
            if term.outcome == "time":
                timed_out = timed_out | held[name]
                continue
            terminated = terminated | held[name]
            if term.outcome == "failure":
                failed = failed | held[name]
        state.failed = failed
        reason = state.contact_force_n.new_full(faults.shape, -1.0)
        for index in reversed(range(len(self.reasons))):
            reason = reason.masked_fill(held[self.reasons[index]], float(index))
        return Endings(
            terminated=terminated,
            timed_out=timed_out & ~terminated,
            is_sound=~unsound,
            reason=reason,
        )

    def describe(self) -> dict[str, Any]:
        """Return the terms beyond success and time by name, as plain JSON data, for `policy.json`."""
        described: dict[str, Any] = {}
        for name, term in self._having("failure", "void"):
            described[name] = {"term": type(term).__name__} | asdict(term)  # type: ignore[call-overload]
        return described

    def find_joint_margin(self) -> float | None:
        """Return the margin of the joint limits, `None` where they do not end an episode."""
        margins = [term.margin for term in self.terms.values() if isinstance(term, JointLimit)]
        return max(margins, default=None)

    def _having(self, *outcomes: Outcome) -> list[tuple[str, Termination]]:
        return [(name, term) for name, term in self.terms.items() if term.outcome in outcomes]
