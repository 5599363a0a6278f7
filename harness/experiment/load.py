"""Loads an experiment from a YAML file and ``--set`` overrides, and reports all of its mistakes at
once."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

from harness.experiment import checks
from harness.experiment.schema import (
    DETECTOR_SETTINGS,
    Experiment,
    ValuesVariation,
    declared_of,
    recording_of,
)
from harness.experiment.unfold import OPTION, overridden, set_path, unfolded
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import dotted
from harness.vocabulary.declaration.yaml_source import (
    DeclarationError,
    KeyPath,
    Source,
    read_yaml,
    to_yaml,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped
from harness.vocabulary.path_names import UNKNOWNS
from harness.vocabulary.provenance import check_version, stamp_of, stamped
from harness.vocabulary.words import nearest
from scenes.sensor.camera import camera_names, is_camera_path, load_camera, numbers_of_lens
from scenes.sensor.common.config import CameraConfig

# Version of the resolved experiment in a result folder; raised when a key changes its meaning
EXPERIMENT_VERSION = 1
# Boards that set a threshold in a first look: 18 of the shipped size show one false call per m2,
# of which 0.054 m2 are judged; two more for cameras whose outline takes more off
QUICK_CALIBRATION_BOARDS = 20
STAMP_KIND = "experiment"


def load_experiment(
    path: Path,
    overrides: Sequence[str] = (),
    calibration: Path | None = None,
    *,
    quick: bool = False,
) -> Experiment:
    """Read an experiment, apply ``path=value`` overrides, validate and unfold it. Raises
    DeclarationError with all problems. The lens of a recording ``calibration`` replaces the camera
    file's nominal lens (`lens_numbers`). ``quick`` reduces repeats and boards and drops the
    sensitivity study and a study's unknowns; ``overrides`` take precedence."""
    recording_of.cache_clear()
    path = _experiment_file(Path(path))
    written = read_yaml(path)
    # a file in a result folder states its version; a file that is written by hand states none
    stamp = stamp_of(written.text, STAMP_KIND)
    if stamp is not None:
        again = (
            "use the original experiment, or remove the first line and correct the problems "
            "that are then reported"
        )
        check_version(stamp, EXPERIMENT_VERSION, path, "an experiment", again=again)
    overrides = [*_quick(written.data), *overrides] if quick else overrides
    source, problems = overridden(written, overrides, declared_of)
    source = _with_absolute_paths(source, path.resolve().parent)
    if calibration is not None:
        source = _with_calibration(source, calibration)
    config, invalid = checks.resolved(source)
    problems += invalid
    points, unfolding = unfolded(source, None if problems else config)
    if problems or unfolding or config is None:
        raise DeclarationError(str(path), [*problems, *unfolding])
    data = config.to_data()
    varied = [*config.sweep]
    for variation in config.sensitivity.vary if config.sensitivity else ():
        varied += [variation.path] if isinstance(variation, ValuesVariation) else [*variation.set]
    if any(path.startswith("detector") for path in varied):
        # a detector may fill some settings from others (a preset); written out, they would
        # override a varied preset
        data["detector"]["settings"] = shape.get(source.data, DETECTOR_SETTINGS) or {}
    return Experiment(config, points, data, source)


def _quick(data: Any) -> list[str]:
    """Return the overrides for a first look: at most 5 repeats, a third of a study's boards, no
    sensitivity, and no unknowns of a study. A threshold keeps `QUICK_CALIBRATION_BOARDS` of its
    boards, if it has as many."""
    title = shape.get(data, ("title",)) or shape.get(data, ("name",))
    overrides = [f"title={json.dumps(f'{title} (a first look)')}"]
    overrides += ["sensitivity=null"] if shape.get(data, ("sensitivity",)) else []
    # a third of the boards is too few to tell unknowns apart
    if shape.get(data, ("study",)) and shape.get(data, (UNKNOWNS,)):
        overrides.append(f"{UNKNOWNS}=[]")
    for path in ("repeats", "threshold.calibrate.repeats"):
        repeats = shape.get(data, tuple(path.split(".")))
        if isinstance(repeats, int):
            overrides.append(f"{path}={min(repeats, 5)}")
    calibration_boards = "threshold.calibrate.boards"
    for path in ("study.boards", "study.hole_free_boards", calibration_boards):
        boards = shape.get(data, tuple(path.split(".")))
        if isinstance(boards, int):
            fewer = ceil(boards / 3)
            if path == calibration_boards:
                fewer = min(boards, max(fewer, QUICK_CALIBRATION_BOARDS))
            if path == "study.boards" and shape.get(data, ("study", "precision")):
                fewer = min(boards, max(fewer, checks.LEAST_BOARDS))
            overrides.append(f"{path}={fewer}")
    return overrides


