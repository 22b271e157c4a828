"""Table of the parts of an MJCF that each backend simulates, with its measured parity."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.status import Status
from rich.table import Table

from brokk_rl.errors import ConfigError
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.model_features import BACKENDS, FEATURES, list_left_out, list_unknown_fields

if TYPE_CHECKING:
    import torch

    from brokk_rl.machine import Machine
    from brokk_rl.sim.simulator import WarpSimulator

WORDS = {"native": "sim=native", "staged": "sim.fused=false", "fused": "sim=warp"}


def inspect_machine(
    machine: Machine, simulator: WarpSimulator, device: torch.device
) -> dict[str, Any]:
    """Return the parts that each backend simulates of a machine, as plain JSON data.

    Args:
        machine: The machine.
        simulator: Gives substeps and buffers; both of its backends are measured.
        device: Where `sim=warp` runs. Its kernels are compiled at the first use, for some minutes.

    Raises:
        ConfigError: The machine has no MJCF, or it is not valid.
    """
    model = compile_model(machine, machine.period_s / simulator.substeps)
    found: dict[str, Any] = {
        "machine": machine.name,
        "joints": model.njnt,
        "parts": {
            one.name: [name for name in BACKENDS if name in one.backends]
            for one in FEATURES
            if one.is_used(model)
        },
        "unknown_fields": list_unknown_fields(model),
        "backends": {"native": {"left_out": list_left_out(model, "native")}},
    }
    for backend in ("staged", "fused"):
        row: dict[str, Any] = {"left_out": list_left_out(model, backend)}
        if not row["left_out"]:
            row |= _measure(machine, simulator, backend == "fused", device)
        found["backends"][backend] = row
    return found


def show_machine(found: dict[str, Any]) -> None:
    """Print the result of `inspect_machine`."""
    console = Console()
    title = f"{found['machine']}: parts of the MJCF that not every backend simulates"
    table = Table(title=title, box=None, padding=(0, 2, 0, 0), title_justify="left")
    for name in ("part", *(WORDS[backend] for backend in BACKENDS)):
        table.add_column(name)
    for part, backends in found["parts"].items():
        table.add_row(part, *("yes" if name in backends else "no" for name in BACKENDS))
    if not found["parts"]:
        table.add_row("none", *["yes"] * len(BACKENDS))
    console.print(table)
    for backend in ("staged", "fused"):
        row = found["backends"][backend]
        said = row.get("parity") or "left out, not simulated: " + ", ".join(row["left_out"])
        console.print(f"{WORDS[backend]}: {said}", highlight=False, soft_wrap=True)


def _measure(
    machine: Machine, simulator: WarpSimulator, is_fused: bool, device: torch.device
) -> dict[str, Any]:
    """Return the figures of one backend against MuJoCo C."""
    from brokk_rl.sim.parity import measure_parity

    num_worlds = simulator.parity_worlds or 64
    chosen = dataclasses.replace(simulator, fused=is_fused, parity_worlds=0)
    with Status(f"comparing {WORDS['fused' if is_fused else 'staged']} with MuJoCo C"):
        try:
            world = chosen.build(machine, device, num_worlds)
        except ConfigError as error:
            return {"left_out": [str(error)]}
        result = measure_parity(world, machine, simulator.substeps)
    return {
        "parity": result.describe(),
        "is_alike": result.is_alike,
        "position_error": float(result.position_error.max()),
        "force_error": float(result.force_error.max()),
        "num_touching": result.num_touching,
        "num_different": result.num_different,
    }
