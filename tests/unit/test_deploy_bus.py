"""The bus: what is sent, how it is protected, and that every wire carries it alike."""

from __future__ import annotations

import itertools
import math
import random
import shutil
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import can
import pytest
from can.io.blf import BLFWriter
from crccheck.crc import Crc8SaeJ1850
from desk import DBC
from desk import wire as udp
from hypothesis import given, settings
from hypothesis import strategies as st

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from deploy.bus import description as described
from deploy.bus.c_header import generate_c_header
from deploy.bus.can_bus import BusReplay, CanBus, CanFrame
from deploy.bus.clock import GatewayClock
from deploy.bus.description import BusDescription
from deploy.bus.protection import ChannelTrust, MessageFault, ProtectedChannel, compute_crc8


@pytest.fixture(scope="module")
def bus(machine: Machine) -> BusDescription:
    return BusDescription(DBC, machine)


@given(st.binary(max_size=8), st.integers(0, 0xFFFF))
def test_the_crc_is_that_of_sae_j1850_over_data_and_data_id(data: bytes, data_id: int) -> None:
    assert compute_crc8(data, data_id) == Crc8SaeJ1850.calc(data + data_id.to_bytes(2, "little"))


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=5, max_size=5), st.integers(0, 100))
def test_commands_arrive_as_they_were_sent_to_half_a_step(
    machine: Machine, u: list[float], counter: int
) -> None:
    bus = BusDescription(DBC, machine)
    names = [f"Command_q{j}" for j in range(1, 6)]
    data = bus.encode("ValveCmd", dict(zip(names, u, strict=True)) | {"CommandMode": 1}, counter)
    values = bus.decode(bus.command, data)
    assert (
        isinstance(values, dict)
        and values["Counter"] == counter % 16
        and values["CommandMode"] == 1
    )
    assert all(
        abs(values[name] - wanted) <= 0.002 + 1e-12 for name, wanted in zip(names, u, strict=True)
    )


