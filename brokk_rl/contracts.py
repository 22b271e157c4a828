"""What the parts of the framework promise each other. Rooms meet only here; the config puts them together.

`brokk_rl.checks` holds a public checker for each contract, for our own entries and for those of
extensions.
Axes: `N` environments, `J` joints, `H` samples of history (oldest first), `K` numbers that describe
a target.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    import torch

    from brokk_rl.history import History
    from brokk_rl.machine import Machine
    from brokk_rl.record import Recording
    from brokk_rl.session import Session
    from brokk_rl.signals import Borehole, Command, Frame, JointState


class Mode(Protocol):
    """What `brokk mode=…` runs."""

    def run(self) -> float | None:
        """Does the work; returns the objective of a sweep, or `None`."""
        ...


class ActuatorModel(Protocol):
    """From the last `H` positions and commands to the next joint position, for all environments at once.

    A model with a state of its own (spool position, pressure) keeps it in tensors of fixed shape
    listed by `state`. `step` works without a host synchronisation and without data-dependent
    shapes, so that it can be captured in a CUDA graph.
    """

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Internal state by name, each of shape `(N, …)`; written in place. Empty for a model without memory."""
        ...

    def reset(self, mask: torch.Tensor) -> None:
        """Puts the environments of `mask`, shape `(N,)` bool, into the state of a machine at rest."""
        ...

    def step(self, history: History) -> torch.Tensor:
        """Returns the joint positions one control period later, shape `(N, J)` in rad or m.

        `history.u[:, -1]` is the command that has just come into force, `history.q[:, -1]` the
        position at this moment.
        """
        ...


class SensingModel(ActuatorModel, Protocol):
    """An actuator model that also says what is seen of the motion; what effects on sensors and geometry make of a model.

    A loop asks an actuator for `sides` (absent: none) and calls `measure` and `misplacement` only
    where they do something, once a control period, after `reset`. `step` is given true positions.
    """

    @property
    def sides(self) -> frozenset[str]:
        """`measurement` where `measure` matters, `kinematics` where `misplacement` does."""
        ...

    def measure(self, q: torch.Tensor) -> torch.Tensor:
        """Returns what the sensors say at the true positions `q`, `(N, J)`."""
        ...

    def truth(self, q: torch.Tensor) -> torch.Tensor:
        """Returns the likeliest true positions where the sensors say `q`, `(N, J)` or `(N, H, J)`."""
        ...

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Returns how far off the controller believes a target near the tool at the true positions `q`, `(N, 3)` in m."""
        ...


class Actuator(Protocol):
    """A spec in `conf/actuator`: builds an actuator model."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ActuatorModel:
        """Returns a model for `num_envs` environments on `device`."""
        ...


@dataclass(frozen=True)
class Segment:
    """A piece of an excitation: a pose and the commands that are played from it. Pure data for one machine.

    Attributes:
        name: What it is, different from all others of its plan, e.g. `ramps_q3_02`.
        start: Joint positions from which it is played, `(J,)`, rad or m.
        u: The program, `(T, J)` in [-1, 1]; row `k` is in force in control period `k`. Exclusive
            joints never together with others.
        stops: What happens when a joint is about to come to rest closer to its stop than
            `stop_margin`. `home`: everything goes
            back to `start` and waits until the program, which runs on by the clock, next passes
                zero. `inward`: this joint is
            driven the other way until its program next passes zero.
        stop_margin: Distance from the stops, as a part of the joint's travel.
        repeat_of: Name of an earlier segment of the same length, of which this one repeats what was
            really sent.
    """

    name: str
    start: np.ndarray
    u: np.ndarray
    stops: Literal["home", "inward"]
    stop_margin: float
    repeat_of: str | None = None


class Excitation(Protocol):
    """A spec in `conf/excitation`: commands that show what an actuator does. Numpy only: it also runs on the machine's computer."""

    def weight(self, before: float) -> float:
        """Returns its part of the time, relative to the others of the plan; those before it have `before` in all."""
        ...

    def segments(
        self,
        machine: Machine,
        duration_s: float,
        generator: np.random.Generator,
        before: Sequence[Segment],
    ) -> list[Segment]:
        """Returns segments whose programs last `duration_s` in all, or as much of it as whole segments fill.

        Args:
            machine: Gives limits, speeds, weights, and the joints that never move together with
                others.
            duration_s: Time for the programs, without the ways to their start poses.
            generator: The only source of chance.
            before: Segments that are already planned.

        Raises:
            ConfigError: not a single segment fits into `duration_s`.
        """
        ...