def _experiment_file(path: Path) -> Path:
    """Return the file for a path, or for the name of tofpod's own experiment, which may also be
    that of a folder here (``detectors``). Raises UserError."""
    if path.is_file() or path.name != str(path):
        return path
    shipped_file = shipped("experiments") / f"{path.name.removesuffix('.yaml')}.yaml"
    if not (shipped_file.is_file() or path.suffix or path.exists()):
        names = sorted(file.stem for file in shipped_file.parent.glob("*.yaml"))
        meant = nearest(path.name, names)
        raise UserError(
            f"{path}: there is no such file or experiment"
            + (f"; did you mean {meant!r}?" if meant else ""),
            legal=f"a YAML file, or one of {', '.join(names)}",
        )
    return shipped_file if shipped_file.is_file() else path


def resolved_yaml(experiment: Experiment) -> str:
    """Return the experiment as YAML with its version and every default; loading it gives the same
    points."""
    return stamped(STAMP_KIND, EXPERIMENT_VERSION) + to_yaml(dict(experiment.data))


def _with_absolute_paths(source: Source, folder: Path) -> Source:
    """Make file paths absolute: they are relative to the YAML's folder, or in ``--set`` to the
    current folder."""
    data = source.data
    swept: KeyPath = ("sweep", dotted(checks.CAMERA_NAME))
    listed = shape.get(data, swept)
    named_paths: list[KeyPath] = [checks.CAMERA_NAME]
    named_paths += [(*swept, k) for k in range(len(listed) if isinstance(listed, list) else 0)]
    files = [
        (*checks.TARGET, *part, "file")
        for part in ((), ("board", "shape"), ("material", "texture"))
    ]
    if shape.get(data, ("source", "kind")) == "capture":
        files += [
            ("source", "paths", k) for k in range(len(shape.get(data, ("source", "paths")) or ()))
        ]
        files += (
            []
            if shape.get(data, ("source", "intrinsics")) in camera_names()
            else [("source", "intrinsics")]
        )
    for key in (*named_paths, *files):
        name = shape.get(data, key)
        if isinstance(name, str) and name and (key in files or is_camera_path(name)):
            start = Path.cwd() if source.place_of(key).origin == OPTION else folder
            data = set_path(data, key, str(start / Path(name).expanduser()))
    return replace(source, data=data)


def _with_calibration(source: Source, recording: Path) -> Source:
    """Add the recording's lens to the camera's replaced numbers; it takes precedence over the lens
    in the file."""
    if shape.get(source.data, ("source", "kind")) != "simulated":
        raise UserError(
            "a real capture has its own lens",
            fix="leave out --calibration, or use source.intrinsics",
        )
    swept = shape.get(source.data, ("sweep", ".".join(checks.CAMERA_NAME)))
    single = shape.get(source.data, checks.CAMERA_NAME)
    if isinstance(swept, list):
        names = swept
    elif isinstance(single, str):
        names = [single]
    else:
        names = [CameraConfig().name]
    numbers = shape.get(source.data, checks.CAMERA_NUMBERS)
    merged = {
        **(numbers if isinstance(numbers, dict) else {}),
        **lens_numbers(recording, map(str, names)),
    }
    return replace(
        source, data=set_path(source.data, checks.CAMERA_NUMBERS, merged, declared_of(source.data))
    )


def lens_numbers(recording: Path, cameras: Iterable[str]) -> dict[str, Any]:
    """Return the ``source.camera.numbers`` that give the cameras the lens of a recording. Raises
    UserError if the recording cannot be read, states no lens, or has another size than a camera's
    sensor."""
    from detectors.recordings import open_capture  # imports the readers of all formats

    lens = None
    if recording.is_dir() or recording.suffix.lower() == ".mkv":
        lens = open_capture([recording]).lens
    elif not recording.is_file():
        raise UserError(f"--calibration {recording}: no such file or folder")
    if lens is None:
        legal = "an Azure Kinect .mkv, or a folder of depth images with its intrinsics beside them"
        raise UserError(f"--calibration {recording}: holds no calibrated lens", legal=legal)
    for name in cameras:
        nominal = (
            load_camera(name).nominal_lens
            if name in camera_names() or is_camera_path(name)
            else lens
        )
        if (nominal.width, nominal.height) != (lens.width, lens.height):
            legal = f"{nominal.width} x {nominal.height}, as {name} has"
            fix = (
                "name a recording of the same camera in the same mode, or choose another "
                "source.camera.name"
            )
            message = f"{recording}: its calibration is for {lens.width} x {lens.height} pixels"
            raise UserError(message, legal=legal, fix=fix)
    return numbers_of_lens(lens)
