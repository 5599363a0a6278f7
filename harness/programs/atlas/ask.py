"""``tofpod ask``: which camera finds a damage, at which distance, with how many frames, by stored
limits."""

from __future__ import annotations

import argparse
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.records.outputs import ATLAS_PAGE, ATLAS_PICTURE
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped, write_text
from harness.vocabulary.program import length_m, program
from harness.vocabulary.words import damage_kind, nearest

if TYPE_CHECKING:
    from harness.programs.atlas.limits import Conditions, LimitSurface
    from harness.programs.atlas.stored import CameraLimits
    from harness.programs.atlas.tables import Row

KINDS = ("through", "blind", "dent", "slot", "gouge")
"""Kinds of damage that are answered; a gouge as a slot."""
SIZE_OF = {"slot": "width"}
"""What a size is of; of all others, the diameter."""
ALBEDO = 0.6
MOST_WARNINGS = 2
"""Most warnings about single cameras."""
GUESSED_FACTORS = re.compile(r"may be ([\d.]+) to ([\d.]+) times")
"""What a camera's warning says of its noise (`scenes.sensor.camera.guessed_precision`)."""
SCRATCH = (
    "A scratch (gouge) is answered as a slot of that width and depth; one with a V-shaped section"
    " is shallower on average, so that its limit is larger."
)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--damage",
        default="hole",
        metavar="KIND",
        help="hole (through the part; the default), blind, dent, crack or scratch",
    )
    add(
        "--size",
        metavar="LENGTH",
        help="diameter of a hole or dent, width of a crack, such as 5mm or 0.25in (default: none;"
        " the answer is the size that is found)",
    )
    add("--depth", metavar="LENGTH", help="depth of the damage; not of a hole through the part")
    add(
        "--backing",
        metavar="LENGTH",
        help="distance of the surface behind a hole through the part (default: 20mm)",
    )
    add("--distance", metavar="LENGTH", help="distance from camera to target, such as 1m")
    add("--frames", type=int, metavar="N", help="frames averaged (default: the fewest and most)")
    add(
        "--albedo",
        type=float,
        metavar="A",
        default=ALBEDO,
        help=f"albedo of the target, 0.1 black to 0.9 white (default: {ALBEDO}, bright wood)",
    )
    add(
        "--camera",
        action="append",
        metavar="NAME",
        help="only this camera, by its name or part of it (femto bolt), or your own camera's"
        " file; may be repeated",
    )
    add("--atlas", type=Path, metavar="FILE", help="atlas of tofpod atlas (default: tofpod's own)")
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for a page that opens at the question ({ATLAS_PAGE.name}), a picture and"
        " atlas.csv",
    )


