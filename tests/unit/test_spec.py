"""Specs: what may be written for a field, and what is refused."""

from __future__ import annotations

import pytest

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


@spec
class Budget:
    """A spec with a count and a duration."""

    steps: int | None
    seconds: float


def test_numbers_are_taken_as_people_write_them() -> None:
    budget = Budget(steps=48e6, seconds=60)  # type: ignore[arg-type]
    assert (budget.steps, type(budget.steps)) == (48_000_000, int)
    assert (budget.seconds, type(budget.seconds)) == (60.0, float)


@pytest.mark.parametrize("steps", [1.5, float("nan"), float("inf"), True, "many"])
def test_what_is_no_whole_number_is_refused(steps: object) -> None:
    with pytest.raises(ConfigError, match=r"Budget\.steps: expected int"):
        Budget(steps=steps, seconds=1.0)  # type: ignore[arg-type]
