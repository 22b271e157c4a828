"""Building: each node once, what needs torch last, and messages with the key as it is typed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from brokk_rl import build, extensions
from brokk_rl.build import build_node
from brokk_rl.errors import ConfigError

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
