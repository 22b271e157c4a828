"""Fit of `actuators.models.trees` by scikit-learn's histogram gradient boosting."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actuators.models import checkpoint
from actuators.models.trees import BoostedTrees, build_tree_features
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec


@spec
class BoostingFit:
    """Gradient boosting of the next increment, joint by joint.

    Attributes:
        name: Name in tables and of the checkpoint.
        trees: Trees a joint.
        depth: Of each tree.
        learning_rate: Share of each tree's answer that is added.
        min_samples: Least rows in a leaf.
        max_rows: Rows fitted to at most, evenly spread.
    """

    name: str
    trees: int
    depth: int
    learning_rate: float
    min_samples: int
    max_rows: int

    def check(self) -> None:
        if min(self.trees, self.depth, self.min_samples, self.max_rows) < 1:
            raise ConfigError("fit: trees, depth, min_samples and max_rows must be 1 or more")
        if self.depth > 8:
            raise ConfigError(f"fit.depth: expected 8 or less, got {self.depth}")
        if not 0 < self.learning_rate <= 1:
            raise ConfigError(f"fit.learning_rate: expected (0, 1], got {self.learning_rate}")

    def require(self) -> None:
        """Check that scikit-learn is there.

        Raises:
            ConfigError: it is not.
        """
        import_ensemble(self.name)

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> BoostedTrees:
        """Fit to all recordings and write `<name>.safetensors`; validation chooses nothing.

        Raises:
            ConfigError: scikit-learn is not installed.
            RecordingError: too little data.
        """
        self.require()
        inputs, targets = _stack_rows(machine, [*train, *validation], self.max_rows)
        forests = [self.grow_trees(x, y, seed) for x, y in zip(inputs, targets, strict=True)]
        tensors = {}
        for name in forests[0]:
            tensors[name] = torch.as_tensor(np.stack([forest[name] for forest in forests]))
        path = folder / f"{self.name}.safetensors"
        checkpoint.write_checkpoint(path, "boosting", machine, tensors, {"depth": self.depth})
        return BoostedTrees(checkpoint=str(path))

    def grow_trees(
        self, inputs: np.ndarray, targets: np.ndarray, seed: int, weight: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Return trees fitted to rows of one joint as complete trees; see `evaluate_trees`.

        Args:
            inputs: Features, `(B, F)`.
            targets: What they should answer, `(B,)`.
            seed: Of scikit-learn's random numbers.
            weight: Weight of each row, `(B,)`; `None`: all count alike.

        Raises:
            ConfigError: scikit-learn is not installed.
        """
        model = import_ensemble(self.name).HistGradientBoostingRegressor(
            max_iter=self.trees,
            max_depth=self.depth,
            max_leaf_nodes=None,
            learning_rate=self.learning_rate,
            min_samples_leaf=self.min_samples,
            early_stopping=False,
            random_state=seed % 2**31,
        )
        return tabulate_trees(model.fit(inputs, targets, weight), self.depth)


def tabulate_trees(model: Any, depth: int) -> dict[str, np.ndarray]:
    """Return a fitted regressor of scikit-learn as complete trees; see `evaluate_trees`."""
    predictors = [stage[0] for stage in model._predictors]
    inner, leaves = 2**depth - 1, 2**depth
    feature = np.zeros((len(predictors), inner), dtype=np.int32)
    threshold = np.zeros((len(predictors), inner), dtype=np.float32)
    leaf = np.zeros((len(predictors), leaves), dtype=np.float32)
    for e, predictor in enumerate(predictors):
        nodes = predictor.nodes
        waiting = [(0, 0)]  # node of scikit-learn, place in the complete tree
        while waiting:
            number, place = waiting.pop()
            node = nodes[number]
            if place >= inner:
                leaf[e, place - inner] = node["value"]
            elif node["is_leaf"]:  # both sides hold the same value
                waiting += [(number, 2 * place + 1), (number, 2 * place + 2)]
            else:
                feature[e, place], threshold[e, place] = node["feature_idx"], node["num_threshold"]
                waiting += [(node["left"], 2 * place + 1), (node["right"], 2 * place + 2)]
    offset = np.array(np.ravel(model._baseline_prediction)[0], dtype=np.float32)
    return {"feature": feature, "threshold": threshold, "leaf": leaf, "offset": offset}


def import_ensemble(name: str) -> Any:
    """Return the ensembles of scikit-learn for the fit `name`.

    Raises:
        ConfigError: scikit-learn is not installed.
    """
    try:
        return import_module("sklearn.ensemble")
    except ImportError as error:
        raise ConfigError(
            f"fit={name} needs scikit-learn: pip install 'brokk-rl[boosting]'"
        ) from error


def _stack_rows(
    machine: Machine, recordings: Sequence[Recording], max_rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs `(J, B, F)` and the next increments in full steps, `(J, B)`."""
    size, full = machine.num_history, machine.max_speed * machine.period_s
    total = sum(max(0, recording.num_samples - size) for recording in recordings)
    if not total:
        raise RecordingError(
            f"too little data: none of {len(recordings)} recordings is longer than the history of {size} samples"
        )
    every, inputs, targets = -(-total // max_rows), [], []
    for recording in recordings:
        if recording.num_samples <= size:
            continue
        u, q = torch.as_tensor(recording.u).float(), torch.as_tensor(recording.q / full).float()
        seen = [x.unfold(0, size, 1)[:-1].transpose(1, 2)[::every] for x in (u, q)]
        place = (recording.q[size - 1 : -1] - machine.lower) / (machine.upper - machine.lower)
        place = torch.as_tensor(place[::every]).float()
        inputs.append(build_tree_features(seen[0], seen[1], place).numpy())
        targets.append((q[size:] - q[size - 1 : -1])[::every].T.numpy())
    return np.concatenate(inputs, 1), np.concatenate(targets, 1)
