"""Speed beside other libraries, and how the cost grows: ``python tests/benchmarks/performance.py
[--quick] [PART ..]``.

Rivals do the same work in turns in one process, so that their ratios hold on any machine; what
they find is compared too. Times are this process' processor time on one thread, which others' work
on the machine lengthens less than the wall clock. No time is asserted. A study's trials see a
board of 30,000 pixels with direct light only: the time of a trial does not depend on how its view
was rendered.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np

Work = Callable[[], Any]
STUDY = ROOT / "experiments" / "detection_limit.yaml"
OVERRIDES = (
    *("sweep={}", "capture.frames=50", "study.hole_free_boards=1"),
    *("source.target.distance_m=0.785", "source.render.bounces=0", "threshold={k: 5.0}"),
)


def seconds(work: Work, runs: int) -> float:
    """Return the median processor time of a call, after one that is not counted."""
    return float(np.median([once(work) for _ in range(runs + 1)][1:]))


def once(work: Work) -> float:
    """Return the processor time of a call."""
    began = time.process_time()
    work()
    return time.process_time() - began


def told(
    title: str, rivals: Mapping[str, Work], runs: int, agree: Callable[[Any, Any], str]
) -> None:
    """Print the rivals' times, ours first, their ratios to it, and how far their results agree
    with ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = [work() for work in rivals.values()]
        spent = np.median([[once(work) for work in rivals.values()] for _ in range(runs)], axis=0)
    print(f"\n{title}")
    for name, s, result in zip(rivals, spent, results, strict=True):
        print(
            f"  {name:34} {1e3 * s:10.3f} ms {s / spent[0]:8.2f} x  {agree(results[0], result)}",
            flush=True,
        )


def exponent(title: str, works: Mapping[float, Work], runs: int) -> None:
    """Print the times by size, and the exponent of their growth: the slope of the logarithms."""
    times = {size: seconds(work, runs) for size, work in works.items()}
    slope = np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0]
    listed = ", ".join(f"{size:g}: {1e3 * s:.2f}" for size, s in times.items())
    print(f"  {title:44} cost ~ size^{slope:.2f}   (ms by size: {listed})", flush=True)


# ---------------------------------------------------------------- the same work by other libraries


def noisy_board(pixels: int) -> np.ndarray:
    """Return points (h, w, 3) of a bent board with damage, 0.5 mm of noise and a pitch of 1.4 mm."""
    random = np.random.default_rng(0)
    h = round((pixels / 1.5) ** 0.5)
    v, u = np.mgrid[:h, : round(1.5 * h)] * 1.4e-3
    z = 0.75 + 0.1 * u + 0.2 * u * v - v**3 + 5e-4 * random.standard_normal(u.shape)
    z[np.hypot(u % 0.06 - 0.03, v % 0.06 - 0.03) < 0.005] += 0.0127
    return np.stack([u, v, z], axis=-1)


def peers_of_frames(runs: int) -> None:
    """Average frames that lie in memory."""
    from detectors.averages.average import AverageConfig, average
    from harness.vocabulary.geometry import Frame, Lens

    lens = Lens(200, 150, 504.0, 504.0, 99.5, 74.5)
    stack = (0.75 + 1e-3 * np.random.default_rng(0).standard_normal((50, 150, 200))).astype(
        np.float32
    )

    frames = [Frame(str(i), z, np.zeros(z.shape, np.uint8)) for i, z in enumerate(stack)]
    source: Any = SimpleNamespace(
        name="bench", organised=True, z_step_m=0.0, region=lens.whole, lens=lens
    )
    source.slopes = lens.region_slopes(lens.whole)
    source.frames = lambda: iter(frames)

    def theirs() -> np.ndarray:
        np.nanvar(stack, axis=0, dtype=float), np.isfinite(stack).sum(axis=0)
        return np.asarray(np.nanmean(stack, axis=0, dtype=float))

    def apart(first: np.ndarray, other: np.ndarray) -> str:
        return f"means within {1e3 * np.abs(first - other).max():.1e} mm of ours"

    ours = partial(average, source, AverageConfig())
    rivals = {
        "tofpod, which also judges frames": lambda: ours().points_m[..., 2],
        "NumPy nanmean, nanvar": theirs,
    }
    told("mean, variance and count of 50 frames of 30,000 pixels", rivals, runs, apart)


