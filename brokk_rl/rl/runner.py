"""rsl-rl's on-policy runner with exact resume, atomic checkpoints and a budget.

Several processes, one for each GPU, may train one policy. rsl-rl averages gradients and normalisers
over them. `TrainingGroup` adds the process group itself, decisions that the first process makes for
all, statistics over all environments, and a check that all still hold the same policy.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from rsl_rl.runners import OnPolicyRunner

from brokk_rl import distributed
from brokk_rl.errors import CheckpointError, ConfigError, DistributedError, StorageError
from brokk_rl.policy_folder import TaskDescription, find_policy, list_checkpoints, read_checkpoint
from brokk_rl.rl.logger import TrainingLogger
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import load_policy, scale_output
from brokk_rl.rl.ppo import CappedGaussian, DevicePPO
from brokk_rl.rl.settings import TrainingConfig

log = logging.getLogger(__name__)

ITERATIONS_PER_ROUND = 10
"""Iterations between two changes of the desired divergence, at most."""
NUM_ANSWERS = 256
"""Observations at most, of as many environments, that a checkpoint holds with the network's own
commands. Chosen by hand: many phases of an episode, and 150 kB."""
LOST_CONNECTION = ("gloo", "NCCL", "Connection closed by peer", "Connection reset by peer")
"""Words of a RuntimeError that is a lost connection: gloo has no class of its own for it."""


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
        device: Where the networks live.
        logger: Takes the place of rsl-rl's logger.
        group: The processes that train together, entered; `None` for a single process.
    """

    env: ControlLoop
    logger: TrainingLogger  # type: ignore[assignment]

    def __init__(
        self,
        env: ControlLoop,
        training: TrainingConfig,
        folder: Path,
        device: torch.device,
        logger: TrainingLogger,
        group: TrainingGroup | None = None,
    ) -> None:
        self.training, self.folder = training, folder
        self.group = group or TrainingGroup(device)
        offered = list(map(str, env.get_observations().keys()))
        _require_groups(training.runner["obs_groups"], offered)
        config = training.runner_config()
        if training.symmetry:
            config["algorithm"]["symmetry_cfg"] = _mirror_steps(env)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):  # rsl-rl prints its networks
            super().__init__(env, config, log_dir=None, device=str(device))
        log.debug(printed.getvalue())
        self.logger = logger
        if training.output_gain != 1.0:
            scale_output(self.alg.actor, training.output_gain)
        if isinstance(self.alg, DevicePPO):
            self.alg.fuse = training.fuse
            if training.teacher:
                self.alg.follow(load_policy(find_policy(training.teacher.folder), env).actor)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Train until the budget is spent; save a checkpoint every `save_interval`.

        Args:
            until: Asked after each round; training ends early where it returns true.
        """
        first = self.current_learning_iteration == 0
        while num := self.group.broadcast_first(self._count_iterations()):
            if self.current_learning_iteration % ITERATIONS_PER_ROUND == 0:
                self._follow_schedules(self.group.broadcast_first(self.logger.share_done))
            with contextlib.redirect_stdout(io.StringIO()):
                self.learn(
                    num, init_at_random_ep_len=first and self.training.random_episode_lengths
                )
            first = False
            # `learn` leaves the index of the last iteration; the next one is another
            self.current_learning_iteration += 1
            enough = self.group.broadcast_first(until())
            over = enough or self.group.broadcast_first(self._count_iterations()) == 0
            if over or self.current_learning_iteration % self.training.save_interval == 0:
                self.group.check_same(self._policy_state())
                self.checkpoint()
            if enough:
                break

    def _follow_schedules(self, share_spent: float) -> None:
        """Set the divergence to aim at, the cap of the noise and the teacher's weight."""
        self.alg.desired_kl = self.training.divergence(share_spent)  # type: ignore[assignment]
        distribution, teacher = self.alg.actor.distribution, self.training.teacher
        if self.training.exploration and isinstance(distribution, CappedGaussian):
            distribution.set_cap(self.training.exploration.cap_at(share_spent))
        if teacher and isinstance(self.alg, DevicePPO):
            self.alg.set_imitation(teacher.weight_at(share_spent))

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
        with allow_tensor_cores(self.training.tf32 and self.env.graph_active):
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
            "desired_kl": self.alg.desired_kl,
            **own,
            "others": parts[1:],
            "book": self.logger.state_dict(),
            "fingerprint": self.env.machine.fingerprint(),
            "task": self.env.description.to_json(),
            "network": self.training.describe_network(),
            "answers": self.record_answers(),
        }
        path = self.folder / f"model_{self.current_learning_iteration}.pt"
        part = path.with_suffix(".part")
        try:
            torch.save(content, part)
            with part.open("rb") as file:
                os.fsync(file.fileno())
            part.replace(path)
        # torch's writer reports a full disk as a RuntimeError
        except (OSError, RuntimeError) as error:
            part.unlink(missing_ok=True)
            raise StorageError(
                f"cannot write the checkpoint {path}: {error}. The checkpoint before it is "
                "untouched; make room and resume."
            ) from error
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
            self.alg.desired_kl = content["desired_kl"]
            self.current_learning_iteration = content["iter"]
            self.logger.load_state_dict(content["book"])  # last: it rewrites progress.csv
        except (KeyError, RuntimeError) as error:
            raise CheckpointError(
                f"{path} does not fit this configuration: {str(error).splitlines()[0]}. "
                "Resume with the run's own resolved.yaml."
            ) from error
        return {}


