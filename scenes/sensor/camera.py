"""Cameras as data: a YAML file in which every number has a tag and a source, of tofpod or of an
installed package."""

import difflib
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from harness.vocabulary.declaration.diagnose import read_as, settings_of, with_value_at
from harness.vocabulary.declaration.yaml_source import (
    DeclarationError,
    KeyPath,
    Problem,
    Source,
    read_yaml,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens, OtherLens
from harness.vocabulary.plug_ins import PlugIns
from harness.vocabulary.seeds import canonical_json
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.lidar.facts import ScannedLidar

CAMERA_FOLDER = Path(__file__).resolve().parent.parent / "cameras"
DEEPEST = 5  # most cameras in a chain of ``like``
# its entry points give the path of a camera's file, which has the entry point's name
GROUP = "tofpod.cameras"


@lru_cache
def _built_in_cameras() -> dict[str, str]:
    """Return the paths of tofpod's camera files, by name."""
    return {path.stem: str(path) for path in CAMERA_FOLDER.glob("[!.]*.yaml")}


CAMERAS = PlugIns(
    GROUP,
    "camera",
    _built_in_cameras,
    fix="to add one, write its file in scenes/cameras/, or install a package that offers it by "
    f"{GROUP!r}",
)

AnyCamera = AmcwCamera | ScannedLidar | EmpiricalCamera
"""All kinds of camera, distinguished by ``kind``. Each has name, title, nominal_lens, optics,
unit, z_step_m."""
KINDS: dict[str, type[AnyCamera]] = {
    "amcw_imager": AmcwCamera,
    "scanned_lidar": ScannedLidar,
    "empirical": EmpiricalCamera,
}


def camera_names() -> tuple[str, ...]:
    """Return the cameras that come with tofpod and those of installed packages."""
    return CAMERAS.names()


def camera_file(name: str) -> Path:
    """Return the path of a camera's file. Raises UserError for a name that is unknown, ambiguous
    or without a file."""
    if is_camera_path(name):
        return Path(name)
    offer = CAMERAS.offer(name)
    if offer.built_in:
        return Path(offer.target)
    offered = CAMERAS.load(offer)
    if not isinstance(offered, str | Path):
        raise CAMERAS.broken(
            offer, f"it must be the path of a YAML file, not {type(offered).__name__}"
        )
    path = Path(offered)
    if path.stem != name or not path.is_file():
        raise CAMERAS.broken(
            offer,
            f"the camera {name} needs a file called {name}.yaml; there is no such file {path}",
        )
    return path


def is_camera_path(name: str) -> bool:
    """Return whether a camera's name is the path of its file."""
    return name.endswith(".yaml")


def load_camera(name: str) -> AnyCamera:
    """Return the camera of that name. Raises UserError as `camera_file` does, and for a file that
    is not a camera."""
    return _camera_at(camera_file(name))


def lens_names() -> dict[str, str]:
    """Return the names that `lens_named` knows (cameras, and further depth modes), each with its
    camera."""
    names: dict[str, str] = {}
    for camera in camera_names():
        modes = dict.fromkeys((camera, *load_camera(camera).modes), camera)
        # a mode with its own file stays with the camera whose mode it is
        names = {**modes, **names}
    return names


def lens_named(name: str) -> OtherLens:
    """Return the nominal lens of a camera or depth mode, with those of its other modes; UserError
    for other names."""
    camera_name = lens_names().get(name, name)
    lenses = {}
    for mode in (camera_name, *load_camera(camera_name).modes):
        camera = load_camera(mode)
        note = f"the lens is the nominal one of {mode}"
        lenses[mode] = OtherLens(
            **vars(camera.nominal_lens), note=note, mode=mode, unit_m=camera.z_step_m
        )
    return replace(lenses[name], others=tuple(lenses.values()))


def camera_of(config: CameraConfig) -> AnyCamera:
    """Return the camera that an experiment declares. Raises UserError if a replaced number is
    impossible."""
    if not config.numbers:
        return load_camera(config.name)
    return _with_numbers(config.name, canonical_json(config.numbers))


def guessed_precision(camera: AnyCamera) -> str:
    """Return a warning for a camera whose precision is a guess (shot noise by its gain), because
    its maker publishes none, or a limit without conditions; empty for others."""
    if isinstance(camera, EmpiricalCamera):
        return ""
    gain = camera.photons.signal_electrons
    if gain.tag != "G" or gain.range is None:
        return ""
    least_gain, greatest_gain = gain.range
    least_noise = float(np.sqrt(gain.value / greatest_gain))
    greatest_noise = float(np.sqrt(gain.value / least_gain))
    is_published = camera.photons.calibration_sigma_mm.tag != "M"
    state = "is published only roughly" if is_published else "is not published"
    return (
        f"the precision of {camera.title} {state}: its noise is a guess, which may be "
        f"{least_noise:.2g} to {greatest_noise:.2g} times as much"
    )


def numbers_of_lens(lens: Lens) -> dict[str, Any]:
    """Return the numbers of a camera file (`CameraConfig.numbers`) that describe a lens."""
    return {
        "lens.fx_px": float(lens.fx),
        "lens.fy_px": float(lens.fy),
        "lens.cx_px": float(lens.cx),
        "lens.cy_px": float(lens.cy),
        "lens.distortion": [float(term) for term in lens.distortion],
    }


# a study that draws unknown numbers has a camera for each board
@lru_cache(maxsize=4096)
def _with_numbers(name: str, numbers_json: str) -> AnyCamera:
    data = load_camera(name).to_data()
    for path, value in json.loads(numbers_json).items():
        fact: Any = data
        for key in path.split("."):
            fact = fact.get(key) if isinstance(fact, dict) else None
        if not (isinstance(fact, dict) and "value" in fact):
            similar = difflib.get_close_matches(path, number_paths(data), n=1)
            hint = f"; did you mean {similar[0]!r}?" if similar else ""
            legal = f"a number of {camera_file(name)}, such as lens.fx_px"
            raise UserError(
                f"source.camera.numbers: {name} has no number {path!r}{hint}", legal=legal
            )
        fact.update(value=value, tag="U", source="set by the experiment", range=None)
    return settings_of(
        KINDS[data["kind"]],
        data,
        f"source.camera.numbers and {name} together do not describe a camera",
    )


def number_paths(data: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the dotted paths of all numbers in a camera's plain data."""
    paths: list[str] = []
    for key, value in data.items():
        if not isinstance(value, dict):
            continue
        if "value" in value:
            paths.append(prefix + key)
        else:
            paths += number_paths(value, f"{prefix}{key}.")
    return paths


def stated_in(name: str) -> dict[str, str]:
    """Return the camera whose file states each number of a camera, by dotted keys: its own, or one
    that `like` leads to. Raises UserError as `load_camera` does."""
    owners: dict[str, str] = {}
    owner = name
    while True:
        data = read_yaml(camera_file(owner)).data
        for key in number_paths(data):
            owners.setdefault(key, owner)
        base = data.get("like")
        if base is None:
            break
        owner = str(camera_file(owner).parent / base) if is_camera_path(base) else base
    return {key: owners[key] for key in number_paths(load_camera(name).to_data())}


def read_camera(path: Path) -> AnyCamera:
    """Read a camera file. Raises UserError that names the file and each key that is missing,
    unknown or impossible."""
    source = _completed(read_yaml(path))
    camera = read_as(KINDS, "kind", source)
    if camera.name != path.stem:
        message = f"`name` is {camera.name}, but the file is {path.name}"
        raise DeclarationError(
            str(path), [Problem(message, source.place_of(("name",)), fix=f"write {path.stem}")]
        )
    return camera


def _completed(source: Source, depth: int = 0) -> Source:
    """Return a file's content, completed from the camera that its key ``like`` names: by whole
    facts and lists, never by parts of them. Other modes of the lens are not inherited."""
    name = source.data.get("like")
    if name is None:
        return source
    if not isinstance(name, str) or depth == DEEPEST:
        message = "`like` is not the name of a camera"
        if depth == DEEPEST:
            message = f"`like` chains {DEEPEST} files"
        legal = f"one of {', '.join(camera_names())}"
        problem = Problem(message, source.place_of(("like",)), legal=legal)
        raise DeclarationError(source.origin, [problem])
    if is_camera_path(name):
        base = _completed(read_yaml(Path(source.origin).parent / name), depth + 1)
    else:
        base = _named(name, depth + 1)
    inherited = {key: value for key, value in base.data.items() if key != "modes"}
    stated = {key: value for key, value in source.data.items() if key != "like"}
    completed = replace(
        source,
        data=inherited,
        values={**base.values, **source.values},
        keys={**base.keys, **source.keys},
    )
    for path, value in _stated(stated):
        data = with_value_at(completed.data, path, value)
        completed = completed.with_value(path, data, source, path)
    return completed


@lru_cache
def _named(name: str, depth: int) -> Source:
    return _completed(read_yaml(camera_file(name)), depth)


def _stated(data: Mapping[str, Any], prefix: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the path and value of each fact, and of everything else that is not a mapping of
    facts."""
    for key, value in data.items():
        if isinstance(value, dict) and "value" not in value:
            yield from _stated(value, (*prefix, key))
        else:
            yield (*prefix, key), value


_camera_at = lru_cache(read_camera)
