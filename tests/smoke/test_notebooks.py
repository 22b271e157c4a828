"""The notebooks of the documentation run from their first cell to their last, and find what they tell."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import nbclient
import nbformat
import pytest

pytestmark = pytest.mark.slow

NOTEBOOKS = Path(__file__).resolve().parents[2] / "docs/tutorials"


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    monkeypatch.setenv("PATH", path)
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    place = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(notebook, timeout=1200, resources=place).execute()


def test_logs_become_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("logs_to_policy", tmp_path, monkeypatch)
    assert len(list((tmp_path / "logs").glob("*.csv"))) == 3
    policies = json.loads((tmp_path / "runs/policy/evaluation.json").read_text())["policies"]
    assert policies["trained"]["success_strict"]["mean"] > 0.5


def test_a_withheld_effect_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("withheld_effect", tmp_path, monkeypatch)
    answer = json.loads((tmp_path / "runs/diagnosis/diagnosis.json").read_text())
    assert answer["verdict"] == "effects"
    assert "asymmetry" in (tmp_path / "runs/diagnosis/effects.yaml").read_text()


def test_the_python_api_finds_what_the_servos_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("diagnosis_in_python", tmp_path, monkeypatch)
    answer = json.loads((tmp_path / "diagnosis/diagnosis.json").read_text())
    found = {one["effect"]: one["joints"] for one in answer["selected"]}
    assert answer["verdict"] == "effects"
    assert {"backlash", "dead_time"} <= set(found)
    assert "turn" not in found.get("sag", [])  # it has no weight
    gap = {one["effect"]: one["parameters"] for one in answer["selected"]}["backlash"]["gap_rad"]
    for value in gap.values():  # twice the friction over the stiffness: 2 * 6 / 600
        assert value["mean"] == pytest.approx(0.02, rel=0.2)
