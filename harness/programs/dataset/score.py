"""``tofpod score PREDICTIONS --dataset DIR``: states the detection limit of a method's anomaly
maps.

A map is judged like a detector's score in a study. The threshold is the lowest with the wanted
rate of false calls on the good boards of ``validation``. Pixels above it that are connected by
short steps form a finding, which hits a damage by the set's rule (`harness.trials.judge.matched`).
Limits follow from ``test``. Only inspected pixels count.

AU-PRO is the area under the mean overlap of damages against the share of false pixels, up to
`PRO_LIMIT` and divided by `PRO_LIMIT` (Bergmann et al., Int. Journal of Computer Vision 129
(2021), 1038); each damage is a region."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.programs.dataset.score_detector import DETECTOR
from harness.programs.dataset.score_rank import RANK
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import PICTURE_BYTES, bounded_bytes, write_text
from harness.vocabulary.geometry import MM
from harness.vocabulary.program import program
from harness.vocabulary.provenance import record
from harness.vocabulary.seeds import digest

if TYPE_CHECKING:
    from detectors.score_map import Findings
    from harness.evaluation.study.limit import SetUpLimit
    from harness.programs.dataset.judged_sets import JudgedPicture, JudgedSet

ENDINGS = (".npy", ".tiff", ".tif")
PRO_LIMIT = 0.3
MOST_NAMED = 3
CALLING_SHARE = 0.1
"""Share of good pictures that may call, where the data set states no rate of false calls."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("predictions", type=Path, metavar="PREDICTIONS", help="a folder with the anomaly maps")
    add(
        "--dataset",
        type=Path,
        required=True,
        metavar="DIR",
        help="a folder that tofpod dataset wrote, or one in the layout of MVTec 3D-AD",
    )
    rate = (
        "wanted false calls per square metre, which sets the threshold (default: the data set's, "
        "or those with which one good picture in ten calls)"
    )
    add("--false-calls-per-m2", type=float, metavar="RATE", help=rate)
    add(
        "--name",
        default="maps",
        help="name of the method in tables and comparisons (default: maps)",
    )
    add(
        "--out",
        type=Path,
        default=Path("results/score"),
        metavar="DIR",
        help="default: results/score",
    )


@program(
    _options,
    "State the detection limit (a90, a90/95) of anomaly maps on a data set of tofpod dataset, "
    "with AU-PRO and AUROC. PREDICTIONS holds a map for each board of validation and test: "
    "<category>/<split>/<label>/<number>.npy or .tiff, with the size of the pictures, higher for "
    "likely damage. In the layout of MVTec 3D-AD, sizes are those of circles with the area of "
    "each region of a mask, and maps of validation may be left out.",
    "tofpod score maps --dataset boards --out scores",
    "tofpod score maps --dataset boards --name ours --out scores",
    epilog="tofpod compare compares two such folders of results, tofpod score rank any number; "
    "tofpod score detector NAME writes the maps of a detector.",
    further={"detector": DETECTOR, "rank": RANK},
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if no limit is demonstrated), 2 for a user's mistake."""
    from harness.evaluation.study.record import StudyRecord, record_text
    from harness.records.schema import write_table
    from harness.report.pod import pod_html
    from harness.tables.limits import LIMITS, SCORES
    from harness.vocabulary.text import show

    data = _opened(options.dataset)
    rate = options.false_calls_per_m2
    if rate is None:
        rate = data.false_calls_per_m2
    if rate is not None and not 0 < rate <= 1e6:
        raise UserError(
            f"--false-calls-per-m2 {rate:g}", legal="above 0, up to 1e6 per square metre"
        )
    maps = _found(options.predictions, data)
    judged = [_judged(category, maps, options, data, rate) for category in data.categories]
    limits = [limit for limit, _ in judged]
    rows = [row for _, row in judged]
    origin = record(command)
    study = StudyRecord(
        name=data.name,
        digest=digest([data.content, options.name, rate]),
        hit_radius_mm=data.hit_radius_mm,
        hit_overlap=data.hit_overlap,
        false_calls_per_m2=rate,
        provenance={key: origin[key] for key in ("commit", "dirty", "versions", "command")},
        set_ups=tuple(limit.record for limit in limits),
    )
    write_text(options.out / "study.json", record_text(study))
    write_table(options.out, SCORES, SCORES.frame(rows), origin)
    write_table(options.out, LIMITS, LIMITS.frame(limits), origin)
    for limit in limits:
        if limit.statement is not None:
            page = options.out / f"{limit.record.variant}.html"
            write_text(page, pod_html(limit.statement, command))
    single = [name for name, facts in data.categories.items() if facts["units"] == 1]
    if single:
        show([f"warning: the limit holds for one unit of the camera only: {', '.join(single)}"])
    in_sample = [name for name in data.categories if data.quiet_split(name, list(maps)) == "test"]
    if in_sample:
        text = (
            "warning: the threshold is set on the good pictures on which false calls are counted; "
            f"write maps of validation/good too: {', '.join(in_sample)}"
        )
        show([text])
    show([LIMITS.grid(limits, terminal=True), "", SCORES.grid(rows, terminal=True)])
    print(f"wrote {options.out}: study.json, limits.csv, scores.csv, a page for each curve")
    return 0


