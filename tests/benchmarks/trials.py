"""What whole trials cost: ``python tests/benchmarks/trials.py [--quick] [--peers] [--json FILE]``.

Frames and trials a second on one core, where a trial's time goes, what engine and journal add, memory of a worker, and
two workers against one, on a board's region of 30,000 pixels before an Azure Kinect. With --peers the same work in
plain NumPy, SciPy, scikit-learn, statsmodels and Open3D, in the same run and in turns with ours, so that ratios hold on
any machine. One thread each. No time is asserted. Other work on the machine shows in what the wall clock says, less in
processor times; what is to be quoted is measured on an idle one.
"""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

ROOT = Path(__file__).resolve().parents[2]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

if TYPE_CHECKING:
    from clocks import Times
    from peers import Rival
    from whole_trials import Trials


def main() -> int:
    """The program. Everything heavy is imported below, after the threads are set; workers import this file too."""
    options = _options()
    os.environ.update(dict.fromkeys(THREADS, "1"))
    sys.path.insert(0, str(ROOT))
    found: dict[str, Any] = {"machine": _machine(), "quick": options.quick}
    print("\n".join(f"{name}: {value}" for name, value in found["machine"].items()))
    with tempfile.TemporaryDirectory(prefix="tofpod-bench-") as folder:
        _measure(Path(folder), options, found)
    found["machine"]["load at the end"] = _load()
    print(f"\nload at the end: {_load()}")
    if options.json is not None:
        import json

        from harness.vocabulary.files import write_text

        write_text(options.json, json.dumps(found, indent=1) + "\n")
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python tests/benchmarks/trials.py", description="What whole trials cost.")
    parser.add_argument("--quick", action="store_true", help="fewer runs: under a minute, and less certain")
    parser.add_argument("--peers", action="store_true", help="NumPy, SciPy, scikit-learn, statsmodels and Open3D too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers there as well")
    return parser.parse_args()


def _measure(folder: Path, options: argparse.Namespace, found: dict[str, Any]) -> None:
    import engine_rates
    import whole_trials as whole

    cache = folder / "renders"
    measured = {way: whole.Trials.of(whole.group_of(cache, *said)) for way, said in whole.ways().items()}
    first = measured["frame by frame"]
    found["region"] = _region(first)
    found["frames"] = _frames(first, 4 if options.quick else 12)
    found["trials"] = {way: _trials(way, trials, options.quick) for way, trials in measured.items()}
    found["shares"] = _shares(measured, options.quick)
    if not whole.AT_ONCE:
        print("\naverages cannot be drawn at once in this version: frame by frame only")
    found["memory MB"] = {way: whole.peak_mb(trials.tasks("damaged", 5)) for way, trials in measured.items()}
    _table("memory of a worker at most (MB)", [[way, f"{mb:.0f}"] for way, mb in found["memory MB"].items()])
    found["engine"] = engine_rates.overhead(folder, 200 if options.quick else 1000)
    _table("engine and journal, cheap trials", engine_rates.overhead_lines(found["engine"]))
    counts = {"frame by frame": 10 if options.quick else 60, "drawn at once": 60 if options.quick else 600}
    found["workers"] = {
        way: engine_rates.two_against_one(folder, cache, way, said, counts[way], control=not options.quick)
        for way, said in whole.ways().items()
    }
    _table("two workers against one, by engine and journal", engine_rates.worker_lines(found["workers"]))
    if options.peers:
        found["peers"] = _peers(first, options.quick)


# ---------------------------------------------------------------- ours


def _region(trials: Trials) -> dict[str, Any]:
    from harness.engine.setup import load_set_up

    set_up = load_set_up(trials.group.damaged.set_ups[0])
    view = set_up.unit.view
    region = {"simulated": view.range_m.size, "kept": set_up.unit.region.shape, "on the board": set_up.on_board.sum()}
    region["kept"] = region["kept"][0] * region["kept"][1]
    region = {name: int(pixels) for name, pixels in region.items()}
    _table(f"pixels, {set_up.unit.camera.name}", [[name, f"{pixels:,}"] for name, pixels in region.items()])
    return region


def _frames(trials: Trials, runs: int) -> dict[str, Any]:
    from whole_trials import frame_times

    times = frame_times(trials.unit, runs)
    _table("frames, frame by frame", [["", *HEADS], *([name, *_rates(each)] for name, each in times.items())])
    return {name: asdict(each) for name, each in times.items()}