class ActuatorFit(Protocol):
    """A spec in `conf/fit`: learns an actuator model from recordings."""

    name: str
    """Name of the model in tables and files."""

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> Actuator:
        """Fits to `train`, chooses by `validation`, leaves what it learned in `folder`, returns the fitted actuator."""
        ...


class Effect(Protocol):
    """A spec in `conf/effect`: something a simulator leaves out; wraps an actuator model and is again one."""

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> ActuatorModel:
        """Returns `model` with the effect added; with the effect's neutral value nothing changes."""
        ...


class FollowerModel(Protocol):
    """From the command that the policy proposes to the one that is given, as a person at the levers does it, in `N` environments.

    `step` works without a host synchronisation and without data-dependent shapes, so that it can be
    captured in a CUDA graph.
    """

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Everything needed to go on exactly, by name, each `(N, …)`; written in place. Empty for a follower without memory."""
        ...

    def reset(self, mask: torch.Tensor) -> None:
        """Puts a new person at the levers in the environments of `mask`, shape `(N,)` bool, who has seen nothing yet."""
        ...

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Returns the command given during the coming control period, `(N, J)` in [-1, 1].

        `proposed`, `(N, J)`, is what the policy shows from now on. Where no proposal moves an
        exclusive joint together with others, what is given does not either.
        """
        ...


class Follower(Protocol):
    """A spec in `conf/follower`: builds what stands between policy and machine."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> FollowerModel:
        """Returns followers for `num_envs` environments on `device`."""
        ...


class World(Protocol):
    """Parallel physics: the machine, pushed along by its drive, beside a block with a borehole.

    All tensors are float32 on `device`, of fixed address, and refreshed in place by `step` and
    `reset`.
    """

    num_worlds: int
    device: torch.device
    q: torch.Tensor
    """Joint positions, `(N, J)`, rad or m."""
    contact_force_n: torch.Tensor
    """Peak force between tool and surroundings over the last control period, `(N,)`."""
    faults: torch.Tensor
    """Worlds that diverged, lost contacts to a full buffer, or became NaN since their last reset,
    `(N,)` bool."""
    supports_graphs: bool
    """True when `step` and `reset` may be captured in a CUDA graph."""

    def step(self, increment: torch.Tensor) -> None:
        """Advances one control period; the drive moves each joint by `increment`, `(N, J)`, unless something blocks it."""
        ...

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Puts the worlds of `mask`, `(N,)` bool, at rest at `q`, `(N, J)`, in the scenes of `scene`, `(N, S)`; see `sim.scene`."""
        ...

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Returns copies of everything that must be stored to go on exactly."""
        ...

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restores what `state_dict` returned."""
        ...


class Simulator(Protocol):
    """A spec in `conf/sim`: builds a world."""

    def build(self, machine: Machine, device: torch.device, num_worlds: int | None = None) -> World:
        """Returns a world on `device`; `num_worlds` overrides the configured number."""
        ...


@dataclass
class Transition:
    """What a task says about one control step; all of shape `(N,)`.

    Attributes:
        reward: Reward of the step.
        terminated: The episode ended by what happened (success, joint limit, …).
        timed_out: The episode ended by its time limit only.
        reason: Index into `TaskProcess.reasons` where the episode ended, else -1.
    """

    reward: torch.Tensor
    terminated: torch.Tensor
    timed_out: torch.Tensor
    reason: torch.Tensor


class TaskProcess(Protocol):
    """A task at work in `N` environments. No method synchronises with the host; all shapes are fixed."""

    num_actions: int
    max_episode_steps: int
    reasons: tuple[str, ...]
    """Names of the ways in which an episode can end."""
    state: dict[str, torch.Tensor]
    """Everything needed to go on exactly, by name, each `(N, …)`; written in place."""
    episode: dict[str, torch.Tensor]
    """Figures of the running episode, each `(N,)`; those that stand in `evaluation.json` have the
    names given there."""

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draws `count` valid starts: `q` `(count, J)`, `scene` `(count, S)` and whatever else `reset` needs."""
        ...

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begins a new episode in the environments of `mask` with the given starts, each entry `(N, …)`."""
        ...

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Turns the policy's action, `(N, num_actions)`, into valve commands `(N, J)`: bounds and the masks of exclusive joints."""
        ...

    def step(self, history: History, world: World) -> Transition:
        """Judges the control step that has just been simulated."""
        ...

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Returns the observation groups, called once a control step after `step` and `reset`.

        `history` is what sensors say; `shift_m`, `(N, 3)`, is how far off the target is believed
        (`SensingModel.misplacement`). `policy` is the vector of `brokk_rl.observation`; the tensors
        are the task's own and are overwritten by the next call.
        """
        ...

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the action, `(N, num_actions)`, with which the classical controller alone would act on these groups."""
        ...

    def describe(self) -> dict[str, Any]:
        """Returns `size`, order, scale and filters of the `policy` vector for the policy's contract, as plain JSON data."""
        ...

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Returns the policy as it runs on the machine: a module from the `policy` vector, `(B, …)`, to masked commands, `(B, J)`.

        `network` takes a dictionary of observation groups and returns the action.
        """
        ...


class Task(Protocol):
    """A spec in `conf/task`: builds a task process."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Returns the task for `num_envs` environments on `device`."""
        ...


