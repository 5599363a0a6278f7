"""What one recording of a printed gauge says of simulated cameras that are wrong in a known way.

    python tests/validation/gauge_recovery.py [--draws N]

Prints a table: the true error, its mean estimate, the mean half width of the 95 % interval, and how
many of the intervals hold the truth. Each camera takes 12 frames of 240 x 224 pixels at 0.47 m with
1 mm of noise; each draw is another unit with another fixed pattern and other noise."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.evaluation.intervals import Interval
from harness.programs.camera import characterise
from harness.programs.camera.gauge_report import GaugeReading, read_recording
from harness.vocabulary.geometry import MM
from tests.support.gauge_scene import recorded

CAMERAS = {
    "right": {"pattern_mm": 0.3, "blur_px": 0.3},
    "scale 1 %": {"scale": 1.01, "pattern_mm": 0.3, "blur_px": 0.3},
    "bias 5 mm": {"bias_mm": 5.0, "pattern_mm": 0.3, "blur_px": 0.3},
    "blur 0.6 px": {"pattern_mm": 0.3, "blur_px": 0.6},
    "all three, half of the pixels lost": {
        "scale": 1.01,
        "bias_mm": 5.0,
        "pattern_mm": 0.3,
        "blur_px": 0.6,
        "dropped": 0.5,
    },
}


def quantities(
    reading: GaugeReading, wrong: dict[str, float]
) -> Iterator[tuple[str, float, float, Interval]]:
    """Yield the name, the truth, the estimate and its interval of each error."""
    scale = reading.fit.interval(0)
    percent = Interval(100 * (scale.low - 1), 100 * (scale.high - 1))
    true_percent = 100 * (wrong.get("scale", 1.0) - 1)
    yield "scale (%)", true_percent, 100 * (reading.fit.scale - 1), percent
    bias = reading.fit.interval(1)
    in_mm = Interval(bias.low / MM, bias.high / MM)
    yield "bias (mm)", wrong.get("bias_mm", 0.0), reading.fit.bias_m / MM, in_mm
    assert reading.blur is not None
    yield "blur (px)", wrong["blur_px"], reading.blur.blur_px, reading.blur.interval


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=3)
    draws = parser.parse_args().draws
    print("| camera | quantity | true | found | ± | held |")
    print("|---|---|---|---|---|---|")
    for name, wrong in CAMERAS.items():
        rows: dict[str, list[tuple[float, float, Interval]]] = {}
        for draw in range(draws):
            with tempfile.TemporaryDirectory() as folder:
                arguments = recorded(Path(folder), seed=100 + draw, **wrong)
                reading = read_recording(characterise.main.parser().parse_args(arguments))
            for quantity, truth, estimate, interval in quantities(reading, wrong):
                rows.setdefault(quantity, []).append((truth, estimate, interval))
        for quantity, results in rows.items():
            truth = results[0][0]
            mean = float(np.mean([estimate for _, estimate, _ in results]))
            half = float(np.mean([(ends.high - ends.low) / 2 for _, _, ends in results]))
            covered = sum(ends.low <= truth <= ends.high for _, _, ends in results)
            cells = (f"{truth:.2f}", f"{mean:.2f}", f"{half:.2f}", f"{covered} of {draws}")
            print(f"| {name} | {quantity} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
