"""``tofpod ask``: which camera finds a damage, at which distance, with how many frames, by stored
limits."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.records.outputs import ATLAS_PAGE, ATLAS_PICTURE
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped, write_text
from harness.vocabulary.program import length_m, program

if TYPE_CHECKING:
    from harness.programs.atlas.limits import LimitSurface

STORED = "atlas.parquet"
KINDS = {"hole": "through", "through-hole": "through", "blind-hole": "blind", "crack": "slot"}
BEST = "matched"


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
    "State which cameras find damage of a given size nine times out of ten at a given distance, with how many frames, "
    "from a stored table of limits of simulated set-ups (experiments/atlas.yaml), with intervals. Nothing is "
    "extrapolated.",
    epilog="example: tofpod ask --damage hole --size 5mm --distance 1m",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 for any answer, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.atlas.limits import surfaces_of
    from harness.programs.atlas.tables import ATLAS, curves
    from harness.records.schema import write_table
    from scenes.sensor.camera import load_camera

    ends = sum(given is not None for given in (options.size, options.distance))
    if ends == 1 or (not ends and options.out is None):
        legal = "--damage hole --size 5mm --distance 1m, or --out DIR for the whole atlas"
        raise UserError("--size and --distance are needed", legal=legal)
    limits, about = _read(options.atlas or shipped("baselines") / STORED)
    surfaces = surfaces_of(limits)
    titles = {
        name: load_camera(name).title
        for name in dict.fromkeys(surface.camera for surface in surfaces)
    }
    if ends:
        _answer(options, surfaces, titles, about)
    if options.out is not None:
        from harness.programs.atlas.page import atlas_html, save_atlas_png

        rows = curves(surfaces, titles)
        write_table(options.out, ATLAS, ATLAS.frame(rows), about)
        write_text(
            options.out / ATLAS_PAGE.name, atlas_html(rows, _warnings(titles), about, command)
        )
        save_atlas_png(options.out / ATLAS_PICTURE.name, rows)
        print(
            f"wrote {options.out / ATLAS_PAGE.name}, {ATLAS_PICTURE.name}, {', '.join(ATLAS.files)}"
        )
    return 0


def _read(path: Path) -> tuple[Any, dict[str, Any]]:
    """Return the table of limits and the data that is stored with it. Raises UserError if it is no
    such table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from harness.programs.atlas import limits as atlas

    file = path / "limits.parquet" if path.is_dir() else path
    legal = (
        "limits.parquet of a study over cameras and distances, as experiments/atlas.yaml makes it"
    )
    if not file.is_file():
        raise UserError(
            f"{file}: there is no such table of limits", legal=legal, fix="run tofpod sweep atlas"
        )
    try:
        table = pq.read_table(file)
    except (OSError, pa.ArrowException) as error:
        raise UserError(
            f"{file}: cannot be read as a table of limits: {error}", legal=legal
        ) from error
    needed = (
        atlas.CAMERA,
        atlas.DAMAGE,
        atlas.AXES["distance_m"],
        "frames",
        "a90_mm",
        "a90_low_mm",
        "largest_mm",
    )
    if missing := [name for name in needed if name not in table.column_names]:
        raise UserError(f"{file}: lacks the columns {', '.join(missing)}", legal=legal)
    return table.to_pandas(), json.loads((table.schema.metadata or {}).get(b"tofpod", b"{}"))


def _warnings(cameras: Iterable[str]) -> list[str]:
    """Return warnings about cameras whose precision is a guess, with a common warning for equal
    guesses."""
    from scenes.sensor.camera import guessed_precision, load_camera

    alike: dict[str, list[str]] = {}
    for camera in map(load_camera, dict.fromkeys(cameras)):
        if text := guessed_precision(camera):
            alike.setdefault(text.replace(camera.title, "{}"), []).append(camera.title)
    form = {
        text: text if len(who) == 1 else text.replace("its noise", "their noise")
        for text, who in alike.items()
    }
    return [form[text].format("; ".join(who)) for text, who in alike.items()]


