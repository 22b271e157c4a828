"""The bus description: one DBC that defines each message, its rate and its sender.

Signals are found by their names, whatever message they travel in. A DBC of another gateway takes
the place of the example as long as it names them alike: `Command_<joint>`, `CommandMode`,
`Position_<joint>`, `Valid_<joint>`, `Flow_<joint>`, `FlowSource`, `Lever_<left|right>_<theta|psi>`,
`ButtonRight`, `DeadMan`, `RemoteOn`, `EStop`, `ExclusiveSelected`. Optional are `Stamp`,
`OilTemperature` and all others, which are recorded. Protected messages have a `Counter`, a `Crc` of
one whole byte and the attribute `E2EDataId`. Cycle times are the DBC's (`GenMsgCycleTime`): no rate
is written down twice.

`generate_c_header` writes a header for the gateway's firmware. cantools generates the C source that
packs and unpacks (`cantools generate_c_source <dbc>`); the header adds the end-to-end protection
and the times, so that gateway and PC go by one file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import cantools
from cantools.database import Database
from cantools.database.can import Message

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from deploy.bus.protection import FINAL, MAX_STEP, START, TABLE, MessageFault, compute_crc8

COUNTER, CRC = "Counter", "Crc"
"""Signals of the end-to-end protection."""
CRC_BITS = 8
PC, GATEWAY, REMOTE = "PC", "GATEWAY", "REMOTE"
"""Nodes of the bus."""
PREFIX = "BROKK"
"""Of all names in the C header."""
ROW_BYTES = 16
"""Of the CRC table in a row of the C header."""
LEVER_AXES = ("left_theta", "left_psi", "right_theta", "right_psi")


@dataclass(frozen=True)
class MessageLayout:
    """One message of the bus.

    Attributes:
        name: Its name.
        frame_id: Its identifier.
        extended: Whether that has 29 bits.
        length: Number of data bytes.
        period_s: Nominal time between two of them; 0: not sent by the clock.
        sender: The node that sends it.
        data_id: Goes into the CRC; `None`: not protected.
        crc_byte: Where the CRC stands.
        modulus: The counter counts 0 … modulus - 1.
    """

    name: str
    frame_id: int
    extended: bool
    length: int
    period_s: float
    sender: str
    data_id: int | None
    crc_byte: int
    modulus: int


class BusDescription:
    """A DBC, checked against a machine.

    Args:
        name: Path of the DBC, or `package:path` for one that ships with a package.
        machine: Gives the joints.

    Attributes:
        layouts: Messages by name.
        by_id: The same by identifier.

    Raises:
        ConfigError: there is no such file, it is no DBC, or it lacks a signal.
    """

    def __init__(self, name: str, machine: Machine) -> None:
        self.name = name
        self._database = _load_database(name)
        self._messages: dict[str, Message] = {}
        self.layouts: dict[str, MessageLayout] = {}
        self.by_id: dict[int, MessageLayout] = {}
        self._home: dict[str, str] = {}
        for message in self._database.messages:
            layout = _build_layout(message, name)
            self._messages[message.name] = message
            self.layouts[message.name] = layout
            self.by_id[layout.frame_id] = layout
            for signal in message.signals:
                self._home[signal.name] = message.name
        required = []
        for kind in ("Command", "Position", "Valid", "Flow"):
            required += [f"{kind}_{joint}" for joint in machine.joint_names]
        required += [f"Lever_{axis}" for axis in LEVER_AXES]
        required += [
            "CommandMode",
            "FlowSource",
            "ButtonRight",
            "DeadMan",
            "RemoteOn",
            "EStop",
            "ExclusiveSelected",
        ]
        for signal in required:
            if signal not in self._home:
                raise ConfigError(
                    f"bus: {name} has no signal '{signal}', which machine '{machine.name}' needs"
                )
        self.command = self.layouts[self.message_of(f"Command_{machine.joint_names[0]}")]
        """The message with the valve commands."""

    def message_of(self, signal: str) -> str:
        """Return the message in which `signal` travels.

        Raises:
            ConfigError: there is none.
        """
        if signal not in self._home:
            raise ConfigError(
                f"bus: {self.name} has no signal '{signal}'; {list_choices(signal, self._home)}"
            )
        return self._home[signal]

    def signals(self, message: str) -> list[str]:
        """Return the names of the signals of `message`, without counter and CRC."""
        names = []
        for signal in self._messages[message].signals:
            if signal.name not in (COUNTER, CRC):
                names.append(signal.name)
        return names

    def unit(self, message: str, signal: str) -> str:
        """Return the unit of a signal, '' for none."""
        return self._messages[message].get_signal_by_name(signal).unit or ""

    def sent_by(self, node: str) -> list[MessageLayout]:
        """Return the messages of `node`."""
        return [layout for layout in self.layouts.values() if layout.sender == node]

    def encode(self, name: str, values: Mapping[str, float], counter: int) -> bytes:
        """Return the data of message `name`, with counter and CRC; missing signals are 0."""
        layout, message = self.layouts[name], self._messages[name]
        data = {signal.name: values.get(signal.name, 0) for signal in message.signals}
        if layout.data_id is None:
            return message.encode(data)
        encoded = bytearray(message.encode(data | {COUNTER: counter % layout.modulus, CRC: 0}))
        encoded[layout.crc_byte] = compute_crc8(encoded, layout.data_id)
        return bytes(encoded)

    def decode(self, layout: MessageLayout, data: bytes) -> dict[str, float] | MessageFault:
        """Return the signals of a message, its counter among them, or its fault."""
        if len(data) != layout.length:
            return MessageFault.LENGTH
        if layout.data_id is not None:
            plain = bytearray(data)
            plain[layout.crc_byte] = 0
            if compute_crc8(plain, layout.data_id) != data[layout.crc_byte]:
                return MessageFault.CRC
        decoded = self._messages[layout.name].decode(data, decode_choices=False)
        assert isinstance(decoded, dict)
        return {name: float(value) for name, value in decoded.items()}  # type: ignore[arg-type]


def _load_database(name: str) -> Database:
    path = resolve_package_path(name)
    try:
        database = cantools.database.load_file(path)
    except OSError as error:
        raise ConfigError(f"bus.dbc={name}: cannot be read ({error.strerror or error})") from error
    except (cantools.database.Error, ValueError) as error:
        raise ConfigError(f"bus.dbc={name}: no valid DBC ({error})") from error
    if not isinstance(database, Database):
        raise ConfigError(f"bus.dbc={name}: no CAN database")
    return database


def _build_layout(message: Message, dbc: str) -> MessageLayout:
    signals = {signal.name: signal for signal in message.signals}
    attribute = message.dbc.attributes.get("E2EDataId") if message.dbc else None
    data_id, crc_byte, modulus = None, 0, 1
    if attribute is not None:
        counter, crc = signals.get(COUNTER), signals.get(CRC)
        if (
            counter is None
            or crc is None
            or crc.length != CRC_BITS
            or crc.start % CRC_BITS
            or crc.byte_order != "little_endian"
        ):
            raise ConfigError(
                f"bus: message {message.name} of {dbc} has E2EDataId; it needs {COUNTER}, and {CRC} of one whole byte"
            )
        data_id, crc_byte, modulus = (
            int(attribute.value),
            crc.start // CRC_BITS,
            1 << counter.length,
        )
    return MessageLayout(
        name=message.name,
        frame_id=message.frame_id,
        extended=message.is_extended_frame,
        length=message.length,
        period_s=(message.cycle_time or 0) / 1e3,
        sender=message.senders[0] if message.senders else "",
        data_id=data_id,
        crc_byte=crc_byte,
        modulus=modulus,
    )


def generate_c_header(description: BusDescription) -> str:
    """Return the text of the header."""
    lines = [
        f"/* Made from {description.name}: do not edit. Packing and unpacking: cantools generate_c_source. */",
        f"#ifndef {PREFIX}_BUS_H",
        f"#define {PREFIX}_BUS_H",
        "#include <stdint.h>",
        "",
        f"#define {PREFIX}_COUNTER_MAX_STEP {MAX_STEP}u",
    ]
    for layout in description.layouts.values():
        name = f"{PREFIX}_{_convert_to_upper_snake(layout.name)}"
        lines += [
            "",
            f"#define {name}_ID 0x{layout.frame_id:X}u",
            f"#define {name}_EXTENDED {int(layout.extended)}",
            f"#define {name}_LENGTH {layout.length}u",
            f"#define {name}_PERIOD_MS {round(1e3 * layout.period_s)}u",
        ]
        if layout.data_id is not None:
            lines += [
                f"#define {name}_DATA_ID 0x{layout.data_id:X}u",
                f"#define {name}_CRC_BYTE {layout.crc_byte}u",
                f"#define {name}_COUNTER_MODULUS {layout.modulus}u",
            ]
    rows = []
    for first in range(0, len(TABLE), ROW_BYTES):
        row = ", ".join(f"0x{value:02X}" for value in TABLE[first : first + ROW_BYTES])
        rows.append(f"  {row},")
    rows[-1] = rows[-1].removesuffix(",")
    lines += [
        "",
        "/* CRC-8 SAE J1850 over the data, its CRC byte taken as zero, then the data id, low byte first. */",
        "static const uint8_t brokk_crc8_table[256] = {",
        *rows,
        "};",
        "static inline uint8_t brokk_crc8(const uint8_t *data, uint8_t length, uint8_t crc_byte, uint16_t data_id) {",
        f"  uint8_t crc = 0x{START:02X}u, i;",
        "  for (i = 0; i < length; i++) crc = brokk_crc8_table[crc ^ (i == crc_byte ? 0u : data[i])];",
        "  crc = brokk_crc8_table[crc ^ (data_id & 0xFFu)];",
        f"  return (uint8_t)(brokk_crc8_table[crc ^ (data_id >> 8)] ^ 0x{FINAL:02X}u);",
        "}",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def _convert_to_upper_snake(name: str) -> str:
    """Return `ValveCmd` as `VALVE_CMD`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).upper()
