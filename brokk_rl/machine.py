"""The machine: joints, limits, geometry, control rate and levers, read from one YAML file.

Training, recordings and the machine's own computer must agree on these numbers. `fingerprint`
stamps them onto every file, so a policy of another machine is refused when it is loaded. This
module needs neither torch nor MuJoCo.
"""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import MinLen

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.registry import find_packages, resolve_package_path
from brokk_rl.spec import Count, NonNegative, Positive, spec

ASSETS = Path(__file__).parent / "sim/assets"
"""Folder of the MJCF files of this package."""

JointPart = Literal["slew", "arm_1", "arm_2", "arm_3", "boom", "stick", "bucket", "tool"]
"""Parts of demolition machines and excavators; the operator's page has a word and an icon for each."""

CommandInterface = Literal["valve", "velocity", "position", "torque"]
"""Quantity that a command of a joint sets. A command of 1 is for `valve` and `velocity` the joint's
`max_speed`, for `position` a target at the upper end of its travel (-1: the lower end), for `torque`
its `max_force`. `valve` is a speed that the load may change, `velocity` one that a drive regulates."""


@spec
class Dimension:
    """A number of the machine with its source.

    Attributes:
        value: The number, in the unit that its key names.
        source: Data sheet, measurement, paper, or how it was estimated.
        confidence: Trust in the number; randomise a number of low confidence widely.
    """

    value: float
    source: str
    confidence: Literal["low", "medium", "high"]


@spec
class Body:
    """The link behind a joint: geometry, mass, and the force of its cylinder.

    Attributes:
        axis: Unit axis of the joint in the frame of the parent link, right-handed.
        origin_m: Position of the joint in the frame of the parent link.
        mass_kg: Mass of the link.
        com_m: Centre of mass of the link in its own frame.
        yield_force: Largest force (N) or torque (Nm) beyond the weight with which the joint pushes
            before its relief valve opens.
        stiffness: Stiffness of the closed cylinder seen at the joint (Nm/rad or N/m).
    """

    axis: tuple[float, float, float]
    origin_m: tuple[Dimension, Dimension, Dimension]
    mass_kg: Dimension
    com_m: tuple[float, float, float]
    yield_force: Dimension
    stiffness: Dimension

    def check(self) -> None:
        if abs(float(np.linalg.norm(self.axis)) - 1.0) > 1e-6:
            raise ConfigError(f"body: axis {self.axis} is not a unit vector")


@spec
class Joint:
    """One actuated joint.

    Attributes:
        name: `q1`, `q2`, …; names the columns of recordings and the joint of the MJCF.
        part: Part that it moves: people read its word and see its icon; `null`: its name.
        kind: `hinge` (rad) or `slide` (m).
        lower: Lower end of travel (rad or m).
        upper: Upper end of travel.
        home: Position to which data collection returns.
        max_speed: Speed at full command (rad/s or m/s), the slower of both directions.
        body: The link behind it; `null` where it is not known: such a machine can be recorded and
            identified, but not simulated.
        command: Quantity that its command sets; see `CommandInterface`.
        max_force: Force (N) or torque (Nm) at full command; a joint commanded by torque needs it.
    """

    name: str
    part: JointPart | None
    kind: Literal["hinge", "slide"]
    lower: Dimension
    upper: Dimension
    home: float
    max_speed: Dimension
    body: Body | None
    command: CommandInterface = "valve"  # as files from before this field mean
    max_force: Dimension | None = None  # files from before this field lack it

    @property
    def unit(self) -> str:
        """`rad` or `m`."""
        return "rad" if self.kind == "hinge" else "m"

    def check(self) -> None:
        lower, upper = self.lower.value, self.upper.value
        fault = ""
        if lower >= upper:
            fault = f"expected upper above lower, got {upper} and {lower}"
        elif self.max_speed.value <= 0.0:
            fault = f"expected max_speed above 0, got {self.max_speed.value}"
        elif not lower <= self.home <= upper:
            fault = f"home {self.home} lies outside [{lower}, {upper}]"
        elif self.command == "torque" and (self.max_force is None or self.max_force.value <= 0):
            fault = "command: torque needs max_force, the force or torque at full command, above 0"
        if fault:
            raise ConfigError(f"joint {self.name}: {fault}")


