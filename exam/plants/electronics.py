"""Electronics of the plants: command frames on the bus, losses in bursts, encoders."""

from __future__ import annotations

import numpy as np

from exam.plants.changes import PlantParameters

NUM_FRAMES = 64
"""Frames on their way: 3.2 s at 20 Hz, more than any delay."""
BURST_FRAMES = 1.8
"""Mean length of a burst of lost frames; chosen by hand, as of a fading radio link."""
NUM_MOTIONS = 4096
"""Motions of a run for which the rest of a compensator is drawn; then they repeat."""
QUANTISER_BAND = 0.6
"""Steps that a position must leave its reading by before that changes: 0.5 without hysteresis."""


class CommandBus:
    """Command frames: sent once a period, delivered late and in order, in force until the next.

    Args:
        numbers: `transport_s`, `jitter_s`, `loss`, each `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._numbers = numbers
        shape = numbers["transport_s"].shape
        self._u = np.zeros((NUM_FRAMES, *shape))
        self._due_s = np.full((NUM_FRAMES, *shape), -np.inf)
        self._sent, self._seen = 0, np.zeros(shape, dtype=int)

    def send(
        self, u: np.ndarray, t_s: float, luck: np.ndarray, late: np.ndarray, later_s: np.ndarray
    ) -> None:
        """Send a frame.

        Args:
            u: Commands, `(N, J)`.
            t_s: Now.
            luck: In [0, 1), `(N, 1)`: a frame below the share of loss never arrives.
            late: In [0, 1), `(N, 1)`: how much of the longest jitter this frame has.
            later_s: Further delay of this frame, `(N, J)`.
        """
        numbers = self._numbers
        before, slot = self._sent % NUM_FRAMES, (self._sent + 1) % NUM_FRAMES
        due_s = t_s + numbers["transport_s"] + numbers["jitter_s"] * late + later_s
        lost = luck < numbers["loss"]
        self._u[slot] = np.where(lost, self._u[before], u)  # a lost frame says nothing new
        self._due_s[slot] = np.maximum(due_s, self._due_s[before])  # none overtakes another
        self._sent += 1

    def at(self, t_s: float) -> np.ndarray:
        """Return the commands in force at `t_s`, `(N, J)`; times may only grow."""
        following = np.minimum(self._seen + 1, self._sent)
        arrived = np.take_along_axis(self._due_s, (following % NUM_FRAMES)[None], 0)[0] <= t_s
        self._seen = np.where(arrived, following, self._seen)
        return np.take_along_axis(self._u, (self._seen % NUM_FRAMES)[None], 0)[0]


def draw_chance(seed: int, one: PlantParameters, steps: int) -> dict[str, np.ndarray]:
    """Return the random numbers of one run of a machine with valves, by name.

    They are: whether the frame of each period is lost, `(T,)`; delay of each frame over the mean delay of
    the `queue`, `(T,)`; `noise` of the encoders over its standard deviation, `(T, J)`; uniform `luck`,
    `(T,)`; normal numbers of the tracker of the `tool`, `(T, 4)`; where compensators come to rest when
    `settling`, normal, `(M, J)`; and one uniform `phase`, `(1,)`.
    """
    generator = np.random.default_rng([seed, 7])
    periods, count = steps + 1, len(one["loss"])
    return {
        "lost": draw_bursts(generator.random(periods), float(one["loss"].max())),
        # waiting times of a queue are exponential; a frame older than three means is dropped
        "queue": np.minimum(generator.exponential(1.0, periods), 3.0),
        # of a Laplace distribution the variance is twice the squared scale
        "noise": generator.laplace(0.0, np.sqrt(0.5), (periods, count)).astype(np.float32),
        "luck": generator.random(periods),
        "tool": generator.standard_normal((periods, 4)).astype(np.float32),
        "settling": generator.standard_normal((NUM_MOTIONS, count)).astype(np.float32),
        "phase": generator.random(1),
    }


def draw_bursts(luck: np.ndarray, share: float) -> np.ndarray:
    """Return which frames a two-state channel loses, `(T,)` bool: `share` of them in the long run.

    A burst ends with the chance `1 / BURST_FRAMES` a frame (Gilbert 1960).
    """
    ends = 1.0 / BURST_FRAMES
    begins = min(ends * share / max(1.0 - share, 1e-9), 1.0)
    lost, is_bad = np.zeros(len(luck), dtype=bool), False
    for k, chance in enumerate(luck.tolist()):
        is_bad = chance >= ends if is_bad else chance < begins
        lost[k] = is_bad
    return lost


class SteppedEncoders:
    """Positions as they are logged.

    Args:
        numbers: The machine's, `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._n = numbers
        self._sigma = np.hypot(numbers["noise_rad"], numbers["extra_noise_rad"])
        self._step = np.maximum(numbers["step_rad"], 1e-9)
        self._count: np.ndarray | None = None

    def read(self, q: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the readings at positions `q` with unit noise, both `(N, J)`."""
        n = self._n
        shown = n["scale"] * q + n["bias_rad"] + self._sigma * noise
        nearest = np.round(shown / self._step)
        if self._count is None:
            self._count = nearest
        keeps = np.abs(shown / self._step - self._count) < QUANTISER_BAND
        self._count = np.where(keeps, self._count, nearest)
        return np.where(n["step_rad"] > 0, self._count * self._step, shown)
