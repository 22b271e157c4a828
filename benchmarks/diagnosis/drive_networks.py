"""Networks of drives, run by the simulators that they are for.

    python benchmarks/diagnosis/drive_networks.py <arm.xml> <machine.yaml> <run folder of mode=change_simulator> <out.json>

It takes those of mjlab, newton (with warp-nn) and isaaclab that are installed. The whole of Isaac Lab needs Isaac Sim:
its class `ActuatorNetMLP` is loaded from the package's source, with a plain reader of files.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import platform
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from arm import draw_targets  # noqa: E402

from brokk_rl.machine import Machine  # noqa: E402
from brokk_rl.sim import drive_torques  # noqa: E402
from diagnosis import api  # noqa: E402

UNLIMITED = 1e4
"""Limits of torque and speed, so that the torque of the network is not cut."""


def run_mjlab(folder: Path, machine: Machine, targets: np.ndarray) -> np.ndarray:
    """Returns the positions of the changed file in mjlab, driven by `LearnedMlpActuator`."""
    from mjlab.actuator import LearnedMlpActuatorCfg
    from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg
    from mjlab.sim.sim import Simulation, SimulationCfg

    def load_spec() -> Any:
        spec = mujoco.MjSpec.from_file(str(folder / "changed.xml"))
        for drive in list(spec.actuators):
            spec.delete(drive)
        return spec

    drives = []
    for name in machine.joint_names:
        contract = read_contract(folder, name)
        fields = ("pos_scale", "vel_scale", "torque_scale", "input_order", "history_length")
        drives.append(
            LearnedMlpActuatorCfg(
                target_names_expr=(name,),
                network_file=str(folder / f"networks/{name}.pt"),
                saturation_effort=UNLIMITED,
                velocity_limit=UNLIMITED,
                effort_limit=UNLIMITED,
                **{field: contract[field] for field in fields},
            )
        )
    articulation = EntityArticulationInfoCfg(actuators=tuple(drives))
    entity = Entity(EntityCfg(spec_fn=load_spec, articulation=articulation))
    model = entity.compile()
    simulation = Simulation(num_envs=1, cfg=SimulationCfg(), model=model, device="cpu")
    entity.initialize(model, simulation.model, simulation.data, "cpu")
    entity.reset()
    found, substeps = np.zeros_like(targets), round(machine.period_s / model.opt.timestep)
    for k, target in enumerate(targets):
        found[k] = entity.data.joint_pos[0].numpy()
        for _ in range(substeps):
            entity.set_joint_position_target(torch.as_tensor(target, dtype=torch.float32)[None])
            entity.write_data_to_sim()
            simulation.step()
            entity.update(model.opt.timestep)
    return found


def run_isaaclab(folder: Path, machine: Machine, targets: np.ndarray) -> np.ndarray:
    """Returns the positions of the changed file in MuJoCo C, driven by Isaac Lab's `ActuatorNetMLP`."""
    source = importlib.metadata.files("isaaclab") or ()
    place = next(one for one in source if str(one).endswith("actuators/actuator_net.py"))
    package = Path(str(place.locate())).parents[1]
    for name, path in {
        "isaaclab": package,
        "isaaclab.utils": package / "utils",
        "isaaclab.actuators": package / "actuators",
    }.items():
        module: Any = types.ModuleType(name)
        module.__path__ = [str(path)]
        module.DelayBuffer = module.LinearInterpolation = object  # of drives that are not used here
        sys.modules[name] = module
    assets: Any = types.ModuleType("isaaclab.utils.assets")
    assets.read_file = lambda path: io.BytesIO(Path(path).read_bytes())
    sys.modules["isaaclab.utils.assets"] = assets
    from isaaclab.actuators.actuator_net import ActuatorNetMLP
    from isaaclab.utils.types import ArticulationActions

    class Config(types.SimpleNamespace):
        """Fields of `ActuatorNetMLPCfg`; those that are not given are `None`, as there."""

        def __getattr__(self, name: str) -> None:
            return None

    drives = []
    for name in machine.joint_names:
        contract = read_contract(folder, name)
        fields = ("pos_scale", "vel_scale", "torque_scale", "input_order", "input_idx")
        limits = {"effort_limit": UNLIMITED, "velocity_limit": UNLIMITED}
        config = Config(
            network_file=str(folder / f"networks/{name}.pt"),
            saturation_effort=UNLIMITED,
            effort_limit_sim=UNLIMITED,
            velocity_limit_sim=UNLIMITED,
            joint_names_expr=[name],
            **limits,
            **{field: contract[field] for field in fields},
        )
        drives.append(ActuatorNetMLP(config, [name], [0], 1, "cpu", **limits))

    def drive(error: np.ndarray, speed: np.ndarray) -> np.ndarray:
        torques, still = [], torch.zeros(1, 1)
        for place, one in enumerate(drives):
            target = torch.tensor([[error[place]]], dtype=torch.float32)
            action = ArticulationActions(target, still, still, [0])
            at_speed = torch.tensor([[speed[place]]], dtype=torch.float32)
            torques.append(float(one.compute(action, still, at_speed).joint_efforts))
        return np.array(torques)

    changed = folder / "changed.xml"
    return drive_torques.roll_out_torques(changed, machine, targets, np.zeros(2), drive)


