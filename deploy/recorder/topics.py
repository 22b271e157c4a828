"""Topics of a capture and their schemas: protobuf messages that are described here, field by field.

Any reader of MCAP can decode them, since the schema stands in the file: Foxglove, Rerun, and
`mcap-protobuf-support`. Messages of the bus take their fields from the bus description. Units and
meanings stand in the schema as comments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from deploy.bus.description import BusDescription, MessageLayout
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.kernel.protection import MessageFault
from deploy.runtime.operator_state import AdviceStatus

FieldKind = Literal["number", "integer", "flag", "text"]
PACKAGE = "brokk"
PROTO = descriptor_pb2.FieldDescriptorProto
TYPES = {
    "number": PROTO.TYPE_DOUBLE,
    "integer": PROTO.TYPE_INT64,
    "flag": PROTO.TYPE_BOOL,
    "text": PROTO.TYPE_STRING,
}
TIME = "t_s"
PICTURE, LENS, CLOUD, CAMERA_POSE = "camera", "camera/calibration", "camera/points", "tf/camera"
"""Topics of the camera, written by `camera_topics`."""


@dataclass(frozen=True)
class TopicField:
    """A field of a topic's messages.

    Attributes:
        name: Its name.
        kind: Type of its values; ignored where it has parts.
        meaning: Meaning and unit.
        many: Whether it is a list.
        optional: Whether it may be missing.
        parts: Fields of each entry, where the values are records of their own.
    """

    name: str
    kind: FieldKind
    meaning: str
    many: bool = False
    optional: bool = False
    parts: tuple[TopicField, ...] = ()


def _list_values(choices: type[Enum]) -> str:
    return "one of: " + "; ".join(str(one.value) for one in choices)


def _list_names(choices: type[Enum]) -> str:
    return "one of: " + ", ".join(one.name for one in choices)


HOLE = (
    TopicField("name", "integer", "number of the borehole; it keeps it"),
    TopicField("center_in_base_m", "number", "centre of the rim, base frame, m", many=True),
    TopicField("axis_in_base", "number", "unit vector out of the hole, base frame", many=True),
    TopicField("radius_m", "number", "radius, m"),
    TopicField("std_m", "number", "standard deviation of the centre, m"),
    TopicField("score", "number", "probability that it is one, 0 to 1"),
    TopicField("seen_t_s", "number", "when it was seen last, s of the monotonic clock"),
)
TOPICS: dict[str, tuple[TopicField, ...]] = {
    "advice": (
        TopicField("reason", "text", f"why there is an advice or none; {_list_values(AdviceStatus)}"),
        TopicField("u", "number", "advised commands in machine order, -1 to 1", many=True),
        TopicField("lever_rad", "number", "shown levers: left theta, psi, right theta, psi; rad", many=True),
        TopicField("button_right", "flag", "whether the right button is to be held"),
        TopicField("target_in_base_m", "number", "centre of the target's rim, base frame, m", many=True),
        TopicField("infer_s", "number", "time that the network took, s"),
        TopicField("observation", "number", "vector that the network got; empty without advice", many=True),
    ),
    "guard": (
        TopicField("state", "text", f"state of the guard; {_list_names(GuardState)}"),
        TopicField("trip", "text", f"why nothing passes now; {_list_values(GuardTrip)}"),
        TopicField("cause", "text", f"why it latched last; {_list_values(GuardTrip)}"),
        TopicField("joint", "text", "joint that does not move as commanded", optional=True),
    ),
    "fault": (
        TopicField("frame_id", "integer", "CAN identifier of the frame that was refused"),
        TopicField("fault", "text", f"why; {_list_values(MessageFault)}"),
    ),
    "refused": (
        TopicField("message", "text", "name of the message that does not decode"),
        TopicField("fault", "text", f"why; {_list_values(MessageFault)}"),
        TopicField("data", "text", "its bytes, hexadecimal"),
    ),
    "bus": (TopicField("down", "text", "why the bus went down"),),
    "holes": (TopicField("holes", "text", "boreholes known now", many=True, parts=HOLE),),
    "view": (
        TopicField("name", "text", "position of the camera's mount"),
        TopicField("is_moving", "flag", "whether the camera is on its way there"),
        TopicField("travel_s", "number", "time until it stands there, s"),
        TopicField("seen_s", "number", "time for which the hole will be seen from there, s"),
        TopicField("seen_before_s", "number", "the same had the camera stayed, s"),
        TopicField("horizon_s", "number", "time ahead that was looked at, s"),
        TopicField("std_m", "number", "expected standard deviation of the hole after that time, m"),
        TopicField("std_before_m", "number", "the same had the camera stayed, m"),
    ),
    "wish": (
        TopicField("kind", "text", "request of the operator: start, stop, record, target, point"),
        TopicField("value", "text", "on or off, name of the target, or point of the picture"),
        TopicField("taken", "flag", "whether the loop had room for it"),
        TopicField("asked_s", "number", "when, s of the monotonic clock", optional=True),
        TopicField("center_in_base_m", "number", "borehole that was chosen, base frame, m", many=True),
        TopicField("std_m", "number", "its standard deviation, m", optional=True),
        TopicField("seen_s", "number", "when it was measured, s of the monotonic clock", optional=True),
    ),
}  # fmt: skip
"""Fields by topic, beside those of the bus and of Foxglove's own schemas (`camera_topics`)."""


