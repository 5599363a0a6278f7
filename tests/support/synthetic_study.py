"""Studies with known answers: boards of damage whose chance of detection, false calls and board
effects are as asked.

A damage of diameter a is found with probability logistic((a - a50 - shift of its board) / width);
its signal crosses the threshold exactly when it is found. False calls are Poisson on the face,
with exponential scores above `LOWEST`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from harness.evaluation.study.record import (
    Calibrated,
    Inspected,
    SetUpRecord,
    StudyRecord,
    Unflawed,
)
from harness.records.trials import ResultTables

THRESHOLD = 5.0
LOWEST = 3.0
"""The lowest threshold of the operating grid."""
SIDE_MM = 500.0
AREA_M2 = (SIDE_MM / 1000) ** 2
RADIUS_MM = 15.0
SIGNAL_PER_MM = 0.8
OPERATING = np.arange(LOWEST, 12.01, 0.5)
PIXEL_GRID = np.linspace(-4.0, 9.0, 131)
FACE_PIXELS = 20_000

CALIBRATED = Calibrated(
    board=np.arange(4),
    repeat=np.zeros(4, int),
    score=np.array([4.1, THRESHOLD, 7.5, 4.4]),
    x_mm=np.array([1.0, -120.4, np.nan, 3.0]),
    y_mm=np.array([2.0, 33.2, np.nan, 4.0]),
)
"""Hole-free runs of which the second highest set the threshold."""


@dataclass(frozen=True)
class SetUp:
    """One set-up's answers: POD is logistic((a - a50_mm) / width_mm), on boards whose a50 scatters
    by ``boards_mm``.

    ``own_noise``: share of the variance of luck that set-ups do not have in common (0: identical
    hits where a50 is equal). ``pixel_d``: distance of the damaged pixels' scores from the face's,
    in standard deviations.
    """

    variant: str = "main"
    frames: int = 1
    axes: Mapping[str, Any] = field(default_factory=dict)
    a50_mm: float = 6.0
    width_mm: float = 0.8
    boards_mm: float = 0.0
    false_calls_per_m2: float = 1.0
    own_noise: float = 0.5
    pixel_d: float = 2.0
    mm_per_depth_mm: float = 0.0
    """By how much a50 falls with every mm of depth above 5 mm."""
    detector: str = "plane"
    detector_version: int = 1
    frames_digest: str = "frames-a"

    @property
    def a90_mm(self) -> float:
        """The true one, at 5 mm depth and without board effects."""
        return self.a50_mm + self.width_mm * float(np.log(9.0))


@dataclass(frozen=True)
class Study:
    """The boards: each with ``holes`` of diameters spread evenly over ``sizes_mm``; depth 5 mm, or
    drawn evenly from ``depths_mm``; every board inspected ``repeats`` times."""

    set_ups: tuple[SetUp, ...] = (SetUp(),)
    boards: int = 60
    hole_free_boards: int = 60
    holes: int = 8
    repeats: int = 1
    sizes_mm: tuple[float, float] = (1.0, 14.0)
    depths_mm: tuple[float, float] | None = None
    seed: int = 1
    name: str = "synthetic"


def study_record(study: Study | None = None) -> StudyRecord:
    """What the study leaves to be judged."""
    study = study or Study()
    return StudyRecord(
        name=study.name,
        digest=f"digest-{study.seed}",
        hit_radius_mm=RADIUS_MM,
        false_calls_per_m2=1.0,
        provenance={
            "commit": "0" * 40,
            "dirty": False,
            "seed": study.seed,
            "versions": {"tofpod": "0.1.0"},
        },
        set_ups=tuple(_record(study, set_up) for set_up in study.set_ups),
    )


def _record(study: Study, set_up: SetUp) -> SetUpRecord:
    calls = _calls(study, set_up, "hole_free")
    calls = calls[calls["score"] > THRESHOLD]
    board, repeat = _runs(study, "hole_free")
    count = [
        int(((calls["board"] == b) & (calls["repeat"] == r)).sum())
        for b, r in zip(board, repeat, strict=True)
    ]
    return SetUpRecord(
        variant=set_up.variant,
        frames=set_up.frames,
        axes=dict(set_up.axes),
        detector=set_up.detector,
        detector_version=set_up.detector_version,
        threshold=THRESHOLD,
        threshold_mm=1.0,
        calibration_runs=60,
        failed=0,
        targets_digest=f"targets-{study.seed}-{study.boards}-{study.holes}",
        frames_digest=f"{set_up.frames_digest}-{study.seed}",
        inspected=_inspected(study, set_up),
        unflawed=Unflawed(board, repeat, np.array(count, int), np.full(len(board), AREA_M2)),
        calibrated=CALIBRATED,
    )


def _runs(study: Study, role: str) -> tuple[np.ndarray, np.ndarray]:
    """(board, repeat) of every run of a role; roles number their boards apart."""
    first, boards = (0, study.boards) if role == "damaged" else (100_000, study.hole_free_boards)
    return np.repeat(first + np.arange(boards), study.repeats), np.tile(
        np.arange(study.repeats), boards
    )


def _places(study: Study) -> pd.DataFrame:
    """The damages of all damaged boards, one row each: the same for every set-up."""
    rng = np.random.default_rng([study.seed, 1])
    n = study.boards * study.holes
    cells = [(x, y) for x in (-180.0, -60.0, 60.0, 180.0) for y in (-180.0, -60.0, 60.0, 180.0)]
    centre_mm = np.array(
        [[cells[k] for k in rng.permutation(16)[: study.holes]] for _ in range(study.boards)]
    ).reshape(n, 2)
    centre_mm += rng.uniform(-30.0, 30.0, (n, 2))
    depth = np.full(n, 5.0) if study.depths_mm is None else rng.uniform(*study.depths_mm, n)
    return pd.DataFrame(
        {
            "board": np.repeat(np.arange(study.boards), study.holes),
            "hole": np.tile([str(1 + k) for k in range(study.holes)], study.boards),
            "true_diameter_mm": rng.permutation(np.linspace(*study.sizes_mm, n)),
            "true_depth_mm": depth,
            "true_x_mm": centre_mm[:, 0],
            "true_y_mm": centre_mm[:, 1],
        }
    )


def _signals(study: Study, set_up: SetUp) -> pd.DataFrame:
    """Every inspection of every damage, with its signal."""
    damages = _places(study)
    n = len(damages)
    common = np.random.default_rng([study.seed, 2]).standard_normal((n, study.repeats))
    own_luck = np.random.default_rng(
        [study.seed, 3, set_up.frames, *set_up.variant.encode()]
    ).standard_normal((n, study.repeats))
    luck = stats.logistic.ppf(
        stats.norm.cdf(
            np.sqrt(1 - set_up.own_noise) * common + np.sqrt(set_up.own_noise) * own_luck
        )
    )
    shift = set_up.boards_mm * np.random.default_rng([study.seed, 4]).standard_normal(study.boards)
    easier = set_up.mm_per_depth_mm * (damages["true_depth_mm"] - 5.0)
    above = damages["true_diameter_mm"] - set_up.a50_mm - shift[damages["board"]] + easier
    signal = THRESHOLD + SIGNAL_PER_MM * (above.to_numpy()[:, None] + set_up.width_mm * luck)
    noise = np.random.default_rng([study.seed, 5]).normal(2.5, 0.4, (n, study.repeats))
    rows = damages.loc[np.repeat(np.arange(n), study.repeats)].reset_index(drop=True)
    rows["repeat"] = np.tile(np.arange(study.repeats), n)
    rows["signal"] = np.maximum(signal, noise).ravel()
    return rows


def _inspected(study: Study, set_up: SetUp) -> Inspected:
    rows = _signals(study, set_up)
    return Inspected(
        board=rows["board"].to_numpy(),
        hole=rows["hole"].to_numpy(str),
        repeat=rows["repeat"].to_numpy(),
        diameter_mm=rows["true_diameter_mm"].to_numpy(float),
        depth_mm=rows["true_depth_mm"].to_numpy(float),
        x_mm=rows["true_x_mm"].to_numpy(float),
        y_mm=rows["true_y_mm"].to_numpy(float),
        hit=(rows["signal"] > THRESHOLD).to_numpy(),
        signal=rows["signal"].to_numpy(float),
    )


def _calls(study: Study, set_up: SetUp, role: str) -> pd.DataFrame:
    """False findings above `LOWEST` of every run of a role, evenly over the face."""
    label = {"damaged": 6, "hole_free": 7}[role]
    rng = np.random.default_rng([study.seed, label, set_up.frames, *set_up.variant.encode()])
    board, repeat = _runs(study, role)
    count = rng.poisson(
        set_up.false_calls_per_m2 * np.exp(THRESHOLD - LOWEST) * AREA_M2, len(board)
    )
    n = int(count.sum())
    return pd.DataFrame(
        {
            "role": role,
            "board": np.repeat(board, count),
            "repeat": np.repeat(repeat, count),
            "x_mm": rng.uniform(-SIDE_MM / 2, SIDE_MM / 2, n),
            "y_mm": rng.uniform(-SIDE_MM / 2, SIDE_MM / 2, n),
            "score": LOWEST + rng.exponential(1.0, n),
            "hole": "",
        }
    )


def study_tables(study: Study | None = None) -> ResultTables:
    """The tables of the same study as `study_record`'s: the same hits, false calls and signals."""
    study = study or Study()
    parts = [_tables(study, set_up) for set_up in study.set_ups]
    names = ("holes", "sites", "runs", "findings", "operating", "pixels")
    tables = {}
    for index, name in enumerate(names):
        tables[name] = pd.concat([part[index] for part in parts], ignore_index=True)
    for name in ("probes", "variants", "noise", "axes"):
        tables[name] = pd.DataFrame()
    return ResultTables(**tables)