def _answer(
    options: argparse.Namespace,
    surfaces: Sequence[LimitSurface],
    titles: dict[str, str],
    about: Any,
) -> None:
    import numpy as np

    from harness.programs.atlas.tables import ATLAS, damage_words, rows_at
    from harness.vocabulary.text import many, show

    size_mm = 1e3 * length_m("--size", options.size)
    distance_m = length_m("--distance", options.distance)
    kind = KINDS.get(options.damage, options.damage)
    chosen = _chosen(options, surfaces, kind)
    given = {
        "distance_m": [distance_m],
        "frames": [options.frames],
        "albedo": [options.albedo],
        "depth_mm": [None],
    }
    if options.depth is not None:
        given["depth_mm"] = [1e3 * length_m("--depth", options.depth)]
    for axis, values in given.items():
        computed = sorted({value for surface in chosen for value in surface.grid.get(axis, ())})
        option = f"--{axis.partition('_')[0]}"
        if values == [None]:
            if axis == "depth_mm" and len(computed) > 1:
                raise UserError(
                    f"{option} is missing",
                    legal=f"{computed[0]:g} to {computed[-1]:g} in this atlas",
                )
            given[axis] = sorted({computed[0], computed[-1]}) if computed else []
        elif not computed:
            raise UserError(
                f"{option}: the atlas has no values for {damage_words(kind)}s",
                fix=f"leave {option} out",
            )
    places = [
        dict(zip(filter(given.get, given), each, strict=True))
        for each in product(*filter(None, given.values()))
    ]
    rows = []
    whose = dict[str, set[str]]()
    for position in places:
        found, why = rows_at(chosen, titles, position, size_mm)
        rows += found
        for reason, title in why:
            whose.setdefault(reason, set()).add(title)
    all_chosen = {titles[surface.camera] for surface in chosen}
    refused = [
        reason if who == all_chosen else f"{', '.join(sorted(who))}: {reason}"
        for reason, who in whose.items()
    ]
    if not rows:
        fix = f"compute it: {_exactly(chosen[0], places[0], about)}"
        raise UserError("the atlas does not cover this: " + "; ".join(refused), fix=fix)
    for text in _warnings(row.surface.camera for row in rows):
        print(f"warning: {text}")
    verdicts = [row.answer.verdict(size_mm) for row in rows]
    counts = ", ".join(
        f"{name} for {verdicts.count(name)}" for name in ("no", "undecided") if name in verdicts
    )
    of_all = f"{verdicts.count('yes')} of {many(len(rows), 'set-up')}" + (
        f" ({counts})." if counts else "."
    )
    asked_for = f"{damage_words(kind).capitalize()}s of {size_mm:g} mm at {distance_m:g} m"
    answer = f"{asked_for} are found nine times out of ten in {of_all}"
    errors = [row.surface.error for row in rows if np.isfinite(row.surface.error)]
    left_out = f"the error of a90 at set-ups left out of the fit is {100 * max(errors, default=0):.0f} % (rms) at most"
    missed = f"; {left_out}" if errors else ""
    study = about.get("experiment", "the study")
    heads = {} if len(given["albedo"]) > 1 else {"albedo": ""}
    notes = [f"Simulated: one unit of each camera, under the conditions of {study}.yaml{missed}."]
    notes += [f"not answered: {reason}" for reason in refused]
    notes.append(
        f"to compute the first row exactly: {_exactly(rows[0].surface, rows[0].place, about)}"
    )
    show([answer, ATLAS.grid(rows, heads=heads, terminal=True), *notes])


def _chosen(
    options: argparse.Namespace, surfaces: Sequence[LimitSurface], kind: str
) -> list[LimitSurface]:
    """Return the surfaces for a question. Raises UserError if a name is not in the atlas."""
    from harness.vocabulary.words import nearest

    detectors = list(dict.fromkeys(surface.detector for surface in surfaces))
    detector = options.detector or (BEST if BEST in detectors else detectors[0])
    for name, wanted in (
        ("camera", options.camera or ()),
        ("kind", [kind]),
        ("detector", [detector]),
    ):
        in_atlas = dict.fromkeys(getattr(surface, name) for surface in surfaces)
        if unknown := [value for value in wanted if value not in in_atlas]:
            option = "--damage" if name == "kind" else f"--{name}"
            legal = [
                *(word for word, kind in KINDS.items() if name == "kind" and kind in in_atlas),
                *in_atlas,
            ]
            near = nearest(unknown[0], (*legal, *(KINDS if name == "kind" else ())))
            meant = f"; did you mean {near!r}?" if near and near != unknown[0] else ""
            what = f"{option} {options.damage if name == 'kind' else ', '.join(unknown)}: not in the atlas{meant}"
            fix = "run a study of damage that is not in the atlas, such as tofpod sweep crack"
            raise UserError(what, legal=", ".join(legal), fix=fix if name == "kind" else None)
    cameras = options.camera or [surface.camera for surface in surfaces]
    return [
        s for s in surfaces if s.kind == kind and s.detector == detector and s.camera in cameras
    ]


def _exactly(surface: LimitSurface, place: Mapping[str, float], about: dict[str, Any]) -> str:
    """Return the command of a study that computes the set-up itself."""
    from harness.programs.atlas import limits as atlas

    axes: dict[str, Any] = {atlas.CAMERA: surface.camera, "capture.frames": int(place["frames"])}
    axes[atlas.AXES["distance_m"]] = place["distance_m"]
    parts = [f"tofpod sweep {about.get('experiment', 'atlas')}"]
    depth = place.get("depth_mm")
    if depth is not None or surface.kind != "through":
        axes[atlas.DAMAGE] = json.loads(surface.damage) | (
            {} if depth is None else {"depth_mm": [depth, depth]}
        )
    if "albedo" in place:
        axes[atlas.AXES["albedo"]] = place["albedo"]
    swept = {path: [value] for path, value in axes.items()}
    return " ".join(
        [*parts, "--set study.boards=36 --set", shlex.quote(f"sweep={json.dumps(swept)}")]
    )


if __name__ == "__main__":
    raise SystemExit(main())
