"""``tofpod ask``: which camera finds a damage, at which distance, with how many frames, by stored
limits."""

from __future__ import annotations

import argparse
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.records.outputs import ATLAS_PAGE, ATLAS_PICTURE
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped, strict_json, write_text
from harness.vocabulary.program import length_m, program
from harness.vocabulary.words import DAMAGE, kind_called

if TYPE_CHECKING:
    from harness.programs.atlas.limits import LimitSurface
    from harness.programs.atlas.tables import Row

STORED = "atlas.parquet"
"""The table of limits that comes with tofpod, in baselines."""
LEGAL = "limits.parquet of a study over cameras and distances, as experiments/atlas.yaml makes it"
NEEDED_AXES = ("source.target.distance_m", "frames")
NUMBERS = ("a90_mm", "a90_low_mm", "a90_high_mm", "largest_mm", "hits")
IS_AT_MOST = "is_at_most"
BEST = "matched"
"""The detector that is asked for if the atlas has it."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--damage",
        default="through",
        metavar="KIND",
        help="hole (through; the default), blind, dent, ...",
    )
    add(
        "--size",
        metavar="LENGTH",
        help="size of the damage (diameter of a hole), such as 5mm or 0.25in",
    )
    add("--depth", metavar="LENGTH", help="depth of the damage, if the atlas has several")
    add("--distance", metavar="LENGTH", help="distance from camera to target, such as 1m")
    add(
        "--frames",
        type=int,
        metavar="N",
        help="frames averaged (default: the fewest and the most of the atlas)",
    )
    add(
        "--albedo",
        type=float,
        metavar="A",
        help="albedo of the target (default: the extremes of the atlas)",
    )
    add("--camera", action="append", metavar="NAME", help="only this camera; may be repeated")
    add("--detector", metavar="NAME", help=f"only this detector (default: {BEST}, else the first)")
    add(
        "--atlas",
        type=Path,
        metavar="PATH",
        help="limits.parquet of a study, or its folder (default: tofpod's own)",
    )
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the whole atlas: {ATLAS_PAGE.name}, a picture, atlas.csv",
    )


@program(
    _options,
    "State which cameras find damage of a given size nine times out of ten at a given distance,"
    " with how many frames, from a stored table of limits of simulated set-ups"
    " (experiments/atlas.yaml), with intervals. Nothing is extrapolated.",
    "tofpod ask --damage hole --size 5mm --distance 1m",
    "tofpod ask --size 0.25in --distance 70cm --camera azure_kinect_nfov --frames 50",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 for any answer, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.atlas.age import age_of
    from harness.programs.atlas.limits import surfaces_of
    from scenes.sensor.camera import load_camera

    has_question = options.size is not None and options.distance is not None
    is_partial = (options.size is None) != (options.distance is None)
    if is_partial or (not has_question and options.out is None):
        raise UserError(
            "--size and --distance are needed",
            legal="--damage hole --size 5mm --distance 1m, or --out DIR for the whole atlas",
        )
    limits, about = _read(options.atlas or shipped("baselines") / STORED)
    surfaces = surfaces_of(limits)
    cameras = dict.fromkeys(surface.camera for surface in surfaces)
    titles = {camera: load_camera(camera).title for camera in cameras}
    age = age_of(limits, about)
    if age:
        print(age)
    if has_question:
        _answer(options, surfaces, titles, about)
    if options.out is not None:
        warnings = [age, *_warnings(titles)] if age else _warnings(titles)
        _write_atlas(options.out, surfaces, titles, about, warnings=warnings, command=command)
    return 0


def _write_atlas(
    out: Path,
    surfaces: Sequence[LimitSurface],
    titles: Mapping[str, str],
    about: Mapping[str, Any],
    *,
    warnings: Sequence[str],
    command: str,
) -> None:
    """Write the page, the picture and the table of the whole atlas."""
    from harness.programs.atlas.page import atlas_html, save_atlas_png
    from harness.programs.atlas.tables import ATLAS, curves
    from harness.records.schema import write_table

    rows = curves(surfaces, titles)
    write_table(out, ATLAS, ATLAS.frame(rows), about)
    page = atlas_html(rows, warnings, about, command)
    write_text(out / ATLAS_PAGE.name, page)
    save_atlas_png(out / ATLAS_PICTURE.name, rows)
    print(f"wrote {out / ATLAS_PAGE.name}, {ATLAS_PICTURE.name}, {', '.join(ATLAS.files)}")


def _read(path: Path) -> tuple[Any, dict[str, Any]]:
    """Return the table of limits and the data that is stored with it. Raises UserError if it is no
    such table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = path / "limits.parquet" if path.is_dir() else path
    if not file.is_file():
        raise UserError(
            f"{file}: there is no such table of limits", legal=LEGAL, fix="run tofpod sweep atlas"
        )
    try:
        table = pq.read_table(file)
        limits = table.to_pandas()
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise UserError(
            f"{file}: cannot be read as a table of limits: {error}", legal=LEGAL
        ) from error
    _refuse_odd(file, limits)
    metadata = table.schema.metadata or {}
    try:
        about = strict_json(metadata.get(b"tofpod", b"{}"), nan=True)
        if not isinstance(about, dict) or not isinstance(about.get("experiment", ""), str):
            raise ValueError("it is not a mapping that names an experiment")
    except ValueError as error:
        problem = f"{file}: the data beside the table cannot be read ({error})"
        raise UserError(problem, legal=LEGAL) from error
    return limits, about


