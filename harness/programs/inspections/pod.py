"""``tofpod pod``: fits the probability of detection to the user's own inspections
(MIL-HDBK-1823A)."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.evaluation.pod.inspections import Inspections
    from harness.evaluation.pod.statement import PodStatement
    from harness.evaluation.study.record import SetUpRecord
    from harness.programs.inspections.mapod import Mapod

LINKS = ("logit", "probit", "cloglog", "loglog")


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    switch = argparse.BooleanOptionalAction
    add(
        "file",
        type=Path,
        metavar="FILE",
        help="CSV or Excel (.xlsx): a header row, then one row per inspection",
    )
    add("--size", required=True, metavar="COL", help="column of the flaws' true sizes")
    hits = (
        "column with 1 (found) and 0 (missed), yes and no, or hit and miss; give it once for each "
        "inspector"
    )
    add("--hit", metavar="COL", action="append", help=hits)
    add("--ahat", metavar="COL", help="column of signals, instead of --hit; needs --decision")
    add(
        "--target",
        metavar="COL",
        help="column of the flaws' names, if some were inspected more than once",
    )
    add(
        "--unit",
        default="",
        metavar="UNIT",
        help="unit of the sizes, for the labels: mm, inch, ...",
    )
    add("--out", type=Path, default=Path("results/pod"), metavar="DIR", help="default: results/pod")
    least = "(default: the choice with the lower deviance)"
    add("--log", action=switch, help=f"use the logarithm of the sizes, or not {least}")
    put = parser.add_argument_group("with --hit").add_argument
    put(
        "--link",
        choices=LINKS,
        help="shape of the curve (default: the shape with the least deviance)",
    )
    put = parser.add_argument_group("with --ahat").add_argument
    put(
        "--decision",
        type=float,
        metavar="Y",
        help="a flaw is called if its signal is higher than this",
    )
    put(
        "--left",
        type=float,
        metavar="Y",
        help="signals at or below this value are censored (noise)",
    )
    put(
        "--right",
        type=float,
        metavar="Y",
        help="signals at or above this value are censored (saturation)",
    )
    put("--log-signal", action=switch, help=f"use the logarithm of the signals, or not {least}")
    prior_help = (
        "with --prior: model-assisted POD (MAPOD), a simulated curve corrected by these hits and "
        "misses"
    )
    put = parser.add_argument_group(prior_help).add_argument
    prior = "folder of a study, simulated or by virtual damage (tofpod implant)"
    put("--prior", type=Path, metavar="STUDY", help=prior)
    put("--set-up", metavar="NAME", help='set-up of the study: "50 frames"')
    put(
        "--board",
        metavar="COL",
        help="column of the boards' names, in the order in which they were inspected",
    )


@program(
    _options,
    "Fit a probability of detection curve to inspections, one per row of a table, and state the "
    "size that is found 90 % of the time with 95 % confidence (a90/95). Write pod.json, pod.png "
    "and pod.html.",
    "tofpod pod inspections.csv --hit found --size length --unit mm",
    "tofpod pod inspections.csv --ahat depth --decision 0.8 --size length_mm --out pod",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if no limit is demonstrated), 2 for a user's mistake, 130
    after Ctrl-C."""
    from harness.programs.inspections.mapod_page import mapod_html, mapod_parts, save_mapod_png
    from harness.report.pod import pod_html, pod_parts, save_pod_png
    from harness.vocabulary.files import write_json, write_text
    from harness.vocabulary.provenance import RESULTS_VERSION
    from harness.vocabulary.text import show

    stem = "pod" if options.prior is None else "mapod"
    data = options.out / f"{stem}.json"
    picture = options.out / f"{stem}.png"
    page = options.out / f"{stem}.html"
    if options.prior is None:
        statement = _stated(options)
        show(pod_parts(statement))
        facts = statement.to_data()
        save_pod_png(picture, statement)
        write_text(page, pod_html(statement, command))
    else:
        mapod = _corrected(options)
        show(mapod_parts(mapod))
        facts = mapod.to_data()
        save_mapod_png(picture, mapod)
        write_text(page, mapod_html(mapod, command))
    write_json(data, {"results_version": RESULTS_VERSION, **facts, "command": command})
    print(f"wrote {data}, {picture.name}, {page.name}")
    return 0


