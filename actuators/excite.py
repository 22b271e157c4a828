"""Excitations: commands that show what an actuator does, for collecting the recordings it is identified from."""

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine, exclusive_mask
from brokk_rl.spec import spec


@spec
class Sine:
    """One joint at a time, sine commands of random frequency and amplitude, back home at the stops (the paper's excitation).

    Attributes:
        lowest_hz: Lowest frequency; frequencies are drawn log-uniformly.
        highest_hz: Highest frequency.
        smallest: Smallest amplitude; amplitudes are drawn uniformly.
        largest: Largest amplitude.
        stop_margin: A joint this close to its stop, as a part of its travel, is brought home.
        return_level: Command with which it is brought home.
        rest_s: Rest at home before the next sine.
    """

    lowest_hz: float
    highest_hz: float
    smallest: float
    largest: float
    stop_margin: float
    return_level: float
    rest_s: float

    def check(self) -> None:
        if not 0 < self.lowest_hz <= self.highest_hz:
            raise ConfigError(f"excitation: expected 0 < lowest_hz <= highest_hz, got {self.lowest_hz} and {self.highest_hz}")
        if not 0 < self.smallest <= self.largest <= 1:
            raise ConfigError(f"excitation: expected 0 < smallest <= largest <= 1, got {self.smallest} and {self.largest}")

    def build(self, machine: Machine, num_runs: int, generator: np.random.Generator) -> "SineProcess":
        """Returns the excitation for `num_runs` runs; run `n` moves joint `n` modulo the number of joints."""
        return SineProcess(self, machine, num_runs, generator)


class SineProcess:
    """Sines at work in `N` runs. A new frequency and amplitude are drawn at each end of a full wave, where the command is zero."""

    def __init__(self, config: Sine, machine: Machine, num_runs: int, generator: np.random.Generator) -> None:
        runs = np.arange(num_runs)
        self._joint = runs % machine.num_joints
        self.names = tuple(f"sine_{machine.joint_names[j]}_{n // machine.num_joints:02d}" for n, j in enumerate(self._joint))
        self.start = np.tile(machine.home, (num_runs, 1))
        self._config, self._machine, self._generator, self._runs = config, machine, generator, runs
        margin = config.stop_margin * (machine.upper - machine.lower)
        self._low, self._high, self._home = (
            bound[self._joint] for bound in (machine.lower + margin, machine.upper - margin, machine.home)
        )
        self._going_home = np.zeros(num_runs, dtype=bool)
        self._rest_s = np.zeros(num_runs)
        self._angle = np.zeros(num_runs)
        self._hz, self._amplitude, self._before = np.zeros(num_runs), np.zeros(num_runs), self.start[runs, self._joint]
        self._draw(np.ones(num_runs, dtype=bool))

    def command(self, q: np.ndarray) -> np.ndarray:
        """Returns the commands for the coming control period, `(N, J)`."""
        config, period_s = self._config, self._machine.period_s
        at = q[self._runs, self._joint]
        ahead = at + (at - self._before) / period_s * self._machine.dead_time_s  # where it comes to rest when the command ends now
        self._before = at
        resting = self._rest_s > 0
        self._rest_s -= period_s
        self._going_home |= ~resting & ((at <= self._low) | (at >= self._high))
        side = np.sign(self._home - at)
        arrived = self._going_home & (side != np.sign(self._home - ahead))
        self._going_home &= ~arrived
        self._rest_s[arrived] = config.rest_s
        self._angle[arrived] = 0.0
        sweeping = ~self._going_home & (self._rest_s <= 0)
        self._angle += 2.0 * np.pi * self._hz * period_s * sweeping
        whole = self._angle >= 2.0 * np.pi
        self._angle[whole] = 0.0
        self._draw(whole | arrived)
        level = np.where(
            sweeping, self._amplitude * np.sin(self._angle), np.where(self._going_home, config.return_level * side, 0.0)
        )
        u = np.zeros_like(q)
        u[self._runs, self._joint] = level
        return u

    def _draw(self, mask: np.ndarray) -> None:
        config, count = self._config, len(mask)
        hz = np.exp(self._generator.uniform(np.log(config.lowest_hz), np.log(config.highest_hz), count))
        amplitude = self._generator.uniform(config.smallest, config.largest, count)
        amplitude *= self._generator.choice([-1.0, 1.0], count)  # a wave may start either way
        self._hz, self._amplitude = np.where(mask, hz, self._hz), np.where(mask, amplitude, self._amplitude)


