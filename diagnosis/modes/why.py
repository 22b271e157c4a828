"""`brokk mode=why`: why a policy works in simulation and not on the machine, on one page.

It runs the modes that exist, each in a folder of its own: `doctor_policy`, then `diagnose` unless the
code is to blame, then `evaluate` with the effects that were found.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml

from brokk_rl import record, registry
from brokk_rl.console_table import print_text
from brokk_rl.errors import BrokkError, ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.rl.settings import Evaluation
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import spec
from diagnosis import own_simulator, report, why_answer
from diagnosis.deployment.contract import load_policy
from diagnosis.own_simulator import OwnSimulator
from diagnosis.story import HANDED_ON_FOLDER, StoryStage, run_story, write_groups
from diagnosis.why_answer import WhyResult

log = logging.getLogger(__name__)

HANDED_ON_GROUPS = ("machine", "evaluation")
EFFECT_HEAD = "# @package effect\n"
ONNX_SUFFIX = ".onnx"


@spec
class Why:
    """Say why a policy fails on the machine: code, actuator or task, and what each costs.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        evaluation: How to evaluate what an effect costs.
        log: Glob or globs of recordings of the policy's runs.
        policy: `folder`: the policy.
        simulator: Actuator of the simulator that trained it, as `actuator=` takes it; or a simulator of
            your own, `module:function` or an MJCF file.
        sent: The commands of the log are those that the policy's loop sent.
        target_in_base_m: Target where the log has none.
    """

    session: Session
    machine: Machine
    evaluation: Evaluation
    log: str | tuple[str, ...]
    policy_path: str
    simulator: str
    sent: bool
    target_in_base_m: tuple[float, float, float] | None

    def check(self) -> None:
        if self._is_own:
            OwnSimulator(source=self.simulator)
        elif not self.simulator.startswith("@"):
            names = [one.name for one in registry.list_options() if one.group == "actuator"]
            if self.simulator not in names:
                raise ConfigError(
                    f"simulator={self.simulator}: expected the actuator of the simulator, or your own as module:function "
                    f"or my.xml; {list_choices(self.simulator, names)}"
                )

    def run(self) -> None:
        """Write `why.json` and `why.html`.

        Raises:
            BrokkError: logs, policy or simulator cannot be used, or the first stage failed.
        """
        self._try_inputs()
        folder = self.session.folder.resolve()
        write_groups(folder, HANDED_ON_GROUPS)
        run_story(self.session, {why_answer.DOCTOR: self._examine()})
        result = self._write_answer()
        if result.doctor["verdict"] != "code":
            self._try_to_play({why_answer.DIAGNOSIS: self._diagnose()})
            if effects := why_answer.read_effects(folder):
                self._try_to_play(self._list_evaluations(folder, effects))
            result = self._write_answer()
        print_text(result.title[0], "bold")
        print_text(why_answer.write_summary(result))
        for step in (*why_answer.list_changes(result), *why_answer.list_records(result)):
            for line in filter(None, step):
                print_text(line)
        print_text(f"page: {self.session.folder / why_answer.WHY_PAGE}", "bold")

    def _write_answer(self) -> WhyResult:
        """Write `why.json` and `why.html` from what the stages have left so far, and return it."""
        folder = self.session.folder.resolve()
        result = why_answer.read_result(folder, self.policy_path, self.simulator)
        write_json(folder / why_answer.WHY_FILE, result.to_json())
        why_answer.write_page(result)
        return result

    @property
    def _is_own(self) -> bool:
        return own_simulator.is_named_in(self.simulator)

    def _try_inputs(self) -> None:
        """Refuse logs, a policy or a simulator that no stage could use, before the first one."""
        load_policy(self.policy_path, self.machine)
        if self._is_own:
            OwnSimulator(source=self.simulator).build(self.machine, 1, torch.device("cpu"))
        record.read_recordings(self.log, self.machine)

    def _try_to_play(self, stages: Mapping[str, StoryStage]) -> None:
        """Run stages whose failure leaves the rest of the answer true."""
        try:
            run_story(self.session, stages)
        except BrokkError as error:
            log.warning("%s", error)

    def _choose_simulator(self) -> list[str]:
        """Return the overrides that choose the simulator."""
        if self._is_own:
            return ["actuator=own", f"actuator.source={json.dumps(self.simulator)}"]
        return [f"actuator={self.simulator}"]

    def _examine(self) -> StoryStage:
        command = [
            "mode=doctor_policy", f"doctor.log={json.dumps(self.log)}",
            f"policy={self.policy_path}", *self._choose_simulator(),
            f"doctor.sent={str(self.sent).lower()}",
        ]  # fmt: skip
        if self.target_in_base_m is not None:
            command.append(f"doctor.target_in_base_m={list(self.target_in_base_m)}")
        return _make_stage("Is the code, the task or the actuator to blame?", command, ("machine",))

    def _diagnose(self) -> StoryStage:
        field = f"diagnosis.field={json.dumps(self.log)}"
        command = ["mode=diagnose", field, *self._choose_simulator()]
        return _make_stage("Which effect does the simulator lack?", command, ("machine", "device"))

    def _list_evaluations(self, folder: Path, effects: Mapping[str, Any]) -> dict[str, StoryStage]:
        """Return the stages that measure success: as trained, with each effect, with all.

        A foreign ONNX file has no task to succeed in: no stage measures it.
        """
        if self.policy_path.endswith(ONNX_SUFFIX):
            return {}
        stages = {why_answer.BEFORE: self._evaluate("As trained", "[library]")}
        for name, node in effects.items() if len(effects) > 1 else ():
            path = folder / HANDED_ON_FOLDER / f"found_{name}.yaml"
            write_text(path, EFFECT_HEAD + yaml.safe_dump({name: node}, sort_keys=False))
            title = f"With {report.name_effect(name)}"
            stages[f"with_{name}"] = self._evaluate(title, f"[library,@{path}]")
        path = folder / why_answer.DIAGNOSIS / "effects.yaml"
        names = [report.name_effect(name) for name in effects]
        title = f"With {names[0]}" if len(names) == 1 else "With all of them"
        stages[why_answer.ALL_EFFECTS] = self._evaluate(title, f"[library,@{path}]")
        return stages

    def _evaluate(self, title: str, effects: str) -> StoryStage:
        command = [
            "mode=evaluate", f"policy={self.policy_path}", *self._choose_simulator(),
            f"effect={effects}", "~policy@rivals.classical", "+rivals={}",
        ]  # fmt: skip
        return _make_stage(title, command, ("machine", "evaluation", "device"))


def _make_stage(title: str, command: list[str], takes: tuple[str, ...]) -> StoryStage:
    return StoryStage(title=title, command=tuple(command), takes=takes, links={}, needs=None)
