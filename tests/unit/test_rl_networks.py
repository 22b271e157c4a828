"""Networks that read the history as increments: the encoding on numbers, and that an exported actor keeps it."""

from __future__ import annotations

import math

import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from brokk_rl.rl.networks import HistoryEncoding, HistoryModel
from brokk_rl.rl.policy import PlainActor, make_actor

GROUPS = {"actor": ["policy", "guide"]}
NOISE = {"class_name": "GaussianDistribution", "init_std": 0.5}
CONFIG = {"hidden_dims": [8], "activation": "elu", "distribution_cfg": NOISE}


def test_the_encoding_gives_the_newest_position_increments_and_waves() -> None:
    """Two samples of one joint: target (3), positions 0.5 and 0.75, commands 0.25 and 1."""
    vector = torch.tensor([[0.0, 1.0, 2.0, 0.5, 0.75, 0.25, 1.0]])
    place = [0.0, 1.0, 2.0, 0.75]
    waves = [f(factor * x) for factor in (1, 2) for f in (math.sin, math.cos) for x in place]
    # an increment of 0.25 times the gain of 20
    expected = [*place, 5.0, 0.25, 1.0, *waves]
    assert HistoryEncoding(2, 1)(vector)[0].tolist() == pytest.approx(expected)


def test_the_encoding_loses_nothing() -> None:
    """Positions and commands of 13 samples and 5 joints can be had back from it."""
    torch.manual_seed(0)
    vector = torch.randn(4, 133)
    seen = HistoryEncoding(13, 5)(vector)
    newest, increments = seen[:, 3:8], seen[:, 8:68].reshape(4, 12, 5) / 20.0
    older = newest[:, None] - increments.flip(1).cumsum(1).flip(1)
    q = torch.cat((older, newest[:, None]), 1).flatten(1)
    torch.testing.assert_close(torch.cat((seen[:, :3], q, seen[:, 68:133]), 1), vector)


def test_what_follows_the_history_is_handed_on() -> None:
    encoding = HistoryEncoding(2, 1)
    seen = encoding(torch.arange(9.0)[None])
    assert seen.shape[1] == 9 + encoding.num_added
    assert seen[0, 5:9].tolist() == [5.0, 6.0, 7.0, 8.0]


def test_an_actor_for_export_answers_as_the_actor_does() -> None:
    torch.manual_seed(0)
    groups = {"policy": torch.randn(6, 133), "guide": torch.randn(6, 4)}
    seen = TensorDict(groups, batch_size=[6])
    config = CONFIG | {"class_name": "brokk_rl.rl.networks:HistoryModel"}
    actor = make_actor(config | {"num_samples": 13, "num_joints": 5}, GROUPS, seen, 5)
    assert isinstance(actor, HistoryModel)
    assert torch.equal(PlainActor(actor)(groups), actor(seen))
    plain = make_actor(CONFIG | {"class_name": "MLPModel"}, GROUPS, seen, 5)
    assert type(plain) is MLPModel
    assert plain.mlp[0].in_features == 137 and actor.mlp[0].in_features == 137 + 32
