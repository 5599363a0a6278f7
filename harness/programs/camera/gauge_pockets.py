"""Pockets of a solid gauge: which are seen in a recording, and how probably the camera's file sees
each, by simulated units before the same gauge in the same pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.evaluation.intervals import clopper_pearson
from harness.programs.camera.camera_file import UNIT
from harness.records.schema import Column, Estimate, Table
from harness.stills.solid_gauge import SolidGauge, SolidPocket
from harness.stills.spheres import RangeImage, correlated_pixels
from harness.vocabulary.geometry import MM, rotate_vectors, transform_points
from scenes.closed_form import image_view
from scenes.sensor.camera import AnyCamera
from scenes.sensor.source import SimulatedUnit

SEEN = 5.0
"""Signal over noise at which a pocket counts as seen."""
UNITS = 16
"""Simulated units, each with its own fixed pattern and noise."""
MOST_FRAMES = 50
AROUND_MM = 2.5
"""Width of the face around a pocket that counts, on a plate of 180 mm."""


@dataclass(frozen=True)
class PocketSignal:
    """The signal of a pocket in a range image."""

    pocket: SolidPocket
    share: float
    """Share of its expected depth: 1 for a camera that has but the blur of its edges."""
    sigma: float
    """Standard error of that share."""
    degrees: float
    """Independent pixels, less fitted numbers."""

    @property
    def ratio(self) -> float:
        """Signal over noise."""
        return self.share / max(self.sigma, 1e-9)

    @property
    def is_seen(self) -> bool:
        """True where it stands out."""
        return self.ratio >= SEEN


def pocket_signals(
    straight: RangeImage, gauge: SolidGauge, T_camera_gauge: np.ndarray, seen_m: np.ndarray
) -> Iterator[PocketSignal]:
    """Yield the signals of the pockets that have pixels in a corrected image; ``seen_m`` (h, w) is
    the gauge's range with the blur of edges."""
    normal = rotate_vectors(T_camera_gauge, np.array([0.0, 0.0, 1.0]))
    origin_m = T_camera_gauge[:3, 3]
    face_m = (normal @ origin_m) / (straight.rays @ normal)
    expected_m = seen_m - face_m
    off_m = straight.range_m - face_m
    points_m = straight.rays * face_m[..., None]
    fitted = []
    for pocket in gauge.pockets:
        on_gauge_m = np.array([pocket.x_mm, pocket.y_mm, 0.0]) * MM
        centre_m = transform_points(T_camera_gauge, on_gauge_m)
        away_m = np.linalg.norm(points_m - centre_m, axis=-1)
        reach_m = (pocket.diameter_mm / 2 + AROUND_MM) * gauge.width_mm / 180 * MM
        near = (away_m < reach_m) & np.isfinite(off_m)
        template = expected_m[near]
        power_m2 = float((template**2).sum())
        if near.sum() < 9 or not np.isfinite(power_m2) or power_m2 == 0:
            continue
        design = np.column_stack([template, np.ones(len(template))])
        (share, level_m), *_ = np.linalg.lstsq(design, off_m[near], rcond=None)
        left_m = off_m[near] - design @ (share, level_m)
        shared = correlated_pixels(off_m.shape, np.flatnonzero(near.ravel()), left_m, numbers=2)
        fitted.append((pocket, float(share), design, left_m, shared))
    # a pocket of few pixels shows the correlation of their errors poorly, and all share it
    common = float(np.median([shared for *_, shared in fitted])) if fitted else 1.0
    for pocket, share, design, left_m, _ in fitted:
        degrees = max(len(left_m) - 2 * common, 1.0)
        variance_m2 = float((left_m**2).sum()) / degrees * common
        sigma = float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0] * variance_m2))
        yield PocketSignal(pocket, share, sigma, degrees)


@dataclass(frozen=True)
class PocketRow:
    """A pocket in the recording and in simulated ones."""

    pocket: SolidPocket
    ratio: float
    """Signal over noise in the recording; 0 without pixels."""
    is_seen: bool
    probability: Estimate
    """Share of simulated units that see it, with its exact 95 % interval."""


