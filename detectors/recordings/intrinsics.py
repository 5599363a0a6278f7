"""The lens of a capture from a file: JSON or YAML of many programs, bare matrices, GraspNet's
meta.mat, an Azure Kinect's calibration."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detectors.recordings.recording import CaptureOptions, read_errors
from harness.vocabulary.declaration.yaml_source import MAX_BYTES, DeclarationError, parse_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, refuse_bytes, strict_json
from harness.vocabulary.geometry import Lens, OtherLens

Mode = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""A readout of the sensor: the binned sensor, the crop's offset in it, and the image; (x, y) in
pixels."""
DEPTH_MODES: dict[str, Mode] = {
    "NFOV_2X2BINNED": ((512, 512), (96, 90), (320, 288)),
    "NFOV_UNBINNED": ((1024, 1024), (192, 180), (640, 576)),
    "WFOV_2X2BINNED": ((512, 512), (0, 0), (512, 512)),
    "WFOV_UNBINNED": ((1024, 1024), (0, 0), (1024, 1024)),
}
COLOUR_SIZES = ((1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072))
MODEL = "CALIBRATION_LensDistortionModelBrownConrady"
OWN_LENS = "record again, or give a lens with --intrinsics FILE"


class ColourCamera(NamedTuple):
    """The colour camera beside the depth camera."""

    lens: Lens
    # maps points (metres) from the depth camera's frame to its own (4, 4)
    T_colour_depth: np.ndarray


