"""Parts of an MJCF that a backend is known to leave out, and that a comparison would not show.

MuJoCo C (`sim=native`) simulates all of MuJoCo. `sim=warp` leaves stages out so that a control step
takes few launches, and our kernels (`sim.fused`) write the dynamics of a chain of links on servos
anew. Whether that is the motion of the machine at hand is measured when its worlds are built
(`brokk_rl.sim.parity`). Named here are only parts that act late, seldom, or in MuJoCo C as wrongly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import mujoco
import numpy as np

from brokk_rl.errors import ConfigError

Backend = Literal["native", "staged", "fused"]
"""`native` is MuJoCo C, `staged` is `sim=warp sim.fused=false`, `fused` is `sim=warp`."""
WORDS: dict[Backend, str] = {
    "native": "sim=native",
    "staged": "sim.fused=false",
    "fused": "sim=warp",
}

MAX_DOFS = 16
"""Up to here Warp unrolls the loops over degrees of freedom; beyond, a solver for any size is the
better one."""

_DISABLE = mujoco.mjtDisableBit
_NEEDED = _DISABLE.mjDSBL_ACTUATION | _DISABLE.mjDSBL_SENSOR | _DISABLE.mjDSBL_AUTORESET
"""Parts of MuJoCo that a world cannot do without: drives, contact forces from sensors, and the word
about a world that diverges."""


def _has_branches(model: mujoco.MjModel) -> bool:
    return bool((model.dof_parentid != np.arange(-1, model.nv - 1)).any())


def _has_changed_touch(model: mujoco.MjModel) -> bool:
    is_touch = model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH
    values = (model.sensor_cutoff, model.sensor_delay, model.sensor_interval[:, 0])
    return any((value[is_touch] != 0).any() for value in values)


FEATURES: dict[str, tuple[Callable[[mujoco.MjModel], Any], tuple[Backend, ...]]] = {
    "a flag actuation=disable, sensor=disable or autoreset=disable": (
        lambda model: model.opt.disableflags & _NEEDED,
        (),
    ),
    "mocap bodies of its own": (lambda model: model.nmocap > 1, ()),
    "flags that switch a part of MuJoCo on": (lambda model: model.opt.enableflags, ("native",)),
    "friction in joints": (lambda model: model.dof_frictionloss.any(), ("native",)),
    "springs that yield": (
        lambda model: model.nplastic or model.jnt_springyield.any(),
        ("native",),
    ),
    "touch sensors with cut-off, delay or interval": (_has_changed_touch, ("native",)),
    "tendons": (lambda model: model.ntendon, ("native",)),
    "equalities": (lambda model: model.neq, ("native",)),
    "deformable bodies": (lambda model: model.nflex, ("native",)),
    "plugins": (lambda model: model.nplugin, ("native",)),
    "branches": (_has_branches, ("native", "staged")),
    f"more than {MAX_DOFS} joints": (lambda model: model.nv > MAX_DOFS, ("native", "staged")),
}
"""By name: whether a model has the part, and the backends that simulate it. Found by comparing the
backends' sources for MuJoCo 4.0.0 and mujoco_warp 4.0.0."""


def list_left_out(model: mujoco.MjModel, backend: Backend) -> list[str]:
    """Return the parts of a model that a backend does not simulate, as an error names them."""
    found = []
    for name, (is_used, backends) in FEATURES.items():
        if backend not in backends and is_used(model):
            found.append(name)
    return found


def check_simulated(model: mujoco.MjModel, machine: str, backend: Backend) -> None:
    """Raise a `ConfigError` for a model with parts that a backend does not simulate.

    Args:
        model: The compiled model.
        machine: Name of the machine, for the message.
        backend: The backend that is about to simulate it.
    """
    if not (found := list_left_out(model, backend)):
        return
    others = [words for other, words in WORDS.items() if not list_left_out(model, other)]
    instead = f", or choose {' or '.join(others)}" if others else ""
    raise ConfigError(
        f"machine {machine}: {WORDS[backend]} simulates a chain of links driven by servos, but the "
        f"MJCF has {', '.join(found)}; remove that from the MJCF{instead}"
    )