def _tables(study: Study, set_up: SetUp) -> tuple[pd.DataFrame, ...]:
    holes = _signals(study, set_up)
    holes["detected"] = holes["signal"] > THRESHOLD
    holes["kind"] = "hole"
    # errors of 0.1 to 0.5 mm; of the largest no diameter is known
    error_mm = (
        0.1 * (1 + np.arange(len(holes)) % 5) * np.where(np.arange(len(holes)) % 2, -1.0, 1.0)
    )
    holes["model_diameter_mm"] = (holes["true_diameter_mm"] + error_mm).where(
        np.abs(error_mm) < 0.45
    )
    calls = pd.concat(
        [_calls(study, set_up, role) for role in ("hole_free", "damaged")], ignore_index=True
    )
    findings = holes[holes["signal"] > LOWEST]
    matched = pd.DataFrame(
        {
            "role": "damaged",
            "board": findings["board"],
            "repeat": findings["repeat"],
            "x_mm": findings["true_x_mm"],
            "y_mm": findings["true_y_mm"],
            "score": findings["signal"],
            "hole": findings["hole"],
        }
    )
    findings = pd.concat([calls, matched], ignore_index=True)
    out = (
        holes,
        _sites(study, calls),
        _run_rows(study, findings),
        findings[findings["score"] > THRESHOLD],
        _operating(study, findings),
        _pixels(study, set_up, holes),
    )
    return tuple(table.assign(variant=set_up.variant, frames=set_up.frames) for table in out)


