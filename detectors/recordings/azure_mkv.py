"""Azure Kinect recordings (.mkv): depth, infrared and colour by PyAV, the lens from the attached calibration.

What k4arecorder writes: tracks titled COLOR, DEPTH and IR (16-bit big-endian grey, depth in millimetres, 0 = none),
tags K4A_*, and the factory calibration as an attachment. The colour is brought to the depth pixels by projecting each
depth point into the colour camera; a point that the colour camera cannot see takes the colour of what hides it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.recordings.azure_calibration import (
    ColourCamera,
    colour_camera,
    depth_lens,
    depth_mode_of_size,
    parse_calibration,
)
from detectors.recordings.distances import UNITS_M, frame_from_depth
from detectors.recordings.intrinsics import lens_of_size, no_lens, read_lens
from detectors.recordings.recording import Recording
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import transform_points
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import FRAME_PIXELS, refuse_pixels

TITLES = ("DEPTH", "IR", "COLOR")
LEGAL_MKV = "a recording of k4arecorder with its DEPTH track"
SEGMENT_ID = bytes.fromhex("18538067")
WAITING = 4
"""Captures held while their other pictures may still come; the recorder interleaves its tracks within one frame."""


@dataclass(frozen=True)
class MkvReader:
    """Streams the captures of one recording. ``lens`` of the depth pixels; ``colour`` None leaves the colour out."""

    path: Path
    scale_m: float
    lens: Lens
    colour: ColourCamera | None

    @cached_property
    def slopes(self) -> np.ndarray:
        """(h, w, 2) x/z and y/z of the depth pixels."""
        return self.lens.region_slopes(self.lens.whole)

    def frames(self) -> Iterator[Frame]:
        """One frame a depth picture. Raises UserError where the file is truncated or cannot be decoded."""
        for number, pictures in enumerate(_captures(self.path, with_colour=self.colour is not None)):
            depth = pictures["DEPTH"]
            name = f"{self.path.name} frame {number}"
            amplitude = pictures.get("IR")
            frame = frame_from_depth(
                name,
                depth,
                self.scale_m,
                amplitude=amplitude.astype(np.float32) if amplitude is not None else None,
            )
            if self.colour is not None and "COLOR" in pictures:
                rgb = colour_on_depth(frame.z_m, self.slopes, self.colour, pictures["COLOR"])
                frame = Frame(frame.name, frame.z_m, frame.reason, rgb=rgb, amplitude=frame.amplitude)
            yield frame


def open_mkv(path: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None) -> Recording:
    """Open a recording. Without another lens given, its own calibration counts.

    Raises UserError where the file is no recording, has no depth, or carries no calibration.
    """
    _refuse_truncated(path)
    header = _header(path)
    size = header.depth_size
    notes: list[str] = []
    colour = None
    if intrinsics is not None:
        lens = read_lens(intrinsics, *size)
    if header.calibration is not None:
        cameras = parse_calibration(f"{path} (calibration.json)", header.calibration)
        lens = lens or depth_lens(str(path), cameras, header.depth_mode)
        colour = colour_camera(str(path), cameras, *header.colour_size) if header.colour_size else None
    if lens is None:
        raise no_lens(str(path))
    lens = lens_of_size(str(path), lens, *size)
    if colour is not None:
        notes.append("colour sampled at each depth point's place in the colour picture, without a test for occlusion")
    scale_m = scale_m or UNITS_M["mm"]
    files = (path,) if intrinsics is None else (path, intrinsics)
    reader = MkvReader(path, scale_m, lens, colour)
    return Recording(
        path.name,
        reader,
        lens.whole,
        scale_m,
        z_step_m=scale_m,
        files=files,
        lens=lens,
        notes=tuple(notes),
        unit_from="k4arecorder, which writes millimetres",
    )


def colour_on_depth(z_m: np.ndarray, slopes: np.ndarray, colour: ColourCamera, picture: np.ndarray) -> np.ndarray:
    """The colour (h, w, 3) uint8 at each depth pixel, bilinear; black where there is no depth or no colour picture.

    Not modelled: occlusion between the two cameras (32 mm apart in an Azure Kinect).
    """
    points = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1) * z_m[..., None]
    points_colour = transform_points(colour.T_colour_depth, points)
    seen = np.isfinite(points_colour).all(axis=-1) & (points_colour[..., 2] > 0)
    at = np.full((*z_m.shape, 2), -1e3, np.float32)
    at[seen] = colour.lens.project(points_colour[seen])
    # Beyond the frame the rational distortion may fold back into it; true rays there are steeper than the corner's.
    corner = np.abs(colour.lens.slopes(np.array([0, colour.lens.width - 1]), np.array([0, colour.lens.height - 1])))
    steep = np.abs(points_colour[..., :2] / np.where(seen, points_colour[..., 2], 1.0)[..., None]) > 1.2 * corner.max(0)
    at[steep.any(axis=-1)] = -1e3
    return cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


@dataclass(frozen=True)
class _Header:
    depth_size: tuple[int, int]
    depth_mode: str
    colour_size: tuple[int, int] | None
    calibration: bytes | None


def _opened(path: Path) -> Any:
    import av

    # Without these the decoder guesses the form by content: a playlist or a script called .mkv would open other files,
    # and addresses.
    only = {"protocol_whitelist": "file", "format_whitelist": "matroska,webm"}
    try:
        return av.open(f"file:{path}", format="matroska", options=only)
    except (OSError, ValueError) as error:  # PyAV's errors derive from these
        raise UserError(
            f"{path}: cannot be opened as a recording ({error})", legal=LEGAL_MKV, fix="copy or record it again"
        ) from error


def _header(path: Path) -> _Header:
    """What the recording says of itself before its frames."""
    with _opened(path) as container:
        tracks = _tracks(container)
        if "DEPTH" not in tracks:
            found = ", ".join(sorted(tracks)) or "none"
            raise UserError(f"{path}: has no DEPTH track (its tracks: {found})", legal=LEGAL_MKV)
        depth, colour = tracks["DEPTH"], tracks.get("COLOR")
        attached = [s for s in container.streams if s.type == "attachment" and "calib" in (s.name or "").lower()]
        for track in filter(None, (depth, colour)):
            refuse_pixels(f"{path}: its track", track.codec_context.width, track.codec_context.height)
        size = (depth.codec_context.width, depth.codec_context.height)
        # recorders of other makers (Orbbec's Femto) may leave the tag out; each mode has its own size
        stated = depth.metadata.get("K4A_DEPTH_MODE") or container.metadata.get("K4A_DEPTH_MODE")
        return _Header(
            depth_size=size,
            depth_mode=stated or depth_mode_of_size(*size) or "(not stated)",
            colour_size=(colour.codec_context.width, colour.codec_context.height) if colour else None,
            calibration=bytes(attached[0].data) if attached else None,
        )


def _tracks(container: Any) -> dict[str, Any]:
    return {s.metadata["title"]: s for s in container.streams.video if s.metadata.get("title") in TITLES}


@dataclass
class _Capture:
    """Pictures of one instant, by track title."""

    time_s: float
    pictures: dict[str, np.ndarray] = field(default_factory=dict)


def _captures(path: Path, with_colour: bool) -> Iterator[dict[str, np.ndarray]]:
    """Pictures that belong together (within half a frame period), in order of time; those without depth are skipped."""
    waiting: list[_Capture] = []
    for title, time_s, period_s, picture in _pictures(path, with_colour):
        home = next((c for c in waiting if abs(c.time_s - time_s) < period_s / 2 and title not in c.pictures), None)
        if home is None:
            home = _Capture(time_s)
            waiting = sorted([*waiting, home], key=lambda c: c.time_s)
        home.pictures[title] = picture
        if len(waiting) > WAITING and "DEPTH" in (ready := waiting.pop(0)).pictures:
            yield ready.pictures
    yield from (c.pictures for c in waiting if "DEPTH" in c.pictures)


def _pictures(path: Path, with_colour: bool) -> Iterator[tuple[str, float, float, np.ndarray]]:
    """(title, time in s, frame period in s, picture) as the file interleaves them. Raises UserError where it breaks."""
    with _opened(path) as container:
        tracks = {title: s for title, s in _tracks(container).items() if with_colour or title != "COLOR"}
        title_of = {s.index: title for title, s in tracks.items()}
        period_s = 1.0 / float(tracks["DEPTH"].average_rate or 30)
        for track in tracks.values():
            # A picture may state another size than its track.
            track.codec_context.options = {"max_pixels": str(FRAME_PIXELS)}
        try:
            delay_s = int(container.metadata.get("K4A_DEPTH_DELAY_NS", 0)) * 1e-9
            for packet in container.demux(*tracks.values()):
                title = title_of[packet.stream.index]
                for picture in packet.decode():
                    form = "rgb24" if title == "COLOR" else "gray16le"
                    # The depth camera may be set to fire after the colour camera; both belong to one capture.
                    shift_s = 0.0 if title == "COLOR" else delay_s
                    yield title, float(picture.time or 0.0) - shift_s, period_s, picture.to_ndarray(format=form)
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: cannot be decoded ({error})", legal=LEGAL_MKV, fix="record it again") from error


def _refuse_truncated(path: Path) -> None:
    """Compare the file's length with what its Segment element states (Matroska: an ID, then a variable-length size).

    The decoder says nothing when a file ends inside a block. A killed recorder leaves the size unknown (all ones).
    """
    with path.open("rb") as file:
        head = file.read(4096)
    at = head.find(SEGMENT_ID) + len(SEGMENT_ID)
    if at < len(SEGMENT_ID) or at >= len(head) or head[at] == 0:
        raise UserError(f"{path}: is no Matroska file, or is truncated", legal=LEGAL_MKV, fix="copy or record it again")
    length = 9 - head[at].bit_length()
    bits = 7 * length
    size = int.from_bytes(head[at : at + length], "big") & ((1 << bits) - 1)
    expected, found = at + length + size, path.stat().st_size
    if size != (1 << bits) - 1 and found < expected:
        raise UserError(
            f"{path}: is truncated: {found} of {expected} bytes",
            legal="a whole recording",
            fix="copy or record it again",
        )
