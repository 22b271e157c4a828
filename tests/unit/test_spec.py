"""Specs: what may be written for a field, and what is refused."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import pytest

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, Positive, PositiveRange, spec


class Motor(Protocol):
    """A motor."""

    def turn(self) -> float:
        """Turn."""
        ...


class Wheel:
    """Something without the method of a motor."""


class Engine:
    """Something with the method of a motor."""

    def turn(self) -> float:
        return 1.0


@spec
class Limits:
    """A spec within another one."""

    highest: Positive


@spec
class Budget:
    """A spec with a field of each kind."""

    steps: Count | None
    seconds: float
    range_m: PositiveRange
    device: Literal["auto", "cpu"]
    motor: Motor
    limits: dict[str, Limits]

    def check(self) -> None:
        if self.steps and self.seconds > self.steps:
            raise ConfigError(f"seconds: expected up to {self.steps}, got {self.seconds}")


GOOD: dict[str, Any] = {
    "steps": 48e6,
    "seconds": 60,
    "range_m": [1, 2],
    "device": "cpu",
    "motor": Engine(),
    "limits": {"q1": {"highest": 2}},
}


def test_values_are_taken_as_people_write_them() -> None:
    budget = Budget(**GOOD)
    assert (budget.steps, type(budget.steps)) == (48_000_000, int)
    assert (budget.seconds, type(budget.seconds)) == (60.0, float)
    assert budget.range_m == (1.0, 2.0)
    assert budget.limits == {"q1": Limits(highest=2.0)}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        *[("steps", value, "Budget.steps: expected a valid integer, got")
          for value in (1.5, float("nan"), float("inf"), True, "many")],
        ("steps", 0, "Budget.steps: expected a number greater than or equal to 1, got 0"),
        ("seconds", float("nan"), "Budget.seconds: expected a finite number, got nan"),
        ("seconds", True, "Budget.seconds: expected a valid number, got true"),
        ("range_m", [2, 1], "Budget.range_m: expected (lowest, highest)"),
        ("range_m", [1], "Budget.range_m: expected more than 1 values, got [1]"),
        ("range_m", [0, 1], "Budget.range_m[0]: expected a number greater than 0, got 0"),
        ("device", "auot", "expected 'auto' or 'cpu', got 'auot'; did you mean 'auto'?"),
        ("motor", Wheel(), "Budget.motor: expected an option of its group (Motor with turn), got Wheel"),
        ("limits", {"q1": {"highest": 0}}, "Budget.limits.q1.highest: expected a number greater than 0"),
        ("limits", {"q1": {"hihgest": 1}}, "has no field 'hihgest'; did you mean 'highest'?"),
        ("limits", {"q1": {}}, "Budget.limits.q1: no highest was given"),
        ("second", 1, "Budget: has no field 'second'; did you mean 'seconds'?"),
        ("steps", 3, "seconds: expected up to 3, got 60.0"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_refused_by_name(field: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError) as told:
        Budget(**GOOD | {field: value})
    assert message in str(told.value)


def test_all_wrong_fields_are_named_at_once() -> None:
    with pytest.raises(ConfigError) as told:
        Budget(**GOOD | {"seconds": "1", "device": "gpu"})
    assert "Budget.seconds" in str(told.value) and "Budget.device" in str(told.value)
