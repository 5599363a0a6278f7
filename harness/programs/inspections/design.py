"""``tofpod design``: predicts what a planned study of detection limits can demonstrate."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from harness.vocabulary.errors import UserError
from harness.vocabulary.lengths import LEGAL, UNITS_M, in_unit, states_unit
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.evaluation.pod.curve import PodCurve

LINKS = ("logit", "probit", "cloglog", "loglog")
FILES = ("design.json", "design.png", "design.html")
TARGETS = (30, 40, 60, 120)
MOST_STUDIES = 100_000  # limited because simulated studies are kept in memory
# targets of a study: the rows that tofpod pod requires; nobody makes more
LEAST = 10
MOST = 10_000


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    put = parser.add_argument_group("the assumed curve, given or read from a study").add_argument
    put("--a50", metavar="SIZE", help="size that is found half the time")
    put("--a90", metavar="SIZE", help="size that is found nine times out of ten")
    put("--link", choices=LINKS, help="shape of the curve (default: logit)")
    put("--log", action="store_true", default=None, help="use the logarithm of the sizes")
    put(
        "--study",
        type=Path,
        metavar="DIR",
        help="the curve of a study: its result folder, or its study.json",
    )
    put(
        "--set-up", metavar="NAME", help='set-up of that study, as named in its tables: "50 frames"'
    )
    add(
        "--sizes",
        metavar="FROM:TO",
        help="sizes to choose from (default: the study's)",
    )
    add("--unit", help="unit of bare sizes, and of the labels (default: mm)")
    add(
        "--targets",
        type=int,
        nargs="+",
        default=list(TARGETS),
        metavar="N",
        help="default: 30 40 60 120",
    )
    goal = "the wanted a90/95: recommend the fewest targets that reach it reliably"
    add("--goal", metavar="SIZE", help=goal)
    add(
        "--studies",
        type=int,
        default=100,
        metavar="N",
        help="studies simulated for each plan (default: 100)",
    )
    put = parser.add_argument_group("hole-free boards").add_argument
    put(
        "--false-calls-per-m2",
        type=float,
        metavar="RATE",
        help="wanted rate: states how much to inspect for it",
    )
    put(
        "--board-m2",
        type=float,
        metavar="AREA",
        help="face of one hole-free board (default: the study's)",
    )
    add("--out", type=Path, metavar="DIR", help=f"also write {', '.join(FILES)} to this folder")


# a curve and its origin, sizes to choose from, and the face of a hole-free board in m2 (None if
# unknown)
Guess = tuple["PodCurve", str, tuple[float, float], float | None]


@program(
    _options,
    "Plan a hit/miss study from a guess of its probability of detection curve: simulate studies, "
    "analyse them like real ones, and state which a90/95 to expect, how many targets it takes, "
    "and which sizes to make.",
    "tofpod design --a50 5 --a90 7 --sizes 2:12",
    "tofpod design --a50 5 --a90 7 --sizes 2:12 --goal 9",
    epilog="A simulated study takes about 40 ms.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if no plan shows a limit), 2 for a user's mistake, 130
    after Ctrl-C."""
    from harness.programs.inspections import design_statistics as plan
    from harness.programs.inspections.design_page import (
        StudyDesign,
        design_data,
        design_html,
        design_parts,
        save_design_png,
    )
    from harness.vocabulary.files import write_json, write_text
    from harness.vocabulary.provenance import RESULTS_VERSION
    from harness.vocabulary.text import show

    _refuse_what_does_not_belong(options)
    _read_sizes(options)
    guess = _guess(options)
    _check(options, guess)
    curve, origin, sizes, board_m2 = guess
    wanted = options.false_calls_per_m2
    board_m2 = board_m2 if options.board_m2 is None else options.board_m2
    # refused before the simulation, which takes a minute; `_check` has required the area
    free = plan.hole_free(wanted, board_m2 or 0.0) if wanted is not None else None
    plans = plan.design(curve, sorted(set(options.targets)), sizes, studies=options.studies, seed=1)
    recommended, reaches = plan.recommend(plans, options.goal)
    design = StudyDesign(
        guess=curve,
        origin=origin,
        unit="mm" if options.unit is None else options.unit,
        range_of_sizes=sizes,
        plans=plans,
        recommended=recommended,
        reaches=reaches,
        goal=options.goal,
        hole_free=free,
    )
    show(design_parts(design))
    if options.out is not None:
        data, picture, page = [options.out / name for name in FILES]
        facts = {"results_version": RESULTS_VERSION, **design_data(design), "command": command}
        write_json(data, facts)
        save_design_png(picture, design)
        write_text(page, design_html(design, command))
        print(f"wrote {data}, {picture.name}, {page.name}")
    return 0


