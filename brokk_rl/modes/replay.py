"""`brokk mode=replay`: plays a recorded fault of the simulator through MuJoCo C."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from rich.table import Table

from brokk_rl.console_table import print_table
from brokk_rl.machine import Machine
from brokk_rl.sim.fault_recorder import Fault, load_fault
from brokk_rl.sim.fault_replay import PlayedStep, describe_cause, play_fault
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

NUM_SHOWN = 12
"""Newest control steps in the table. Chosen by hand: a divergence takes few."""


@spec
class ReplayRequest:
    """Selection of a fault.

    Attributes:
        fault: File of `mode=train`, `<run folder>/faults/*.npz`.
        video: File of a film (mp4) to write; `null` for none.
    """

    fault: str
    video: str | None


@spec
class Replay:
    """Plays a recorded fault of the simulator through MuJoCo C and says what began it.

    Attributes:
        machine: The machine, as in the training.
        replay: What to play.
    """

    machine: Machine
    replay: ReplayRequest

    def run(self) -> None:
        """Print the last steps and the cause; write the film.

        Raises:
            ConfigError: The file is no fault, or of another machine.
        """
        fault = load_fault(Path(self.replay.fault))
        played = play_fault(fault, self.machine)
        _print_steps(played, self.machine)
        log.info("%s", describe_cause(fault, self.machine))
        if played[-1].is_fault:
            log.info("MuJoCo C diverges too")
        else:
            log.info("MuJoCo C does not diverge: the simulators differ, or rounding decides")
        if self.replay.video:
            self._render(fault, Path(self.replay.video))

    def _render(self, fault: Fault, path: Path) -> None:
        """Write a film of the recorded states that are finite."""
        from brokk_rl.sim.video import RenderJob, render_video

        q = fault.states["q"][:-1]
        num = int(np.isfinite(q).all(1).sum())
        episode = RenderJob(
            machine=self.machine,
            q=q[:num],
            u=np.zeros_like(q[:num]),
            force_n=np.zeros(num),
            scene=fault.scene,
            target_m=None,
            path=path,
        )
        render_video(self.machine, episode, path)
        log.info("film: %s", path)


def _print_steps(played: list[PlayedStep], machine: Machine) -> None:
    table = Table("step", *machine.joint_names, "top speed", "contact", "from the record", "fault")
    for index in range(max(0, len(played) - NUM_SHOWN), len(played)):
        step = played[index]
        table.add_row(
            str(index - len(played) + 1),
            *(f"{value:.3f}" for value in step.q),
            f"{step.top_speed:.2f}",
            f"{step.contact_force_n / 1000:,.1f} kN",
            f"{step.difference:.1e}",
            "yes" if step.is_fault else "no",
        )
    table.caption = "Positions in rad or m after each control step of MuJoCo C, the last is 0."
    print_table(table)