def _refuse_odd(file: Path, limits: Any) -> None:
    """Raise UserError if a table lacks rows or columns, or holds other values than limits."""
    import numpy as np
    from pandas.api.types import is_bool_dtype, is_integer_dtype, is_numeric_dtype

    from harness.programs.atlas.age import VERSION
    from harness.programs.atlas.limits import AXES, CAMERA, DAMAGE, DETECTOR, damage_of

    if limits.columns.duplicated().any():
        raise UserError(f"{file}: has two columns of one name", legal=LEGAL)
    detector = DETECTOR if DETECTOR in limits else "detector"
    names = (CAMERA, DAMAGE, detector)
    axes = [column for column in AXES.values() if column in (*NEEDED_AXES, *limits.columns)]
    needed = (*names, *axes, *NUMBERS, IS_AT_MOST)
    missing = [name for name in needed if name not in limits]
    if missing:
        raise UserError(f"{file}: lacks the columns {', '.join(missing)}", legal=LEGAL)
    if limits.empty:
        raise UserError(f"{file}: has no row", legal=LEGAL)
    for name in names:
        if not all(isinstance(value, str) for value in limits[name]):
            raise UserError(f"{file}: {name} holds a value that is no text", legal=LEGAL)
    for name in (*axes, *NUMBERS):
        if is_bool_dtype(limits[name]) or not is_numeric_dtype(limits[name]):
            raise UserError(f"{file}: {name} holds a value that is no number", legal=LEGAL)
    for name in axes:
        values = limits[name].to_numpy(float)
        if not ((values > 0) & (values < np.inf) | np.isnan(values)).all():
            raise UserError(f"{file}: {name} holds a number that is not above 0", legal=LEGAL)
    for name in NEEDED_AXES:
        if limits[name].isna().any():
            raise UserError(f"{file}: {name} lacks a number", legal=LEGAL)
    if VERSION in limits and not is_integer_dtype(limits[VERSION]):
        raise UserError(f"{file}: {VERSION} holds a value that is no whole number", legal=LEGAL)
    if not is_bool_dtype(limits[IS_AT_MOST]):
        raise UserError(
            f"{file}: {IS_AT_MOST} holds a value that is not true or false", legal=LEGAL
        )
    if (limits["a90_mm"] <= 0).any():
        raise UserError(f"{file}: a90_mm holds a size that is not above 0", legal=LEGAL)
    for text in limits[DAMAGE].unique():
        try:
            damage_of(text)
        except ValueError as error:
            problem = f"{file}: {DAMAGE} holds {text[:60]!r}, which declares no damage ({error})"
            raise UserError(problem, legal=LEGAL) from error


def _warnings(cameras: Iterable[str]) -> list[str]:
    """Return warnings about cameras whose precision is a guess, with a common warning for equal
    guesses."""
    from scenes.sensor.camera import guessed_precision, load_camera

    titles_by_form: dict[str, list[str]] = {}
    for camera in map(load_camera, dict.fromkeys(cameras)):
        text = guessed_precision(camera)
        if text:
            form = text.replace(camera.title, "{}")
            titles_by_form.setdefault(form, []).append(camera.title)
    warnings = []
    for form, titles in titles_by_form.items():
        if len(titles) > 1:
            form = form.replace("its noise", "their noise")
        warnings.append(form.format("; ".join(titles)))
    return warnings