@spec
class Lever:
    """One axis of a lever and the joint it commands (paper, equations 2 and 3).

    Attributes:
        joint: The joint.
        side: Which lever.
        axis: `theta` (fore and aft) or `psi` (sideways).
        max_angle_rad: Lever angle at full command, `alpha_max` of equation 2.
    """

    joint: str
    side: Literal["left", "right"]
    axis: Literal["theta", "psi"]
    max_angle_rad: float


@spec
class Machine:
    """A machine with any number of joints.

    Attributes:
        name: Config name, written into recordings and checkpoints.
        title: What it is, for people.
        mjcf: File name under `brokk_rl/sim/assets`, `package:path` in an installed package, or an
            absolute path; `null` without a model.
        period_s: Control period.
        dead_time_s: Nominal time from command to first motion.
        num_history: Samples of commands and positions that actuator models and policies see.
        joints: In machine order, from the base to the tool.
        tool_m: Tool point (chisel tip) in the frame of the last link; `null`: not known.
        exclusive: Joints that never move together with any other joint.
        levers: Lever axis of each joint.
    """

    name: str
    title: str
    mjcf: str | None
    period_s: Positive
    dead_time_s: NonNegative
    num_history: Count
    joints: Annotated[tuple[Joint, ...], MinLen(1)]
    tool_m: tuple[Dimension, Dimension, Dimension] | None
    exclusive: tuple[str, ...]
    levers: tuple[Lever, ...]

    def check(self) -> None:
        names = self.joint_names
        if len(set(names)) != len(names):
            raise ConfigError(f"machine {self.name}: joint names repeat: {', '.join(names)}")
        for other in (*self.exclusive, *(lever.joint for lever in self.levers)):
            if other not in names:
                raise ConfigError(
                    f"machine {self.name}: '{other}' is none of its joints ({', '.join(names)})"
                )
        if len({_name_family(joint.command) for joint in self.joints}) > 1:
            listed = ", ".join(f"{joint.name}: {joint.command}" for joint in self.joints)
            raise ConfigError(
                f"machine {self.name}: joints are commanded by different quantities ({listed}); expected speeds "
                "(valve, velocity) only, or positions only, or torques only: record and diagnose the parts as machines of their own"
            )
        if self.dead_time_s > (self.num_history - 1) * self.period_s + 1e-9:
            raise ConfigError(
                f"machine {self.name}: {self.num_history} samples of {self.period_s} s do not span the dead time of "
                f"{self.dead_time_s} s; raise num_history"
            )

    def check_sim(self, sim: object) -> None:
        """Refuse a machine that cannot be simulated."""
        self.bodies  # noqa: B018  refuses links that are not known
        self.tip_m  # noqa: B018  refuses a tool point that is not known
        find_mjcf(self)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in machine order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def num_joints(self) -> int:
        """Number of joints, `J`."""
        return len(self.joints)

    @property
    def lower(self) -> np.ndarray:
        """Lower joint limits, shape `(J,)`, rad or m."""
        return np.array([joint.lower.value for joint in self.joints])

    @property
    def upper(self) -> np.ndarray:
        """Upper joint limits, shape `(J,)`, rad or m."""
        return np.array([joint.upper.value for joint in self.joints])

    @property
    def home(self) -> np.ndarray:
        """Home position, shape `(J,)`, rad or m."""
        return np.array([joint.home for joint in self.joints])

    @property
    def max_speed(self) -> np.ndarray:
        """Speed at full command, shape `(J,)`, rad/s or m/s."""
        return np.array([joint.max_speed.value for joint in self.joints])

    @property
    def is_exclusive(self) -> np.ndarray:
        """True for joints that never move together with others, shape `(J,)`."""
        return np.array([name in self.exclusive for name in self.joint_names])

    @property
    def interface(self) -> Literal["speed", "position", "torque"]:
        """Quantity that commands set: `speed` for `valve` and `velocity`."""
        return _name_family(self.joints[0].command)

    @property
    def max_force(self) -> np.ndarray:
        """Force or torque at full command, shape `(J,)`, N or Nm; NaN where the file has none."""
        forces = [joint.max_force.value if joint.max_force else None for joint in self.joints]
        return np.array(forces, float)

    @property
    def has_bodies(self) -> bool:
        """True if geometry and masses are known, as simulation and weight need."""
        return self.tool_m is not None and all(joint.body is not None for joint in self.joints)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The links in machine order.

        Raises:
            ConfigError: The bodies are not known.
        """
        bodies = tuple(joint.body for joint in self.joints if joint.body is not None)
        if len(bodies) < self.num_joints:
            raise ConfigError(
                f"machine '{self.name}' is known by its joints only; simulation, weight and tool point need joints[].body (axis, "
                "origin, mass, …) in its file, or another machine=…"
            )
        return bodies

    @property
    def tip_m(self) -> np.ndarray:
        """Tool point in the frame of the last link, `(3,)`.

        Raises:
            ConfigError: The tool point is not known.
        """
        if self.tool_m is None:
            raise ConfigError(
                f"machine '{self.name}' has no tool point; add tool_m to its file, or choose another machine=…"
            )
        return np.array([d.value for d in self.tool_m])

    def fingerprint(self) -> dict[str, str]:
        """Return a short hash of each group of fields that files of this machine must share.

        Names, order, limits, geometry, rate and masks count. Sources, confidences, titles and home
        positions do not.
        """
        geometry: list[list[float] | None] = []
        for joint in self.joints:
            body = joint.body
            geometry.append(body and [d.value for d in body.origin_m] + [*body.axis])
        groups = {
            "name": self.name,
            "joints": [_list_traits(joint) for joint in self.joints],
            "limits": [self.lower.tolist(), self.upper.tolist()],
            "geometry": [geometry, None if self.tool_m is None else self.tip_m.tolist()],
            "control": [self.period_s, self.num_history, list(self.exclusive)],
            "levers": [asdict(lever) for lever in self.levers],
        }
        texts = {key: json.dumps(value).encode() for key, value in groups.items()}
        return {key: hashlib.sha256(text).hexdigest()[:12] for key, text in texts.items()}

    def list_differences(self, other: dict[str, str]) -> list[str]:
        """Return the groups of fields in which the fingerprint `other` differs."""
        return [group for group, stamp in self.fingerprint().items() if other.get(group) != stamp]

    def check_fingerprint(self, other: dict[str, str], what: str) -> None:
        """Refuse a fingerprint `other` of the file `what` that differs.

        Raises:
            CheckpointError: Groups of fields differ; the message names them.
        """
        if differing := self.list_differences(other):
            raise CheckpointError(
                f"{what} was made for another machine: {', '.join(differing)} differ from machine '{self.name}'. "
                "Choose the machine it was made for (machine=…) or make it again for this one."
            )


def find_mjcf(machine: Machine) -> Path:
    """Return the path of the machine's MJCF.

    A file name is looked up in this package, then beside the machines of installed extensions.

    Raises:
        ConfigError: The machine names none, or there is no such file.
    """
    if machine.mjcf is None:
        raise ConfigError(
            f"machine {machine.name} has no MJCF and cannot be simulated; set `mjcf`, or choose "
            "another machine=…"
        )
    beside = [folder / "machine" for folder in find_packages().values()]
    for folder in (ASSETS, *beside):
        path = folder / resolve_package_path(machine.mjcf)
        if path.is_file():
            return path
    raise ConfigError(
        f"machine {machine.name}: there is no MJCF '{machine.mjcf}'; set `mjcf` to the name of a file "
        "beside the machine's YAML in a config package, to package:path, or to an absolute path"
    )


def _name_family(command: CommandInterface) -> Literal["speed", "position", "torque"]:
    if command == "position" or command == "torque":
        return command
    return "speed"


def _list_traits(joint: Joint) -> list[object]:
    """Return name, kind and interface of a joint; the files of valves have no interface yet."""
    traits: list[object] = [joint.name, joint.kind]
    if joint.command != "valve":
        traits.append(joint.command)
    if joint.max_force is not None:
        traits.append(joint.max_force.value)
    return traits


def mask_exclusive_joints(is_exclusive: Any, positioning: Any) -> Any:
    """Return the joints that may be commanded: exclusive ones while positioning, else the others.

    These are the paper's masks [0, 1, 0, 0, 0] and [1, 0, 1, 1, 1]. Tasks, excitations, guard and
    levers all call this function.

    Args:
        is_exclusive: `Machine.is_exclusive`, `(J,)` bool, numpy or torch.
        positioning: One bool, or an array of the same kind, `(…,)`.

    Returns:
        `(J,)` for one bool, else `(…, J)`.
    """
    return is_exclusive == (
        positioning[..., None] if getattr(positioning, "ndim", 0) else positioning
    )
