"""Classical controller: resolved-rate control of the tool with dead-time compensation.

It is the baseline of a learned policy, and the base on which the default policy learns a residual.
It sees only the policy's observation: the measured history and the estimated target. It is written
in torch, batched, without host synchronisation, in operations that ONNX knows: an exported policy
carries it inside.

Dead-time compensation is the idea of the Smith predictor (O. J. M. Smith, 1957). Commands that were
sent but have not acted yet are added to the measured position through a static map of the valve.
The controller acts on the predicted position. Resolved-rate control with damped least squares
follows Nakamura and Hanafusa (1986).

"""

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics, ToolPose, multiply_small_matrices
from brokk_rl.machine import Machine
from tasks.settings import ClassicalConfig, ControllerGuidance

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
        """
        config = self.config
        now = q[:, -1]
        ahead = now + (self.rate(u) * self._in_flight).sum(1)
        if coming is not None:
            ahead = ahead + self.rate(coming).sum(1) * self._period_s
        # one pass for both: small operations cost their launch, not their size
        both, jacobian = self.kinematics.pose_and_jacobian(torch.stack((ahead, now)))
        tip, pitch = both.tip_in_base_m[0], both.pitch_rad[0]

        error = target_m - tip
        outer, inner = config.funnel_m
        lateral = error[:, :2].norm(dim=1)
        goal_up = (
            error[:, 2] + ((lateral - inner) / (outer - inner)).clamp(0.0, 1.0) * config.hover_m
        )
        pitch_error = pitch_rad - pitch
        share = self.approach(jacobian.tip[0], jacobian.pitch[0], error, goal_up, pitch_error)

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

    def reach(self, q: torch.Tensor, target_m: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the reach at `q`, `(N, J)`, and its slope over joints: `(N,)` and `(N, J)`."""
        reach, slope, _ = self._reach(self.kinematics.pose(q[None]), target_m)
        return reach[0], slope

    def approach(
        self,
        tip_jacobian: torch.Tensor,
        pitch_jacobian: torch.Tensor,
        error: torch.Tensor,
        up: torch.Tensor,
        turn: torch.Tensor,
    ) -> torch.Tensor:
        """Return joint speeds that bring the tool closer, as shares of full speed, `(N, J)`.

        Exclusive joints rest.
        """
        config = self.config
        wanted = torch.cat((error[:, :2], up[:, None]), 1) * config.gain_1_s
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
