"""Recognise a capture by what it is, and open it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from detectors.recordings.arrays import RawLoader, load_npy, open_stack, raw_layout_of
from detectors.recordings.azure_mkv import open_mkv
from detectors.recordings.bag_files import BAG_SUFFIXES, ROS1_SUFFIX, is_bag_folder
from detectors.recordings.bags import open_bag
from detectors.recordings.depth_images import open_depth_folder, open_depth_list, png_kind
from detectors.recordings.distances import UNITS_M, Unit, decided_unit, metres_per_unit, scale_in
from detectors.recordings.height_maps import open_height_map
from detectors.recordings.intrinsics import statements_beside
from detectors.recordings.matlab import load_mat
from detectors.recordings.phones import is_stray, open_r3d, open_stray
from detectors.recordings.point_lists import POINT_LISTS, open_point_lists
from detectors.recordings.pointclouds import open_clouds
from detectors.recordings.recording import Recording
from harness.vocabulary.archives import read_npz
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens, OtherLens

STACKS = {".npy": load_npy, ".npz": read_npz, ".mat": load_mat}
CLOUDS = (".ply", ".pcd")
HELD = 6
"""Names of a folder's contents that a message lists."""
LEGAL_FORMATS = (
    "a folder or list of 16-bit depth .png, of .ply or .pcd, or of .xyz .txt .csv points; a ROS bag (folder, .mcap, "
    ".db3, .bag); one .npy, .npz, .mat, .mkv or .r3d file; a Stray Scanner folder; with --pitch a height map; with "
    "--raw a file of bare numbers"
)
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
"""What turns files that are not read into files that are."""


