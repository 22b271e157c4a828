"""End-to-end protection: who is believed, and how old a stamped message is."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable

import pytest
from crccheck.crc import Crc8SaeJ1850

from deploy.kernel.clock import NUM_AGREEING, GatewayClock
from deploy.kernel.protection import ChannelTrust, MessageFault, ProtectedChannel, compute_crc8

PERIOD_S, WRAP_S = 0.02, 2.048
GOOD, CRC, REPEATED = None, MessageFault.CRC, MessageFault.REPEATED
SEQUENCE, LATE, RATE = MessageFault.SEQUENCE, MessageFault.LATE, MessageFault.RATE
INIT, VALID, INVALID = ChannelTrust


class Listener:
    """A channel with a clock: its sender is on time, and stamps each message when it sends it."""

    def __init__(self, period_s: float = PERIOD_S, wrap_s: float = WRAP_S) -> None:
        self.channel = ProtectedChannel(16, period_s, wrap_s)
        self.now_s = 100.0
        self.period_s = period_s

    def hear(self, counters: Iterable[int | None]) -> list[MessageFault | None]:
        """Hear messages one period apart; `None`: one with a wrong CRC."""
        found = []
        for counter in counters:
            self.now_s += self.period_s
            if counter is None:
                found.append(self.channel.refuse(CRC))
            else:
                found.append(self.channel.take(counter % 16, self.now_s % WRAP_S, self.now_s))
        return found

    @property
    def trust(self) -> ChannelTrust:
        return self.channel.trust


def test_a_channel_is_believed_after_two_messages_in_order() -> None:
    one = Listener()
    one.hear([7])
    assert one.trust is INIT
    one.hear([8])
    assert one.trust is VALID


@pytest.mark.parametrize(
    ("counters", "faults", "trust"),
    [
        ([0, 1, 2, 15, 0], [GOOD, GOOD, GOOD, SEQUENCE, GOOD], VALID),  # one out of order
        ([14, 15, 0, 1], [GOOD] * 4, VALID),  # the counter goes round
        ([0, 1, 5, 6], [GOOD] * 4, VALID),  # three lost
        ([0, 1, 6, 7], [GOOD, GOOD, SEQUENCE, GOOD], VALID),  # four lost: one error
        ([0, 1, 1, 1, 1], [GOOD, GOOD, *[REPEATED] * 3], INVALID),  # stands still
        ([0, 1, 1, 1, 2], [GOOD, GOOD, REPEATED, REPEATED, GOOD], VALID),  # twice repeated by CAN
        ([0, 1, None, None], [GOOD, GOOD, CRC, CRC], INVALID),
        ([0, 1, None, 2, None, 3], [GOOD, GOOD, CRC, GOOD, CRC, GOOD], INVALID),  # every second
        ([None], [CRC], INIT),
        ([None, None], [CRC] * 2, INVALID),
        ([0, None, 1, 2], [GOOD, CRC, GOOD, GOOD], VALID),
    ],
    ids=str,
)
def test_a_channel_judges_by_counter_and_crc(
    counters: list[int | None], faults: list[MessageFault | None], trust: ChannelTrust
) -> None:
    one = Listener()
    assert one.hear(counters) == faults
    assert one.trust is trust
    assert one.channel.errors == {kind: faults.count(kind) for kind in MessageFault}


def test_two_errors_within_fifty_messages_are_too_many_and_two_further_apart_are_not() -> None:
    for apart, trust in ((49, INVALID), (50, VALID)):
        one = Listener()
        one.hear(range(10))
        one.hear([None, *range(10, 9 + apart), None])
        assert one.trust is trust


def test_what_became_invalid_needs_twenty_five_good_messages_in_a_row() -> None:
    one = Listener()
    one.hear([0, 1, None, None, *range(2, 26)])
    assert one.trust is INVALID
    one.hear([26])
    assert one.trust is VALID
    one.hear([27, None])
    assert one.trust is VALID, "the errors of before are forgotten"


def test_a_channel_that_recovered_bears_as_much_as_a_new_one() -> None:
    one = Listener()
    one.hear([0, 1, None, None, *range(2, 28), 27, 27])
    assert one.trust is VALID, "two repetitions"
    one.hear([27])
    assert one.trust is INVALID
    other = Listener()
    other.hear([0, 1, None, None, *range(2, 28), None])
    assert other.trust is VALID, "one error"


@pytest.mark.parametrize("every", [1, 5, 10, 20])
@pytest.mark.parametrize("offset", range(16))
def test_a_second_sender_is_found_whatever_its_counter_with_its_third_message(
    every: int, offset: int
) -> None:
    one = Listener()
    one.hear(range(60))
    for turn in range(3):
        first = 60 + turn * every
        one.hear(range(first, first + every))
        last = first + every - 1
        one.channel.take((last + offset) % 16, one.now_s % WRAP_S, one.now_s)
    one.hear([60 + 3 * every])
    assert one.trust is INVALID


@pytest.mark.parametrize("late_ms", [*range(20, 1000, 20)])
def test_late_copies_of_a_sender_are_found_and_never_used(late_ms: int) -> None:
    one, late = Listener(), late_ms // 20
    one.hear(range(60))
    for number in range(60, 63):
        one.hear([number])
        sent_s = one.now_s - 1e-3 * late_ms
        fault = one.channel.take((number - late) % 16, sent_s % WRAP_S, one.now_s + 0.001)
        assert fault in (LATE, RATE)
    assert one.trust is INVALID


def test_a_sender_whose_clock_began_anew_is_believed_again() -> None:
    one = Listener()
    one.hear(range(60))
    for number in range(60, 100):
        one.now_s += PERIOD_S
        one.channel.take(number % 16, (one.now_s - 0.5) % WRAP_S, one.now_s)
    assert one.channel.errors[LATE] == 2 and one.trust is VALID


def test_after_a_long_silence_a_stamp_is_neither_old_nor_new() -> None:
    for silence_s, fault in ((1.0, LATE), (1.03, GOOD)):
        one = Listener()
        one.hear([0, 1])
        stamp_s = (one.now_s - 0.1) % WRAP_S
        one.now_s += silence_s
        assert one.channel.take(2, stamp_s, one.now_s) is fault


def test_stamps_may_stay_and_wrap_and_need_not_be() -> None:
    one = Listener()
    assert one.hear(range(300)) == [GOOD] * 300, "the stamp wraps twice"
    assert one.channel.take(300 % 16, one.now_s % WRAP_S, one.now_s + 0.02) is GOOD
    other = Listener(wrap_s=0.0)
    other.hear(range(3))
    assert other.channel.take(3, 0.0, other.now_s) is GOOD


def test_more_messages_than_the_cycle_time_allows_are_a_second_sender() -> None:
    one = Listener()
    one.hear(range(10))
    taken = [one.channel.take(k % 16, one.now_s % WRAP_S, one.now_s) for k in range(10, 30)]
    # a quarter of a second of messages may have waited: the one just heard and eleven more
    assert taken[:11] == [GOOD] * 11 and taken[11:] == [RATE] * 9
    assert one.trust is INVALID
    one.hear(range(30, 30 + 24))
    assert one.trust is INVALID and one.channel.errors[RATE] == 9
    one.hear(range(54, 54 + 2))
    assert one.trust is VALID, "a flood leaves no debt that would outlast it"


def test_a_sender_may_be_a_tenth_faster_than_its_cycle_time_and_no_more() -> None:
    for factor, faults in ((0.92, 0), (0.85, 1)):
        one = Listener()
        for number in range(400):
            one.now_s += factor * PERIOD_S
            one.channel.take(number % 16, one.now_s % WRAP_S, one.now_s)
        assert min(1, one.channel.errors[RATE]) == faults
    free = Listener(period_s=0.0)
    free.hear([k % 16 for k in range(400)])
    assert free.trust is VALID, "what is not sent by the clock has no rate"


def test_lost_messages_are_counted() -> None:
    one = Listener()
    one.hear([0, 1, 4, 5])
    assert one.channel.lost == 2


CLOCK_WRAP_S = 65.536


def hear_clock(clock: GatewayClock, seconds: float, ahead_s: float, rate: float = 1.0) -> float:
    """Let a clock that is `ahead_s` ahead, and goes at `rate`, be heard for a time; return the delay seen last."""
    delay_s = math.nan
    for k in range(round(seconds * 10)):
        now_s = 1000.0 + k / 10
        stamp_s = (ahead_s + rate * now_s) % CLOCK_WRAP_S
        clock.learn(stamp_s, CLOCK_WRAP_S, now_s)
        delay_s = now_s - clock.find_sent_s(stamp_s, CLOCK_WRAP_S, now_s)
    return delay_s


@pytest.mark.parametrize("rate", [1.0 - 90e-6, 1.0, 1.0 + 90e-6])
def test_clocks_of_two_crystals_seem_to_have_no_delay_for_hours(rate: float) -> None:
    assert hear_clock(GatewayClock(), 7200.0, 33.3, rate) == pytest.approx(0.0, abs=1e-4)


def test_a_delay_that_grows_by_a_millisecond_a_second_is_seen_and_not_forgotten() -> None:
    # of 1 ms/s a tenth could be the crystals
    assert hear_clock(GatewayClock(), 200.0, 0.0, 1.0 - 1e-3) == pytest.approx(0.18, abs=1e-3)


def test_the_shortest_transit_counts_as_none_and_stamps_of_the_future_as_unknown() -> None:
    clock = GatewayClock()
    assert clock.find_sent_s(0.0, 2.048, 5.0) == -math.inf
    clock.learn(7.0, CLOCK_WRAP_S, 10.04)
    clock.learn(7.2, CLOCK_WRAP_S, 10.20)
    assert clock.find_sent_s(7.2 % 2.048, 2.048, 10.20) == pytest.approx(10.20, abs=1e-3)
    assert clock.find_sent_s(7.1 % 2.048, 2.048, 10.20) == pytest.approx(10.10, abs=1e-3)
    assert clock.find_sent_s(7.24 % 2.048, 2.048, 10.20) == pytest.approx(10.20, abs=1e-3)
    assert clock.find_sent_s(7.26 % 2.048, 2.048, 10.20) == -math.inf
    assert clock.find_sent_s((7.2 - 1.5) % 2.048, 2.048, 10.20) == pytest.approx(8.70, abs=1e-3)


def test_the_newest_stamp_stays_when_an_older_one_comes_and_a_clock_that_begins_anew_is_learned() -> (
    None
):
    clock = GatewayClock()
    for stamp_s, newest_s in ((65.5, 65.5), (0.01, 0.01), (65.53, 0.01), (0.012, 0.012)):
        clock.learn(stamp_s, CLOCK_WRAP_S, 10.0)
        assert clock.newest_s == newest_s
    clock.learn(50.0, CLOCK_WRAP_S, 11.0)
    assert clock.find_sent_s(50.0, CLOCK_WRAP_S, 11.0) != 11.0, "one second may be a delay"
    # 0.8 s later by its own clock, 1.1 s by ours: a delay, or a gateway that began anew
    clock.learn(50.8, CLOCK_WRAP_S, 12.1)
    assert clock.newest_s == 50.8 and clock.find_sent_s(50.8, CLOCK_WRAP_S, 12.1) == 12.1
    assert GatewayClock().newest_s == 0.0


def test_a_stamp_up_to_half_a_turn_ahead_is_newer_and_three_quarters_late_is_late() -> None:
    clock = GatewayClock()
    clock.learn(1.0, 2.048, 10.0)
    clock.learn(1.9, 2.048, 10.9)
    assert clock.newest_s == 1.9
    clock.learn((1.9 + 1.1) % 2.048, 2.048, 10.95)
    assert clock.newest_s == 1.9
    other = GatewayClock()
    other.learn(1.0, CLOCK_WRAP_S, 10.0)
    assert other.find_sent_s(1.49, 2.048, 10.0) == -math.inf
    assert other.find_sent_s((1.0 - 1.53) % 2.048, 2.048, 10.0) == pytest.approx(8.47)


def hear(clock: GatewayClock, stamps: Iterable[float], now_s: float) -> float:
    """Let stamps come every 3 ms from `now_s` on; return the time of the last."""
    for stamp_s in stamps:
        now_s += 0.003
        clock.learn(stamp_s % CLOCK_WRAP_S, CLOCK_WRAP_S, now_s)
    return now_s


def test_one_stamp_of_the_future_teaches_nothing_and_a_clock_that_was_set_ahead_is_learned() -> (
    None
):
    clock = GatewayClock()
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    clock.learn(15.3, CLOCK_WRAP_S, now_s + 0.001)
    assert clock.newest_s < 6.0 and clock.is_early(15.3, CLOCK_WRAP_S, now_s)
    assert not clock.is_early(5.297, CLOCK_WRAP_S, now_s)
    now_s = hear(clock, [5.3], now_s)
    assert clock.find_sent_s(5.3, CLOCK_WRAP_S, now_s) == pytest.approx(now_s, abs=0.01)
    now_s = hear(clock, [15.3 + 0.003 * k for k in range(NUM_AGREEING - 1)], now_s)
    assert clock.is_early(15.375, CLOCK_WRAP_S, now_s + 0.003)
    now_s = hear(clock, [15.3 + 0.003 * NUM_AGREEING], now_s)
    assert clock.newest_s == pytest.approx(15.375)
    assert clock.find_sent_s(15.375, CLOCK_WRAP_S, now_s) == pytest.approx(now_s, abs=1e-6)


@pytest.mark.parametrize(("rate", "early_s"), [(1e-2, 5.05), (1e-3, 55.56), (-1e-2, math.inf)])
def test_a_clock_that_goes_faster_than_a_crystal_is_from_the_future(
    rate: float, early_s: float
) -> None:
    clock, found_s = GatewayClock(), math.inf
    for k in range(21_000):
        now_s = 0.003 * k
        if clock.learn((1.0 + rate) * now_s, CLOCK_WRAP_S, now_s):
            found_s = now_s
            break
    assert found_s == pytest.approx(early_s, abs=0.05)
    # Heard on and on it is learned anew, and gets ahead once more.
    again = []
    for j in range(k, k + 100):
        again.append(clock.learn((1.0 + rate) * 0.003 * j, CLOCK_WRAP_S, 0.003 * j))
    assert sum(again) == (NUM_AGREEING - 1 if found_s < math.inf else 0)


def test_random_stamps_teach_nothing() -> None:
    clock, draw = GatewayClock(), random.Random(3)
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    now_s = hear(clock, [draw.uniform(0.0, CLOCK_WRAP_S) for _ in range(1000)], now_s)
    stamp_s = 5.297 + now_s - 100.3
    assert clock.find_sent_s(stamp_s, CLOCK_WRAP_S, now_s) == pytest.approx(now_s, abs=2e-3)
    assert clock.newest_s <= stamp_s + 0.05


@pytest.mark.parametrize(("back_s", "accepted"), [(0.3, True), (0.1, False)])
def test_a_clock_that_was_set_back_is_learned_when_a_person_says_so(
    back_s: float, accepted: bool
) -> None:
    clock = GatewayClock()
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    clock.accept_delay(5.297, 0.135)
    stamps = [5.3 - back_s + 0.003 * k for k in range(100)]
    now_s = hear(clock, stamps, now_s)
    late_s = now_s - clock.find_sent_s(stamps[-1], CLOCK_WRAP_S, now_s)
    assert late_s == pytest.approx(back_s, abs=2e-3)
    clock.accept_delay(stamps[-1], 0.135)
    late_s = now_s - clock.find_sent_s(stamps[-1], CLOCK_WRAP_S, now_s)
    assert late_s == pytest.approx(0.0 if accepted else back_s, abs=2e-3)
    assert clock.newest_s == stamps[-1]


@pytest.mark.parametrize("least_s", [0.135, 0.28, 0.32])
def test_of_delays_that_agree_the_least_becomes_none(least_s: float) -> None:
    clock = GatewayClock()
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    stamps = [5.3 + 0.003 * k - (0.3 if k % 2 else 0.34) for k in range(100)]
    now_s = hear(clock, stamps, now_s)
    clock.accept_delay(stamps[-1], least_s)
    expected = (0.0, 0.04) if least_s < 0.3 else (0.3, 0.34)
    for late_s, delay_s in zip((0.3, 0.34), expected, strict=True):
        sent_s = clock.find_sent_s(5.297 + 0.3 - late_s, CLOCK_WRAP_S, now_s)
        assert now_s - sent_s == pytest.approx(delay_s, abs=2e-3)


def test_a_clock_set_ahead_is_learned_by_the_message_that_came_fastest() -> None:
    clock = GatewayClock()
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    stamps = [15.3 + 0.003 * k - 0.04 * (k % 2) for k in range(NUM_AGREEING)]
    now_s = hear(clock, stamps, now_s)
    age_s = now_s - clock.find_sent_s(stamps[-1], CLOCK_WRAP_S, now_s)
    assert age_s == pytest.approx(0.0, abs=2e-3)
    late = clock.find_sent_s(stamps[-1] - 0.04, CLOCK_WRAP_S, now_s)
    assert now_s - late == pytest.approx(0.04, abs=2e-3)


def test_delays_that_differ_are_no_clock_that_was_set_back() -> None:
    clock = GatewayClock()
    now_s = hear(clock, [5.0 + 0.003 * k for k in range(100)], 100.0)
    stamps = [5.3 + 0.003 * k - (0.3 if k % 2 else 0.38) for k in range(100)]
    now_s = hear(clock, stamps, now_s)
    clock.accept_delay(stamps[-1], 0.135)
    age_s = now_s - clock.find_sent_s(stamps[-1], CLOCK_WRAP_S, now_s)
    assert age_s == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("data", [b"", b"\x00", b"\x12\x34\x56\x78\x9a\xbc\xde\xf0", b"\xff" * 8])
@pytest.mark.parametrize("data_id", [0, 0x1031, 0xFFFF])
def test_the_crc_is_that_of_another_library(data: bytes, data_id: int) -> None:
    assert compute_crc8(data, data_id) == Crc8SaeJ1850.calc(data + data_id.to_bytes(2, "little"))
