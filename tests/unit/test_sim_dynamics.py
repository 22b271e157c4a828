"""Dynamics of an arm in the Warp worlds against MuJoCo C in double precision; kernels compile for some seconds at first use."""

from dataclasses import replace

import mujoco
import mujoco_warp
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from composed import MACHINE, option
from warp_states import copy_state

from brokk_rl.errors import DeviceError
from brokk_rl.sim.native_world import NativeWorld
from brokk_rl.sim.simulator import AutoSimulator, NativeSimulator
from brokk_rl.sim.warp_dynamics import ArmDynamics
from brokk_rl.sim.warp_solver import ContactSolver

pytestmark = pytest.mark.usefixtures("warp_device")
NUM_WORLDS = 16
ARM = """
<mujoco><compiler autolimits="true" angle="radian"/>
  <option gravity="0 0 0" cone="elliptic" timestep="0.01" integrator="implicitfast" tolerance="1e-10" iterations="100"/>
  <default><geom contype="0" conaffinity="0"/><default class="ball"><geom type="sphere" contype="1"/></default></default>
  <worldbody><geom type="plane" size="9 9 1" conaffinity="1"/><body mocap="true" pos="0 9 0"><geom size="0.1"/></body>
    <body pos="0 0 1"><geom type="box" size="0.3 0.2 0.1" mass="90"/>
      <body pos="0.1 0 0.2"><joint axis="0 0 1" range="-9 9"/>
        <geom type="box" size="0.3 0.1 0.1" pos="0.2 0.1 0" euler="0.2 0.4 0" mass="30"/>
        <body pos="0.5 0 0.1" euler="0 0.3 0.1"><joint axis="0 1 0.2" pos="0.05 0 0.1" range="-9 9" armature="3"/>
          <geom type="capsule" fromto="0 0 0 0.5 0 0.1" size="0.05" mass="20"/>
          <body pos="0.5 0 0"><joint type="slide" axis="1 0 0.1" range="-9 9"/><geom type="box" size="0.2 0.05 0.1" mass="12"/>
            <body pos="0.2 0.1 0"><geom class="ball" size="0.1" mass="5"/></body>
            <body pos="0.4 0 0"><joint axis="0 1 0" range="-9 9"/>
              <inertial pos="0.1 0.02 0" mass="8" fullinertia="0.4 0.3 0.2 0.01 0.02 0.03"/>
              <geom class="ball" pos="0.4 0 0" size="0.15" mass="6"/></body></body></body></body></body></worldbody>
  <actuator>{servos}</actuator></mujoco>
"""