def _answer(
    options: argparse.Namespace,
    surfaces: Sequence[LimitSurface],
    titles: Mapping[str, str],
    about: Mapping[str, Any],
) -> None:
    """Print the answer to a question: a sentence, the table of set-ups, and notes."""
    from harness.programs.atlas.tables import ATLAS, damage_words, rows_at
    from harness.vocabulary.text import show

    size_mm = 1e3 * length_m("--size", options.size)
    distance_m = length_m("--distance", options.distance)
    kind = kind_called(options.damage)
    chosen = _chosen(options, surfaces, kind)
    values = _values(options, chosen, kind, distance_m)
    positions = _positions(values)
    rows: list[Row] = []
    cameras_by_reason: dict[str, set[str]] = {}
    for position in positions:
        answered, refused = rows_at(chosen, titles, position, size_mm)
        rows += answered
        for reason, title in refused:
            cameras_by_reason.setdefault(reason, set()).add(title)
    all_chosen = {titles[surface.camera] for surface in chosen}
    reasons = [
        reason if cameras == all_chosen else f"{', '.join(sorted(cameras))}: {reason}"
        for reason, cameras in cameras_by_reason.items()
    ]
    if not rows:
        raise UserError(
            f"the atlas does not cover this: {'; '.join(reasons)}",
            fix=f"compute it: {_exactly(chosen[0], positions[0], about)}",
        )
    for text in _warnings(row.surface.camera for row in rows):
        print(f"warning: {text}")
    asked = f"{damage_words(kind).capitalize()}s of {size_mm:g} mm at {distance_m:g} m"
    answer = f"{asked} are found nine times out of ten in {_counts(rows)}."
    exact = _exactly(rows[0].surface, rows[0].position, about)
    heads = {} if len(values["albedo"]) > 1 else {"albedo": ""}
    show(
        [
            answer,
            ATLAS.grid(rows, heads=heads, terminal=True),
            _basis(rows, about),
            *_assumed(kind, rows),
            *(f"not answered: {reason}" for reason in reasons),
            f"to compute the first row exactly: {exact}",
        ]
    )


def _values(
    options: argparse.Namespace, chosen: Sequence[LimitSurface], kind: str, distance_m: float
) -> dict[str, list[float]]:
    """Return the values on each axis that the question asks for; without an option, the ends of
    the atlas. An axis that the atlas lacks has none. Raises UserError if a value is needed or
    cannot be."""
    from harness.programs.atlas.tables import damage_words

    depth_mm = None
    if options.depth is not None:
        depth_mm = 1e3 * length_m("--depth", options.depth)
    asked = {
        "distance_m": distance_m,
        "frames": options.frames,
        "albedo": options.albedo,
        "depth_mm": depth_mm,
    }
    values: dict[str, list[float]] = {}
    for axis, value in asked.items():
        computed = sorted({node for surface in chosen for node in surface.grid.get(axis, ())})
        option = f"--{axis.partition('_')[0]}"
        if value is not None:
            if not computed:
                raise UserError(
                    f"{option}: the atlas has no values for {damage_words(kind)}s",
                    fix=f"leave {option} out",
                )
            values[axis] = [value]
        elif axis == "depth_mm" and len(computed) > 1:
            raise UserError(
                f"{option} is missing",
                legal=f"{computed[0]:g} to {computed[-1]:g} in this atlas",
            )
        else:
            values[axis] = sorted({*computed[:1], *computed[-1:]})
    return values


def _positions(values: Mapping[str, Sequence[float]]) -> list[dict[str, float]]:
    """Return every combination of the values, without the axes that have none."""
    axes = [axis for axis in values if values[axis]]
    combinations = product(*(values[axis] for axis in axes))
    return [dict(zip(axes, combination, strict=True)) for combination in combinations]


def _counts(rows: Sequence[Row]) -> str:
    """Return ``3 of 8 set-ups (no for 4, undecided for 1)``."""
    from harness.vocabulary.text import many

    verdicts = [row.verdict for row in rows]
    unfavourable = [
        f"{verdict} for {verdicts.count(verdict)}"
        for verdict in ("no", "undecided")
        if verdict in verdicts
    ]
    text = f"{verdicts.count('yes')} of {many(len(rows), 'set-up')}"
    return f"{text} ({', '.join(unfavourable)})" if unfavourable else text