def test_every_single_wrong_bit_is_found_in_every_message(bus: BusDescription) -> None:
    for layout in bus.layouts.values():
        data = bus.encode(layout.name, {}, 3)
        for bit in range(8 * len(data)):
            wrong = bytearray(data)
            wrong[bit // 8] ^= 1 << bit % 8
            assert bus.decode(layout, bytes(wrong)) is MessageFault.CRC


def test_a_message_under_the_name_of_another_is_found(bus: BusDescription) -> None:
    for one, other in itertools.permutations(
        [layout for layout in bus.layouts.values() if layout.length == 8], 2
    ):
        assert bus.decode(other, bus.encode(one.name, {}, 1)) is MessageFault.CRC
    assert bus.decode(bus.command, bus.encode("ValveCmd", {}, 1)[:-1]) is MessageFault.LENGTH


PERIOD_S, WRAP_S = 0.02, 2.048
GOOD, CRC, REPEATED = None, MessageFault.CRC, MessageFault.REPEATED
SEQUENCE, LATE, RATE = MessageFault.SEQUENCE, MessageFault.LATE, MessageFault.RATE
INIT, VALID, INVALID = ChannelTrust


class Listener:
    """A channel with a clock: its sender is on time, and stamps each message when it sends it."""

    def __init__(self, period_s: float = PERIOD_S, wrap_s: float = WRAP_S) -> None:
        self.channel, self.now_s, self.period_s = (
            ProtectedChannel(16, period_s, wrap_s),
            100.0,
            period_s,
        )

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


def test_three_repetitions_within_fifty_messages_are_too_many() -> None:
    for apart, trust in ((48, INVALID), (49, VALID)):
        one = Listener()
        one.hear([0, 1, 1, 1, *range(2, 2 + apart - 1)])
        one.hear([apart])
        assert one.trust is trust, "the last of them is the third"


def test_what_became_invalid_needs_twenty_five_good_messages_in_a_row() -> None:
    one = Listener()
    one.hear([0, 1, None, None, *range(2, 26)])
    assert one.trust is INVALID
    one.hear([26])
    assert one.trust is VALID
    one.hear([27, None])
    assert one.trust is VALID, "the errors of before are forgotten"


@pytest.mark.parametrize("offset", range(16))
def test_two_senders_of_one_message_are_found_whatever_their_counters(offset: int) -> None:
    one = Listener()
    one.hear(range(40))
    for number in range(40, 44):
        one.hear([number])
        one.channel.take((number + offset) % 16, one.now_s % WRAP_S, one.now_s)
    assert one.trust is INVALID


@pytest.mark.parametrize("every", [5, 10, 20])
@pytest.mark.parametrize("offset", range(16))
def test_a_second_sender_who_speaks_seldom_is_found_at_the_latest_with_its_third_message(
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


def test_messages_that_waited_while_the_receiver_stood_still_are_no_second_sender() -> None:
    one = Listener()
    one.hear(range(10))
    one.now_s += 0.2
    waited = [one.channel.take(k % 16, one.now_s % WRAP_S, one.now_s) for k in range(10, 21)]
    assert waited == [GOOD] * 11


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


def test_a_constant_delay_is_still_seen_after_half_an_hour() -> None:
    clock = GatewayClock()
    hear_clock(clock, 10.0, 0.0)
    for k in range(18_000):
        now_s = 1010.0 + k / 10
        stamp_s = (now_s - 0.5) % CLOCK_WRAP_S
        clock.learn(stamp_s, CLOCK_WRAP_S, now_s)
    # the crystals could have drifted 180 ms apart meanwhile
    assert now_s - clock.find_sent_s(stamp_s, CLOCK_WRAP_S, now_s) == pytest.approx(0.32, abs=2e-3)


def test_the_shortest_transit_counts_as_none_and_stamps_of_the_future_as_unknown() -> None:
    clock = GatewayClock()
    assert clock.find_sent_s(0.0, 2.048, 5.0) == -math.inf
    clock.learn(7.0, CLOCK_WRAP_S, 10.05)
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
    for stamp_s, newest_s in ((65.5, 65.5), (0.01, 0.01), (65.53, 0.01), (0.02, 0.02)):
        clock.learn(stamp_s, CLOCK_WRAP_S, 10.0)
        assert clock.newest_s == newest_s
    clock.learn(50.0, CLOCK_WRAP_S, 11.0)
    assert clock.find_sent_s(50.0, CLOCK_WRAP_S, 11.0) != 11.0, "one second may be a delay"
    clock.learn(3.0, CLOCK_WRAP_S, 12.1)
    assert clock.newest_s == 3.0 and clock.find_sent_s(3.0, CLOCK_WRAP_S, 12.1) == 12.1


def _virtual(tmp_path: Path) -> CanBus:
    return CanBus(interface="virtual", channel=str(tmp_path), bitrate=None, port=None, hops=None)


def _udp(_: Path) -> CanBus:
    return udp()


WIRES = pytest.mark.parametrize("make", [_virtual, _udp], ids=["virtual", "udp_multicast"])
"""Every wire that this computer has; socketcan needs a kernel with CAN."""


@WIRES
def test_a_wire_carries_frames_to_all_others(
    make: Callable[[Path], CanBus], tmp_path: Path
) -> None:
    wire, frame = make(tmp_path), CanFrame(0x0D001027, b"12345678")
    with wire.open() as one, wire.open() as two, wire.open([0x123]) as three:
        one.send(frame)
        one.send(CanFrame(0x123, b"\x01", extended=False))
        assert two.recv(1.0) == frame
        assert three.recv(1.0) == CanFrame(0x123, b"\x01", extended=False)


@WIRES
def test_a_silent_wire_says_nothing_in_time(make: Callable[[Path], CanBus], tmp_path: Path) -> None:
    with make(tmp_path).open() as one:
        assert one.recv(0.01) is None and one.recv(0.0) is None and one.recv(-1.0) is None


@WIRES
def test_a_closed_wire_is_an_error_and_may_be_closed_again(
    make: Callable[[Path], CanBus], tmp_path: Path
) -> None:
    one = make(tmp_path).open()
    one.close()
    one.close()
    with pytest.raises(LinkError):
        one.send(CanFrame(1, b""))


def test_a_wire_that_is_not_there_is_an_error_that_says_what_to_change() -> None:
    with pytest.raises(LinkError, match=r"bus\.channel=nowhere"):
        CanBus(interface="socketcan", channel="nowhere", bitrate=None, port=None, hops=None).open()


def test_a_replay_says_what_was_recorded_in_its_own_time_and_sends_nothing(tmp_path: Path) -> None:
    path = tmp_path / "frames.blf"
    with BLFWriter(path) as writer:
        for number in range(5):
            message = can.Message(
                timestamp=1000.0 + 0.02 * number,
                arbitration_id=0x100 + number,
                data=[number],
                is_rx=number != 3,
            )
            writer.on_message_received(message)
    with BusReplay(path=str(path), speed=2.0).open() as one:
        one.send(CanFrame(0x200, b""))
        found = [one.recv(0.5) for _ in range(4)]
        assert [frame.frame_id for frame in found if frame] == [
            0x100,
            0x101,
            0x102,
            0x104,
        ]  # what was sent from here is left out
        with pytest.raises(LinkError, match="over"):
            one.recv(0.5)


def test_a_replay_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="nothing"):
        BusReplay(path=str(tmp_path / "nothing.blf"), speed=1.0).open()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Position_q3", "Pos3", "no signal 'Position_q3'"),
        (" SG_ Crc : 56|8@1+ (1,0) [0|255] \"\" GATEWAY\n\nBO_ 2566918439", "\nBO_ 2566918439", "needs Counter, and Crc"),
        ("BO_ 2365592067 JointPos1: 8", "BO_ JointPos1: 8", "no valid DBC"),
    ],
    ids=["signal", "crc", "syntax"],
)  # fmt: skip
def test_a_description_that_does_not_do_is_refused(
    machine: Machine, tmp_path: Path, old: str, new: str, message: str
) -> None:
    text = described.resolve_package_path(DBC).read_text()
    assert old in text
    path = tmp_path / "other.dbc"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message):
        BusDescription(str(path), machine)


