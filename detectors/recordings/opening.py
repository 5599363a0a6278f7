"""Recognises the format of a capture, and opens it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.arrays import LOADERS, open_array_list, open_arrays, raw_layout_of
from detectors.recordings.bags import BAG_SUFFIXES, ROS1_SUFFIX, is_bag, open_bag
from detectors.recordings.clouds import CLOUDS, POINT_LISTS, open_clouds
from detectors.recordings.depth_images import (
    depth_named,
    open_depth_folder,
    open_depth_list,
    png_kind,
    shown,
)
from detectors.recordings.devices import is_stray, open_mkv, open_r3d, open_stray
from detectors.recordings.distances import (
    UNITS_M,
    Unit,
    decided_unit,
    metres_per_unit,
    ray_lengths_doubt,
    scale_in,
)
from detectors.recordings.intrinsics import GRASPNET, mappings, parsed_lens
from detectors.recordings.recording import CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import OtherLens

LEGAL_FORMATS = (
    "a folder or list of 16-bit depth .png, of .ply or .pcd, or of .xyz .txt .csv points; "
    "a folder of .npy, .tiff or .exr; a ROS bag (folder, .mcap, .db3, .bag); "
    "one .npy, .npz, .mat, .tiff, .exr, .pfm, .mkv or .r3d file; a Stray Scanner folder; "
    "with --pitch a height map; with --raw a file of bare numbers"
)
Opener = Callable[[Path, CaptureOptions], Recording]
ListOpener = Callable[[Sequence[Path], CaptureOptions, str], Recording]
FILES: dict[str, Opener] = {
    ".mkv": open_mkv,
    ".r3d": open_r3d,
    **dict.fromkeys(LOADERS, open_arrays),
    **dict.fromkeys((*BAG_SUFFIXES, ROS1_SUFFIX), open_bag),
}
"""File suffixes for which one file is a capture, and the function that opens it."""
LISTS: dict[str, ListOpener] = {
    ".png": open_depth_list,
    **dict.fromkeys((*CLOUDS, *POINT_LISTS), open_clouds),
}
"""File suffixes for which several files with the same suffix form one capture."""
SAVE = "python -c \"import numpy, {}; numpy.save('depth.npy', {})\", then name depth.npy"
PICTURE = SAVE.format("cv2", "cv2.imread('FILE', -1)")
HDF5 = SAVE.format("h5py", "h5py.File('FILE')['NAME'][:]")
CONVERT = {
    ".pgm": PICTURE,
    ".h5": HDF5,
    ".hdf5": HDF5,
    **dict.fromkeys(
        (".e57", ".las", ".laz", ".pcap", ".obj", ".stl", ".off"), "export its points as PLY"
    ),
}  # commands that convert unsupported files
HELD = 6  # most names of a folder's contents in a message


def open_capture(paths: Sequence[Path], *, unit: str | None = None, **statements: Any) -> Recording:
    """Open a real capture as a source of frames; its first frame is read and checked. ``unit``: of
    the stored distances (mm, m, cm, um, tum, N/m), if the format's usual unit is wrong. The other
    ``statements`` are the fields of `recording.CaptureOptions`. Raises UserError for every fault of
    the files."""
    paths = [Path(path) for path in paths]
    _refuse_absent(paths)
    options = CaptureOptions(metres_per_unit(unit) if unit else None, **statements)
    recording = replace(_opened(paths, options), selection=options.frames)
    stated = Unit(recording.scale_m, f"--unit {unit}" if unit else recording.unit_from)
    if not stated.origin:
        stated = _unit_not_stated(recording)
        if stated.scale_m != recording.scale_m:
            recording = _opened(paths, replace(options, scale_m=stated.scale_m))
            recording = replace(recording, selection=options.frames)
    notes = list(recording.notes)
    warnings = [*recording.warnings, stated.warning]
    first, *second = islice(recording.frames(), 2)
    notes += first.notes
    if second and np.array_equal(first.z_m, second[0].z_m, equal_nan=True):
        warnings.append(
            "the first two frames are equal: repeated frames do not lower noise, "
            "but are counted as if they did"
        )
    if recording.slopes is not None and first.xy_m is None:
        warnings.append(ray_lengths_doubt(first.z_m, recording.slopes))
    lens = recording.lens
    if isinstance(lens, OtherLens):
        notes.append(lens.note)
        warnings.append(lens.warning)
        lens = lens.plain
    return replace(
        recording,
        lens=lens,
        unit_from=stated.origin,
        notes=tuple(filter(None, notes)),
        warnings=tuple(filter(None, warnings)),
    )


def _refuse_absent(paths: Sequence[Path]) -> None:
    """Raise UserError unless there are paths and each is a file or a folder."""
    if not paths:
        raise UserError("no capture is named", legal=LEGAL_FORMATS)
    for path in paths:
        if not path.is_file() and not path.is_dir():
            problem = "no such file or folder"
            if path.exists():
                problem = "is neither a file nor a folder, but a device or a pipe"
            raise UserError(f"{path}: {problem}", legal=LEGAL_FORMATS)


def _unit_not_stated(recording: Recording) -> Unit:
    """Return a unit that the format leaves open: from a file beside the capture, the named camera,
    or the data."""
    for frame in recording.selected():
        z_m = frame.z_m[np.isfinite(frame.z_m)].astype(np.float64)
        if z_m.size:
            break
    else:
        return Unit(recording.scale_m, "what is usual")
    stored = z_m / recording.scale_m
    if recording.scale_m == UNITS_M["mm"]:
        stored = np.rint(stored)  # float32 metres hold whole numbers to 1e-7
        for path, texts in _statements_beside(recording.files):
            scale_m = scale_in(texts, float(np.median(stored)))
            if scale_m is not None:
                return Unit(scale_m, path.name)
        if isinstance(recording.lens, OtherLens) and recording.lens.unit_m:
            return Unit(recording.lens.unit_m, f"the camera of {recording.lens.mode}")
    return decided_unit(recording.name, stored, recording.scale_m, recording.shape[::-1])


def _statements_beside(files: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the names and values in the JSON, YAML and lens files in and above the folder of a
    capture's first file."""
    folders = (files[0].parent, files[0].parent.parent) if files else ()
    for folder in dict.fromkeys(folders):
        beside: list[Path] = []
        for ending in ("json", "yaml", "yml"):
            beside += sorted(folder.glob(f"*.{ending}"))
        for pattern in GRASPNET:
            beside += sorted(folder.glob(pattern))[:1]
        for path in beside[:20]:
            try:
                for _, mapping in mappings(parsed_lens(path)):
                    yield path, mapping
            except UserError:
                continue