def _basis(rows: Sequence[Row], about: Mapping[str, Any]) -> str:
    """Say under what conditions the limits hold, and how well the surfaces predict set-ups."""
    study = about.get("experiment", "the study")
    text = f"Simulated: one unit of each camera, under the conditions of {study}.yaml"
    errors = [row.surface.error for row in rows if math.isfinite(row.surface.error)]
    if errors:
        text += (
            "; the error of a90 at set-ups left out of the fit is"
            f" {100 * max(errors):.0f} % (rms) at most"
        )
    return f"{text}."


def _assumed(kind: str, rows: Sequence[Row]) -> list[str]:
    """Say what the limits assume that nobody has measured, and how far that moves them, by the
    study of unknowns that comes with tofpod; nothing if it does not come with one."""
    import pandas as pd

    from harness.programs.atlas.assumptions import STORED_UNKNOWNS, assumed

    file = shipped("baselines") / STORED_UNKNOWNS
    if not file.is_file():
        return []
    table = pd.read_parquet(file)
    frames = int(max(row.position["frames"] for row in rows))
    axes = [axis for row in rows for axis in row.surface.grid]
    return assumed(table, kind, rows[0].surface.detector, frames, axes)


def _chosen(
    options: argparse.Namespace, surfaces: Sequence[LimitSurface], kind: str
) -> list[LimitSurface]:
    """Return the surfaces for a question. Raises UserError if a name is not in the atlas."""
    in_atlas = dict.fromkeys(surface.camera for surface in surfaces)
    cameras = options.camera or list(in_atlas)
    _refuse_unknown("--camera", [camera for camera in cameras if camera not in in_atlas], in_atlas)
    kinds = dict.fromkeys(surface.kind for surface in surfaces)
    if kind not in kinds:
        _refuse_kind(options.damage, kind, list(kinds))
    detectors = dict.fromkeys(surface.detector for surface in surfaces)
    best = BEST if BEST in detectors else next(iter(detectors))
    detector = options.detector or best
    if detector not in detectors:
        _refuse_unknown("--detector", [detector], detectors)
    return [
        surface
        for surface in surfaces
        if surface.kind == kind and surface.detector == detector and surface.camera in cameras
    ]


def _refuse_unknown(option: str, unknown: Sequence[str], in_atlas: Iterable[str]) -> None:
    """Raise UserError if a name is ``unknown``."""
    legal = list(in_atlas)
    if unknown:
        text = f"{option} {', '.join(unknown)}: not in the atlas{_meant(unknown[0], legal)}"
        raise UserError(text, legal=", ".join(legal))


def _refuse_kind(damage: str, kind: str, in_atlas: Sequence[str]) -> None:
    """Raise UserError: the ``damage`` that the user named is of a ``kind`` not in the atlas."""
    legal = [*(word for word, meant_kind in DAMAGE.items() if meant_kind in in_atlas), *in_atlas]
    raise UserError(
        f"--damage {damage}: not in the atlas{_meant(kind, [*legal, *DAMAGE])}",
        legal=", ".join(legal),
        fix="run a study of damage that is not in the atlas, such as tofpod sweep crack",
    )


def _meant(name: str, candidates: Sequence[str]) -> str:
    from harness.vocabulary.words import nearest

    word = nearest(name, candidates)
    return f"; did you mean {word!r}?" if word and word != name else ""


def _exactly(surface: LimitSurface, position: Mapping[str, float], about: Mapping[str, Any]) -> str:
    """Return the command of a study that computes the set-up itself."""
    from harness.programs.atlas.limits import AXES, CAMERA, DAMAGE

    axes: dict[str, Any] = {
        CAMERA: [surface.camera],
        "capture.frames": [int(position["frames"])],
        AXES["distance_m"]: [position["distance_m"]],
    }
    depth_mm = position.get("depth_mm")
    if depth_mm is not None or surface.kind != "through":
        damage = json.loads(surface.damage)
        if depth_mm is not None:
            damage["depth_mm"] = [depth_mm, depth_mm]
        axes[DAMAGE] = [damage]
    if "albedo" in position:
        axes[AXES["albedo"]] = [position["albedo"]]
    swept = shlex.quote(f"sweep={json.dumps(axes)}")
    experiment = about.get("experiment", "atlas")
    return f"tofpod sweep {experiment} --set study.boards=36 --set {swept}"


if __name__ == "__main__":
    raise SystemExit(main())
