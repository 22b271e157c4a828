"""The bus: what is sent, how it is protected, and that every wire carries it alike."""

from __future__ import annotations

import itertools
import random
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from composed import MACHINE
from desk import DBC
from desk import wire as udp
from hypothesis import given, settings
from hypothesis import strategies as st
from sender import BUS, DBC_TEXT, build_other_bus

from brokk_rl.errors import ConfigError, LinkError
from deploy.bus.c_header import generate_c_header
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.bus.description import BusDescription
from deploy.kernel.protection import MessageFault


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1), min_size=5, max_size=5), st.integers(0, 100))
def test_commands_arrive_as_they_were_sent_to_half_a_step(u: list[float], counter: int) -> None:
    names = [f"Command_q{j}" for j in range(1, 6)]
    data = BUS.encode("ValveCmd", dict(zip(names, u, strict=True)) | {"CommandMode": 1}, counter)
    values = BUS.decode(BUS.command, data)
    assert values["Counter"] == counter % 16
    assert values["CommandMode"] == 1
    for name, wanted in zip(names, u, strict=True):
        assert abs(values[name] - wanted) <= 0.002 + 1e-12


def test_every_single_wrong_bit_is_found_in_every_message() -> None:
    for layout in BUS.layouts.values():
        data = BUS.encode(layout.name, {}, 3)
        for bit in range(8 * len(data)):
            wrong = bytearray(data)
            wrong[bit // 8] ^= 1 << bit % 8
            assert BUS.decode(layout, bytes(wrong)) is MessageFault.CRC


def test_a_message_under_the_name_of_another_is_found() -> None:
    for one, other in itertools.permutations(
        [layout for layout in BUS.layouts.values() if layout.length == 8], 2
    ):
        assert BUS.decode(other, BUS.encode(one.name, {}, 1)) is MessageFault.CRC
    assert BUS.decode(BUS.command, BUS.encode("ValveCmd", {}, 1)[:-1]) is MessageFault.LENGTH


def _virtual(tmp_path: Path) -> CanBus:
    return CanBus(interface="virtual", channel=str(tmp_path), bitrate=None, port=None, hops=None)


def _udp(_: Path) -> CanBus:
    return udp("udp")


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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Position_q3", "Pos3", "no signal 'Position_q3'"),
        (" SG_ Crc : 56|8@1+ (1,0) [0|255] \"\" GATEWAY\n\nBO_ 2566918439", "\nBO_ 2566918439", "needs Counter, and Crc"),
        ("(0.001,0) [0|65.535]", "(0,0) [0|65.535]", "factor other than 0"),
        ("SG_ Position_q5", "SG_ Position_q1", "'Position_q1' in one message, got it in JointPos1 and JointPos3"),
        ("SG_ Flow_q5", "SG_ Spare_q5", "no signal 'Flow_q5'"),
        (" SG_ OilTemperature : 8", " SG_ Flow_q5 : 8", "in one message, got MachineStatus, ValveFeedback"),
        ("BO_ 2365592067 JointPos1: 8", "BO_ JointPos1: 8", "no valid DBC"),
    ],
    ids=["signal", "crc", "factor", "twice", "missing", "apart", "syntax"],
)  # fmt: skip
def test_a_description_that_does_not_do_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in DBC_TEXT
    text = DBC_TEXT.replace(old, new, 1)
    if new.endswith("Flow_q5 : 8"):  # moved, not doubled
        text = text.replace("SG_ Flow_q5 : 36", "SG_ Spare : 36", 1)
    with pytest.raises(ConfigError, match=message):
        build_other_bus(tmp_path, text)


@pytest.mark.parametrize(
    "message", ["ValveCmd", "JointPos2", "LeverState", "ValveFeedback", "MachineStatus"]
)
def test_where_commands_are_sent_all_that_they_depend_on_is_protected(
    tmp_path: Path, message: str
) -> None:
    BUS.check_protection()
    mark = f'BA_ "E2EDataId" BO_ {1 << 31 | BUS.layouts[message].frame_id}'
    text = "\n".join(line for line in DBC_TEXT.splitlines() if not line.startswith(mark))
    with pytest.raises(ConfigError, match=f"E2EDataId for message {message}"):
        build_other_bus(tmp_path, text).check_protection()


def test_another_layout_with_the_same_names_is_as_good(tmp_path: Path) -> None:
    text = DBC_TEXT.replace("2365591591", "291")
    text = text.replace('"GenMsgCycleTime" BO_ 291 20', '"GenMsgCycleTime" BO_ 291 50')
    bus = build_other_bus(tmp_path, text)
    assert bus.command.frame_id == 291 and not bus.command.extended and bus.command.period_s == 0.05


