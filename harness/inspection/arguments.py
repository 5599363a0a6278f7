"""The arguments of `tofpod detect` as settings: a detector, the merging of views, captures,
stated poses."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json
from harness.vocabulary.lengths import in_unit, states_unit
from harness.vocabulary.program import length_m
from harness.vocabulary.provenance import RESULTS_VERSION, check_version

if TYPE_CHECKING:
    import numpy as np

    from detectors.interface import Detector
    from detectors.recordings import Recording
    from detectors.surfaces.drawing import DrawingFile
    from detectors.views.mapping.settings import MappingConfig
    from detectors.views.marks.mark import MarksConfig
    from harness.vocabulary.geometry import Lens

METHODS = ("marks", "icp", "cpd", "joint", "odometry", "nominal")
MERGES = ("fusion", "grid", "volume")
MARKS = ("colour", "red", "coded")
WHOLE_CAPTURES = (".mcap", ".db3", ".mkv", ".npy", ".npz", ".mat", ".tif", ".tiff", ".pfm")
MESHES = (".stl", ".obj", ".glb", ".step", ".stp", ".iges", ".igs")
HEAD_BYTES = 4096
"""Bytes of a .ply that hold its header."""
DEFAULT_FALSE_CALLS = 1.0  # expected false calls in the capture
DEFAULT_DETECTOR = "auto"
"""The detector is chosen on the capture among `CANDIDATES`."""
CANDIDATES = ("matched", "local", "thesis")
"""Detectors among which a capture chooses; the first is used where it cannot."""
# prefixes of the --set keys for merging views and for the drawing; all other keys are the
# detector's
PREFIX = "mapping."
DRAWING_PREFIX = "reference."
PREFIXES = (PREFIX, DRAWING_PREFIX)
STATED_SURFACE = ("surface=", "surface.degree", "surface.method", "surface.drop")
"""Settings that state a polynomial: without them, the surface's shape is chosen by evidence."""
LEGAL_CROP = (
    "auto, none, box:x0,x1,y0,y1,z0,z1 (mm or with units, camera frame), "
    "polygon:u,v,u,v,u,v.. (pixels)"
)


READING = (
    "unit",
    "topic",
    "array",
    "pitch",
    "raw",
)  # options that `open_capture` takes as they are


def add_reading(add: Callable[..., Any]) -> None:
    """Add the options for reading captures with ``add_argument`` of a parser or group."""
    add(
        "--unit",
        help=(
            "unit of stored distances: mm, m, cm, um, in, tum (5000/m) or N/m; default: from "
            "the data"
        ),
    )
    add(
        "--intrinsics",
        metavar="FILE|CAMERA",
        help="lens of the depth pixels: a file, or a camera (nominal lens)",
    )
    add("--topic", help="topic of a ROS bag with depth images or clouds (default: the only one)")
    add(
        "--array",
        metavar="NAME[:NUMBER]",
        help="name of the array in a .npz, .mat or .npy, and number of the map",
    )
    add(
        "--pitch",
        metavar="LENGTH",
        help="the array is a height map with this distance between pixels, such as 0.5mm",
    )
    add(
        "--raw",
        metavar="LAYOUT",
        help="layout of bare numbers: WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]], 640x480:u2",
    )


def reading_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return the values of `add_reading`'s options except the lens, for `opened`."""
    return {name: getattr(options, name) for name in READING}