def _corrected(options: argparse.Namespace) -> Mapod:
    """Return a study's curve corrected by the inspections."""
    from harness.evaluation.pod import inspections as table
    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record, set_up_named
    from harness.programs.inspections.mapod import Mapod

    for name in ("ahat", "decision", "left", "right", "log_signal", "link", "log"):
        if getattr(options, name) is not None:
            fix = "leave it out, since the study's curve determines it"
            raise UserError(f"--{name.replace('_', '-')} cannot be combined with --prior", fix=fix)
    if not options.hit or len(options.hit) != 1 or options.unit not in ("", "mm"):
        legal = "--hit COL once, with sizes in mm like those of a study"
        raise UserError("--prior corrects a curve by hits and misses", legal=legal)
    study = read_record(options.prior)
    limit = limit_of(set_up_named(study, options.set_up))
    read = table.read_inspections(options.file, options.size, options.hit, options.target)
    table.require_positive(read, response=False, why="--prior")
    if read.targets < len(read.size):
        raise UserError(
            f"{options.file}: some targets appear more than once",
            fix="keep one inspection of each target",
        )
    boards = table.texts_of(read, options.board) if options.board else None
    doubt = _unlike(read, limit.record, study.hit_radius_mm)
    return Mapod.of(limit.record.label, limit.statement, limit.why, read, boards, doubt)


def _unlike(read: Inspections, study: SetUpRecord, radius_mm: float) -> str:
    """Return a remark if the real hits were counted differently from the study's, or if the table
    does not show how."""
    from harness.evaluation.pod.inspections import texts_of

    def rule(detector: str, threshold: float, hit_radius_mm: float) -> str:
        return f"by {detector} at a threshold of {threshold:.3g}, within {hit_radius_mm:.3g} mm"

    study_rule = rule(f"{study.detector} {study.detector_version}", study.threshold, radius_mm)
    real = {f"in a way that {read.path.name} does not state"}
    with suppress(UserError, ValueError):
        detectors = texts_of(read, "detector")
        thresholds = texts_of(read, "threshold")
        radii_mm = texts_of(read, "hit_radius_mm")
        real = {
            rule(detector, float(threshold), float(hit_radius_mm))
            for detector, threshold, hit_radius_mm in zip(
                detectors, thresholds, radii_mm, strict=True
            )
        }
    if real == {study_rule}:
        return ""
    return f"real hits were counted {'; '.join(sorted(real))}; those of the study {study_rule}"


def _stated(options: argparse.Namespace) -> PodStatement:
    """Return the statement on the inspections alone."""
    from harness.evaluation.pod import inspections as table
    from harness.evaluation.pod import statement as pod

    for name in ("set_up", "board"):
        if getattr(options, name) is not None:
            option = name.replace("_", "-")
            raise UserError(f"--{option} belongs to --prior", fix="add --prior, or leave it out")
    of_hits = options.hit is not None
    legal = "--hit COL with 0 and 1, or --ahat COL with signals and --decision Y"
    if of_hits == (options.ahat is not None):
        problem = "one of them, not both" if of_hits else "no column states what was found"
        raise UserError(
            f"--hit and --ahat: {problem}",
            legal=legal,
            fix="name one column; the program does not guess",
        )
    owner = "--hit"
    foreign: tuple[str, ...] = ("link",)
    if of_hits:
        owner = "--ahat"
        foreign = ("decision", "left", "right", "log_signal")
    for name in foreign:
        if getattr(options, name) is not None:
            raise UserError(f"--{name.replace('_', '-')} belongs to {owner}", fix="leave it out")
    if not of_hits and options.decision is None:
        legal = "a signal, in the column's unit"
        fix = "add --decision Y; a value for a wanted rate of false calls comes from hole-free runs"
        raise UserError(
            "--ahat needs --decision, the signal above which a flaw is called", legal=legal, fix=fix
        )
    responses = options.hit if of_hits else [options.ahat]
    read = table.read_inspections(
        options.file, options.size, responses, options.target, hits=of_hits
    )
    if of_hits and read.response.min() == read.response.max():
        kind = "hits" if read.response[0] else "misses"
        problem = f"{read.path}: all {len(read.response)} rows of {read.response_column} are {kind}"
        raise UserError(
            f"{problem}, but a curve needs both hits and misses", fix="add targets of other sizes"
        )
    if options.log:
        table.require_positive(read, response=False, why="--log")
    if of_hits:
        return pod.state_hits(read, link=options.link, log_size=options.log, unit=options.unit)
    if options.log_signal and options.left is None:
        table.require_positive(read, response=True, why="--log-signal")
    return pod.state_signals(
        read,
        log_size=options.log,
        decision=options.decision,
        left=options.left,
        right=options.right,
        log_signal=options.log_signal,
        unit=options.unit,
    )


if __name__ == "__main__":
    raise SystemExit(main())
