"""List of every field of a MuJoCo model, and of the backends that simulate it.

MuJoCo C (`sim=native`) simulates all of MuJoCo. `sim=warp` leaves stages out so that a control step
takes few launches, and our kernels (`sim.fused`) write the dynamics of one kind of machine anew: a
chain of links whose joints are driven by servos. A model with more than that would be simulated
wrongly without a word. So every field of MuJoCo's model stands in one of three lists: simulated by
all backends, without effect on motion, or part of a feature that only some backends simulate. A
field that stands in none of them is new in MuJoCo; a model that uses it is refused by name.

`brokk_rl.sim.parity` measures the same on the machine at hand.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from brokk_rl.errors import ConfigError

Backend = Literal["native", "staged", "fused"]
"""`native` is MuJoCo C, `staged` is `sim=warp sim.fused=false`, `fused` is `sim=warp`."""
BACKENDS: tuple[Backend, ...] = ("native", "staged", "fused")
_NONE: frozenset[Backend] = frozenset()
_NATIVE: frozenset[Backend] = frozenset({"native"})
_NOT_FUSED: frozenset[Backend] = frozenset({"native", "staged"})

MAX_DOFS = 16
"""Up to here Warp unrolls the loops over degrees of freedom; beyond, a solver for any size is the
better one."""

_DISABLE = mujoco.mjtDisableBit
_SHARED_FLAGS = (
    _DISABLE.mjDSBL_GRAVITY
    | _DISABLE.mjDSBL_CONSTRAINT
    | _DISABLE.mjDSBL_CONTACT
    | _DISABLE.mjDSBL_LIMIT
    | _DISABLE.mjDSBL_FILTERPARENT
    | _DISABLE.mjDSBL_REFSAFE
    | _DISABLE.mjDSBL_CLAMPCTRL
    | _DISABLE.mjDSBL_WARMSTART
    | _DISABLE.mjDSBL_MIDPHASE
    | _DISABLE.mjDSBL_EULERDAMP
    | _DISABLE.mjDSBL_ISLAND
    | _DISABLE.mjDSBL_EQUALITY
    | _DISABLE.mjDSBL_FRICTIONLOSS
    | _DISABLE.mjDSBL_SPRING
    | _DISABLE.mjDSBL_DAMPER
)
"""Flags that all backends obey, or that only leave out what the features below refuse anyway."""
_UNREAD_FLAGS = _DISABLE.mjDSBL_SENSOR | _DISABLE.mjDSBL_AUTORESET
"""Flags that a world cannot do without: contact forces are read from sensors, and a world that
diverges must be told."""


@dataclass(frozen=True)
class ModelFeature:
    """A part of MuJoCo's models that not every backend simulates.

    Attributes:
        name: As an error names it.
        fields: Fields of `MjModel` that belong to it; those of its options begin with `opt.`.
        is_used: Whether a model has it.
        backends: Which simulate it.
    """

    name: str
    fields: tuple[str, ...]
    is_used: Callable[[mujoco.MjModel], Any]
    backends: frozenset[Backend]


def _is_set(*names: str) -> Callable[[mujoco.MjModel], bool]:
    """Return a function that says whether any of these fields of a model is not zero."""

    def is_used(model: mujoco.MjModel) -> bool:
        return any(np.any(read_field(model, name)) for name in names)

    return is_used


def _has_branches(model: mujoco.MjModel) -> bool:
    return bool((model.dof_parentid != np.arange(-1, model.nv - 1)).any())


def _has_other_drives(model: mujoco.MjModel) -> bool:
    """Return whether the drive differs from the one servo a joint that `brokk_rl.sim.drive` adds."""
    gear = np.zeros_like(model.actuator_gear)
    gear[:, 0] = 1.0
    return (
        model.nu != model.njnt
        or (model.actuator_trnid[:, 0] != np.arange(model.njnt)).any()
        or (model.actuator_gear != gear).any()
        or model.actuator_ctrllimited.any()
        or model.actuator_actlimited.any()
    )


def _has_changed_touch(model: mujoco.MjModel) -> bool:
    is_touch = model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH
    values = (model.sensor_cutoff, model.sensor_delay, model.sensor_interval[:, 0])
    return any((value[is_touch] != 0).any() for value in values)


FEATURES: tuple[ModelFeature, ...] = (
    ModelFeature("branches", ("dof_parentid",), _has_branches, _NOT_FUSED),
    ModelFeature(f"more than {MAX_DOFS} joints", ("nv",), lambda m: m.nv > MAX_DOFS, _NOT_FUSED),
    ModelFeature("friction in joints", ("dof_frictionloss",), _is_set("dof_frictionloss"), _NATIVE),
    ModelFeature(
        "springs in joints",
        ("jnt_stiffness", "jnt_stiffnesspoly", "qpos_spring"),
        _is_set("jnt_stiffness", "jnt_stiffnesspoly"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "springs that yield",
        ("jnt_springyield", "jnt_plasticadr", "nplastic", "key_plastic"),
        lambda m: m.nplastic or np.any(m.jnt_springyield),
        _NATIVE,
    ),
    ModelFeature(
        "dampers in joints",
        ("dof_damping", "dof_dampingpoly"),
        _is_set("dof_damping", "dof_dampingpoly"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "limits of a joint's effort (actuatorfrcrange)",
        ("jnt_actfrclimited", "jnt_actfrcrange"),
        _is_set("jnt_actfrclimited"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "drives other than the machine's servos",
        (
            "nu",
            "nactuator",
            "na",
            "nout",
            "actuator_trntype",
            "actuator_trnid",
            "actuator_gear",
            "actuator_ctrllimited",
            "actuator_ctrlrange",
            "actuator_actlimited",
            "actuator_actrange",
        ),
        _has_other_drives,
        _NONE,
    ),
    ModelFeature(
        "inertia or damping of actuators",
        ("actuator_armature", "actuator_damping", "actuator_dampingpoly"),
        _is_set("actuator_armature", "actuator_damping", "actuator_dampingpoly"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "delay of actuators",
        ("actuator_delay", "actuator_history", "actuator_historyadr", "nhistory"),
        _is_set("actuator_delay", "actuator_history"),
        _NATIVE,
    ),
    ModelFeature(
        "early activation", ("actuator_actearly",), _is_set("actuator_actearly"), _NOT_FUSED
    ),
    ModelFeature(
        "actuators that are switched off",
        ("actuator_group", "opt.disableactuator"),
        _is_set("opt.disableactuator"),
        _NONE,
    ),
    ModelFeature(
        "the flag actuation=disable",
        (),
        lambda m: m.opt.disableflags & _DISABLE.mjDSBL_ACTUATION,
        _NONE,
    ),
    ModelFeature(
        "the flag sensor=disable or autoreset=disable",
        (),
        lambda m: m.opt.disableflags & _UNREAD_FLAGS,
        _NONE,
    ),
    ModelFeature(
        "flags that switch a part of MuJoCo off",
        ("opt.disableflags",),
        lambda m: (
            m.opt.disableflags & ~int(_SHARED_FLAGS | _UNREAD_FLAGS | _DISABLE.mjDSBL_ACTUATION)
        ),
        _NATIVE,
    ),
    ModelFeature(
        "flags that switch a part of MuJoCo on",
        (
            "opt.enableflags",
            "opt.o_margin",
            "opt.o_solref",
            "opt.o_solimp",
            "opt.o_friction",
            "opt.sleep_tolerance",
            "tree_sleep_policy",
        ),
        _is_set("opt.enableflags"),
        _NATIVE,
    ),
    ModelFeature(
        "compensation of gravity",
        ("body_gravcomp", "jnt_actgravcomp", "ngravcomp", "flg_gravcomp"),
        _is_set("body_gravcomp"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "air or fluid",
        ("opt.density", "opt.viscosity", "opt.wind", "geom_fluid"),
        _is_set("opt.density", "opt.viscosity"),
        _NOT_FUSED,
    ),
    ModelFeature(
        "torsional friction (condim above 3)",
        ("geom_condim", "pair_dim"),
        lambda m: (np.concatenate([m.geom_condim, m.pair_dim]) > 3).any(),
        _NOT_FUSED,
    ),
    ModelFeature(
        "adhesion",
        ("geom_adhesion", "pair_adhesion", "flg_adhesion"),
        _is_set("geom_adhesion", "pair_adhesion"),
        _NATIVE,
    ),
    ModelFeature(
        "surfaces that move (surfacevel)",
        ("geom_surfacevel", "flg_surfacevel"),
        _is_set("geom_surfacevel"),
        _NATIVE,
    ),
    ModelFeature(
        "touch sensors with cut-off, delay or interval",
        ("sensor_cutoff", "sensor_delay", "sensor_interval", "sensor_history", "sensor_historyadr"),
        _has_changed_touch,
        _NATIVE,
    ),
    ModelFeature("mocap bodies of its own", ("nmocap",), lambda m: m.nmocap > 1, _NONE),
    ModelFeature("tendons", ("ntendon",), _is_set("ntendon"), _NATIVE),
    ModelFeature("equalities", ("neq",), _is_set("neq"), _NATIVE),
    ModelFeature("deformable bodies", ("nflex",), _is_set("nflex"), _NATIVE),
    ModelFeature("plugins", ("nplugin",), _is_set("nplugin"), _NATIVE),
    ModelFeature(
        "the noslip solver",
        ("opt.noslip_iterations", "opt.noslip_tolerance"),
        _is_set("opt.noslip_iterations"),
        _NATIVE,
    ),
)
"""Found by comparing the backends' sources for MuJoCo 4.0.0 and mujoco_warp 4.0.0; a test holds each
against MuJoCo C (`tests/unit/test_sim_parity.py`)."""

_SIMULATED_BY_ALL = (
    r"body_(parentid|rootid|weldid|mocapid|jntnum|jntadr|dofnum|dofadr|treeid|geomnum|geomadr|simple)",
    r"body_(pos|quat|ipos|iquat|mass|subtreemass|inertia|invweight0|contype|conaffinity|margin)",
    r"body_sameframe|body_plugin",
    r"jnt_(type|qposadr|dofadr|bodyid|limited|solref|solimp|pos|axis|range|margin|actuatorid)|qpos0",
    r"dof_(bodyid|jntid|treeid|Madr|simplenum|solref|solimp|armature|invweight0|M0|length)",
    r"geom_(type|contype|conaffinity|bodyid|dataid|plugin|priority|solmix|solref|solimp|size|aabb)",
    r"geom_(rbound|pos|quat|friction|margin|gap|sameframe)",
    r"pair_(geom1|geom2|signature|solref|solreffriction|solimp|margin|gap|friction)",
    r"exclude_signature|(mesh|hfield)_.*|tree_(body|dof)(adr|num)",
    r"actuator_(dyntype|gaintype|biastype|dynprm|gainprm|biasprm|forcelimited|forcerange|actadr)",
    r"actuator_(actnum|ctrladr|ctrlnum|ctrlspec|outadr|outnum|plugin|acc0|length0|lengthrange)",
    r"actuator_cranklength|sensor_(type|objid|objtype|reftype|refid|adr|dim|datatype|needstage)",
    r"sensor_(intprm|plugin)",
    r"[MDB]_(colind|rowadr|rownnz|diag)|map[MD]2[MD]",
    r"opt\.(timestep|impratio|gravity|integrator|cone|solver|jacobian|iterations|ls_iterations)",
    r"opt\.(tolerance|ls_tolerance|ccd_iterations|ccd_tolerance|sdf_initpoints|sdf_iterations)",
)
"""Read by the stages that all backends share, or written by `brokk_rl.sim.model` for all machines."""
_WITHOUT_EFFECT = (
    r"(cam|light|mat|tex|skin|key|text|tuple|numeric|name|site|bvh|oct)_.*|name_.*|names.*|paths",
    r".*_(user|group|rgba|matid|bvhadr|bvhnum|castshadow)|nuser.*|vis|stat|signature|sensor_noise",
    r"n(B|C|D|M|J).*|n(body|bvh.*|cam|geom|jnt|key|light|mat|pair|site|skin.*|tex.*|text.*|tuple.*)",
    r"n(q|v|tree|exclude|arena|buffer|names|names_map|paths|numeric.*|sensor.*|userdata|wrap)",
    r"n(hfield.*|mesh.*|oct|polygonmax|conmax|jmax|emax|efm.*|flex.+|pluginattr|pluginstate)",
    r"opt\.magnetic",
)
"""Names, pictures, counts and layouts of memory."""
_OF_REFUSED_PARTS = r"plugin|(tendon|ten|wrap|eq|flex|flexedge|plugin|efm0|efmC)_.*"
"""Fields of tendons, equalities, deformable bodies and plugins: their numbers are features above."""

_BARE_MJCF = """<mujoco><worldbody><body><joint/><geom size="1"/><site name="s"/></body></worldbody>
<sensor><touch site="s"/></sensor></mujoco>"""
"""The smallest model with a row in each table of bodies, joints, geoms and sensors: its values are
MuJoCo's defaults."""