def refuse_misfits(arguments: argparse.Namespace, paths: list[Path]) -> None:
    """Raise UserError for arguments of several views with one capture, and vice versa."""
    several = f"--register {'|'.join(METHODS)}"
    reference = getattr(arguments, "reference", None)
    is_compared = reference is not None and not is_mesh(reference)
    if is_compared and arguments.quiet_capture is not None:
        raise UserError(
            "--quiet-capture and --reference: the threshold is that of a part that is compared with"
            " the reference",
            fix="leave out --quiet-capture; or record it among the good parts of --reference",
        )
    drawing = [text for text in arguments.set if text.startswith(DRAWING_PREFIX)]
    if drawing and (reference is None or not is_mesh(reference)):
        raise UserError(
            f"--set {drawing[0]}: concerns a mesh, and none is the reference",
            fix="name it with --reference part.stl",
        )
    if arguments.register is None:
        names = ["merge", "poses"] if is_compared else ["merge", "marks", "poses"]
        given_options = [name for name in names if getattr(arguments, name) is not None]
        given_options += [
            f"set {assignment}" for assignment in arguments.set if assignment.startswith(PREFIX)
        ]
        if given_options:
            message = (
                f"--{given_options[0]}: concerns several views, but without --register all "
                "PATHs are one capture"
            )
            raise UserError(message, legal=several)
        whole_captures = [
            path for path in paths if path.is_dir() or path.suffix.lower() in WHOLE_CAPTURES
        ]
        if len(paths) > 1 and whole_captures:
            fix = f"run each separately, or register them as views of one target: {several}"
            raise UserError(
                f"{len(paths)} PATHs, but {whole_captures[0]} is a whole capture", fix=fix
            )
        return
    if len(paths) < 2:
        fix = "name the other views, or leave out --register"
        raise UserError(f"{len(paths)} view cannot be registered: there is no other view", fix=fix)
    refuse_repeats(paths)
    if arguments.register == "nominal" and arguments.poses is None:
        raise UserError(
            "--register nominal uses the stated poses, and none are stated", fix="give --poses FILE"
        )
    if arguments.quiet_capture is not None:
        message = (
            "--quiet-capture is one cloud, and its noise differs from that of a cloud merged "
            "from several views"
        )
        raise UserError(
            message, fix="use --threshold with a value at which undamaged views have no finding"
        )


def limit_depth_m(arguments: argparse.Namespace) -> float | None:
    """Return the depth of --limit; None if none is stated. Raises UserError if it is no length, or
    if several views are judged without a grid."""
    text = getattr(arguments, "limit", None)
    if not text:
        return None
    try:
        return length_m("limit", text)
    except UserError as mistake:
        fix = f"write a depth, such as --limit 2mm, or put --limit after the paths: {mistake.fix}"
        raise UserError(mistake.message, legal=mistake.legal, fix=fix) from mistake


def refuse_repeats(paths: Sequence[Path]) -> None:
    """Raise UserError if a capture is named twice."""
    resolved_paths = [path.resolve() for path in paths]
    for path, resolved_path in zip(paths, resolved_paths, strict=True):
        if resolved_paths.count(resolved_path) > 1:
            legal = "captures from different places, each named once"
            raise UserError(
                f"{path}: is named twice; counting the same noise twice would understate it",
                legal=legal,
            )


def detectors_of(
    arguments: argparse.Namespace, crop: str, assignments: Sequence[str]
) -> list[tuple[Detector, dict[str, Any]]]:
    """Return `detector_of` for --detector, or for each of `CANDIDATES` that has all of the settings
    if the capture is to choose. Raises UserError of the first if none has.

    A stated threshold is in units of one detector's score, so that nothing is to be chosen."""
    if arguments.detector != DEFAULT_DETECTOR:
        return [detector_of(arguments, crop, assignments)]
    if arguments.threshold is not None:
        return [detector_of(arguments, crop, assignments)]
    loaded = []
    mistakes = []
    for name in CANDIDATES:
        try:
            loaded.append(detector_of(arguments, crop, assignments, name))
        except UserError as mistake:
            mistakes.append(mistake)
    if not loaded:
        raise mistakes[0]
    return loaded