@program(
    _options,
    "State which cameras find damage of a given size nine times out of ten at a given distance,"
    " with how many frames, from a stored table of limits of simulated set-ups (tofpod atlas),"
    " with intervals. Nothing is extrapolated.",
    "tofpod ask --damage hole --size 5mm --distance 1m",
    "tofpod ask --damage blind --depth 4mm --distance 1m --camera pmd_flexx2",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 for any answer, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.atlas.age import age_of
    from harness.programs.atlas.stored import STORED, read_atlas

    if options.distance is None:
        raise UserError(
            "--distance is missing",
            legal="--damage hole --size 5mm --distance 1m, or without --size for the size found",
        )
    called = damage_kind("--damage", options.damage.lower().removesuffix("s"), KINDS)
    kind = "slot" if called == "gouge" else called
    shards = read_atlas(options.atlas or shipped("baselines") / STORED)
    chosen = _chosen(options.camera, shards)
    used = {shard.camera: shard for shard, _ in chosen}
    age = age_of((name, shard.about) for name, shard in used.items())
    if age:
        print(age)
    surfaces = [surface for shard, name in chosen for surface in shard.surfaces(kind, name)]
    problems = _problems(used.values(), kind)
    if not surfaces:
        raise UserError(
            f"--damage {options.damage}: is not in this atlas: {'; '.join(problems) or 'no law'}"
        )
    asked = _asked(options, kind, surfaces)
    size_mm = math.nan if options.size is None else _mm("--size", options.size)
    rows, reasons = _answers(surfaces, asked, size_mm)
    if not rows:
        raise UserError(
            f"the atlas does not cover this: {'; '.join(reasons)}",
            fix=f"compute it: {_exactly(surfaces[0], asked[0])}",
        )
    warnings = _warnings(used.values())
    answer = _headline(kind, asked, rows, size_mm)
    notes = [
        *_next_best(rows, size_mm),
        *_deep_enough(rows),
        _basis(rows),
        *_assumed(kind, rows, used.values()),
    ]
    if not options.camera:
        notes += _same(used.values())
    if called == "gouge":
        notes.append(SCRATCH)
    notes += [f"not answered: {reason}" for reason in [*reasons, *problems]]
    exact = f"to compute the first row exactly: {_exactly(rows[0].surface, rows[0].conditions)}"
    _show(rows, answer, warnings, [*notes, exact])
    if options.out is not None:
        heads = [age, *warnings] if age else warnings
        about = next(iter(used.values())).about
        _write_page(options.out, rows, asked, answer, [heads, notes], about, command)
    return 0


def _chosen(
    asked: Sequence[str] | None, shards: Sequence[CameraLimits]
) -> list[tuple[CameraLimits, str]]:
    """Return each camera of the question as a shard and the name that it is shown as. Raises
    UserError for a name that is not in the atlas."""
    if not asked:
        return [(shard, shard.camera) for shard in shards]
    every = [(shard, name) for shard in shards for name in shard.titles]
    chosen: dict[str, tuple[CameraLimits, str]] = {}
    for word in asked:
        for shard, name in _named(word, every):
            chosen[name] = (shard, name)
    return list(chosen.values())


def _named(word: str, every: Sequence[tuple[CameraLimits, str]]) -> list[tuple[CameraLimits, str]]:
    """Return the cameras that a word names: that name, or all whose name or title has all of its
    parts. Raises UserError, with the nearest name."""
    exact = [pair for pair in every if pair[1] == word]
    if exact:
        return exact
    if word.endswith((".yaml", ".yml")):
        return [_same_numbers(word, every)]
    sought = _parts(word)
    similar = []
    for shard, name in every:
        if sought and sought <= _parts(f"{name} {shard.titles[name]}"):
            similar.append((shard, name))
    if similar:
        return similar
    words = {}
    for shard, name in every:
        words[name] = name
        words[shard.titles[name]] = name
    meant = nearest(word, words)
    hint = f"; did you mean {words[meant]!r}?" if meant else ""
    raise UserError(
        f"--camera {word}: is not in the atlas{hint}",
        legal=", ".join(name for _, name in every),
        fix="for a camera of your own, give its file (.yaml)",
    )


def _parts(name: str) -> set[str]:
    """Return the words and numbers of a camera's name."""
    return set(re.findall(r"[a-z]+|[0-9]+", name.lower()))


def _same_numbers(path: str, every: Sequence[tuple[CameraLimits, str]]) -> tuple[CameraLimits, str]:
    """Return the camera of the atlas that has the numbers of a user's own file. Raises UserError,
    with the command that computes it."""
    from harness.experiment.digests import CAMERA_PART, camera_digests

    digest = camera_digests([path])[f"{CAMERA_PART}{path}"]
    for shard, name in every:
        digests = shard.about.get("digests") or {}
        if digest in (digests.get(f"{CAMERA_PART}{part}") for part in (path, shard.camera)):
            return shard, name
    raise UserError(
        f"--camera {path}: the atlas has no camera of these numbers",
        fix=f"compute its limits: tofpod atlas {shlex.quote(path)}, then ask with"
        " --atlas results/atlas/atlas.json",
    )


def _asked(
    options: argparse.Namespace, kind: str, surfaces: Sequence[LimitSurface]
) -> list[Conditions]:
    """Return the set-ups that the question asks for; without an option, the usual ones. Raises
    UserError if a value is needed or cannot be."""
    from harness.programs.atlas.limits import Conditions

    distance_m = length_m("--distance", options.distance)
    depth_mm = _depth_mm(options, kind, surfaces)
    if options.frames is not None and options.frames < 1:
        raise UserError(f"--frames {options.frames}: must be 1 or more")
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}: must lie between 0 and 1")
    frames = [1, 50] if options.frames is None else [options.frames]
    return [Conditions(distance_m, options.albedo, count, depth_mm) for count in frames]


def _depth_mm(options: argparse.Namespace, kind: str, surfaces: Sequence[LimitSurface]) -> float:
    """Return the depth in question; of a hole through the part, the distance of what is behind.
    Raises UserError if it is missing, or is none of this damage."""
    from harness.programs.atlas.parts import BACKING_MM

    if kind == "through":
        if options.depth is not None:
            raise UserError(
                "--depth: a hole through the part has none",
                fix="leave it out (--backing is the distance of the surface behind), or ask for"
                " --damage blind",
            )
        return BACKING_MM if options.backing is None else _mm("--backing", options.backing)
    if options.backing is not None:
        raise UserError(
            "--backing: is seen through holes only", fix="leave it out, or ask for --damage hole"
        )
    if options.depth is None:
        ends = [depth for surface in surfaces for depth in surface.ranges["depth_mm"]]
        raise UserError(
            f"--depth is missing: how deep is the {options.damage}?",
            legal=f"{min(ends):g} to {max(ends):g} mm in this atlas; --size is its"
            f" {SIZE_OF.get(kind, 'diameter')}",
        )
    return _mm("--depth", options.depth)


