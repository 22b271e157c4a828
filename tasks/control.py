"""Control of a tool-pose task: the path from an observation to a masked command.

The same code runs in training, in `N` environments, and inside the exported policy: it is written in
torch, batched, without host synchronisation, in operations that ONNX knows.

The classical controller is the baseline of a learned policy, and the base on which the default policy
learns a residual. It sees only the policy's observation. Dead-time compensation is the idea of the
Smith predictor (O. J. M. Smith, 1957): commands that were sent but have not acted yet are added to the
measured position through a static map of the valve. Resolved-rate control with damped least squares
follows Nakamura and Hanafusa (1986).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics, ToolPose, multiply_small_matrices
from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET, ObservationEncoder, list_pose_parts
from tasks.advice import LeverAdviser
from tasks.settings import (
    ClassicalConfig,
    CommandBase,
    ControllerGuidance,
    ToolPoseTask,
    find_tool_direction,
)

ERROR_SCALES_M = (0.1, 0.02)
"""Distances at which the saturated copies of position errors resolve: approach and insertion.
Chosen by hand."""
PITCH_SCALE_RAD = 0.1
"""The same for the pitch error. Chosen by hand."""
PLAN_GAIN_1_S = 1.0
"""Speed of joints along a planned path per distance left. Chosen by hand: half the controller's
strikes half as hard."""
PLAN_END_RAD = 0.2
"""Distance of each joint from the end of a planned path, rad or m, within which it is done. Chosen
by hand."""
PLAN_DONE = -1.0
"""Marks a plan whose path is done."""
REACH_CENTER_M = 2.0
"""Subtracted from the reach; about the middle of the paper's range, 1.7 to 2.4 m."""
REACH_DAMPING = 0.05
"""Damping of the exclusive joints' step towards the working range, m² per (rad or m)². Chosen by
hand: bounds the step where a joint hardly changes the reach."""
MIN_RADIUS_M = 1e-3
"""Floor of horizontal distances by which the controller divides."""