def describe_bus_fields(
    description: BusDescription, layout: MessageLayout
) -> tuple[TopicField, ...]:
    """Return the fields of a message of the bus: its signals, and whether we sent it."""
    units = description.units(layout.name)
    found = [TopicField(name, "number", unit or "without unit") for name, unit in units.items()]
    return (*found, TopicField("sent", "flag", "whether this computer sent it"))


class TopicSchema:
    """Schema of a topic, and the coding of its messages.

    Args:
        topic: Its name.
        fields: Fields of its messages, beside the time.

    Attributes:
        name: Name of the schema.
        data: The schema as a serialised `FileDescriptorSet`.
    """

    def __init__(self, topic: str, fields: Sequence[TopicField]) -> None:
        title = topic[:1].upper() + topic[1:]
        self.name = f"{PACKAGE}.{title}"
        file = descriptor_pb2.FileDescriptorProto(
            name=f"{PACKAGE}/{topic}.proto", package=PACKAGE, syntax="proto3"
        )
        time = TopicField(TIME, "number", "time, s of the monotonic clock")
        _describe_message(file, file.message_type.add(name=title), (4, 0), (time, *fields))
        files = descriptor_pb2.FileDescriptorSet(file=[file])
        self.data = files.SerializeToString()
        pool = descriptor_pool.DescriptorPool()
        pool.Add(file)
        self._build = message_factory.GetMessageClass(pool.FindMessageTypeByName(self.name))

    def encode(self, values: dict[str, Any]) -> bytes:
        """Return a message.

        Raises:
            ValueError: the schema has no such field.
        """
        return self._build(**values).SerializeToString()


def decode_message(message: Message) -> dict[str, Any]:
    """Return a message as plain data; optional fields that are missing are left out."""
    found = {}
    for field in message.DESCRIPTOR.fields:
        if field.has_presence and not message.HasField(field.name):
            continue
        value = getattr(message, field.name)
        if field.message_type is not None:
            value = [decode_message(one) for one in value]
        elif field.is_repeated:
            value = list(value)
        found[field.name] = value
    return found


def _describe_message(
    file: descriptor_pb2.FileDescriptorProto,
    message: descriptor_pb2.DescriptorProto,
    path: tuple[int, ...],
    fields: Sequence[TopicField],
) -> None:
    """Add fields to a message; comments stand beside it, found by the path of field numbers."""
    for index, field in enumerate(fields):
        entry = message.field.add(name=field.name, number=index + 1, type=TYPES[field.kind])
        entry.label = PROTO.LABEL_REPEATED if field.many else PROTO.LABEL_OPTIONAL
        if field.parts:
            title = f"{field.name[:1].upper()}{field.name[1:]}Entry"
            entry.type, entry.type_name = PROTO.TYPE_MESSAGE, title
            inner = (*path, 3, len(message.nested_type))
            _describe_message(file, message.nested_type.add(name=title), inner, field.parts)
        if field.optional:
            # proto3 keeps the presence of a field in a group of its own.
            entry.proto3_optional, entry.oneof_index = True, len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{field.name}")
        place = file.source_code_info.location.add(leading_comments=f" {field.meaning}\n")
        place.path.extend((*path, 2, index))
        place.span.extend((0, 0, 0))
