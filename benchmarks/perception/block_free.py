"""Pictures without a block: on how many of them a network names one.

    python benchmarks/perception/block_free.py <out.json> [<network> ...]        # judges by the withheld pictures
    python benchmarks/perception/block_free.py --train <folder>                  # writes those to learn from

The pictures are views cut from photographed panoramas (Poly Haven, CC0), which the package `viser`
brings, and photographs of scikit-learn and matplotlib. Panoramas of one list are never in the other.
Pictures to learn from are views of the other panoramas, and drawn layers of leaves: shapes that
cover one another, of sizes by a power law ("dead leaves"), have statistics of real foliage.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path

import cv2
import numpy as np
from rich.progress import track

from brokk_rl.signals import Frame
from perception.segment.network import THRESHOLD, Onnx

WITHHELD = ("rooitou_park", "st_fagans_interior", "kiara_1_dawn", "dikhololo_night")
LEARNED = (
    "forest_slope", "empty_warehouse_01", "potsdamer_platz", "lebombo", "venice_sunset", "studio_small_03",
)  # fmt: skip
SIZE_PX = (640, 360)
JUDGED_EACH = (10, 9, 9, 9)
"""Views of each withheld panorama; with three photographs they are 40 pictures."""
VIEWS_EACH, LEAVES = 120, 500
"""Pictures to learn from: views of each panorama, and drawn leaves."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("networks", nargs="*", default=["segmenter.onnx"])
    parser.add_argument("--train", action="store_true", help="write pictures to learn from")
    parser.add_argument("--panoramas", type=Path, help="their folder; default: that of viser")
    parser.add_argument("--gate", help="also judge the first network behind this gate")
    parser.add_argument("--pictures", type=Path, help="folder of other pictures to judge by")
    given = parser.parse_args()
    panoramas = given.panoramas or find_panoramas()
    if given.train:
        write_training(given.out, panoramas)
        return
    pictures = read_judged(panoramas) if given.pictures is None else read_folder(given.pictures)
    rows = {}
    for network in given.networks:
        rows[Path(network).name] = judge(network, None, pictures)
    if given.gate is not None:
        rows["ships"] = judge(given.networks[0], given.gate, pictures)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    command = "python benchmarks/perception/block_free.py <out.json>"
    given.out.write_text(
        json.dumps({"command": command, "commit": commit, "networks": rows}, indent=1) + "\n"
    )
    for name, row in rows.items():
        print(f"{name}: a block in {row['named']} of {row['pictures']} pictures without one")


def find_panoramas() -> Path:
    import viser

    return Path(viser.__file__).parent / "_assets" / "hdri"


def read_folder(folder: Path) -> dict[str, np.ndarray]:
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
            found[path.name] = read_rgb(path)
    return found


def read_judged(panoramas: Path) -> dict[str, np.ndarray]:
    """Return the withheld pictures by name, RGB."""
    found = {}
    for name, count in zip(WITHHELD, JUDGED_EACH, strict=True):
        chance = np.random.default_rng(100)
        panorama = read_rgb(panoramas / f"{name}_1k.jpg")
        for number in range(count):
            found[f"{name} {number}"] = cut_view(panorama, chance, 360.0 * number / count)
    from matplotlib import cbook
    from sklearn.datasets import load_sample_images

    photographs = [*load_sample_images().images]
    path = cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)
    photographs.append(read_rgb(Path(str(path))))
    for name, picture in zip(("temple", "flower", "person"), photographs, strict=True):
        found[name] = np.ascontiguousarray(picture)
    return found


def read_rgb(path: Path) -> np.ndarray:
    """Return a picture, RGB.

    Raises:
        FileNotFoundError: it is missing or no picture.
    """
    picture = cv2.imread(str(path))
    if picture is None:
        raise FileNotFoundError(f"{path} is missing or no picture")
    return picture[..., ::-1]


def judge(network: str, gate: str | None, pictures: dict[str, np.ndarray]) -> dict[str, object]:
    """Return on how many pictures a network names a block, and the part of each that it takes."""
    segmenter = Onnx(weights=network, margin=0.15, gate=gate, threads=1).build()
    parts = {}
    for name, picture in track(pictures.items(), network, transient=True):
        height, width = picture.shape[:2]
        frame = Frame(
            color=np.ascontiguousarray(picture),
            depth_m=np.full((height, width), np.nan, np.float32),
            camera_matrix=np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]),
            base_from_camera=None,
            t_s=0.0,
        )
        block = segmenter.segment(frame).block > THRESHOLD
        parts[name] = float(block.mean())
    named = sum(part > 0 for part in parts.values())
    return {"pictures": len(parts), "named": named, "largest": max(parts.values()), "parts": parts}


