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
from typing import Any, NamedTuple

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
from harness.vocabulary.geometry import Frame, Lens, rays_of, transform_points

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
        sizes = {}
        for title, track in tracks.items():
            size = (track.codec_context.width, track.codec_context.height)
            refuse_pixels(f"{path}: its track {title}", size[0], size[1])
            sizes[title] = size
        # recorders of other makers (Orbbec's Femto) may omit the tag; each mode has its own size
        tag = "K4A_DEPTH_MODE"
        stated = tracks["DEPTH"].metadata.get(tag) or container.metadata.get(tag)
        calibration = _calibration(container)
    width, height = sizes["DEPTH"]
    cameras = None
    if calibration is not None:
        cameras = parse_calibration(f"{path} (calibration.json)", calibration)

    def capture_lens() -> Lens | None:
        mode = stated or depth_mode_of_size(width, height) or "(not stated)"
        return None if cameras is None else depth_lens(str(path), cameras, mode)

    lens, lens_files = lens_for(str(path), options, width, height, capture_lens)
    colour = None
    if cameras is not None and "COLOR" in sizes:
        colour_width, colour_height = sizes["COLOR"]
        colour = colour_camera(str(path), cameras, colour_width, colour_height)
    notes: tuple[str, ...] = ()
    if colour is not None:
        note = (
            "colour sampled at each depth point's place in the colour picture, "
            "without a test for occlusion"
        )
        notes = (note,)
    scale_m = options.scale_m or UNITS_M["mm"]
    return Recording.begun(
        path.name,
        partial(_frames, path, scale_m, lens, colour),
        scale_m,
        is_whole=True,
        unit_from="k4arecorder, which writes millimetres",
        files=(path, *lens_files),
        lens=lens,
        notes=notes,
    )


def _calibration(container: Any) -> bytes | None:
    """Return the attached factory calibration."""
    for stream in container.streams:
        if stream.type == "attachment" and "calib" in (stream.name or "").lower():
            return bytes(stream.data)
    return None


def _frames(path: Path, scale_m: float, lens: Lens, colour: ColourCamera | None) -> Iterator[Frame]:
    """Yield one frame per depth picture. Raises UserError if the file is truncated or cannot be
    decoded."""
    slopes = lens.region_slopes(lens.whole)
    captures = _captures(path, with_colour=colour is not None)
    for number, (time_s, pictures) in enumerate(captures):
        name = f"{path.name} frame {number}"
        infrared = pictures.get("IR")
        amplitude = infrared.astype(np.float32) if infrared is not None else None
        frame = frame_of(name, pictures["DEPTH"], scale_m, amplitude=amplitude)
        frame = replace(frame, time_s=time_s)
        if colour is not None and "COLOR" in pictures:
            rgb = colour_on_depth(frame.z_m, slopes, colour, pictures["COLOR"])
            frame = replace(frame, rgb=rgb)
        yield frame


def colour_on_depth(
    z_m: np.ndarray,
    slopes: np.ndarray,
    colour: ColourCamera,
    picture: np.ndarray,
) -> np.ndarray:
    """Return the colour (h, w, 3) uint8 at each depth pixel, bilinear; black where depth or colour
    is missing. Not modelled: occlusion between the two cameras (32 mm apart in an Azure Kinect).
    """
    rays = rays_of(slopes)
    points_colour = transform_points(colour.T_colour_depth, rays * z_m[..., None])
    lens = colour.lens
    is_visible = np.isfinite(points_colour).all(axis=-1) & (points_colour[..., 2] > 0)
    colour_px = np.full((*z_m.shape, 2), -1e3, np.float32)
    colour_px[is_visible] = lens.project(points_colour[is_visible])
    # Beyond the frame the rational distortion may fold back into it; true rays there are steeper
    # than the corner's.
    last_column = lens.width - 1
    last_row = lens.height - 1
    corners = np.abs(lens.slopes(np.array([0, last_column]), np.array([0, last_row])))
    depths = np.where(is_visible, points_colour[..., 2], 1.0)[..., None]
    is_steep = np.abs(points_colour[..., :2] / depths) > 1.2 * corners.max(axis=0)
    colour_px[is_steep.any(axis=-1)] = -1e3
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
    """Return the recorder's video tracks by title."""
    tracks = {}
    for stream in container.streams.video:
        if stream.metadata.get("title") in TITLES:
            tracks[stream.metadata["title"]] = stream
    return tracks


