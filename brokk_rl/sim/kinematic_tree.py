"""Choice of one arm in a model: a chain of hinges and slides among legs, fingers, loops and objects."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.sim.model_source import KINDS, ModelSource

GRIPPER = re.compile("grip|finger|jaw|claw|knuckle|thumb|pincer", re.IGNORECASE)
"""Names of joints and links of grippers."""
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
        gripper: Joints of its gripper that are not part of the chain.
        left_out: Other joints of the robot.
    """

    joints: list[int]
    root: int
    gripper: list[int] = field(default_factory=list)
    left_out: list[int] = field(default_factory=list)


class KinematicTree:
    """Joints of a model that a drive can move, and their order.

    Args:
        source: The model.

    Attributes:
        loops: Sentences about loops that `<equality>` closes.
        has_cylinders: Whether a slide closes a loop, as hydraulic cylinders do.
    """

    def __init__(self, source: ModelSource) -> None:
        self._source, self.model = source, source.model
        self.loops: list[str] = []
        self.has_cylinders = False
        self._passive: dict[int, str] = {}
        for joint in range(self.model.njnt):
            leader = source.followers.get(self.model.joint(joint).name)
            if leader is not None:
                self._passive[joint] = f"follows {leader}, so it is no joint of its own"
            elif int(self.model.jnt_type[joint]) not in KINDS:
                self._passive[joint] = "is neither a hinge nor a slide"
            elif self._is_locked(joint):
                self._passive[joint] = "cannot move: it has no limits and a damping like a lock"
        self._cut_loops()
        self._chains = self._list_chains()

    def choose(self, chain: Sequence[str], tip: str | None, with_gripper: bool) -> ArmChain:
        """Return the arm: the one that is named, else the longest chain.

        Args:
            chain: Last joint or link, first and last link, or all joints; empty for the longest.
            tip: Site or link of the tool point, which the chain must move.
            with_gripper: Whether the first joint of the gripper is the last of the chain.

        Raises:
            ConfigError: There is no chain, several are alike, or a name is unknown.
        """
        gripper: list[int] = []
        if chain:
            joints = self._choose_named(chain)
        else:
            joints, gripper = self._choose_longest()
            beyond = self.list_above(self._find_frame(tip)) if tip else []
            if tip and not set(beyond) <= {*joints, *gripper}:
                joints, gripper = beyond, []
        if with_gripper and gripper:
            joints = [*joints, gripper[0]]
            gripper = gripper[1:]
        root = self._find_root(joints[0])
        others = []
        for joint in range(self.model.njnt):
            is_used = joint in self._passive or joint in joints or joint in gripper
            if not is_used and self._find_root(joint) == root:
                others.append(joint)
        return ArmChain(list(joints), root, gripper, others)

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

    def _find_frame(self, name: str) -> int:
        """Return the body of a site or body of this name."""
        model = self.model
        bodies = {model.body(body).name: body for body in range(1, model.nbody)}
        for site in range(model.nsite):
            bodies[model.site(site).name] = int(model.site_bodyid[site])
        if name not in bodies:
            raise ConfigError(
                f"subject.tip={name}: {self._source.path.name} has no such site or link; "
                f"{list_choices(name, bodies)}"
            )
        return bodies[name]

    def describe_held(self, chain: ArmChain) -> list[str]:
        """Return sentences about all joints that the machine does not have."""
        said = list(self.loops)
        inside = self.list_above(int(self.model.jnt_bodyid[chain.joints[-1]]), driven=False)
        reasons: dict[str, list[int]] = {}
        for joint, why in self._passive.items():
            same_robot = int(self.model.body_rootid[self.model.jnt_bodyid[joint]]) == chain.root
            if same_robot and why != CLOSES_LOOP and not self._is_free(joint):
                reasons.setdefault(why, []).append(joint)
        for why, joints in reasons.items():
            said.append(f"{self.list_names(joints)} {why}; held where drawn.")
        if chain.gripper:
            said.append(
                f"The gripper ({self.list_names(chain.gripper)}) is held where it is drawn; subject.gripper=true makes "
                "its first joint the last of the machine."
            )
        if chain.left_out:
            said.append(
                f"{self.list_names(chain.left_out)} are not part of the chain and are held where they are drawn; "
                "subject.chain=<joint or link> chooses another."
            )
        if any(self._is_free(joint) for joint in inside):
            said.append(
                f"The base ({self.model.body(chain.root).name}) floats in the model; here it stands still."
            )
        return said

    def _list_chains(self) -> list[tuple[int, ...]]:
        """Driven joints from the base to each end of the model, the shortest first."""
        paths = {tuple(self.list_above(body)) for body in range(1, self.model.nbody)}
        inner = {path[:place] for path in paths for place in range(len(path))}
        return sorted(
            paths - inner - {()}, key=lambda path: (len(path), [-joint for joint in path])
        )

    def _is_free(self, joint: int) -> bool:
        return int(self.model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_FREE

    def _is_locked(self, joint: int) -> bool:
        damping = self.model.dof_damping[self.model.jnt_dofadr[joint]]
        return bool(damping > LOCK and not self.model.jnt_limited[joint])

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
            if not all(paths):  # a mocap body or the world
                continue
            sides = [[joint for joint in paths[i] if joint not in paths[1 - i]] for i in range(2)]
            ranked = sorted(range(2), key=lambda i: self._rank_side(ends[i], sides[i]))
            passive, kept = sides[ranked[0]], sides[ranked[1]]
            if not passive or not kept:
                continue
            self.has_cylinders |= any(self._is_slide(joint) for joint in passive)
            names = self.list_names(passive)
            for joint in passive:
                self._passive[joint] = CLOSES_LOOP
            self.loops.append(
                f"<equality> closes a loop of {names} with {self.list_names(kept)}; {names} are left out, and "
                f"{self.name(kept[-1])} is driven directly."
            )

    def _rank_side(self, end: int, side: list[int]) -> tuple[bool, bool, float]:
        """Return how much a side of a loop is the arm: joints go on behind it, no slide, mass."""
        path = tuple(self.list_above(end))
        goes_on = any(
            len(chain) > len(path) and chain[: len(path)] == path for chain in self._list_chains()
        )
        has_slide = any(self._is_slide(joint) for joint in side)
        return goes_on, not has_slide, float(self.model.body_subtreemass[end])

    def _is_slide(self, joint: int) -> bool:
        return int(self.model.jnt_type[joint]) == mujoco.mjtJoint.mjJNT_SLIDE

    def _choose_longest(self) -> tuple[tuple[int, ...], list[int]]:
        """Return the joints of the longest chain, and those of the gripper at its end.

        Raises:
            ConfigError: Nothing moves, or several robots, legs or arms are alike.
        """
        chains = self._list_standing()
        arm: tuple[int, ...] = ()
        while True:
            roots = {self._find_root(chain[0]) for chain in chains}
            branches: dict[int, tuple[int, ...]] = {}
            for chain in chains:
                if len(chain) > len(arm):
                    root = self._find_root(chain[0])
                    branches[chain[len(arm)] if len(roots) == 1 else root] = chain
            ranked = sorted(branches.values(), key=lambda chain: (-len(chain), chain))
            if not ranked:
                return arm, []
            if self._is_gripper(arm, ranked):
                behind = sorted({joint for chain in chains for joint in chain[len(arm) :]})
                return arm, behind
            chosen = self._choose_branch(arm, ranked)
            if len(roots) > 1:
                root = self._find_root(chosen[0])
                chains = [chain for chain in chains if self._find_root(chain[0]) == root]
            else:
                arm = chosen[: len(arm) + 1]
                chains = [chain for chain in chains if chain[: len(arm)] == arm]

    def _list_standing(self) -> list[tuple[int, ...]]:
        """Return the chains of robots that stand, or of all where none has a chain of two joints."""
        if not self._chains:
            passive = [f"{self.name(joint)} {why}" for joint, why in self._passive.items()]
            why = f" ({'; '.join(passive)})" if passive else ""
            raise self._source.refuse(
                f"it has no joint that moves{why}; a fragment that a scene includes has none either: "
                "give the scene"
            )
        standing = []
        for chain in self._chains:
            first = int(self.model.body_jntadr[self._find_root(chain[0])])
            if first < 0 or not self._is_free(first):
                standing.append(chain)
        return standing if max(map(len, standing), default=0) > 1 else self._chains

    def _find_root(self, joint: int) -> int:
        return int(self.model.body_rootid[self.model.jnt_bodyid[joint]])

    def _is_gripper(self, arm: tuple[int, ...], ranked: list[tuple[int, ...]]) -> bool:
        """Return whether the branches behind an arm are fingers: named so, or short and alike."""
        depths = [len(chain) - len(arm) for chain in ranked]
        if not arm or depths[0] >= max(len(arm), 2):
            return False
        first = ranked[0][len(arm)]
        body = self.model.body(int(self.model.jnt_bodyid[first])).name
        if GRIPPER.search(f"{self.name(first)} {body}"):
            return len(arm) > 1 or len(ranked) > 1
        return len(arm) > 1 and depths.count(depths[0]) > 1

    def _choose_branch(
        self, arm: tuple[int, ...], ranked: list[tuple[int, ...]]
    ) -> tuple[int, ...]:
        """Return the chain with which an arm goes on.

        Raises:
            ConfigError: Several are alike: robots, legs, fingers or two arms.
        """
        depths = [len(chain) - len(arm) for chain in ranked]
        most = depths[0]
        alike = []
        for chain, depth in zip(ranked, depths, strict=True):
            if depth == most or (depth == most - 1 and depth > 1):
                alike.append(chain)
        if most > 1:
            alike = [chain for chain in alike if self._has_drive(arm, chain)] or alike
        if len(alike) == 1:
            return alike[0]
        ends = [self.name(chain[-1]) for chain in alike]
        roots = {self._find_root(chain[0]) for chain in alike}
        if len(roots) > 1:
            names = ", ".join(self.model.body(root).name for root in sorted(roots))
            raise self._source.refuse(
                f"{len(alike)} robots ({names}) have {most} joints each; name the last joint of "
                f"one: subject.chain={' or subject.chain='.join(ends)}"
            )
        base = int(self.model.body_parentid[self.model.jnt_bodyid[alike[0][len(arm)]]])
        where = self.model.body(base).name
        if most == 1 and not arm:
            raise self._source.refuse(
                f"{len(alike)} single joints hang on '{where}' side by side ({', '.join(ends)}), such as wheels; "
                "expected a chain of joints, an arm. Name one: subject.chain=" + ends[0]
            )
        kind = "two arms or legs" if len(alike) == 2 else "legs or fingers"
        raise self._source.refuse(
            f"{len(alike)} chains of {most} joints leave '{where}' ({', '.join(ends)}): {kind}. A machine is one "
            f"arm on a base that stands still, so a robot that walks cannot be trained here (mjlab and Isaac Lab "
            f"can). One of them as an arm: subject.chain={ends[0]}"
        )

    def _has_drive(self, arm: tuple[int, ...], chain: tuple[int, ...]) -> bool:
        """Return whether an actuator moves a joint of a branch behind an arm."""
        model = self.model
        is_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        moved = set(model.actuator_trnid[is_joint, 0].tolist())
        branch = chain[: len(arm) + 1]
        behind = {
            joint
            for one in self._chains
            if one[: len(branch)] == branch
            for joint in one[len(arm) :]
        }
        return not moved.isdisjoint(behind)

    def _choose_named(self, names: Sequence[str]) -> list[int]:
        """Return the joints of a chain that is named by its end, its ends, or its joints."""
        model = self.model
        by_name = {self.name(joint): joint for joint in range(model.njnt)}
        found: list[tuple[int | None, int]] = []
        for name in names:
            if name in by_name:
                joint = by_name[name]
                if joint in self._passive:
                    raise self._source.refuse(f"subject.chain: {name} {self._passive[joint]}")
                found.append((joint, int(model.jnt_bodyid[joint])))
                continue
            bodies = [i for i in range(1, model.nbody) if model.body(i).name == name]
            if not bodies:
                listed = [*by_name, *(model.body(i).name for i in range(1, model.nbody))]
                raise self._source.refuse(
                    f"subject.chain: there is no joint or link '{name}'; {list_choices(name, listed)}"
                )
            found.append((None, bodies[0]))
        joint, end = found[-1]
        path = self.list_above(end)
        if joint is not None:
            path = path[: path.index(joint) + 1]
        chosen = [one for one, _ in found]
        if len(found) > 1 and None not in chosen:
            if beside := [self.name(one) for one in chosen if one is not None and one not in path]:
                raise self._source.refuse(
                    f"subject.chain: {', '.join(beside)} do not lie on the way to {names[-1]}"
                )
            return [one for one in path if one in chosen]
        if len(found) > 1:
            before = self.list_above(found[0][1])
            path = [one for one in path if one not in before]
        if not path:
            raise self._source.refuse(f"subject.chain={','.join(names)}: no joint moves it")
        return path
