"""Photographs as surfaces of rendered scenes, so that a network does not learn the renderer's grain."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.spec import PositiveRange, Share, spec
from perception.render.materials import Photograph, read_photograph
from perception.render.scene_ranges import Scene, draw_log_uniform

ENDINGS = (".png", ".jpg", ".jpeg")


@spec
class PhotographedSurfaces:
    """Photographs on the ground, on walls, on the block and on other things.

    Attributes:
        folder: Folder of photographs (PNG, JPEG), those below it too; `null` for none.
        share: Probability that a thing has one.
        block_share: The same for the block.
        size_m: Side of a photograph on a surface; each size as likely as any other.
    """

    folder: str | None
    share: Share
    block_share: Share
    size_m: PositiveRange

    def check(self) -> None:
        if self.folder is not None and not _list_photographs(self.folder):
            raise ConfigError(
                f"folder: expected a folder with photographs ({', '.join(ENDINGS)}), found none in "
                f"{self.folder}"
            )

    def paint(self, scene: Scene, generator: np.random.Generator) -> Scene:
        """Return a scene, some of whose surfaces are photographed; the same where there is none.

        Raises:
            FrameError: a photograph cannot be read.
        """
        if self.folder is None:
            return scene
        paths = _list_photographs(self.folder)
        solids: list[Any] = []
        block = None
        for solid in scene.solids:
            painted: Any = solid
            share = self.block_share if solid.role == "block" else self.share
            if solid.role != "board" and generator.random() < share:
                path = paths[int(generator.integers(len(paths)))]
                photograph = _load_photograph(path)
                side_m = draw_log_uniform(self.size_m, generator)
                # The mirror images beside it make the pyramid twice as wide.
                texel_m = 2.0 * side_m / photograph.levels[0].shape[0]
                photograph = replace(photograph, texel_m=texel_m)
                materials = tuple(replace(one, photograph=photograph) for one in solid.materials)
                painted = replace(painted, materials=materials)
            if solid is scene.block:
                block = painted
            solids.append(painted)
        return replace(scene, solids=tuple(solids), block=block)


NO_PHOTOGRAPHS = PhotographedSurfaces(folder=None, share=0.0, block_share=0.0, size_m=(1.0, 1.0))


def _list_photographs(folder: str) -> tuple[Path, ...]:
    found = []
    for path in sorted(Path(folder).rglob("*")):
        if path.suffix.lower() in ENDINGS and not path.name.startswith("."):
            found.append(path)
    return tuple(found)


@lru_cache(maxsize=8)
def _load_photograph(path: Path) -> Photograph:
    """Return a photograph; some stay in memory, 17 MB each."""
    return read_photograph(path)
