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
from detectors.recordings.intrinsics import mappings, parsed_lens
from detectors.recordings.recording import CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import OtherLens

LEGAL_FORMATS = (
    "a folder or list of 16-bit depth .png, of .ply or .pcd, or of .xyz .txt .csv points; a folder of .npy or .tiff;"
    " a ROS bag (folder, .mcap, .db3, .bag); one .npy, .npz, .mat, .tiff, .pfm, .mkv or .r3d file; a Stray Scanner"
    " folder; with --pitch a height map; with --raw a file of bare numbers"
)
FILES = {".mkv": open_mkv, ".r3d": open_r3d, **dict.fromkeys(LOADERS, open_arrays)}
FILES |= dict.fromkeys((*BAG_SUFFIXES, ROS1_SUFFIX), open_bag)
"""File suffixes for which one file is a capture, and the function that opens it."""
ListOpener = Callable[[Sequence[Path], CaptureOptions, str], Recording]
LISTS: dict[str, ListOpener] = {
    ".png": open_depth_list,
    **dict.fromkeys((*CLOUDS, *POINT_LISTS), open_clouds),
}
"""File suffixes for which several files with the same suffix form one capture."""
SAVE = "python -c \"import numpy, {}; numpy.save('depth.npy', {})\", then name depth.npy"
PICTURE = SAVE.format("cv2", "cv2.imread('FILE', -1)")
HDF5 = SAVE.format("h5py", "h5py.File('FILE')['NAME'][:]")
CONVERT = {
    **{".exr": f"OPENCV_IO_ENABLE_OPENEXR=1 {PICTURE}", ".pgm": PICTURE},
    **dict.fromkeys((".h5", ".hdf5"), HDF5),
    **dict.fromkeys(
        (".e57", ".las", ".laz", ".pcap", ".obj", ".stl", ".off"), "export its points as PLY"
    ),
}  # commands that convert unsupported files
HELD = 6  # most names of a folder's contents in a message


def open_capture(paths: Sequence[Path], *, unit: str | None = None, **statements: Any) -> Recording:
    """Open a real capture as a source of frames; its first frame is read and checked. ``unit``: of
    the stored distances (mm, m, cm, um, tum, N/m), if the format's usual unit is wrong. The other
    ``statements`` are the fields of `recording.CaptureOptions`. Raises UserError for every fault of the
    files."""
    paths = [Path(path) for path in paths]
    if not paths:
        raise UserError("no capture is named", legal=LEGAL_FORMATS)
    for path in paths:
        if not path.is_file() and not path.is_dir():
            odd = path.exists() and "is neither a file nor a folder, but a device or a pipe"
            raise UserError(f"{path}: {odd or 'no such file or folder'}", legal=LEGAL_FORMATS)
    options = CaptureOptions(metres_per_unit(unit) if unit else None, **statements)
    recording = replace(_opened(paths, options), selection=options.frames)
    stated = Unit(recording.scale_m, f"--unit {unit}" if unit else recording.unit_from)
    if not stated.origin:
        stated = _unit_not_stated(recording)
        if stated.scale_m != recording.scale_m:
            recording = replace(
                _opened(paths, replace(options, scale_m=stated.scale_m)), selection=options.frames
            )
    first, *second = islice(recording.frames(), 2)
    lens = recording.lens
    doubts = [stated.warning]
    if second and np.array_equal(first.z_m, second[0].z_m, equal_nan=True):
        doubts += [
            "the first two frames are equal: repeated frames do not lower noise, but are counted as if they did"
        ]
    if recording.slopes is not None and first.xy_m is None:
        doubts += [ray_lengths_doubt(first.z_m, recording.slopes)]
    notes = [*recording.notes, *first.notes]
    warnings = [*recording.warnings, *doubts]
    if isinstance(lens, OtherLens):
        notes = [*notes, lens.note]
        warnings = [*warnings, lens.warning]
        recording = replace(recording, lens=lens.plain)
    notes = list(filter(None, notes))
    warnings = list(filter(None, warnings))
    return replace(recording, unit_from=stated.origin, notes=tuple(notes), warnings=tuple(warnings))


def _unit_not_stated(recording: Recording) -> Unit:
    """Return a unit that the format leaves open: from a file beside the capture, the named camera,
    or the data."""
    frames_m = (
        frame.z_m[np.isfinite(frame.z_m)].astype(np.float64) for frame in recording.selected()
    )
    z_m = next((frame_m for frame_m in frames_m if frame_m.size), None)
    if z_m is None:
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
    """Yield the names and values in the JSON and YAML files in and above the folder of a capture's
    first file."""
    for folder in dict.fromkeys((files[0].parent, files[0].parent.parent) if files else ()):
        beside = (
            path for end in ("json", "yaml", "yml") for path in sorted(folder.glob(f"*.{end}"))
        )
        for path in islice(beside, 20):
            try:
                yield from ((path, mapping) for _, mapping in mappings(parsed_lens(path)))
            except UserError:
                continue


