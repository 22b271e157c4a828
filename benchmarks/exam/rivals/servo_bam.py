"""BAM (`better-actuator-models`; Duclusaud et al., ICRA 2025) on an arm of position servos.

The package itself: its motor STS3215, its friction models and its simulator, called with arrays of
candidates. Its bench is a pendulum on one servo; here each joint of the arm is a bench of its own,
with inertia and weight of the recorded pose. Its identification is CMA-ES over the mean absolute error
of free runs, by `optuna`; here the same by `cmaes`, the library behind that, with fewer trials. A delay
of the targets, which its authors measure apart, is one more number of each joint.
"""

from __future__ import annotations

from pathlib import Path

import cmaes
import numpy as np
from bam.feetech.actuator import STS3215Actuator
from bam.model import Model, models
from bam.simulate import Simulator
from bam.testbench import Testbench
from case_data import Arm, Change, Windows, delay_commands, read_windows
from servo_arm import (
    FIELD_STRIDE_S,
    REFERENCE_STRIDE_S,
    JointPaths,
    Numbers,
    list_changes,
    trace_joints,
)

FRICTION = "m1"
"""Friction model, one of six: that of the package's own fit of this servo, `params/feetech_sts3215_7_4V`."""
GENERATIONS, FIELD_GENERATIONS, SIGMA, FIELD_SIGMA = 150, 100, 0.3, 0.15
"""Generations and first spread of the searches. That of the reference begins at the package's values, that
of the field at the answer of the reference."""
LIMIT = "max_velocity"
"""Bound on the speed of targets. Above the motor's own speed it shows nothing, and a search does not
find its way down from there, so that the field begins at the package's value again."""
STEPS = 4
"""Time steps of a control period: 5 ms."""
DELAY_S = (0.05, 0.0, 0.2)
"""Start and bounds."""


