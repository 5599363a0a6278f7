"""What one recording of a printed gauge says of simulated cameras that are wrong in a known way.

    python tests/validation/gauge_recovery.py --out gauge_recovery.csv [--units N]

Writes one row per camera, unit and quantity: truth, estimate, 95 % interval; prints a table of the
mean error, the mean half width, and how many intervals hold the truth. The same command goes on
with the units that the file does not hold yet. Each unit has another fixed pattern (0.3 mm), other
noise (1 mm), another pose, and takes 12 frames of 240 x 224 pixels at 0.42 to 0.55 m; light is mixed
over the area of each pixel."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.programs.camera import characterise
from harness.programs.camera.gauge_report import GaugeReading, read_recording
from harness.vocabulary.geometry import MM, rotation_xyz_deg
from harness.vocabulary.seeds import random_stream
from tests.support.gauge_scene import CAMERA_NAME, recorded

CAMERAS = {
    "right": {"blur_px": 0.3},
    "scale 1 %": {"scale": 1.01, "blur_px": 0.3},
    "bias 5 mm": {"bias_mm": 5.0, "blur_px": 0.3},
    "blur 0.6 px": {"blur_px": 0.6},
    "offset of the unit": {"offset_mm": 3.0, "blur_px": 0.3},
    "all, half of the pixels lost": {
        "scale": 1.01,
        "bias_mm": 5.0,
        "blur_px": 0.6,
        "dropped": 0.5,
    },
}
FIRST_SEED = 400


def pose_of(seed: int) -> np.ndarray:
    """``T_camera_gauge`` of a unit: 15 to 30 degrees and less about all axes."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    tilt_deg = rng.uniform(15, 30)
    T[:3, :3] = rotation_xyz_deg(180 - tilt_deg, rng.uniform(-15, 15), rng.uniform(-20, 20))
    T[:3, 3] = [*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.42, 0.55)]
    return T


def quantities(
    reading: GaugeReading, wrong: dict[str, float], seed: int
) -> Iterator[dict[str, float | str]]:
    """Yield each quantity of a unit with its truth, estimate and interval."""
    scale = reading.fit.interval(0)
    yield {
        "quantity": "scale (%)",
        "truth": 100 * (wrong.get("scale", 1.0) - 1),
        "estimate": 100 * (reading.fit.scale - 1),
        "low": 100 * (scale.low - 1),
        "high": 100 * (scale.high - 1),
    }
    offset_mm = 0.0
    if "offset_mm" in wrong:
        deviation = random_stream(seed, "unit offset", CAMERA_NAME).standard_normal()
        offset_mm = wrong["offset_mm"] * float(deviation)
    bias = reading.fit.interval(1)
    yield {
        "quantity": "bias (mm)",
        "truth": wrong.get("bias_mm", 0.0) + offset_mm,
        "estimate": reading.fit.bias_m / MM,
        "low": bias.low / MM,
        "high": bias.high / MM,
    }
    assert reading.blur is not None
    yield {
        "quantity": "blur (px)",
        "truth": wrong["blur_px"],
        "estimate": reading.blur.blur_px,
        "low": reading.blur.interval.low,
        "high": reading.blur.interval.high,
    }


def rows_of(camera: str, unit: int) -> list[dict[str, float | str]]:
    """Return the rows of a unit."""
    wrong = CAMERAS[camera]
    seed = FIRST_SEED + 100 * list(CAMERAS).index(camera) + unit
    with tempfile.TemporaryDirectory() as folder:
        arguments = recorded(
            Path(folder), pattern_mm=0.3, seed=seed, T_camera_gauge=pose_of(seed), **wrong
        )
        reading = read_recording(characterise.main.parser().parse_args(arguments))
    values = quantities(reading, wrong, seed)
    return [{"camera": camera, "unit": unit, **quantity} for quantity in values]


def table_of(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table: mean error ± mean half width of the intervals, and how many of
    these hold the truth."""
    names = list(dict.fromkeys(rows.quantity))
    yield f"| camera | {' | '.join(names)} | hold |"
    yield "|---" * (len(names) + 2) + "|"
    for camera, of_camera in rows.groupby("camera", sort=False):
        cells = []
        for name in names:
            units = of_camera[of_camera.quantity == name]
            error = (units.estimate - units.truth).mean()
            half = (units.high - units.low).mean() / 2
            cells.append(f"{error:+.2f} ± {half:.2f}")
        held = (of_camera.low <= of_camera.truth) & (of_camera.truth <= of_camera.high)
        yield f"| {camera} | {' | '.join(cells)} | {held.sum()}/{len(held)} |"


def main() -> None:
    """Write the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--units", type=int, default=4)
    options = parser.parse_args()
    rows = pd.DataFrame({"camera": [], "unit": []})
    if options.out.exists():
        rows = pd.read_csv(options.out)
    for camera, unit in product(CAMERAS, range(options.units)):
        if ((rows.camera == camera) & (rows.unit == unit)).any():
            continue
        rows = pd.concat([rows, pd.DataFrame(rows_of(camera, unit))])
        rows.to_csv(options.out, index=False)
    print("\n".join(table_of(rows)))


if __name__ == "__main__":
    main()