@spec
class Levels:
    """Random levels held for random times on several joints at once, exclusive joints by themselves, from random poses.

    Attributes:
        shortest_s: Shortest time a level is held; times are drawn log-uniformly.
        longest_s: Longest time.
        zero_share: Part of the levels that are zero, so that the number of moving joints varies.
        small_share: Part of the levels drawn from below `small_level`, where the dead band is.
        small_level: Largest small level.
        exclusive_share: Part of the time in which the exclusive joints move and the others rest.
        turn_s: Time after which it is drawn anew which joints may move.
        stop_margin: A joint this close to its stop, as a part of its travel, is only driven away from it.
    """

    shortest_s: float
    longest_s: float
    zero_share: float
    small_share: float
    small_level: float
    exclusive_share: float
    turn_s: float
    stop_margin: float

    def check(self) -> None:
        if not 0 < self.shortest_s <= self.longest_s:
            raise ConfigError(f"excitation: expected 0 < shortest_s <= longest_s, got {self.shortest_s} and {self.longest_s}")
        if not 0 <= self.zero_share + self.small_share <= 1:
            raise ConfigError(f"excitation: zero_share + small_share must lie in [0, 1], got {self.zero_share + self.small_share}")

    def build(self, machine: Machine, num_runs: int, generator: np.random.Generator) -> "LevelsProcess":
        """Returns the excitation for `num_runs` runs."""
        return LevelsProcess(self, machine, num_runs, generator)


class LevelsProcess:
    """Levels at work in `N` runs."""

    def __init__(self, config: Levels, machine: Machine, num_runs: int, generator: np.random.Generator) -> None:
        self._config, self._machine, self._generator = config, machine, generator
        self.names = tuple(f"levels_{n:02d}" for n in range(num_runs))
        margin = config.stop_margin * (machine.upper - machine.lower)
        self._low, self._high = machine.lower + margin, machine.upper - margin
        self.start = generator.uniform(self._low, self._high, (num_runs, machine.num_joints))
        self._level, self._left_s = np.zeros_like(self.start), np.zeros_like(self.start)
        self._positioning, self._turn_s = np.zeros(num_runs, dtype=bool), np.zeros(num_runs)
        self._before = self.start

    def command(self, q: np.ndarray) -> np.ndarray:
        """Returns the commands for the coming control period, `(N, J)`."""
        config, generator, machine = self._config, self._generator, self._machine
        ahead = q + (q - self._before) / machine.period_s * machine.dead_time_s
        self._before = q
        due = self._left_s <= 0
        kind = generator.random(q.shape)
        reach = np.where(kind < config.zero_share + config.small_share, config.small_level, 1.0) * (kind >= config.zero_share)
        level = reach * generator.uniform(-1.0, 1.0, q.shape)
        hold_s = np.exp(generator.uniform(np.log(config.shortest_s), np.log(config.longest_s), q.shape))
        self._level, self._left_s = np.where(due, level, self._level), np.where(due, hold_s, self._left_s) - machine.period_s
        inward = np.where(ahead < self._low, 1.0, np.where(ahead > self._high, -1.0, np.sign(self._level)))
        self._level = inward * np.abs(self._level)

        turn = self._turn_s <= 0
        self._positioning = np.where(turn, generator.random(len(q)) < config.exclusive_share, self._positioning)
        self._turn_s = np.where(turn, config.turn_s, self._turn_s) - machine.period_s
        if not machine.is_exclusive.any():
            return self._level.copy()
        may_move = exclusive_mask(machine.is_exclusive, self._positioning)
        return self._level * may_move
