"""Side and top view of an episode drawn with matplotlib, for computers on which no GL library works."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.scene import HALF_LENGTH_M, HALF_WIDTH_M, HOLE_DEPTH_M


def frames(
    machine: Machine, arrays: dict[str, np.ndarray], size: tuple[int, int]
) -> Callable[[Iterable[int]], Iterator[np.ndarray]]:
    """Returns what draws the given steps as pictures of `size` (width, height), uint8; see `sim.video.write`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from brokk_rl.sim.video import captions

    pose = Kinematics(machine).pose(torch.as_tensor(arrays["q"], dtype=torch.float32))
    chain = torch.cat(
        (
            torch.zeros_like(pose.tip_in_base_m[:, None]),
            pose.joints_in_base_m,
            pose.tip_in_base_m[:, None],
        ),
        1,
    ).numpy()
    lines, scene = captions(machine, arrays), arrays["scene"]

    def draw(steps: Iterable[int]) -> Iterator[np.ndarray]:
        figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        side, top = figure.subplots(1, 2)
        arms = [_view(axes, scene, up) for axes, up in ((side, 2), (top, 1))]
        title = figure.suptitle("", family="monospace", fontsize=10)
        for step in steps:
            for (links, chisel), up in zip(arms, (2, 1), strict=True):
                links.set_data(chain[step, :-1, 0], chain[step, :-1, up])
                chisel.set_data(chain[step, -2:, 0], chain[step, -2:, up])
            title.set_text(lines[step])
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[..., :3]

    return draw


def _view(axes, scene: np.ndarray, up: int):
    """Sets up one view, along y (`up` = 2) or from above (`up` = 1); returns the lines of the arm and the chisel."""
    x, y, rim_z, yaw, scale, radius = scene
    length, width = HALF_LENGTH_M * scale, HALF_WIDTH_M * scale
    if up == 2:
        reach = abs(length * np.cos(yaw)) + abs(width * np.sin(yaw))
        xs = [-reach, -radius, -radius, radius, radius, reach, reach, -reach]
        zs = [0.0, 0.0, -HOLE_DEPTH_M, -HOLE_DEPTH_M, 0.0, 0.0, -rim_z, -rim_z]
        corners = np.stack([xs, zs], axis=1) + np.array([x, rim_z])
    else:
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        corners = np.array(
            [[-length, -width], [length, -width], [length, width], [-length, width]]
        ) @ turn.T + np.array([x, y])
    axes.fill(*corners.T, color="0.75", zorder=0)
    if up == 2:
        axes.axhline(0.0, color="0.4", linewidth=1)
    else:
        angles = np.linspace(0, 2 * np.pi, 60)
        axes.plot(
            x + radius * np.cos(angles), y + radius * np.sin(angles), color="0.2", linewidth=1
        )
    axes.set(
        xlim=(-1.0, 5.0),
        ylim=(-0.8, 3.6) if up == 2 else (-2.6, 2.6),
        xlabel="x / m",
        ylabel="z / m" if up == 2 else "y / m",
    )
    axes.set_aspect("equal")
    (links,) = axes.plot(
        [],
        [],
        "-o",
        color="darkorange",
        linewidth=5,
        markersize=5,
        markerfacecolor="0.2",
        markeredgecolor="0.2",
    )
    (chisel,) = axes.plot([], [], color="0.15", linewidth=3)
    return links, chisel