def _refuse_what_does_not_belong(options: argparse.Namespace) -> None:
    belonging = [
        f"--{name}"
        for name in ("a50", "a90", "link", "log", "unit")
        if getattr(options, name) is not None
    ]
    if options.study is not None and belonging:
        fix = f"leave one out: {belonging[0]} or --study"
        raise UserError(
            f"{belonging[0]} and --study both state the curve (a study's is in mm)", fix=fix
        )
    missing = [f"--{name}" for name in ("a50", "a90", "sizes") if getattr(options, name) is None]
    if options.study is None and missing:
        legal = "--a50 SIZE --a90 SIZE --sizes FROM:TO, or --study DIR"
        fix = (
            "make a careful guess; a study that is planned for an optimistic guess demonstrates "
            "nothing"
        )
        raise UserError(f"{', '.join(missing)}: not stated", legal=legal, fix=fix)
    for name, owner in (("set-up", "study"), ("board-m2", "false-calls-per-m2")):
        value = getattr(options, name.replace("-", "_"))
        owner_value = getattr(options, owner.replace("-", "_"))
        if value is not None and owner_value is None:
            raise UserError(f"--{name} belongs to --{owner}", fix=f"add --{owner}, or leave it out")


def _read_sizes(options: argparse.Namespace) -> None:
    """Replace the texts of sizes by numbers in --unit. Raises UserError for what is no size."""
    unit = options.unit or "mm"

    def size(option: str, text: str) -> float:
        value = in_unit(text, unit if unit in UNITS_M else "mm")
        if value is None or (states_unit(text) and unit not in UNITS_M):
            legal = f"a number in {unit}"
            if unit in UNITS_M:
                legal += f", or a length with a unit, {LEGAL}"
            raise UserError(f"--{option} {text}: is not a size", legal=legal)
        return value

    for name in ("a50", "a90", "goal"):
        text = getattr(options, name)
        if text is not None:
            setattr(options, name, size(name, text))
    if options.sizes is not None:
        ends = options.sizes.split(":")
        if len(ends) != 2:
            raise UserError(
                f"--sizes {options.sizes}: is not a range", legal="FROM:TO, such as 2:12"
            )
        options.sizes = tuple(size("sizes", end) for end in ends)


def _guess(options: argparse.Namespace) -> Guess:
    """Return the given curve or a study's, with the given or inspected sizes."""
    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record, set_up_named
    from harness.programs.inspections.design_statistics import curve_through

    if options.study is None:
        curve = curve_through(
            options.a50, options.a90, options.link or "logit", log_size=bool(options.log)
        )
        return curve, "as stated", tuple(options.sizes), None
    study = read_record(options.study)
    record = set_up_named(study, options.set_up)
    limit = limit_of(record)
    if limit.statement is None:
        fix = (
            "state a guess instead of --study: --a50 SIZE --a90 SIZE --sizes FROM:TO; or name "
            "another set-up"
        )
        raise UserError(f"{options.study}: {record.label} has no curve: {limit.why}", fix=fix)
    curve = limit.statement.curve
    origin = f"fitted to {study.name}, {record.label}"
    inspected_mm = record.inspected.size_mm
    boards = record.unflawed.area_m2
    sizes = options.sizes or (float(inspected_mm.min()), float(inspected_mm.max()))
    return curve, origin, tuple(sizes), float(boards.mean()) if len(boards) else None


def _check(options: argparse.Namespace, guess: Guess) -> None:
    """Refuse arguments that would fail after minutes or give meaningless results."""
    curve, _, (low, high), board_m2 = guess
    a50 = curve.size_at(0.5)
    a90 = curve.size_at(0.9)
    wrong = next((number for number in options.targets if not LEAST <= number <= MOST), None)
    # NaN compares false with everything, so every rule states the condition that must hold
    rules = (
        (
            0 <= low < high < float("inf"),
            f"--sizes {low:g}:{high:g}: not a range",
            "0 <= FROM < TO",
        ),
        (
            low < a50 < high,
            f"sizes of {low:g} to {high:g} do not include a50 = {a50:.4g}",
            "--sizes FROM < a50 < TO",
        ),
        (not curve.log_size or low > 0, "--sizes from 0 have no logarithm", "FROM above 0"),
        (
            wrong is None,
            f"--targets {wrong}",
            f"{LEAST} to {MOST}; MIL-HDBK-1823A asks for 60 at least",
        ),
        (
            LEAST <= options.studies <= MOST_STUDIES,
            f"--studies {options.studies}",
            f"{LEAST} to {MOST_STUDIES}",
        ),
    )
    for holds, problem, legal in rules:
        if not holds:
            raise UserError(problem, legal=legal)
    if options.goal is not None and not options.goal > a90:
        fix = (
            "no study can demonstrate a limit below the true a90: improve the detector, or state "
            "a larger goal"
        )
        problem = f"--goal {options.goal:g} is not above the guess's own {a90:.4g}"
        raise UserError(problem, legal=f"more than {a90:.4g}", fix=fix)
    if options.false_calls_per_m2 is not None and options.board_m2 is None and board_m2 is None:
        raise UserError(
            "--false-calls-per-m2 needs --board-m2, the area of a board", legal="square metres"
        )


if __name__ == "__main__":
    raise SystemExit(main())
