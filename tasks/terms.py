"""State after a control step, and the terms of tasks: functions of that state.

A task lists its rewards, observations, endings, figures and criteria in its YAML, each by the name
of a function (`tasks.terms:progress`) with its parameters; see `tasks.term_task`. The result is
`(N,)` unless the docstring says otherwise. Rewards, endings and figures see the machine itself.
Observation terms get joints and tool as sensors measure them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from brokk_rl.history import History


@dataclass
class StepState:
    """State of every task after a control step; `N` environments, `J` joints.

    Rewards, endings and figures see the machine itself. Observation terms see what sensors measure,
    and neither `success` nor `failed`.

    Attributes:
        history: The last positions and the commands given, `(N, H, J)` each, oldest first.
        lower: Lower joint limits, `(J,)`.
        upper: Upper joint limits, `(J,)`.
        tip_m: Tool point in the base frame, `(N, 3)`.
        pitch_rad: Pitch of the tool, `(N,)`.
        u: Commands that the policy asked for in this step, `(N, J)`, in [-1, 1].
        u_before: Those of the step before, `(N, J)`.
        contact_force_n: Peak contact force of the step, `(N,)`.
        peak_force_n: The largest of the episode's steps before, `(N,)`.
        steps: Control steps of the episode as the time limit counts them, `(N,)`.
        max_steps: Time limit of an episode, control steps.
        age: Control steps since the start of the episode, `(N,)`.
        period_s: Control period.
        start: What was drawn for the episode, `(N, …)` each, by name: `q`, `scene`, `tip_m`, and
            what the task asks for.
        success: The task's criterion holds, `(N,)` bool.
        failed: The episode ends by a failure, such as a joint limit, `(N,)` bool.
        held_share: Part of the counted steps in which a `HeldCriterion` held, `(N,)`.
    """

    history: History
    lower: torch.Tensor
    upper: torch.Tensor
    tip_m: torch.Tensor
    pitch_rad: torch.Tensor
    u: torch.Tensor
    u_before: torch.Tensor
    contact_force_n: torch.Tensor
    peak_force_n: torch.Tensor
    steps: torch.Tensor
    max_steps: int
    age: torch.Tensor
    period_s: float
    start: dict[str, torch.Tensor]
    success: torch.Tensor
    failed: torch.Tensor
    held_share: torch.Tensor

    @property
    def q(self) -> torch.Tensor:
        """Joint positions, `(N, J)`, rad or m."""
        return self.history.q[:, -1]

    @property
    def is_first(self) -> torch.Tensor:
        """True where the episode began just before this step, `(N,)` bool."""
        return self.age == 1

    @property
    def time_s(self) -> torch.Tensor:
        """Time since the start of the episode, `(N,)`."""
        return self.age * self.period_s

    @property
    def speed(self) -> torch.Tensor:
        """Joint speeds over the last control period, `(N, J)`, rad/s or m/s."""
        return (self.history.q[:, -1] - self.history.q[:, -2]) / self.period_s


@dataclass
class ToolState(StepState):
    """State of a task that moves the tool to a pose.

    Attributes:
        target_m: Target point of the controller, `(N, 3)`.
        target_pitch_rad: Wanted pitch, `(N,)`.
        reach_m: Distance by which the switch decides, `(N,)`.
        reach_range_m: Good working range (nearest, farthest).
        positioning: Whether only the exclusive joints could move in this step, `(N,)` bool.
        reached: The tool is where the task wants it, `(N,)` bool; `success` asks for more.
        inserted: The same for the present hole of a row (`tasks.hole_row`), `(N,)` bool.
        paper_success: The paper's criterion holds, `(N,)` bool.
        closeness: How near the task is to done, 0 to about 1, `(N,)`.
        closeness_before: The same one step earlier.
        lateral_m: Distance of the tool point from the hole's axis, in the open from the vertical
            through the target, `(N,)`.
    """

    target_m: torch.Tensor
    target_pitch_rad: torch.Tensor
    reach_m: torch.Tensor
    reach_range_m: tuple[float, float]
    positioning: torch.Tensor
    reached: torch.Tensor
    inserted: torch.Tensor
    paper_success: torch.Tensor
    closeness: torch.Tensor
    closeness_before: torch.Tensor
    lateral_m: torch.Tensor

    @property
    def distance_m(self) -> torch.Tensor:
        """Distance from the tool point to the target, `(N,)`."""
        return (self.target_m - self.tip_m).norm(dim=1)

    @property
    def pitch_error_rad(self) -> torch.Tensor:
        """Size of the pitch error, `(N,)`."""
        return (self.target_pitch_rad - self.pitch_rad).abs()


# observations


def joint_positions(state: StepState) -> torch.Tensor:
    """Positions within the travel, -1 at the lower and 1 at the upper limit, `(N, J)`."""
    return (2.0 * state.q - state.lower - state.upper) / (state.upper - state.lower)


def commands(state: StepState) -> torch.Tensor:
    """Valve commands in force, `(N, J)`, in [-1, 1]."""
    return state.history.u[:, -1]


def tip_position(state: StepState) -> torch.Tensor:
    """Tool point in the base frame, `(N, 3)`, m."""
    return state.tip_m


def tool_pitch(state: StepState) -> torch.Tensor:
    """Pitch of the tool below the horizontal, `(N,)`, rad."""
    return state.pitch_rad


def drawn(state: StepState, name: str) -> torch.Tensor:
    """Numbers that were drawn for the episode under a name of `task.command`, `(N, K)`."""
    return state.start[name]


def time_share(state: StepState) -> torch.Tensor:
    """Part of the time limit that is over, `(N,)`."""
    return state.steps / state.max_steps


# figures


def success(state: StepState) -> torch.Tensor:
    """The task's criterion holds."""
    return state.success