def _captures(path: Path, with_colour: bool) -> Iterator[tuple[float, dict[str, np.ndarray]]]:
    """Yield the time in s and the pictures of one instant (within half a frame period) by track
    title, in order of time."""
    waiting: list[tuple[float, dict[str, np.ndarray]]] = []
    for title, time_s, period_s, picture in _pictures(path, with_colour):
        for capture_s, capture in waiting:
            if abs(capture_s - time_s) < period_s / 2 and title not in capture:
                capture[title] = picture
                break
        else:
            waiting.append((time_s, {title: picture}))
            waiting.sort(key=lambda capture: capture[0])
        if len(waiting) > WAITING:
            oldest_s, oldest = waiting.pop(0)
            if "DEPTH" in oldest:
                yield oldest_s, oldest
    for capture_s, capture in waiting:
        if "DEPTH" in capture:
            yield capture_s, capture


def _pictures(path: Path, with_colour: bool) -> Iterator[tuple[str, float, float, np.ndarray]]:
    """Yield (title, time in s, frame period in s, picture) in the file's order. Raises UserError
    if it is broken."""
    with _opened(path) as container:
        tracks = _tracks(container)
        if not with_colour:
            tracks.pop("COLOR", None)
        title_of = {track.index: title for title, track in tracks.items()}
        period_s = 1.0 / float(tracks["DEPTH"].average_rate or 30)
        for track in tracks.values():
            # A picture may state another size than its track.
            track.codec_context.options = {"max_pixels": str(FRAME_PIXELS)}
        try:
            delay_s = int(container.metadata.get("K4A_DEPTH_DELAY_NS", 0)) * 1e-9
            for packet in container.demux(*tracks.values()):
                title = title_of[packet.stream.index]
                # The depth camera may be set to expose after the colour camera; both belong to one
                # capture.
                shift_s = 0.0 if title == "COLOR" else delay_s
                form = "rgb24" if title == "COLOR" else "gray16le"
                for picture in packet.decode():
                    time_s = float(picture.time or 0.0) - shift_s
                    yield title, time_s, period_s, picture.to_ndarray(format=form)
        except (OSError, ValueError) as error:
            problem = f"{path}: cannot be decoded ({error})"
            raise UserError(problem, legal=LEGAL_MKV, fix="record it again") from error


def _refuse_truncated(path: Path) -> None:
    """Compare the file's length with what its Segment element states (Matroska: an ID, then a
    variable-length size)."""
    with path.open("rb") as file:
        head = file.read(4096)
    fix = "copy or record it again"
    start = head.find(SEGMENT_ID) + len(SEGMENT_ID)
    if start < len(SEGMENT_ID) or start >= len(head) or head[start] == 0:
        problem = f"{path}: is truncated, or is not Matroska"
        raise UserError(problem, legal=LEGAL_MKV, fix=fix)
    length = 9 - head[start].bit_length()
    end = start + length
    # all ones mean that the size is unknown
    unknown = (1 << 7 * length) - 1
    size = int.from_bytes(head[start:end], "big") & unknown
    expected = end + size
    file_bytes = path.stat().st_size
    if size != unknown and file_bytes < expected:
        problem = f"{path}: is truncated: {file_bytes} of {expected} bytes"
        raise UserError(problem, legal="a whole recording", fix=fix)


LEGAL_STRAY = (
    "Stray Scanner's folder: depth/*.png, confidence/*.png, camera_matrix.csv, odometry.csv"
)
LEGAL_R3D = "Record3D's .r3d: metadata and rgbd/*.depth"
COLOUR_WIDTHS = (1920, 1280, 640, 3840)
"""Widths of the pictures to which ARKit's lens may refer; all have a ratio of 4 : 3, like its
depth."""
BLUR_PX = 0.5  # motion by this much of a pixel blurs an edge more than the sensor does


class _Phone(NamedTuple):
    """A phone's capture, as one of the two programs writes it."""

    # its folder or archive
    path: Path
    # width and height of the depth, pixels
    size: tuple[int, int]
    # metres in one stored number
    scale_m: float
    # all files that are read
    files: tuple[Path, ...]
    # the program and its unit
    writer: str
    # the camera's positions (n, 3), metres
    positions_m: np.ndarray
    # its turns as quaternions (n, 4)
    turns: np.ndarray
    # the file that states them
    poses_from: str


def _recording(
    phone: _Phone,
    options: CaptureOptions,
    read: Callable[[], Iterator[Frame]],
    scaled_lens: Callable[[], Lens],
) -> Recording:
    """Return the recording of either program."""
    width, height = phone.size
    lens, lens_files = lens_for(str(phone.path), options, width, height, scaled_lens)
    notes: tuple[str, ...] = ()
    if not lens_files and not options.lens:
        notes = (f"lens scaled from the colour pixels to {width} x {height}",)
    first_m = next(read()).z_m
    valid_m = first_m[np.isfinite(first_m)]
    median_m = float(np.median(valid_m)) if valid_m.size else 1.0
    return Recording.begun(
        phone.path.name,
        read,
        phone.scale_m,
        is_whole="milli" in phone.writer,
        unit_from=phone.writer,
        files=(*phone.files, *lens_files),
        lens=lens,
        notes=notes,
        warnings=_motion_warnings(phone, options.frames, lens, median_m),
    )