def compare_newton(folder: Path, machine: Machine) -> float:
    """Returns the largest difference of Newton's torques from those of the TorchScript file, Nm."""
    import warp
    from newton.actuators import DriveNeuralMLP

    largest, generator = 0.0, np.random.default_rng(0)
    for name in machine.joint_names:
        contract = read_contract(folder, name)
        network = torch.jit.load(str(folder / f"networks/{name}.pt"))
        rows = generator.normal(size=(8, 2 * contract["history_length"])).astype(np.float32)
        with torch.no_grad():
            expected = network(torch.as_tensor(rows))[:, 0].numpy() * contract["torque_scale"]
        drive: Any = DriveNeuralMLP(str(folder / f"networks/{name}.onnx"))
        drive.finalize(warp.get_device("cpu"), 8)
        drive._net_input.assign(rows)
        told = drive._network({drive._net_input_name: drive._net_input})
        found = told[drive._net_output_name].numpy()[:, 0] * drive.effort_scale
        largest = max(largest, float(np.abs(found - expected).max()))
    return largest


def read_contract(folder: Path, joint: str) -> dict[str, Any]:
    """Returns the contract of a network."""
    return json.loads((folder / f"networks/{joint}.json").read_text())


def main() -> None:
    """Writes the errors in each simulator that is installed."""
    source, machine_file, folder, out = (Path(one) for one in sys.argv[1:5])
    machine: Machine = api._load_option("machine", machine_file)
    targets = draw_targets(np.random.default_rng(5), 250, 2)
    begin, warm = np.zeros(2), round(1.0 / machine.period_s)
    expected = drive_torques.roll_out_targets(folder / "changed.xml", machine, targets, begin)

    def measure(path: np.ndarray) -> list[float]:
        return np.sqrt(np.square(path[warm:] - expected[warm:]).mean(0)).tolist()

    unchanged = drive_torques.roll_out_targets(source, machine, targets, begin)
    content: dict[str, Any] = {
        "command": "python benchmarks/diagnosis/drive_networks.py <arm.xml> <machine.yaml> <changes> <out.json>",
        "machine": f"{platform.machine()}, one core",
        "rmse_rad": {"unchanged_file": measure(unchanged)},
        "versions": {},
    }
    runs: dict[str, Callable[[], Any]] = {
        "mjlab": lambda: measure(run_mjlab(folder, machine, targets)),
        "isaaclab": lambda: measure(run_isaaclab(folder, machine, targets)),
        "newton": lambda: compare_newton(folder, machine),
    }
    for name, run in runs.items():
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        content["versions"][name] = version
        if name == "newton":
            content["newton_torque_difference_nm"] = run()
        else:
            content["rmse_rad"][name] = run()
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
