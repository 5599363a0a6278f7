"""Recordings of cameras by their own programs: Azure Kinects (.mkv), iPhones and iPads (Stray
Scanner, Record3D).

k4arecorder writes tracks titled COLOR, DEPTH and IR (16-bit big-endian grey, depth in millimetres,
0 = none) and attaches the factory calibration. Phones store ARKit's depth, a confidence from 0 to
2 for each pixel (0 is no return), the lens of the colour camera, and poses; the program warns if
these show movement."""

import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.recordings.depth_images import depth_files, read_depth_png, read_picture
from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.intrinsics import (
    ColourCamera,
    colour_camera,
    depth_lens,
    depth_mode_of_size,
    lens_for,
    parse_calibration,
)
from detectors.recordings.recording import CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import (
    FRAME_PIXELS,
    TEXT_BYTES,
    bounded_bytes,
    refuse_bytes,
    refuse_pixels,
    strict_json,
)
from harness.vocabulary.geometry import Frame, Lens, transform_points

TITLES = ("DEPTH", "IR", "COLOR")
LEGAL_MKV = "a recording of k4arecorder with its DEPTH track"
SEGMENT_ID = bytes.fromhex("18538067")
# most captures that wait for their other pictures; the recorder interleaves tracks within one
# frame
WAITING = 4


def open_mkv(path: Path, options: CaptureOptions) -> Recording:
    """Open a recording with its own calibration, or with the given lens. Raises UserError if it
    has no depth."""
    _refuse_truncated(path)
    with _opened(path) as container:
        tracks = _tracks(container)
        if "DEPTH" not in tracks:
            titles = ", ".join(sorted(tracks)) or "none"
            raise UserError(f"{path}: has no DEPTH track (its tracks: {titles})", legal=LEGAL_MKV)
        sizes = {
            title: (t.codec_context.width, t.codec_context.height) for title, t in tracks.items()
        }
        for title in sizes:
            refuse_pixels(f"{path}: its track {title}", *sizes[title])
        width, height = sizes["DEPTH"]
        # recorders of other makers (Orbbec's Femto) may omit the tag; each mode has its own size
        stated = tracks["DEPTH"].metadata.get("K4A_DEPTH_MODE") or container.metadata.get(
            "K4A_DEPTH_MODE"
        )
        attached = [
            s
            for s in container.streams
            if s.type == "attachment" and "calib" in (s.name or "").lower()
        ]
        calibration = bytes(attached[0].data) if attached else None
    cameras = (
        None
        if calibration is None
        else parse_calibration(f"{path} (calibration.json)", calibration)
    )

    def capture_lens() -> Lens | None:
        mode = stated or depth_mode_of_size(width, height) or "(not stated)"
        return None if cameras is None else depth_lens(str(path), cameras, mode)

    lens, lens_files = lens_for(str(path), options, width, height, capture_lens)
    colour = (
        colour_camera(str(path), cameras, *sizes["COLOR"])
        if cameras is not None and "COLOR" in sizes
        else None
    )
    note = "colour sampled at each depth point's place in the colour picture, without a test for occlusion"
    scale_m = options.scale_m or UNITS_M["mm"]
    read = partial(_frames, path, scale_m, lens, colour)
    notes = () if colour is None else (note,)
    fields = {"files": (path, *lens_files), "lens": lens, "notes": notes}
    return Recording.begun(
        path.name, read, scale_m, True, unit_from="k4arecorder, which writes millimetres", **fields
    )


def _frames(path: Path, scale_m: float, lens: Lens, colour: ColourCamera | None) -> Iterator[Frame]:
    """Yield one frame per depth picture. Raises UserError if the file is truncated or cannot be
    decoded."""
    slopes = lens.region_slopes(lens.whole)
    for number, pictures in enumerate(_captures(path, with_colour=colour is not None)):
        infrared = pictures.get("IR")
        amplitude = infrared.astype(np.float32) if infrared is not None else None
        frame = frame_of(
            f"{path.name} frame {number}", pictures["DEPTH"], scale_m, amplitude=amplitude
        )
        if colour is not None and "COLOR" in pictures:
            frame = replace(
                frame, rgb=colour_on_depth(frame.z_m, slopes, colour, pictures["COLOR"])
            )
        yield frame