def _opened(paths: list[Path], options: CaptureOptions) -> Recording:
    """Open a capture by the first format that its paths fit."""
    path = paths[0]
    is_single = len(paths) == 1
    suffixes = sorted({file.suffix.lower() for file in paths})
    opener = _opener_of(path, options) if is_single else None
    _refuse_unused(path, options, opener)
    if opener is not None:
        return opener(path, options)
    if any(file.is_dir() for file in paths):
        problem = f"{len(paths)} paths that include folders"
        raise UserError(problem, legal=LEGAL_FORMATS, fix="name one folder alone")
    suffix = suffixes[0]
    if suffix in LISTS and len(suffixes) == 1:
        name = path.name if is_single else f"{path.name} .. {paths[-1].name}"
        return LISTS[suffix](paths, options, name)
    if not is_single:
        problem = f"{len(paths)} files of the kinds {', '.join(suffixes)}"
        raise UserError(problem, legal=LEGAL_FORMATS)
    if suffix in (".bin", ".raw", ".dat"):
        raise raw_layout_of(path)
    problem = f"{path}: files of the type '{suffix}' are not read"
    raise UserError(problem, legal=LEGAL_FORMATS, fix=_conversion_of(path))


def _conversion_of(path: Path) -> str | None:
    """Return how a file of a type that is not read becomes one that is; None if that is unknown."""
    return CONVERT.get(path.suffix.lower(), "").replace("FILE", str(path)) or None


def _opener_of(path: Path, options: CaptureOptions) -> Opener | None:
    """Return the function that opens a path as a capture, None if its type does not tell."""
    if path.is_dir():
        return open_bag if is_bag(path) and options.raw is None else _open_folder
    if options.raw is not None:
        return open_arrays
    return FILES.get(path.suffix.lower())


def _refuse_unused(path: Path, options: CaptureOptions, opener: Opener | None) -> None:
    """Raise UserError if an option is stated that is not for this kind of capture."""
    if options.topic is not None and opener is not open_bag:
        problem = f"{path}: is not a ROS bag, so it has no topic {options.topic}"
        raise UserError(problem, fix="leave out --topic")
    for name in ("array", "pitch", "raw"):
        if getattr(options, name) is not None and opener is not open_arrays:
            raise UserError(
                f"{path}: --{name} is for files of arrays",
                legal=f"{', '.join(LOADERS)}, or bare numbers with --raw",
                fix=f"leave out --{name}",
            )


def _open_folder(folder: Path, options: CaptureOptions) -> Recording:
    """Open a folder as the first kind of capture that it holds."""
    with read_errors(f"{folder}: cannot be read", LEGAL_FORMATS, "check its permissions"):
        inside = shown(folder)
    if is_stray(folder):
        return open_stray(folder, options)
    pictures = [path for path in inside if path.suffix.lower() == ".png"]
    arrays = [path for path in inside if path.suffix.lower() in LOADERS]
    for suffix in (*CLOUDS, *POINT_LISTS[:3]):
        clouds = [path for path in inside if path.suffix.lower() == suffix]
        if clouds:
            recording = open_clouds(clouds, options, folder.name)
            ignored = len(pictures) + len(arrays)
            note = ""
            if ignored:
                note = f"{ignored} pictures or arrays beside the {suffix} files are ignored"
            return replace(recording, notes=(*recording.notes, note))
    is_depth = bool(pictures)
    if pictures and arrays:
        is_depth = any(png_kind(path)[2:] == (16, 0) for path in pictures)
    inner = folder / "depth"
    if is_depth:
        return open_depth_folder(folder, options)
    if inner.is_dir():
        has_pictures = any(path.suffix.lower() == ".png" for path in inner.iterdir())
        if has_pictures:
            return open_depth_folder(folder, options)
        return _open_folder(inner, options)
    frames = depth_named(arrays, arrays)
    if len(frames) > 1 and len({path.suffix.lower() for path in frames}) == 1:
        return open_array_list(frames, options, folder.name)
    raise _no_capture(folder, inside)


def _no_capture(folder: Path, inside: Sequence[Path]) -> UserError:
    """Return the error for a folder that is not a capture, with the captures inside."""
    problem = f"{folder}: is empty"
    if inside:
        names = ", ".join(path.name for path in inside[:HELD])
        ellipsis = ", .." if len(inside) > HELD else ""
        problem = f"{folder}: contains no capture; it holds {names}{ellipsis}"
    captures = [str(path) for path in inside if _may_be_capture(path)]
    fix = None
    if captures:
        several = "one of " if len(captures) > 1 else ""
        fix = f"name {several}{', '.join(captures[:HELD])}"
    else:
        fix = next(filter(None, map(_conversion_of, inside)), None)
    return UserError(problem, legal=LEGAL_FORMATS, fix=fix)


def _may_be_capture(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in FILES
    return is_bag(path) or (path / "depth").is_dir()
