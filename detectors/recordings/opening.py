"""Recognise a capture by what it is, and open it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from detectors.recordings.array_files import raw_layout_of
from detectors.recordings.arrays import LOADERS, open_arrays
from detectors.recordings.azure_mkv import open_mkv
from detectors.recordings.bag_files import ROS1_SUFFIX, is_bag
from detectors.recordings.bags import open_bag
from detectors.recordings.clouds import CLOUDS, POINT_LISTS, open_clouds
from detectors.recordings.depth_images import open_depth_folder, open_depth_list, png_kind
from detectors.recordings.distances import UNITS_M, Unit, decided_unit, metres_per_unit, scale_in
from detectors.recordings.intrinsics import statements_beside
from detectors.recordings.phones import is_stray, open_r3d, open_stray
from detectors.recordings.recording import Asked, Recording
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens, OtherLens

LEGAL_FORMATS = (
    "a folder or list of 16-bit depth .png, of .ply or .pcd, or of .xyz .txt .csv points; a ROS bag (folder, .mcap, "
    ".db3, .bag); one .npy, .npz, .mat, .mkv or .r3d file; a Stray Scanner folder; with --pitch a height map; with "
    "--raw a file of bare numbers"
)
LISTS = {(".png",): open_depth_list, CLOUDS: open_clouds, POINT_LISTS: open_clouds}
"""Suffixes of files of which several, all of one suffix, are one capture."""
BARE = (".bin", ".raw", ".dat")
CONVERT = {
    **dict.fromkeys(
        (".tif", ".tiff", ".exr"),
        "OPENCV_IO_ENABLE_OPENEXR=1 python -c \"import cv2, numpy; numpy.save('depth.npy', cv2.imread('{}', -1))\""
        ", then name depth.npy",
    ),
    **dict.fromkeys(
        (".h5", ".hdf5"),
        "python -c \"import h5py, numpy; numpy.save('depth.npy', h5py.File('{}')['NAME'][:])\", then name depth.npy",
    ),
    **dict.fromkeys(
        (".e57", ".las", ".laz", ".pcap", ".obj", ".stl", ".off"),
        "export its points as PLY, for instance by CloudCompare",
    ),
}
"""Commands that turn files that are not read into files that are."""
HELD = 6
"""Names of a folder's contents that a message lists."""


def open_capture(
    paths: Sequence[Path],
    *,
    unit: str | None = None,
    intrinsics: Path | None = None,
    lens: Lens | None = None,
    frames: slice | None = None,
    topic: str | None = None,
    array: str | None = None,
    pitch: str | None = None,
    raw: str | None = None,
) -> Recording:
    """Open a real capture as a source of frames; its first frame is read and checked.

    ``unit`` of the stored distances (mm, m, cm, um, tum, N/m) where the format's usual one is wrong. ``intrinsics``: a
    file with the depth pixels' lens, which counts before one found beside the frames or attached to them; ``lens`` the
    same as a value. ``frames`` selects frames by number. ``topic``: of a ROS bag the topic with the depth images or
    clouds, where several have some. ``array``: NAME or NAME:NUMBER in a file of arrays. ``pitch``: the distance between
    the pixels of a height map (``0.5mm``). ``raw``: the layout of bare numbers (`array_files.RawLoader`). Raises
    UserError for every fault of the files.
    """
    paths = [Path(path) for path in paths]
    if not paths:
        raise UserError("no capture named", legal=LEGAL_FORMATS)
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: no such file or folder", legal=LEGAL_FORMATS)
        if not path.is_file() and not path.is_dir():
            raise UserError(f"{path}: is neither a file nor a folder, but a device or a pipe", legal=LEGAL_FORMATS)
    asked = Asked(metres_per_unit(unit) if unit else None, intrinsics, lens, frames, topic, array, pitch, raw)
    recording = replace(_opened(paths, asked), selection=frames)
    said = Unit(recording.scale_m, f"--unit {unit}" if unit else recording.unit_from)
    if not said.origin:
        said = _unit_not_stated(recording)
        if said.scale_m != recording.scale_m:
            recording = replace(_opened(paths, replace(asked, scale_m=said.scale_m)), selection=frames)
    first, given = recording.first_frame(), recording.lens
    notes, warnings = [*recording.notes, *first.notes], [*recording.warnings, said.warning]
    if isinstance(given, OtherLens):
        notes, warnings = [*notes, given.note], [*warnings, given.warning]
        recording = replace(recording, lens=given.plain)
    notes, warnings = list(filter(None, notes)), list(filter(None, warnings))
    return replace(recording, unit_from=said.origin, notes=tuple(notes), warnings=tuple(warnings))


