"""Bags of ROS 2 and ROS 1, by rosbags; their messages are read by blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from actuators.recordings.message_log import Gatherer, MessageBlock, MessageLog
from actuators.recordings.ros_layout import RosReader


class BagLog(MessageLog):
    """A bag of ROS 2 (a folder, or its `.db3`) or ROS 1 (`.bag`)."""

    def _open(self, stack: ExitStack) -> Any:
        # Bags from before 2023 have no definitions; messages of joints are the same in all versions.
        default = get_typestore(Stores.ROS2_HUMBLE)
        return stack.enter_context(AnyReader([self.path], default_typestore=default))

    def _list_topics(self) -> list[str]:
        with ExitStack() as stack:
            reader = self._open(stack)
            return [one.topic for one in reader.connections if one.msgtype in reader.typestore.fielddefs]  # fmt: skip

    def _iterate(self, topics: Collection[str]) -> Iterator[MessageBlock]:
        with ExitStack() as stack:
            bag = self._open(stack)
            chosen = [one for one in bag.connections if one.topic in topics]
            types = {(one.topic, one.msgtype) for one in chosen}
            readers = {
                both: RosReader(bag.typestore.fielddefs, both[1], not bag.is2) for both in types
            }
            gatherer = Gatherer()
            for connection, time_ns, data in bag.messages(connections=chosen) if chosen else ():
                both = (connection.topic, connection.msgtype)
                if gatherer.add(both, time_ns, bytes(data)):
                    yield gatherer.take(both, both[0], readers[both])
            for both in gatherer.list_waiting():
                yield gatherer.take(both, both[0], readers[both])
