"""The errors that meslam_core raises on purpose; every one names its input and a remedy."""

from __future__ import annotations


class MeslamError(Exception):
    """Base of all errors a user can cause and mend."""


class ConfigError(MeslamError):
    """A setting that does not exist, has the wrong type or lies outside its range."""


class FrameError(MeslamError):
    """An image pair that cannot be used: sizes, encodings or intrinsics do not fit."""


class RecordingError(MeslamError):
    """A recording that cannot be read, or lacks what SLAM needs."""


class MapError(MeslamError):
    """A map store or an encoded region that is missing, damaged or of another version."""


class OutputError(MeslamError):
    """A place that results cannot be written to."""


class EvaluationError(MeslamError):
    """Trajectories or surfaces that cannot be compared."""


class TrackingLostError(MeslamError):
    """Tracking was lost and never recovered."""
