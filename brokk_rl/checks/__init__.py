"""Is it a valid actuator, effect, task or finder? What these checkers accept is one.

Each builds the object, exercises it against the promises of its Protocol in `brokk_rl.contracts`,
and raises an `AssertionError` that says which promise was broken. Our own tests run them over every
option of each config group; an extension over its own:

    def test_my_actuator_is_an_actuator():
        check_actuator(MyActuator(gain=1.0), machine)
"""

from brokk_rl.checks.actuator import check_actuator, check_actuator_model, check_effect
from brokk_rl.checks.exercise import NUM_ENVS
from brokk_rl.checks.perception import check_finder
from brokk_rl.checks.task import check_task

__all__ = [
    "NUM_ENVS",
    "check_actuator",
    "check_actuator_model",
    "check_effect",
    "check_finder",
    "check_task",
]