def test_another_layout_with_the_same_names_is_as_good(machine: Machine, tmp_path: Path) -> None:
    text = (
        described.resolve_package_path(DBC)
        .read_text()
        .replace("2365591591", "291")
        .replace('"GenMsgCycleTime" BO_ 291 20', '"GenMsgCycleTime" BO_ 291 50')
    )
    path = tmp_path / "other.dbc"
    path.write_text(text)
    bus = BusDescription(str(path), machine)
    assert bus.command.frame_id == 291 and not bus.command.extended and bus.command.period_s == 0.05


def test_a_description_for_other_joints_is_refused(machine: Machine) -> None:
    other = replace(
        machine,
        joints=tuple(replace(joint, name=f"j{n}") for n, joint in enumerate(machine.joints)),
        exclusive=(),
        levers=(),
    )
    with pytest.raises(ConfigError, match="Command_j0"):
        BusDescription(DBC, other)


HEADER_TIMES = (0.15, 0.13, 0.07)


def compile_c(tmp_path: Path, bus: BusDescription, body: str) -> list[str]:
    """Compile a program with the header; return its output as words."""
    (tmp_path / "bus.h").write_text(generate_c_header(bus, *HEADER_TIMES))
    (tmp_path / "main.c").write_text(
        f'#include <stdio.h>\n#include "bus.h"\nint main(void) {{\n{body}\nreturn 0;\n}}'
    )
    flags = ["-Wall", "-Wextra", "-Werror", "-std=c99"]
    subprocess.run(["cc", *flags, "-o", "main", "main.c"], cwd=tmp_path, check=True)
    done = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True)
    return done.stdout.split()


NEEDS_C = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


@NEEDS_C
def test_the_header_computes_the_same_crc_in_c(bus: BusDescription, tmp_path: Path) -> None:
    layout = bus.command
    data = bus.encode("ValveCmd", {"Command_q1": 0.4, "Stamp": 3.0}, 5)
    numbers = ", ".join(map(str, data))
    found = compile_c(
        tmp_path,
        bus,
        f"const uint8_t data[] = {{{numbers}}};\nbrokk_channel unused = {{0}};\n(void)brokk_take; (void)unused;\n"
        'printf("%d", brokk_crc8(data, BROKK_VALVE_CMD_LENGTH, BROKK_VALVE_CMD_CRC_BYTE, BROKK_VALVE_CMD_DATA_ID));',
    )
    assert int(found[0]) == data[layout.crc_byte]