def _frame(name: str, stored: np.ndarray, confidence: np.ndarray | None, scale_m: float) -> Frame:
    """Return a frame without the pixels of no confidence."""
    if confidence is not None:
        if confidence.shape != stored.shape:
            sizes = f"{confidence.shape} pixels, the depth {stored.shape}"
            raise UserError(f"{name}: its confidence has {sizes}")
        stored = np.where(confidence > 0, stored, stored.dtype.type(0))
    return frame_of(name, stored, scale_m)


def _scaled(name: str, k: np.ndarray, colour: tuple[int, int], size: tuple[int, int]) -> Lens:
    """Scale the lens of a colour picture to the depth picture of the same view."""
    width, height = size
    colour_width, colour_height = colour
    across = width / max(colour_width, 1)
    down = height / max(colour_height, 1)
    fx = float(k[0, 0])
    fy = float(k[1, 1])
    cx = float(k[0, 2])
    cy = float(k[1, 2])
    is_same_view = abs(across / down - 1) < 0.02
    is_focal = np.isfinite(k).all() and 0.1 < across * fx / width < 100 and fy > 0
    is_inside = 0 < cx < colour_width and 0 < cy < colour_height
    if not (is_same_view and is_focal and is_inside):
        raise UserError(
            f"{name}: fx {fx:g}, cx {cx:g}, cy {cy:g} of {colour_width} x {colour_height} pixels "
            f"is not a lens of {size} pixels",
            fix="pass --intrinsics FILE with the lens of the depth pictures",
        )
    return Lens(
        width=width,
        height=height,
        fx=fx * across,
        fy=fy * down,
        # positions count from the first pixel's centre
        cx=(cx + 0.5) * across - 0.5,
        cy=(cy + 0.5) * down - 0.5,
    )


def _motion_warnings(
    phone: _Phone,
    frames: slice | None,
    lens: Lens,
    median_m: float,
) -> tuple[str, ...]:
    """Warn if the poses of the selected frames differ by more than `BLUR_PX` on the target."""
    chosen = frames or slice(None)
    positions_m = phone.positions_m[chosen]
    turns = phone.turns[chosen]
    if len(positions_m) < 2:
        return ()
    if not np.isfinite(positions_m).all() or not np.isfinite(turns).all():
        return ()
    moved_m = float(np.linalg.norm(positions_m - positions_m[0], axis=1).max())
    unit = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    cosines = np.clip(np.abs(unit @ unit[0]), 0, 1)
    turned = float(2 * np.arccos(cosines).max())
    blur_px = lens.fx * (turned + moved_m / median_m)
    if blur_px <= BLUR_PX:
        return ()
    warning = (
        f"the camera moved by {1e3 * moved_m:.3g} mm and {np.degrees(turned):.2g} degrees "
        f"during the {len(positions_m)} frames ({phone.poses_from}), "
        f"up to {blur_px:.2g} pixels on the target, so their average is blurred: "
        "--max-frames 1 takes the first frame alone"
    )
    return (warning,)


def is_stray(folder: Path) -> bool:
    """Return whether a folder is Stray Scanner's."""
    return (folder / "camera_matrix.csv").is_file() and (folder / "depth").is_dir()


def open_stray(folder: Path, options: CaptureOptions) -> Recording:
    """Open Stray Scanner's folder. Raises UserError if a file is broken or the lens's resolution
    is unknown."""
    depths = depth_files(folder / "depth")
    height, width = read_depth_png(depths[0]).shape
    confidences = [folder / "confidence" / path.name for path in depths]
    scale_m = options.scale_m or UNITS_M["mm"]
    matrix = folder / "camera_matrix.csv"
    odometry = folder / "odometry.csv"

    def read() -> Iterator[Frame]:
        for depth, path in zip(depths, confidences, strict=True):
            confidence = read_picture(path, cv2.IMREAD_UNCHANGED) if path.is_file() else None
            name = f"{depth.parent.name}/{depth.name}"
            yield _frame(name, read_depth_png(depth), confidence, scale_m)

    # x y z, then the quaternion
    poses = _table(odometry)[:, 2:9] if odometry.is_file() else np.zeros((0, 7))
    files = (*depths, *confidences, matrix, odometry)
    phone = _Phone(
        path=folder,
        size=(width, height),
        scale_m=scale_m,
        files=tuple(path for path in files if path.is_file()),
        writer="Stray Scanner, which writes millimetres",
        positions_m=poses[:, :3],
        turns=poses[:, 3:],
        poses_from=odometry.name,
    )
    return _recording(phone, options, read, partial(_stray_lens, matrix, phone.size))


