"""Labels of `mode=label` beside the truth of rendered footage, as a user makes them.

    python benchmarks/perception/labels.py <out.json> --seeds 0 1 2

Each footage is ten frames of one block with a board beside it, and three clicks that are 2 px off
(`scene=footage`). It is labelled once as it is. Then all clicks are moved 6 px to the right and the
block is not refined, so that the outline lies beside the block: such frames should be left out.
`corner_mm` is the largest error of a corner in a frame; the pose of the camera by the board is part
of it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perception import dataset
from perception.benchmark.label_score import compare_corners, compute_overlap

RIGS = ("zed_2i_720p", "zed_2i_1080p")
NOISE_PER_M = {"zed_2i_720p": 0.0048, "zed_2i_1080p": 0.0024}
"""`label.noise_per_m` of each rig; conf/mode/label.yaml gives both."""
MOVED_PX = 6.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--sensors", nargs="+", default=["linear", "mosaic"])
    parser.add_argument(
        "--runs", type=Path, help="keep the runs here, and use those that are there"
    )
    given = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.runs or Path(temporary)
        rows = list(label_all(folder, given.sensors, given.seeds))
    seeds, sensors = (" ".join(map(str, some)) for some in (given.seeds, given.sensors))
    content = {
        "command": f"python benchmarks/perception/labels.py <out.json> --seeds {seeds} "
        f"--sensors {sensors}",
        "machine": "two shared cores",
        "commit": commit,
        "rows": rows,
    }
    given.out.write_text(json.dumps(content, indent=1) + "\n")


def label_all(folder: Path, sensors: list[str], seeds: list[int]) -> Iterator[dict[str, Any]]:
    """Yield a row for each footage."""
    for sensor in sensors:
        for rig in RIGS:
            for seed in seeds:
                footage = folder / f"footage_{rig}_{sensor}_{seed}"
                if not (footage / "placing.yaml").is_file():
                    run("mode=render", "scene=footage", f"rig={rig}", f"rig/sensor={sensor}",
                        "render.count=10", f"session.seed={seed}", f"session.out={footage}")  # fmt: skip
                yield {"sensor": sensor, "rig": rig, "seed": seed, **judge_footage(footage, rig)}


def judge_footage(footage: Path, rig: str) -> dict[str, Any]:
    """Return how many frames are kept as placed and as moved, and the errors of the kept labels."""
    kept = label(footage, rig, footage / "placing.yaml", 20)
    placing = yaml.safe_load((footage / "placing.yaml").read_text())
    for place in placing["corners_px"]:
        place[0] += MOVED_PX
    (footage / "moved.yaml").write_text(yaml.safe_dump(placing))
    moved = label(footage, rig, footage / "moved.yaml", 0)
    corners_m, overlaps = [], []
    for name in kept["names"]:
        found, true = kept["frames"] / name, footage / "frames" / name
        corners_m.append(compare_corners(found, true))
        blocks = (dataset.read_label(stem).block for stem in (found, true))
        overlaps.append(compute_overlap(*blocks))
    return {
        "frames": kept["count"],
        "kept": len(kept["names"]),
        "left_out": kept["left_out"],
        "corner_mm": {"median": 1000 * float(np.median(corners_m)), "most": 1000 * max(corners_m)},
        "least_overlap": min(overlaps),
        "moved_kept": len(moved["names"]),
    }


def label(footage: Path, rig: str, placing: Path, num_refined: int) -> dict[str, Any]:
    """Return the names of the frames that are kept, and why the others are not."""
    out = footage.parent / f"labels_{placing.stem}_{footage.name}"
    # All frames left out is an answer too, and ends with an error.
    is_done = (out / "labels.json").is_file() or run(
        "mode=label", f"label.source.folder={footage / 'frames'}", f"label.placing={placing}",
        f"label.num_refined={num_refined}", f"label.noise_per_m={NOISE_PER_M[rig]}",
        f"session.out={out}", may_fail=placing.stem == "moved",
    )  # fmt: skip
    frames = json.loads((out / "labels.json").read_text())["frames"] if is_done else {}
    reasons = {name: one["left_out"] for name, one in frames.items()}
    return {
        "frames": out / "frames",
        "count": len(frames),
        "names": [name for name, reason in reasons.items() if reason is None],
        "left_out": [reason for reason in reasons.values() if reason],
    }


def run(*overrides: str, may_fail: bool = False) -> bool:
    """Run `brokk` and return whether it ended well."""
    ended = subprocess.run([sys.executable, "-m", "brokk_rl", *overrides], check=not may_fail)
    return ended.returncode == 0


if __name__ == "__main__":
    main()
