"""rsl-rl's on-policy runner with exact resume, atomic checkpoints and a budget."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from pathlib import Path

import torch
from rsl_rl.runners import OnPolicyRunner

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.policy_folder import TaskDescription, list_checkpoints, read_checkpoint
from brokk_rl.rl.group import TrainingGroup
from brokk_rl.rl.logger import TrainingLogger
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import require_groups
from brokk_rl.rl.ppo import CappedGaussian, DevicePPO
from brokk_rl.rl.settings import SUPPORTED, TrainingConfig
from brokk_rl.session import write_bytes

log = logging.getLogger(__name__)

ITERATIONS_PER_ROUND = 10
"""Iterations between two changes of the desired divergence, at most."""
NUM_ANSWERS = 256
"""Observations at most, of as many environments, that a checkpoint holds with the network's own
commands. Chosen by hand: many phases of an episode, and 150 kB."""


class TrainingRunner(OnPolicyRunner):
    """Runner of a training; see `TrainingConfig`.

    rsl-rl's own checkpoint lacks the environment, the random generators and the step count. This
    one holds all of them: a resumed run on a CPU goes on bit for bit. It is read with
    `weights_only=True`, so that a checkpoint from a stranger cannot run code. Of several processes
    the first writes it, including the state of the others.

    Args:
        env: The control loop; a checkpoint of another machine than its own is refused.
        training: Configuration.
        folder: Checkpoints go here.
        group: The processes that train together, entered; `None` for a single process.
    """

    env: ControlLoop
    logger: TrainingLogger  # type: ignore[assignment]

    def __init__(
        self,
        env: ControlLoop,
        training: TrainingConfig,
        folder: Path,
        group: TrainingGroup | None = None,
    ) -> None:
        self.training, self.folder = training, folder
        self._share_spent = 0.0
        self.group = group or TrainingGroup(env.device)
        require_groups(training.runner["obs_groups"], env.get_observations())
        config = training.runner_config()
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):  # rsl-rl prints its networks
            super().__init__(env, config, log_dir=None, device=str(env.device))
        log.debug(printed.getvalue())
        if self.alg.actor.is_recurrent or self.alg.critic.is_recurrent:  # a subclass of RNNModel
            raise ConfigError(f"rl.runner: a network with memory {SUPPORTED}")
        self.logger = TrainingLogger(folder, env, training, self.group)
        if isinstance(self.alg, DevicePPO):
            self.alg.fuse = training.fuse
            if training.teacher:
                env.task.require("example_action", "give rl.teacher=null")
                self.alg.follow(env.task.example_action)

    def run(self) -> None:
        """Train until the budget is spent; save a checkpoint every `save_interval`.

        Raises:
            SimulationError: Too many worlds diverged.
            TrainingError: A loss, a gradient or a weight is not finite.
        """
        spread = self.current_learning_iteration == 0 and self.training.random_episode_lengths
        with self.logger:
            while num := self.group.broadcast_first(self._count_iterations()):
                if self.current_learning_iteration % ITERATIONS_PER_ROUND == 0:
                    self._follow_schedules(self.group.broadcast_first(self.logger.share_done))
                with contextlib.redirect_stdout(io.StringIO()):
                    self.learn(num, init_at_random_ep_len=spread)
                spread = False
                # `learn` leaves the index of the last iteration; the next one is another
                self.current_learning_iteration += 1
                is_over = self.group.broadcast_first(self._count_iterations()) == 0
                if is_over or self.current_learning_iteration % self.training.save_interval == 0:
                    self.group.check_same(self._policy_state())
                    self.checkpoint()

    def _follow_schedules(self, share_spent: float) -> None:
        """Set all that changes with the spent share of the budget."""
        self._share_spent = share_spent
        self.alg.desired_kl = self.training.divergence(share_spent)  # type: ignore[assignment]
        distribution, teacher = self.alg.actor.distribution, self.training.teacher
        if self.training.near_starts:
            self.env.draw_near(self.training.near_starts.share_at(share_spent))
        if self.training.exploration and isinstance(distribution, CappedGaussian):
            distribution.set_cap(self.training.exploration.cap_at(share_spent))
        if teacher and isinstance(self.alg, DevicePPO):
            self.alg.imitation = teacher.weights_at(share_spent)

    def _count_iterations(self) -> int:
        """Return the number of iterations until the next checkpoint or change of the schedules.

        0 when the budget is spent.
        """
        book, budget = self.logger, self.training.budget
        if book.share_done >= 1.0:
            return 0
        left = []
        for part in (ITERATIONS_PER_ROUND, self.training.save_interval):
            left.append(part - self.current_learning_iteration % part)
        if budget.max_env_steps:
            left.append(-(-(budget.max_env_steps - book.env_steps) // book.steps_per_iteration))
        if budget.max_seconds:
            # the first round is short and shows how long one takes
            steps_left = 1
            if book.env_steps:
                steps_left = (budget.max_seconds - book.seconds) * book.env_steps / book.seconds
            left.append(round(steps_left / book.steps_per_iteration))
        return max(1, min(left))

    def _policy_state(self) -> dict[str, torch.Tensor]:
        """Return parameters and normalisers of actor and critic by name."""
        both = torch.nn.ModuleDict({"actor": self.alg.actor, "critic": self.alg.critic})
        return both.state_dict()

    def _configure_multi_gpu(self) -> None:
        """Tell rsl-rl of the processes of `group`.

        rsl-rl's own way knows NCCL only and never ends the process group.
        """
        rank = self.group.rank
        self.gpu_world_size = rank.count
        self.gpu_global_rank = rank.index
        self.gpu_local_rank = rank.local
        self.is_distributed = self.group.together
        numbers = {"global_rank": rank.index, "local_rank": rank.local, "world_size": rank.count}
        self.cfg["multi_gpu"] = numbers if self.is_distributed else None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for some iterations; see `rsl_rl.runners.OnPolicyRunner`."""
        with allow_tensor_cores(self.env.graph_active):
            super().learn(num_learning_iterations, init_at_random_ep_len)

    def checkpoint(self) -> None:
        """Write a checkpoint in one step; drop the oldest beyond `keep_checkpoints`.

        It holds all that is needed to go on exactly.

        Raises:
            StorageError: The disk is full or the folder cannot be written; older checkpoints are
                untouched.
        """
        own = {"env": self.env.state_dict(), "random": get_random_state(self.device)}
        parts = self.group.gather_on_first(own)
        if not self.group.rank.first:
            return
        self.logger.flush()
        content = self.alg.save() | {
            "iter": self.current_learning_iteration,
            "learning_rate": self.alg.learning_rate,
            "share_spent": self._share_spent,
            **own,
            "others": parts[1:],
            "book": self.logger.state_dict(),
            "fingerprint": self.env.machine.fingerprint(),
            "task": self.env.description.to_json(),
            "network": self.training.describe_network(),
            "answers": self.record_answers(),
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        path = self.folder / f"model_{self.current_learning_iteration}.pt"
        write_bytes(path, buffer.getvalue())
        for old in list_checkpoints(self.folder)[: -self.training.keep_checkpoints]:
            old.unlink()

    def record_answers(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return observations of running episodes and the network's own commands for them.

        An export is compared with them; see `ControlLoop.record_answers`.
        """
        return self.env.record_answers(self.alg.get_policy(), NUM_ANSWERS)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Do nothing: rsl-rl would save within an iteration; `checkpoint` follows every `learn`."""

    def load(
        self,
        path: str,
        load_cfg: dict | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict:
        """Restore a checkpoint so that training goes on exactly.

        Raises:
            CheckpointError: The file is missing, corrupt, holds NaN or belongs to another machine
                or configuration.
        """
        content = read_checkpoint(Path(path), self.device)
        self.env.machine.check_fingerprint(content.get("fingerprint", {}), path)
        TaskDescription.from_json(content["task"], path).require_same(
            self.env.description,
            path,
            "resume with the run's own resolved.yaml: brokk --config-dir <run> --config-name "
            "resolved policy=<run> session.out=<run>",
        )
        try:
            self.alg.load(content, None, strict=True)
            own = [content, *content.get("others", [])][self.group.rank.index :][:1]
            # Empty where more processes continue than were stopped: the new ones start afresh.
            for part in own:
                self.env.load_state_dict(part["env"])
                set_random_state(part["random"], self.device)
            self.alg.learning_rate = content["learning_rate"]
            self._follow_schedules(content["share_spent"])
            self.current_learning_iteration = content["iter"]
            self.logger.load_state_dict(content["book"])  # last: it rewrites progress.csv
        except (KeyError, RuntimeError) as error:
            raise CheckpointError(
                f"{path} does not fit this configuration: {str(error).splitlines()[0]}. "
                "Resume with the run's own resolved.yaml."
            ) from error
        return {}


@contextlib.contextmanager
def allow_tensor_cores(allowed: bool) -> Iterator[None]:
    """Let matrix products use TF32 inside of this context.

    Only where the control step is a captured graph, whose kernels were chosen before: ten bits of
    mantissa are enough for a network, but would put the tool of a 5 m arm millimetres off.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if allowed else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def get_random_state(device: torch.device | str) -> dict[str, torch.Tensor]:
    """Return the state of torch's generators on the CPU and on `device`."""
    state = {"cpu": torch.get_rng_state()}
    if torch.device(device).type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, torch.Tensor], device: torch.device | str) -> None:
    """Restore generators that `get_random_state` read."""
    torch.set_rng_state(state["cpu"].cpu())
    if torch.device(device).type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)
