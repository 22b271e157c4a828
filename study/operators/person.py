"""A simulated person: numbers that stay the same through all trials, hands, and what an operator has to be able to do."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine

if TYPE_CHECKING:
    from actuators.person import HumanFollower

Range = float | tuple[float, float]
"""A number of a person, or a range [low, high] from which each person has one."""


class Person:
    """One simulated person in one trial.

    Args:
        number: Number of the person.
        seed: The same seed, person and name give the same place within a range, whatever the range:
            who is slow is slow in all trials and both conditions.
        chance: What differs from trial to trial.
    """

    def __init__(self, number: int, seed: int, chance: np.random.Generator) -> None:
        self.chance = chance
        self._number, self._seed = number, seed

    def draw(self, name: str, value: Range) -> float:
        """Return the person's number `name`."""
        low, high = value if isinstance(value, tuple) else (value, value)
        if high < low:
            raise ConfigError(f"operator: {name} is [{low}, {high}], expected the lower end first")
        key = (self._seed, self._number, zlib.crc32(name.encode()))
        place = np.random.default_rng(key).random()
        return low + (high - low) * place


OperatorModel = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""A simulated operator at the levers of a machine; one control period a call.

It takes the joint positions at its start, `(J,)`, the centre of the hole's rim, `(3,)`, to which the
model adds its errors of vision, and the commands that are advised, `(J,)`, NaN where none is shown.
It returns the commands of the coming period, `(J,)` in [-1, 1]. Exclusive joints never move
together with others.
"""


class Operator(Protocol):
    """A spec in `conf/operator`: a kind of simulated operator."""

    def build(self, machine: Machine, person: Person) -> OperatorModel:
        """Return a model of the operator `person`."""
        ...


class Hands:
    """A person's hands: they follow the wanted deflections as `follower=person` does.

    Args:
        follower: The person's motor properties; ranges become the person's numbers.
        machine: The machine.
        person: Whose hands they are.
    """

    def __init__(self, follower: HumanFollower, machine: Machine, person: Person) -> None:
        import torch

        drawn: dict[str, Any] = {}
        for field in fields(follower):
            value = getattr(follower, field.name)
            if isinstance(value, tuple):
                # Of whole numbers each has an interval of its own: they are equally likely.
                half = 0.499 if field.name == "joints_at_once" else 0.0
                number = person.draw(field.name, (value[0] - half, value[1] + half))
                drawn[field.name] = round(number) if half else number
        self._torch = torch
        torch.manual_seed(int(person.chance.integers(2**31)))
        self._model = replace(follower, **drawn).build(machine, 1, torch.device("cpu"))

    def step(self, wanted: np.ndarray) -> np.ndarray:
        """Return the mean command of the coming period, `(J,)`, where deflections `(J,)` are wanted from now on."""
        with self._torch.inference_mode():
            given = self._model.step(self._torch.as_tensor(wanted[None], dtype=self._torch.float32))
        return given[0].numpy().astype(float)
