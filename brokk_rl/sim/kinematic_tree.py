"""Choice of one arm in a model: a chain of hinges and slides among legs, fingers, loops and objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco

from brokk_rl.errors import list_choices
from brokk_rl.sim.model_source import KINDS, ModelSource

LOCK = 1e5
"""Damping beyond which a joint without limits is a lock, as bases in scenes have it (1e11), Nm s/rad."""
_TIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
CLOSES_LOOP = "closes a loop"


@dataclass
class ArmChain:
    """The joints of an arm.

    Attributes:
        joints: From the base to the tool.
        root: Body at its foot.
        left_out: Other joints of the robot.
    """

    joints: list[int]
    root: int
    left_out: list[int] = field(default_factory=list)


class KinematicTree:
    """Joints of a model that a drive can move, and their order.

    Args:
        source: The model.

    Attributes:
        has_cylinders: Whether a slide closes a loop, as hydraulic cylinders do.
    """

    def __init__(self, source: ModelSource) -> None:
        self._source, self.model = source, source.model
        self.has_cylinders = False
        self._passive: dict[int, str] = {}
        for joint in range(self.model.njnt):
            leader = source.followers.get(joint)
            if leader is not None:
                self._passive[joint] = f"follows {leader}, so it is no joint of its own"
            elif int(self.model.jnt_type[joint]) not in KINDS:
                self._passive[joint] = "is neither a hinge nor a slide"
            elif self._is_locked(joint):
                self._passive[joint] = "cannot move: it has no limits and a damping like a lock"
        self._cut_loops()
        self._chains = self._list_chains()

    def choose(self, names: Sequence[str]) -> ArmChain:
        """Return the arm: the one that is named, else the longest chain.

        Args:
            names: Last joint or link, or first and last; empty for the longest.

        Raises:
            ConfigError: There is no chain, several are alike, or a name is unknown.
        """
        joints = self._choose_named(names) if names else self._choose_longest()
        root = self._find_root(joints[0])
        used = {*self._passive, *joints}
        others = []
        for joint in range(self.model.njnt):
            if joint not in used and self._find_root(joint) == root:
                others.append(joint)
        return ArmChain(joints, root, others)

    def name(self, joint: int) -> str:
        """Return the name of a joint; one without is called by its body."""
        found = self.model.joint(joint).name
        return found or f"joint of {self.model.body(int(self.model.jnt_bodyid[joint])).name}"

    def list_names(self, joints: Sequence[int]) -> str:
        """Return the names of joints with commas between."""
        return ", ".join(self.name(joint) for joint in joints)

    def list_above(self, body: int, driven: bool = True) -> list[int]:
        """Return the joints that move a body, from the base on."""
        found: list[int] = []
        while body:
            first = int(self.model.body_jntadr[body])
            own = range(first, first + int(self.model.body_jntnum[body]))
            found = [joint for joint in own if not driven or joint not in self._passive] + found
            body = int(self.model.body_parentid[body])
        return found

    def note_held(self, chain: ArmChain) -> None:
        """Say which joints the machine does not have."""
        for joint, why in self._passive.items():
            if self._find_root(joint) == chain.root and why != CLOSES_LOOP:
                self._source.note(self.name(joint), f"{why}; held where drawn.")
        for joint in chain.left_out:
            self._source.note(
                self.name(joint),
                "not part of the chain and held where drawn; subject.chain=<joint or link> chooses another.",
            )

    def _list_chains(self) -> list[tuple[int, ...]]:
        """Driven joints from the base to each end of the model."""
        paths = {tuple(self.list_above(body)) for body in range(1, self.model.nbody)}
        inner = {path[:place] for path in paths for place in range(len(path))}
        return sorted(paths - inner - {()})

    def _find_root(self, joint: int) -> int:
        return int(self.model.body_rootid[self.model.jnt_bodyid[joint]])

    def _is_slide(self, joint: int) -> bool:
        return int(self.model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE

    def _is_locked(self, joint: int) -> bool:
        damping = self.model.dof_damping[self.model.jnt_dofadr[joint]]
        return bool(damping > LOCK and not self.model.jnt_limited[joint])

    # loops

    def _cut_loops(self) -> None:
        """Take the passive side of each loop that `<equality>` closes out of the tree."""
        model = self.model
        for number in range(model.neq):
            if int(model.eq_type[number]) not in _TIES:
                continue
            ends = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
            if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
                ends = [int(model.site_bodyid[end]) for end in ends]
            paths = [self.list_above(end) for end in ends]
            sides = [[joint for joint in paths[i] if joint not in paths[1 - i]] for i in range(2)]
            ranked = sorted(range(2), key=lambda i: self._rank_side(ends[i], sides[i]))
            passive, kept = sides[ranked[0]], sides[ranked[1]]
            if not passive or not kept:  # also a mocap body or the world
                continue
            self.has_cylinders |= any(self._is_slide(joint) for joint in passive)
            names = self.list_names(passive)
            self._passive |= dict.fromkeys(passive, CLOSES_LOOP)
            self._source.remark(
                f"<equality> closes a loop of {names} with {self.list_names(kept)}; {names} are left out, and "
                f"{self.name(kept[-1])} is driven directly."
            )

    def _rank_side(self, end: int, side: list[int]) -> tuple[bool, bool, int, float]:
        """Return how much a side of a loop is the arm: joints go on behind it, no slide, joints, mass."""
        path = tuple(self.list_above(end))
        goes_on = any(
            len(chain) > len(path) and chain[: len(path)] == path for chain in self._list_chains()
        )
        has_slide = any(self._is_slide(joint) for joint in side)
        return goes_on, not has_slide, len(side), float(self.model.body_subtreemass[end])

    # the longest chain

    def _choose_longest(self) -> list[int]:
        """Return the joints of the longest chain; of fingers that are alike, those before them.

        Raises:
            ConfigError: Nothing moves, or several robots, legs or arms are alike.
        """
        if not self._chains:
            passive = [f"{self.name(joint)} {why}" for joint, why in self._passive.items()]
            why = f" ({'; '.join(passive)})" if passive else ""
            raise self._source.refuse(
                f"it has no joint that moves{why}; a fragment that a scene includes has none either: "
                "give the scene"
            )
        longest = max(self._chains, key=len)
        alike = [chain for chain in self._chains if len(chain) == len(longest)]
        shared = [joint for joint in longest if all(joint in chain for chain in alike)]
        num_apart = len(longest) - len(shared)
        if num_apart < len(shared):
            return shared
        ends = [self.name(chain[-1]) for chain in alike]
        raise self._source.refuse(
            f"{len(alike)} chains of {num_apart} joints are alike ({', '.join(ends)}): legs, arms, wheels, or robots of "
            "a scene. A machine is one arm on a base that stands still, so a robot that walks cannot be trained "
            "here (mjlab and Isaac Lab can). Name the last joint of an arm: subject.chain="
            + " or subject.chain=".join(ends)
        )

    # a chain by name

    def _choose_named(self, names: Sequence[str]) -> list[int]:
        """Return the joints up to the one that is named, or between two."""
        path = self._list_up_to(names[-1])
        if len(names) > 1:
            before = self._list_up_to(names[0])
            if not set(before) <= set(path):
                raise self._source.refuse(
                    f"subject.chain: {names[0]} does not lie on the way to {names[-1]}"
                )
            if before and self.name(before[-1]) == names[0]:
                before.pop()
            path = path[len(before) :]
        if not path:
            raise self._source.refuse(f"subject.chain={','.join(names)}: no joint moves it")
        return path

    def _list_up_to(self, name: str) -> list[int]:
        """Return the joints up to a joint, or those that move a link or a site."""
        model = self.model
        joints = {self.name(joint): joint for joint in range(model.njnt)}
        bodies = {model.body(body).name: body for body in range(1, model.nbody)}
        bodies |= {
            model.site(site).name: int(model.site_bodyid[site]) for site in range(model.nsite)
        }
        if name in bodies and name not in joints:
            return self.list_above(bodies[name])
        if name not in joints:
            raise self._source.refuse(
                f"there is no joint, link or site '{name}'; {list_choices(name, [*joints, *bodies])}"
            )
        joint = joints[name]
        if joint in self._passive:
            raise self._source.refuse(f"{name} {self._passive[joint]}")
        path = self.list_above(int(model.jnt_bodyid[joint]))
        return path[: path.index(joint) + 1]
