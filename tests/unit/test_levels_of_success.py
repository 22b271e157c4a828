"""Time to success: when a level counts as passed."""

from __future__ import annotations

import pytest

from brokk_rl.modes.train import describe_gain
from brokk_rl.rl.logger import find_passing


def rows(*pairs: tuple[int, float]) -> list[dict[str, float]]:
    return [
        {"episodes": count, "episode/success_strict": success, "seconds": float(index)}
        for index, (count, success) in enumerate(pairs)
    ]


def test_a_level_is_passed_by_the_newest_episodes_and_not_by_few_of_them() -> None:
    # newest 20 episodes: 0.5, then 0.75 twice, then 1
    found = rows((10, 0.0), (10, 1.0), (10, 0.5), (10, 1.0), (10, 1.0))
    assert find_passing(found, 0.7, window=20)["seconds"] == 2.0
    assert find_passing(found, 0.95, window=20)["seconds"] == 4.0
    assert find_passing(found[:4], 0.95, window=20) is None
    assert find_passing(rows((19, 1.0)), 0.95, window=20) is None
    # the first episodes to end are the short ones, and those succeed
    early = rows((20, 1.0), (10, 0.5), (10, 0.5), (20, 1.0))
    for number, row in enumerate(early, 1):
        row["env_steps"] = 100.0 * number
    assert find_passing(early, 0.95, window=20)["seconds"] == 0.0
    assert find_passing(early, 0.95, after=100, window=20)["seconds"] == 3.0
    # an iteration without an episode repeats older figures, which count for nothing
    assert find_passing(rows((10, 0.0), (0, 1.0), (10, 0.0)), 0.5, window=20) is None


@pytest.mark.parametrize(
    ("successes", "verdict"),
    # of 1,024 each, against 973
    [(979, "no gain shown"), (1015, "better than the controller by 0.041"), (900, "no gain shown")],
)
def test_a_gain_over_the_controller_is_said_only_where_it_is_shown(
    successes: int, verdict: str
) -> None:
    trained, controller = (
        {"episodes": 1024, "success_strict": {"mean": count / 1024}} for count in (successes, 973)
    )
    assert describe_gain(trained, controller, "success_strict").endswith(verdict)
