"""Checks of recordings before any physics; `actuators.recordings.recording_checks` has them for all modes."""

from actuators.recordings.recording_checks import (
    TEXTS,
    RecordingRemark,
    examine_recordings,
    name_recording,
)

__all__ = ["TEXTS", "RecordingRemark", "examine_recordings", "name_recording"]
