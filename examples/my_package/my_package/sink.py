"""An effect: joints that sink."""

from brokk_rl.spec import Finite, spec


@spec
class Sink:
    """Sink at a constant speed.

    Attributes:
        speed: Speed in rad/s or m/s.
    """

    speed: Finite

    def wrap(self, model, machine, num_envs, device):
        """Return the model with the effect around it."""
        return SinkModel(model, self.speed * machine.period_s)


class SinkModel:
    """A model whose joints sink by `step` in each control period."""

    def __init__(self, model, step):
        self._model, self._step = model, step
        self.state = model.state

    def reset(self, mask):
        """Let the model inside begin anew in the environments of `mask`."""
        self._model.reset(mask)

    def step(self, history):
        """Return the joint positions one control period later, (N, J)."""
        return self._model.step(history) - self._step
