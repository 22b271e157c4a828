"""Specs: what may be written for a field, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, Literal, Protocol

import pytest

from brokk_rl import build, extensions
from brokk_rl.build import build_node
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


PARTS = """
from brokk_rl.errors import ConfigError
from brokk_rl.spec import Positive, spec

@spec
class Fast:
    size_m: Positive
    rate: float
    def check(self) -> None:
        if self.rate > self.size_m:
            raise ConfigError(f"rate: expected up to {self.size_m}, got {self.rate}")
"""
FAST = {"_target_": "some_parts.Fast", "size_m": 2.0, "rate": 1.0}


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that can be imported."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "some_parts", raising=False)
    (tmp_path / "some_parts.py").write_text(PARTS)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (FAST | {"size_m": -1}, "a.b.size_m: expected a number greater than 0, got -1 (change a.b.size_m=…"),
        (FAST | {"rate": 3.0}, "a.b.rate: expected up to 2.0, got 3.0 (change a.b.rate=…"),
        (FAST | {"siez_m": 1}, "a.b: has no field 'siez_m'; did you mean 'size_m'?"),
        ([FAST, FAST | {"rate": "x"}], "a.b[1].rate: expected a valid number, got 'x'"),
    ],
)  # fmt: skip
def test_a_refused_node_is_named_as_typed(node: Any, message: str, parts: None) -> None:
    with pytest.raises(ConfigError) as told:
        build_node(node, "a.b")
    assert message in str(told.value)


def test_each_node_of_a_mode_is_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    call = build._call
    monkeypatch.setattr(build, "_call", lambda *given: built.append(given[2]) or call(*given))
    extensions.load_mode("mode=train", "sim=native", "session.out=unused")
    assert len(built) == len(set(built)) and {"task", "actuator", ""} <= set(built)
    # a node that another one takes in is built there alone
    built.clear()
    extensions.load_mode("mode=collect", "link=simulated", "session.out=unused")
    assert len(built) == len(set(built)) and "link.actuator" in built and "actuator" not in built


def test_torch_that_was_imported_early_is_executed_at_its_first_use() -> None:
    program = """
import sys
from brokk_rl.build import defer_slow_import
with defer_slow_import():
    from actuators.effects import speed
assert "torch" not in sys.modules
assert speed.torch.zeros(2).sum() == 0
assert sys.modules["torch"] is speed.torch
import torch.nn.functional
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_package_whose_import_was_put_off_is_whole_later(tmp_path: Path) -> None:
    (tmp_path / "late" / "part").mkdir(parents=True)
    (tmp_path / "late/__init__.py").write_text("from late.part import quick\nfrom late import slow")
    (tmp_path / "late/part/quick.py").write_text("SIZE_M = 2.0")
    (tmp_path / "late/slow.py").write_text("import torch\nZERO = torch.zeros(1)")
    program = """
from brokk_rl import build
build._try_nodes({"a": {"_target_": "late.Part"}}, ["a"])
import late
assert late.part.quick.SIZE_M == 2.0 and late.slow.ZERO == 0
"""
    subprocess.run([sys.executable, "-c", program], check=True, cwd=tmp_path)
