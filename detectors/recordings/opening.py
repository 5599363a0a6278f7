"""Recognise a capture by what it is, and open it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from detectors.recordings.arrays import load_npy, load_npz, open_stack
from detectors.recordings.azure_mkv import open_mkv
from detectors.recordings.bag_files import BAG_SUFFIXES, ROS1_SUFFIX, is_bag_folder
from detectors.recordings.bags import open_bag
from detectors.recordings.depth_images import open_depth_folder, open_depth_list
from detectors.recordings.distances import UNITS_M, Unit, decided_unit, metres_per_unit
from detectors.recordings.matlab import load_mat
from detectors.recordings.pointclouds import open_clouds
from detectors.recordings.recording import Recording
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens

STACKS = {".npy": load_npy, ".npz": load_npz, ".mat": load_mat}
CLOUDS = (".ply", ".pcd")
HELD = 6
"""Names of a folder's contents that a message lists."""
LEGAL_FORMATS = (
    "a folder or list of 16-bit depth .png, a folder or list of .ply or .pcd, a ROS bag (folder, .mcap, .db3, "
    ".bag), or one .npy, .npz, .mat or .mkv file"
)


def open_capture(
    paths: Sequence[Path],
    *,
    unit: str | None = None,
    intrinsics: Path | None = None,
    lens: Lens | None = None,
    frames: slice | None = None,
    topic: str | None = None,
) -> Recording:
    """Open a real capture as a source of frames; its first frame is read and checked.

    ``unit`` of the stored distances (mm, m, cm, um, tum, N/m) where the format's usual one is wrong. ``intrinsics``: a
    file with the depth pixels' lens, which counts before one found beside the frames or attached to them; ``lens`` the
    same as a value. ``frames`` selects frames by number. ``topic``: of a ROS bag the topic with the depth images or
    clouds, where several have some. Raises UserError for every fault of the files.
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

    def opened(scale_m: float | None) -> Recording:
        if len(paths) == 1 and _is_bag(paths[0]):
            recording = open_bag(paths[0], scale_m, intrinsics, lens, topic)
        elif topic is not None:
            raise UserError(f"{paths[0]}: is no ROS bag, so it has no topic {topic}", fix="leave out --topic")
        else:
            recording = _open_files(paths, scale_m, intrinsics, lens)
        return replace(recording, selection=frames)

    recording = opened(metres_per_unit(unit) if unit else None)
    said = Unit(recording.scale_m, f"--unit {unit}" if unit else recording.unit_from)
    if not said.origin:
        said = _unit_by_data(recording)
        if said.scale_m != recording.scale_m:
            recording = opened(said.scale_m)
    first = recording.first_frame()
    return replace(
        recording,
        unit_from=said.origin,
        notes=(*recording.notes, *first.notes),
        warnings=(*recording.warnings, *((said.warning,) if said.warning else ())),
    )


def _unit_by_data(recording: Recording) -> Unit:
    """The unit of a capture whose files do not state it, by the first selected frame that has a distance."""
    chosen = recording.selection or slice(None)
    for frame in islice(recording.reader.frames(), chosen.start, chosen.stop, chosen.step):
        z_m = frame.z_m[np.isfinite(frame.z_m)].astype(np.float64)
        if z_m.size:
            stored = z_m / recording.scale_m
            # Back to whole numbers what float32 metres hold to 1e-7.
            stored = np.rint(stored) if recording.scale_m == UNITS_M["mm"] else stored
            height, width = recording.region.shape
            return decided_unit(recording.name, stored, recording.scale_m, (width, height))
    return Unit(recording.scale_m, "what is usual")


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in (*BAG_SUFFIXES, ROS1_SUFFIX)
    try:
        return is_bag_folder(path)
    except OSError:
        return False


def _open_files(paths: list[Path], scale_m: float | None, intrinsics: Path | None, lens: Lens | None) -> Recording:
    suffixes = {path.suffix.lower() for path in paths if path.is_file()}
    if len(paths) == 1 and paths[0].is_dir():
        return _open_folder(paths[0], scale_m, intrinsics, lens)
    if any(path.is_dir() for path in paths):
        raise UserError(f"{len(paths)} paths with folders among them", legal=LEGAL_FORMATS, fix="name one folder alone")
    if suffixes == {".png"}:
        return open_depth_list(paths, scale_m, intrinsics, lens)
    if len(suffixes) == 1 and suffixes <= set(CLOUDS):
        return open_clouds(paths, scale_m, _list_name(paths))
    if len(paths) > 1:
        raise UserError(f"{len(paths)} files of the kinds {', '.join(sorted(suffixes))}", legal=LEGAL_FORMATS)
    (suffix,) = suffixes
    if suffix in STACKS:
        return open_stack(paths[0], scale_m, intrinsics, lens, STACKS[suffix])
    if suffix == ".mkv":
        return open_mkv(paths[0], scale_m, intrinsics, lens)
    raise UserError(f"{paths[0]}: files of the kind '{suffix}' are not read", legal=LEGAL_FORMATS)


def _open_folder(folder: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None) -> Recording:
    try:
        inside = sorted(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from error
    for suffix in CLOUDS:
        clouds = [path for path in inside if path.suffix.lower() == suffix]
        if clouds:
            return open_clouds(clouds, scale_m, folder.name)
    if not (folder / "depth").is_dir() and not any(path.suffix.lower() == ".png" for path in inside):
        raise _nothing_in(folder, inside)
    return open_depth_folder(folder, scale_m, intrinsics, lens)


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
        return path.suffix.lower() in (*STACKS, ".mkv")
    return _is_bag(path) or (path / "depth").is_dir()


def _list_name(paths: list[Path]) -> str:
    return paths[0].name if len(paths) == 1 else f"{paths[0].name} .. {paths[-1].name}"