def _opened(folder: Path) -> JudgedSet:
    """Open a data set of either layout. Raises UserError."""
    from harness.programs.dataset.boards import INDEX
    from harness.programs.dataset.judged_sets import BoardSet
    from harness.programs.dataset.mvtec import MvtecSet, is_mvtec

    if not (folder / INDEX).is_file() and is_mvtec(folder):
        return MvtecSet(folder)
    return BoardSet(folder)


def _found(predictions: Path, data: JudgedSet) -> dict[str, Path]:
    """Return the file of each picture's map. Raises a UserError that names all missing, extra or
    wrong files."""
    files: dict[str, list[Path]] = {}
    for path in sorted(predictions.rglob("*")):
        if path.suffix.lower() in ENDINGS:
            name = path.relative_to(predictions).with_suffix("").as_posix()
            files.setdefault(name, []).append(path)
    wanted = data.wanted(set(files))
    faults: dict[str, list[str]] = {}
    for name in sorted(wanted | files.keys()):
        if name not in files:
            faults.setdefault("missing", []).append(name)
        elif name not in wanted:
            faults.setdefault("not for a board of validation or test", []).append(name)
        elif len(files[name]) > 1:
            faults.setdefault("there twice", []).append(name)
        else:
            if fault := _fault(files[name][0], data.picture(name).inspected):
                faults.setdefault("invalid", []).append(f"{name} ({fault})")
    if faults:
        lines = [
            f"{len(names)} maps are {fault}: "
            f"{', '.join(names[:MOST_NAMED])}{', ...' * (len(names) > MOST_NAMED)}"
            for fault, names in faults.items()
        ]
        legal = (
            "a .npy or .tiff of real numbers with the pictures' size for each board of validation "
            "and test"
        )
        problem = f"{predictions}: {'; '.join(lines)}"
        raise UserError(problem, legal=legal, fix="write maps for all boards again")
    return {name: files[name][0] for name in wanted}


def _fault(path: Path, inspected: np.ndarray) -> str:
    """Return what is wrong with a map; empty if nothing is."""
    try:
        scores = _read(path)
    except UserError:
        return "cannot be read as an array of numbers"
    if scores.shape != inspected.shape:
        return (
            f"{' x '.join(map(str, scores.shape))} instead of "
            f"{' x '.join(map(str, inspected.shape))}"
        )
    lacking = int((~np.isfinite(scores[inspected])).sum())
    if lacking:
        return f"no finite number at {lacking} inspected pixels; write the lowest score there"
    return ""


def _read(path: Path) -> np.ndarray:
    """Return a map's numbers. Raises UserError if there are none."""
    import cv2

    from detectors.recordings.arrays import load_npy

    values: np.ndarray | None
    if path.suffix.lower() == ".npy":
        (values,) = load_npy(path).values()
    else:
        content = np.frombuffer(bounded_bytes(path, PICTURE_BYTES), np.uint8)
        values = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) else None
    if values is None or values.dtype.kind not in "fiu":
        raise UserError(f"{path}: holds no real numbers")
    return np.asarray(values, float)


@dataclass(frozen=True, eq=False)
class ScoredPicture:
    """A picture with the map that a method made of it."""

    name: str
    """Name of the picture."""
    picture: JudgedPicture
    """The picture with its truth."""
    scores: np.ndarray
    """Scores (h, w); NaN if not inspected."""
    area_m2: float
    """Inspected area of the face."""