def colour_on_depth(
    z_m: np.ndarray, slopes: np.ndarray, colour: ColourCamera, picture: np.ndarray
) -> np.ndarray:
    """Return the colour (h, w, 3) uint8 at each depth pixel, bilinear; black where depth or colour
    is missing. Not modelled: occlusion between the two cameras (32 mm apart in an Azure Kinect).
    """
    points = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1) * z_m[..., None]
    points_colour = transform_points(colour.T_colour_depth, points)
    is_visible = np.isfinite(points_colour).all(axis=-1) & (points_colour[..., 2] > 0)
    colour_px = np.full((*z_m.shape, 2), -1e3, np.float32)
    colour_px[is_visible] = colour.lens.project(points_colour[is_visible])
    # Beyond the frame the rational distortion may fold back into it; true rays there are steeper
    # than the corner's.
    corner = np.abs(
        colour.lens.slopes(
            np.array([0, colour.lens.width - 1]), np.array([0, colour.lens.height - 1])
        )
    )
    steep = np.abs(
        points_colour[..., :2] / np.where(is_visible, points_colour[..., 2], 1.0)[..., None]
    ) > 1.2 * corner.max(0)
    colour_px[steep.any(axis=-1)] = -1e3
    return cv2.remap(
        picture,
        colour_px[..., 0],
        colour_px[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )


def _opened(path: Path) -> Any:
    import av

    # without these, the decoder guesses the format from the content: a playlist called .mkv would
    # open addresses
    only = {"protocol_whitelist": "file", "format_whitelist": "matroska,webm"}
    with read_errors(f"{path}: cannot be opened as a recording", LEGAL_MKV):
        return av.open(f"file:{path}", format="matroska", options=only)


def _tracks(container: Any) -> dict[str, Any]:
    return {
        s.metadata["title"]: s for s in container.streams.video if s.metadata.get("title") in TITLES
    }


def _captures(path: Path, with_colour: bool) -> Iterator[dict[str, np.ndarray]]:
    """Yield the pictures of one instant (within half a frame period) by track title, in order of
    time."""
    waiting: list[tuple[float, dict[str, np.ndarray]]] = []
    for title, time_s, period_s, picture in _pictures(path, with_colour):
        home = next(
            (
                capture
                for at_s, capture in waiting
                if abs(at_s - time_s) < period_s / 2 and title not in capture
            ),
            None,
        )
        if home is None:
            home = {}
            waiting = sorted([*waiting, (time_s, home)], key=lambda capture: capture[0])
        home[title] = picture
        if len(waiting) > WAITING and "DEPTH" in (ready := waiting.pop(0)[1]):
            yield ready
    yield from (capture for _, capture in waiting if "DEPTH" in capture)


def _pictures(path: Path, with_colour: bool) -> Iterator[tuple[str, float, float, np.ndarray]]:
    """Yield (title, time in s, frame period in s, picture) in the file's order. Raises UserError
    if it is broken."""
    with _opened(path) as container:
        tracks = {
            title: s for title, s in _tracks(container).items() if with_colour or title != "COLOR"
        }
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
                    # The depth camera may be set to expose after the colour camera; both belong to
                    # one capture.
                    shift_s = 0.0 if title == "COLOR" else delay_s
                    yield (
                        title,
                        float(picture.time or 0.0) - shift_s,
                        period_s,
                        picture.to_ndarray(format=form),
                    )
        except (OSError, ValueError) as error:
            raise UserError(
                f"{path}: cannot be decoded ({error})", legal=LEGAL_MKV, fix="record it again"
            ) from error


def _refuse_truncated(path: Path) -> None:
    """Compare the file's length with what its Segment element states (Matroska: an ID, then a
    variable-length size)."""
    with path.open("rb") as file:
        head = file.read(4096)
    start = head.find(SEGMENT_ID) + len(SEGMENT_ID)
    if start < len(SEGMENT_ID) or start >= len(head) or head[start] == 0:
        raise UserError(
            f"{path}: is truncated, or is not Matroska",
            legal=LEGAL_MKV,
            fix="copy or record it again",
        )
    length = 9 - head[start].bit_length()
    bits = 7 * length
    size = int.from_bytes(head[start : start + length], "big") & ((1 << bits) - 1)
    expected = start + length + size
    file_bytes = path.stat().st_size
    if size != (1 << bits) - 1 and file_bytes < expected:
        problem = f"{path}: is truncated: {file_bytes} of {expected} bytes"
        raise UserError(problem, legal="a whole recording", fix="copy or record it again")


LEGAL_STRAY = (
    "Stray Scanner's folder: depth/*.png, confidence/*.png, camera_matrix.csv, odometry.csv"
)
LEGAL_R3D = "Record3D's .r3d: metadata and rgbd/*.depth"
COLOUR_WIDTHS = (1920, 1280, 640, 3840)
"""Widths of the pictures to which ARKit's lens may refer; all have a ratio of 4 : 3, like its
depth."""
BLUR_PX = 0.5  # motion by this much of a pixel blurs an edge more than the sensor does


def _recording(
    path: Path,
    options: CaptureOptions,
    read: Callable[[], Iterator[Frame]],
    size: tuple[int, int],
    scaled_lens: Callable[[], Lens],
    files: tuple[Path, ...],
    poses: tuple[np.ndarray, np.ndarray, str],
    scale_m: float,
    writer: str,
) -> Recording:
    """Return the recording of either program. ``size``: width, height. ``poses``: places,
    quaternions, their source."""
    lens, lens_files = lens_for(str(path), options, *size, scaled_lens)
    notes = (
        ()
        if lens_files or options.lens
        else (f"lens scaled from the colour pixels to {size[0]} x {size[1]}",)
    )
    first_m = next(read()).z_m
    median_m = (
        float(np.median(first_m[np.isfinite(first_m)])) if np.isfinite(first_m).any() else 1.0
    )
    warnings = _motion_warnings(*poses, options.frames, lens, median_m)
    fields = {"files": (*files, *lens_files), "lens": lens, "notes": notes, "warnings": warnings}
    return Recording.begun(path.name, read, scale_m, "milli" in writer, unit_from=writer, **fields)


def _frame(name: str, stored: np.ndarray, confidence: np.ndarray | None, scale_m: float) -> Frame:
    if confidence is not None:
        if confidence.shape != stored.shape:
            raise UserError(
                f"{name}: its confidence has {confidence.shape} pixels, the depth {stored.shape}"
            )
        stored = np.where(confidence > 0, stored, stored.dtype.type(0))
    return frame_of(name, stored, scale_m)


def _scaled(name: str, k: np.ndarray, colour: tuple[int, int], size: tuple[int, int]) -> Lens:
    """Scale the lens of a colour picture to the depth picture of the same view."""
    across = size[0] / max(colour[0], 1)
    down = size[1] / max(colour[1], 1)
    fx = float(k[0, 0])
    fy = float(k[1, 1])
    cx = float(k[0, 2])
    cy = float(k[1, 2])
    good = (
        np.isfinite(k).all() and 0.1 < across * fx / size[0] < 100 and abs(across / down - 1) < 0.02
    )
    if not good or not (0 < cx < colour[0] and 0 < cy < colour[1] and fy > 0):
        problem = f"fx {fx:g}, cx {cx:g}, cy {cy:g} of {colour[0]} x {colour[1]} pixels is not a lens of {size} pixels"
        raise UserError(
            f"{name}: {problem}", fix="pass --intrinsics FILE with the lens of the depth pictures"
        )
    # positions count from the first pixel's centre
    return Lens(*size, fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)


def _motion_warnings(
    places_m: np.ndarray,
    turns: np.ndarray,
    source: str,
    frames: slice | None,
    lens: Lens,
    median_m: float,
) -> tuple[str, ...]:
    """Warn if the selected poses (quaternions in ``turns``) differ by more than `BLUR_PX` on the
    target."""
    chosen = frames or slice(None)
    places_m = places_m[chosen]
    turns = turns[chosen]
    if len(places_m) < 2 or not np.isfinite([*places_m.ravel(), *turns.ravel()]).all():
        return ()
    moved_m = float(np.linalg.norm(places_m - places_m[0], axis=1).max())
    unit = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    turned = float(2 * np.arccos(np.clip(np.abs(unit @ unit[0]), 0, 1)).max())
    blur_px = lens.fx * (turned + moved_m / median_m)
    if blur_px <= BLUR_PX:
        return ()
    moved = f"the camera moved by {1e3 * moved_m:.3g} mm and {np.degrees(turned):.2g} degrees"
    blur = f"up to {blur_px:.2g} pixels on the target, so their average is blurred"
    during = f"during the {len(places_m)} frames ({source})"
    return (f"{moved} {during}, {blur}: --max-frames 1 takes the first frame alone",)


def is_stray(folder: Path) -> bool:
    """Return whether a folder is Stray Scanner's."""
    return (folder / "camera_matrix.csv").is_file() and (folder / "depth").is_dir()


def open_stray(folder: Path, options: CaptureOptions) -> Recording:
    """Open Stray Scanner's folder. Raises UserError if a file is broken or the lens's resolution
    is unknown."""
    depths = depth_files(folder / "depth")
    height, width = read_depth_png(depths[0]).shape
    beside = [folder / "confidence" / path.name for path in depths]
    confidences = tuple(path if path.is_file() else None for path in beside)
    scale_m = options.scale_m or UNITS_M["mm"]
    matrix = folder / "camera_matrix.csv"
    odometry = folder / "odometry.csv"

    def scaled_lens() -> Lens:
        k = _table(matrix)
        if k.shape != (3, 3):
            raise UserError(
                f"{matrix}: holds no 3 x 3 matrix", legal=LEGAL_STRAY, fix="pass --intrinsics FILE"
            )
        across = next((w for w in COLOUR_WIDTHS if abs(2 * k[0, 2] - w) < 0.05 * w), None)
        if across is None:
            problem = f"cx = {k[0, 2]:g} is not the centre of any ARKit picture"
            raise UserError(f"{matrix}: {problem}", legal=LEGAL_STRAY, fix="pass --intrinsics FILE")
        return _scaled(str(matrix), k, (across, across * 3 // 4), (width, height))

    # x y z, then the quaternion
    poses = _table(odometry)[:, 2:9] if odometry.is_file() else np.zeros((0, 7))
    files = (path for path in (*depths, *confidences, matrix, odometry) if path and path.is_file())

    def read() -> Iterator[Frame]:
        for depth, confidence in zip(depths, confidences, strict=True):
            sure = read_picture(confidence, cv2.IMREAD_UNCHANGED) if confidence else None
            yield _frame(f"{depth.parent.name}/{depth.name}", read_depth_png(depth), sure, scale_m)

    motion = (poses[:, :3], poses[:, 3:], odometry.name)
    writer = "Stray Scanner, which writes millimetres"
    return _recording(
        folder, options, read, (width, height), scaled_lens, tuple(files), motion, scale_m, writer
    )


def _table(path: Path) -> np.ndarray:
    """Return the numbers of a small CSV, (rows, columns), without its line of names."""
    with read_errors(f"{path}: cannot be read as a table of numbers", LEGAL_STRAY):
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        lines = (line.strip(" ,\r") for line in text.splitlines() if re.match(r"\s*[-+.\d]", line))
        table = np.array(
            [[float(cell) for cell in re.split(r"[,;\s]+", line) if cell] for line in lines], float
        )
        if table.ndim != 2 or (path.stem == "odometry" and table.shape[1] < 9):
            raise ValueError("its lines differ in length or are too short")
    return table


def open_r3d(path: Path, options: CaptureOptions) -> Recording:
    """Open Record3D's .r3d. Raises UserError if it is broken, or if pyliblzfse, which unpacks its
    depth, is missing."""
    with _archive(path) as archive:
        if "metadata" not in archive.namelist() or not _depth_names(archive):
            contents = ", ".join(archive.namelist()[:6]) or "nothing"
            raise UserError(
                f"{path}: contains no Record3D capture ({contents[:200]})", legal=LEGAL_R3D
            )
        content = _content(path, archive, "metadata")
    with read_errors(f"{path}: its metadata cannot be read", LEGAL_R3D):
        info = strict_json(content)
        k = np.array([float(x) for x in info["K"]]).reshape(3, 3).T
        width = int(info.get("dw", 192))
        height = int(info.get("dh", 256))
        colour = int(info["w"]), int(info["h"])
        poses = np.array(info.get("poses") or np.zeros((0, 7)), float).reshape(-1, 7)
    refuse_pixels(str(path), width, height)
    scale_m = options.scale_m or UNITS_M["m"]
    scaled_lens = partial(_scaled, f"{path}: metadata", k, colour, (width, height))

    def read() -> Iterator[Frame]:
        with _archive(path) as archive:
            for name in _depth_names(archive):
                beside = f"{name.removesuffix('.depth')}.conf"
                sure = (
                    _plane(path, archive, beside, "u1", (width, height))
                    if beside in archive.namelist()
                    else None
                )
                yield _frame(
                    f"{path.name} {name}",
                    _plane(path, archive, name, "<f4", (width, height)),
                    sure,
                    scale_m,
                )

    motion = (poses[:, 4:], poses[:, :4], "its metadata")
    writer = "Record3D, which writes metres"
    return _recording(
        path, options, read, (width, height), scaled_lens, (path,), motion, scale_m, writer
    )


def _archive(path: Path) -> zipfile.ZipFile:
    with read_errors(f"{path}: is not a Record3D archive, or is cut off", LEGAL_R3D):
        return zipfile.ZipFile(path)


def _depth_names(archive: zipfile.ZipFile) -> list[str]:
    names = [name for name in archive.namelist() if re.fullmatch(r"(?:.*/)?\d{1,9}\.depth", name)]
    return sorted(names, key=lambda name: int(Path(name).stem))


def _content(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """Return an entry's bytes, at most `files.TEXT_BYTES`: depth of an iPhone has 0.1 MB."""
    refuse_bytes(f"{path}: {name}", archive.getinfo(name).file_size, TEXT_BYTES)
    with read_errors(f"{path}: {name} cannot be read", LEGAL_R3D), archive.open(name) as stream:
        return stream.read(TEXT_BYTES)


def _plane(
    path: Path, archive: zipfile.ZipFile, name: str, kind: str, size: tuple[int, int]
) -> np.ndarray:
    """Unpack an entry by Apple's LZFSE into numbers (h, w). Raises UserError unless it gives
    exactly as many."""
    packed = _content(path, archive, name)
    try:
        import liblzfse  # type: ignore[import-not-found]
    except ImportError as error:
        problem = f"{path}: {name}: is compressed by LZFSE, and the package that unpacks it is not installed"
        raise UserError(
            problem, fix="pip install pyliblzfse, or export the capture as PLY"
        ) from error
    with read_errors(f"{path}: {name}: is damaged, its LZFSE data cannot be unpacked", LEGAL_R3D):
        return np.frombuffer(liblzfse.decompress(packed), kind).reshape(size[::-1])
