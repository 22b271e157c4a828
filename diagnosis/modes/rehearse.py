"""`brokk mode=rehearse`: runs several modes in a row on a machine with withheld effects."""

from __future__ import annotations

from brokk_rl.contracts.actuator import Effect
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.session import Session
from brokk_rl.spec import spec
from diagnosis import story

HANDED_ON_GROUPS = ("sim", "task", "rl", "evaluation")
"""Groups that a stage can take from the story."""


@spec
class Rehearse:
    """Run several modes in a row, each in a folder of its own.

    Attributes:
        session: Folder, seed, device.
        sim: Physics of the stages.
        task: Task of the stages.
        rl: How stages train.
        evaluation: How stages evaluate.
        withheld: Effects that the machine has and that no stage but it is told of:
            `<folder>/given/withheld.yaml`.
        stages: The story, in order.
    """

    session: Session
    sim: Simulator
    task: Task
    rl: TrainingConfig
    evaluation: Evaluation
    withheld: dict[str, Effect]
    stages: dict[str, story.StoryStage]

    def check(self) -> None:
        if not self.stages:
            raise ConfigError(
                "mode=rehearse has no story of its own; give one, as in experiment=gap_loop"
            )
        story.check_stages(self.stages, HANDED_ON_GROUPS)

    def run(self) -> None:
        """Run the stages.

        Raises:
            BrokkError: a stage failed.
        """
        folder = self.session.folder.resolve()
        heads = {"withheld": "# @package effect\n"}
        story.write_groups(folder, (*HANDED_ON_GROUPS, "withheld"), heads)
        story.run_story(self.session, self.stages)
