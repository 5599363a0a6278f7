"""Azure Kinect recordings (.mkv): depth, infrared and colour by PyAV, the lens from the attached calibration.

What k4arecorder writes: tracks titled COLOR, DEPTH and IR (16-bit big-endian grey, depth in millimetres, 0 = none),
tags K4A_*, and the factory calibration as an attachment. The colour is brought to the depth pixels by projecting each
depth point into the colour camera; a point that the colour camera cannot see takes the colour of what hides it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
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
from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.intrinsics import lens_for
from detectors.recordings.recording import Asked, Recording, slopes_of
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


def open_mkv(path: Path, asked: Asked) -> Recording:
    """Open a recording. Without another lens given, its own calibration counts.

    Raises UserError where the file is no recording, has no depth, or carries no calibration.
    """
    _refuse_truncated(path)
    with _opened(path) as container:
        tracks = _tracks(container)
        if "DEPTH" not in tracks:
            found = ", ".join(sorted(tracks)) or "none"
            raise UserError(f"{path}: has no DEPTH track (its tracks: {found})", legal=LEGAL_MKV)
        sizes = {title: (t.codec_context.width, t.codec_context.height) for title, t in tracks.items()}
        for title in sizes:
            refuse_pixels(f"{path}: its track {title}", *sizes[title])
        width, height = sizes["DEPTH"]
        # recorders of other makers (Orbbec's Femto) may leave the tag out; each mode has its own size
        stated = tracks["DEPTH"].metadata.get("K4A_DEPTH_MODE") or container.metadata.get("K4A_DEPTH_MODE")
        attached = [s for s in container.streams if s.type == "attachment" and "calib" in (s.name or "").lower()]
        calibration = bytes(attached[0].data) if attached else None
    cameras = None if calibration is None else parse_calibration(f"{path} (calibration.json)", calibration)

    def own() -> tuple[Lens | None, None]:
        mode = stated or depth_mode_of_size(width, height) or "(not stated)"
        return None if cameras is None else depth_lens(str(path), cameras, mode), None

    lens, lens_files = lens_for(str(path), asked, width, height, own)
    has_colour = cameras is not None and "COLOR" in sizes
    colour = colour_camera(str(path), cameras, *sizes["COLOR"]) if cameras is not None and has_colour else None
    note = "colour sampled at each depth point's place in the colour picture, without a test for occlusion"
    scale_m = asked.scale_m or UNITS_M["mm"]
    return Recording(
        name=path.name,
        read=partial(_frames, path, scale_m, lens, colour),
        shape=(height, width),
        scale_m=scale_m,
        z_step_m=scale_m,
        files=(path, *lens_files),
        lens=lens,
        notes=() if colour is None else (note,),
        unit_from="k4arecorder, which writes millimetres",
    )


def _frames(path: Path, scale_m: float, lens: Lens, colour: ColourCamera | None) -> Iterator[Frame]:
    """Yield a frame a depth picture. Raises UserError where the file is truncated or cannot be decoded."""
    slopes = slopes_of(lens, lens.whole)
    for number, pictures in enumerate(_captures(path, with_colour=colour is not None)):
        infrared = pictures.get("IR")
        amplitude = infrared.astype(np.float32) if infrared is not None else None
        frame = frame_of(f"{path.name} frame {number}", pictures["DEPTH"], scale_m, amplitude=amplitude)
        if colour is not None and "COLOR" in pictures:
            frame = replace(frame, rgb=colour_on_depth(frame.z_m, slopes, colour, pictures["COLOR"]))
        yield frame


def colour_on_depth(z_m: np.ndarray, slopes: np.ndarray, colour: ColourCamera, picture: np.ndarray) -> np.ndarray:
    """Return the colour (h, w, 3) uint8 at each depth pixel, bilinear; black where depth or colour is missing.

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


def _tracks(container: Any) -> dict[str, Any]:
    return {s.metadata["title"]: s for s in container.streams.video if s.metadata.get("title") in TITLES}


def _captures(path: Path, with_colour: bool) -> Iterator[dict[str, np.ndarray]]:
    """Yield the pictures of one instant (within half a frame period) by track title, in order of time; instants without
    depth are skipped."""
    waiting: list[tuple[float, dict[str, np.ndarray]]] = []
    for title, time_s, period_s, picture in _pictures(path, with_colour):
        home = next((held for at_s, held in waiting if abs(at_s - time_s) < period_s / 2 and title not in held), None)
        if home is None:
            home = {}
            waiting = sorted([*waiting, (time_s, home)], key=lambda capture: capture[0])
        home[title] = picture
        if len(waiting) > WAITING and "DEPTH" in (ready := waiting.pop(0)[1]):
            yield ready
    yield from (held for _, held in waiting if "DEPTH" in held)


def _pictures(path: Path, with_colour: bool) -> Iterator[tuple[str, float, float, np.ndarray]]:
    """Yield (title, time in s, frame period in s, picture) in the file's order. Raises UserError where it breaks."""
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
