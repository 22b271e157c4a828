"""Is it a valid actuator, effect, excitation, follower, task, world, finder or link? What these checkers accept is one.

Each builds the object, exercises it against the promises of its Protocol in `brokk_rl.contracts`,
and raises an `AssertionError` that says which promise was broken. Our own tests run them over every
option of each config group; an extension over its own:

    def test_my_actuator_is_an_actuator():
        check_actuator(MyActuator(gain=1.0), machine)
"""

from brokk_rl.checks.actuator import (
    check_actuator,
    check_actuator_model,
    check_effect,
    check_follower,
)
from brokk_rl.checks.exercise import NUM_ENVS
from brokk_rl.checks.link import check_excitation, check_link
from brokk_rl.checks.perception import check_finder
from brokk_rl.checks.task import check_task
from brokk_rl.checks.world import check_world

__all__ = [
    "NUM_ENVS",
    "check_actuator",
    "check_actuator_model",
    "check_effect",
    "check_excitation",
    "check_finder",
    "check_follower",
    "check_link",
    "check_task",
    "check_world",
]
