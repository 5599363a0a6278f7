"""The arguments of `harness.detect` as settings: a detector, a way from views to one cloud, captures, averages."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from detectors.interface import Detector
    from detectors.mapping.settings import MappingConfig
    from detectors.recordings import Recording
    from harness.vocabulary.capture import Cloud

METHODS = ("marks", "icp", "cpd", "joint", "odometry", "nominal")
MERGES = ("fusion", "grid", "volume")
MARKS = ("colour", "red", "coded")
WHOLE_CAPTURES = (".mcap", ".db3", ".mkv", ".npy", ".npz", ".mat")
PREFIX = "mapping."
"""Start of the --set keys that concern the way from views to one cloud; all others are the detector's."""
STATED_SURFACE = ("surface=", "surface.degree", "surface.method", "surface.drop", "variant")
"""Settings that state a polynomial: without any of them the surface's shape is chosen by evidence."""
LEGAL_CROP = "auto, none, box:x0,x1,y0,y1,z0,z1 (mm, camera frame), polygon:u,v,u,v,u,v.. (pixels)"


def refuse_misfits(arguments: argparse.Namespace, paths: list[Path]) -> None:
    """Raise UserError for arguments that contradict each other: those of several views for one capture, and those of
    one capture for several views."""
    several = f"--register {'|'.join(METHODS)}"
    if arguments.register is None:
        given = [name for name in ("merge", "marks", "poses") if getattr(arguments, name) is not None]
        given += [f"set {assignment}" for assignment in arguments.set if assignment.startswith(PREFIX)]
        if given:
            what = f"--{given[0]}: concerns several views, and without --register all PATHs are one capture"
            raise UserError(what, legal=several)
        whole = [path for path in paths if path.is_dir() or path.suffix.lower() in WHOLE_CAPTURES]
        if len(paths) > 1 and whole:
            raise UserError(
                f"{len(paths)} PATHs, and {whole[0]} is a capture of its own",
                legal="one capture: a folder, a file of many frames, or a list of .png, .ply or .pcd",
                fix=f"run each alone, or, as views of one target, together: {several}",
            )
        return
    if len(paths) < 2:
        raise UserError(
            f"{len(paths)} view to register: there is nothing to register it to",
            legal="two or more PATHs, each a capture of its own",
            fix="name the other views, or leave out --register",
        )
    places = [path.resolve() for path in paths]
    twice = next((path for path, place in zip(paths, places, strict=True) if places.count(place) > 1), None)
    if twice is not None:
        raise UserError(
            f"{twice}: is named twice; the same noise counted twice would pass for less noise",
            legal="captures from different places, each named once",
        )
    if arguments.register == "nominal" and arguments.poses is None:
        raise UserError("--register nominal takes the poses as they are, and there are none", fix="give --poses FILE")
    if arguments.quiet_capture is not None:
        raise UserError(
            "--quiet-capture is one cloud, and its noise is not that of a cloud merged from several views",
            fix="run the undamaged views in the same way, and give the threshold that is silent there as --threshold",
        )


def detector_of(
    arguments: argparse.Namespace, crop: str, assignments: Sequence[str]
) -> tuple[Detector, dict[str, Any]]:
    """Return the detector with a crop and settings as --crop and --set state them, and all of its settings."""
    from detectors import detector_type, load_detector

    settings: dict[str, Any] = {}
    known = detector_type(arguments.detector).settings_type
    if "crop" in known.model_fields:
        # of several views --crop is the mapping's, and so is --target
        settings["crop"] = crop_from_text(crop, arguments.target if crop == arguments.crop else None)
    elif arguments.target is not None:
        raise UserError(f"--target {arguments.target}: detector {arguments.detector} has no crop that could take it")
    if "surface" in known.model_fields and not any(each.startswith(STATED_SURFACE) for each in assignments):
        settings["surface"] = {"shape": "auto"}
    for assignment in assignments:
        assign(settings, assignment)
    detector = load_detector(arguments.detector, settings)
    return detector, known.from_data(settings).to_data()


