"""Control of a tool-pose task: the path from an observation to a masked command.

The same code runs in training, in `N` environments, and inside the exported policy: masks, the
classical controller's guidance, the residual, and proposals for a person.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET, ObservationEncoder, list_pose_parts
from tasks.advice import LeverAdviser
from tasks.classical import ClassicalController, ControllerGuidance
from tasks.settings import ToolPoseTask

ERROR_SCALES_M = (0.1, 0.02)
"""Distances at which the saturated copies of position errors resolve: approach and insertion.
Chosen by hand."""
PITCH_SCALE_RAD = 0.1
"""The same for the pitch error. Chosen by hand."""
PLAN_STEP_S = 0.1
"""Step of a planned motion: joints turn by 0.05 rad at most. Chosen by hand."""
REACH_CENTER_M = 2.0
"""Subtracted from the reach; about the middle of the paper's range, 1.7 to 2.4 m."""


@dataclass(frozen=True)
class ControlInput:
    """Everything that follows from one observation.

    Attributes:
        vector: The policy's observation vector, `(N, O)`.
        features: The `guide` group, `(N, G)`; see `compute_features`.
        guidance: Commands and errors of the classical controller.
        positioning: Whether only the exclusive joints move, `(N,)` bool.
    """

    vector: torch.Tensor
    features: torch.Tensor
    guidance: ControllerGuidance
    positioning: torch.Tensor


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

        self.switch, self.action, self.memory = task.switch, task.action, task.memory
        self.controller = ClassicalController(task.classical, machine, device)
        self.adviser = LeverAdviser(task.advice, machine, device) if task.advice else None
        parts = list_pose_parts(machine, task.scaling, with_proposals=self.adviser is not None)
        self.encoder = ObservationEncoder(parts, to_constant, torch.cat)
        self.down = to_constant([0.0, 0.0, task.aim_below_m])
        self.exclusive = to_constant(machine.is_exclusive).bool()

    def process(
        self,
        target_m: torch.Tensor,
        q: torch.Tensor,
        u: torch.Tensor,
        pitch_rad: torch.Tensor,
        proposed: torch.Tensor | None,
    ) -> ControlInput:
        """Return the observation vector and all that the controller makes of it.

        Args:
            target_m: Estimated target, `(N, 3)`.
            q: Measured positions, oldest first, `(N, H, J)`.
            u: Commands in force, oldest first, `(N, H, J)`.
            pitch_rad: Wanted pitch, `(N,)`.
            proposed: Proposals so far, oldest first, `(N, H, J)`; `None` without an adviser.
        """
        q, u = self._forget_positions(q), self._forget_commands(u)
        coming = None
        if self.adviser is not None and proposed is not None:
            proposed = self._forget_commands(proposed)
            coming = self.adviser.coming(proposed, u[:, -1])
        guidance = self.controller.guide(
            q, u, target_m - self.down, pitch_rad, self.switch.reach_m, coming
        )
        positioning = self.switch.positioning(guidance)
        values = {TARGET: target_m, "q": q, "u": u, PITCH: pitch_rad, PROPOSALS: proposed}
        return ControlInput(
            vector=self.encoder.encode(values),
            features=compute_features(guidance, positioning, u[:, -1]),
            guidance=guidance,
            positioning=positioning,
        )

    def plan(
        self,
        q: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        num_times: int,
        step_s: float,
    ) -> torch.Tensor:
        """Return the motion that the controller would make of an ideal machine, `(N, T, J)`.

        A learned policy corrects this controller; dead time and valves are left out.

        Args:
            q: Present joint positions, `(N, J)`.
            target_m: Targets, `(N, 3)`.
            pitch_rad: Wanted pitches, `(N,)`.
            num_times: `T`; the first time is now.
            step_s: Time between two of them.
        """
        rest = torch.zeros_like(q)
        num_parts = max(1, round(step_s / PLAN_STEP_S))
        planned = [q]
        for _ in range(num_times - 1):
            for _ in range(num_parts):
                guidance = self.controller.guide(
                    q[:, None], rest[:, None], target_m - self.down, pitch_rad, self.switch.reach_m
                )
                positioning = self.switch.positioning(guidance)
                u = self.action.command(
                    rest,
                    guidance.command,
                    guidance.lowest,
                    guidance.highest,
                    positioning,
                    self.exclusive,
                )
                q = q + self.controller.rate(u) * (step_s / num_parts)
            planned.append(q)
        return torch.stack(planned, 1)

    def command(
        self,
        output: torch.Tensor,
        base: torch.Tensor,
        lowest: torch.Tensor,
        highest: torch.Tensor,
        positioning: torch.Tensor,
        proposed: torch.Tensor | None,
    ) -> torch.Tensor:
        """Return masked commands, or proposals where there is an adviser, `(N, J)`.

        Args:
            output: Output of the network, `(N, J)`.
            base: See `ActionMapping.command`, like the next three.
            lowest: See there.
            highest: See there.
            positioning: See there.
            proposed: As in `process`.
        """
        u = self.action.command(output, base, lowest, highest, positioning, self.exclusive)
        if self.adviser is None or proposed is None:
            return u
        return self.adviser.proposal(u, self._forget_commands(proposed))

    def _forget_positions(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions `(N, H, J)` that rest before the last `memory` samples."""
        forgotten = q.shape[1] - self.memory
        if forgotten <= 0:
            return q
        still = q[:, forgotten : forgotten + 1].expand(-1, forgotten, -1)
        return torch.cat((still, q[:, forgotten:]), 1)

    def _forget_commands(self, u: torch.Tensor) -> torch.Tensor:
        """Return commands `(N, H, J)` that are zero before the last `memory` samples."""
        forgotten = u.shape[1] - self.memory
        if forgotten <= 0:
            return u
        return torch.cat((torch.zeros_like(u[:, :forgotten]), u[:, forgotten:]), 1)


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


def list_feature_signs(joint_signs: torch.Tensor) -> torch.Tensor:
    """Return the factor of each feature in the mirror, `(G,)`, in the order of `compute_features`.

    Of the errors only the tangential one changes sides.

    Args:
        joint_signs: See `brokk_rl.symmetry.compute_joint_signs`, `(J,)`.
    """
    errors = joint_signs.new_tensor([1.0, -1.0, 1.0, 1.0])
    # pitch error at two scales, reach, phase
    same = joint_signs.new_ones(4)
    return torch.cat((joint_signs, joint_signs, errors, errors, errors, same))


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
        target_m, q, u = values[TARGET], values["q"], values["u"]
        pitch_rad = values.get(PITCH)
        if pitch_rad is None:
            pitch_rad = torch.full_like(target_m[:, 0], self._pitch_rad)
        proposed = values.get(PROPOSALS)
        seen = control.process(target_m, q, u, pitch_rad, proposed)
        # encoding again is not exact to the last bit: only where history was forgotten
        vector = seen.vector if control.memory < q.shape[1] else observation
        guidance = seen.guidance
        return control.command(
            self.network({"policy": vector, "guide": seen.features}),
            guidance.command,
            guidance.lowest,
            guidance.highest,
            seen.positioning,
            proposed,
        )