@dataclass(frozen=True)
class Asked:
    """What the user said of a capture, as `open_capture` takes it."""

    intrinsics: Path | None = None
    lens: Lens | None = None
    frames: slice | None = None
    topic: str | None = None
    array: str | None = None
    pitch: str | None = None
    raw: str | None = None


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
    the pixels of a height map (``0.5mm``). ``raw``: the layout of bare numbers (`RawLoader.stated`). Raises
    UserError for every fault of the files.
    """
    paths = [Path(path) for path in paths]
    if not paths:
        raise UserError("no capture named", legal=LEGAL_FORMATS)
    missing = next((path for path in paths if not path.exists()), None)
    if missing is not None:
        raise UserError(f"{missing}: no such file or folder", legal=LEGAL_FORMATS)
    odd = next((path for path in paths if not path.is_file() and not path.is_dir()), None)
    if odd is not None:
        raise UserError(f"{odd}: is neither a file nor a folder, but a device or a pipe", legal=LEGAL_FORMATS)
    asked = Asked(intrinsics, lens, frames, topic, array, pitch, raw)

    def opened(scale_m: float | None) -> Recording:
        recording = _opened(paths, scale_m, asked)
        return replace(recording, selection=frames)

    recording = opened(metres_per_unit(unit) if unit else None)
    said = Unit(recording.scale_m, f"--unit {unit}" if unit else recording.unit_from)
    if not said.origin:
        said = _unit_not_stated(recording)
        if said.scale_m != recording.scale_m:
            recording = opened(said.scale_m)
    first, given = recording.first_frame(), recording.lens
    notes, warnings = (*recording.notes, *first.notes), (*recording.warnings, said.warning)
    if isinstance(given, OtherLens):
        notes, warnings = (*notes, given.note), (*warnings, given.warning)
        recording = replace(recording, lens=given.plain)
    notes, warnings = tuple(filter(None, notes)), tuple(filter(None, warnings))
    return replace(recording, unit_from=said.origin, notes=notes, warnings=warnings)


def _unit_not_stated(recording: Recording) -> Unit:
    """The unit of a capture whose format leaves it open: of a file beside, of the named camera, or by the data of the
    first selected frame that has a distance."""
    chosen = recording.selection or slice(None)
    for frame in islice(recording.reader.frames(), chosen.start, chosen.stop, chosen.step):
        z_m = frame.z_m[np.isfinite(frame.z_m)].astype(np.float64)
        if z_m.size:
            break
    else:
        return Unit(recording.scale_m, "what is usual")
    stored, integers = z_m / recording.scale_m, recording.scale_m == UNITS_M["mm"]
    if integers:
        stored = np.rint(stored)  # float32 metres hold whole numbers to 1e-7
        for path, texts in statements_beside(recording.files):
            scale_m = scale_in(texts, float(np.median(stored)))
            if scale_m is not None:
                return Unit(scale_m, path.name)
        if isinstance(recording.lens, OtherLens) and recording.lens.unit_m:
            return Unit(recording.lens.unit_m, f"the camera of {recording.lens.mode}")
    height, width = recording.region.shape
    return decided_unit(recording.name, stored, recording.scale_m, (width, height))


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in (*BAG_SUFFIXES, ROS1_SUFFIX)
    try:
        return is_bag_folder(path)
    except OSError:
        return False


def _opened(paths: list[Path], scale_m: float | None, asked: Asked) -> Recording:
    suffixes = {path.suffix.lower() for path in paths if path.is_file()}
    if len(paths) == 1 and _is_bag(paths[0]) and asked.raw is None:
        _refuse_unused(paths[0], asked, "ROS bag")
        return open_bag(paths[0], scale_m, asked.intrinsics, asked.lens, asked.topic)
    if asked.topic is not None:
        raise UserError(f"{paths[0]}: is no ROS bag, so it has no topic {asked.topic}", fix="leave out --topic")
    if len(paths) == 1 and (asked.raw is not None or suffixes <= set(STACKS)) and paths[0].is_file():
        return _open_arrays(paths[0], scale_m, asked)
    _refuse_unused(paths[0], asked, "file of arrays")
    if len(paths) == 1 and paths[0].is_dir():
        return _open_folder(paths[0], scale_m, asked)
    if any(path.is_dir() for path in paths):
        raise UserError(f"{len(paths)} paths with folders among them", legal=LEGAL_FORMATS, fix="name one folder alone")
    if suffixes == {".png"}:
        return open_depth_list(paths, scale_m, asked.intrinsics, asked.lens)
    if len(suffixes) == 1 and suffixes <= set(CLOUDS):
        return open_clouds(paths, scale_m, _list_name(paths))
    if len(suffixes) == 1 and suffixes <= set(POINT_LISTS):
        return open_point_lists(paths, scale_m, asked.lens, _list_name(paths))
    if len(paths) > 1:
        raise UserError(f"{len(paths)} files of the kinds {', '.join(sorted(suffixes))}", legal=LEGAL_FORMATS)
    (suffix,) = suffixes
    if suffix == ".mkv":
        return open_mkv(paths[0], scale_m, asked.intrinsics, asked.lens)
    if suffix == ".r3d":
        return open_r3d(paths[0], scale_m, asked.intrinsics, asked.lens, asked.frames)
    if suffix in BARE:
        raise raw_layout_of(paths[0])
    fix = CONVERT.get(suffix, "").format(paths[0]) or None
    raise UserError(f"{paths[0]}: files of the kind '{suffix}' are not read", legal=LEGAL_FORMATS, fix=fix)


def _open_arrays(path: Path, scale_m: float | None, asked: Asked) -> Recording:
    load = RawLoader.stated(asked.raw) if asked.raw is not None else STACKS[path.suffix.lower()]
    if asked.pitch is not None:
        return open_height_map(path, load, scale_m, asked.pitch, asked.array)
    return open_stack(path, scale_m, asked.intrinsics, asked.lens, load, asked.array)


def _refuse_unused(path: Path, asked: Asked, kind: str) -> None:
    """Raise UserError for options that only files of arrays have."""
    for name in ("array", "pitch", "raw"):
        if getattr(asked, name) is not None:
            raise UserError(
                f"{path}: --{name} is for files of arrays",
                legal=f"{', '.join(STACKS)}, or bare numbers with --raw",
                fix=f"leave out --{name}" + ("" if kind == "file of arrays" else f": this is a {kind}"),
            )


def _open_folder(folder: Path, scale_m: float | None, asked: Asked) -> Recording:
    try:
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from error
    if is_stray(folder):
        return open_stray(folder, scale_m, asked.intrinsics, asked.lens, asked.frames)
    for suffix in (*CLOUDS, *POINT_LISTS[:3]):
        clouds = [path for path in inside if path.suffix.lower() == suffix]
        if clouds and suffix in CLOUDS:
            return open_clouds(clouds, scale_m, folder.name)
        if clouds:
            return open_point_lists(clouds, scale_m, asked.lens, folder.name)
    pictures = [path for path in inside if path.suffix.lower() == ".png"]
    has_arrays = any(path.suffix.lower() in STACKS for path in inside)
    if not (folder / "depth").is_dir() and (not pictures or (has_arrays and not any(map(_is_depth, pictures)))):
        raise _nothing_in(folder, inside)
    return open_depth_folder(folder, scale_m, asked.intrinsics, asked.lens)


def _is_depth(picture: Path) -> bool:
    return png_kind(picture)[2:] == (16, 0)


def _nothing_in(folder: Path, inside: list[Path]) -> UserError:
    """Of a folder that is no capture: what it holds, and which of it could be one."""
    held = ", ".join(path.name for path in inside[:HELD]) + (", .." if len(inside) > HELD else "")
    captures = [path for path in inside if _is_capture(path)]
    one = f"name {'one of ' if len(captures) > 1 else ''}{', '.join(map(str, captures[:HELD]))}" if captures else None
    what = f"no capture in it; it holds {held}" if held else "is empty"
    return UserError(f"{folder}: {what}", legal=LEGAL_FORMATS, fix=one)


def _is_capture(path: Path) -> bool:
    """Whether what lies in a folder looks like a capture of its own."""
    if path.is_file():
        return path.suffix.lower() in (*STACKS, ".mkv", ".r3d", ROS1_SUFFIX)
    return _is_bag(path) or (path / "depth").is_dir()


def _list_name(paths: list[Path]) -> str:
    return paths[0].name if len(paths) == 1 else f"{paths[0].name} .. {paths[-1].name}"