def _unit_not_stated(recording: Recording) -> Unit:
    """Find the unit of a capture whose format leaves it open: of a file beside, of the named camera, or by the data of
    the first selected frame that has a distance."""
    for frame in recording.selected():
        z_m = frame.z_m[np.isfinite(frame.z_m)].astype(np.float64)
        if z_m.size:
            break
    else:
        return Unit(recording.scale_m, "what is usual")
    stored = z_m / recording.scale_m
    if recording.scale_m == UNITS_M["mm"]:
        stored = np.rint(stored)  # float32 metres hold whole numbers to 1e-7
        for path, texts in statements_beside(recording.files):
            scale_m = scale_in(texts, float(np.median(stored)))
            if scale_m is not None:
                return Unit(scale_m, path.name)
        if isinstance(recording.lens, OtherLens) and recording.lens.unit_m:
            return Unit(recording.lens.unit_m, f"the camera of {recording.lens.mode}")
    height, width = recording.shape
    return decided_unit(recording.name, stored, recording.scale_m, (width, height))


def _opened(paths: list[Path], asked: Asked) -> Recording:
    """Open a capture by the first format that its paths fit."""
    path, is_single = paths[0], len(paths) == 1
    suffixes = {each.suffix.lower() for each in paths if each.is_file()}
    if is_single and is_bag(path) and asked.raw is None:
        _refuse_unused(path, asked, ": this is a ROS bag")
        return open_bag(path, asked)
    if asked.topic is not None:
        raise UserError(f"{path}: is no ROS bag, so it has no topic {asked.topic}", fix="leave out --topic")
    if is_single and path.is_file() and (asked.raw is not None or suffixes <= set(LOADERS)):
        return open_arrays(path, asked)
    _refuse_unused(path, asked)
    if is_single and path.is_dir():
        return _open_folder(path, asked)
    if any(each.is_dir() for each in paths):
        raise UserError(f"{len(paths)} paths with folders among them", legal=LEGAL_FORMATS, fix="name one folder alone")
    name = path.name if is_single else f"{path.name} .. {paths[-1].name}"
    for kind, opener in LISTS.items():
        if len(suffixes) == 1 and suffixes <= set(kind):
            return opener(paths, asked, name)
    if not is_single:
        raise UserError(f"{len(paths)} files of the kinds {', '.join(sorted(suffixes))}", legal=LEGAL_FORMATS)
    (suffix,) = suffixes
    if suffix in (".mkv", ".r3d"):
        return (open_mkv if suffix == ".mkv" else open_r3d)(path, asked)
    if suffix in BARE:
        raise raw_layout_of(path)
    fix = CONVERT.get(suffix, "").format(path) or None
    raise UserError(f"{path}: files of the kind '{suffix}' are not read", legal=LEGAL_FORMATS, fix=fix)


def _refuse_unused(path: Path, asked: Asked, but: str = "") -> None:
    """Raise UserError for options that only files of arrays have."""
    for name in ("array", "pitch", "raw"):
        if getattr(asked, name) is not None:
            raise UserError(
                f"{path}: --{name} is for files of arrays",
                legal=f"{', '.join(LOADERS)}, or bare numbers with --raw",
                fix=f"leave out --{name}{but}",
            )


def _open_folder(folder: Path, asked: Asked) -> Recording:
    try:
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from error
    if is_stray(folder):
        return open_stray(folder, asked)
    for suffix in (*CLOUDS, *POINT_LISTS[:3]):
        clouds = [path for path in inside if path.suffix.lower() == suffix]
        if clouds:
            return open_clouds(clouds, asked, folder.name)
    pictures = [path for path in inside if path.suffix.lower() == ".png"]
    has_arrays = any(path.suffix.lower() in LOADERS for path in inside)
    is_depth = (folder / "depth").is_dir() or (
        bool(pictures) and (not has_arrays or any(png_kind(path)[2:] == (16, 0) for path in pictures))
    )
    if is_depth:
        return open_depth_folder(folder, asked)
    held = ", ".join(path.name for path in inside[:HELD]) + (", .." if len(inside) > HELD else "")
    files = (*LOADERS, ".mkv", ".r3d", ROS1_SUFFIX)
    captures = [
        path
        for path in inside
        if (path.suffix.lower() in files if path.is_file() else is_bag(path) or (path / "depth").is_dir())
    ]
    several = "one of " if len(captures) > 1 else ""
    raise UserError(
        f"{folder}: no capture in it; it holds {held}" if held else f"{folder}: is empty",
        legal=LEGAL_FORMATS,
        fix=f"name {several}{', '.join(map(str, captures[:HELD]))}" if captures else None,
    )
