"""From a YAML file and ``--set`` overrides to an experiment, or to everything that is wrong with it. Runs nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from harness.experiment import checks
from harness.experiment.calibrated import lens_numbers
from harness.experiment.declared import DETECTOR_SETTINGS, declared_of, splices_of
from harness.experiment.dotted import OPTION, overridden, set_path
from harness.experiment.points import Experiment
from harness.experiment.recorded import recording_of
from harness.experiment.schema import ExperimentConfig, ValuesVariation
from harness.experiment.unfold import unfolded
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import validated
from harness.vocabulary.declaration.problems import DeclarationError, Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source, read_yaml, to_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.versions import check_version, stamp_of, stamped
from scenes.sensor.camera import CameraConfig

EXPERIMENT_VERSION = 1
"""Of the resolved experiment in a result folder; raised when a key changes its meaning."""
STAMP_KIND = "experiment"
RESERVED = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(10))}
)


def load_experiment(path: Path, overrides: Sequence[str] = (), calibration: Path | None = None) -> Experiment:
    """Read, override (``path=value`` each), validate and unfold. Raises DeclarationError with all problems at once.

    ``calibration``: a recording whose lens takes the place of the nominal one (`harness.experiment.calibrated`).
    """
    recording_of.cache_clear()
    written = read_yaml(Path(path))
    _refuse_other_version(written, Path(path))
    source, problems = overridden(written, overrides, declared_of)
    source = _with_absolute_paths(source, Path(path).resolve().parent)
    if calibration is not None:
        source = _with_calibration(source, calibration)
    config, invalid = validated(ExperimentConfig, source, splices_of(source.data))
    problems += invalid
    problems += checks.name_problems(source)
    problems += _reserved_names(source)
    if config is not None and not problems:
        problems += checks.joint_problems(config, source)
    points, unfolding = unfolded(source, None if problems else config)
    if problems or unfolding or config is None:
        raise DeclarationError(str(path), [*problems, *unfolding])
    return Experiment(config, points, _resolved_data(config, source), source)


def resolved_yaml(experiment: Experiment) -> str:
    """The experiment with every default written out, under its version; loading it again gives the same points."""
    return stamped(STAMP_KIND, EXPERIMENT_VERSION) + to_yaml(dict(experiment.data))


def _refuse_other_version(source: Source, path: Path) -> None:
    """A file that a result folder holds says its version; one that is written by hand says none and is read as is."""
    found = stamp_of(source.text, STAMP_KIND)
    if found is not None:
        again = "take the experiment that it was made from, or remove the first line and mend what is refused then"
        check_version(found, EXPERIMENT_VERSION, path, "an experiment", again=again)


def _reserved_names(source: Source) -> Iterator[Problem]:
    """Names that are devices on Windows: no folder of results can be called so there."""
    name = source.data.get("name")
    if isinstance(name, str) and name.lower() in RESERVED:
        place = source.place_of(("name",))
        yield Problem(f"`name` is {name}, which is a device's name on Windows", place, fix="choose another name")


def _resolved_data(config: ExperimentConfig, source: Source) -> dict[str, Any]:
    """Every default written out; but where keys of the detector are varied its settings stay as they are written.

    A detector may fill some settings from others (a preset); written out they would count beside a varied preset.
    """
    data = config.to_data()
    study = config.sensitivity
    varied = [*config.sweep]
    for variation in study.vary if study else ():
        varied += [variation.path] if isinstance(variation, ValuesVariation) else [*variation.set]
    if any(path.startswith("detector") for path in varied):
        data["detector"]["settings"] = shape.get(source.data, DETECTOR_SETTINGS) or {}
    return data


def _with_absolute_paths(source: Source, folder: Path) -> Source:
    """Paths of a real capture, made absolute: they count from the YAML's folder, in ``--set`` from the current one."""
    data = source.data
    if shape.get(data, ("source", "kind")) != "capture":
        return source
    listed = shape.get(data, ("source", "paths"))
    names: list[KeyPath] = [
        ("source", "paths", index) for index in range(len(listed) if isinstance(listed, list) else 0)
    ]
    lens = shape.get(data, ("source", "intrinsics"))
    if isinstance(lens, str) and lens not in checks.camera_names():
        names.append(("source", "intrinsics"))
    for at in names:
        data = _absolute(data, at, Path.cwd() if source.place_of(at).origin == OPTION else folder)
    return Source(source.origin, source.text, data, source.values, source.keys)


def _with_calibration(source: Source, recording: Path) -> Source:
    """The recording's lens among the camera's replaced numbers; it counts before what the file says of the lens."""
    if shape.get(source.data, ("source", "kind")) != "simulated":
        raise UserError("a real capture brings its own lens", fix="leave out --calibration, or use source.intrinsics")
    swept = shape.get(source.data, ("sweep", ".".join(checks.CAMERA_NAME)))
    single = shape.get(source.data, checks.CAMERA_NAME)
    names = swept if isinstance(swept, list) else [single] if isinstance(single, str) else [CameraConfig().name]
    numbers = shape.get(source.data, checks.CAMERA_NUMBERS)
    merged = {**(numbers if isinstance(numbers, dict) else {}), **lens_numbers(recording, map(str, names))}
    data = set_path(source.data, checks.CAMERA_NUMBERS, merged, declared_of(source.data))
    return Source(source.origin, source.text, data, source.values, source.keys)


def _absolute(data: Any, at: KeyPath, folder: Path) -> Any:
    name = shape.get(data, at)
    return set_path(data, at, str(folder / Path(name).expanduser())) if isinstance(name, str) and name else data
