"""The H.264 encoder of one camera for one page: small pictures now rather than fine ones later.

aiortc's own encoder takes six times as long, and starts again with a large key picture at each
change of the link's estimate by a tenth.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import av  # pyright: ignore[reportMissingImports]
from aiortc.codecs.h264 import H264Encoder  # pyright: ignore[reportMissingImports]
from av.video.frame import PictureType  # pyright: ignore[reportMissingImports]

CLOCK_HZ = 90_000
"""Rate of the clock of video in RTP (RFC 6184)."""
USUAL_HZ = 15
"""Pictures a second until their times say otherwise (paper: video at 15 Hz)."""
PRESET = "veryfast"
"""Preset of x264: 2.7 ms for a picture of 640 x 360 on one core, where the default takes 15.6 ms."""
BURST_S = 0.15
"""Longest time that one picture takes on a link of just the wanted rate: it bounds key pictures."""
LESS, MORE, MORE_AFTER_S = 0.85, 1.3, 3.0
"""Ratios of the wanted to the present rate from which the encoder starts again, and the time before
it asks for more. Each start costs a key picture: a link that gets worse cannot wait, others can."""


class LinkEncoder(H264Encoder):
    """Encodes at the rate that the receiver's estimate of the link allows.

    Args:
        min_bitrate: Bits a second, whatever the estimate.
        max_bitrate: The same, upwards.
        num_cameras: Cameras that share the link.
    """

    def __init__(self, min_bitrate: int, max_bitrate: int, num_cameras: int) -> None:
        super().__init__()
        self.codec: Any = None
        self._least, self._most, self._num_cameras = min_bitrate, max_bitrate, num_cameras
        # In the middle, by ratio: the link is not known yet.
        self._wanted = self._present = round(math.sqrt(min_bitrate * max_bitrate))
        self._begun_s = 0.0

    @property
    def target_bitrate(self) -> int:
        """Bits a second of this camera; set it to the estimate of the whole link."""
        return self._wanted

    @target_bitrate.setter
    def target_bitrate(self, bitrate: int) -> None:
        self._wanted = max(self._least, min(bitrate // self._num_cameras, self._most))

    def _encode_frame(self, frame: Any, force_keyframe: bool) -> Iterator[bytes]:
        if self.codec is None or self._should_restart(frame):
            self.codec = self._open(frame)
        # Without NONE the kind that the frame had elsewhere would be kept.
        frame.pict_type = PictureType.I if force_keyframe else PictureType.NONE
        encoded = b"".join(bytes(packet) for packet in self.codec.encode(frame))
        if encoded:
            yield from self._split_bitstream(encoded)

    def _should_restart(self, frame: Any) -> bool:
        if (frame.width, frame.height) != (self.codec.width, self.codec.height):
            return True
        ratio, age_s = self._wanted / self._present, time.monotonic() - self._begun_s
        # At either end of the range the last step may be a small one.
        at_end = self._wanted in (self._least, self._most) and ratio != 1.0
        return ratio < LESS or ((ratio > MORE or at_end) and age_s > MORE_AFTER_S)

    def _open(self, frame: Any) -> Any:
        self._present, self._begun_s = self._wanted, time.monotonic()
        codec = av.CodecContext.create("libx264", "w")
        codec.width, codec.height, codec.pix_fmt = frame.width, frame.height, "yuv420p"
        codec.time_base, codec.framerate = Fraction(1, CLOCK_HZ), Fraction(USUAL_HZ)
        codec.bit_rate = self._present
        # The loop needs the other cores more.
        codec.thread_count = 1
        codec.profile = "Baseline"
        # Key pictures come when the receiver asks for one, not by the clock.
        rate = f"vbv-maxrate={self._present // 1000}"
        rate += f":vbv-bufsize={math.ceil(BURST_S * self._present / 1000)}"
        codec.options = {
            "preset": PRESET,
            "tune": "zerolatency",
            "level": "31",
            "forced-idr": "1",
            "x264-params": f"{rate}:keyint=infinite:scenecut=0",
        }
        return codec
