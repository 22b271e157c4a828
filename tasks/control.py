"""Control of a tool-pose task: the path from an observation to a masked command.

The same code runs in training, in `N` environments, and inside the exported policy: masks, the
classical controller's guidance, the residual, and proposals for a person.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET, ObservationEncoder, list_pose_parts
from tasks.advice import LeverAdviser
from tasks.classical import ClassicalController
from tasks.settings import CommandBase, ControllerGuidance, ToolPoseTask

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
        base: Command of the classical controller, and bounds.
        reach_m: Distance by which the switch decides, `(N,)`.
    """

    vector: torch.Tensor
    features: torch.Tensor
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
        self.down = to_constant([0.0, 0.0, task.aim_below_m])
        self.exclusive = to_constant(machine.is_exclusive).bool()
        self.num_forgotten = max(0, machine.num_history - task.memory)

    def process(self, values: Mapping[str, torch.Tensor]) -> ControlInput:
        """Return the observation vector and all that the controller makes of it.

        Args:
            values: `target_in_base_m` `(N, 3)`, histories `q` and `u` `(N, H, J)`, `pitch_rad`
                `(N,)`, and `proposals` `(N, H, J)` where there is an adviser.
        """
        target_m, pitch_rad = values[TARGET], values[PITCH]
        seen = dict(values) | {"q": self._forget(values["q"]), "u": self._forget(values["u"], 0.0)}
        coming = None
        if self.adviser is not None:
            seen[PROPOSALS] = self._forget(values[PROPOSALS], 0.0)
            coming = self.adviser.coming(seen[PROPOSALS], seen["u"][:, -1])
        guidance, base = self._guide(seen["q"], seen["u"], target_m, pitch_rad, coming)
        return ControlInput(
            vector=self.encoder.encode(seen),
            features=compute_features(guidance, base.positioning, seen["u"][:, -1]),
            base=base,
            reach_m=self.task.switch.reach(guidance),
        )

    def _guide(
        self,
        q: torch.Tensor,
        u: torch.Tensor,
        target_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        coming: torch.Tensor | None = None,
    ) -> tuple[ControllerGuidance, CommandBase]:
        switch = self.task.switch
        aim_m = target_m - self.down
        guidance = self.controller.guide(q, u, aim_m, pitch_rad, switch.reach_m, coming)
        positioning = switch.positioning(guidance)
        bounds = (guidance.command, guidance.lowest, guidance.highest)
        return guidance, CommandBase(*bounds, positioning)

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
                _, base = self._guide(q[:, None], rest[:, None], target_m, pitch_rad)
                u = self.task.action.command(rest, base, self.exclusive)
                q = q + self.controller.rate(u) * (step_s / num_parts)
            planned.append(q)
        return torch.stack(planned, 1)

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
        return self.adviser.proposal(u, self._forget(proposed, 0.0))

    def _forget(self, history: torch.Tensor, rest: float | None = None) -> torch.Tensor:
        """Return a history `(N, H, J)` with `rest` before the memory; `None`: at rest there."""
        count = self.num_forgotten
        if count == 0:
            return history
        first = history[:, count : count + 1].expand(-1, count, -1)
        before = first if rest is None else torch.full_like(first, rest)
        return torch.cat((before, history[:, count:]), 1)


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
        if PITCH not in values:
            values[PITCH] = torch.full_like(observation[:, 0], self._pitch_rad)
        seen = control.process(values)
        # encoding again is not exact to the last bit: only where history was forgotten
        vector = seen.vector if control.num_forgotten else observation
        output = self.network({"policy": vector, "guide": seen.features})
        return control.command(output, seen.base, values.get(PROPOSALS))