def parse_calibration(name: str, content: bytes) -> dict[str, Any]:
    """Parse the calibration's JSON (a trailing zero byte is the recorder's). Raises UserError for
    any other content."""
    refuse_bytes(name, len(content), TEXT_BYTES)
    legal = "the JSON that k4arecorder attaches: CalibrationInformation with its Cameras"
    with read_errors(f"{name}: is not an Azure Kinect calibration", legal, OWN_LENS):
        cameras = strict_json(content.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        return {
            camera["Purpose"].removeprefix("CALIBRATION_CameraPurpose"): camera
            for camera in cameras
        }


def depth_lens(name: str, cameras: dict[str, Any], mode: str) -> Lens:
    """Return the lens of a depth mode such as ``NFOV_UNBINNED``. Raises UserError for another mode
    or a bad file."""
    if mode not in DEPTH_MODES:
        legal = ", ".join(DEPTH_MODES)
        raise UserError(f"{name}: depth mode {mode} has no depth image", legal=legal)
    camera, numbers = _camera(name, cameras, "Depth")
    if (camera["SensorWidth"], camera["SensorHeight"]) != (1024, 1024):
        raise UserError(
            f"{name}: the calibrated sensor is not 1024 x 1024, as an Azure Kinect's is"
        )
    return _lens(name, numbers, DEPTH_MODES[mode])


def depth_mode_of_size(width: int, height: int) -> str | None:
    """Return the depth mode whose image has this size, None if there is none."""
    for name, (_, _, image) in DEPTH_MODES.items():
        if image == (width, height):
            return name
    return None


def colour_camera(
    name: str,
    cameras: dict[str, Any],
    width: int,
    height: int,
) -> ColourCamera | None:
    """Return the colour camera in the mode of this image's size, None without one. Raises
    UserError without a lens."""
    if (width, height) not in COLOUR_SIZES:
        return None
    rows = width * 3 // 4  # the sensor is 4 : 3, and wider images are its middle
    camera, parameters = _camera(name, cameras, "PhotoVideo")
    if camera["SensorWidth"] * 9 == camera["SensorHeight"] * 16:
        # Early units were calibrated on the 16:9 part of the sensor: 2304 of its 3072 rows, from
        # row 384.
        parameters[1] = (parameters[1] * 2304 + 384) / 3072
        parameters[3] = parameters[3] * 2304 / 3072
    T_colour_depth = np.eye(4)
    problem = f"{name}: the colour camera's place cannot be read"
    with read_errors(problem, "Rt with Rotation and Translation", OWN_LENS):
        place = camera["Rt"]
        T_colour_depth[:3, :3] = np.array(place["Rotation"], float).reshape(3, 3)
        T_colour_depth[:3, 3] = np.array(place["Translation"], float).reshape(3)
    mode = ((width, rows), (0, (rows - height) // 2), (width, height))
    return ColourCamera(_lens(name, parameters, mode), T_colour_depth)


def _camera(name: str, cameras: dict[str, Any], purpose: str) -> tuple[dict[str, Any], list[float]]:
    """Return a camera and its 14 numbers cx, cy, fx, fy, k1..k6, codx, cody, p2, p1."""
    if purpose not in cameras:
        problem = f"{name}: the calibration has no camera for {purpose}"
        raise UserError(problem, legal="cameras Depth and PhotoVideo")
    camera: dict[str, Any] = cameras[purpose]
    legal = f"SensorWidth and SensorHeight, {MODEL} with 14 finite parameters"
    with read_errors(f"{name}: the calibration's intrinsics cannot be read", legal, OWN_LENS):
        is_sized = all(isinstance(camera[key], int) for key in ("SensorWidth", "SensorHeight"))
        model = camera["Intrinsics"]["ModelType"]
        numbers = [float(x) for x in camera["Intrinsics"]["ModelParameters"]]
    is_known = is_sized and model == MODEL and len(numbers) == 14 and np.isfinite(numbers).all()
    if not is_known or numbers[10] or numbers[11]:
        problem = (
            f"{name}: lens model {model} with {len(numbers)} parameters, "
            "or with a centre of distortion, is not known"
        )
        raise UserError(problem, legal=legal, fix=OWN_LENS)
    return camera, numbers


def _lens(name: str, parameters: list[float], mode: Mode) -> Lens:
    """Return the lens of a readout from parameters that are shares of the sensor's sides."""
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = parameters
    if not (fx > 0 and fy > 0):
        raise UserError(f"{name}: the focal length is {fx:g}, {fy:g}", legal="above 0")
    (across, down), (left_px, top_px), (width, height) = mode
    return Lens(
        width=width,
        height=height,
        fx=fx * across,
        fy=fy * down,
        cx=cx * across - left_px - 0.5,
        cy=cy * down - top_px - 0.5,
        distortion=(k1, k2, p1, p2, k3, k4, k5, k6),
    )


LEGAL_LENS = (
    "JSON or YAML with fx, fy, cx, cy (RealSense: ppx, ppy) in pixels "
    "[distortion: k1 k2 p1 p2 k3 k4 k5 k6]; Open3D's intrinsic.json; "
    "OpenCV's or ROS' camera_info YAML; BOP's scene_camera.json; "
    "a matrix of 3 x 3 or 4 x 4 numbers; GraspNet's meta.mat; Berkeley's .intr; "
    "an Azure Kinect's calibration.json"
)
FOUND_BESIDE = (
    "intrinsic",
    "intrinsics",
    "camera_intrinsic",
    "camera_intrinsics",
    "camera",
    "camera_info",
    "calibration",
    "rtabmap_calib",
    "scene_camera",
    "depth_intrinsics",
    "intrinsic_depth",
    "transforms",
)
"""Stems of the files that count as the lens of the frames beside or below them."""
BARE_MATRICES = (
    "intrinsics.txt",
    "intrinsic.txt",
    "camera-intrinsics.txt",
    "intrinsic_depth.txt",
    "K.txt",
    "cam_K.txt",
    "camera_intrinsics.txt",
    "camera_intrinsic.txt",
    "depth_intrinsics.txt",
)
"""The same for text files: other text beside frames is mostly something different."""
GRASPNET = ("meta.mat", "meta/*.mat")
"""The same for GraspNet, whose scenes have one such file for each picture, with equal lenses."""
BERKELEY = "*.intr"
"""The same for the perception library of Berkeley, which GQ-CNN uses; a folder with several such
files does not tell which of them is meant."""
MAT = ".mat"
SPELLINGS = {
    "fx": ("fx", "fl_x", "focal_x", "_fx"),
    "fy": ("fy", "fl_y", "focal_y", "_fy"),
    "cx": ("cx", "ppx", "c_x", "_cx"),
    "cy": ("cy", "ppy", "c_y", "_cy"),
}
SKEW = "_skew"
MATRICES = ("intrinsic_matrix", "camera_matrix", "cam_K", "K", "k")
SIZES = (
    ("width", "height"),
    ("image_width", "image_height"),
    ("width_px", "height_px"),
    ("w", "h"),
    ("_width", "_height"),
)
COEFFICIENTS = ("distortion", "distortion_coefficients", "D", "d", "coeffs", "dist_coeffs")
UNIT_NAMES_OF_MAT = ("factor_depth", "depth_factor", "depth_scale")
"""Names by which MATLAB files state how many stored numbers make a metre."""
MODELS = ("distortion_model", "model", "camera_model")
"""Keys by which programs name focal lengths and centre, the matrix, the size, and the distortion.
"""
FAR_OFF = 0.2
"""Largest distance of a principal point from the middle, as a share of the image, without doubt
about the lens."""
NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
MAX_MATRIX_TEXT = 2000
NESTED = 3  # levels of mappings in a file in which a lens is sought
DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
LARGEST = 1e12  # largest number that a lens may state, in any unit
KNOWN_MODELS = (
    "",
    "none",
    "pinhole",
    "plumb_bob",
    "brown_conrady",
    "rational_polynomial",
    "opencv",
)


def lens_for(
    name: str,
    options: CaptureOptions,
    width: int,
    height: int,
    capture_lens: Callable[[], Lens | None] = lambda: None,
    beside: Sequence[Path] = (),
    hint: str = "",
) -> tuple[Lens, tuple[Path, ...]]:
    """Return the lens of depth images and the files that state it: --intrinsics, the named
    camera's, the capture's own, or the first file named like a lens in the folders ``beside``.
    Raises UserError if no lens is stated (``hint`` ends its advice), or only that of other images.
    """
    lens = options.lens
    file = options.intrinsics
    if lens is None and file is None:
        lens = capture_lens()
        file = _lens_file_in(beside)
    if file is not None:
        lens = read_lens(file, width, height)
    if lens is None:
        raise UserError(
            f"{name}: the lens of these depth images is unknown; without it they give no points",
            legal=LEGAL_LENS,
            fix="pass --intrinsics FILE, or the name of a camera whose nominal lens is good "
            f"enough{hint}",
        )
    modes = (lens, *lens.others) if isinstance(lens, OtherLens) else (lens,)
    for mode in modes:
        if (mode.width, mode.height) == (width, height):
            return mode, (file,) if file else ()
    sizes = []
    for mode in modes[1:]:
        if isinstance(mode, OtherLens):
            sizes.append(f"{mode.mode} {mode.width} x {mode.height}")
    raise UserError(
        f"{name}: depth images of {width} x {height} pixels, "
        f"but the lens is of {lens.width} x {lens.height}",
        legal=f"the modes of this camera: {', '.join(sizes)}" if sizes else None,
        fix="pass --intrinsics FILE with the lens of these images "
        "(of the colour camera, if the depth was aligned to it)",
    )


def _lens_file_in(folders: Sequence[Path]) -> Path | None:
    """Return the first file in the folders that is named like a lens."""
    names = []
    for stem in FOUND_BESIDE:
        names += [f"{stem}.json", f"{stem}.yaml", f"{stem}.yml"]
    names += BARE_MATRICES
    for folder in folders:
        for name in names:
            if (folder / name).is_file():
                return folder / name
        for pattern in GRASPNET:
            for path in sorted(folder.glob(pattern)):
                return path
        lenses = sorted(folder.glob(BERKELEY))
        if len(lenses) == 1:
            return lenses[0]
    return None


def read_lens(path: Path, width: int, height: int) -> Lens:
    """Return the lens in a file, for images of ``width`` x ``height``. Raises UserError if it is
    missing, unreadable, of another image size, or of a lens model that is not known."""
    data = parsed_lens(path)
    if "CalibrationInformation" in data:
        mode = depth_mode_of_size(width, height)
        if mode is None:
            problem = f"{path}: no depth mode of an Azure Kinect has {width} x {height} pixels"
            raise UserError(problem, legal=LEGAL_LENS)
        cameras = parse_calibration(str(path), bounded_bytes(path, TEXT_BYTES))
        return depth_lens(str(path), cameras, mode)
    stated = _size(data)
    data = _the_lens(path, data, (width, height))
    across, down = _size(data) or stated or (width, height)
    if not isinstance(across, int) or not isinstance(down, int):
        problem = f"{path}: the lens' width and height are not whole numbers"
        raise UserError(problem, legal=LEGAL_LENS)
    if across * height != down * width:
        raise UserError(
            f"{path}: is for images of {across} x {down} pixels, "
            f"but the depth images have {width} x {height}",
            fix="give the lens of the depth images (or of the colour camera they are aligned to)",
        )
    fx, fy, cx, cy = _focal_and_centre(path, data)
    # a lens of the images' own size stays as it is written: a shift by half a pixel and back rounds
    if across != width:
        side = across / width
        fx = fx / side
        fy = fy / side
        cx = (cx + 0.5) / side - 0.5
        cy = (cy + 0.5) / side - 0.5
    # no lens of these images has a mirrored or normalised focal length, or a centre far outside
    is_near = -width < cx < 2 * width and -height < cy < 2 * height
    is_focal = 0.1 * width < fx < 100 * width and 0.1 * width < fy < 100 * width
    if not (is_near and is_focal):
        raise UserError(
            f"{path}: focal length {fx:g}, {fy:g} or principal point {cx:g}, {cy:g} "
            f"is impossible for {width} x {height}",
            legal="pixels, from the centre of the first one",
            fix="multiply a normalised focal length by the image's width",
        )
    distortion = _distortion(path, data)
    off = max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5))
    warning = ""
    if (across, down) != (width, height):
        warning = (
            f"{path.name} is the lens of images of {across} x {down} pixels; "
            f"it is scaled to {width} x {height}, "
            "which is right unless the smaller image is a crop of the larger"
        )
    elif off > FAR_OFF:
        warning = (
            f"{path.name} has its principal point at {cx:.5g}, {cy:.5g}, "
            f"far from the middle of {width} x {height} pixels: "
            "unless the images are crops of larger images, "
            "the lens is for another size, and all sizes are wrong"
        )
    lens = OtherLens(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=distortion,
        warning=warning,
    )
    return lens if warning else lens.plain


def parsed_lens(path: Path) -> dict[str, Any]:
    """Return the file's mapping; bare numbers get names. Raises UserError if it is neither JSON
    nor YAML."""
    if not path.exists():
        raise UserError(f"{path}: no such file", legal=LEGAL_LENS)
    if path.suffix.lower() == MAT:
        return _mat_lens(path)
    with read_errors(f"{path}: cannot be read", LEGAL_LENS, "give another file"):
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        lens = _bare_lens(text)
        if lens is not None:
            return lens
        try:
            if text.lstrip().startswith("{"):
                # `_number` names a key whose value is not a number
                data = strict_json(text, nan=True)
            else:
                refuse_bytes(str(path), len(text), MAX_BYTES)
                data = parse_yaml(_plain_yaml(text), str(path)).data
        except json.JSONDecodeError as error:
            problem = f"{path}:{error.lineno}:{error.colno}: {error.msg}"
            raise UserError(problem, legal=LEGAL_LENS) from error
        except DeclarationError as error:
            first = error.problems[0]
            position = first.place.head if first.place else path
            raise UserError(f"{position}: {first.message}", legal=LEGAL_LENS) from error
    if not isinstance(data, dict):
        raise UserError(f"{path}: contains no keys with values", legal=LEGAL_LENS)
    return data


def _mat_lens(path: Path) -> dict[str, Any]:
    """Return the lens matrix and the depth factor of a MATLAB file. Raises UserError if it cannot
    be read."""
    import scipy.io

    wanted = (*MATRICES, *UNIT_NAMES_OF_MAT)
    with read_errors(f"{path}: cannot be read", LEGAL_LENS, "give another file"):
        refuse_bytes(str(path), path.stat().st_size, TEXT_BYTES)
        loaded = scipy.io.loadmat(path, variable_names=wanted)
    lens: dict[str, Any] = {}
    for name, value in loaded.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size:
            # MATLAB's scalars are 1 x 1 arrays
            lens[name] = value.item() if value.size == 1 else value.tolist()
    return lens


def _bare_lens(text: str) -> dict[str, Any] | None:
    """Return the lens in a text of 4 bare numbers or of a matrix, None in any other text."""
    if len(text) >= MAX_MATRIX_TEXT:
        return None
    words = re.sub(r"[\[\](),;]|#.*", " ", text).split()
    if len(words) not in (4, 9, 12, 16):
        return None
    if not all(re.fullmatch(NUMBER, word) for word in words):
        return None
    numbers = [float(word) for word in words]
    if len(numbers) == 4:
        return dict(zip(SPELLINGS, numbers, strict=True))
    columns = 3 if len(numbers) == 9 else 4
    return {"K": [numbers[columns * i + j] for i in range(3) for j in range(3)]}


def _plain_yaml(text: str) -> str:
    """Return OpenCV's YAML as plain YAML of the same columns: its first line, "%YAML:1.0", is not
    a YAML directive, and its matrices are mappings under a tag."""
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    return "\n".join(lines).replace("!!opencv-matrix", " " * 15)


def mappings(
    data: dict[str, Any],
    name: str = "",
    level: int = 0,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a mapping and those within it, up to `NESTED` levels, each with its path of keys."""
    yield name, data
    if level < NESTED:
        for key, value in data.items():
            if isinstance(value, dict):
                yield from mappings(value, f"{name}.{key}".lstrip("."), level + 1)


def _the_lens(path: Path, data: dict[str, Any], size: tuple[int, int]) -> dict[str, Any]:
    """Return the mapping in a file that holds the lens: if several differ, those of this image
    size, then those with a name that contains "depth". Raises UserError if there is none, or if
    several remain."""
    lenses = []
    for name, mapping in mappings(data):
        has_numbers = all(_named(mapping, key) for key in SPELLINGS)
        if has_numbers or _matrix_key(mapping):
            lenses.append((name, mapping))
    if not lenses:
        keys = ", ".join(str(key)[:40] for key in list(data)[:20]) or "none"
        raise UserError(f"{path}: holds no lens (its keys: {keys})", legal=LEGAL_LENS)
    if len(lenses) > 1:
        of_size = [(name, mapping) for name, mapping in lenses if _size(mapping) == size]
        lenses = of_size or lenses
    if len(lenses) > 1:
        of_depth = [(name, mapping) for name, mapping in lenses if "depth" in name.lower()]
        lenses = of_depth or lenses
    if len({_focal_and_centre(path, mapping) for _, mapping in lenses}) > 1:
        names = ", ".join(name for name, _ in lenses[:9])
        problem = f"{path}: holds {len(lenses)} different lenses ({names})"
        fix = "write the lens of these images to a file of its own"
        raise UserError(problem, legal=LEGAL_LENS, fix=fix)
    return lenses[0][1]


def _named(data: dict[str, Any], quantity: str) -> str | None:
    """Return the key by which a mapping names one of `SPELLINGS`."""
    for key in SPELLINGS[quantity]:
        if key in data:
            return key
    return None


def _matrix_key(data: dict[str, Any]) -> str | None:
    """Return the key under which a mapping holds a matrix."""
    for key in MATRICES:
        if isinstance(data.get(key), list | dict):
            return key
    return None


def _size(data: dict[str, Any]) -> tuple[Any, Any] | None:
    """Return the width and height that a mapping states, None if it states none."""
    for across, down in SIZES:
        if across in data and down in data:
            return data[across], data[down]
    return None


def _focal_and_centre(path: Path, data: dict[str, Any]) -> tuple[float, ...]:
    """Return fx, fy, cx, cy from any of the known forms of a mapping."""
    keys = [_named(data, quantity) for quantity in SPELLINGS]
    if all(keys):
        skew = _number(path, SKEW, data.get(SKEW, 0.0))
        if skew:
            problem = f"{path}: {SKEW} is {skew:g}, and skewed pixels are not modelled"
            raise UserError(problem, legal=f"{SKEW} 0")
        return tuple(_number(path, key, data[key]) for key in keys if key)
    key = _matrix_key(data)
    assert key is not None
    m = _numbers(path, key, data[key], 9)
    # the last row is 0 0 1: anything else there shows that it is by columns, as Open3D's
    if m[6] or m[7]:
        return (m[0], m[4], m[6], m[7])
    return (m[0], m[4], m[2], m[5])


def _distortion(path: Path, data: dict[str, Any]) -> tuple[float, ...]:
    """Return OpenCV's eight coefficients; absent ones are 0. Raises UserError for other models."""
    key = next((k for k in COEFFICIENTS if k in data), None)
    coefficients = data if key is None else data[key]
    if isinstance(coefficients, dict) and (key is None or "data" not in coefficients):
        unknown: list[str] = []
        if key is not None:
            unknown = sorted(map(str, set(coefficients) - set(DISTORTION_NAMES)))
        if unknown:
            problem = f"{path}: {key} has unknown names: {', '.join(unknown)}"
            raise UserError(problem, legal=", ".join(DISTORTION_NAMES))
        values = [(name, coefficients.get(name, 0.0)) for name in DISTORTION_NAMES]
        numbers = tuple(_number(path, name, value) for name, value in values)
    else:
        numbers = _numbers(path, str(key), coefficients, None)
    if len(numbers) not in (0, 4, 5, 8, 12, 14) or any(numbers[8:]):
        legal = "0, 4, 5 or 8 in OpenCV's order k1 k2 p1 p2 k3 .. k6; no thin prism, no tilt"
        raise UserError(f"{path}: {key} has {len(numbers)} numbers", legal=legal)
    model = str(next((data[name] for name in MODELS if name in data), ""))
    usual_model = re.sub(r"[ -]", "_", model.lower().removeprefix("distortion."))
    if any(numbers) and usual_model not in KNOWN_MODELS:
        problem = f"{path}: distortion model {model} is not known"
        raise UserError(problem, legal=", ".join(KNOWN_MODELS[1:]))
    return (numbers + (0.0,) * 8)[:8]


def _numbers(path: Path, key: str, value: Any, count: int | None) -> tuple[float, ...]:
    """Return the numbers of a flat list, a list of rows, or an OpenCV matrix (``data``)."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [x for row in value for x in row]
    if not isinstance(value, list) or (count is not None and len(value) != count):
        problem = f"{path}: {key} is not a list of {count or 'any'} numbers"
        raise UserError(problem, legal=LEGAL_LENS)
    return tuple(_number(path, key, x) for x in value)


def _number(path: Path, key: str, value: Any) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # Python's integers have no largest value, and lists may be too long to print
    if not is_number or not abs(value) < LARGEST:
        shown = type(value).__name__
        if isinstance(value, str | bool | float | None):
            shown = repr(value)[:40]
        raise UserError(f"{path}: {key} is {shown}", legal=f"a number within {LARGEST:g}")
    return float(value)