def time(state: StepState) -> torch.Tensor:
    """Time since the start of the episode, s."""
    return state.time_s


def contact_force(state: StepState) -> torch.Tensor:
    """Peak contact force of the control period, N."""
    return state.contact_force_n


def valve_travel(state: StepState) -> torch.Tensor:
    """Sum over joints of the change of the given commands, per second."""
    given = state.history.u
    return (given[:, -1] - given[:, -2]).abs().sum(1) / state.period_s


def held_share(state: StepState) -> torch.Tensor:
    """Part of the counted control steps in which the criterion held."""
    return state.held_share


def reached(state: ToolState) -> torch.Tensor:
    """The tool is where the task wants it, however hard and tilted."""
    return state.reached


def paper_success(state: ToolState) -> torch.Tensor:
    """The paper's criterion holds."""
    return state.paper_success


def lateral_error(state: ToolState) -> torch.Tensor:
    """Distance of the tool point from the hole's axis, m."""
    return state.lateral_m


# endings


def joint_limit(state: StepState, margin: float) -> torch.Tensor:
    """A joint comes within `margin` of its limit, rad or m."""
    lower, upper = state.lower + margin, state.upper - margin
    return ((state.q < lower) | (state.q > upper)).any(1)


def start_in_contact(state: StepState) -> torch.Tensor:
    """The arm touches something in the first step: the start was not valid."""
    return state.is_first & (state.contact_force_n > 0)


def force_limit(state: StepState, largest_n: float) -> torch.Tensor:
    """The tool presses harder than it may."""
    return state.contact_force_n > largest_n


def time_limit(state: StepState) -> torch.Tensor:
    """The time of the episode, `task.episode_s`, is over."""
    return state.steps >= state.max_steps


# rewards: the six terms of the paper's equation 1, with the symbol of each


def working_distance(state: ToolState, edge: float) -> torch.Tensor:
    """r^m: while positioning, `edge` at the edge of the good working range, less outside."""
    near, far = state.reach_range_m
    outside = (state.reach_m - far).clamp(min=0.0) + (near - state.reach_m).clamp(min=0.0)
    return state.positioning * edge / (1.0 + outside)


def distance(state: ToolState) -> torch.Tensor:
    """r^d: 1 / (1 + distance of the tool to the target in m), once not positioning."""
    return ~state.positioning / (1.0 + state.distance_m)


def pitch(state: ToolState) -> torch.Tensor:
    """r^o: 1 / (1 + pitch error in rad), once not positioning."""
    return ~state.positioning / (1.0 + state.pitch_error_rad)


def insertion(state: ToolState) -> torch.Tensor:
    """r^i: r^d + r^o while the paper's criterion of success holds (weighted five times there)."""
    return (state.paper_success & ~state.positioning) * (
        1.0 / (1.0 + state.distance_m) + 1.0 / (1.0 + state.pitch_error_rad)
    )


def far_contact(state: ToolState, largest: float) -> torch.Tensor:
    """r^c: contact force in N while the tool is far from the hole: r^d at most `largest`."""
    far = 1.0 / (1.0 + state.distance_m) <= largest
    return (far & ~state.positioning) * state.contact_force_n


def approach_command_change(state: ToolState) -> torch.Tensor:
    """r^a: sum over joints of the change of command since the last step, once not positioning."""
    return ~state.positioning * command_change(state)


# beyond the paper


def command_change(state: StepState) -> torch.Tensor:
    """Sum over joints of the change of command since the last step, in all phases."""
    return (state.u - state.u_before).abs().sum(1)


def progress(state: ToolState) -> torch.Tensor:
    """Gain of closeness.

    A potential: it speeds up learning and leaves the best policy as it is (Ng et al. 1999).
    """
    return state.closeness - state.closeness_before


def failure(state: ToolState) -> torch.Tensor:
    """One plus the closeness that is given up when the episode ends by a failure."""
    return state.failed * (1.0 + state.closeness)


def contact(state: StepState, most_n: float) -> torch.Tensor:
    """Contact force in kN up to `most_n`: a hydraulic arm can break an obstacle."""
    return (state.contact_force_n / 1000.0).clamp(max=most_n / 1000.0)


def peak_contact(state: StepState, above_n: float, most_n: float) -> torch.Tensor:
    """Growth of the episode's peak contact force in kN, between two forces.

    An episode pays for its hardest blow, not for the time it leans on the rim: a penalty of every
    step in contact teaches a beginner to stay away from the hole.
    """
    peak_n = state.peak_force_n.maximum(state.contact_force_n)
    grown_n = peak_n.clamp(above_n, most_n) - state.peak_force_n.clamp(above_n, most_n)
    return grown_n / 1000.0


def duration(state: StepState) -> torch.Tensor:
    """One in each step."""
    return state.contact_force_n.new_ones(state.contact_force_n.shape)