def _mm(option: str, value: str) -> float:
    """Return a length with its unit in millimetres. Raises UserError."""
    return 1e3 * length_m(option, value)


def _answers(
    surfaces: Sequence[LimitSurface], asked: Sequence[Conditions], size_mm: float
) -> tuple[list[Row], list[str]]:
    """Return the rows of all conditions, and the reasons why others have none."""
    from harness.programs.atlas.tables import rows_at

    rows: list[Row] = []
    titles_by_reason: dict[str, dict[str, None]] = {}
    for conditions in asked:
        answered, refused = rows_at(surfaces, conditions, size_mm)
        rows += answered
        for reason, title in refused:
            titles_by_reason.setdefault(reason, {})[title] = None
    every = {surface.title for surface in surfaces}
    reasons = []
    for reason, titles in titles_by_reason.items():
        reasons.append(reason if set(titles) == every else f"{'; '.join(titles)}: {reason}")
    return rows, reasons


def _problems(shards: Iterable[CameraLimits], kind: str) -> list[str]:
    """Return why cameras have no law of a kind of damage."""
    reasons = []
    for shard in shards:
        if kind not in shard.kinds:
            why = "; ".join(shard.problems) or "no damage of that kind was judged"
            reasons.append(f"{shard.titles[shard.camera]}: {why}")
    return reasons


def _headline(kind: str, asked: Sequence[Conditions], rows: Sequence[Row], size_mm: float) -> str:
    """Return the answer in a sentence: what is found in how many set-ups or, without a size, which
    camera finds the smallest."""
    from harness.programs.atlas.tables import DAMAGE, order
    from harness.vocabulary.text import many

    conditions = asked[0]
    deep = "" if kind == "through" else f", {conditions.depth_mm:g} mm deep,"
    if math.isnan(size_mm):
        best = min(rows, key=order)
        if best.answer.rank_mm == math.inf:
            return (
                f"At {conditions.distance_m:g} m, {DAMAGE[kind]}s{deep} of no size inspected are"
                " found nine times out of ten."
            )
        return (
            f"At {conditions.distance_m:g} m, {best.surface.title} finds the smallest"
            f" {DAMAGE[kind]}s{deep} nine times out of ten: {_interval(best)}"
            f" with {many(best.conditions.frames, 'frame')} on albedo {best.conditions.albedo:g}."
        )
    verdicts = [row.verdict for row in rows]
    others = []
    for verdict in ("no", "undecided"):
        if verdict in verdicts:
            others.append(f"{verdict} for {verdicts.count(verdict)}")
    beside = f" ({', '.join(others)})" if others else ""
    what = f"{DAMAGE[kind].capitalize()}s of {size_mm:g} mm{deep} at {conditions.distance_m:g} m"
    count = f"{verdicts.count('yes')} of {many(len(rows), 'set-up')}{beside}"
    return f"{what} are found nine times out of ten in {count}."


def _interval(row: Row) -> str:
    """Return ``2.8 mm (2.3 to 3.6 mm)`` or ``≤ 2.1 mm``."""
    from harness.programs.atlas.tables import a90

    number, _, ends = a90(row).text(1).partition(" (")
    return f"{number} mm ({ends.removesuffix(')')} mm)" if ends else f"{number} mm"


def _next_best(rows: Sequence[Row], size_mm: float) -> list[str]:
    """Say which other camera finds the next smallest damage, and whether the order is certain;
    nothing if a size is asked for, or there is no other with a limit."""
    from harness.programs.atlas.tables import order
    from harness.vocabulary.text import many

    best, *others = sorted(rows, key=order)
    others = [row for row in others if row.surface.title != best.surface.title]
    if not math.isnan(size_mm) or not others or others[0].answer.rank_mm == math.inf:
        return []
    second = others[0]
    is_certain = second.answer.low_mm > best.answer.high_mm
    order_is = "is certain" if is_certain else "is not certain"
    frames = many(second.conditions.frames, "frame")
    return [
        f"Next: {second.surface.title}, {_interval(second)} with {frames}; by their intervals, the"
        f" order of the two {order_is}."
    ]


def _deep_enough(rows: Sequence[Row]) -> list[str]:
    """Say, where damage of this depth is found at no size, how deep it has to be; nothing where
    there is a limit, or where none is found at any depth."""
    from harness.programs.atlas.tables import deep_enough_mm
    from harness.vocabulary.text import many

    if any(row.answer.rank_mm < math.inf for row in rows):
        return []
    depths_mm = [(deep_enough_mm(row), row) for row in rows]
    depth_mm, row = min(depths_mm, key=lambda pair: pair[0])
    if depth_mm == math.inf:
        return []
    return [
        f"Found at some size inspected from a depth of about {depth_mm:.2g} mm on:"
        f" {row.surface.title}, {many(row.conditions.frames, 'frame')}."
    ]