def cut_view(panorama: np.ndarray, chance: np.random.Generator, yaw_deg: float) -> np.ndarray:
    """Return a view of 60 to 95 degrees in a direction about the horizon or below it."""
    width, height = SIZE_PX
    focal_px = width / 2 / np.tan(np.radians(chance.uniform(60, 95)) / 2)
    pitch, roll = np.radians(chance.uniform(-45, 15)), np.radians(chance.uniform(-5, 5))
    yaw = np.radians(yaw_deg + chance.uniform(-15, 15))
    x, y = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    rays = np.stack([x, y, np.full_like(x, focal_px)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    turns = [cv2.Rodrigues(np.array(one))[0] for one in ((pitch, 0.0, 0.0), (0.0, 0.0, roll))]
    rays = rays @ (turns[0] @ turns[1]).T
    rows, columns = panorama.shape[:2]
    u = ((np.arctan2(rays[..., 0], rays[..., 2]) + yaw) / (2 * np.pi)) % 1.0 * columns
    v = (np.arcsin(np.clip(rays[..., 1], -1, 1)) / np.pi + 0.5) * rows
    return cv2.remap(
        panorama, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
    )  # fmt: skip


def draw_leaves(chance: np.random.Generator) -> np.ndarray:
    """Return layers of leaves, blades or stones, far ones first, RGB."""
    width, height = SIZE_PX
    hue = chance.uniform(15, 45) if chance.random() < 0.7 else chance.uniform(0, 180)
    base = np.array([hue * 2, chance.uniform(40, 180), chance.uniform(40, 150)])
    canvas = np.full((height, width, 3), 30, np.uint8)
    slim = chance.uniform(1.0, 6.0)
    least, most = chance.uniform(2, 8), chance.uniform(30, 220)
    count = int(min(6000, 4.0 * width * height / (least * most)))
    shading = chance.uniform(0.3, 0.9)
    for number in range(count):
        # Sizes by a power law with exponent 3, as in natural pictures.
        share = chance.random()
        size = (least**-2 * (1 - share) + most**-2 * share) ** -0.5
        near = shading + (1 - shading) * number / count
        tone = base + chance.normal(0, 1, 3) * [12, 25, 25]
        tone[2] *= near
        pixel = [int(tone[0] / 2) % 180, *np.clip(tone[1:], 5, 250).astype(int)]
        hsv = np.array([[pixel]], np.uint8)
        colour = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0]
        place = (int(chance.uniform(0, width)), int(chance.uniform(0, height)))
        axes = (max(1, int(size)), max(1, int(size / slim)))
        angle = chance.uniform(0, 360)
        cv2.ellipse(canvas, place, axes, angle, 0, 360, colour.tolist(), -1, cv2.LINE_AA)
        if size > 12:
            vein = np.clip(colour.astype(int) * 1.15, 0, 255).astype(int).tolist()
            along = axes[0] * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            ends = [(int(place[0] + s * along[0]), int(place[1] + s * along[1])) for s in (-1, 1)]
            cv2.line(canvas, ends[0], ends[1], vein, max(1, int(size / 30)), cv2.LINE_AA)
    noise = chance.normal(0, chance.uniform(1, 8), canvas.shape)
    return np.clip(
        cv2.GaussianBlur(canvas, (0, 0), chance.uniform(0.4, 1.4)) + noise, 0, 255
    ).astype(np.uint8)


def write_training(folder: Path, panoramas: Path) -> None:
    """Write views of panoramas and drawn leaves."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in LEARNED:
        chance = np.random.default_rng(7)
        panorama = read_rgb(panoramas / f"{name}_1k.jpg")
        for number in range(VIEWS_EACH):
            view = cut_view(panorama, chance, chance.uniform(0, 360))
            cv2.imwrite(str(folder / f"{name}_{number:03d}.jpg"), view[..., ::-1])
    for number in range(LEAVES):
        view = draw_leaves(np.random.default_rng(number))
        cv2.imwrite(str(folder / f"leaves_{number:03d}.jpg"), view[..., ::-1])


if __name__ == "__main__":
    main()
