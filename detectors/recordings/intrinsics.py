"""The lens of a capture from a file: plain JSON, Open3D, OpenCV, ROS camera_info, or an Azure Kinect calibration."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from detectors.recordings.azure_calibration import depth_lens, depth_mode_of_size, parse_calibration
from detectors.recordings.pictures import png_texts
from detectors.recordings.recording import Asked
from harness.vocabulary.declaration.problems import DeclarationError
from harness.vocabulary.declaration.yaml_source import MAX_BYTES, parse_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.lens import Lens, OtherLens
from harness.vocabulary.limits import PICTURE_BYTES, TEXT_BYTES, bounded_bytes, refuse_bytes

LEGAL_LENS = (
    "JSON or YAML with fx, fy, cx, cy in pixels [distortion: k1 k2 p1 p2 k3 k4 k5 k6]; Open3D's intrinsic.json; "
    "OpenCV's or ROS' camera_info YAML; an Azure Kinect's calibration.json"
)
FOUND_BESIDE = (
    *("intrinsic", "intrinsics", "camera_intrinsic", "camera_intrinsics", "camera", "camera_info", "calibration"),
    "rtabmap_calib",
)
"""Stems of the files that are taken for the lens of the frames beside or below them."""
DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
BESIDE = 20
"""Files beside a capture that are asked for its unit."""
SHOWN_KEYS = 20
LARGEST = 1e12
"""Largest number that a lens may state, in any unit."""
KNOWN_MODELS = ("", "none", "pinhole", "plumb_bob", "brown_conrady", "rational_polynomial")

Own = Callable[[], tuple[Lens | None, Path | None]]
"""Finds the lens that comes with a capture, and the file that it was read from, where it has one of its own."""


def lens_for(
    name: str, asked: Asked, width: int, height: int, own: Own, hint: str = ""
) -> tuple[Lens, tuple[Path, ...]]:
    """Return the lens of depth images and the files that state it: --intrinsics, the named camera's, or ``own``.

    Raises UserError where nobody states a lens (``hint`` ends its advice), or the one stated is of other images.
    """
    lens, file = asked.lens, asked.intrinsics
    if file is not None:
        lens = read_lens(file, width, height)
    elif lens is None:
        lens, file = own()
    if lens is None:
        raise UserError(
            f"{name}: nothing says which lens took these depth images, and without it they are no points",
            legal=LEGAL_LENS,
            fix="pass --intrinsics FILE, or the name of a camera whose nominal lens is good enough" + hint,
        )
    files = (file,) if file else ()
    modes = (lens, *lens.others) if isinstance(lens, OtherLens) else (lens,)
    found = next((mode for mode in modes if (mode.width, mode.height) == (width, height)), None)
    if found is not None:
        return found, files
    known = [f"{mode.mode} {mode.width} x {mode.height}" for mode in modes[1:] if isinstance(mode, OtherLens)]
    raise UserError(
        f"{name}: depth images of {width} x {height} pixels, but the lens is of {lens.width} x {lens.height}",
        legal=f"the modes of this camera: {', '.join(known)}" if known else None,
        fix="pass --intrinsics FILE with the lens of these images"
        + (" (of the colour camera, where the depth was aligned to it)" if known else ""),
    )


def lens_beside(folders: Sequence[Path], width: int, height: int) -> tuple[Lens | None, Path | None]:
    """Read the first file in ``folders`` that is named like a lens. Raises UserError as `read_lens` does."""
    for folder in folders:
        for path in (folder / f"{stem}{suffix}" for stem in FOUND_BESIDE for suffix in (".json", ".yaml", ".yml")):
            if path.is_file():
                return read_lens(path, width, height), path
    return None, None


def statements_beside(files: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the names and values in the JSON and YAML files in and above the folder of a capture's first file, and the
    text in that file where it is a PNG. Files that cannot be read are passed over: they may belong to something else.
    """
    folders = dict.fromkeys((files[0].parent, files[0].parent.parent) if files else ())
    if files and files[0].suffix.lower() == ".png":
        yield files[0], png_texts(bounded_bytes(files[0], PICTURE_BYTES))
    for folder in folders:
        beside = (path for end in ("json", "yaml", "yml") for path in sorted(folder.glob(f"*.{end}")))
        for path in islice(beside, BESIDE):
            try:
                yield path, _parsed(path)
            except UserError:
                continue