POCKETS = Table(
    "pockets",
    "one row per pocket of a solid gauge",
    (
        Column("pocket", "pocket", lambda row: row.pocket.name, "diameter x depth, mm"),
        Column(
            "diameter_mm", "", lambda row: row.pocket.diameter_mm, "diameter of the gauge's truth"
        ),
        Column("depth_mm", "", lambda row: row.pocket.depth_mm, "depth of the gauge's truth"),
        Column("ratio", "signal/noise", "ratio", "signal over noise in the recording"),
        Column(
            "seen",
            "seen",
            "is_seen",
            f"whether that is {SEEN:g} or more",
            text=lambda is_seen: "yes" if is_seen else "no",
        ),
        Column(
            "simulated",
            "simulated",
            "probability",
            f"probability of that by {UNITS} simulated units of the camera file",
            interval=True,
        ),
    ),
    formats=("csv",),
    left=1,
)


def pocket_rows(
    camera: AnyCamera,
    gauge: SolidGauge,
    recorded: Sequence[PocketSignal],
    T_camera_gauge: np.ndarray,
    view: tuple[RangeImage, np.ndarray],
    frames: int,
    albedo: float,
) -> list[PocketRow]:
    """Return all pockets, in the recording and by the camera. ``view``: the gauge's ranges without
    blur along the rays of the lens, and those (h, w) with the blur that the recording shows. The
    simulated light is direct, of one albedo, and that of the face."""
    sharp, seen_m = view
    counts = dict.fromkeys((pocket.name for pocket in gauge.pockets), 0)
    normal = rotate_vectors(T_camera_gauge, np.array([0.0, 0.0, 1.0]))
    forward = sharp.rays[..., 2]
    light = albedo * np.abs(sharp.rays @ normal) / sharp.range_m**2
    lens = camera.nominal_lens
    ideal = image_view(camera, lens.whole, sharp.range_m * forward, np.nan_to_num(light))
    for number in range(UNITS):
        config = UNIT.model_copy(update={"name": camera.name, "unit_seed": number})
        unit = SimulatedUnit(camera, config, ideal)
        taken = unit.capture(min(frames, MOST_FRAMES), number, "pockets").frames()
        sum_m = np.zeros(forward.shape)
        present = np.zeros(forward.shape)
        for frame in taken:
            sum_m += np.nan_to_num(frame.z_m)
            present += np.isfinite(frame.z_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            average = replace(
                sharp, range_m=np.where(present > 0, sum_m / present / forward, np.nan)
            )
        for signal in pocket_signals(average, gauge, T_camera_gauge, seen_m):
            counts[signal.pocket.name] += signal.is_seen
    by_name = {signal.pocket.name: signal for signal in recorded}
    rows = []
    for pocket in gauge.pockets:
        found = counts[pocket.name]
        low, high = (float(end) for end in clopper_pearson(found, UNITS))
        shown = by_name.get(pocket.name)
        row = PocketRow(
            pocket=pocket,
            ratio=shown.ratio if shown else 0.0,
            is_seen=shown is not None and shown.is_seen,
            probability=Estimate(found / UNITS, low, high),
        )
        rows.append(row)
    return rows


def answer_of_pockets(rows: Sequence[PocketRow]) -> str:
    """Return how many pockets are seen, beside as many as the camera file expects with its 95 %
    range (chance of each pocket, and of the share of units)."""
    shares = np.array([row.probability.value for row in rows])
    expected = float(shares.sum())
    variance = float((shares * (1 - shares)).sum()) * (1 + 1 / UNITS)
    half = 1.96 * np.sqrt(variance) + 0.5
    seen = sum(row.is_seen for row in rows)
    return (
        f"{seen} of {len(rows)} pockets are seen; the camera file expects {expected:.1f} "
        f"({max(expected - half, 0):.0f} to {min(expected + half, len(rows)):.0f})."
    )
