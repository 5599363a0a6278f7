"""Real captures as sources of frames: depth pictures, arrays, height maps, clouds, bags,
recordings of cameras."""

from detectors.recordings.opening import LEGAL_FORMATS, open_capture
from detectors.recordings.recording import Recording

__all__ = ["LEGAL_FORMATS", "Recording", "open_capture"]