def read_lens(path: Path, width: int, height: int) -> Lens:
    """Return the lens in a file, for images of ``width`` x ``height``.

    Raises UserError where the file is missing, unreadable, of another image size, or of a lens model that is not known.
    """
    data = _parsed(path)
    if "CalibrationInformation" in data:
        mode = depth_mode_of_size(width, height)
        if mode is None:
            raise UserError(f"{path}: no depth mode of an Azure Kinect has {width} x {height} pixels", legal=LEGAL_LENS)
        return depth_lens(str(path), parse_calibration(str(path), bounded_bytes(path, TEXT_BYTES)), mode)
    data = data.get("intrinsic", data) if isinstance(data.get("intrinsic"), dict) else data
    stated = None
    for keys in (("width", "height"), ("image_width", "image_height"), ("width_px", "height_px")):
        if stated is None and all(key in data for key in keys):
            if not all(isinstance(data[key], int) for key in keys):
                raise UserError(f"{path}: the lens' width and height are no whole numbers", legal=LEGAL_LENS)
            stated = data[keys[0]], data[keys[1]]
    if stated is not None and stated != (width, height) and stated[0] * height != stated[1] * width:
        raise UserError(
            f"{path}: is for images of {stated[0]} x {stated[1]} pixels, but the depth images have {width} x {height}",
            fix="give the lens of the depth images themselves (or of the colour camera that they are aligned to)",
        )
    fx, fy, cx, cy = _focal_and_centre(path, data)
    side = stated[0] / width if stated else 1.0
    fx, fy, cx, cy = fx / side, fy / side, (cx + 0.5) / side - 0.5, (cy + 0.5) / side - 0.5
    # no lens of these images has a mirrored or normalised focal length, or a centre far outside
    if not (0.1 * width < fx < 100 * width and 0.1 * width < fy < 100 * width):
        raise UserError(
            f"{path}: focal length fx = {fx:g}, fy = {fy:g} for an image {width} pixels wide",
            legal=f"pixels, {0.1 * width:g} to {100 * width:g}",
            fix="multiply a normalised focal length by the image's width",
        )
    if not (-width < cx < 2 * width and -height < cy < 2 * height):
        raise UserError(
            f"{path}: principal point cx = {cx:g}, cy = {cy:g} for {width} x {height} pixels",
            legal="pixels from the centre of the first one, near the image's centre",
        )
    distortion = _distortion(path, data)
    if stated in (None, (width, height)):
        return Lens(width, height, fx, fy, cx, cy, distortion)
    warning = (
        f"{path.name} is the lens of images of {stated[0]} x {stated[1]} pixels; it is scaled to {width} x {height},"
        " which is right unless the smaller image is cut out of the larger"
    )
    return OtherLens(width, height, fx, fy, cx, cy, distortion, warning=warning)


def _parsed(path: Path) -> dict[str, Any]:
    """Return the file's mapping. Raises UserError on what is no JSON or YAML, and on a key given twice."""
    try:
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        if text.lstrip().startswith("{"):
            data = strict_json(text, nan=True)  # `_number` names the key that is no number
        else:
            refuse_bytes(str(path), len(text), MAX_BYTES)
            # OpenCV's first line, "%YAML:1.0", is no directive of YAML; its matrices are plain mappings under a tag
            body = "\n".join("" if line.startswith("%YAML") else line for line in text.splitlines())
            data = parse_yaml(body.replace("!!opencv-matrix", " " * 15), str(path)).data
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such file", legal=LEGAL_LENS) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error})", legal=LEGAL_LENS) from error
    except json.JSONDecodeError as error:
        raise UserError(f"{path}:{error.lineno}:{error.colno}: {error.msg}", legal=LEGAL_LENS) from error
    except DeclarationError as error:
        first = error.problems[0]
        where = first.place.head if first.place else str(path)
        raise UserError(f"{where}: {first.message}", legal=LEGAL_LENS) from error
    except ValueError as error:
        raise UserError(f"{path}: {error}", legal=LEGAL_LENS) from error
    if not isinstance(data, dict):
        raise UserError(f"{path}: holds no names with values", legal=LEGAL_LENS)
    return data