def test_a_description_for_other_joints_is_refused() -> None:
    joints = tuple(replace(joint, name=f"j{n}") for n, joint in enumerate(MACHINE.joints))
    other = replace(MACHINE, joints=joints, exclusive=(), levers=())
    with pytest.raises(ConfigError, match="Command_j0"):
        BusDescription(DBC, other)


HEADER_TIMES = (0.15, 0.13, 0.07)


def compile_c(tmp_path: Path, body: str) -> list[str]:
    """Compile a program with the header; return its output as words."""
    (tmp_path / "bus.h").write_text(generate_c_header(BUS, *HEADER_TIMES))
    text = f'#include <stdio.h>\n#include "bus.h"\nint main(void) {{\n{body}\nreturn 0;\n}}'
    (tmp_path / "main.c").write_text(text)
    flags = ["-Wall", "-Wextra", "-Werror", "-std=c99"]
    subprocess.run(["cc", *flags, "-o", "main", "main.c"], cwd=tmp_path, check=True)
    done = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True)
    return done.stdout.split()


NEEDS_C = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


@NEEDS_C
def test_the_header_computes_the_same_crc_in_c(tmp_path: Path) -> None:
    layout = BUS.command
    data = BUS.encode("ValveCmd", {"Command_q1": 0.4, "Stamp": 3.0}, 5)
    numbers = ", ".join(map(str, data))
    found = compile_c(
        tmp_path,
        f"const uint8_t data[] = {{{numbers}}};\nbrokk_channel unused = {{0}};\n(void)brokk_take; (void)unused;\n"
        'printf("%d", brokk_crc8(data, BROKK_VALVE_CMD_LENGTH, BROKK_VALVE_CMD_CRC_BYTE, BROKK_VALVE_CMD_DATA_ID));',
    )
    assert int(found[0]) == data[layout.crc_byte]


@NEEDS_C
def test_the_header_decides_about_messages_as_the_python_side_does(tmp_path: Path) -> None:
    """Ten thousand messages of good and bad senders: late, repeated, lost, corrupt, in floods, after silence."""
    chance, layout = random.Random(3), BUS.command
    wrap_ms = round(1e3 * layout.stamp_wrap_s)
    channel = layout.open_channel()
    rows, expected = [], []
    kinds, now_ms, counter = list(MessageFault), 5000, 0
    for k in range(10_000):
        calm = (k // 200) % 2
        flood = k % 400 > 370
        steps_ms = [20] * 20 if calm else [20] * 12 + [0, 1, 7, 40, 90, 700, 5000]
        now_ms += 0 if flood else chance.choice(steps_ms)
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
        f"static const uint32_t rows[][4] = {{{table}}};\n"
        "brokk_channel c = {.modulus = BROKK_VALVE_CMD_COUNTER_MODULUS, .period_ms = BROKK_VALVE_CMD_PERIOD_MS,"
        " .wrap_ms = BROKK_VALVE_CMD_STAMP_WRAP_MS};\n"
        f"for (int k = 0; k < {len(rows)}; k++) {{\n"
        "  uint8_t fault = rows[k][3] ? brokk_count(&c, BROKK_FAULT_CRC)"
        " : brokk_take(&c, (uint8_t)rows[k][0], rows[k][1], rows[k][2]);\n"
        '  printf("%d %d\\n", fault, c.trust);\n}\n(void)brokk_crc8;',
    )
    assert list(zip(map(int, found[::2]), map(int, found[1::2]), strict=True)) == expected


def test_the_header_for_a_gateway_says_what_the_description_says() -> None:
    text = generate_c_header(BUS, *HEADER_TIMES)
    # Without them no gateway could say that it goes by this description, and nothing would ever move.
    for line in (
        f"BROKK_DESCRIPTION_HASH 0x{BUS.identity['DescriptionHash']:06X}u",
        f"BROKK_MACHINE_HASH 0x{BUS.identity['MachineHash']:06X}u",
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


def test_stamps_are_wrapped_and_rounded_down_to_the_resolution_of_each_message() -> None:
    # 197.743 s, modulo 1.024 s, 2.048 s, 65.536 s and 2.048 s
    wanted = {"ValveCmd": 0.096, "LeverState": 1.128, "JointPos1": 1.135, "ValveFeedback": 1.120}
    for name, stamp_s in wanted.items():
        values = BUS.decode(BUS.layouts[name], BUS.encode(name, {"Stamp": 197.743}, 0))
        assert isinstance(values, dict) and values["Stamp"] == pytest.approx(stamp_s)