def detector_of(
    arguments: argparse.Namespace,
    crop: str,
    assignments: Sequence[str],
    name: str | None = None,
) -> tuple[Detector, dict[str, Any]]:
    """Return the detector of this ``name`` (default: --detector, or the first of `CANDIDATES`) with
    the crop and settings of --crop and --set, and all of its settings."""
    from detectors import detector_type, load_detector

    if name is None:
        is_stated = arguments.detector != DEFAULT_DETECTOR
        name = arguments.detector if is_stated else CANDIDATES[0]
    settings: dict[str, Any] = {}
    settings_type = detector_type(name).settings_type
    if "crop" in settings_type.model_fields:
        # with several views, --crop and --target belong to the mapping
        settings["crop"] = crop_from_text(
            crop, arguments.target if crop == arguments.crop else None
        )
    elif arguments.target is not None:
        raise UserError(f"--target {arguments.target}: detector {name} has no crop for it")
    reference = getattr(arguments, "reference", None)
    if reference is not None:
        if "surface" not in settings_type.model_fields:
            raise UserError(f"--reference {reference}: detector {name} has no surface setting")
        settings["surface"] = {"shape": "expected"}
    elif "surface" in settings_type.model_fields and not any(
        assignment.startswith(STATED_SURFACE) for assignment in assignments
    ):
        settings["surface"] = {"shape": "auto"}
    for assignment in assignments:
        assign(settings, assignment)
    return load_detector(name, settings), settings_type.from_data(settings).to_data()


def is_mesh(path: Path) -> bool:
    """Return whether a reference is a drawing: a file of triangles or of CAD surfaces. A .ply may
    also hold the points of a capture."""
    suffix = path.suffix.lower()
    if suffix != ".ply" or not path.is_file():
        return suffix in MESHES
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError:
        # the reader of captures says why
        return False
    faces = re.search(rb"element face (\d+)", head)
    return faces is not None and int(faces[1]) > 0


def drawing_file_of(arguments: argparse.Namespace) -> DrawingFile:
    """Return the mesh of --reference with its unit and front. Raises UserError."""
    from detectors.surfaces.drawing import DrawingFile
    from harness.vocabulary.declaration.diagnose import settings_of

    data: dict[str, Any] = {"file": arguments.reference.as_posix()}
    for assignment in arguments.set:
        if assignment.startswith(DRAWING_PREFIX):
            assign(data, assignment.removeprefix(DRAWING_PREFIX))
    return settings_of(DrawingFile, data, "settings of the drawing", DRAWING_PREFIX.rstrip("."))


def rate_text(arguments: argparse.Namespace) -> str:
    """Return the rate of false calls at which detectors are compared, in words."""
    if arguments.quiet_capture is not None:
        return "thresholds that are silent on the quiet capture"
    calls = arguments.false_calls or DEFAULT_FALSE_CALLS
    return expected_text(calls)


def expected_text(calls: float) -> str:
    """Return ``1 expected false call`` or ``14 expected false calls``."""
    number = f"{calls:.2g}"
    return f"{number} expected false call{'s' * (number != '1')}"


def mapping_of(arguments: argparse.Namespace) -> MappingConfig:
    """Return the settings that merge views into one cloud. Raises UserError with every problem at
    once."""
    from detectors.views.mapping.settings import MappingConfig
    from harness.vocabulary.declaration.diagnose import settings_of

    data: dict[str, Any] = {
        "crop": crop_from_text(arguments.crop, arguments.target),
        "marks": {"kind": arguments.marks or MARKS[0]},
        "registration": {"method": arguments.register},
        "merge": {"kind": arguments.merge or MERGES[0]},
    }
    for assignment in arguments.set:
        if assignment.startswith(PREFIX):
            assign(data, assignment.removeprefix(PREFIX))
    return settings_of(MappingConfig, data, "settings of the mapping", PREFIX.rstrip("."))


def marks_of(arguments: argparse.Namespace) -> MarksConfig:
    """Return the marks by which a part is placed on its reference: coded ones unless stated."""
    from detectors.views.mapping.settings import MappingConfig

    kind = arguments.marks or "coded"
    return MappingConfig.from_data({"marks": {"kind": kind}}).marks