def _focal_and_centre(path: Path, data: dict[str, Any]) -> tuple[float, ...]:
    """Return fx, fy, cx, cy from whichever of the known forms the file has."""
    if all(key in data for key in ("fx", "fy", "cx", "cy")):
        return tuple(_number(path, key, data[key]) for key in ("fx", "fy", "cx", "cy"))
    if "intrinsic_matrix" in data:  # Open3D: column by column
        m = _numbers(path, "intrinsic_matrix", data["intrinsic_matrix"], 9)
        return m[0], m[4], m[6], m[7]
    for key in ("camera_matrix", "K", "k"):  # OpenCV and ROS: row by row
        if key in data:
            m = _numbers(path, key, data[key], 9)
            return m[0], m[4], m[2], m[5]
    keys = ", ".join(str(key)[:40] for key in list(data)[:SHOWN_KEYS]) + (", .." if len(data) > SHOWN_KEYS else "")
    raise UserError(f"{path}: holds no lens (its keys: {keys or 'none'})", legal=LEGAL_LENS)


def _distortion(path: Path, data: dict[str, Any]) -> tuple[float, ...]:
    """Return OpenCV's eight coefficients; absent ones are 0. Raises UserError for other models."""
    model = str(data.get("distortion_model", ""))
    if model.lower() not in KNOWN_MODELS:
        raise UserError(f"{path}: distortion model {model} is not known", legal=", ".join(KNOWN_MODELS[1:]))
    key = next((k for k in ("distortion", "distortion_coefficients", "D", "d") if k in data), None)
    if key is None:
        return (0.0,) * 8
    if isinstance(data[key], dict) and "data" not in data[key]:
        unknown = set(data[key]) - set(DISTORTION_NAMES)
        if unknown:
            raise UserError(
                f"{path}: {key} has {', '.join(sorted(map(str, unknown)))}", legal=", ".join(DISTORTION_NAMES)
            )
        return tuple(_number(path, f"{key}.{name}", data[key].get(name, 0.0)) for name in DISTORTION_NAMES)
    numbers = _numbers(path, key, data[key], None)
    if len(numbers) not in (0, 4, 5, 8, 12, 14) or any(numbers[8:]):
        raise UserError(
            f"{path}: {key} has {len(numbers)} numbers",
            legal="0, 4, 5 or 8 in OpenCV's order k1 k2 p1 p2 k3 .. k6; no thin prism, no tilt",
        )
    return (numbers + (0.0,) * 8)[:8]


def _numbers(path: Path, key: str, value: Any, count: int | None) -> tuple[float, ...]:
    """Return the numbers of a flat list, a list of rows, or an OpenCV matrix (``data``)."""
    value = value.get("data") if isinstance(value, dict) else value
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [x for row in value for x in row]
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise UserError(f"{path}: {key} is no list of {count or ''} numbers".replace("  ", " "), legal=LEGAL_LENS)
    return tuple(_number(path, key, x) for x in value)


def _number(path: Path, key: str, value: Any) -> float:
    # Python's integers have no largest one, and lists may be endless to print.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        shown = repr(value)[:40] if isinstance(value, str | bool | float | None) else type(value).__name__
        raise UserError(f"{path}: {key} is {shown}", legal=f"a number within {LARGEST:g}")
    return float(value)