class TrainingGroup:
    """Process group of a training, a context manager; without effect for a single process.

    Args:
        device: Where this process computes: NCCL between GPUs, gloo between CPUs and for data
            on the host.
    """

    def __init__(self, device: torch.device) -> None:
        self.device, self.rank = device, distributed.read_rank()

    @property
    def together(self) -> bool:
        """True when there is more than one process."""
        return self.rank.count > 1

    def __enter__(self) -> TrainingGroup:
        if self.device.type == "cuda":
            torch.cuda.set_device(self.device)
        if self.together:
            backend = "cpu:gloo,cuda:nccl" if self.device.type == "cuda" else "gloo"
            dist.init_process_group(backend, rank=self.rank.index, world_size=self.rank.count)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        if not self.together:
            return
        if error is None:
            dist.barrier()
            dist.destroy_process_group()
            return
        # gloo's threads must end before the interpreter does, or it aborts. Between GPUs nothing is
        # destroyed after an error: NCCL would wait for processes that have ended.
        if self.device.type == "cpu":
            dist.destroy_process_group()
        if isinstance(error, dist.DistError) or (
            isinstance(error, RuntimeError) and any(word in str(error) for word in LOST_CONNECTION)
        ):
            raise DistributedError(
                f"rank {self.rank.index}: another process of this training has ended; its own "
                f"message says why ({str(error).splitlines()[0]})"
            ) from error

    def wait(self) -> None:
        """Wait until all processes have called this."""
        if self.together:
            dist.barrier()

    def broadcast_first(self, value: Any) -> Any:
        """Return the `value` of the first process, so that all act by the same clock."""
        if not self.together:
            return value
        box = [value]
        dist.broadcast_object_list(box, src=0)
        return box[0]

    def gather(self, value: Any) -> list[Any]:
        """Return the `value` (plain numbers and text) of all processes, in the order of ranks."""
        if not self.together:
            return [value]
        found: list[Any] = [None] * self.rank.count
        dist.all_gather_object(found, value)
        return found

    def gather_on_first(self, state: Any) -> list[Any]:
        """Return the `state` of all processes to the first one, an empty list to the others.

        A state is a mapping of tensors; they are copied to the host.
        """
        if not self.together:
            return [state]
        found: list[Any] = [None] * self.rank.count
        dist.gather_object(_copy_to_host(state), found if self.rank.first else None, dst=0)
        return found if self.rank.first else []

    def pool_statistics(self, figures: Mapping[str, float]) -> dict[str, float]:
        """Return the figures of all environments of all processes; see `ControlLoop.statistics`.

        Means over episodes weigh by the number of episodes; the fault rate by control steps, which
        are as many everywhere.
        """
        parts = self.gather(dict(figures))
        episodes = sum(part["episodes"] for part in parts)
        pooled = {}
        for name in figures:
            pooled[name] = sum(part[name] * part["episodes"] for part in parts) / max(1.0, episodes)
        return pooled | {
            "episodes": episodes,
            "fault_rate": sum(part["fault_rate"] for part in parts) / len(parts),
        }

    def check_same(self, state: Mapping[str, torch.Tensor]) -> None:
        """Compare the numbers of all processes, bit for bit.

        Raises:
            DistributedError: They differ; the message names the ranks that differ from the first.
        """
        if not self.together:
            return
        first, *others = self.gather(hash_tensors(state))
        differing = [str(rank) for rank, value in enumerate(others, 1) if value != first]
        if differing:
            raise DistributedError(
                f"the policy of rank {', '.join(differing)} is no longer that of rank 0: "
                "parameters or normalisers differ. "
                "Look for randomness or data-dependent code that runs on some ranks only, and "
                "for GPUs of different kinds."
            )


def hash_tensors(state: Mapping[str, torch.Tensor]) -> str:
    """Return the SHA-256 of names and bytes of tensors."""
    digest = hashlib.sha256()
    for name, value in state.items():
        digest.update(name.encode())
        digest.update(
            value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        )
    return digest.hexdigest()


def _copy_to_host(state: Any) -> Any:
    if isinstance(state, torch.Tensor):
        return state.detach().cpu()
    if isinstance(state, Mapping):
        return {name: _copy_to_host(value) for name, value in state.items()}
    return state


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


def _require_groups(asked: Mapping[str, Sequence[str]], offered: Collection[str]) -> None:
    """Raise a `ConfigError` where a network wants observations that the task does not give."""
    for network, names in asked.items():
        missing = [name for name in names if name not in offered]
        if missing:
            raise ConfigError(
                f"rl.runner.obs_groups.{network}: the task gives no group {', '.join(missing)}; "
                f"it gives {', '.join(sorted(offered))}: rl.runner.obs_groups.{network}=[policy]"
            )


def _mirror_steps(env: ControlLoop) -> dict[str, Any]:
    """Return what rsl-rl needs to learn from each step and its mirror image.

    Advantage, return and old probability are those of the step itself (Mittal et al. 2024).
    """
    env.task.require("mirror", "give rl.symmetry=false")
    return {"use_data_augmentation": True, "data_augmentation_func": env.task.mirror().augment}