def crop_from_text(text: str, target: int | None = None) -> dict[str, Any]:
    """Return the crop's declaration from text, with the number of the automatic crop's candidate.
    Raises UserError."""
    kind, _, values = text.partition(":")
    if target is not None and text != "auto":
        message = (
            f"--target {target}: chooses among the surfaces of --crop auto, but --crop {text} "
            "is another crop"
        )
        raise UserError(message, fix="leave out one of the two")
    numbers = []
    for value in values.split(",") if values else ():
        number = in_unit(value, "mm") if kind == "box" or not states_unit(value) else None
        if number is None:
            problem = f"--crop {text}: not all of its values are numbers"
            raise UserError(problem, legal=LEGAL_CROP)
        numbers.append(number)
    pairs = [numbers[i : i + 2] for i in range(0, len(numbers), 2)]
    if kind in ("auto", "none") and not numbers:
        return {"kind": kind} if target is None else {"kind": kind, "target": target}
    if kind == "box" and len(numbers) == 6:
        if not all(low < high for low, high in pairs):
            message = f"--crop {text}: a lower bound is not below the upper one"
            raise UserError(
                message, legal=LEGAL_CROP, fix="state the smaller bound of each axis first"
            )
        return {
            "kind": "box",
            "x_mm": pairs[0],
            "y_mm": pairs[1],
            "z_mm": pairs[2],
            "range_max_m": None,
        }
    if kind == "polygon" and len(numbers) >= 6 and len(numbers) % 2 == 0:
        return {"kind": "polygon", "vertices_px": pairs}
    raise UserError(f"--crop {text}: no such crop", legal=LEGAL_CROP)


