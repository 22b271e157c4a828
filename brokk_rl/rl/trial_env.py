"""Trials of simulated operators: the simulated machine beside its block, all trials at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brokk_rl.commands import accept_speeds
from brokk_rl.contracts.actuator import Actuator, Effect, FollowerModel
from brokk_rl.contracts.operator import OperatorModel, OperatorView, TrialBatch
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import describe_task
from brokk_rl.progress import track_items
from brokk_rl.record import Recording
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.session import Session
from brokk_rl.spec import spec

Rows = list[np.ndarray]


@spec
class SimulatedTrials:
    """The simulated machine and block, with the policy that advises.

    Attributes:
        sim: Physics.
        task: The task that the policy advises for; holes and starts are the study's.
        actuator: How commands become motion.
        effect: Effects around the actuator model, by name.
        policy: Who advises, a spec of `conf/policy`.
        assumed: Hands of the operator as the advice assumes them; the task's advice takes its
            numbers from here.
        noise: Standard deviation of recorded positions, rad or m.
        settle_s: Time for which a recording goes on after the insertion.
    """

    sim: Simulator
    task: Task
    actuator: Actuator
    effect: dict[str, Effect]
    policy: Any
    assumed: Any
    noise: float
    settle_s: float

    def run(
        self, machine: Machine, session: Session, trials: TrialBatch, operators: OperatorModel
    ) -> list[Recording]:
        """Run all trials; see `brokk_rl.contracts.operator.TrialGround`."""
        # A few hundred trials are as fast on a CPU, and operators are numpy.
        device = torch.device("cpu")
        torch.manual_seed(session.stream("ground"))
        num = len(trials.q)
        world = self.sim.build(machine, device, num)
        model = self.actuator.build(machine, num, device)
        for effect in self.effect.values():
            model = effect.wrap(model, machine, num, device)
        model = accept_speeds(model, machine, num, device)
        levers = OperatorLevers(operators, trials.guided)
        task = self.task.build(machine, num, device)
        starts = {}
        for key, value in task.starts(1, 0).items():
            starts[key] = value[:1].expand(num, *value.shape[1:]).clone()
        loop = ControlLoop(
            machine,
            world,
            model,
            levers,
            task,
            starts | _make_starts(machine, trials),
            describe_task(self.task),
        )
        if task.max_episode_steps * machine.period_s < trials.limit_s:
            raise ConfigError(
                "ground.task.episode_s: expected at least the trials' limit of "
                f"{trials.limit_s:g} s"
            )
        if "start.target_m" not in task.state:
            raise ConfigError(
                f"ground.task: operators steer to a target, but {type(self.task).__name__} has no "
                "state 'start.target_m'; choose task=borehole_insertion"
            )
        levers.loop = loop
        return self._drive(loop, levers, session, trials)

    def _drive(
        self, loop: ControlLoop, levers: OperatorLevers, session: Session, trials: TrialBatch
    ) -> list[Recording]:
        machine, policy = loop.machine, self.policy.build(loop, session.seed)
        loop.begin(loop.starts)
        running = np.ones(len(trials.q), bool)
        rows: dict[str, Rows] = {
            "q": [loop.history.q[:, -1].numpy().copy()],
            "force_n": [np.zeros(len(trials.q))],
            "running": [running.copy()],
        }
        groups = loop.get_observations()
        steps, left = (
            round(trials.limit_s / machine.period_s),
            np.full(len(trials.q), round(self.settle_s / machine.period_s)),
        )
        for _ in track_items(range(steps), "simulated operators at work"):
            groups, _, done, _ = loop.step(policy.act(dict(groups.items())))  # type: ignore[arg-type]
            rows["q"].append(loop.end_q.numpy().copy())
            rows["force_n"].append(loop.end_force_n.numpy().copy())
            left = left - (loop.task.episode["success_strict"].numpy() > 0)
            running &= ~done.numpy() & (left > 0)
            rows["running"].append(running.copy())
            if not running.any():
                break
        return _make_recordings(
            machine,
            {name: np.stack(part) for name, part in rows.items()},
            levers,
            session,
            trials,
            self.noise,
        )


class OperatorLevers(FollowerModel):
    """Operators in the place of a follower: they see arm, hole and proposal, and give the commands.

    Args:
        operators: The operators.
        guided: In which trials the proposal is shown, `(N,)` bool.
    """

    def __init__(self, operators: OperatorModel, guided: np.ndarray) -> None:
        self._operators, self._guided = operators, guided
        self.loop: ControlLoop | None = None
        self.given: Rows = []
        self.shown: Rows = []

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Empty: nothing can be restored, trials are done once."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Do nothing: a trial that is over stays over."""

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the commands of the operators, `(N, J)`, who are shown `proposed`, `(N, J)`."""
        assert self.loop is not None
        q = self.loop.history.q[:, -1].numpy().astype(float)
        rim_m = self.loop.task.state["start.target_m"].numpy().astype(float)
        advice = np.where(self._guided[:, None], proposed.numpy(), np.nan)
        given = self._operators.step(OperatorView(q=q, rim_in_base_m=rim_m, advice=advice))
        self.shown.append(advice.astype(np.float32))
        self.given.append(given.astype(np.float32))
        return torch.as_tensor(self.given[-1])


def _make_starts(machine: Machine, trials: TrialBatch) -> dict[str, torch.Tensor]:
    """Return starts of the control loop at the study's places; the block faces the machine."""
    num, rim = len(trials.q), trials.rim_in_base_m
    scene = np.column_stack((rim, np.arctan2(rim[:, 1], rim[:, 0]), np.ones(num), trials.radius_m))
    made: dict[str, Any] = {
        "q": trials.q,
        "scene": scene,
        "target_m": rim,
        "closeness": np.zeros(num),
    }
    return {name: torch.as_tensor(value, dtype=torch.float32) for name, value in made.items()}


def _make_recordings(
    machine: Machine,
    rows: dict[str, np.ndarray],
    levers: OperatorLevers,
    session: Session,
    trials: TrialBatch,
    noise: float,
) -> list[Recording]:
    given, shown = np.stack(levers.given), np.stack(levers.shown)
    generator = session.generator("ground noise")
    found = []
    for n in range(len(trials.q)):
        num = int(rows["running"][:, n].sum())  # samples from which a command was in force
        num = min(num, len(given))
        q = rows["q"][: num + 1, n] + noise * generator.standard_normal(
            (num + 1, machine.num_joints)
        )
        advice = np.concatenate((shown[:num, n], shown[num - 1 : num, n]))
        extra = {"force_n": rows["force_n"][: num + 1, n]}
        extra |= {
            f"target_{axis}_m": np.full(num + 1, trials.rim_in_base_m[n, i])
            for i, axis in enumerate("xyz")
        }
        if trials.guided[n]:
            extra |= {f"advice_{name}": advice[:, j] for j, name in enumerate(machine.joint_names)}
        found.append(
            Recording(
                machine=machine.name,
                joints=machine.joint_names,
                units=tuple(joint.unit for joint in machine.joints),
                rate_hz=1.0 / machine.period_s,
                t_s=np.arange(num + 1) * machine.period_s,
                u=np.concatenate((given[:num, n], np.zeros((1, machine.num_joints), np.float32))),
                q=q.astype(np.float32),
                extra=extra,
                metadata={
                    "source": "simulated operator, simulated machine",
                    "seed": str(session.seed),
                },
            )
        )
    return found
