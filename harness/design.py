"""``python -m harness.design``: what a study of detection limits will be able to say, before anybody drills a hole."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from harness.evaluation.pod.curve import PodCurve
    from harness.evaluation.study.record import SetUpRecord, StudyRecord
    from harness.report.design import StudyDesign

LINKS = ("logit", "probit", "cloglog", "loglog")
FILES = ("design.json", "design.png", "design.html")
TARGETS = (30, 40, 60, 120)
MOST_STUDIES = 100_000
"""Simulated studies are kept in memory."""
LEAST = 10
"""Fewer targets are no study: the same number of rows that python -m harness.pod asks for."""
MOST = 10_000
"""Nobody makes more; beyond, a simulated study takes seconds."""
FURTHEST = 2.0
"""Times the largest size inspected: a90 beyond it is no plan's guess."""
LEAST_SHARE = 0.1
"""Share of a50 for the smallest size: a curve against the size itself may begin to rise below 0."""
REPEATED = 8
"""Targets of the repeats check: a single board of holes."""


def main(arguments: list[str] | None = None) -> int:
    """The program. Returns 0 (also where no plan shows a limit), 2 on a mistake of the user, 130 after Ctrl-C."""
    given = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(given)
    return exit_code_of(lambda: _run(options, "python -m harness.design " + shlex.join(given)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.design",
        description="Plan a hit/miss study from a guess of its probability of detection curve: simulate studies, "
        "analyse them as real ones would be, and say which a90/95 to expect, how many targets it takes, and which "
        "sizes to make.",
        epilog="example: python -m harness.design --a50 5 --a90 7 --sizes 2 12 --goal 9. Takes about 5 ms a "
        "simulated study; there are two placements for each number of targets.",
    )
    add = parser.add_argument
    guess = parser.add_argument_group("the guess, told or read from a study")
    put = guess.add_argument
    put("--a50", type=float, metavar="SIZE", help="size that is found half the time")
    put("--a90", type=float, metavar="SIZE", help="size that is found nine times of ten")
    put("--link", choices=LINKS, help="shape of the curve (default: logit)")
    put("--log", action="store_true", help="the curve is against the sizes' logarithm")
    put("--study", type=Path, metavar="DIR", help="the curve of a study: its result folder, or its study.json")
    put("--set-up", metavar="NAME", help='which one of that study, as in its tables: "50 frames"')
    add("--sizes", type=float, nargs=2, metavar=("FROM", "TO"), help="sizes to choose from (default: the study's)")
    add("--unit", help="of all sizes, for the labels (default: mm)")
    add("--targets", type=int, nargs="+", default=list(TARGETS), metavar="N", help="default: 30 40 60 120")
    add(
        "--goal", type=float, metavar="SIZE", help="the a90/95 wanted: recommend the fewest targets that are sure of it"
    )
    add("--pod", type=float, default=0.9, help="the 90 of a90/95 (default: 0.9)")
    add("--confidence", type=float, default=0.95, help="the 95 of a90/95 (default: 0.95)")
    add("--studies", type=int, default=200, metavar="N", help="simulated for each plan (default: 200)")
    add("--seed", type=int, default=1, help="of the simulated studies (default: 1)")
    frames = parser.add_argument_group("how many frames to average")
    put = frames.add_argument
    put("--frames", type=int, nargs="+", metavar="N", help="carry the guess to these numbers of averaged frames")
    put("--guessed-with", type=int, metavar="N", help="frames that the guess is for (default: the study's set-up's)")
    put("--white-mm", type=float, metavar="MM", help="deviation of one frame's noise that averages out")
    put("--fixed-mm", type=float, metavar="MM", help="deviation of the error that is the same in every frame")
    repeats = parser.add_argument_group("what repeats are worth")
    put = repeats.add_argument
    put("--repeats", type=int, metavar="N", help="show the limit of this many repeats, right and wrong")
    put("--repeated-targets", type=int, metavar="N", help=f"of so many targets (default: {REPEATED})")
    calls = parser.add_argument_group("hole-free boards")
    put = calls.add_argument
    put("--false-calls-per-m2", type=float, metavar="RATE", help="wanted rate: how much has to be inspected for it")
    put("--board-m2", type=float, metavar="AREA", help="face of one hole-free board (default: the study's)")
    add("--json", action="store_true", help="print JSON instead of the table")
    add("--out", type=Path, metavar="DIR", help=f"write {', '.join(FILES)} there as well")
    return parser


class _GuessedCurve(NamedTuple):
    curve: PodCurve
    origin: str
    range_of_sizes: tuple[float, float]
    frames: int | None
    board_m2: float | None


def _run(options: argparse.Namespace, command: str) -> int:
    import json

    from harness.report.design import design_data, design_html, design_parts, save_design_png
    from harness.tables.grid import show
    from harness.vocabulary.versions import RESULTS_VERSION

    _refuse_what_does_not_belong(options)
    guess = _told(options) if options.study is None else _from_study(options)
    _check(options, guess)
    design = _designed(options, guess)
    told = {"results_version": RESULTS_VERSION, **design_data(design), "command": command}
    data_text = json.dumps(told, indent=2, allow_nan=False)
    if options.json:
        print(data_text)
    else:
        show(design_parts(design))
    if options.out is not None:
        from harness.vocabulary.files import write_text

        data, picture, page = (options.out / name for name in FILES)
        html = design_html(design, command)
        write_text(data, data_text + "\n")
        save_design_png(picture, design)
        write_text(page, html)
        # On stdout it would be no JSON any more.
        print(f"wrote {data}, {picture.name}, {page.name}", file=sys.stderr)
    return 0


def _refuse_what_does_not_belong(options: argparse.Namespace) -> None:
    told = [
        f"--{name}" for name in ("a50", "a90", "link", "log", "unit") if getattr(options, name) not in (None, False)
    ]
    if options.study is not None and told:
        raise UserError(
            f"{told[0]} and --study: the study has a curve, in mm", fix=f"leave one out: {told[0]} or --study"
        )
    if options.study is None:
        missing = [f"--{name}" for name in ("a50", "a90", "sizes") if getattr(options, name) is None]
        if missing:
            raise UserError(
                f"{', '.join(missing)}: not told",
                legal="--a50 SIZE --a90 SIZE --sizes FROM TO, or --study DIR",
                fix="guess from what is known; a plan for a guess too good is a study that demonstrates nothing",
            )
    for name, owner in (
        ("set_up", "study"),
        ("guessed_with", "frames"),
        ("white_mm", "frames"),
        ("fixed_mm", "frames"),
        ("repeated_targets", "repeats"),
        ("board_m2", "false_calls_per_m2"),
    ):
        if getattr(options, name) is not None and getattr(options, owner) is None:
            raise UserError(f"{_flag(name)} belongs to {_flag(owner)}", fix=f"add {_flag(owner)}, or leave it out")


def _told(options: argparse.Namespace) -> _GuessedCurve:
    from harness.evaluation.pod.design import curve_through

    curve = curve_through(options.a50, options.a90, options.link or "logit", log_size=options.log)
    return _GuessedCurve(curve, "as told", tuple(options.sizes), None, None)


def _from_study(options: argparse.Namespace) -> _GuessedCurve:
    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record

    study = read_record(options.study)
    record = _set_up(study, options.set_up)
    limit = limit_of(record)
    if limit.statement is None:
        raise UserError(
            f"{options.study}: {record.label} has no curve to guess from: {limit.why}",
            fix="tell a guess in place of --study: --a50 SIZE --a90 SIZE --sizes FROM TO; or name another set-up",
        )
    curve, origin = limit.statement.curve, f"fitted to {study.name}, {record.label}"
    seen, boards = record.inspected.diameter_mm, record.unflawed.area_m2
    inspected = (float(seen.min()), float(seen.max()))
    sizes = _holding_the_rise(curve, inspected, origin) if options.sizes is None else tuple(options.sizes)
    if sizes != inspected and options.sizes is None:
        origin += f"; sizes beyond the {inspected[0]:.4g} to {inspected[1]:.4g} mm that it inspected"
    area = float(boards.mean()) if len(boards) else None
    return _GuessedCurve(curve, origin, sizes, record.frames, area)


def _holding_the_rise(curve: PodCurve, inspected: tuple[float, float], origin: str) -> tuple[float, float]:
    """The sizes that a study inspected, widened to the curve's whole rise where they do not hold its a50 or its a90.

    Raises UserError where that is further than `FURTHEST` times the largest: the study says nothing about it there.
    """
    from harness.evaluation.pod.design import RISE

    (low, high), (a50, a90) = inspected, (curve.size_at(0.5), curve.size_at(0.9))
    if not a50 > 0 or a90 > FURTHEST * high:
        raise UserError(
            f"the curve {origin} has a50 = {a50:.4g} and a90 = {a90:.4g} mm, and the study inspected {low:.4g} to "
            f"{high:.4g} mm: it says too little about the rise of the curve",
            fix="run the study with damage of other sizes, or tell a guess: --a50 SIZE --a90 SIZE --sizes FROM TO",
        )
    if not low < a50:
        low = max(curve.size_at(RISE[0]), LEAST_SHARE * a50)
    if not a90 < high:
        high = min(max(high, curve.size_at(RISE[1])), FURTHEST * high)
    return low, high


def _set_up(study: StudyRecord, name: str | None) -> SetUpRecord:
    """The set-up of this label, or the only one."""
    from harness.vocabulary.declaration.diagnose import nearest

    by_label = {record.label: record for record in study.set_ups}
    if name is None and len(by_label) == 1:
        return next(iter(by_label.values()))
    if name in by_label:
        return by_label[name]
    known = "; ".join(by_label)
    if name is None:
        raise UserError(f"{study.name} has {len(by_label)} set-ups", legal=known, fix='name one: --set-up "..."')
    near = nearest(name, by_label)
    raise UserError(f"{study.name} has no set-up {name!r}" + (f"; did you mean {near!r}?" if near else ""), legal=known)


def _check(options: argparse.Namespace, guess: _GuessedCurve) -> None:
    """Refuse what would fail after minutes, or give nonsense."""
    low, high = guess.range_of_sizes
    a50 = guess.curve.size_at(0.5)
    # NaN compares false with everything, so every rule is written as what has to hold.
    if not (0 <= low < high < float("inf")):
        raise UserError(f"--sizes {low:g} {high:g}", legal="0 <= FROM < TO", fix="the smallest first")
    if not low < a50 < high:
        raise UserError(
            f"--sizes {low:g} {high:g} do not hold a50 = {a50:.4g}", legal=f"FROM < {a50:.4g} < TO", fix="widen --sizes"
        )
    if guess.curve.log_size and low == 0:
        raise UserError("--sizes from 0 under a logarithm", legal="FROM above 0")
    wrong = [number for number in options.targets if not LEAST <= number <= MOST]
    if wrong:
        raise UserError(f"--targets {wrong[0]}", legal=f"{LEAST} to {MOST}; MIL-HDBK-1823A asks for 60 at least")
    if not (0 < options.pod < 1 and 0.5 < options.confidence < 1):
        raise UserError(
            f"--pod {options.pod:g} --confidence {options.confidence:g}", legal="0 < pod < 1, 0.5 < confidence < 1"
        )
    if not LEAST <= options.studies <= MOST_STUDIES:
        legal = f"{LEAST} to {MOST_STUDIES}; quantiles of fewer mean nothing, and more take the memory"
        raise UserError(f"--studies {options.studies}", legal=legal)
    a_pod = guess.curve.size_at(options.pod)
    if options.goal is not None and not options.goal > a_pod:
        raise UserError(
            f"--goal {options.goal:g} is not above the guess's own {a_pod:.4g}",
            legal=f"more than {a_pod:.4g}",
            fix="no study can be sure to demonstrate less than the truth: improve the detector, or want less",
        )
    if options.frames is not None:
        needed = ["white_mm", "fixed_mm", *(["guessed_with"] if guess.frames is None else [])]
        missing = [_flag(name) for name in needed if getattr(options, name) is None]
        if missing:
            raise UserError(f"--frames needs {' and '.join(missing)}", fix="python -m harness.validate measures noise")
        if min(options.frames) < 1:
            raise UserError(f"--frames {min(options.frames)}", legal="1 or more")
    if options.repeats is not None and min(options.repeats, options.repeated_targets or REPEATED) < 2:
        raise UserError("--repeats: nothing is repeated", legal="two repeats of two targets at least")
    if options.false_calls_per_m2 is not None and options.board_m2 is None and guess.board_m2 is None:
        raise UserError("--false-calls-per-m2 needs --board-m2: boards of which face?", legal="square metres")


def _designed(options: argparse.Namespace, guess: _GuessedCurve) -> StudyDesign:
    from harness.evaluation.pod.design import (
        design,
        fixed_share,
        hole_free,
        plans_by_frames,
        recommend,
        repeated_studies,
    )
    from harness.report.design import StudyDesign

    asked = {name: getattr(options, name) for name in ("pod", "confidence", "studies", "seed")}
    guessed_with = guess.frames if options.guessed_with is None else options.guessed_with
    area = guess.board_m2 if options.board_m2 is None else options.board_m2
    wanted = options.false_calls_per_m2
    # Mistakes in these two come before the simulation's minute; `_check` has asked for frames and area.
    share = fixed_share(options.white_mm, options.fixed_mm, guessed_with or 0) if options.frames else 0.0
    free = hole_free(wanted, area or 0.0, options.confidence) if wanted is not None else None
    plans = design(guess.curve, sorted(set(options.targets)), guess.range_of_sizes, **asked)
    recommended = recommend(plans, options.goal)
    frames = options.frames and plans_by_frames(
        guess.curve,
        sorted(set(options.frames)),
        guessed_with=guessed_with or 0,
        fixed_share=share,
        targets=recommended.plan.targets,
        range_of_sizes=guess.range_of_sizes,
        **asked,
    )
    repeats = options.repeats and repeated_studies(
        guess.curve, options.repeated_targets or REPEATED, options.repeats, guess.range_of_sizes, **asked
    )
    return StudyDesign(
        guess=guess.curve,
        origin=guess.origin,
        unit="mm" if options.unit is None else options.unit,
        range_of_sizes=guess.range_of_sizes,
        plans=plans,
        recommended=recommended,
        goal=options.goal,
        guessed_with=guessed_with if options.frames else None,
        frames=frames or (),
        repeats=repeats or (),
        hole_free=free,
    )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


if __name__ == "__main__":
    sys.exit(main())
