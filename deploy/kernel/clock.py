"""Age of stamped messages: when a message was sent, by the receiver's own clock.

All stamps of the bus are readings of one clock, the gateway's. The gateway stamps its messages; the
remote and the PC put the newest stamp that they have heard into theirs. The gateway therefore sees
the whole way of a command or a lever, there and back, and reports that of commands as `RoundTrip`.

The PC does not share the gateway's clock, and reads its own crystal, which no NTP slews. It takes
the shortest transit that it has seen as none, and lets that grow by `DRIFT` at most: the two crystals
cannot differ by more. A delay that grows is seen and stays seen; a delay that was there from the
beginning shows in `RoundTrip`.

A stamp from the future is one wrong message, and teaches nothing. Stamps that get ahead step by step
are from the future as soon as the steps come to as much: no crystal goes so fast. Where many in a
row agree, the gateway's clock was set ahead, and is learned anew. A clock that was set back looks
like a delay of all messages: only a person lets it be learned anew (`accept_delay`).
"""

from __future__ import annotations

import math
from collections import deque

DRIFT = 100e-6
"""Largest difference of the rates of two clocks: two crystals of 50 ppm each, as automotive
controllers have them (AEC-Q200 parts are sold as 20 to 50 ppm)."""
SILENCE_S = 1.0
"""Silence after which the gateway may have started anew, with another clock. By hand."""
FUTURE_S = 0.05
"""By which stamps may seem to come from the future, all steps together. Chosen by hand: above the resolution of stamps
and the shortest transit, far below the delays that are looked for."""
NUM_AGREEING = 25
"""Messages in a row whose delays differ by less than `FUTURE_S`, from which a clock is learned anew:
70 ms of the example bus. Chosen by hand: no random stamps agree so often."""


class GatewayClock:
    """The gateway's clock, as seen from here.

    Attributes:
        newest_s: Newest stamp that was heard, to be put into own messages.
    """

    def __init__(self) -> None:
        self._offset_s, self._heard_s, self.newest_s = math.nan, -math.inf, 0.0
        # By which stamps were ahead of what two crystals explain, all steps together.
        self._ahead_s = 0.0
        # Delays of the last messages, and of those from the future, by the present offset.
        self._delays_s = deque[float](maxlen=NUM_AGREEING)
        self._early_s = deque[float](maxlen=NUM_AGREEING)

    def learn(self, stamp_s: float, modulus_s: float, now_s: float) -> bool:
        """Learn from a message of the gateway itself; return whether it is from the future.

        Args:
            stamp_s: Its stamp.
            modulus_s: Time after which the stamp wraps.
            now_s: When it came.
        """
        elapsed_s, self._heard_s = now_s - self._heard_s, now_s
        if elapsed_s > SILENCE_S:
            self._offset_s = now_s - stamp_s
            self._begin_anew(stamp_s, 0.0)
            return False
        # The shortest transit can only seem to have grown because the clocks differ.
        self._offset_s += DRIFT * elapsed_s
        # By DRIFT the other clock may be the faster one, and by DRIFT the offset has just grown.
        self._ahead_s = max(0.0, self._ahead_s - 2 * DRIFT * elapsed_s)
        delay_s = self._wrap(now_s - stamp_s, modulus_s)
        step_s = max(0.0, -delay_s)
        if self._ahead_s + step_s > FUTURE_S:
            self._early_s.append(delay_s)
            if _agree(self._early_s):
                self._begin_anew(stamp_s, min(self._early_s))
            return True
        self._early_s.clear()
        self._delays_s.append(max(0.0, delay_s))
        # Messages may overtake each other. Around a clock's turn a very late one looks newer.
        is_newer = (stamp_s - self.newest_s) % modulus_s < modulus_s / 2
        if is_newer and delay_s < modulus_s / 4:
            self.newest_s = stamp_s
        self._offset_s -= step_s
        self._ahead_s += step_s
        return False

    def accept_delay(self, stamp_s: float, least_s: float) -> None:
        """Take the present delay as none, where all messages have it alike and it exceeds `least_s`.

        Args:
            stamp_s: Newest stamp that was heard.
            least_s: Delay up to which nothing is changed.
        """
        if _agree(self._delays_s) and min(self._delays_s) > least_s:
            self._begin_anew(stamp_s, min(self._delays_s))

    def is_early(self, stamp_s: float, modulus_s: float, now_s: float) -> bool:
        """Return whether a stamp lies in the future, as far as the clock is known."""
        return self._wrap(now_s - stamp_s, modulus_s) < -FUTURE_S

    def _begin_anew(self, stamp_s: float, delay_s: float) -> None:
        self._offset_s += delay_s
        self.newest_s, self._ahead_s = stamp_s, 0.0
        self._delays_s.clear()
        self._early_s.clear()

    def find_sent_s(self, stamp_s: float, modulus_s: float, now_s: float) -> float:
        """Return when a message that came at `now_s` was stamped, by the clock of `now_s`.

        It is `-inf` where that is unknown: nothing was learned yet, or the stamp seems to come from
        the future. A message that is late by `modulus_s` cannot be told from one that is not.
        """
        delay_s = self._wrap(now_s - stamp_s, modulus_s)
        # NaN, of a clock that is not known, fails the comparison.
        return now_s - max(0.0, delay_s) if delay_s >= -FUTURE_S else -math.inf

    def _wrap(self, raw_s: float, modulus_s: float) -> float:
        """Return the delay beyond the shortest, in [-modulus / 4, 3 modulus / 4)."""
        quarter_s = modulus_s / 4
        return (raw_s - self._offset_s + quarter_s) % modulus_s - quarter_s


def _agree(delays_s: deque[float]) -> bool:
    """Return whether there are enough delays, all alike."""
    return len(delays_s) == NUM_AGREEING and max(delays_s) - min(delays_s) <= FUTURE_S