@NEEDS_C
def test_the_header_decides_about_messages_as_the_python_side_does(
    bus: BusDescription, tmp_path: Path
) -> None:
    """Ten thousand messages of good and bad senders: late, repeated, lost, corrupt, in floods, after silence."""
    chance, layout = random.Random(3), bus.command
    wrap_ms = round(1e3 * layout.stamp_wrap_s)
    channel = layout.open_channel()
    rows, expected = [], []
    kinds, now_ms, counter = list(MessageFault), 5000, 0
    for k in range(10_000):
        calm = (k // 200) % 2
        flood = k % 400 > 370
        now_ms += (
            0
            if flood
            else chance.choice([20] * 20 if calm else [20] * 12 + [0, 1, 7, 40, 90, 700, 5000])
        )
        counter += chance.choice([1] * 30 if calm else [1] * 12 + [0, 2, 4, 5, 9])
        late_ms = 0 if calm or chance.random() < 0.9 else chance.choice([30, 200, 600])
        stamp_ms = max(0, now_ms - late_ms) % wrap_ms
        wrong = not calm and chance.random() < 0.05
        rows.append((counter % 16, stamp_ms, now_ms, int(wrong)))
        if wrong:
            fault = channel.refuse(MessageFault.CRC)
        else:
            fault = channel.take(counter % 16, stamp_ms / 1e3, now_ms / 1e3)
        expected.append((kinds.index(fault) + 1 if fault else 0, channel.trust.value))
    assert {kind for kind, _ in expected} >= {0, 1, 2, 3, 5, 6}
    table = ",".join(f"{{{a},{b},{c},{d}}}" for a, b, c, d in rows)
    found = compile_c(
        tmp_path,
        bus,
        f"static const uint32_t rows[][4] = {{{table}}};\n"
        "brokk_channel c = {.modulus = BROKK_VALVE_CMD_COUNTER_MODULUS, .period_ms = BROKK_VALVE_CMD_PERIOD_MS,"
        " .wrap_ms = BROKK_VALVE_CMD_STAMP_WRAP_MS};\n"
        f"for (int k = 0; k < {len(rows)}; k++) {{\n"
        "  uint8_t fault = rows[k][3] ? brokk_count(&c, BROKK_FAULT_CRC)"
        " : brokk_take(&c, (uint8_t)rows[k][0], rows[k][1], rows[k][2]);\n"
        '  printf("%d %d\\n", fault, c.trust);\n}\n(void)brokk_crc8;',
    )
    assert list(zip(map(int, found[::2]), map(int, found[1::2]), strict=True)) == expected


def test_the_header_for_a_gateway_says_what_the_description_says(bus: BusDescription) -> None:
    text = generate_c_header(bus, *HEADER_TIMES)
    for line in (
        "BROKK_VALVE_CMD_ID 0xD001027u",
        "BROKK_VALVE_CMD_DATA_ID 0x1031u",
        "BROKK_VALVE_CMD_STAMP_WRAP_MS 1024u",
        "BROKK_VALVE_CMD_STAMP_STEP_MS 16u",
        "BROKK_JOINT_POS1_PERIOD_MS 10u",
        "BROKK_ROUND_TRIP_MS 150u",
        "BROKK_REMOTE_MS 130u",
        "BROKK_COMMAND_MS 70u",
    ):
        assert f"#define {line}\n" in text


def test_stamps_are_wrapped_and_rounded_down_to_the_resolution_of_each_message(
    bus: BusDescription,
) -> None:
    # 197.743 s, modulo 1.024 s, 2.048 s, 65.536 s and 2.048 s
    wanted = {"ValveCmd": 0.096, "LeverState": 1.128, "JointPos1": 1.135, "ValveFeedback": 1.120}
    for name, stamp_s in wanted.items():
        values = bus.decode(bus.layouts[name], bus.encode(name, {"Stamp": 197.743}, 0))
        assert isinstance(values, dict) and values["Stamp"] == pytest.approx(stamp_s)