def _sites(study: Study, calls: pd.DataFrame) -> pd.DataFrame:
    """The damages' places on hole-free boards: found where a false call lies within the radius."""
    sites = _places(study)
    sites["board"] += 100_000
    sites = sites[sites["board"] < 100_000 + study.hole_free_boards]
    sites = sites.merge(pd.DataFrame({"repeat": np.arange(study.repeats)}), how="cross")
    noise = np.random.default_rng([study.seed, 8]).normal(2.5, 0.4, len(sites))
    highest = np.full(len(sites), -np.inf)
    boards = calls["board"].to_numpy()
    repeats = calls["repeat"].to_numpy()
    x_mm = calls["x_mm"].to_numpy()
    y_mm = calls["y_mm"].to_numpy()
    scores = calls["score"].to_numpy()
    columns = ["board", "repeat", "true_x_mm", "true_y_mm"]
    for row, (board, repeat, x, y) in enumerate(sites[columns].to_numpy()):
        same_run = (boards == board) & (repeats == repeat)
        within_radius = same_run & (np.hypot(x_mm - x, y_mm - y) <= RADIUS_MM)
        highest[row] = scores[within_radius].max(initial=-np.inf)
    return sites.assign(signal=np.maximum(highest, noise), detected=highest > THRESHOLD)


def _of_runs(
    study: Study, findings: pd.DataFrame
) -> Iterator[tuple[str, int, int, np.ndarray, np.ndarray]]:
    """Every run's role, board and repeat, and the scores and holes of its findings (as arrays,
    which is fast)."""
    roles = findings["role"].to_numpy()
    boards = findings["board"].to_numpy()
    repeats = findings["repeat"].to_numpy()
    scores = findings["score"].to_numpy()
    holes = findings["hole"].to_numpy()
    for role in ("hole_free", "damaged"):
        for board, repeat in zip(*_runs(study, role), strict=True):
            of_run = (roles == role) & (boards == board) & (repeats == repeat)
            yield role, board, repeat, scores[of_run], holes[of_run]


def _run_rows(study: Study, findings: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for role, board, repeat, score, hole in _of_runs(
        study, findings[findings["score"] > THRESHOLD]
    ):
        rows.append(
            {
                "role": role,
                "board": board,
                "repeat": repeat,
                "threshold": THRESHOLD,
                "inspected_m2": AREA_M2,
                "detections": len(score),
                "false_calls": int((hole == "").sum()),
                "scale_mm": 0.2,
                "surface_noise_mm": 0.3,
                "seconds_frames": 0.01,
                "seconds_detect": 0.05,
                "quiet_threshold": 4.5,
            }
        )
    return pd.DataFrame(rows)


def _operating(study: Study, findings: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for role, board, repeat, score, hole in _of_runs(study, findings):
        above = score > OPERATING[:, None]
        rows.append(
            (role, board, repeat, OPERATING, above.sum(axis=1), (above & (hole != "")).sum(axis=1))
        )
    return pd.DataFrame(rows, columns=["role", "board", "repeat", "threshold", "findings", "hits"])


def _pixels(study: Study, set_up: SetUp, holes: pd.DataFrame) -> pd.DataFrame:
    """Scores of pixels as normal distributions, counted exactly: face 0, damage ``pixel_d``."""
    board, repeat = _runs(study, "damaged")
    face = pd.DataFrame({"board": board, "repeat": repeat, "hole": ""})
    damaged = holes[["board", "repeat", "hole"]]
    tables = []
    for rows, pixels, mean in ((face, FACE_PIXELS, 0.0), (damaged, 1000, set_up.pixel_d)):
        above = np.round(pixels * stats.norm.sf(PIXEL_GRID - mean)).astype(int)
        tables.append(
            rows.assign(
                threshold=[PIXEL_GRID] * len(rows), above=[above] * len(rows), pixels=pixels
            )
        )
    return pd.concat(tables, ignore_index=True)
