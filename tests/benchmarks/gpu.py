"""Renders on a GPU beside the processor: ``python tests/benchmarks/gpu.py [--boards N] [--variants
NAME ..]``.

Boards of `experiments/detection_limit.yaml` are rendered by each variant in a process of its own,
once with the study's settings and once as a reference with many paths. Prints wall-clock seconds a
board when kernels are warm, the seconds of the first board, which compiles them, and how far the
views are apart in range: the median, and the share of pixels that differ by more than four
deviations of the noise that both state. Exit code 1 where that share is above 1 %.

Needs an NVIDIA GPU with OptiX for ``cuda``; ``llvm`` is the processor with all its cores,
``llvm-1`` with one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

import numpy as np

VARIANTS = {
    "cuda": ("cuda_ad_mono", None),
    "llvm": ("llvm_ad_mono", None),
    "llvm-1": ("llvm_ad_mono", 1),
}
"""Mitsuba's variants and the number of threads; None means all."""
WORKS: dict[str, dict[str, float]] = {
    "study": {},
    "reference": {
        "hole_noise_mm": 0.03,
        "hole_samples": 65536,
        "face_samples": 65536,
        "rest_samples": 64,
    },
}
"""Settings of the render that replace the study's; a reference is rendered of one board of each
kind."""
OVERRIDES = (
    "study.hole_free_boards=1",
    "threshold={k: 5.0}",
    "detector.name=thesis",
    "capture.frames=1",
)


def boards_of(count: int) -> list[Any]:
    """Return jobs of ``count`` boards of each kind of damage and of one without."""
    from harness.experiment.load import load_experiment
    from harness.runs.plan import plan_of

    damage = (
        '"source.target.damage": [{kind: through, per_board: 8, diameter_mm: [2.0, 8.0]}, '
        "{kind: blind, "
    )
    damage += "per_board: 8, diameter_mm: [4.0, 20.0], depth_mm: [1.0, 12.0]}]"
    printed = [f"sweep={{{damage}}}", f"study.boards={count}", *OVERRIDES]
    plan = plan_of(
        load_experiment(ROOT / "experiments" / "detection_limit.yaml", printed), Path("unused")
    )
    jobs = [job for group in plan.groups for batch in group.batches for job in batch.renders]
    return list({job.target: job for job in jobs}.values())


def render(name: str, boards: int, folder: Path) -> None:
    """Render all boards in this process; prints {work: seconds of each board} as JSON. Views go
    into ``folder``."""
    from scenes.render.scene import _point_to_llvm

    _point_to_llvm()
    import drjit
    import mitsuba

    variant, threads = VARIANTS[name]
    mitsuba.set_variant(variant)
    if threads is not None:
        drjit.set_thread_count(threads)
    from scenes.render.cache import write_view
    from scenes.render.view import render_view
    from scenes.sensor.camera import camera_of
    from scenes.target.mesh import build_target

    spent: dict[str, list[float]] = {}
    for work, settings in WORKS.items():
        for number, job in enumerate(boards_of(1 if settings else boards)):
            began = time.perf_counter()
            config = job.config.model_copy(update=settings)
            view = render_view(build_target(job.target), camera_of(job.camera).optics, config)
            spent.setdefault(work, []).append(time.perf_counter() - began)
            write_view(folder / f"{name}_{work}_{number}.npz", view)
    print(json.dumps(spent))


def apart(first: Path, second: Path) -> np.ndarray:
    """Return (2, n): the difference of range in mm of two stored views of a board, and the
    deviation of what their noise makes of it; pixels with less light than 0.03 of a white plane at
    1 m are left out."""
    from scenes.render.cache import read_view
    from scenes.render.range_noise import range_change_m

    view = read_view(first)
    two = read_view(second)
    assert view is not None and two is not None
    lit = np.abs(two.phasor).mean(axis=0) > 0.03
    change = (view.phasor[:, lit] - two.phasor[:, lit]).astype(complex)
    moved_m = range_change_m(change, two.phasor[:, lit].astype(complex), two.frequencies_hz)
    noise_m = np.hypot(view.indirect_noise_m[lit], two.indirect_noise_m[lit])
    return np.stack([1e3 * moved_m, 1e3 * np.maximum(noise_m, 1e-7)])


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--boards", type=int, default=4, help="of each kind of damage")
    parser.add_argument(
        "--variants",
        nargs="+",
        choices=VARIANTS,
        default=["cuda", "llvm"],
        help="the last is compared",
    )
    parser.add_argument("--render", nargs=2, metavar=("VARIANT", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.render:
        render(options.render[0], options.boards, Path(options.render[1]))
        return 0
    agree = True
    with tempfile.TemporaryDirectory() as folder:
        spent: dict[str, dict[str, list[float]]] = {}
        for name in options.variants:
            command = [
                sys.executable,
                __file__,
                "--boards",
                str(options.boards),
                "--render",
                name,
                folder,
            ]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                print(f"{name}: {done.stderr}", file=sys.stderr)
                return 1
            spent[name] = json.loads(done.stdout.splitlines()[-1])
        *remaining, last = options.variants
        for work in WORKS:
            warm = {name: float(np.median(spent[name][work][1:])) for name in options.variants}
            print(f"\n{work}: {len(spent[last][work])} boards")
            for name, seconds in warm.items():
                first = spent[name][work][0]
                ratio = warm[last] / seconds
                print(
                    (
                        f"  {name:8} {seconds:8.3f} s a board, first {first:6.2f} s, "
                        f"{ratio:7.2f} times as fast as {last}"
                    )
                )
            for name in remaining:
                pairs = [
                    (Path(folder) / f"{v}_{work}_{n}.npz" for v in (name, last))
                    for n in range(len(spent[last][work]))
                ]
                moved_mm, noise_mm = np.concatenate([apart(*pair) for pair in pairs], axis=1)
                beyond = float((np.abs(moved_mm) > 4 * noise_mm).mean())
                agree &= beyond <= 0.01
                print(
                    f"  {name} and {last}: {np.median(np.abs(moved_mm)):.5f} mm apart "
                    "(median), noise of the two "
                    f"{np.median(noise_mm):.5f} mm, {100 * beyond:.2f} % of pixels beyond "
                    "four deviations"
                )
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
