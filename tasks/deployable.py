"""A tool-pose policy as it leaves the trainer: one module with everything between the observation vector and the masked command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from tasks.classical import ControllerGuidance

if TYPE_CHECKING:
    from tasks.process import ToolPoseProcess


class DeployedPolicy(torch.nn.Module):
    """The whole policy as it runs on the machine: from the observation vector `(B, O)` to masked commands `(B, J)`.

    Everything that training computes beside the paper's observation (guidance, phase, residual,
    masks) is inside, so that nothing of it has to be written again, in another order or scale,
    where the policy is deployed.
    """

    def __init__(self, process: ToolPoseProcess, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network
        self._process = process
        self._pitch_rad = float(process.starts(1, 0)["target_pitch_rad"][0])

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Returns valve commands, `(B, J)` in [-1, 1]."""
        process, options = self._process, self._process.options
        target_m, q, u = process._encoder.decode(observation)
        q, u = process.remembered(q, u)
        varies = process._encoder.has_pitch
        pitch = (
            process._encoder.decode_pitch(observation)
            if varies
            else torch.full_like(target_m[:, 0], self._pitch_rad)
        )
        adviser, proposed, coming = process.adviser, None, None
        if adviser is not None:
            proposed = process.recalled(process._encoder.decode_proposals(observation))
            coming = adviser.coming(proposed, u[:, -1])
        guidance = process._controller.guide(
            q, u, target_m - process._down, pitch, options.switch.reach_m, coming
        )
        positioning = options.switch.positioning(guidance)
        if options.memory < q.shape[1]:
            observation = process._encoder.encode(target_m, q, u, pitch, proposed)
        groups = {"policy": observation, "guide": compute_features(guidance, positioning, u[:, -1])}
        command = options.action.command(
            self.network(groups),
            guidance.command,
            guidance.lowest,
            guidance.highest,
            positioning,
            process._exclusive,
        )
        return (
            command if adviser is None or proposed is None else adviser.proposal(command, proposed)
        )


def compute_features(
    guidance: ControllerGuidance, positioning: torch.Tensor, u_last: torch.Tensor
) -> torch.Tensor:
    """Returns what the default policy is told beside the paper's observation, all of it computed from that observation."""
    errors = torch.cat((guidance.error_m, guidance.goal_error_m[:, None]), 1)
    scales = (errors, (errors / 0.1).tanh(), (errors / 0.02).tanh())
    turn = guidance.pitch_error_rad[:, None]
    reach = (guidance.reach_m - 2.0)[:, None]
    return torch.cat(
        (
            guidance.command,
            u_last,
            *scales,
            turn,
            (turn / 0.1).tanh(),
            reach,
            positioning[:, None].float(),
        ),
        1,
    )
