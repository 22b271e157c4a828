"""The bus description: one DBC that defines each message, its rate and its sender.

Signals are found by their names, whatever message they travel in. A DBC of another gateway takes
the place of the example as long as it names them alike: `Command_<joint>`, `CommandMode`,
`Position_<joint>`, `Valid_<joint>`, `Flow_<joint>`, `FlowSource`, `Lever_<left|right>_<theta|psi>`,
`ButtonRight`, `DeadMan`, `RemoteOn`, `EStop`, `ExclusiveSelected`. Where commands are to be sent,
the gateway says by `DescriptionHash` and `MachineHash` that it goes by this very file and machine.
Optional are `Stamp` (without it
a message is as old as its arrival), `RoundTrip` (without it a delay that is there from the beginning
is not seen), `OilTemperature` and all others, which are recorded. Protected messages have a
`Counter`, a `Crc` of one whole byte and the attribute `E2EDataId`. Cycle times are the DBC's
(`GenMsgCycleTime`): no rate is written down twice.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import cantools
from cantools.database import Database
from cantools.database.can import Message, Signal

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.plain_files import check_plain_file
from brokk_rl.registry import resolve_package_path
from deploy.kernel.protection import MessageFault, ProtectedChannel, compute_crc8

COUNTER, CRC, STAMP = "Counter", "Crc", "Stamp"
"""Signals of the end-to-end protection; for the stamp see `deploy.kernel.clock`."""
ROUNDING = 1e-6
"""Part of a step by which a stamp may miss it through rounding."""
CRC_BITS = 8
MOST_BYTES = 1 << 24
"""Size beyond which a file is no DBC; those of cars have a MB."""
KNOWN = (
    "Command", "Position_", "Valid_", "Flow", "Lever_", "ButtonRight", "DeadMan", "RemoteOn", "EStop",
    "ExclusiveSelected", "RoundTrip", "DescriptionHash", "MachineHash",
)  # fmt: skip
"""Beginnings of the signals that decide about motion; each stands in one message."""
TOGETHER = (
    ("Command_", "CommandMode"), ("Flow_",), ("Lever_", "ButtonRight", "DeadMan", "RemoteOn"), ("EStop", "ExclusiveSelected"),
)  # fmt: skip
"""Beginnings of the signals that mean something at one moment alone: each group is one message."""
SWITCHES = (
    "CommandMode", "FlowSource", "ButtonRight", "DeadMan", "RemoteOn", "EStop", "ExclusiveSelected",
)  # fmt: skip
"""Further signals that every bus has."""
HASH_BYTES = 3
"""Of the hash of description and machine; both fit into one message with counter and CRC."""
PC, GATEWAY, REMOTE = "PC", "GATEWAY", "REMOTE"
"""Nodes of the bus."""
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
        stamp_step_s: Resolution of its stamp; 0: it has none.
        stamp_wrap_s: Time after which its stamp wraps; 0: it has none.
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
    stamp_step_s: float
    stamp_wrap_s: float

    def open_channel(self) -> ProtectedChannel:
        """Return the receiver's side of the message."""
        return ProtectedChannel(self.modulus, self.period_s, self.stamp_wrap_s)


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
                first = self._home.setdefault(signal.name, message.name)
                if first != message.name and signal.name.startswith(KNOWN):
                    raise ConfigError(
                        f"bus: {name}: expected '{signal.name}' in one message, got it in {first} and "
                        f"{message.name}; rename one of them"
                    )
                if not signal.scale:
                    raise ConfigError(
                        f"bus: {name}: expected a factor other than 0 for '{signal.name}', got 0; mend the DBC"
                    )
        required = []
        for kind in ("Command", "Position", "Valid", "Flow"):
            required += [f"{kind}_{joint}" for joint in machine.joint_names]
        required += [f"Lever_{axis}" for axis in LEVER_AXES]
        self._required = required = [*required, *SWITCHES]
        for signal in required:
            if signal not in self._home:
                raise ConfigError(
                    f"bus: {name} has no signal '{signal}', which machine '{machine.name}' needs"
                )
        for group in TOGETHER:
            homes = {self._home[one] for one in required if one.startswith(group)}
            if len(homes) > 1:
                raise ConfigError(
                    f"bus: {name}: expected {', '.join(group)} in one message, got "
                    f"{', '.join(sorted(homes))}; mend the DBC"
                )
        for joint in machine.joint_names:
            self._check_command_range(f"Command_{joint}")
        self.identity = {
            "DescriptionHash": _hash(_list_facts(self._database)),
            "MachineHash": _hash(machine.fingerprint()),
        }
        """Values of the signals by which gateway and PC know that they go by one description."""
        self.command = self.layouts[self.message_of(f"Command_{machine.joint_names[0]}")]
        """The message with the valve commands."""

    def _check_command_range(self, name: str) -> None:
        """Refuse a command that cannot be zero, or stands for another number."""
        signal = self._messages[self._home[name]].get_signal_by_name(name)
        if _clip(0.0, signal) != 0.0:
            raise ConfigError(
                f"bus: {self.name}: expected 0 within the range of '{name}', got "
                f"[{signal.minimum}, {signal.maximum}]; mend the DBC"
            )

    def list_needed(self) -> set[str]:
        """Return the messages without which nothing may be commanded."""
        signals = ["DeadMan", "EStop", "ExclusiveSelected"]
        signals += [one for one in self._required if one.startswith(("Position_", "Flow_"))]
        return {self._home[signal] for signal in signals}

    def check_protection(self) -> None:
        """Check that commands, and what they depend on, are protected end to end.

        Raises:
            ConfigError: a message is not.
        """
        for name in sorted({self.command.name, *self.list_needed()}):
            if self.layouts[name].data_id is None:
                raise ConfigError(
                    f"bus: {self.name}: expected E2EDataId for message {name}, since commands are sent, "
                    "got none; protect it, or only listen (deploy=listen)"
                )

    def has_signal(self, signal: str) -> bool:
        """Return whether any message has `signal`."""
        return signal in self._home

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

    def units(self, message: str) -> dict[str, str]:
        """Return the unit of each signal of `message`, counter and CRC among them; '' for none."""
        return {signal.name: signal.unit or "" for signal in self._messages[message].signals}

    def sent_by(self, node: str) -> list[MessageLayout]:
        """Return the messages of `node`."""
        return [layout for layout in self.layouts.values() if layout.sender == node]

    def encode(self, name: str, values: Mapping[str, float], counter: int) -> bytes:
        """Return the data of message `name`, with counter and CRC; missing signals are 0.

        A value beyond its signal's range becomes the nearest one. `Stamp` is a time in s that is wrapped and rounded down here.
        """
        layout, message = self.layouts[name], self._messages[name]
        data: dict[str, float] = {}
        for signal in message.signals:
            value = values.get(signal.name, 0)
            # Stamps are wrapped below, and lie within their range then.
            data[signal.name] = value if signal.name == STAMP else _clip(value, signal)
        if layout.stamp_step_s:
            steps = math.floor(data[STAMP] / layout.stamp_step_s + ROUNDING)
            num_steps = round(layout.stamp_wrap_s / layout.stamp_step_s)
            data[STAMP] = steps % num_steps * layout.stamp_step_s
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