class ClassicalController:
    """Controller under `ClassicalConfig`; stateless, so that it can stand inside a policy."""

    def __init__(self, config: ClassicalConfig, machine: Machine, device: torch.device) -> None:
        def constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.config = config
        self.kinematics = Kinematics(machine, device)
        self.speed = constant(machine.max_speed)
        self._lower = constant(machine.lower) + config.margin_rad
        self._upper = constant(machine.upper) - config.margin_rad
        self._exclusive = constant(machine.is_exclusive)
        # the joint whose distance to the target decides about reach: the first one behind the
        # exclusive joints (the paper's q3)
        last = max(np.flatnonzero(machine.is_exclusive), default=-1)
        self.reach_joint = int(min(last + 1, machine.num_joints - 1))
        age = torch.arange(machine.num_history - 1, -1, -1, dtype=torch.float32, device=device)
        self._period_s = machine.period_s
        self._in_flight = (config.in_flight_samples - age).clamp(0.0, 1.0)[
            :, None
        ] * machine.period_s
        self._damping = config.damping**2 * torch.eye(4, device=device)

    def rate(self, u: torch.Tensor) -> torch.Tensor:
        """Return joint speeds of the static valve map for commands `u`, `(…, J)`, rad/s or m/s."""
        band = self.config.dead_band
        return self.speed * u.sign() * (u.abs() - band).clamp(min=0.0) / (1.0 - band)

    def valve(self, rate: torch.Tensor) -> torch.Tensor:
        """Return the commands, in [-1, 1], for joint speeds given as a share of full speed.

        The inverse of `rate`.

        Speeds too small for the valve are given as pulses of `creep`: the prediction counts a pulse
        as soon as it is sent, so that no more of them are sent than are needed.
        """
        band = self.config.dead_band
        size = rate.abs()
        return (
            rate.sign()
            * (band + (1.0 - band) * size.clamp(min=self.config.creep)).clamp(max=1.0)
            * (size > self.config.rest)
        )

    def _opening(self, share: torch.Tensor) -> torch.Tensor:
        """Return the largest command not faster than a share of full speed, `(N, J)` in [0, 1]."""
        band = self.config.dead_band
        return (band + (1.0 - band) * share) * (share > 0)

    def guide(
        self,
        q: torch.Tensor,
        u: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        reach_m: tuple[float, float],
        coming: torch.Tensor | None = None,
        along: torch.Tensor | None = None,
    ) -> ControllerGuidance:
        """Return commands and errors.

        Args:
            q: Measured positions, oldest first, `(N, H, J)`.
            u: Commands sent, oldest first, `(N, H, J)`.
            target_m: Where the tool point shall end up in the base frame, `(N, 3)`.
            pitch_rad: Wanted pitch, `(N,)`.
            reach_m: Good working range (nearest, farthest); positioning aims at its middle.
            coming: Commands that will be given whatever is asked for now, `(N, F, J)`; `None` where
                nobody stands between.
            along: Direction in which the tool goes in, `(N, 3)`; `None`: straight down.
        """
        config = self.config
        now, ahead = q[:, -1], self.predict(q, u)
        if coming is not None:
            ahead = ahead + self.rate(coming).sum(1) * self._period_s
        # one pass for both: small operations cost their launch, not their size
        both, jacobian = self.kinematics.pose_and_jacobian(torch.stack((ahead, now)))
        tip, pitch = both.tip_in_base_m[0], both.pitch_rad[0]

        error = target_m - tip
        outer, inner = config.funnel_m
        up = error[:, 2] if along is None else -(error * along).sum(1)
        across = error[:, :2] if along is None else error + up[:, None] * along
        lateral = across.norm(dim=1)
        goal_up = up + ((lateral - inner) / (outer - inner)).clamp(0.0, 1.0) * config.hover_m
        if along is None:
            wanted = torch.cat((across, goal_up[:, None]), 1)
        else:
            wanted = across - goal_up[:, None] * along
        pitch_error = pitch_rad - pitch
        share = self.approach(jacobian.tip[0], jacobian.pitch[0], wanted, pitch_error)

        reach, reach_slope, reach_3d = self._reach(both, target_m)
        left = (
            (sum(reach_m) / 2 - reach[0])[:, None]
            * reach_slope
            / (reach_slope.square() + REACH_DAMPING)
        )
        share = share + (config.gain_1_s * left * self._exclusive / self.speed).clamp(-1.0, 1.0)
        # each joint slows down before the place from which it must go no further
        down, up = (
            (room / (self.speed * config.brake_s)).clamp(0.0, 1.0)
            for room in (ahead - self._lower, self._upper - ahead)
        )
        share = torch.maximum(torch.minimum(share, up), -down)

        bearing = tip[:, :2] / tip[:, :2].norm(dim=1, keepdim=True).clamp(min=MIN_RADIUS_M)
        radial = (error[:, :2] * bearing).sum(1)
        tangential = bearing[:, 0] * error[:, 1] - bearing[:, 1] * error[:, 0]
        return ControllerGuidance(
            command=self.valve(share),
            error_m=torch.stack((radial, tangential, error[:, 2]), 1),
            pitch_error_rad=pitch_error,
            goal_error_m=goal_up,
            reach_m=reach[1],
            reach_3d_m=reach_3d[1],
            tip_z_m=both.tip_in_base_m[1, :, 2],
            lowest=-self._opening(down),
            highest=self._opening(up),
        )

    def predict(self, q: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """Return the positions, `(N, J)`, to which the commands that were sent will lead."""
        return q[:, -1] + (self.rate(u) * self._in_flight).sum(1)

    def reach(self, q: torch.Tensor, target_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the reach at `q`, `(N, J)`, and its slope over joints: `(N,)` and `(N, J)`."""
        reach, slope, _ = self._reach(self.kinematics.pose(q[None]), target_m)
        return reach[0], slope

    def approach(
        self,
        tip_jacobian: torch.Tensor,
        pitch_jacobian: torch.Tensor,
        way: torch.Tensor,
        turn: torch.Tensor,
    ) -> torch.Tensor:
        """Return joint speeds that bring the tool closer, as shares of full speed, `(N, J)`.

        Exclusive joints rest.

        Args:
            tip_jacobian: Slopes of the tool point over the joints.
            pitch_jacobian: Slopes of its pitch.
            way: Where the tool point has yet to go, `(N, 3)`.
            turn: By how much the tool has yet to turn, `(N,)`.
        """
        config = self.config
        wanted = way * config.gain_1_s
        wanted = wanted * (
            config.top_speed_m_s / wanted.norm(dim=1, keepdim=True).clamp(min=config.top_speed_m_s)
        )
        turn = (turn * config.gain_1_s).clamp(-config.top_rate_rad_s, config.top_rate_rad_s)
        jacobian = torch.cat((tip_jacobian, pitch_jacobian[:, None]), 1) * (
            self.speed * (1.0 - self._exclusive)
        )
        square = multiply_small_matrices(jacobian, jacobian.transpose(1, 2)) + self._damping
        share = multiply_small_matrices(
            jacobian.transpose(1, 2),
            _solve_4(square, torch.cat((wanted, turn[:, None]), 1)[..., None]),
        )[..., 0]
        return (
            share / share.abs().amax(1, keepdim=True).clamp(min=1.0)
            if config.straight
            else share.clamp(-1.0, 1.0)
        )

    def _reach(self, pose: ToolPose, target_m: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return reach and distance in space, `(M, N)` each, and the slope of the reach, `(N, J)`.

        The slope is that of the first row. Order: reach, slope, distance.
        """
        origins = pose.joints_in_base_m
        joint = origins[:, :, self.reach_joint]
        radius = joint[..., :2].norm(dim=-1).clamp(min=MIN_RADIUS_M)
        out = target_m[:, :2].norm(dim=1) - radius
        up = target_m[:, 2] - joint[..., 2]
        reach = torch.sqrt(out.square() + up.square()).clamp(min=MIN_RADIUS_M)
        motion = torch.linalg.cross(pose.axes_in_base[0], joint[0, :, None] - origins[0], dim=-1)
        outward = (motion[..., :2] * (joint[0, :, :2] / radius[0, :, None])[:, None]).sum(-1)
        slope = -(out[0, :, None] * outward + up[0, :, None] * motion[..., 2]) / reach[0, :, None]
        return reach, slope, (target_m - joint).norm(dim=-1)


@dataclass(frozen=True)
class ControlInput:
    """Everything that follows from one observation.

    Attributes:
        vector: The policy's observation vector, `(N, O)`.
        features: The `guide` group, `(N, G)`; see `compute_features`.
        joints: The newest joint positions, scaled as in `vector`, `(N, J)`.
        base: Command of the classical controller, and bounds.
        reach_m: Distance by which the switch decides, `(N,)`.
    """

    vector: torch.Tensor
    features: torch.Tensor
    joints: torch.Tensor
    base: CommandBase
    reach_m: torch.Tensor


class ToolPoseControl:
    """Path from an observation to a command; stateless.

    Args:
        task: The spec.
        machine: The machine.
        device: Where to compute.
    """

    def __init__(self, task: ToolPoseTask, machine: Machine, device: torch.device) -> None:
        def to_constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.task = task
        self.controller = ClassicalController(task.classical, machine, device)
        self.adviser = LeverAdviser(task.advice, machine, device) if task.advice else None
        parts = list_pose_parts(machine, task.scaling, with_proposals=self.adviser is not None)
        self.encoder = ObservationEncoder(parts, to_constant, torch.cat)
        self._middle = to_constant((machine.lower + machine.upper) / 2)
        self._quarter = to_constant((machine.upper - machine.lower) / 4)
        self._down = to_constant([0.0, 0.0, task.aim_below_m])
        self.exclusive = to_constant(machine.is_exclusive).bool()

    def process(self, values: Mapping[str, torch.Tensor]) -> ControlInput:
        """Return the observation vector and all that the controller makes of it.

        Args:
            values: `target_in_base_m` `(N, 3)`, histories `q` and `u` `(N, H, J)`, `pitch_rad`
                `(N,)`, and `proposals` `(N, H, J)` where there is an adviser.
        """
        q, u = values["q"], values["u"]
        coming = None
        if self.adviser is not None:
            coming = self.adviser.coming(values[PROPOSALS], u[:, -1])
        guidance, base = self.guide(q, u, values[TARGET], values[PITCH], coming)
        return ControlInput(
            vector=self.encoder.encode(values),
            features=compute_features(guidance, base.positioning, u[:, -1]),
            joints=(q[:, -1] - self._middle) / self._quarter,
            base=base,
            reach_m=self.task.switch.reach(guidance),
        )

    def follow_plan(
        self, values: Mapping[str, torch.Tensor], plan: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return commands along a planned path of the joints, and those of the controller, `(N, J)`.

        The controller acts from the end of the path on, and where only exclusive joints move.

        Args:
            values: As `process` takes them.
            plan: As `tasks.starts.StartSearch.check` returns it, `(N, J + 1)`; the last number is
                `PLAN_DONE` from the end of the path on.
        """
        q, u = values["q"], values["u"]
        guidance, base = self.guide(q, u, values[TARGET], values[PITCH])
        left = self.measure_rest(values, plan)
        waits = (plan[:, -1] > 0.5) & (left[:, 1:].abs().amax(1) > PLAN_END_RAD)
        left[:, 0] *= ~waits
        share = PLAN_GAIN_1_S * left / self.controller.speed
        share = share / share.abs().amax(1, keepdim=True).clamp(min=1.0)
        u_planned = self.controller.valve(share)
        u_planned = u_planned.minimum(guidance.highest).maximum(guidance.lowest)
        is_led = base.positioning | (plan[:, -1] == PLAN_DONE)
        return base.command.where(is_led[:, None], u_planned), base.command

    def measure_rest(self, values: Mapping[str, torch.Tensor], plan: torch.Tensor) -> torch.Tensor:
        """Return how far joints will be from the end of a planned path, `(N, J)`."""
        ahead = self.controller.predict(values["q"], values["u"])
        return (plan[:, :-1] - ahead) * ~self.exclusive

    def aim(self, target_m: torch.Tensor, pitch_rad: torch.Tensor) -> torch.Tensor:
        """Return where the tool point shall end up for targets `(N, 3)` and pitches `(N,)`."""
        if not self.task.leans:
            return target_m - self._down
        return target_m + self.task.aim_below_m * find_tool_direction(target_m, pitch_rad)

    def guide(
        self,
        q: torch.Tensor,
        u: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        coming: torch.Tensor | None = None,
    ) -> tuple[ControllerGuidance, CommandBase]:
        """Return what the classical controller makes of an observation; see its `guide`."""
        switch = self.task.switch
        along = find_tool_direction(target_m, pitch_rad) if self.task.leans else None
        aim_m = self.aim(target_m, pitch_rad)
        guidance = self.controller.guide(q, u, aim_m, pitch_rad, switch.reach_m, coming, along)
        positioning = switch.positioning(guidance)
        lowest, highest = self.task.action.bound(guidance.lowest, guidance.highest, u[:, -1])
        return guidance, CommandBase(guidance.command, lowest, highest, positioning)

    def command(
        self, output: torch.Tensor, base: CommandBase, proposed: torch.Tensor | None
    ) -> torch.Tensor:
        """Return masked commands, or proposals where there is an adviser, `(N, J)`.

        Args:
            output: Output of the network, `(N, J)`.
            base: See `ControlInput`.
            proposed: Proposals so far, oldest first, `(N, H, J)`.
        """
        u = self.task.action.command(output, base, self.exclusive)
        if self.adviser is None or proposed is None:
            return u
        return self.adviser.proposal(u, proposed)


def compute_features(
    guidance: ControllerGuidance, positioning: torch.Tensor, u_last: torch.Tensor
) -> torch.Tensor:
    """Return the `guide` group, `(N, G)`, which the default policy sees beside the paper's vector.

    All of it follows from that vector: commands of the classical controller, the last command,
    position errors at three scales, pitch error at two, reach, phase.
    """
    errors = torch.cat((guidance.error_m, guidance.goal_error_m[:, None]), 1)
    coarse, fine = ERROR_SCALES_M
    turn = guidance.pitch_error_rad[:, None]
    parts = (
        guidance.command,
        u_last,
        errors,
        (errors / coarse).tanh(),
        (errors / fine).tanh(),
        turn,
        (turn / PITCH_SCALE_RAD).tanh(),
        (guidance.reach_m - REACH_CENTER_M)[:, None],
        positioning[:, None].float(),
    )
    return torch.cat(parts, 1)


class DeployedPolicy(torch.nn.Module):
    """The whole policy as it runs on the machine: `(B, O)` observations to `(B, J)` commands.

    Everything that training computes beside the paper's observation (guidance, phase, residual,
    masks) is inside. Nothing of it has to be written again where the policy is deployed.

    Args:
        control: Path from observation to command.
        network: Takes a dictionary of observation groups, returns the action.
        pitch_rad: Wanted pitch of a task that fixes it.
    """

    def __init__(
        self, control: ToolPoseControl, network: torch.nn.Module, pitch_rad: float
    ) -> None:
        super().__init__()
        self.network = network
        self._control, self._pitch_rad = control, pitch_rad

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return valve commands, `(B, J)` in [-1, 1]."""
        control = self._control
        values = control.encoder.decode(observation)
        if PITCH not in values:
            values[PITCH] = torch.full_like(observation[:, 0], self._pitch_rad)
        seen = control.process(values)
        # encoding again is not exact to the last bit
        groups = {"policy": observation, "guide": seen.features, "joints": seen.joints}
        output = self.network(groups)
        return control.command(output, seen.base, values.get(PROPOSALS))


def _solve_4(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Solve symmetric positive definite 4 x 4 systems by 2 x 2 blocks (Schur complement).

    Args:
        a: Matrices, `(N, 4, 4)`.
        b: Right sides, `(N, 4, 1)`.


    Own code because LAPACK calls neither export to ONNX nor fit into a captured CUDA graph.
    """
    p, q, s = a[:, :2, :2], a[:, :2, 2:], a[:, 2:, 2:]
    p_inverse = _invert_2(p)
    down = multiply_small_matrices(q.transpose(1, 2), p_inverse)
    low = multiply_small_matrices(
        _invert_2(s - multiply_small_matrices(down, q)),
        b[:, 2:] - multiply_small_matrices(down, b[:, :2]),
    )
    return torch.cat(
        (multiply_small_matrices(p_inverse, b[:, :2] - multiply_small_matrices(q, low)), low), 1
    )


def _invert_2(m: torch.Tensor) -> torch.Tensor:
    a, b, c, d = m[:, 0, 0], m[:, 0, 1], m[:, 1, 0], m[:, 1, 1]
    return torch.stack((d, -b, -c, a), 1).reshape(-1, 2, 2) / (a * d - b * c)[:, None, None]
