"""``tofpod gauge``: designs boards with holes to check a detection limit: drilling template and
truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.programs.inspections.gauge_read import READ
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import length, program, span

if TYPE_CHECKING:
    from harness.evaluation.pod.curve import PodCurve
    from harness.programs.inspections.gauge_board import Gauge

DICTIONARY = "DICT_6X6_50"
CODES = 50
# Side of a mark, step of drill sizes, seed of the order of sizes
MARK_MM = 32.0
DRILLS_MM = 0.5
SEED = 1
# White margin of a mark; least distance from a hole's rim to the board's edge
CLEAR_MM = 6.0
EDGE_MM = 18.0
LARGEST_MM = 5e3  # the largest size that the truth file allows
# Hit radius as a share of the distance between holes, so that no finding can hit two holes
HIT_SHARE = 0.4


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--diameters",
        required=True,
        type=span("mm"),
        metavar="FROM:TO",
        help="range of drill diameters (bare numbers: mm)",
    )
    add(
        "--depths",
        type=span("mm"),
        metavar="FROM:TO",
        help="depths of blind holes (bare: mm; default: all are through-holes)",
    )
    add(
        "--study",
        type=Path,
        metavar="DIR",
        help="plan with the curve of this study, simulated or implanted",
    )
    add("--set-up", metavar="NAME", help='set-up of that study: "50 frames"')
    add(
        "--a50",
        type=length("mm"),
        metavar="SIZE",
        help="plan with a guess: the size that is found half the time (bare: mm)",
    )
    add(
        "--a90",
        type=length("mm"),
        metavar="SIZE",
        help="and the size that is found nine times out of ten (bare: mm)",
    )
    add("--targets", type=int, default=36, metavar="N", help="total number of holes (default: 36)")
    add(
        "--board-size",
        default="270x175",
        metavar="WxH",
        help="size of a board, mm (default: 270x175, one sheet of A4)",
    )
    add(
        "--apart",
        type=length("mm"),
        default=30.0,
        metavar="LENGTH",
        help="distance between holes (bare: mm; default: 30)",
    )
    add("--paper", choices=("A4", "A3", "letter"), default="A4", help="default: A4")
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for template.pdf, board-N.svg and gauge.json",
    )


@program(
    _options,
    "Design gauge boards with coded corner marks and holes of evenly spread sizes, and state the "
    "limit that tofpod design expects of them. Write template.pdf (1:1, in tiles of the paper), "
    "an SVG for each board, and gauge.json, the truth that tofpod gauge read needs.",
    "tofpod gauge --diameters 2:12 --a50 4 --a90 6 --out gauge",
    "tofpod gauge --diameters 2:12 --study results/implant --set-up '50 frames' --out gauge",
    epilog="The holes are drilled, the board is recorded, and tofpod gauge read finds them.",
    further={"read": READ},
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.inspections import design_statistics as plan
    from harness.programs.inspections.gauge_board import GAUGE_VERSION
    from harness.programs.inspections.gauge_page import template_pdf, template_svg, tiles_of
    from harness.programs.inspections.mapod import PRIOR_SIZE
    from harness.vocabulary.files import write_bytes, write_text

    low, high = options.diameters
    if not DRILLS_MM <= low < high < LARGEST_MM:
        raise UserError(
            f"--diameters {low:g}:{high:g}", legal=f"FROM < TO, and FROM at least {DRILLS_MM:g}"
        )
    if options.depths and not 0 < options.depths[0] <= options.depths[1] < LARGEST_MM:
        shallow, deep = options.depths
        raise UserError(f"--depths {shallow:g}:{deep:g}", legal="FROM <= TO, both above 0, in mm")
    if not 10 <= options.targets <= 600:
        raise UserError(f"--targets {options.targets}", legal="10 to 600 holes")
    curve = _curve(options)
    # sizes are spread evenly: sizes only where the study's curve rises show nothing if the real
    # curve rises elsewhere
    (chosen,) = plan.design(curve, [options.targets], (low, high), studies=40, seed=SEED)
    true_mm = PRIOR_SIZE * curve.size_at(0.9)
    if not low < true_mm < high:
        print(
            f"warning: if the curve's a90 is too small by a factor of {PRIOR_SIZE:g}, the true "
            f"a90 is {true_mm:.3g} mm, which no hole of {low:g} to {high:g} mm would show; choose "
            "other --diameters"
        )
    gauge = _laid_out(options, chosen.sizes)
    text = json.dumps({"gauge_version": GAUGE_VERSION, **gauge.to_data()}, indent=1)
    write_text(options.out / "gauge.json", text + "\n")
    write_bytes(options.out / "template.pdf", template_pdf(gauge.boards, DICTIONARY, options.paper))
    for board in gauge.boards:
        write_bytes(options.out / f"{board.name}.svg", template_svg(board, DICTIONARY))
    first = gauge.boards[0]
    sheets = len(tiles_of(first.width_mm, first.height_mm, options.paper)[1])
    expected = (
        "no a90/95" if chosen.bound == float("inf") else f"a90/95 of about {chosen.bound:.3g} mm"
    )
    print(
        f"holes: {chosen.targets}; boards: {len(gauge.boards)}; sheets of {options.paper} for "
        f"each: {sheets}"
    )
    print(
        f"expected from real hits and misses alone: {expected}; tofpod pod --prior combines them "
        "with a study"
    )
    print(f"a finding within {gauge.hit_radius_mm:g} mm of a hole is a hit")
    print(
        f"wrote {options.out / 'template.pdf'}, {len(gauge.boards)} SVG, gauge.json; print at 100 %"
    )
    return 0


def _curve(options: argparse.Namespace) -> PodCurve:
    """Return the curve for planning. Raises UserError if it is stated twice or not at all."""
    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record, set_up_named
    from harness.programs.inspections.design_statistics import curve_through

    guessed = options.a50 is not None and options.a90 is not None
    if guessed == (options.study is not None):
        raise UserError(
            "planning needs exactly one curve", legal="--study DIR, or --a50 MM --a90 MM"
        )
    if guessed:
        return curve_through(options.a50, options.a90)
    limit = limit_of(set_up_named(read_record(options.study), options.set_up))
    if limit.statement is None:
        raise UserError(
            f"{options.study}: has no curve: {limit.why}", fix="state a guess with --a50 and --a90"
        )
    return limit.statement.curve


def _laid_out(options: argparse.Namespace, sizes: np.ndarray) -> Gauge:
    """Return as few boards as can hold these holes, with sizes spread over all boards in random
    order."""
    from harness.programs.inspections.gauge_board import Gauge, GaugeBoard, GaugeHole, GaugeMark
    from harness.vocabulary.seeds import random_stream

    try:
        width, height = map(float, options.board_size.lower().split("x"))
        if not all(0 < length_mm < LARGEST_MM for length_mm in (width, height)):
            raise ValueError("no size of a board")
    except ValueError as error:
        raise UserError(
            f"--board-size {options.board_size}: is not a size", legal="WIDTHxHEIGHT in mm: 270x175"
        ) from error
    side = MARK_MM
    spacing = options.apart
    if not 0 < options.diameters[1] < spacing - 4:
        problem = f"--apart {spacing:g}: holes of {options.diameters[1]:g} mm overlap"
        raise UserError(problem, legal="at least their diameter plus 5 mm")
    inset = np.array([width, height]) / 2 - side / 2 - CLEAR_MM
    corners = inset * [(-1, 1), (1, 1), (1, -1), (-1, -1)]
    rim = options.diameters[1] / 2 + EDGE_MM
    room = np.array([width, height]) - 2 * rim

    def positions(length_mm: float) -> list[float]:
        """Return evenly spread positions about the middle, at least two."""
        number = max(int(length_mm // spacing) + 1, 2)
        return np.linspace(-length_mm / 2, length_mm / 2, number).round(2).tolist()

    clear = side / 2 + options.diameters[1] / 2 + CLEAR_MM
    free_mm = []
    for y in positions(room[1]):
        for x in positions(room[0]):
            from_marks = np.abs(corners - (x, y)).max(axis=1)
            if (from_marks >= clear).all():
                free_mm.append((x, y))
    count = -(-len(sizes) // max(len(free_mm), 1))
    if not free_mm or min(inset.min(), room.min()) <= side or 4 * count > CODES:
        fix = "a larger --board-size, a smaller --apart, or fewer --targets"
        raise UserError(
            f"{len(sizes)} holes need {count} boards of {width:g} x {height:g} mm", fix=fix
        )
    drilled = np.round(sizes / DRILLS_MM) * DRILLS_MM
    boards = []
    for number in range(count):
        stream = random_stream(SEED, "gauge board", number)
        sheet_holes = drilled[number::count]
        chosen = stream.permutation(len(free_mm))[: len(sheet_holes)]
        deep: list[float | None] = [None] * len(sheet_holes)
        if options.depths:
            parts = (stream.permutation(len(sheet_holes)) + 0.5) / len(sheet_holes)
            shallow_mm, deepest_mm = options.depths
            deep = np.round(shallow_mm + parts * (deepest_mm - shallow_mm), 1).tolist()
        holes = []
        for k, position in enumerate(chosen.tolist()):
            x, y = free_mm[position]
            hole = GaugeHole(
                id=k + 1, diameter_mm=float(sheet_holes[k]), depth_mm=deep[k], x_mm=x, y_mm=y
            )
            holes.append(hole)
        marks = []
        for code, (x, y) in enumerate(corners.tolist(), start=4 * number):
            marks.append(GaugeMark(code=code, x_mm=x, y_mm=y, side_mm=side))
        board = GaugeBoard(
            name=f"board-{number + 1}",
            width_mm=width,
            height_mm=height,
            marks=tuple(marks),
            holes=tuple(holes),
        )
        boards.append(board)
    return Gauge(dictionary=DICTIONARY, hit_radius_mm=HIT_SHARE * spacing, boards=tuple(boards))


if __name__ == "__main__":
    raise SystemExit(main())
