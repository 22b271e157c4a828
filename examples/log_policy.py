"""Log runs of the shipped policy on a simulated machine with an effect that its training lacked.

    python examples/log_policy.py runs/changed asymmetry joints=q3,q4 extend_gain=0.5 retract_gain=1.0

The policy runs with numpy and onnxruntime, as on a machine. Each log holds 15 s: what the policy saw, what
it commanded, and where the target was. `brokk mode=why` and `mode=doctor_policy` read such logs.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from run_policy import ExportedPolicy

from brokk_rl import extensions
from brokk_rl.history import History
from brokk_rl.record import Recording, write_recording

POLICY = Path(__file__).parents[1] / "tasks/policies/borehole_insertion"
NUM_LOGS, NUM_STEPS = 8, 300
ENCODER_NOISE_RAD = 3e-4


def build_machine(effect, numbers):
    """Return machine, world, actuator with the effect, and starts of the task."""
    cpu = torch.device("cpu")
    machine = extensions.load_option("machine", "brokk170")
    task = extensions.load_option("task", "borehole_insertion").build(machine, 1, cpu)
    native = extensions.load_option("sim", "native", num_worlds=NUM_LOGS, num_threads=1)
    actuator = extensions.load_option("actuator", "mlp").build(machine, NUM_LOGS, cpu)
    changed = extensions.load_option("effect", effect, **numbers)
    actuator = changed.wrap(actuator, machine, NUM_LOGS, cpu)
    return machine, native.build(machine, cpu, NUM_LOGS), actuator, task.starts(NUM_LOGS, 5)


def run_policies(machine, world, actuator, starts):
    """Return positions and commands, each (T, N, J)."""
    everywhere = torch.ones(NUM_LOGS, dtype=torch.bool)
    actuator.reset(everywhere)
    world.reset(everywhere, starts["q"], starts["scene"])
    blank = torch.zeros(NUM_LOGS, machine.num_history, machine.num_joints)
    history = History(q=blank, u=blank.clone())
    history.reset(everywhere, starts["q"])
    policies = [ExportedPolicy(POLICY) for _ in range(NUM_LOGS)]
    generator, targets_m = np.random.default_rng(0), starts["target_m"].numpy()
    u = np.zeros((NUM_LOGS, machine.num_joints), np.float32)
    positions, commands = [], []
    for _ in range(NUM_STEPS):
        q = history.q[:, -1].numpy() + generator.normal(0.0, ENCODER_NOISE_RAD, u.shape)
        q = q.astype(np.float32)
        answers = []
        for n, policy in enumerate(policies):
            answers.append(policy.step(targets_m[n], q[n], u[n]))
        u = np.array(answers, np.float32)
        positions.append(q)
        commands.append(u)
        with torch.inference_mode():
            history.push_u(torch.as_tensor(u))
            world.step(actuator.step(history) - history.q[:, -1])
            history.push_q(world.q)
    return np.array(positions), np.array(commands)


def write_logs(folder, machine, positions, commands, targets_m):
    """Write a recording for each run; targets (N, 3) in the base frame."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, target_m in enumerate(targets_m):
        extra = {}
        for axis, value in zip("xyz", target_m, strict=True):
            extra[f"target_{axis}_m"] = np.full(NUM_STEPS, value, np.float32)
        for j, joint in enumerate(machine.joint_names):
            extra[f"advice_{joint}"] = commands[:, n, j]
        recording = Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=np.arange(NUM_STEPS) * machine.period_s,
            u=commands[:, n],
            q=positions[:, n],
            extra=extra,
            metadata={"source": "simulated machine"},
        )
        write_recording(recording, folder / f"run_{n}.parquet")


def parse_numbers(words):
    """Return the numbers of an effect from words such as `extend_gain=0.5` and `joints=q3,q4`."""
    pairs = dict(word.split("=") for word in words)
    return {
        name: value.split(",") if name == "joints" else float(value)
        for name, value in pairs.items()
    }


if __name__ == "__main__":
    torch.manual_seed(1)
    machine, world, actuator, starts = build_machine(sys.argv[2], parse_numbers(sys.argv[3:]))
    positions, commands = run_policies(machine, world, actuator, starts)
    write_logs(Path(sys.argv[1]), machine, positions, commands, starts["target_m"].numpy())
    print(f"{NUM_LOGS} logs of {NUM_STEPS * machine.period_s:.0f} s in {sys.argv[1]}")