class Arms:
    """Random states of an arm with hinges, a slide and bodies welded on, on the device and in `reference`."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(ARM.format(servos=""))
        names = [f"j{i}" for i in range(self.model.njnt)]
        spec = mujoco.MjSpec.from_string(ARM.format(servos=""))
        for name, joint in zip(names, spec.joints, strict=True):
            joint.name = name
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_intvelocity(kp=4_000.0, kv=150.0)
            servo.forcelimited, servo.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, (-900.0, 900.0)
            servo.actlimited = servo.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        self.model = spec.compile()
        random = np.random.default_rng(0)
        self.device_model = mjw.put_model(self.model)
        self.data = mjw.make_data(self.model, NUM_WORLDS, nconmax=16, njmax=40)
        self.device_model.opt.iterations = 50
        self.dynamics = ArmDynamics(self.model, self.device_model, self.data)
        self.solve = ContactSolver(self.device_model, self.data, wp.zeros(NUM_WORLDS, dtype=float))
        self.reference = []
        for world in range(NUM_WORLDS):
            data = mujoco.MjData(self.model)
            data.qpos = random.uniform(-1.0, 1.0, self.model.nq)
            data.qvel = random.normal(size=self.model.nv)
            data.act = data.qpos + random.normal(scale=0.2, size=self.model.na)
            data.ctrl = random.normal(size=self.model.nu)
            copy_state(self.model, data, ("qpos", "qvel", "act", "ctrl"), self.data, world)
            self.reference.append(data)

    def prepare(self):
        mjw.kinematics(self.device_model, self.data)
        self.dynamics.before_contacts()

    def step(self):
        self.prepare()
        mjw.collision(self.device_model, self.data)
        mjw.make_constraint(self.device_model, self.data)
        self.solve()
        self.dynamics.after_contacts()


@pytest.fixture
def arms():
    return Arms()


def test_mass_matrix_and_forces_are_those_of_mujoco_c(arms):
    arms.prepare()
    rows, columns = np.tril_indices(arms.model.nv)
    found = arms.data.M.numpy()[:, arms.device_model.M_elemid.numpy()[rows, columns]]
    for world, data in enumerate(arms.reference):
        inertia = np.zeros((arms.model.nv, arms.model.nv))
        mujoco.mj_fullM(arms.model, data, inertia)
        slack = 1e-5 * np.trace(inertia)
        np.testing.assert_allclose(found[world], inertia[rows, columns], rtol=1e-5, atol=slack)
        smooth = arms.data.qfrc_smooth.numpy()[world]
        np.testing.assert_allclose(smooth, data.qfrc_smooth, rtol=1e-4, atol=2e-3)
    cut = np.abs(arms.data.actuator_force.numpy()) == 900.0
    assert cut.any() and not cut.all()


def test_a_hundred_substeps_with_servos_at_their_limit_and_contact_are_those_of_mujoco_c(arms):
    touched = 0
    for _ in range(100):
        arms.step()
        for data in arms.reference:
            mujoco.mj_step(arms.model, data)
            touched += data.ncon > 0
    assert touched > 20
    expected = np.array([data.qpos for data in arms.reference])
    apart = np.abs(arms.data.qpos.numpy() - expected).max(1)
    assert np.median(apart) < 1e-4 and (apart < 5e-3).sum() >= NUM_WORLDS - 1
    np.testing.assert_allclose(arms.data.act.numpy()[0], arms.reference[0].act, atol=1e-5)
    np.testing.assert_allclose(arms.data.time.numpy(), 1.0, rtol=1e-5)
    assert not arms.data.overflow.numpy().any()


def test_rows_contacts_and_pairs_without_room_are_reported(arms):
    data = arms.data
    data.nefc.fill_(0)
    data.nefc[3:4].fill_(data.njmax + 1)
    arms.dynamics.after_contacts()
    expected = np.where(np.arange(NUM_WORLDS) == 3, int(mjw.OverflowType.NEFC), 0)
    assert (data.overflow.numpy() == expected).all()
    data.nacon.fill_(data.naconmax + 1)
    data.ncollision.fill_(data.naconmax + 1)
    arms.dynamics.after_contacts()
    pairs = int(mjw.OverflowType.NARROWPHASE | mjw.OverflowType.BROADPHASE)
    assert (data.overflow.numpy() & pairs != 0).all()


NUM_WARP_WORLDS = 8
WARP = replace(option("sim", "warp"), num_worlds=NUM_WARP_WORLDS, parity_worlds=0)
NATIVE = NativeSimulator(num_worlds=NUM_WARP_WORLDS, substeps=5, num_threads=2)


def _motion(steps, push):
    """Yields smooth random increments; `push` lowers the second joint all the while."""
    generator = torch.Generator().manual_seed(0)
    velocity = torch.zeros(NUM_WARP_WORLDS, MACHINE.num_joints)
    speed = 1.5 * torch.tensor(MACHINE.max_speed, dtype=torch.float32)
    for _ in range(steps):
        velocity = 0.9 * velocity + 0.1 * speed * torch.randn(velocity.shape, generator=generator)
        velocity[:, 1] += push
        yield velocity * MACHINE.period_s


@pytest.mark.slow
def test_a_control_step_is_that_of_mujoco_warp():
    """From the same state, in the air and pressed onto the ground."""
    ours, whole = WARP.build(MACHINE, "cpu"), WARP.build(MACHINE, "cpu")
    whole._substep = lambda: mujoco_warp.step(whole._model, whole._data)
    pressed = 0.0
    for increment in _motion(steps=40, push=0.006):
        whole.load_state_dict(ours.state_dict())
        ours.step(increment)
        whole.step(increment)
        pressed = max(pressed, float(ours.contact_force_n.amax()))
        torch.testing.assert_close(ours.q, whole.q, rtol=0.0, atol=2e-5)
    assert pressed > 1_000.0


def test_a_device_that_a_simulator_cannot_use_is_an_error_that_says_what_to_do():
    auto = AutoSimulator(native=NATIVE, warp=WARP)
    with pytest.raises(DeviceError, match="sim=warp"):
        NATIVE.build(MACHINE, torch.device("cuda"))
    for spec in (WARP, auto) * (not torch.cuda.is_available()):
        with pytest.raises(DeviceError, match="sim=native"):
            spec.build(MACHINE, "cuda")
    assert isinstance(auto.build(MACHINE, "cpu", num_worlds=3), NativeWorld)
