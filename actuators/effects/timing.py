"""Effects on when a command arrives."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import ANY_INTERFACE, EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber, Value
from actuators.models.parameters import split_run_commands
from brokk_rl.spec import spec


class _Delayed(EffectSpec):
    """Commands shifted in time by a constant, exact in the way a joint with constant speed goes.

    A shift that is no multiple of the period gives the mean of the command over each period. The
    inner model sees a shifted history, so that commands which have left its history must be
    remembered for as long again.
    """

    side = "command"
    stage = "timing"
    delays = True
    interfaces = ANY_INTERFACE

    def begin(self, now: StepInputs) -> Memory:
        """Before the history the command equals its oldest entry."""
        u = now.history.u
        return {"older": u[:, :1].expand(-1, u.shape[1] - 1, -1)}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """The commands of as long ago as its number says."""
        (shift_s,) = now.value.values()
        u = now.history.u
        known, size = torch.cat((now.memory["older"], u), 1), u.shape[1]
        shifted = _delay_commands(known, shift_s / now.plant.period_s, size)
        return shifted, {"older": known[:, 1:size]}


@spec
class DeadTime(_Delayed):
    """Commands act later by a constant time.

    Attributes:
        joints: Joints it acts on, or `all`.
        dead_time_s: Transport delay beyond that of the inner model. A negative one shows the inner
            model commands ahead of time: exact up to its own dead time.
    """

    numbers: ClassVar = {
        "dead_time_s": EffectNumber("s", none=0.0, typical=0.1, bounds=(-0.3, 0.5), scale="time")
    }


@spec
class ClockOffset(_Delayed):
    """Positions and commands are stamped by different clocks.

    In a recording a position stamped late looks like a command that acts late, and for a controller
    the loop is longer by as much; so it is simulated as one, see `DeadTime`.

    Attributes:
        joints: Joints it acts on, or `all`.
        offset_s: How much later than their commands positions are stamped.
    """

    shared = True
    # A loop that holds a target shows it as a dead time.
    interfaces = frozenset({"speed", "torque"})
    numbers: ClassVar = {
        "offset_s": EffectNumber("s", none=0.0, typical=0.05, bounds=(-0.3, 0.3), scale="time")
    }


@spec
class DelayJitter(EffectSpec):
    """Each command frame has its own delay, shared by all joints; no frame overtakes another.

    Attributes:
        joints: Joints it acts on, or `all`.
        jitter_s: Longest delay; delays are uniform from 0.
    """

    side = "command"
    stage = "timing"
    stochastic = True
    shared = True
    interfaces = ANY_INTERFACE
    numbers: ClassVar = {
        "jitter_s": EffectNumber("s", none=0.0, typical=0.03, bounds=(0.0, 0.5), scale="time")
    }

    def begin(self, now: StepInputs) -> Memory:
        """Frames have been in time."""
        return {"sent": now.history.u[:, :-1], "delay": torch.zeros_like(now.moved)}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`u(t - delay)`, in which the delay grows by no more than one period a period."""
        u = now.history.u
        delay = torch.minimum(
            now.value["jitter_s"] / now.plant.period_s * now.chance, now.memory["delay"] + 1.0
        )
        newest = _delay_commands(u, delay, 1)[:, 0]
        sent, memory = append_command(now, newest)
        return sent, memory | {"delay": delay}


@spec
class FrameLoss(EffectSpec):
    """Command frames get lost, for all joints at once; the command before is held.

    Attributes:
        joints: Joints it acts on, or `all`.
        probability: Share of frames that are lost.
        persistence: How losses hang together: 0 where each frame is lost by itself; a loss lasts
            `1 / ((1 - persistence) (1 - probability))` frames on average.
    """

    persistence: Value = 0.0  # each frame by itself, as files from before this number mean
    side = "command"
    stage = "timing"
    recent = 2
    stochastic = True
    smooth = False
    shared = True
    interfaces = ANY_INTERFACE
    numbers: ClassVar = {
        "probability": EffectNumber("1", none=0.0, typical=0.02, bounds=(0.0, 0.95)),
        "persistence": EffectNumber(
            "1", none=None, typical=0.0, bounds=(0.0, 0.98), trials=(0.0, 0.7, 0.9)
        ),
    }

    def begin(self, now: StepInputs) -> Memory:
        """All frames have arrived."""
        return {"sent": now.history.u[:, :-1], "was_lost": torch.zeros_like(now.moved)}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """The newest command, or where it is lost the one before as the valve saw it.

        A frame is lost with `(1 - persistence) probability`, after a lost one with `persistence`
        more: of all frames the share `probability`.
        """
        kept = now.value["persistence"]
        lost = now.chance < (1.0 - kept) * now.value["probability"] + kept * now.memory["was_lost"]
        newest = torch.where(lost, now.memory["sent"][:, -1], now.history.u[:, -1])
        sent, memory = append_command(now, newest)
        return sent, memory | {"was_lost": lost.to(now.moved.dtype)}


def append_command(now: StepInputs, newest: torch.Tensor) -> tuple[torch.Tensor, Memory]:
    """Return the commands seen so far with `newest`, `(N, J)`, appended; and the memory."""
    u = torch.cat((now.memory["sent"], newest[:, None]), 1)
    return u, {"sent": u[:, 1:]}


def _delay_commands(u: torch.Tensor, periods: torch.Tensor, count: int) -> torch.Tensor:
    """Return the newest `count` of commands `(N, T, J)`, delayed by `periods`, `(N, J)`.

    Commands are held beyond both ends.
    """
    first = u.shape[1] - count + 1
    earlier, later, part = split_run_commands(u.transpose(0, 1), periods, first)
    return (later + part * (earlier - later)).transpose(0, 1)
