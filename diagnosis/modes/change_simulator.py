"""`brokk mode=change_simulator`: writes findings of a diagnosis as changes of the simulator that was diagnosed."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch

from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from diagnosis import answer, effect_library, effects_file
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
        changes, left = [], {}
        if own.path is not None:
            from diagnosis.mjcf import changes as mjcf  # MuJoCo is not in every installation

            about = own.path, self.machine, given.selected
            changes, left = mjcf.write_changed_mjcf(*about, folder / MJCF_FILE)
        told = {"changes": [asdict(one) for one in changes], "not_in_the_file": left}
        write_json(folder / CHANGES_FILE, told)
        rows = []
        for one in changes:
            attribute = f"{one.element} {one.attribute}"
            rows.append((one.effect, one.joint, attribute, f"{one.before:.4g}", f"{one.after:.4g}"))
        if rows:
            print_table(("finding", "joint", "attribute", "before", "after"), rows)
        for name, reason in left.items():
            print_text(f"not in {MJCF_FILE}: {name}: {reason}")
        for part in effects_file.describe_parts(given):
            print_text(part)
        print_text(f"written: {folder}")
