"""Collecting: what stands in the recordings, and what an interruption leaves of them."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from conftest import Brokk
from motion import rest

from actuators.effects.composition import ActuatorWithEffects
from actuators.excite.player import NominalLink
from actuators.modes.collect import Collect
from brokk_rl import record
from brokk_rl.errors import LinkError
from brokk_rl.extensions import load_mode
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.sim.link import SimulatedMachines

SMALL = (
    "collect.num_runs=2",
    "collect.run_minutes=0.5",
    "collect.file_minutes=0.2",
    "actuator=lag",
)


def made(folder: Path) -> dict[str, Recording]:
    paths = sorted((folder / "recordings").glob("*.parquet"))
    return {path.stem: record.read_recording(path, MACHINE) for path in paths}


def mode(out: Path, *overrides: str) -> Collect:
    out.mkdir(exist_ok=True)
    return load_mode("mode=collect", f"session.out={out}", "session.seed=0", *overrides)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("collected")
    mode(out, *SMALL).run()
    return out


def test_every_run_is_cut_into_files_that_know_each_other(collected: Path) -> None:
    files = made(collected)
    assert list(files) == [f"sine_{n:02d}_{part:02d}" for n in range(2) for part in range(3)]
    assert [file.num_samples for file in files.values()] == [240, 240, 120] * 2
    runs = [file.metadata["run"] for file in files.values()]
    assert len(set(runs)) == 2 and runs[:3] == [runs[0]] * 3
    first, second, *_ = files.values()
    assert second.metadata["created"] == record.add_seconds(first.metadata["created"], 12.0)
    assert first.metadata["source"] == "simulator: Lag, excitation: sine"
    assert first.metadata["seed"] == "0"
    assert json.loads(first.metadata["fingerprint"]) == MACHINE.fingerprint()
    assert first.t_s[0] == second.t_s[0] == 0.0


def test_only_the_plan_is_drawn_and_what_finds_no_time_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    excitation = ("excitation=levels", "collect.only_plan=true")
    for name, minutes, told in (("long", 1.0, False), ("short", 0.2, True)):
        caplog.clear()
        mode(tmp_path / name, *SMALL, *excitation, f"collect.run_minutes={minutes}").run()
        (picture,) = (tmp_path / name).iterdir()
        assert picture.name == "plan.png" and picture.read_bytes().startswith(b"\x89PNG")
        assert ("plan: no time for" in caplog.text) == told, caplog.text


def test_the_same_seed_records_the_same_and_another_does_not(
    collected: Path, tmp_path: Path
) -> None:
    for out, seed in ((tmp_path / "again", 0), (tmp_path / "other", 1)):
        torch.rand(3)  # whatever else drew from the global generator
        mode(out, *SMALL, f"session.seed={seed}").run()
    folders = (collected, tmp_path / "again", tmp_path / "other")
    first, again, other = (made(folder) for folder in folders)
    for name, file in first.items():
        assert np.array_equal(file.u, again[name].u) and np.array_equal(file.q, again[name].q)
    assert any(not np.array_equal(file.u, other[name].u) for name, file in first.items())


def test_actuator_and_effects_are_chosen_as_everywhere(brokk: Brokk) -> None:
    small = ("collect.num_runs=1", "collect.run_minutes=0.4", "collect.file_minutes=0.4")
    chosen = ("actuator=hydraulic", "effect=[backlash,stiction]", "effect.backlash.gap_rad=0.01")
    brokk("mode=collect", "session.out=run", "excitation=levels", *chosen, *small)
    (file,) = made(Path("run")).values()
    source = "simulator: Hydraulic + backlash + stiction, excitation: levels"
    assert file.metadata["source"] == source
    assert file.extra["oil_c"].shape == (file.num_samples,) and 0.0 < file.extra["oil_c"][0] < 60.0


class Fails(NominalLink):
    """Fails, or is interrupted, after 20 s."""

    error: type[BaseException] = LinkError

    def send(self, command: Command) -> Command:
        if self.read().t_s > 19.99:
            raise self.error("the bus is gone")
        return super().send(command)


class Interrupted(Fails):
    error = KeyboardInterrupt


class Connected:
    """A link spec for tests."""

    source = "a test"

    def __init__(self, link: type[NominalLink]) -> None:
        self._link = link

    def build(self, machine: Machine, num_runs: int, session: Session) -> NominalLink:
        return self._link(machine, num_runs)


@pytest.mark.parametrize("link", [Fails, Interrupted])
def test_what_was_recorded_before_an_interruption_is_kept(
    link: type[Fails], tmp_path: Path
) -> None:
    collect = replace(mode(tmp_path / "run", *SMALL), link=Connected(link))
    with pytest.raises(link.error):
        collect.run()
    files = made(tmp_path / "run")
    assert [file.num_samples for file in files.values()] == [240, 160] * 2


class Killed(NominalLink):
    """Looks at the disk as if the power failed now: nothing more is written from here on."""

    seen: list[int] | None = None
    folder = Path()

    def send(self, command: Command) -> Command:
        if self.read().t_s > 9.99 and self.seen is None:
            paths = self.folder.glob("recordings/*.parquet")
            files = [record.read_recording(path, self._machine) for path in paths]
            type(self).seen = [file.num_samples for file in files]
        return super().send(command)


def test_a_file_that_grows_is_on_the_disk_before_it_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect = replace(mode(tmp_path / "run", *SMALL), link=Connected(Killed))
    collect = replace(collect, collect=replace(collect.collect, flush_s=1.0))
    Killed.folder, clock_s = tmp_path / "run", iter(np.arange(0.0, 1e3, 0.05))
    clock = SimpleNamespace(monotonic=lambda: next(clock_s))
    monkeypatch.setattr("actuators.modes.collect.time", clock)
    collect.run()
    assert Killed.seen is not None and len(Killed.seen) == 2
    assert min(Killed.seen) >= 160, "of 200 samples"


class RealTime(NominalLink):
    """Moves with the clock on the wall, at 20 Hz, and once comes late."""

    def __init__(self, machine: Machine, num_runs: int) -> None:
        super().__init__(machine, num_runs)
        self._began, self._num_reads = time.monotonic(), 0

    def read(self) -> JointState:
        # Counted, not timed: a busy computer may read for the first time after the moment meant.
        self._num_reads += 1
        if self._num_reads == 19:
            time.sleep(0.2)
        return JointState(time.monotonic() - self._began, super().read().q[0])

    def send(self, command: Command) -> Command:
        super().send(Command(np.asarray(command.u)[None]))
        return Command(np.asarray(command.u) * 0.5)  # a guard on the machine halves it


def test_a_real_clock_is_waited_for_and_a_gap_begins_a_new_file(tmp_path: Path) -> None:
    small = ("collect.num_runs=1", "collect.run_minutes=0.04", "collect.file_minutes=0.04")
    asked = mode(tmp_path / "run", "excitation=levels", *small)
    collect = replace(asked, link=Connected(RealTime))
    before = time.monotonic()
    collect.run()
    assert time.monotonic() - before > 2.2
    files = list(made(tmp_path / "run").values())
    first, last = files[0], files[-1]
    assert first.metadata["run"] == last.metadata["run"] and first is not last
    # Busy computers come late more than once.
    periods_s = np.concatenate([np.diff(file.t_s) for file in files])
    assert np.median(periods_s) == pytest.approx(0.05, abs=0.006)
    assert len(np.unique(periods_s)) > 3, "as measured"
    assert 0.0 < max(np.abs(file.u).max() for file in (first, last)) <= 0.5, "as sent"


def surround(actuator: str, *effects: str) -> ActuatorWithEffects:
    chosen = {name: option("effect", name) for name in effects}
    return ActuatorWithEffects(actuator=option("actuator", actuator), effects=chosen)


def test_a_simulated_machine_is_its_actuator_model_with_noise(tmp_path: Path) -> None:
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    links = []
    for effects, noise in ((("backlash",), 0.0), (("backlash",), 0.01), ((), 0.0)):
        plant = surround("lag", *effects)
        spec = SimulatedMachines(actuator=plant, noise=noise, one_machine=True)
        links.append(spec.build(MACHINE, 2, session))
    quiet, noisy, neutral = links
    model = option("actuator", "lag").build(MACHINE, 2, torch.device("cpu"))
    history = rest(MACHINE, num=2)
    generator, differences, played = np.random.default_rng(0), [], []
    for _ in range(200):
        u = generator.uniform(-1, 1, (2, 5)).astype(np.float32)
        history.push_u(torch.as_tensor(u))
        history.push_q(model.step(history))
        for link in links:
            assert (link.send(Command(u)).u == u).all()
        assert neutral.read().q == pytest.approx(history.q[:, -1].numpy(), abs=1e-6)
        differences.append(noisy.read().q - quiet.read().q)
        played.append(np.abs(quiet.read().q - neutral.read().q).max())
    assert np.std(differences) == pytest.approx(0.01, rel=0.1)
    assert max(played) > 0.001, "the backlash is there"
    assert quiet.read().t_s == pytest.approx(10.0)


@pytest.mark.parametrize("one_machine", [True, False])
def test_all_runs_record_one_machine_where_effects_are_drawn(
    one_machine: bool, tmp_path: Path
) -> None:
    plant = surround("ideal", "asymmetry")
    connection = SimulatedMachines(actuator=plant, noise=0.0, one_machine=one_machine)
    link = connection.build(MACHINE, 3, Session(out=str(tmp_path), seed=0, device="cpu"))
    for _ in range(60):
        link.send(Command(np.full((3, 5), 0.4)))
    spread = np.ptp(link.read().q, axis=0).max()
    assert spread == 0.0 if one_machine else spread > 1e-3
