"""Bags of ROS 2 and ROS 1, by rosbags; their messages are read by blocks."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from actuators.recordings.message_log import Gatherer, MessageBlock, MessageLog
from actuators.recordings.ros_layout import RosReader
from brokk_rl.errors import RecordingError


class BagLog(MessageLog):
    """A bag of ROS 2 (a folder, or its `.db3`) or ROS 1 (`.bag`)."""

    def _open(self, stack: ExitStack) -> Any:
        # Bags from before 2023 have no definitions; messages of joints are the same in all versions.
        default = get_typestore(Stores.ROS2_HUMBLE)
        try:
            return stack.enter_context(AnyReader([self.path], default_typestore=default))
        except AnyReaderError as error:
            for file in [*sorted(self.path.glob("*.db3")), self.path]:
                if file.suffix == ".db3" and (place := find_damage(file)):
                    raise RecordingError(f"{file}: damaged {place} ({error})") from error
            raise

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


def find_damage(file: Path) -> str | None:
    """Return up to where the messages of a SQLite bag can be read, `None` where all can be."""
    count, first_ns, last_ns = 0, 0, 0
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)) as bag:
            # The message itself comes last in a row, so that its pages are read too.
            for time_ns, _ in bag.execute("SELECT timestamp, data FROM messages ORDER BY id"):
                first_ns = first_ns if count else time_ns
                last_ns, count = time_ns, count + 1
    except sqlite3.DatabaseError:
        return f"after {count} messages, {(last_ns - first_ns) * 1e-9:.3f} s from the first one"
    return None