def peers_of_surfaces(runs: int) -> None:
    """Fit a robust cubic. The others get the basis ready made; tolerances end within some
    micrometres of ours."""
    import statsmodels.api as sm
    from scipy.optimize import least_squares
    from sklearn.linear_model import HuberRegressor

    from detectors.surfaces.surface import Chebyshev, SurfaceConfig, fit_surface

    x, y, z = noisy_board(30_000).reshape(-1, 3).T
    basis = np.ascontiguousarray(
        Chebyshev.over(np.stack([x, y], axis=1), 3).basis(np.stack([x, y], axis=1)).T
    )
    middle = float(np.median(z))
    sigma = 5e-4
    scaled = (z - middle) / sigma
    columns = basis / sigma
    soft = {"loss": "soft_l1", "f_scale": 1.345, "xtol": 1e-4, "jac": lambda _: columns}

    def ours(method: str) -> np.ndarray:
        return fit_surface(x, y, z, SurfaceConfig.from_data({"method": method})).evaluate(x, y)

    def seen(first: np.ndarray, other: np.ndarray) -> str:
        return f"rms {1e6 * np.sqrt(np.mean((first - other) ** 2)):.2f} um from ours"

    huber = HuberRegressor(epsilon=1.345, alpha=0.0, fit_intercept=False, max_iter=1000, tol=1e-3)
    biweight = sm.robust.norms.TukeyBiweight(c=4.685)
    absolute = {
        "tofpod LAR": partial(ours, "lar"),
        "statsmodels QuantReg": lambda: (
            middle + sigma * basis @ sm.QuantReg(scaled, basis).fit(0.5).params
        ),
        "SciPy least_squares, soft_l1": lambda: (
            middle + basis @ least_squares(lambda c: columns @ c - scaled, np.zeros(10), **soft).x
        ),
        "scikit-learn HuberRegressor": lambda: (
            middle + sigma * basis @ huber.fit(basis, scaled).coef_
        ),
    }
    told(
        "a robust cubic through 30,000 points, least absolute residuals and the like",
        absolute,
        runs,
        seen,
    )
    tukey = {
        "tofpod bisquare": partial(ours, "bisquare"),
        "statsmodels RLM, Tukey": lambda: (
            middle + basis @ sm.RLM(z - middle, basis, M=biweight).fit().params
        ),
    }
    told("a robust cubic through 30,000 points, bisquare", tukey, runs, seen)


def peers_of_clusters(runs: int) -> None:
    """Cluster the points that stand out, at 10 mm."""
    import open3d as o3d
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree
    from sklearn.cluster import DBSCAN

    from detectors.pixels.clusters import euclidean_clusters

    points = noisy_board(120_000).reshape(-1, 3)
    points = np.ascontiguousarray(points[np.random.default_rng(1).random(len(points)) < 0.02])
    points[:, 2] = 0.75
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    def by_tree() -> np.ndarray:
        i, j = cKDTree(points).query_pairs(0.01, output_type="ndarray").T
        links = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(points), len(points)))
        return np.asarray(connected_components(links, directed=False)[1])

    rivals = {
        "tofpod": lambda: euclidean_clusters(points, 0.01),
        "SciPy k-d tree and components": by_tree,
        "scikit-learn DBSCAN": lambda: DBSCAN(eps=0.01, min_samples=1).fit_predict(points),
        "Open3D cluster_dbscan": lambda: np.asarray(cloud.cluster_dbscan(0.01, 1)),
    }

    def same(first: np.ndarray, other: np.ndarray) -> str:
        counts = {
            len(np.unique(points, axis=1).T)
            for points in (np.stack([first, other]), first[None], other[None])
        }
        return (
            f"{'the same' if len(counts) == 1 else 'NOT the same'} {len(np.unique(other))} clusters"
        )

    told(f"clusters of {len(points):,} points", rivals, runs, same)