@dataclass(frozen=True, eq=False)
class JudgedMap:
    """A map above the threshold, matched with the damages of its picture."""

    truth: list[Any]
    """Number of the board, and its damages."""
    run: dict[str, Any]
    """The row of its run, as `harness.runs.study_record.set_up_of` takes it."""
    holes: list[dict[str, Any]]
    """The rows of its damages."""
    scores: np.ndarray
    """Scores (n,) of the inspected pixels."""
    damage: np.ndarray
    """Numbers (n,) of their damages; 0: none."""
    highest: float
    """Highest of the scores; NaN if there are none."""


def _judged(
    category: str,
    maps: dict[str, Path],
    options: argparse.Namespace,
    data: JudgedSet,
    rate: float | None,
) -> tuple[SetUpLimit, dict[str, Any]]:
    """Judge the maps of a category at a threshold from its good pictures that set it: limit and
    scores."""
    import pandas as pd

    from harness.evaluation.study.limit import limit_of
    from harness.runs.study_record import set_up_of

    quiet_split = data.quiet_split(category, list(maps))
    quiet = _scored(maps, data, f"{category}/{quiet_split}/good/")
    threshold, quiet_count = _threshold(quiet, rate)
    judged = []
    for scored in _scored(maps, data, f"{category}/test/"):
        judged.append(_judged_map(scored, data, threshold))
    holes = [hole for one_map in judged for hole in one_map.holes]
    if not holes:
        raise UserError(
            f"{data.name}: {category} has no damage in view, so there is no limit to state"
        )
    record = set_up_of(
        pd.DataFrame(holes),
        pd.DataFrame([one_map.run for one_map in judged]),
        variant=category,
        frames=data.categories[category]["frames"],
        detector=options.name,
        calibration_runs=quiet_count,
        targets_digest=digest([one_map.truth for one_map in judged]),
        frames_digest=digest([data.content, category]),
    )
    return limit_of(record), {"category": category, **_areas(judged)}


def _scored(maps: dict[str, Path], data: JudgedSet, start: str) -> Iterator[ScoredPicture]:
    """Yield the pictures whose name starts so."""
    from harness.trials.board import pixel_areas

    for name in sorted(name for name in maps if name.startswith(start)):
        picture = data.picture(name)
        scores = np.where(picture.inspected, _read(maps[name]), np.nan)
        area_m2 = float(np.nansum(pixel_areas(picture.places_m)[picture.inspected]))
        yield ScoredPicture(name, picture, scores, area_m2)


def _threshold(quiet: Iterable[ScoredPicture], rate: float | None) -> tuple[float, int]:
    """Return the threshold with this rate of false calls per square metre on good pictures, and
    their number. Without a rate, a share `CALLING_SHARE` of them calls."""
    from harness.evaluation.intervals import threshold_for_rate

    highest = []
    areas_m2 = []
    for scored in quiet:
        highest.append(np.nanmax(scored.scores))
        areas_m2.append(scored.area_m2)
    area_m2 = float(np.mean(areas_m2))
    if rate is None:
        # calls are as rare as in a Poisson process of this rate
        rate = float(-np.log1p(-CALLING_SHARE) / area_m2)
    threshold = threshold_for_rate(np.array(highest, float), area_m2, rate).value
    return float(threshold), len(highest)


