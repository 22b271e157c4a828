"""Model-predictive control by sampling (MPPI), through an actuator model and the kinematics.

The opponent that knows a model: what a controller can do that plans in the simulator in which a policy
learns. Williams et al., "Information theoretic MPC for model-based reinforcement learning", ICRA 2017.
It sees the policy's observation and nothing else: the measured history and the estimated target.

Each control step

1. predicts the motion of the commands that are still in the dead time;
2. draws `num_samples` sequences of joint speeds around the last plan, shifted by a step, with noise that
   is linear between knots: a quarter of them in the joints, the others in motions of the tool, of sizes
   spread evenly on a logarithmic scale. A few are fixed: the plan itself, rest, the classical command
   for a short and for a long time. The valve map of the classical controller turns speeds into
   commands;
3. predicts each of them and adds up its cost: distance from the hole's axis, height, pitch, the cone
   above the hole in which the classical controller descends, joint ends, changes of command; while
   positioning the distance of the reach from the middle of the working range;
4. takes the mean of the sequences, weighted by `exp(-cost)`, and gives its first command.

Contact is not predicted: the tip is to stay above the cone, which ends at the hole.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from brokk_rl.bounds import require_number
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.contracts.task import Policy
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.spec import spec
from tasks.process import ToolPoseProcess

PITCH_M_RAD = 0.4
"""Cost of a pitch error of 1 rad as a distance, m. Chosen by hand: the distance of tip and joint q5 is
1.2 m, and it matters less on the way."""
FINE_M, FINE_SCALE_M, FINE_SCALE_RAD = 0.05, 0.015, 0.03
"""Cost of any misalignment, m, and the errors at which it saturates. Chosen by hand: about the hole's
clearance of 0.01 m."""
HEIGHT_COST, CONE_COST = 0.5, 4.0
"""Cost per metre of height over the target, and below the cone, against that of lateral error. Chosen by
hand: it descends as soon as the cone lets it, and does not buy height with misalignment."""
END_COST_M_RAD = 5.0
"""Cost per rad (or m) beyond the joint margin of the classical controller. Chosen by hand."""
NUM_FIXED = 4
"""Samples that are not drawn: the plan, rest, the classical command for `SHORT_STEPS` and throughout."""
SHORT_STEPS = 4
"""Control steps of the short classical sample; chosen by hand."""
FINEST = 0.03
"""Size of the finest noise, of the coarsest. Chosen by hand: near the hole small corrections count."""
RIM_M, EDGE_M = 0.02, 0.008
"""Height of the cone's end above the rim, and lateral error over which it opens. Chosen by hand: noise of
the estimate, and the clearance of the hole."""
TOOL_SPEED_M_S = 0.6
"""Noise of motions of the tool, m/s and rad/s for a full share. Chosen by hand: its top speed."""
PROBE_M = 0.001
"""Error by which the linear map from tool to joint speeds is read off the classical controller."""


@spec
class PredictivePolicy:
    """Sampling model-predictive control (MPPI) through an actuator model.

    Attributes:
        actuator: Model through which it predicts; the machine itself may be another one.
        num_samples: Sequences of commands per environment and iteration.
        iterations: Refinements of the plan in each control step.
        horizon_s: Time over which commands are planned, beyond the dead time.
        num_knots: Knots of the noise over the horizon.
        spread: Standard deviation of the noise, of full command.
        temperature: Of the weights, over the mean excess of the costs; smaller is greedier.
        last: Weight of the cost at the end of the horizon against that of the mean over it.
        change: Cost of changing a command by full stroke.
    """

    actuator: Actuator
    num_samples: int
    iterations: int
    horizon_s: float
    num_knots: int
    spread: float
    temperature: float
    last: float
    change: float

    label: ClassVar[str] = "mpc"

    def check(self) -> None:
        require_number("policy.num_samples", self.num_samples, least=NUM_FIXED + 1)
        require_number("policy.iterations", self.iterations, least=1)
        require_number("policy.num_knots", self.num_knots, least=2)
        for name in ("horizon_s", "spread", "temperature"):
            require_number(f"policy.{name}", getattr(self, name), above=0)
        for name in ("last", "change"):
            require_number(f"policy.{name}", getattr(self, name), least=0)

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy; its noise is drawn from `seed`.

        Raises:
            ConfigError: The task is no tool-pose task, or a person stands between.
        """
        if not isinstance(loop.task, ToolPoseProcess) or loop.task.options.advice is not None:
            raise ConfigError(
                f"policy=mpc: it plans for tool-pose tasks without a person at the levers, not for "
                f"{type(loop.task).__name__}; choose task=borehole_insertion or goal_pose and "
                "follower=none"
            )
        return PredictivePlanner(self, loop, loop.task, seed)