class ArmBench(Testbench):
    """One joint of the arm along the recorded path; `now` is the present time step."""

    def __init__(self, paths: JointPaths) -> None:
        self._paths, self.now = paths, 0

    def compute_mass(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the inertia without armature, `(W, J)`."""
        return self._paths.inertia[:, self.now]

    def compute_bias(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torque of the weight, `(W, J)`."""
        return -self._paths.weight[:, self.now]


def build_model() -> Model:
    """Return BAM's model of this servo."""
    model = models[FRICTION]()
    model.set_actuator(STS3215Actuator(ArmBench))
    # an error of the bench, of which the arm has none
    model.q_offset.optimize = False
    return model


def list_bounds(model: Model) -> tuple[list[str], np.ndarray]:
    """Return names of all numbers, and `(start, low, high)` of each."""
    free = {name: one for name, one in model.get_parameters().items() if one.optimize}
    rows = [(one.value, one.min, one.max) for one in free.values()]
    return [*free, "delay_s"], np.array([*rows, DELAY_S])


def simulate(model: Model, names: list[str], vectors: np.ndarray, paths: JointPaths) -> np.ndarray:
    """Return positions at the end of each period, `(P, W, K, J)`, of vectors `(P, J, numbers)`."""
    value = dict(zip(names, np.moveaxis(vectors[:, None], -1, 0), strict=True))
    parameters = model.get_parameters()
    for name in names[:-1]:
        parameters[name].value = value[name]
    late = np.moveaxis(delay_commands(paths.targets, value["delay_s"], paths.step_s), 2, 0)
    actuator, bench, dt_s = model.actuator, ArmBench(paths), paths.step_s
    actuator.testbench = bench
    simulator = Simulator(model)
    shape = late.shape[1:]
    simulator.reset(np.broadcast_to(paths.q, shape), np.broadcast_to(paths.speed, shape))
    actuator.q_target_smooth = late[0]
    for k in range(0, paths.history, STEPS):  # the firmware's bound on the speed of targets
        actuator.compute_control(late[k], simulator.q, simulator.dq, STEPS * dt_s)
    steps = paths.inertia.shape[1]
    found = np.empty((steps // STEPS, *shape))
    base = np.broadcast_to(value["friction_base"], shape)
    for k in range(steps):
        bench.now = k
        parameters["friction_base"].value = base.copy()  # the package adds to it in place
        target = late[paths.history + k]
        control = actuator.compute_control(target, simulator.q, simulator.dq, dt_s)
        simulator.step(control, True, dt_s)
        if k % STEPS == STEPS - 1:
            found[k // STEPS] = simulator.q
    return np.moveaxis(found, 0, 2)


def fit_servos(windows: Windows, paths: JointPaths, start: np.ndarray | None) -> np.ndarray:
    """Return the best numbers of each joint, `(J, numbers)`: the joints' searches go side by side."""
    model = build_model()
    names, bounds = list_bounds(model)
    # numbers that are above 0 for sure are searched by their logarithms
    by_log = bounds[:, 1] > 0.0
    _, low, high = np.where(by_log, np.log(np.where(by_log, bounds.T, 1.0)), bounds.T)
    joints = windows.q.shape[2]
    begin = np.tile(bounds[:, 0], (joints, 1)) if start is None else start.copy()
    begin[:, names.index(LIMIT)] = bounds[names.index(LIMIT), 0]
    rounds, sigma = (GENERATIONS, SIGMA) if start is None else (FIELD_GENERATIONS, FIELD_SIGMA)
    unit = np.tile([0.0, 1.0], (len(low), 1))
    searches = []
    for j in range(joints):
        at = np.where(by_log, np.log(np.where(by_log, begin[j], 1.0)), begin[j])
        mean = np.clip((at - low) / (high - low), 0.001, 0.999)
        searches.append(cmaes.CMA(mean, sigma, bounds=unit, seed=j))
    best, least = begin.copy(), np.full(joints, np.inf)
    for _ in range(rounds):
        size = searches[0].population_size
        asked = np.array([[search.ask() for search in searches] for _ in range(size)])
        scaled = low + asked * (high - low)
        vectors = np.where(by_log, np.exp(np.where(by_log, scaled, 0.0)), scaled)
        errors = np.abs(simulate(model, names, vectors, paths) - windows.q[:, 1:])
        costs = errors.mean((1, 2))
        for j, search in enumerate(searches):
            search.tell(list(zip(asked[:, j], costs[:, j].tolist(), strict=True)))
            i = int(costs[:, j].argmin())
            if costs[i, j] < least[j]:
                best[j], least[j] = vectors[i, j], costs[i, j]
    return best


def measure_effects(vectors: np.ndarray, arm: Arm) -> Numbers:
    """Return the numbers of effects that the numbers of all joints amount to.

    The friction of a joint that rests without load over the stiffness of its loop is half the width in
    which it stays behind; back EMF and viscous friction over that stiffness are the lag of the loop.
    """
    model = build_model()
    names, _ = list_bounds(model)
    value = dict(zip(names, vectors.T, strict=True))
    actuator = model.actuator
    gain = actuator.vin * actuator.kp * actuator.error_gain * value["error_gain_ratio"]
    stiffness = gain * value["kt"] / value["R"]
    damping = value["kt"] ** 2 / value["R"] + value["friction_viscous"]
    return {
        "dead_time": value["delay_s"],
        "lag": damping / stiffness,
        "rate_limit": arm.half_travel / value["max_velocity"],
        "backlash": 2.0 * value["friction_base"] / stiffness,
    }


def find_changes(case: Path, arm: Arm) -> tuple[list[Change], dict[str, list[float]]]:
    """Return the changes from reference to field, and both parameter vectors."""
    reference = read_windows(case / "reference", arm, REFERENCE_STRIDE_S)
    field = read_windows(case / "field", arm, FIELD_STRIDE_S)
    nominal = fit_servos(reference, trace_joints(reference, arm, STEPS), None)
    present = fit_servos(field, trace_joints(field, arm, STEPS), nominal)
    changes = list_changes(
        arm, measure_effects(nominal, arm), measure_effects(present, arm), errors=None
    )
    return changes, {"nominal": nominal.ravel().tolist(), "present": present.ravel().tolist()}


def simulate_halves(
    arm: Arm, windows: Windows, fitted: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free runs of the simulator as built, and as fitted to the field."""
    model, paths = build_model(), trace_joints(windows, arm, STEPS)
    names, _ = list_bounds(model)
    both = np.array([fitted["nominal"], fitted["present"]]).reshape(2, len(arm.joints), -1)
    before, after = simulate(model, names, both, paths)
    return before, after
