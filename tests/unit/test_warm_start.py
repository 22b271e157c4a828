"""Training begins with the network of a policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import option
from training import CPU, plant, small, train

from brokk_rl.errors import CheckpointError
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import describe_policy, write_policy
from brokk_rl.rl.policy import load_initial_weights, make_actor


def spread(actor: Any) -> torch.Tensor:
    return actor.distribution.log_std_param


def test_training_that_begins_with_a_policy_has_its_network_and_its_own_exploration(
    machine: Machine, tmp_path: Path
) -> None:
    training = small(max_env_steps=64)
    runner = train(machine, tmp_path / "old", training)
    old = runner.alg.actor
    with torch.no_grad():
        spread(old).fill_(-3.0)  # as one that has settled
    env = runner.env
    network = training.describe_network()
    contract = describe_policy(network, env.task, env.description, machine)
    write_policy(tmp_path / "old", contract, old.state_dict())
    loop = plant(machine).build(CPU, 16, 64, 0)
    actor = make_actor(network, loop.get_observations(), loop.num_actions)
    load_initial_weights(actor, str(tmp_path / "old"), machine)
    groups = loop.get_observations()
    np.testing.assert_array_equal(actor(groups).detach(), old(groups).detach())
    shipped = option("rl", "ppo").runner["actor"]["distribution_cfg"]["init_std"]
    torch.testing.assert_close(spread(actor).exp(), torch.full((5,), shipped))

    network["actor"]["hidden_dims"] = [8]
    other = make_actor(network, loop.get_observations(), loop.num_actions)
    with pytest.raises(CheckpointError, match="policy="):
        load_initial_weights(other, str(tmp_path / "old"), machine)