def read_field(model: mujoco.MjModel, name: str) -> Any:
    """Return the value of a field of a model, `opt.<name>` for one of its options."""
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)


def list_fields(model: mujoco.MjModel) -> Iterator[str]:
    """Yield the names of all fields that hold data, options with `opt.` before them."""
    for owner, prefix in ((model, ""), (model.opt, "opt.")):
        for name in dir(owner):
            if not name.startswith("_") and name != "opt" and not callable(getattr(owner, name)):
                yield prefix + name


def list_unknown_fields(model: mujoco.MjModel) -> list[str]:
    """Return fields of a model that stand in none of the lists of this module."""
    named = {field for feature in FEATURES for field in feature.fields}
    patterns = (*_SIMULATED_BY_ALL, *_WITHOUT_EFFECT, _OF_REFUSED_PARTS)
    known = re.compile("|".join(f"(?:{pattern})" for pattern in patterns))
    return [name for name in list_fields(model) if name not in named and not known.fullmatch(name)]


def list_left_out(model: mujoco.MjModel, backend: Backend) -> list[str]:
    """Return the parts of a model that a backend does not simulate, as an error names them.

    An unknown field counts for all but `native` where it differs from MuJoCo's default.
    """
    found = [one.name for one in FEATURES if backend not in one.backends and one.is_used(model)]
    if backend != "native":
        bare = mujoco.MjModel.from_xml_string(_BARE_MJCF)
        for name in list_unknown_fields(model):
            if _is_different(read_field(model, name), read_field(bare, name)):
                found.append(f"'{name}', which is new in MuJoCo {mujoco.__version__}")
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
    words = {"native": "sim=native", "staged": "sim.fused=false", "fused": "sim=warp"}
    others = [words[other] for other in BACKENDS if not list_left_out(model, other)]
    instead = f", or choose {' or '.join(others)}" if others else ""
    raise ConfigError(
        f"machine {machine}: {words[backend]} simulates a chain of links driven by servos, but the "
        f"MJCF has {', '.join(found)}; remove that from the MJCF{instead}"
    )


def _is_different(value: Any, default: Any) -> bool:
    """Return whether a value, or a row of it, is not the default's, or is not zero without one."""
    value, default = np.asarray(value), np.asarray(default)
    if value.dtype.kind not in "biuf":
        return False
    expected = default[:1] if default.ndim and len(default) else np.zeros(1, value.dtype)
    return bool((value != (expected if default.ndim else default)).any())
