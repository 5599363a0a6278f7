"""A gauge board: its declaration, its pose in a capture by its coded marks, and the hits and
misses of its holes."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from detectors.rigid_motion import kabsch
from detectors.views.marks.find import find_marks
from detectors.views.marks.mark import CodedMarks
from harness.evaluation.match import match
from harness.records.outputs import GAUGE_ROWS
from harness.records.schema import Column, Table
from harness.report.findings import Judged
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import settings_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, strict_json
from harness.vocabulary.geometry import MM, invert, transform_points
from harness.vocabulary.provenance import check_version
from harness.vocabulary.text import many

GAUGE_VERSION = 1
FEWEST_MARKS = 3
# directions around a hole in which judged points must lie; otherwise a miss is not evidence
SIDES = 8
# rms distance of marks from their places above which the fit is doubtful
WORST_FIT_MM = 2.0
Length = Annotated[float, Field(gt=0, le=5e3)]
CoordinateMm = Annotated[float, Field(ge=-5e3, le=5e3)]


class GaugeMark(Config):
    """A printed code: its number, its centre on the board, and the side length of its black
    square."""

    code: Annotated[int, Field(ge=0, le=999)]
    x_mm: CoordinateMm
    y_mm: CoordinateMm
    side_mm: Length


class GaugeHole(Config):
    """A hole to drill: its centre on the board, its diameter, and its depth (None for a
    through-hole)."""

    id: Annotated[int, Field(ge=1)]
    diameter_mm: Length
    depth_mm: Length | None = None
    x_mm: CoordinateMm
    y_mm: CoordinateMm


class GaugeBoard(Config):
    """A board, with x to the right and y up from its centre, seen from the printed side."""

    name: Annotated[str, Field(min_length=1)]
    width_mm: Length
    height_mm: Length
    marks: tuple[GaugeMark, ...]
    holes: Annotated[tuple[GaugeHole, ...], Field(min_length=1)]


class Gauge(Config):
    """All boards, the dictionary of their codes (OpenCV's name), and the radius within which a
    finding is a hit."""

    dictionary: str
    hit_radius_mm: Length
    boards: Annotated[tuple[GaugeBoard, ...], Field(min_length=1)]


def read_gauge(path: Path) -> Gauge:
    """Read the truth file of `tofpod gauge`. Raises UserError if it cannot be read or is another
    kind of file."""
    legal = "the gauge.json that tofpod gauge wrote"
    try:
        data = strict_json(bounded_bytes(path, RECORD_BYTES))
    except (OSError, ValueError) as error:
        raise UserError(f"--gauge {path}: cannot be read ({error})", legal=legal) from error
    if not isinstance(data, dict) or "gauge_version" not in data:
        raise UserError(f"--gauge {path}: is not the truth file of a gauge", legal=legal)
    check_version(data.pop("gauge_version"), GAUGE_VERSION, path, "a gauge")
    return settings_of(Gauge, data, f"--gauge {path}")


@dataclass(frozen=True)
class GaugeRow:
    """A hole in a capture."""

    board: str
    hole: GaugeHole
    counted: tuple[str, float, float]
    """The detector with its version, its threshold in units of score, and the hit radius in mm."""
    found: Literal["hit", "miss", "NA"]
    """NA if the hole was not judged on all sides."""
    offset_mm: float | None = None
    """Distance of a hit's centre from the hole; None without a hit."""
    score: float | None = None
    """Score of a hit; None without a hit."""


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


HITS_AND_MISSES = Table(
    GAUGE_ROWS.name.removesuffix(".csv"),
    "one row per hole of a gauge board: what tofpod pod reads",
    (
        Column("board", "board", "board", "name of the board"),
        Column(
            "target",
            "hole",
            lambda row: f"{row.board}:{row.hole.id}",
            "board and number of the hole",
        ),
        Column("diameter_mm", "diameter (mm)", "hole.diameter_mm", "diameter of the drill"),
        Column(
            "depth_mm",
            "depth (mm)",
            "hole.depth_mm",
            "depth; empty for a through-hole",
            text=_number,
        ),
        Column(
            "found",
            "found",
            "found",
            "hit, miss, or NA if not all sides of it were judged",
            text=str,
        ),
        Column(
            "offset_mm",
            "offset (mm)",
            "offset_mm",
            "distance of the finding's centre from it",
            text=_number,
        ),
        Column("score", "score", "score", "score of that finding", text=_number),
        Column("detector", "", lambda row: row.counted[0], "name and version of the detector"),
        Column("threshold", "", lambda row: row.counted[1], "threshold in units of score"),
        Column(
            "hit_radius_mm",
            "",
            lambda row: row.counted[2],
            "distance within which a finding is a hit",
        ),
    ),
    formats=("csv",),
)


@dataclass(frozen=True)
class GaugeSeen:
    """The boards in a capture."""

    rows: tuple[GaugeRow, ...]
    """The holes of all boards."""
    false_calls: int
    """Findings on the boards that hit no hole and lie on no mark."""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def answer(self) -> str:
        """The counts as a sentence."""
        count = Counter(row.found for row in self.rows)
        hits = f"{count['hit']} hits, {count['miss']} misses, {count['NA']} holes not judged"
        return f"gauge: {hits}, {many(self.false_calls, 'false call')}"


def seen_on(gauge: Gauge, judged: Judged, detector: str, threshold: float) -> GaugeSeen:
    """Find the boards in a capture by their marks, and match findings to holes. Raises UserError
    without a board."""
    counted = (detector, threshold, gauge.hit_radius_mm)
    cloud = judged.cloud
    if cloud.rgb is None and cloud.amplitude is not None:  # infrared images show printed codes too
        amplitudes = cloud.amplitude[np.isfinite(cloud.amplitude)]
        white = float(np.quantile(amplitudes, 0.99)) if amplitudes.size else 0
        scaled = 255 * np.nan_to_num(cloud.amplitude) / max(white, 1e-9)
        grey = np.clip(scaled, 0, 255).astype(np.uint8)
        cloud = replace(cloud, rgb=np.repeat(grey[..., None], 3, axis=2))
    marks_read = find_marks(cloud, cloud.valid, CodedMarks(dictionary=gauge.dictionary))
    by_code = {mark.code: mark for mark in marks_read.trusted}
    rows: list[GaugeRow] = []
    warnings = []
    notes = []
    calls = 0
    for board in gauge.boards:
        marks = [mark for mark in board.marks if mark.code in by_code]
        if len(marks) < FEWEST_MARKS:
            continue
        on_board = np.array([(mark.x_mm, mark.y_mm, 0.0) for mark in marks]) * MM
        in_camera = np.array([by_code[mark.code].centre_m for mark in marks])
        T_camera_board = kabsch(on_board, in_camera, np.ones(len(marks)))
        apart_m = np.linalg.norm(transform_points(T_camera_board, on_board) - in_camera, axis=-1)
        fit_mm = float(np.sqrt((apart_m**2).mean())) / MM
        notes.append(
            f"{board.name}: {len(marks)} marks, {fit_mm:.2f} mm (rms) from their places on the "
            "board"
        )
        if fit_mm > WORST_FIT_MM:
            doubt = (
                f"its marks are {fit_mm:.1f} mm off: check that it is flat and was printed at 100 %"
            )
            warnings.append(f"{board.name}: {doubt}")
        hits, beside = _matched(board, counted, judged, invert(T_camera_board))
        if unjudged := [str(row.hole.id) for row in hits if row.found == "NA"]:
            outside = (
                "is too close to the edge of the judged area, so it counts neither as a hit nor "
                "as a miss"
            )
            warnings.append(f"{board.name}: hole {', '.join(unjudged)} {outside}")
        rows += hits
        calls += beside
    if not rows:
        why = (
            marks_read.problem or f"{len(by_code)} codes were read, but no board has three of them"
        )
        fix = (
            "show the whole board, closer to the camera, in the image that is recorded with the "
            "depth"
        )
        raise UserError(f"--gauge: no board is recognised: {why}", fix=fix)
    return GaugeSeen(tuple(rows), calls, tuple(warnings), tuple(notes))


def _matched(
    board: GaugeBoard, counted: tuple[str, float, float], judged: Judged, T_board_camera: np.ndarray
) -> tuple[list[GaugeRow], int]:
    """Return the rows of a board's holes, and the number of false calls on the board."""
    radius_m = counted[2] * MM

    def on_face(points_m: np.ndarray) -> np.ndarray:
        """Return (n, 2): where the lines of sight through points (n, 3) in the camera's frame meet
        the face."""
        points = transform_points(T_board_camera, points_m.reshape(-1, 3))
        lens = T_board_camera[:3, 3]
        share = lens[2] / (lens[2] - points[:, 2])
        return np.asarray((lens + (points - lens) * share[:, None])[:, :2])

    findings_m = on_face(np.array([detection.centre_m for detection in judged.detections]))
    centres = np.array([(hole.x_mm, hole.y_mm) for hole in board.holes]) * MM
    pairs = match(centres, findings_m, radius_m)
    scores = judged.evidence.score
    points = judged.cloud.points_m
    judged_m = on_face(points[np.isfinite(scores) & np.isfinite(points[..., 2])])
    rows = []
    for number, (hole, centre) in enumerate(zip(board.holes, centres, strict=True)):
        away = judged_m - centre
        away = away[np.linalg.norm(away, axis=-1) < radius_m + hole.diameter_mm / 2 * MM]
        angle = np.arctan2(away[:, 1], away[:, 0])
        sides = np.floor(angle / (2 * np.pi / SIDES)).astype(int) % SIDES
        row = GaugeRow(board.name, hole, counted, found="miss")
        if len(np.unique(sides)) < SIDES:
            row = replace(row, found="NA")
        elif number in pairs:
            finding = pairs[number]
            offset_mm = float(np.linalg.norm(findings_m[finding] - centre)) / MM
            score = judged.detections[finding].score
            row = replace(row, found="hit", offset_mm=offset_mm, score=score)
        rows.append(row)
    half_m = np.array([board.width_mm, board.height_mm]) / 2 * MM
    is_on_board = (np.abs(findings_m) < half_m).all(axis=-1)
    for mark in board.marks:
        from_mark_m = np.abs(findings_m - np.array([mark.x_mm, mark.y_mm]) * MM)
        is_on_board &= (from_mark_m > mark.side_mm * MM).any(axis=-1)
    hits = sum(bool(is_on_board[finding]) for finding in pairs.values())
    return rows, int(is_on_board.sum()) - hits