def _opened(paths: list[Path], options: CaptureOptions) -> Recording:
    """Open a capture by the first format that its paths fit."""
    path = paths[0]
    is_single = len(paths) == 1
    suffix, *other_suffixes = {file.suffix.lower() for file in paths}
    opener: Callable[[Path, CaptureOptions], Recording] | None = (
        FILES.get(suffix) if is_single else None
    )
    if is_single and path.is_dir():
        opener = open_bag if is_bag(path) and options.raw is None else _open_folder
    elif is_single and options.raw is not None:
        opener = open_arrays
    if options.topic is not None and opener is not open_bag:
        raise UserError(
            f"{path}: is not a ROS bag, so it has no topic {options.topic}", fix="leave out --topic"
        )
    unused = next(
        (name for name in ("array", "pitch", "raw") if getattr(options, name) is not None), None
    )
    if unused and opener is not open_arrays:
        legal = f"{', '.join(LOADERS)}, or bare numbers with --raw"
        raise UserError(
            f"{path}: --{unused} is for files of arrays", legal=legal, fix=f"leave out --{unused}"
        )
    if opener is not None:
        return opener(path, options)
    if any(file.is_dir() for file in paths):
        raise UserError(
            f"{len(paths)} paths that include folders",
            legal=LEGAL_FORMATS,
            fix="name one folder alone",
        )
    if suffix in LISTS and not other_suffixes:
        return LISTS[suffix](
            paths, options, path.name if is_single else f"{path.name} .. {paths[-1].name}"
        )
    if not is_single:
        raise UserError(
            f"{len(paths)} files of the kinds {', '.join(sorted((suffix, *other_suffixes)))}",
            legal=LEGAL_FORMATS,
        )
    if suffix in (".bin", ".raw", ".dat"):
        raise raw_layout_of(path)
    fix = CONVERT.get(suffix, "").replace("FILE", str(path)) or None
    raise UserError(
        f"{path}: files of the type '{suffix}' are not read", legal=LEGAL_FORMATS, fix=fix
    )


def _open_folder(folder: Path, options: CaptureOptions) -> Recording:
    with read_errors(f"{folder}: cannot be read", LEGAL_FORMATS, "check its permissions"):
        inside = shown(folder)
    if is_stray(folder):
        return open_stray(folder, options)
    for suffix in (*CLOUDS, *POINT_LISTS[:3]):
        clouds = [path for path in inside if path.suffix.lower() == suffix]
        if clouds:
            recording = open_clouds(clouds, options, folder.name)
            beside = sum(path.suffix.lower() in (".png", *LOADERS) for path in inside)
            note = (
                f"{beside} pictures or arrays beside the {suffix} files are ignored"
                if beside
                else ""
            )
            return replace(recording, notes=(*recording.notes, note))
    pictures = [path for path in inside if path.suffix.lower() == ".png"]
    arrays = [path for path in inside if path.suffix.lower() in LOADERS]
    is_depth = bool(pictures) and (
        not arrays or any(png_kind(path)[2:] == (16, 0) for path in pictures)
    )
    inner = folder / "depth"
    if (
        inner.is_dir()
        and not is_depth
        and not any(path.suffix.lower() == ".png" for path in inner.iterdir())
    ):
        return _open_folder(inner, options)
    if is_depth or inner.is_dir():
        return open_depth_folder(folder, options)
    frames = depth_named(arrays, arrays)
    if len(frames) > 1 and len({path.suffix.lower() for path in frames}) == 1:
        return open_array_list(frames, options, folder.name)
    contents = ", ".join(path.name for path in inside[:HELD]) + (
        ", .." if len(inside) > HELD else ""
    )
    is_capture = (
        p.suffix.lower() in FILES if p.is_file() else is_bag(p) or (p / "depth").is_dir()
        for p in inside
    )
    captures = [path for path, is_known in zip(inside, is_capture, strict=True) if is_known]
    problem = f"contains no capture; it holds {contents}" if contents else "is empty"
    fix = (
        f"name {'one of ' * (len(captures) > 1)}{', '.join(map(str, captures[:HELD]))}"
        if captures
        else None
    )
    raise UserError(f"{folder}: {problem}", legal=LEGAL_FORMATS, fix=fix)