class Policy(Protocol):
    """Anything that acts: a trained network, the classical controller, an untrained network."""

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the action for the observation groups, shape `(N, num_actions)`."""
        ...


@dataclass(frozen=True)
class TrialBatch:
    """Trials of a study, to be done side by side in numpy.

    Attributes:
        q: Joint positions from which each begins, `(N, J)`.
        rim_in_base_m: Centre of the rim of its hole, `(N, 3)`.
        radius_m: Radius of its hole, `(N,)`.
        guided: Whether advice is shown, `(N,)` bool.
        limit_s: Time after which each ends at the latest.
        depth_m: Depth of the tip below the rim at which the tool is in.
        clearance_m: Distance of the tip from the hole's axis within which it is.
    """

    q: np.ndarray
    rim_in_base_m: np.ndarray
    radius_m: np.ndarray
    guided: np.ndarray
    limit_s: float
    depth_m: float
    clearance_m: float


@dataclass(frozen=True)
class OperatorView:
    """What simulated operators can see at the start of a control period, numpy.

    Attributes:
        q: Joint positions, `(N, J)`.
        rim_in_base_m: Centre of the hole's rim, `(N, 3)`; how well it is seen is the operator's
            matter.
        advice: Commands that are advised, `(N, J)`; NaN where none is shown.
    """

    q: np.ndarray
    rim_in_base_m: np.ndarray
    advice: np.ndarray


class OperatorModel(Protocol):
    """Simulated operators at the levers of `N` machines, in numpy; one control period a call."""

    def step(self, view: OperatorView) -> np.ndarray:
        """Returns the commands given during the coming period, `(N, J)` in [-1, 1]; exclusive joints never together with others."""
        ...


class Operator(Protocol):
    """A spec in `conf/operator`: a kind of simulated operator."""

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """Returns operators at work; `persons`, `(N,)`, numbers them: the same number and seed is the same person."""
        ...


class TrialGround(Protocol):
    """A spec in `conf/ground`: where simulated operators do trials."""

    def run(
        self, machine: Machine, session: Session, trials: TrialBatch, operators: OperatorModel
    ) -> list[Recording]:
        """Does the trials; returns a recording of each, in order, with advice where it was shown."""
        ...


class BoreholeFinder(Protocol):
    """Finds the borehole in a frame."""

    def find(self, frame: Frame) -> Borehole | None:
        """Returns the borehole in the base frame, or `None` when there is none to be sure of."""
        ...


class PerceptionBackend(Protocol):
    """A spec in `conf/perception`: builds a finder."""

    def build(self) -> BoreholeFinder:
        """Returns a finder."""
        ...


@runtime_checkable
class Link(Protocol):
    """The open connection to a machine, real or simulated; a context manager.

    Arrays are `(J,)`, or `(N, J)` where a simulated link drives `N > 1` machines side by side.
    Leaving the context brings the machine to a standstill. A link may have `extra() -> dict[str,
    float | array (N,)]`: more columns of the recording (`oil_c`).
    """

    def read(self) -> JointState:
        """Returns the newest measured state; its `t_s` is the clock by which the control periods are counted."""
        ...

    def send(self, command: Command) -> Command:
        """Sends a command and returns the command that was really sent."""
        ...

    def __enter__(self) -> Link: ...

    def __exit__(self, *exc: Any) -> None: ...


class Connection(Protocol):
    """A spec in `conf/link`: how to reach a machine."""

    @property
    def source(self) -> str:
        """What recordings say they come from."""
        ...

    def build(self, machine: Machine, num_runs: int, session: Session) -> Link:
        """Returns a link, not yet opened, to `num_runs` machines side by side; its random numbers come from the session's streams.

        Raises:
            ConfigError: there are not as many machines.
        """
        ...