def _trials(way: str, trials: Trials, quick: bool) -> dict[str, Any]:
    from dataclasses import replace

    from whole_trials import FRAMES, ROLES, trial_times

    count = (6 if quick else 40) if way == "frame by frame" else (40 if quick else 400)
    kinds = {f"a study's board: {role.replace('_', '-')}": trials.tasks(role, 3 + count) for role in ROLES}
    kinds["a board outside of a study: damaged"] = [
        replace(task, board=None) for task in trials.tasks("damaged", 3 + count)
    ]
    times = {name: trial_times(given) for name, given in kinds.items()}
    lines = [["", *HEADS], *([name, *_rates(each)] for name, each in times.items())]
    _table(f"whole trials of {FRAMES} frames, {way}: frames to judgement, one core", lines)
    return {name: asdict(each) for name, each in times.items()}


def _shares(measured: dict[str, Trials], quick: bool) -> dict[str, dict[str, float]]:
    from whole_trials import shares

    counts = {"frame by frame": 5 if quick else 20, "drawn at once": 30 if quick else 200}
    found = {way: shares(trials.tasks("damaged", counts[way])) for way, trials in measured.items()}
    whole = {way: sum(each.values()) for way, each in found.items()}
    lines = [["processor time", *(f"{way}: ms" for way in found), *(f"{way}: %" for way in found)]]
    for label in next(iter(found.values())):
        milliseconds = [f"{1e3 * found[way][label]:.2f}" for way in found]
        lines.append([label, *milliseconds, *(f"{100 * found[way][label] / whole[way]:.1f}" for way in found)])
    lines.append(["in all", *(f"{1e3 * whole[way]:.2f}" for way in found), *("100" for _ in found)])
    _table("where a study's damaged board spends its time", lines)
    return found


# ---------------------------------------------------------------- peers


def _peers(trials: Trials, quick: bool) -> dict[str, Any]:
    import peers
    from whole_trials import FRAMES

    judged = peers.Judged.of(trials.unit, trials.tasks("damaged", 1)[0])
    runs = 5 if quick else 20
    low = 1.5
    at_threshold, many = (peers.clusters(judged, runs, k) for k in (judged.threshold, low))
    tables = {
        f"frames with their mean, {FRAMES} a capture: ms a frame": peers.frame_loops(
            trials.unit, FRAMES, max(3, runs // 3)
        ),
        f"a robust cubic through {len(judged.points.xyz_m):,} points: ms": peers.surfaces(judged, runs),
        f"clusters of {at_threshold[0]} points beyond the threshold of {judged.threshold:.1f}: ms": at_threshold[1],
        f"clusters of {many[0]} points beyond {low} deviations: ms": many[1],
    }
    for title, rivals in tables.items():
        ours = rivals[0].times.processor_s
        lines = [["", "least", "median", "processor", "runs", "to ours", "agreement"]]
        _table(title, [*lines, *(_rival_line(rival, ours) for rival in rivals)], words=1)
    return {title: [asdict(rival) for rival in rivals] for title, rivals in tables.items()}


def _rival_line(rival: Rival, ours_s: float) -> list[str]:
    times = rival.times
    numbers = [f"{1e3 * s:.2f}" for s in (times.least_s, times.median_s, times.processor_s)]
    return [rival.name, *numbers, str(times.runs), f"{times.processor_s / ours_s:.1f} x", rival.agreement]


# ---------------------------------------------------------------- printing

HEADS = ("a second, median", "best", "by processor time", "ms, median", "least", "processor", "runs")


def _rates(times: Times) -> list[str]:
    seconds = (times.median_s, times.least_s, times.processor_s)
    return [*(f"{1 / s:.1f}" for s in seconds), *(f"{1e3 * s:.2f}" for s in seconds), str(times.runs)]


def _table(title: str, lines: list[list[str]], words: int = 0) -> None:
    """Lines of cells in columns; the first column and the last ``words`` are text, the others numbers."""
    columns = len(lines[0])
    widths = [max(len(line[column]) for line in lines) for column in range(columns)]
    print(f"\n{title}")
    for line in lines:
        text = [
            cell.ljust(width) if column == 0 or column >= columns - words else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        print("  " + "  ".join(text).rstrip())


def _machine() -> dict[str, str]:
    import importlib.metadata

    names = ("numpy", "numba", "scipy", "scikit-learn", "statsmodels", "open3d-cpu")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in names]
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor() or platform.machine()
    return {
        "command": shlex.join(["python", *sys.argv]),
        "processor": f"{processor}, {os.cpu_count()} cores, one thread used",
        "versions": ", ".join([f"Python {platform.python_version()}", *versions]),
        "load at the start": _load(),
    }


def _load() -> str:
    """Processes that want a core, averaged over the last minute: more than none before the start is others' work."""
    return f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"


if __name__ == "__main__":
    sys.exit(main())
