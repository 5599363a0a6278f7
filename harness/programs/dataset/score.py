"""``tofpod score PREDICTIONS --dataset DIR``: states the detection limit of a method's anomaly
maps.

A map is judged like a detector's score in a study. The threshold is the lowest with the wanted
rate of false calls on the good boards of ``validation``. Pixels above it that are connected by
steps of at most `LINK_M` form a finding, which hits a damage by the experiment's rule
(`harness.trials.judge.matched`). Limits follow from ``test``. Only inspected pixels count.

AU-PRO is the area under the mean overlap of damages against the share of false pixels, up to
`PRO_LIMIT` and divided by `PRO_LIMIT` (Bergmann et al., Int. Journal of Computer Vision 129
(2021), 1038); each damage is a region."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import PICTURE_BYTES, bounded_bytes, write_text
from harness.vocabulary.geometry import MM
from harness.vocabulary.program import program
from harness.vocabulary.provenance import record
from harness.vocabulary.seeds import digest

if TYPE_CHECKING:
    from detectors.score_map import Findings
    from harness.evaluation.study.limit import SetUpLimit

ENDINGS = (".npy", ".tiff", ".tif")
JUDGED = ("validation", "test")  # splits whose boards all need a map
LINK_M = 0.010  # longest step within a finding, as in `detectors.score_map`
PRO_LIMIT = 0.3
MOST_NAMED = 3
JUDGED_BY = ("inspected", "board_xy_m", "damage")


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("predictions", type=Path, metavar="PREDICTIONS", help="a folder with the anomaly maps")
    add(
        "--dataset",
        type=Path,
        required=True,
        metavar="DIR",
        help="a folder that tofpod dataset wrote",
    )
    rate = "wanted false calls per square metre, which sets the threshold (default: the data set's)"
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
    "likely damage.",
    "tofpod score maps --dataset boards --out scores",
    "tofpod score maps --dataset boards --name ours --out scores",
    epilog="tofpod compare compares two such folders of results.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if no limit is demonstrated), 2 for a user's mistake."""
    from harness.evaluation.study.record import StudyRecord, record_text
    from harness.programs.dataset.boards import read_index
    from harness.records.schema import write_table
    from harness.report.pod import pod_html
    from harness.tables.limits import LIMITS, SCORES
    from harness.vocabulary.text import show

    index = read_index(options.dataset)
    if index["samples"] is None:
        raise UserError(
            f"{options.dataset}: is not finished",
            fix="run the command that wrote it again; it continues",
        )
    rate = (
        index["false_calls_per_m2"]
        if options.false_calls_per_m2 is None
        else options.false_calls_per_m2
    )
    if not 0 < rate <= 1e6:
        raise UserError(
            f"--false-calls-per-m2 {rate:g}", legal="above 0, up to 1e6 per square metre"
        )
    maps = _found(options.predictions, options.dataset, index["samples"])
    judged = [_judged(category, maps, options, index, rate) for category in index["categories"]]
    limits = [limit for limit, _ in judged]
    rows = [row for _, row in judged]
    origin = record(command)
    study = StudyRecord(
        name=index["name"],
        digest=digest([index["content"], options.name, rate]),
        hit_radius_mm=index["hit_radius_mm"],
        hit_overlap=index["hit_overlap"],
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
    single = [name for name, facts in index["categories"].items() if facts["units"] == 1]
    if single:
        show([f"warning: the limit holds for one unit of the camera only: {', '.join(single)}"])
    show([LIMITS.grid(limits, terminal=True), "", SCORES.grid(rows, terminal=True)])
    print(f"wrote {options.out}: study.json, limits.csv, scores.csv, a page for each curve")
    return 0


def _found(predictions: Path, dataset: Path, samples: list[str]) -> dict[str, Path]:
    """Return the file of each board's map. Raises a UserError that names all missing, extra or
    wrong files."""
    from harness.programs.dataset.boards import read_arrays

    wanted = {name for name in samples if name.split("/")[1] in JUDGED}
    files: dict[str, list[Path]] = {}
    for path in sorted(predictions.rglob("*")):
        if path.suffix.lower() in ENDINGS:
            name = path.relative_to(predictions).with_suffix("").as_posix()
            files.setdefault(name, []).append(path)
    faults: dict[str, list[str]] = {}
    for name in sorted(wanted | files.keys()):
        if name not in files:
            faults.setdefault("missing", []).append(name)
        elif name not in wanted:
            faults.setdefault("not for a board of validation or test", []).append(name)
        elif len(files[name]) > 1:
            faults.setdefault("there twice", []).append(name)
        else:
            (inspected,) = read_arrays(dataset, name, "inspected")
            if fault := _fault(files[name][0], inspected):
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


def _judged(
    category: str,
    maps: dict[str, Path],
    options: argparse.Namespace,
    index: dict[str, Any],
    rate: float,
) -> tuple[SetUpLimit, dict[str, Any]]:
    """Judge the maps of a category at a threshold from its good boards of ``validation``: limit
    and scores."""
    import pandas as pd

    from harness.evaluation.intervals import threshold_for_rate
    from harness.evaluation.study.limit import limit_of
    from harness.programs.dataset.boards import read_arrays, read_truth
    from harness.runs.study_record import set_up_of
    from harness.trials.board import highest_within, pixel_areas
    from harness.trials.judge import matched_places, smeared

    def boards(split: str) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray, float]]:
        """Yield the boards of a split: name, scores (NaN if not inspected), places, damage,
        inspected area."""
        for sample in sorted(name for name in maps if name.startswith(f"{category}/{split}/")):
            inspected, board_xy_m, damage = read_arrays(options.dataset, sample, *JUDGED_BY)
            scores = np.where(inspected, _read(maps[sample]), np.nan)
            places_m = board_xy_m.astype(float)
            area_m2 = float(np.nansum(pixel_areas(places_m)[inspected]))
            yield sample, scores, places_m, damage, area_m2

    if not any(name.startswith(f"{category}/validation/") for name in maps):
        raise UserError(f"{options.dataset}: {category} has no board of validation")
    quiet = [(np.nanmax(scores), area_m2) for _, scores, _, _, area_m2 in boards("validation")]
    highest, areas_m2 = np.array(quiet, float).T
    threshold = threshold_for_rate(highest, float(areas_m2.mean()), rate).value
    radius_m = index["hit_radius_mm"] * MM
    overlap = index["hit_overlap"]
    truths = []
    holes = list[dict[str, Any]]()
    runs = list[dict[str, Any]]()
    pixels = list[np.ndarray]()
    regions = list[np.ndarray]()
    tops = list[tuple[float, bool]]()
    for name, scores, places_m, damage, area_m2 in boards("test"):
        truth = read_truth(options.dataset, name)
        damages = truth["damages"]
        board = truth["board"]
        truths.append([board, damages])
        lines = [np.array(flaw["line_m"]) for flaw in damages]
        findings = _findings(places_m, scores > threshold)
        outlines = [np.flatnonzero(damage == flaw["id"]) for flaw in damages]
        areas = [] if overlap is None else smeared(outlines, damage.shape)
        ((pairs, parts),) = matched_places(
            lines, areas, lambda centres_m: centres_m, [findings], radius_m, overlap
        )
        signals = highest_within(places_m, scores, lines, radius_m)
        common: dict[str, Any] = {
            "board": board,
            "repeat": 0,
            "threshold": float(threshold),
            "scale_mm": np.nan,
        }
        run = {
            **common,
            "role": "hole_free" if "/good/" in name else "damaged",
            "false_calls": len(findings.scores) - len(pairs) - parts,
            "no_return_calls": 0,
            "inspected_m2": area_m2,
        }
        runs.append(run)
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
        is_scored = np.isfinite(scores)
        pixels.append(scores[is_scored])
        damage_ids = damage[is_scored].astype(int)
        # a damage's number is unique only on its board
        regions.append(np.where(damage_ids > 0, damage_ids + (len(truths) << 16), 0))
        tops.append((float(np.nanmax(scores)), bool(damages)))

    if not holes:
        raise UserError(
            f"{options.dataset}: {category} has no damage in view, so there is no limit to state"
        )
    record = set_up_of(
        pd.DataFrame(holes),
        pd.DataFrame(runs),
        variant=category,
        frames=index["categories"][category]["frames"],
        detector=options.name,
        calibration_runs=len(highest),
        targets_digest=digest(truths),
        frames_digest=digest([index["content"], category]),
    )
    scores = np.concatenate(pixels)
    region = np.unique(np.concatenate(regions), return_inverse=True)[1]
    damaged = (region > 0) * 1.0
    share_of_damage = damaged / np.bincount(region)[region]
    top, is_flawed = np.array(tops, float).T
    return limit_of(record), {
        "category": category,
        "au_pro": area_under(scores, share_of_damage, 1 - damaged, PRO_LIMIT),
        "pixel_auroc": area_under(scores, damaged, 1 - damaged),
        "board_auroc": area_under(top, is_flawed, 1 - is_flawed),
    }


def _findings(places_m: np.ndarray, above: np.ndarray) -> Findings:
    """Return the findings of pixels ``above`` (h, w), without scores; their centres (m, 2) lie on
    the face."""
    from detectors.findings.measure import centres_of
    from detectors.pixels.clusters import euclidean_clusters
    from detectors.score_map import Findings

    pixels = np.flatnonzero(above & np.isfinite(places_m[..., 0]))
    points = np.pad(places_m.reshape(-1, 2)[pixels], ((0, 0), (0, 1)))
    labels = euclidean_clusters(points, LINK_M, 1)
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