def _stray_lens(path: Path, size: tuple[int, int]) -> Lens:
    """Return the lens of Stray Scanner's matrix for depth of this size. Raises UserError if the
    colour picture's size is unknown."""
    k = _table(path)
    fix = "pass --intrinsics FILE"
    if k.shape != (3, 3):
        raise UserError(f"{path}: holds no 3 x 3 matrix", legal=LEGAL_STRAY, fix=fix)
    for width in COLOUR_WIDTHS:
        if abs(2 * k[0, 2] - width) < 0.05 * width:
            return _scaled(str(path), k, (width, width * 3 // 4), size)
    problem = f"{path}: cx = {k[0, 2]:g} is not the centre of any ARKit picture"
    raise UserError(problem, legal=LEGAL_STRAY, fix=fix)


def _table(path: Path) -> np.ndarray:
    """Return the numbers of a small CSV, (rows, columns), without its line of names."""
    with read_errors(f"{path}: cannot be read as a table of numbers", LEGAL_STRAY):
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        rows = []
        for line in text.splitlines():
            if re.match(r"\s*[-+.\d]", line):
                cells = re.split(r"[,;\s]+", line.strip(" ,\r"))
                rows.append([float(cell) for cell in cells if cell])
        table = np.array(rows, float)
        if table.ndim != 2 or (path.stem == "odometry" and table.shape[1] < 9):
            raise ValueError("its lines differ in length or are too short")
    return table


def open_r3d(path: Path, options: CaptureOptions) -> Recording:
    """Open Record3D's .r3d. Raises UserError if it is broken, or if lzfse, which unpacks its
    depth, is missing."""
    with _archive(path) as archive:
        names = archive.namelist()
        if "metadata" not in names or not _depth_names(archive):
            contents = ", ".join(names[:6]) or "nothing"
            problem = f"{path}: contains no Record3D capture ({contents[:200]})"
            raise UserError(problem, legal=LEGAL_R3D)
        content = _content(path, archive, "metadata")
    with read_errors(f"{path}: its metadata cannot be read", LEGAL_R3D):
        info = strict_json(content)
        k = np.array([float(x) for x in info["K"]]).reshape(3, 3).T
        size = (int(info.get("dw", 192)), int(info.get("dh", 256)))
        colour_size = (int(info["w"]), int(info["h"]))
        # the quaternion, then x y z
        poses = np.array(info.get("poses") or np.zeros((0, 7)), float).reshape(-1, 7)
    refuse_pixels(str(path), size[0], size[1])
    scale_m = options.scale_m or UNITS_M["m"]

    def read() -> Iterator[Frame]:
        with _archive(path) as archive:
            names = archive.namelist()
            for name in _depth_names(archive):
                confidence_name = f"{name.removesuffix('.depth')}.conf"
                confidence = None
                if confidence_name in names:
                    confidence = _plane(path, archive, confidence_name, "u1", size)
                depth = _plane(path, archive, name, "<f4", size)
                yield _frame(f"{path.name} {name}", depth, confidence, scale_m)

    phone = _Phone(
        path=path,
        size=size,
        scale_m=scale_m,
        files=(path,),
        writer="Record3D, which writes metres",
        positions_m=poses[:, 4:],
        turns=poses[:, :4],
        poses_from="its metadata",
    )
    return _recording(
        phone, options, read, partial(_scaled, f"{path}: metadata", k, colour_size, size)
    )


def _archive(path: Path) -> zipfile.ZipFile:
    with read_errors(f"{path}: is not a Record3D archive, or is cut off", LEGAL_R3D):
        return zipfile.ZipFile(path)


def _depth_names(archive: zipfile.ZipFile) -> list[str]:
    """Return the names of an archive's depth pictures by their numbers."""
    names = []
    for name in archive.namelist():
        if re.fullmatch(r"(?:.*/)?\d{1,9}\.depth", name):
            names.append(name)
    return sorted(names, key=lambda name: int(Path(name).stem))


def _content(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """Return an entry's bytes, at most `files.TEXT_BYTES`: depth of an iPhone has 0.1 MB."""
    refuse_bytes(f"{path}: {name}", archive.getinfo(name).file_size, TEXT_BYTES)
    with read_errors(f"{path}: {name} cannot be read", LEGAL_R3D), archive.open(name) as stream:
        return stream.read(TEXT_BYTES)


def _plane(
    path: Path,
    archive: zipfile.ZipFile,
    name: str,
    kind: str,
    size: tuple[int, int],
) -> np.ndarray:
    """Unpack an entry by Apple's LZFSE into numbers (h, w). Raises UserError unless it gives
    exactly as many."""
    packed = _content(path, archive, name)
    with read_errors(f"{path}: {name}: is damaged, its LZFSE data cannot be unpacked", LEGAL_R3D):
        import lzfse

        return np.frombuffer(lzfse.decompress(packed), kind).reshape(size[::-1])
