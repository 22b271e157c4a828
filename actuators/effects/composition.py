"""Several effects at once: drawn per episode, or around an actuator with its sensors."""

from __future__ import annotations

import zlib

import torch

from actuators.effects.effect import MOTION, EffectChain, EffectSpec
from actuators.models.parameters import OTHER, SharePerJoint
from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

NUM_RECENT = 4
"""Commands that the library's effects on commands see. They look back no further, and a short
window is cheap."""
LIBRARY_SIDES = ("command", *MOTION, "measurement")


@spec
class Library:
    """Machines that differ: each effect is present in a share of the environments, drawn at reset.

    The result is the same as of its effects one around the other, the first of each side nearest
    to the machine. It takes a third of the time: the effects share one draw, one window of
    commands, and one record of the motion that they added.

    Attributes:
        share: Part of the environments that have an effect; or by effect, `other` for the rest.
        effects: Effects by name, on actuation and sensing. An added dead time is nearest to the machine,
            wherever it stands.
    """

    share: SharePerJoint
    effects: dict[str, EffectSpec]

    def check(self) -> None:
        known, where = (*self.effects, OTHER), "effect.library.effects"
        for name in self.share if isinstance(self.share, dict) else ():
            if name not in known:
                raise ConfigError(
                    f"effect.library.share: '{name}' is no effect of it; {list_choices(name, known)}"
                )
        for name, effect in self.effects.items():
            if effect.side not in LIBRARY_SIDES:
                mend = f"put it beside the library, effect=[library,{name}]"
                raise ConfigError(f"{where}.{name}: acts on {effect.side}; {mend}")

    def check_machine(self, machine: Machine) -> None:
        """Refuse numbers that a machine cannot have; effects that do not occur on it are left out."""
        for effect in self.effects.values():
            if effect.find_variant(machine):
                effect.check_machine(machine, "effect.library.effects")

    def _get_shares(self) -> dict[str, float]:
        share = self.share
        if not isinstance(share, dict):
            return dict.fromkeys(self.effects, share)
        return {name: share.get(name, share.get(OTHER, 1.0)) for name in self.effects}

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> EffectChain:
        """Return `model` with the effects around it; see `brokk_rl.contracts.actuator.Effect`.

        Raises:
            ConfigError: A number is out of bounds, or a joint is unknown.
        """
        chain = EffectChain(
            self.effects,
            model,
            machine,
            num_envs,
            device,
            salt=zlib.crc32(b"library"),
            where="effect.library.effects",
            shares=self._get_shares(),
            num_recent=NUM_RECENT,
        )
        model.reset(torch.ones(num_envs, dtype=torch.bool, device=device))
        return chain


@spec
class ActuatorWithEffects:
    """An actuator with effects around it, as recordings show it: positions are sensor readings.

    For free runs and for collecting recordings. A simulator keeps the true positions itself and
    takes the effects from `effect`.

    Attributes:
        actuator: The actuator.
        effects: Effects by name, the first nearest to the machine.
    """

    actuator: Actuator
    effects: dict[str, Effect]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> MeasuredActuatorModel:
        """Return a model for `num_envs` environments on `device`."""
        model = self.actuator.build(machine, num_envs, device)
        return MeasuredActuatorModel(model, self.effects, machine, num_envs, device)


class MeasuredActuatorModel:
    """A model from measured positions to the next measured positions.

    The true positions are kept in the state. They begin at the likeliest truth of the measured
    history.

    Attributes:
        effects: The wrapped model of each effect by name; set their `parameters` to simulate
            candidates side by side.
    """

    def __init__(
        self,
        model: ActuatorModel,
        effects: dict[str, Effect],
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        self.effects: dict[str, ActuatorModel] = {}
        for name, effect in effects.items():
            model = self.effects[name] = effect.wrap(model, machine, num_envs, device)
        self._model = model
        self._truth = getattr(model, "truth", _keep_unchanged)
        self._measure = getattr(model, "measure", _keep_unchanged)
        self._q = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`q`, the true history `(N, H, J)`, and the model's state as `inner.…`."""
        inner = {f"inner.{name}": value for name, value in self._model.state.items()}
        return {"q": self._q, "fresh": self._fresh} | inner

    def reset(self, mask: torch.Tensor) -> None:
        """Forget the true positions in the environments of `mask`, `(N,)` bool."""
        self._fresh.logical_or_(mask)
        self._model.reset(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the measured positions one control period later, shape `(N, J)`."""
        true = torch.where(self._fresh.clone()[:, None, None], self._truth(history.q), self._q)
        q = self._model.step(History(q=true, u=history.u))
        self._q.copy_(torch.cat((true[:, 1:], q[:, None]), 1))
        self._fresh.fill_(False)
        return self._measure(q)


def _keep_unchanged(q: torch.Tensor) -> torch.Tensor:
    return q
