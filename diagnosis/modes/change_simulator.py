"""`brokk mode=change_simulator`: writes findings of a diagnosis as changes of the simulator that was diagnosed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from diagnosis import answer, effect_library, effects_file
from diagnosis.answer import Answer
from diagnosis.own_simulator import OwnSimulator

MJCF_FILE = "changed.xml"
CHANGES_FILE = "changes.json"


@spec
class ChangeRequest:
    """Findings to write.

    Attributes:
        diagnosis: Run folder of `mode=diagnose`.
    """

    diagnosis: str


@spec
class ChangeSimulator:
    """Write what a diagnosis found as changes of the simulator.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        simulator: The simulator that was diagnosed: an MJCF file, or `module:function`.
        changes: Which findings, and what to write.
    """

    session: Session
    machine: Machine
    simulator: str
    changes: ChangeRequest

    def check(self) -> None:
        OwnSimulator(source=self.simulator)

    def run(self) -> None:
        """Write the files.

        Raises:
            RecordingError: The diagnosis cannot be read.
            ConfigError: The MJCF file does not have the machine's joints, or nothing was found.
            StorageError: A file could not be written.
        """
        self.session.seed_all()
        torch.set_num_threads(1)  # small tensors: threads would only wait for each other
        folder = self.session.folder
        given = answer.read_answer(Path(self.changes.diagnosis) / answer.ANSWER_FILE)
        if not given.selected:
            raise ConfigError(
                f"changes.diagnosis={self.changes.diagnosis}: its verdict is '{given.verdict}', so there is nothing to change"
            )
        own = OwnSimulator(source=self.simulator)
        kinds = effect_library.load_effects(self.machine, None, own)
        folder.mkdir(parents=True, exist_ok=True)
        effects_file.write_ranges(given, kinds, folder / effects_file.RANGES_FILE)
        told: dict[str, Any] = {"changes": [], "not_in_the_file": {}}
        if own.path is not None:
            told = self._change_file(own.path, given)
        write_json(folder / CHANGES_FILE, told)
        _print(told, effects_file.describe_parts(given), folder)

    def _change_file(self, path: Path, given: Answer) -> dict[str, Any]:
        """Write the changed MJCF; return what was done."""
        from diagnosis.mjcf import changes as mjcf_changes  # MuJoCo is not in every installation

        changed = self.session.folder / MJCF_FILE
        changes, left = mjcf_changes.write_changed_mjcf(path, self.machine, given.selected, changed)
        return {"changes": [asdict(one) for one in changes], "not_in_the_file": left}


def _print(told: dict[str, Any], parts: Sequence[str], folder: Path) -> None:
    if told["changes"]:
        rows = []
        for one in told["changes"]:
            changed = f"{one['element']} {one['attribute']}"
            numbers = (f"{one['before']:.4g}", f"{one['after']:.4g}")
            rows.append((one["effect"], one["joint"], changed, *numbers))
        print_table(("finding", "joint", "attribute", "before", "after"), rows)
    for name, reason in told["not_in_the_file"].items():
        print_text(f"not in {MJCF_FILE}: {name}: {reason}")
    for part in parts:
        print_text(part)
    print_text(f"written: {folder}")