def _judged_map(scored: ScoredPicture, data: JudgedSet, threshold: float) -> JudgedMap:
    """Judge a map at a threshold."""
    from harness.trials.board import highest_within
    from harness.trials.judge import matched_places, smeared

    picture = scored.picture
    radius_m = data.hit_radius_mm * MM
    overlap = data.hit_overlap
    board, damages = data.damages(scored.name)
    lines_m = [np.array(flaw["line_m"]) for flaw in damages]
    outlines = [np.flatnonzero(picture.damage == flaw["id"]) for flaw in damages]
    areas = [] if overlap is None else smeared(outlines, picture.damage.shape)
    findings = _findings(picture.places_m, scored.scores > threshold, picture.link_m)
    ((pairs, parts),) = matched_places(
        lines_m, areas, lambda centres_m: centres_m, [findings], radius_m, overlap
    )
    common: dict[str, Any] = {
        "board": board,
        "repeat": 0,
        "threshold": threshold,
        "scale_mm": np.nan,
    }
    run = {
        **common,
        "role": "hole_free" if "/good/" in scored.name else "damaged",
        "false_calls": len(findings.scores) - len(pairs) - parts,
        "no_return_calls": 0,
        "inspected_m2": scored.area_m2,
    }
    signals = highest_within(picture.places_m, scored.scores, lines_m, radius_m)
    holes = []
    for number, flaw in enumerate(damages):
        hole = {
            **common,
            "hole": str(flaw["id"]),
            "true_diameter_mm": flaw["diameter_mm"],
            "true_depth_mm": flaw["depth_mm"],
            "true_x_mm": flaw["x_board_mm"],
            "true_y_mm": flaw["y_board_mm"],
            "signal": float(signals[number]),
            "detected": number in pairs,
            "no_return": False,
            "size_of": flaw.get("size_of", "diameter"),
        }
        holes.append(hole)
    is_scored = np.isfinite(scored.scores)
    return JudgedMap(
        truth=[board, damages],
        run=run,
        holes=holes,
        scores=scored.scores[is_scored],
        damage=picture.damage[is_scored].astype(int),
        highest=float(np.nanmax(scored.scores)),
    )


def _areas(judged: Sequence[JudgedMap]) -> dict[str, float]:
    """Return AU-PRO and AUROC of the pixels, and AUROC of the boards by their highest scores."""
    regions = []
    for number, one_map in enumerate(judged, start=1):
        # a damage's number is unique only on its board
        on_board = one_map.damage + (number << 16)
        regions.append(np.where(one_map.damage > 0, on_board, 0))
    region = np.unique(np.concatenate(regions), return_inverse=True)[1]
    scores = np.concatenate([one_map.scores for one_map in judged])
    damaged = (region > 0) * 1.0
    share_of_damage = damaged / np.bincount(region)[region]
    highest = np.array([one_map.highest for one_map in judged])
    is_flawed = np.array([bool(one_map.holes) for one_map in judged], float)
    return {
        "au_pro": area_under(scores, share_of_damage, 1 - damaged, PRO_LIMIT),
        "pixel_auroc": area_under(scores, damaged, 1 - damaged),
        "board_auroc": area_under(highest, is_flawed, 1 - is_flawed),
    }


def _findings(places_m: np.ndarray, above: np.ndarray, link_m: float) -> Findings:
    """Return the findings of pixels ``above`` (h, w), joined by steps of at most ``link_m``,
    without scores; their centres (m, 2) lie on the face."""
    from detectors.findings.extents import centres_of
    from detectors.pixels.clusters import euclidean_clusters
    from detectors.score_map import Findings

    pixels = np.flatnonzero(above & np.isfinite(places_m[..., 0]))
    points = np.pad(places_m.reshape(-1, 2)[pixels], ((0, 0), (0, 1)))
    labels = euclidean_clusters(points, link_m, 1)
    centres_m = centres_of(points, labels, int(labels.max(initial=-1)) + 1)[:, :2]
    return Findings(np.full(len(centres_m), np.nan), pixels, labels, centres_m)


def area_under(
    scores: np.ndarray, true_weight: np.ndarray, false: np.ndarray, limit: float = 1.0
) -> float:
    """Return the area under the share of ``true_weight`` (n,) above a threshold against the share
    of ``false`` (n,), up to ``limit`` and divided by it; NaN if either has no weight. Equal scores
    form a single threshold."""
    order = np.argsort(-scores, kind="stable")
    last = np.append(np.flatnonzero(np.diff(scores[order])), len(scores) - 1)
    up = np.append(0.0, np.cumsum(true_weight[order])[last])
    across = np.append(0.0, np.cumsum(false[order])[last])
    if not (up[-1] > 0 and across[-1] > 0):
        return float("nan")
    up = up / up[-1]
    across = across / across[-1]
    inside = across <= limit
    y = np.append(up[inside], np.interp(limit, across, up))
    x = np.append(across[inside], limit)
    return float(np.trapezoid(y, x) / limit)


if __name__ == "__main__":
    raise SystemExit(main())