def assign(settings: dict[str, Any], assignment: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is YAML, as in an experiment. UserError
    without one."""
    from harness.vocabulary.declaration.yaml_source import parse_yaml

    path, _, text = assignment.partition("=")
    if not (path.strip() and text.strip()):
        raise UserError(
            f"--set {assignment}: has no value", legal="KEY=VALUE, for instance surface.degree=5"
        )
    value = parse_yaml(assignment, "--set", start=len(path) + 1, is_argument=True, key=path).data
    *folders, leaf = path.split(".")
    for folder in folders:
        settings = settings.setdefault(folder, {})
        if not isinstance(settings, dict):
            raise UserError(f"--set {assignment}: {folder} is a value, not a group")
    settings[leaf] = value


def opened(
    paths: Sequence[Path], intrinsics: str | None, lens: Lens | None = None, **reading: Any
) -> Recording:
    """Open a capture. ``intrinsics``: a file or a camera; ``reading``: options of
    `open_capture`."""
    from detectors.recordings import open_capture

    file = None if intrinsics is None else Path(intrinsics)
    if file is not None and not file.is_file():
        from scenes.sensor.camera import lens_named, lens_names

        if str(intrinsics) in lens_names():
            file = None
            lens = lens_named(str(intrinsics))
        elif not file.exists():
            legal = f"a file, or one of the cameras {', '.join(lens_names())}"
            raise UserError(f"--intrinsics {file}: no such file and no such camera", legal=legal)
    return open_capture(list(paths), intrinsics=file, lens=lens, **reading)


def opened_as(
    camera: str | None, paths: Sequence[Path], intrinsics: str | None, **reading: Any
) -> Recording:
    """Open a capture; if it states no lens and none is given, the nominal lens of ``camera`` is
    used."""
    try:
        return opened(paths, intrinsics, **reading)
    except UserError:
        if camera is None or intrinsics is not None:
            raise
        from scenes.sensor.camera import load_camera

        recording = opened(paths, None, lens=load_camera(camera).nominal_lens, **reading)
        note = f"the capture states no lens; the nominal lens of {camera} is used"
        return replace(recording, notes=(*recording.notes, note))


POSES_KEY = (
    "T_reference_view"  # key of the list in a file of `tofpod export`, beside the file's version
)
LEGAL_POSES = (
    "JSON: a list with a 4x4 matrix (metres, last row 0 0 0 1) for each view, all to one "
    "common frame, bare or"
    f" under the key {POSES_KEY}; or lines of"
    " `timestamp tx ty tz qx qy qz qw`, one for each view"
)
# tolerance of R R' = 1 and of the quaternion's length: poses are written with four digits and more
RIGID_WITHIN = 1e-4
FARTHEST_M = 100.0  # Largest distance of two views of one target: poses in millimetres lie beyond


def read_poses(path: Path, count: int) -> tuple[np.ndarray, ...]:
    """Return ``T_first_view`` (4, 4) of each view, the first the identity, from poses to any
    common frame. Raises UserError if the file cannot be read, has another number of poses, or one
    that is not rigid or too far."""
    import numpy as np

    from harness.vocabulary.geometry import invert

    try:
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8")
        poses = (
            _from_json(path, text)
            if text.lstrip().startswith(("[", "{"))
            else _from_lines(path, text)
        )
    except (OSError, ValueError, TypeError, OverflowError) as error:
        why = (
            f"cannot be read ({error.strerror})"
            if isinstance(error, OSError)
            else f"holds no poses ({error})"
        )
        raise UserError(f"{path}: {why}", legal=LEGAL_POSES) from error
    if len(poses) != count:
        fix = (
            "keep one pose for each PATH, in the same order (one line per view for "
            "groundtruth.txt of a sequence)"
        )
        raise UserError(f"{path}: {len(poses)} poses for {count} views", legal=LEGAL_POSES, fix=fix)
    from_first = [np.eye(4)]
    for number, pose in enumerate(poses):
        turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
        with np.errstate(over="ignore", invalid="ignore"):
            is_rigid = (
                np.allclose(turn @ turn.T, np.eye(3), atol=RIGID_WITHIN) and np.linalg.det(turn) > 0
            )
        if not (is_rigid and np.isfinite(pose).all() and np.array_equal(pose[3], [0, 0, 0, 1])):
            raise UserError(
                f"{path}: pose {number} is not a rigid 4x4 transform", legal=LEGAL_POSES
            )
        if number:
            with np.errstate(over="ignore", invalid="ignore"):
                from_first.append(invert(poses[0]) @ pose)
                distance_m = float(np.linalg.norm(from_first[-1][:3, 3]))
            if not distance_m <= FARTHEST_M:  # or NaN, where numbers are near the largest
                message = (
                    f"{path}: pose {number} is {distance_m:.4g} m from pose 0 (up to "
                    f"{FARTHEST_M:g} m)"
                )
                raise UserError(message, fix="write translations in metres, not millimetres")
    return tuple(from_first)


def _from_json(path: Path, text: str) -> list[np.ndarray]:
    """Parse a list of matrices: bare, in an object from `tofpod export`, or in one without a
    version."""
    import numpy as np

    data = strict_json(text)
    if isinstance(data, dict):
        if "results_version" in data:
            check_version(data["results_version"], RESULTS_VERSION, path, "a file of poses")
        if POSES_KEY not in data:
            raise ValueError(f"an object without the key {POSES_KEY}")
        data = data[POSES_KEY]
    return [np.array(matrix, float) for matrix in data]


def _from_lines(path: Path, text: str) -> list[np.ndarray]:
    import numpy as np
    from scipy.spatial.transform import Rotation

    poses = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                _, *shift, x, y, z, w = map(float, line.split())
            except ValueError:
                shift = []
            if len(shift) != 3 or not abs(np.linalg.norm([x, y, z, w]) - 1) < RIGID_WITHIN:
                raise UserError(f"{path}:{number}: is not a pose", legal=LEGAL_POSES)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), shift
            poses.append(pose)
    return poses