class PredictivePlanner:
    """The planner at work in `N` environments; `plan`, speeds `(N, T, J)`, is its only memory."""

    def __init__(
        self, config: PredictivePolicy, loop: ControlLoop, task: ToolPoseProcess, seed: int
    ) -> None:
        self._config, self._task, self._control = config, task, task.control
        machine, device = loop.machine, loop.device
        self._num_steps = max(config.num_knots, round(config.horizon_s / machine.period_s))
        self._dead_steps = min(
            math.ceil(machine.dead_time_s / machine.period_s - 1e-6), machine.num_history - 1
        )
        num = loop.num_envs
        self._ahead = config.actuator.build(machine, num, device)
        self._sampled = config.actuator.build(machine, num * config.num_samples, device)
        self.plan = torch.zeros(num, self._num_steps, machine.num_joints, device=device)
        self._generator = torch.Generator(device).manual_seed(seed)
        margin = task.options.classical.margin_rad
        self._lower = torch.as_tensor(machine.lower + margin, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper - margin, dtype=torch.float32, device=device)
        self._knots = _make_hat_functions(config.num_knots, self._num_steps).to(device)

    @torch.no_grad()
    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the action of which the task makes the planned command, `(N, J)`."""
        control, task = self._control, self._task
        target_m, q, u = control.encoder.decode(groups["policy"])
        pitch_rad = task.state["start.target_pitch_rad"]
        seen = control.process(target_m, q, u, pitch_rad, None)
        begins = (u == 0).all(2).all(1)[:, None, None]
        kept = torch.cat((self.plan[:, 1:], self.plan[:, -1:]), 1)
        free = mask_exclusive_joints(control.exclusive, seen.positioning)
        plan = torch.where(begins, 0.0, kept) * free[:, None]
        history = self._predict_dead_time(q, u)
        for _ in range(self._config.iterations):
            samples = self._draw(plan, seen.guidance.command * free, history.q[:, -1])
            samples = samples * free[:, None, None]
            commands = control.controller.valve(samples)
            path = self._predict(history, commands)
            cost = self._rate(path, commands, u[:, -1], target_m, pitch_rad, seen.positioning)
            excess = cost - cost.amin(1, keepdim=True)
            scale = self._config.temperature * excess.mean(1, keepdim=True) + 1e-9
            weight = torch.softmax(-excess / scale, 1)
            plan = (weight[..., None, None] * samples).sum(1)
        self.plan.copy_(plan)
        command, action = control.controller.valve(self.plan[:, 0]), task.options.action
        base = groups["guide"][:, : command.shape[1]] if action.kind == "residual" else 0.0
        return (command - base) / action.scale

    def _draw(self, plan: torch.Tensor, classical: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return sequences of speeds, of full speed, `(N, K, T, J)`, around `plan`, `(N, T, J)`.

        Args:
            plan: The last plan.
            classical: Command of the classical controller, `(N, J)`.
            q: Positions at which the commands begin to act, `(N, J)`.
        """
        config, controller = self._config, self._control.controller
        shape = (len(plan), config.num_samples, config.num_knots, plan.shape[2])
        noise = torch.randn(shape, device=plan.device, generator=self._generator)
        first = config.num_samples // 4
        tool = TOOL_SPEED_M_S * noise[:, first:, :, :4]
        noise[:, first:] = torch.einsum("njc,nskc->nskj", self._map_tool_speed(q), tool)
        exponent = torch.arange(config.num_samples, device=plan.device) / config.num_samples
        size = FINEST ** ((exponent * 997) % 1.0)  # shuffled: any part has all sizes
        noise = torch.einsum("kt,nskj->nstj", self._knots, noise) * size[:, None, None]
        samples = (plan[:, None] + config.spread * noise).clamp(-1.0, 1.0)
        share = (controller.rate(classical) / controller.speed)[:, None]
        samples[:, 0] = plan
        samples[:, 1:3] = 0.0
        samples[:, 2, :SHORT_STEPS] = share
        samples[:, 3] = share
        return samples

    def _map_tool_speed(self, q: torch.Tensor) -> torch.Tensor:
        """Return joint speeds, of full speed, for unit tool speeds along x, y, z and pitch.

        `(N, J, 4)`, at `q`, `(N, J)`; exclusive joints rest.
        """
        controller = self._control.controller
        jacobian = controller.kinematics.jacobian(q)
        columns = []
        for axis in range(4):
            error = q.new_zeros(len(q), 4)
            error[:, axis] = PROBE_M
            share = controller.approach(
                jacobian.tip, jacobian.pitch, error[:, :3], error[:, 2], error[:, 3]
            )
            columns.append(share / (PROBE_M * controller.config.gain_1_s))
        return torch.stack(columns, 2)

    def _predict_dead_time(self, q: torch.Tensor, u: torch.Tensor) -> History:
        """Return the history at the time when the coming command begins to act.

        Its commands are those in force now and before, oldest first.
        """
        history = History(q=q.clone(), u=u.clone())
        self._ahead.reset(torch.ones(len(q), dtype=torch.bool, device=q.device))
        for _ in range(self._dead_steps):
            history.push_u(u[:, -1])  # has no effect within the dead time
            history.push_q(self._ahead.step(history))
        return History(q=history.q, u=u)

    def _predict(self, history: History, samples: torch.Tensor) -> torch.Tensor:
        """Return predicted positions, `(T, N, K, J)`, for sequences of commands."""
        num, count, steps, joints = samples.shape
        given = history.u[:, None].expand(-1, count, -1, -1)
        held = samples[:, :, -1:].expand(-1, -1, self._dead_steps, -1)
        u = torch.cat((given, samples, held), 2).reshape(num * count, -1, joints)
        size = history.u.shape[1]
        run = History(
            q=history.q[:, None]
            .expand(-1, count, -1, -1)
            .reshape(num * count, size, joints)
            .clone(),
            u=u[:, :size],
        )
        self._sampled.reset(torch.ones(num * count, dtype=torch.bool, device=u.device))
        path = []
        for step in range(steps):
            first = step + self._dead_steps + 1
            run.u = u[:, first : first + size]
            run.push_q(self._sampled.step(run))
            path.append(run.q[:, -1].clone())
        return torch.stack(path).unflatten(1, (num, count))

    def _rate(
        self,
        path: torch.Tensor,
        samples: torch.Tensor,
        u_now: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        positioning: torch.Tensor,
    ) -> torch.Tensor:
        """Return the cost of each sequence, `(N, K)`."""
        control, config = self._control, self._config
        classical = self._task.options.classical
        pose = control.controller.kinematics.pose(path)
        error = target_m[:, None] - control.down - pose.tip_in_base_m
        lateral = error[..., :2].norm(dim=-1)
        outer, inner = classical.funnel_m
        # the tip rides on the cone: it ends above the rim, not in the hole
        rim = control.down[2] + RIM_M
        cone = ((lateral - inner) / EDGE_M).clamp(0.0, 1.0) * rim
        cone = cone + ((lateral - inner - EDGE_M) / (outer - inner)).clamp(0.0, 1.0) * (
            classical.hover_m - rim
        )
        cone = cone * bool(classical.hover_m)
        height = -error[..., 2]
        turn = (pitch_rad[:, None] - pose.pitch_rad).abs()
        cost = lateral + HEIGHT_COST * height.abs() + PITCH_M_RAD * turn
        cost = cost + FINE_M * ((lateral / FINE_SCALE_M).tanh() + (turn / FINE_SCALE_RAD).tanh())
        cost = cost + CONE_COST * (cone - height).clamp(min=0.0)
        joint = pose.joints_in_base_m[..., control.controller.reach_joint, :]
        out = target_m[:, None, :2].norm(dim=-1) - joint[..., :2].norm(dim=-1)
        reach = torch.sqrt(
            out.square() + (target_m[:, None, 2] - control.down[2] - joint[..., 2]) ** 2
        )
        middle = sum(self._task.options.switch.reach_m) / 2
        cost = torch.where(positioning[:, None], (reach - middle).abs(), cost)
        beyond = (self._lower - path).clamp(min=0.0) + (path - self._upper).clamp(min=0.0)
        cost = cost + END_COST_M_RAD * beyond.sum(-1)
        before = torch.cat(
            (u_now[:, None, None].expand_as(samples[:, :, :1]), samples[:, :, :-1]), 2
        )
        changes = (samples - before).abs().sum(3).mean(2)
        return cost.mean(0) + config.last * cost[-1] + config.change * changes


def _make_hat_functions(num_knots: int, num_steps: int) -> torch.Tensor:
    """Return weights of linear interpolation between knots, `(K, T)`."""
    place = torch.linspace(0.0, num_knots - 1.0, num_steps)
    return (1.0 - (place - torch.arange(num_knots)[:, None]).abs()).clamp(min=0.0)