def _clip(value: float, signal: Signal) -> float:
    low = value if signal.minimum is None else float(signal.minimum)
    high = value if signal.maximum is None else float(signal.maximum)
    return max(low, min(high, value))


def _list_facts(database: Database) -> list[object]:
    """Return all of a DBC that both ends of the bus must share."""
    facts: list[object] = []
    for message in sorted(database.messages, key=lambda one: one.frame_id):
        attributes = message.dbc.attributes if message.dbc else {}
        data_id = attributes.get("E2EDataId")
        facts.append([message.name, message.frame_id, message.length, message.cycle_time])
        facts.append(None if data_id is None else int(data_id.value))
        for signal in sorted(message.signals, key=lambda one: one.name):
            place = [signal.name, signal.start, signal.length, signal.byte_order, signal.is_signed]
            numbers = (signal.scale, signal.offset, signal.minimum, signal.maximum)
            facts.append([*place, *(None if one is None else float(one) for one in numbers)])
    return facts


def _hash(facts: object) -> int:
    """Return 24 bits of the hash of plain data."""
    return int.from_bytes(hashlib.sha256(json.dumps(facts).encode()).digest()[:HASH_BYTES], "big")


def _load_database(name: str) -> Database:
    path = resolve_package_path(name)
    try:
        check_plain_file(path, MOST_BYTES)
        database = cantools.database.load_file(path)
    except OSError as error:
        raise ConfigError(f"dbc={name}: cannot be read ({error.strerror or error})") from error
    except (cantools.database.Error, ValueError) as error:
        raise ConfigError(f"dbc={name}: no valid DBC ({error})") from error
    if not isinstance(database, Database):
        raise ConfigError(f"dbc={name}: no CAN database")
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
        data_id = int(attribute.value)
        crc_byte = crc.start // CRC_BITS
        modulus = 1 << counter.length
    stamp = signals.get(STAMP)
    step_s = 0.0 if stamp is None else float(stamp.scale)
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
        stamp_step_s=step_s,
        stamp_wrap_s=0.0 if stamp is None else step_s * (1 << stamp.length),
    )
