"""A bad network link between two network namespaces of this computer, as `tc netem` makes one.

For kernels without netem: each namespace gets a TUN device, and this process carries the IP packets
between them with delay, jitter, loss and a rate. TCP and UDP of the kernel meet what they would
meet on a real link. It needs root and `ip`.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

SITE, DESK = "brokk_site", "brokk_desk"
"""Namespaces of the machine's computer and of the remote operator's."""
ADDRESSES = {SITE: "10.77.0.1", DESK: "10.77.0.2"}
CLONE_NEWNET, TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x40000000, 0x400454CA, 0x0001, 0x1000
QUEUE_S = 0.2
"""Longest wait for the line before a packet is dropped; a buffer of 200 ms is an ordinary one."""
BYTES_MAX = 2048


@dataclass
class LinkQuality:
    """Quality of a link, the same both ways; it may be changed while packets pass.

    Attributes:
        rate_mbit_s: Bits a second on the line.
        delay_s: One way, without waiting for the line.
        jitter_s: Each packet's delay is drawn evenly from `delay_s` ± this.
        loss: Share of packets that vanish.
        in_order: Whether a packet waits for the one before, as in a radio's link layer. Otherwise
            late ones are overtaken, as with netem.
    """

    rate_mbit_s: float
    delay_s: float
    jitter_s: float
    loss: float
    in_order: bool


class EmulatedLink:
    """Carries packets between both devices; see `open_link`.

    Args:
        devices: File descriptors of the two TUN devices.
        quality: Of the link; assign another one to change it.

    Attributes:
        counts: Packets by fate: carried, lost by chance, dropped because the queue was full.
    """

    def __init__(self, devices: tuple[int, int], quality: LinkQuality) -> None:
        self.quality, self.counts = quality, {"carried": 0, "lost": 0, "queue_full": 0}
        self._devices, self._ending, self._random = devices, False, random.Random(0)
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Carry nothing more."""
        self._ending = True
        self._thread.join()

    def _carry(self) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        free_s, last_s, number = [0.0, 0.0], [0.0, 0.0], 0
        while not self._ending:
            patience_s = 0.05 if not waiting else max(0.0, waiting[0][0] - time.monotonic())
            readable, _, _ = select.select(self._devices, [], [], min(0.05, patience_s))
            now_s = time.monotonic()
            for device in readable:
                side = self._devices.index(device)
                packet, quality = os.read(device, BYTES_MAX), self.quality
                if free_s[side] - now_s > QUEUE_S:
                    self.counts["queue_full"] += 1
                    continue
                free_s[side] = max(now_s, free_s[side]) + 8e-6 * len(packet) / quality.rate_mbit_s
                if self._random.random() < quality.loss:
                    self.counts["lost"] += 1
                    continue
                spread_s = self._random.uniform(-quality.jitter_s, quality.jitter_s)
                due_s = free_s[side] + quality.delay_s + spread_s
                if quality.in_order:
                    due_s = last_s[side] = max(due_s, last_s[side])
                number += 1
                heapq.heappush(waiting, (due_s, number, 1 - side, packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, side, packet = heapq.heappop(waiting)
                os.write(self._devices[side], packet)
                self.counts["carried"] += 1


@contextlib.contextmanager
def open_link(quality: LinkQuality) -> Iterator[EmulatedLink]:
    """Make both namespaces with a link between them; remove them in the end."""
    devices = []
    try:
        for name, other in ((SITE, DESK), (DESK, SITE)):
            subprocess.run(["ip", "netns", "add", name], check=True)
            devices.append(_open_device(name))
            for words in (
                "link set lo up",
                f"address add {ADDRESSES[name]} peer {ADDRESSES[other]} dev line",
                "link set dev line up mtu 1500",
            ):
                subprocess.run(["ip", "-n", name, *words.split()], check=True)
        link = EmulatedLink((devices[0], devices[1]), quality)
        yield link
        link.end()
    finally:
        for device in devices:
            os.close(device)
        for name in ADDRESSES:
            subprocess.run(["ip", "netns", "delete", name], check=False)


def _open_device(namespace: str) -> int:
    """Return a TUN device of another namespace; a thread of its own goes there for it."""
    found: list[int] = []

    def enter_and_open() -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        with open(f"/var/run/netns/{namespace}", "rb") as file:
            if libc.setns(file.fileno(), CLONE_NEWNET) != 0:
                return
        device = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", b"line", IFF_TUN | IFF_NO_PI))
        found.append(device)

    thread = threading.Thread(target=enter_and_open)
    thread.start()
    thread.join()
    if not found:
        raise PermissionError(f"cannot enter the network namespace {namespace}: root is needed")
    return found[0]
