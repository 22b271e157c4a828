"""The contact solver of the Warp worlds against MuJoCo C in double precision; kernels compile for some seconds at first use."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from warp_states import copy_state

from brokk_rl.sim.warp_solver import ContactSolver

pytestmark = pytest.mark.usefixtures("warp_device")
NUM_WORLDS = 64


def _arm(num_joints):
    """An arm whose links end in balls, each with its own friction, one without and some with more sideways, above a floor."""
    opened = [
        f'<body pos="{0.4 if i else 0} 0 {0 if i else 0.5}"><joint axis="{"0 1 0" if i % 2 else "0 0 1"}" range="-1 1"/>'
        f'<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05" mass="{20 - 2 * i}" contype="0" conaffinity="0"/>'
        f'<geom type="sphere" pos="0.4 0 0" size="0.1" mass="3" condim="{1 if i == 2 else 3}" friction="{0.2 + 0.2 * i} 0 0"/>'
        f'<geom name="side{i}" type="sphere" pos="0.4 0.2 0" size="0.1" mass="3" contype="0"/>'
        for i in range(num_joints)
    ]
    pairs = ""
    for i in range(num_joints):
        pairs += f'<pair geom1="floor" geom2="side{i}" friction="0.3 {0.4 + 0.1 * i}"/>'
    # the floor takes the friction and the dimension of what touches it
    floor = '<geom name="floor" type="plane" size="9 9 1" priority="-1" contype="0" conaffinity="1" condim="1"/>'
    option = '<option cone="elliptic" impratio="2" timestep="0.01" tolerance="0" iterations="200"/>'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler autolimits="true" angle="radian"/>{option}<default><geom contype="1" conaffinity="0"/></default>'
        f"<worldbody>{floor}{''.join(opened)}{'</body>' * num_joints}</worldbody><contact>{pairs}</contact></mujoco>"
    )


class Problem:
    """Random states of an arm on a floor, up to where the solver begins; `reference` holds them in MuJoCo C, solved."""

    def __init__(self, num_joints, iterations=30):
        random = np.random.default_rng(num_joints)
        self.model = _arm(num_joints)
        self.reference = []
        self.warp_model = mjw.put_model(self.model)
        self.data = mjw.make_data(self.model, NUM_WORLDS, nconmax=16, njmax=40)
        option = self.warp_model.opt
        option.iterations, option.ls_iterations, option.warn_overflow = iterations, 20, 0
        option.tolerance.fill_(1e-6)
        for world in range(NUM_WORLDS):
            data = mujoco.MjData(self.model)
            data.qpos = random.uniform(-1.1, 1.1, num_joints)
            data.qpos[1::2] = random.uniform(-0.2, 1.1, data.qpos[1::2].shape)  # down
            data.qvel = random.normal(scale=random.choice([0.1, 2.0]), size=num_joints)
            data.qfrc_applied = random.normal(scale=50.0, size=num_joints)
            data.qacc_warmstart = random.normal(scale=10.0, size=num_joints)
            fields = ("qpos", "qvel", "qfrc_applied", "qacc_warmstart")
            copy_state(self.model, data, fields, self.data, world)
            self.reference.append(data)
        self.peak = wp.zeros(NUM_WORLDS, dtype=float)
        self.solve = ContactSolver(self.warp_model, self.data, self.peak)
        self.prepare()

    def prepare(self):
        mjw.fwd_position(self.warp_model, self.data)
        mjw.fwd_velocity(self.warp_model, self.data)
        mjw.fwd_actuation(self.warp_model, self.data)
        mjw.fwd_acceleration(self.warp_model, self.data)

    def found(self):
        """Solves and returns accelerations, forces of the rows and of the joints, and iterations."""
        self.solve()
        data = self.data
        arrays = (data.qacc, data.efc.force, data.qfrc_constraint, data.solver_niter, self.peak)
        return [array.numpy().copy() for array in arrays]


@pytest.fixture(scope="module")
def problem():
    return Problem(num_joints=5)


@pytest.mark.parametrize("num_joints", [3, 5, 8])
def test_accelerations_and_forces_are_those_of_mujoco_c(num_joints):
    problem = Problem(num_joints)
    acceleration, _, force, _, peak = problem.found()
    for world, data in enumerate(problem.reference):
        for found, expected in (
            (acceleration[world], data.qacc),
            (force[world], data.qfrc_constraint),
        ):
            atol = 2e-3 * np.abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=2e-3, atol=atol)
        normal = [data.efc_force[c.efc_address] for c in data.contact if c.efc_address >= 0]
        np.testing.assert_allclose(peak[world], sum(normal), rtol=5e-3, atol=0.1)


def test_from_the_solution_no_iteration_is_needed(problem):
    before = problem.data.qacc_warmstart.numpy().copy()
    problem.found()
    wp.copy(problem.data.qacc_warmstart, problem.data.qacc)
    *_, iterations, _ = problem.found()
    problem.data.qacc_warmstart.assign(before)
    assert iterations.max() <= 1 and np.median(iterations) == 0


def test_the_same_problem_gives_the_same_bits_on_one_thread_and_on_a_warp_nearly(
    problem, monkeypatch
):
    first, again = problem.found(), problem.found()
    assert all(np.array_equal(a, b) for a, b in zip(first[:4], again[:4], strict=True))
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    shared = problem.found()
    np.testing.assert_allclose(shared[0], first[0], rtol=1e-3, atol=1e-3 * np.abs(first[0]).max())
    problem.peak.zero_()
    np.testing.assert_allclose(problem.found()[4], first[4], rtol=1e-3, atol=0.1)


def test_too_few_iterations_stop_the_loop_and_are_counted():
    *_, iterations, _ = Problem(num_joints=5, iterations=2).found()
    assert iterations.max() == 2