def _warnings(shards: Iterable[CameraLimits]) -> list[str]:
    """Return the warnings about cameras whose precision is a guess: of two cameras one each, of
    more a single one, so that the answer stands on the first screen."""
    guessed = [shard for shard in shards if shard.warning]
    if len(guessed) <= MOST_WARNINGS:
        return [shard.warning for shard in guessed]
    factors: list[float] = []
    for shard in guessed:
        stated = GUESSED_FACTORS.search(shard.warning)
        if stated is not None:
            factors += [float(factor) for factor in stated.groups()]
    titles = "; ".join(shard.titles[shard.camera] for shard in guessed)
    return [
        f"the precision of {len(guessed)} cameras is not published, or only roughly: their noise is"
        f" a guess, which may be {min(factors):g} to {max(factors):g} times as much ({titles})"
    ]


def _same(shards: Any) -> list[str]:
    """Say which cameras have the same numbers as one of the table."""
    texts = []
    for shard in shards:
        first, *others = shard.titles.values()
        if others:
            texts.append(f"{'; '.join(others)} as {first}")
    return [f"The same numbers: {', '.join(texts)}."] if texts else []


def _basis(rows: Sequence[Row]) -> str:
    """Say under what conditions the limits hold, and how well the laws predict set-ups."""
    text = "Simulated: one unit of each camera, under the conditions of atlas.yaml"
    errors = [row.answer.size_error for row in rows if math.isfinite(row.answer.size_error)]
    if errors:
        text += (
            "; law error: of a90 at distances left out of the law,"
            f" {100 * max(errors):.0f} % at most"
        )
    return f"{text}."


def _assumed(kind: str, rows: Sequence[Row], shards: Any) -> list[str]:
    """Say what the limits assume that nobody has measured, and how far that moves them, by the
    study of unknowns that comes with tofpod; nothing if it does not come with one."""
    import pyarrow.parquet as pq

    from harness.programs.atlas.assumptions import STORED_UNKNOWNS, assumed

    file = shipped("baselines") / STORED_UNKNOWNS
    if not file.is_file():
        return []
    detectors = [str(shard.about.get("detector")) for shard in shards]
    frames = max(row.conditions.frames for row in rows)
    # `read_table` imports pandas, which takes a third of a second
    table = pq.ParquetFile(file).read().to_pylist()
    return assumed(table, kind, detectors[0], frames)


def _exactly(surface: LimitSurface, conditions: Conditions) -> str:
    """Return the command of a study that computes the set-up itself."""
    from harness.programs.atlas.parts import exact_overrides

    overrides = exact_overrides(surface.camera, surface.focal_px, surface.kind, conditions)
    settings = " ".join(f"--set {shlex.quote(text)}" for text in overrides)
    return f"tofpod sweep atlas --set study.boards=36 {settings}"


def _show(rows: Sequence[Row], answer: str, warnings: Sequence[str], notes: Sequence[str]) -> None:
    """Print the answer."""
    from harness.programs.atlas.tables import ATLAS
    from harness.vocabulary.text import show

    for text in warnings:
        print(f"warning: {text}")
    heads = {"found?": ""} if all(not row.verdict for row in rows) else {}
    show([answer, ATLAS.grid(rows, heads=heads, terminal=True), *notes])


def _write_page(
    out: Path,
    rows: Sequence[Row],
    asked: Sequence[Conditions],
    answer: str,
    texts: Sequence[Sequence[str]],
    about: Mapping[str, Any],
    command: str,
) -> None:
    """Write the page, the picture and the table."""
    from harness.programs.atlas.page import atlas_html, save_atlas_png
    from harness.programs.atlas.tables import ATLAS, curves
    from harness.records.schema import write_table

    warnings, notes = texts
    surfaces = list({row.surface.camera: row.surface for row in rows}.values())
    lines = curves(surfaces, asked)
    write_table(out, ATLAS, ATLAS.frame(lines), about)
    page = atlas_html(lines, rows, answer, warnings=warnings, notes=notes, command=command)
    write_text(out / ATLAS_PAGE.name, page)
    save_atlas_png(out / ATLAS_PICTURE.name, lines)
    print(f"wrote {out / ATLAS_PAGE.name}, {ATLAS_PICTURE.name}, {', '.join(ATLAS.files)}")


if __name__ == "__main__":
    raise SystemExit(main())