def mapping_of(arguments: argparse.Namespace) -> MappingConfig:
    """Return the settings from views to one cloud. Raises UserError where they are not legal, every problem at once."""
    from detectors.mapping.settings import MappingConfig
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


def crop_from_text(text: str, target: int | None = None) -> dict[str, Any]:
    """Return the crop's declaration from ``auto``, ``none``, ``box:..`` or ``polygon:..``, with the number of the
    automatic crop's candidate where one is chosen. Raises UserError on anything else."""
    kind, _, values = text.partition(":")
    if target is not None and text != "auto":
        raise UserError(
            f"--target {target}: chooses among the surfaces that the automatic crop finds, and --crop {text} is"
            " another crop",
            legal="--target with --crop auto",
            fix="leave out one of the two",
        )
    try:
        numbers = [float(value) for value in values.split(",")] if values else []
    except ValueError as error:
        raise UserError(f"--crop {text}: not all of its values are numbers", legal=LEGAL_CROP) from error
    if kind in ("auto", "none") and not numbers:
        return {"kind": kind} if target is None else {"kind": kind, "target": target}
    if kind == "box" and len(numbers) == 6:
        x, y, z = numbers[0:2], numbers[2:4], numbers[4:6]
        for axis, (low, high) in zip("xyz", (x, y, z), strict=True):
            if not low < high:
                raise UserError(
                    f"--crop {text}: {axis}0 = {low:g} is not below {axis}1 = {high:g}",
                    legal=LEGAL_CROP,
                    fix="state the smaller bound of each axis first",
                )
        return {"kind": "box", "x_mm": x, "y_mm": y, "z_mm": z, "range_max_m": None}
    if kind == "polygon" and len(numbers) >= 6 and len(numbers) % 2 == 0:
        return {"kind": "polygon", "vertices_px": [numbers[i : i + 2] for i in range(0, len(numbers), 2)]}
    raise UserError(f"--crop {text}: no such crop", legal=LEGAL_CROP)


def assign(settings: dict[str, Any], assignment: str) -> None:
    """Put one KEY=VALUE into nested settings; the value is JSON where it can be, else text. UserError without one."""
    path, equals, text = assignment.partition("=")
    if not (path and equals):
        raise UserError(f"--set {assignment}: no value", legal="KEY=VALUE, for instance surface.degree=5")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = text
    *folders, leaf = path.split(".")
    for folder in folders:
        settings = settings.setdefault(folder, {})
        if not isinstance(settings, dict):
            raise UserError(f"--set {assignment}: {folder} is a value, not a group")
    settings[leaf] = value


def opened(arguments: argparse.Namespace, paths: list[Path]) -> Recording:
    """Open a capture; --intrinsics may name a camera, whose nominal lens then counts."""
    from detectors.recordings import open_capture

    lens, file = None, None
    if arguments.intrinsics is not None:
        from scenes.sensor.camera import lens_named, lens_names

        file = Path(arguments.intrinsics)
        if arguments.intrinsics in lens_names():
            lens, file = lens_named(arguments.intrinsics), None
        elif not file.exists():
            legal = f"a file, or one of the cameras {', '.join(lens_names())}"
            raise UserError(f"--intrinsics {file}: no such file and no such camera", legal=legal)
    return open_capture(
        paths,
        unit=arguments.unit,
        intrinsics=file,
        lens=lens,
        frames=slice(arguments.max_frames) if arguments.max_frames else None,
        topic=arguments.topic,
        array=arguments.array,
        pitch=arguments.pitch,
        raw=arguments.raw,
    )


def averaged(arguments: argparse.Namespace, recording: Recording) -> Cloud:
    """Return the capture's average as --average says."""
    from itertools import islice

    from detectors.average import AverageConfig, average
    from detectors.noise import REACH_FRAMES, noise_reach_px

    cloud = average(recording, AverageConfig(method=arguments.average))
    reach_px = noise_reach_px(list(islice(recording.frames(), REACH_FRAMES))) if cloud.organised else 0.0
    return replace(cloud, projection=recording.projection, noise_reach_px=reach_px)