def peers_of_curves(runs: int) -> None:
    """Fit a curve of detection to 300 hits and misses."""
    import statsmodels.api as sm

    from harness.evaluation.pod.hit_miss import fit_hit_miss

    random = np.random.default_rng(0)
    size = random.uniform(2.0, 8.0, 300)
    hit = (random.random(300) < 1 / (1 + np.exp(-2 * (size - 4)))).astype(float)
    design = np.column_stack([np.ones(300), size])

    def logit() -> float:
        b0, b1 = sm.Logit(hit, design).fit(disp=0).params
        return float(-b0 / b1)

    rivals = {
        "tofpod fit_hit_miss": lambda: fit_hit_miss(size, hit).curve.mu,
        "statsmodels Logit": logit,
    }
    told(
        "a logistic curve of 300 hits and misses",
        rivals,
        runs,
        lambda ours, other: f"a50 {other:.6f}",
    )


def peers_of_registration(runs: int) -> None:
    """Bring two clouds of a wavy sheet together, point to point."""
    import open3d as o3d

    from detectors.views.registration.by_points import register_by_icp
    from detectors.views.registration.settings import IcpRegistration
    from tests.detectors.views.registration.test_registration_icp import (
        pose,
        usual_error,
        wavy_view,
    )

    guess = pose() @ np.linalg.inv(pose(5, -8)) @ usual_error()
    views = [wavy_view(pose(), np.eye(4), 0, 2e-4), wavy_view(pose(5, -8), guess, 1, 2e-4)]
    config = IcpRegistration(points="target")

    def theirs() -> np.ndarray:
        clouds = []
        for view in views:
            points = o3d.utility.Vector3dVector(view.points_m)
            clouds.append(o3d.geometry.PointCloud(points))
        fixed, moving = clouds
        point = o3d.pipelines.registration.TransformationEstimationPointToPoint()
        T = guess
        for limit in (0.03, 0.015, 0.012):
            T = o3d.pipelines.registration.registration_icp(
                moving, fixed, limit, T, point
            ).transformation
        return np.asarray(T)

    def apart(first: np.ndarray, other: np.ndarray) -> str:
        return f"{1e3 * np.linalg.norm((first - other)[:3, 3]):.3f} mm from ours"

    ours = partial(register_by_icp, *views, config)
    rivals = {
        "tofpod, with its covariance": lambda: ours().T_reference_view,
        "Open3D registration_icp": theirs,
    }
    told("ICP, point to point, two clouds of 2,500 points", rivals, max(3, runs // 3), apart)


def peers_of_renders(runs: int) -> None:
    """Render a blind hole: ours against mitransient's path tracer, by time times variance of the
    pixels inside."""
    from scenes.optics import RenderConfig
    from scenes.render.scene import lit_scene, load_mitsuba
    from scenes.render.view import render_view
    from scenes.target.custom import TargetConfig
    from scenes.target.mesh import build_target
    from tests.scenes.render.test_transport_oracle import FREQUENCIES, optics_of
    from tests.validation.transport_oracle import oracle

    hole = {"id": 1, "kind": "blind", "diameter_mm": 24, "depth_mm": 30, "centre_mm": [0, 0]}
    board = {"width_mm": 60, "height_mm": 60, "thickness_mm": 40}
    index = {"distance_m": 0.5, "tilt_x_deg": 8}
    facts = {
        "name": "custom",
        "board": board,
        "holes": [hole],
        "pose": index,
        "backing": None,
        "room": None,
    }
    target = build_target(TargetConfig.from_data(facts))
    optics = optics_of(56, 56, 420.0)
    lit = lit_scene(load_mitsuba(), target.parts, optics)
    view = render_view(target, optics, RenderConfig(bounces=6))
    cut = (slice(view.region.row0, view.region.row1), slice(view.region.col0, view.region.col1))
    tracer = oracle(lit, optics, FREQUENCIES)
    inside = view.range_m > 0.515

    def ours(seed: int) -> np.ndarray:
        return render_view(target, optics, RenderConfig(bounces=6, seed=seed)).phasor[0][inside]

    def theirs(seed: int) -> np.ndarray:
        return tracer.phasors(256, seed, 6)[0][cut][inside]

    print("\nrender of a blind hole 24 mm wide and 30 mm deep")
    products = []
    for name, draw in (("tofpod", ours), ("mitransient, 256 paths a pixel", theirs)):
        spent = seconds(partial(draw, 99), 1)
        drawn = np.stack([draw(seed) for seed in range(1, runs + 1)])
        error_rad = float(
            np.sqrt(np.mean(np.angle(drawn / drawn.mean(axis=0)) ** 2) * runs / (runs - 1))
        )
        products.append(spent * error_rad**2)
        error_mm = 1e3 * error_rad * 299_702_547 / (4 * np.pi * FREQUENCIES[0])
        print(
            f"  {name:34} {1e3 * spent:10.1f} ms, error {error_mm:.4f} mm in {inside.sum()} "
            "pixels of a hole"
        )
    print(f"  at equal error mitransient takes {products[1] / products[0]:.1f} times our time")


# ---------------------------------------------------------------- trials, and how costs grow


def trials_of(cache: Path, count: int, *overrides: str, boards: int = 1) -> list[Any]:
    """Return so many draws of noise on each of a study's damaged boards, their views rendered."""
    from harness.experiment.load import load_experiment
    from harness.runs.plan import plan_of
    from scenes.render.cache import cached_view
    from scenes.sensor.camera import camera_of

    group = plan_of(
        load_experiment(STUDY, [*OVERRIDES, f"study.boards={boards}", *overrides]), cache
    ).groups[0]
    damaged = [batch for batch in group.batches if batch.role == "damaged"]
    for job in [job for batch in damaged for job in batch.renders]:
        cached_view(job.target, camera_of(job.camera).optics, job.config, job.folder)
    firsts = [next(group.trials(batch, {}))[1] for batch in damaged]
    return [replace(task, repeat=number) for number in range(count) for task in firsts]


def run_all(tasks: list[Any]) -> None:
    """Run trials."""
    from harness.trials.trial import run_trial

    for task in tasks:
        run_trial(task)


def rate_of(tasks: list[Any]) -> float:
    """Return the trials a second, by the wall clock, of this process when it is warm."""
    run_all(tasks[:2])
    began = time.perf_counter()
    run_all(tasks)
    return len(tasks) / (time.perf_counter() - began)


def trials(runs: int) -> None:
    """Print how many new boards a second and core are judged, their views rendered: a study draws
    each board once, so that what is kept from an earlier trial of the same board does not count.
    Views are loaded, frames drawn, averaged, cropped and fitted; findings are sized and matched;
    and a study's rows are made. Of detectors that learn nothing, as what `matched` has learned
    comes from boards of its own."""
    print("\nboards of 30,000 pixels with eight holes, 50 frames of each, a second and core")
    with tempfile.TemporaryDirectory() as folder:
        detectors = {
            "thesis (the default)": (),
            "local": ("detector={name: local, settings: {crop: {kind: auto, inset_px: 4}}}",),
        }
        for name, detector in detectors.items():
            tasks = trials_of(Path(folder), 1, *detector, boards=2 * runs + 1)
            run_all(tasks[:1])
            spent = float(np.median([once(partial(run_all, [task])) for task in tasks[1:]]))
            print(f"  {name:24} {1 / spent:8.1f} a second ({1e3 * spent:.1f} ms)", flush=True)


def growth(runs: int) -> None:
    """Print the measured exponents of cost with pixels, frames, holes, boards and workers."""
    from detectors import load_detector
    from harness.vocabulary.geometry import Cloud, Region

    print("\nhow the processor time grows")

    def analysed(pixels: int) -> Work:
        points = noisy_board(pixels)
        flat = np.zeros(points.shape[:2], np.uint8)
        cloud = Cloud(
            points,
            flat,
            flat + 1,
            np.full(flat.shape, np.nan),
            Region(0, len(flat), 0, flat.shape[1]),
            0.0,
            1,
        )
        detector = load_detector("thesis", {"crop": {"kind": "none"}})
        return lambda: detector.find(cloud, detector.analyse(cloud), 6.0)

    exponent("pixels: thesis detector", {n: analysed(n) for n in (10_000, 40_000, 160_000)}, runs)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def tried(*said: str, boards: int = 1) -> Work:
            return partial(run_all, trials_of(folder, 1, *said, boards=boards))

        by_frames = {n: tried(f"capture.frames={n}") for n in (25, 50, 100, 200)}
        exponent("frames: trials", by_frames, runs)
        drilled = "source.target.damage={{kind: through, per_board: {}, diameter_mm: [4.0, 8.0]}}"
        exponent("holes: trials", {n: tried(drilled.format(n)) for n in (1, 2, 4, 8)}, runs)
        exponent(
            "boards: trials",
            {n: tried(boards=n) for n in (1, 2, 4)},
            max(3, runs // 3),
        )
        tasks = trials_of(folder, 20 * runs)
        context = multiprocessing.get_context("spawn")
        rates = []
        for workers in (1, 2):
            with ProcessPoolExecutor(workers, mp_context=context) as pool:
                rates.append(sum(pool.map(rate_of, [tasks] * workers)))
        print(
            f"  workers: two processes do {rates[1] / rates[0]:.2f} times the trials of "
            "one, by the wall clock"
        )


def boards(runs: int) -> None:
    """Print the processor time of a board's render, mesh included, by the board's damage."""
    import drjit

    from harness.experiment.load import load_experiment
    from harness.runs.plan import plan_of
    from scenes.render.view import render_view
    from scenes.sensor.camera import camera_of
    from scenes.target.mesh import build_target

    print("\nrender of a board of detection_limit.yaml, a second and core")
    plan = plan_of(load_experiment(STUDY, []), Path())
    by_kind = dict[str, list[Any]]()
    for group in plan.groups:
        for batch in group.batches:
            holes = batch.renders[0].target.holes
            by_kind.setdefault(
                f"{len(holes)} holes, {holes[0].kind}" if holes else "hole-free", []
            ).append(batch.renders[0])

    def drawn(job: Any) -> None:
        render_view(build_target(job.target), camera_of(job.camera).optics, job.config)

    for jobs in by_kind.values():
        drawn(jobs[0])
    drjit.set_thread_count(1)
    for kind, jobs in by_kind.items():
        spent = np.median(
            [once(partial(drawn, job)) for job in jobs[:: max(1, len(jobs) // runs)][:runs]]
        )
        print(f"  {kind:24} {spent:8.2f} s", flush=True)


def programs(runs: int) -> None:
    """Print the wall-clock time of imports and of whole sweeps that find nothing stored, with two
    processes."""

    def seconds_of(*arguments: str) -> float:
        began = time.perf_counter()
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, **quiet)
        return time.perf_counter() - began

    print("\nwhole programs, by the wall clock")
    names = [
        path.stem
        for path in (ROOT / "harness").glob("[a-z]*.py")
        if "\n@program(" in path.read_text()
    ]
    bare = min(seconds_of("-c", "") for _ in range(3))
    times = {
        name: min(seconds_of("-c", f"import harness.{name}") for _ in range(3)) - bare
        for name in names
    }
    slowest = max(times, key=lambda name: times[name])
    print(
        f"  import of any program: at most {times[slowest]:.2f} s (harness.{slowest})", flush=True
    )
    sweeps = (("averaging", "--quick"), ("averaging",), ("detection_limit",))
    for sweep in sweeps[:1] if runs < 9 else sweeps:
        with tempfile.TemporaryDirectory() as folder:
            spent = seconds_of("-m", "harness.sweep", *sweep, "--out", folder)
            print(f"  sweep {' '.join(sweep):24} {spent:8.1f} s", flush=True)


def main() -> None:
    """Run the parts that are named, or all."""
    peers = (
        peers_of_frames,
        peers_of_surfaces,
        peers_of_clusters,
        peers_of_curves,
        peers_of_registration,
    )
    parts = (*peers, peers_of_renders, boards, trials, growth, programs)
    reference = {part.__name__.removeprefix("peers_of_"): part for part in parts}
    parser = argparse.ArgumentParser(
        description="Compare speed with other libraries and show how cost grows."
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", choices=[*reference, []], help=", ".join(reference)
    )
    parser.add_argument("--quick", action="store_true", help="fewer runs, less certain")
    options = parser.parse_args()
    # Mitsuba cannot run if Open3D was imported before it.
    from scenes.render.scene import load_mitsuba

    load_mitsuba()
    print(f"{os.cpu_count()} cores, one thread used; load {os.getloadavg()[0]:.1f} at the start")
    for name in options.parts or reference:
        reference[name](3 if options.quick else 9)
    print(f"\nload {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
