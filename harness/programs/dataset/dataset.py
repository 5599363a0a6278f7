"""``tofpod dataset EXPERIMENT --boards 500 --out DIR``: writes boards with masks to train and
score on."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.runs.engines import engine_of
from harness.runs.jobs import Job, JobEngine, Outcome, StageCounts
from harness.runs.options import EngineOptions, add_overrides
from harness.runs.shards import locked
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.experiment.schema import Experiment
    from harness.programs.dataset.boards import Sample

MOST = 10_000


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file, or the name of one that comes with tofpod, with random boards",
    )
    add_overrides(parser, "source.target.distance_m=90cm")
    add(
        "--boards",
        type=int,
        required=True,
        metavar="N",
        help="boards for each set-up (camera, frames and so on)",
    )
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="a new folder, or the one of an unfinished run",
    )
    add(
        "--licence",
        default="CC-BY-4.0",
        metavar="NAME",
        help="the licence that the card states (default: CC-BY-4.0)",
    )
    results = (
        "results folder of experiments, whose stored renders are used and extended (default: "
        "results)"
    )
    add("--results", type=Path, default=Path("results"), metavar="DIR", help=results)
    add("--jobs", type=int, default=2, metavar="N", help="processes (default: 2)")
    add("--serial", action="store_true", help="run everything in this process, for a debugger")


@program(
    _options,
    "Write a data set of simulated boards with organised clouds, depth, intensity, validity, "
    "masks and truth: as NPZ and PNG, in the layout of MVTec 3D-AD, and as COCO masks.",
    "tofpod dataset detection_limit --boards 500 --out boards",
    "tofpod dataset panel --boards 100 --set source.target.distance_m=0.9 --out panels",
    epilog="Finished boards are kept: the same command resumes after Ctrl-C or a fault. "
    "tofpod score states the detection limit of any anomaly maps on it.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if boards failed, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.experiment.load import load_experiment, resolved_yaml
    from harness.programs.dataset.boards import FEWEST, INDEX, read_index, samples_of
    from scenes.render.cache import in_use

    if not FEWEST <= options.boards <= MOST or options.jobs < 1:
        fault = f"--boards {options.boards} --jobs {options.jobs}: out of range"
        raise UserError(fault, legal=f"{FEWEST} to {MOST} boards, 1 process or more")
    experiment = load_experiment(options.experiment, options.overrides).at_stated_values()
    out = options.out
    cache = options.results / ".cache" / "renders"
    samples = samples_of(experiment, options.boards, cache)
    facts = _about(experiment, options.licence, samples, command)
    if (out / INDEX).exists():
        if read_index(out)["content"] != facts["content"]:
            problem = (
                f"{out}: holds a data set of another experiment, number of boards or version of "
                "the code"
            )
            raise UserError(problem, fix="name a new folder with --out")
    elif out.is_dir() and any(out.iterdir()):
        raise UserError(
            f"{out}: is not empty, and no file is overwritten", fix="name a new folder with --out"
        )
    write_text(out / INDEX, json.dumps({**facts, "samples": None}, indent=1) + "\n")
    write_text(out / "experiment.yaml", resolved_yaml(experiment))
    engine_options = EngineOptions(jobs=options.jobs, serial=options.serial)
    with in_use(cache), locked(out), engine_of(engine_options) as engine:
        failures = _written(out, samples, engine)
    if failures:
        print(f"{len(failures)} jobs failed; the first failure: {failures[0]}", file=sys.stderr)
        print("run the same command again to write the missing boards", file=sys.stderr)
        return 1
    _finish(out, samples, facts)
    print(
        f"wrote {out}: {len(samples)} boards in {len(facts['categories'])} categories; README.md "
        "there explains them"
    )
    return 0


def _about(
    experiment: Experiment, licence: str, samples: list[Sample], command: str
) -> dict[str, Any]:
    """Return the header of ``dataset.json``; ``content`` is a digest of everything that determines
    the files."""
    from harness.programs.dataset.boards import DATASET_VERSION, categories_of
    from harness.runs.plan import PACKAGES
    from harness.vocabulary.provenance import record, source_digest
    from harness.vocabulary.seeds import digest

    categories: dict[str, Any] = {}
    for name, point in categories_of(experiment).items():
        category_samples = [sample for sample in samples if sample.category == name]
        cameras = [sample.task.views[0].camera for sample in category_samples]
        categories[name] = {
            "camera": cameras[0].name,
            "units": len({camera.unit_seed for camera in cameras}),
            "frames": point.config.capture.frames,
            "boards": Counter(f"{sample.split}/{sample.label}" for sample in category_samples),
        }
    calibrate = experiment.config.threshold.calibrate
    boards = [[sample.name, sample.render.path.stem] for sample in samples]
    points = [[point.frames_key, point.config.capture.to_data()] for point in experiment.points]
    code = source_digest(("harness.programs.dataset.boards",), PACKAGES)
    return {
        "dataset_version": DATASET_VERSION,
        "name": experiment.config.name,
        "content": digest([code, boards, points]),
        "licence": licence,
        "false_calls_per_m2": (calibrate and calibrate.false_calls_per_m2) or 1.0,
        "hit_radius_mm": experiment.config.matching.radius_mm,
        "hit_overlap": experiment.config.matching.overlap,
        "categories": categories,
        "provenance": record(command),
    }


def _written(out: Path, samples: list[Sample], engine: JobEngine) -> list[str]:
    """Render missing views and write missing boards; return why jobs failed. Progress is printed
    to stderr."""
    from harness.programs.dataset.boards import TRUTH, seen_region, write_board
    from harness.runs.estimate import progress_display
    from harness.runs.job_batches import carried_out
    from harness.vocabulary.geometry import Region

    outcome = Outcome()
    failures = list[str]()
    renders = {sample.render.path: sample.render for sample in samples}
    missing = [sample for sample in samples if not (sample.folder(out) / TRUTH).exists()]
    outcome.renders.total = len(renders)
    outcome.trials.total = len(samples)
    outcome.trials.found = len(samples) - len(missing)
    with progress_display() as show:

        def carry_out(jobs: list[Job], counts: StageCounts) -> dict[str, Any]:
            values = {}
            for job, ended in carried_out(jobs, engine):
                values[job.name] = ended.value
                if ended.state == "done":
                    counts.done += 1
                else:
                    counts.failed += 1
                    failures.append(f"{job.name}: {ended.why.strip()}")
                show(outcome)
            return values

        first = [Job(path.stem, "renders", seen_region, (job,)) for path, job in renders.items()]
        regions = carry_out(first, outcome.renders)
        if failures:
            return failures
        by_category: dict[str, list[Any]] = {}
        for sample in samples:
            by_category.setdefault(sample.category, []).append(regions[sample.render.path.stem])
        windows = {
            category: reduce(Region.joined, regions) for category, regions in by_category.items()
        }
        boards = [
            Job(board.name, "trials", write_board, (out, board, windows[board.category]))
            for board in missing
        ]
        carry_out(boards, outcome.trials)
    return failures


def _finish(out: Path, samples: list[Sample], facts: dict[str, Any]) -> None:
    """Write the COCO files, the card, and finally the index, which marks the data set as
    complete."""
    from harness.programs.dataset.boards import INDEX, INSET_PX, SPLITS, read_truth
    from harness.programs.dataset.exchange import coco_data
    from harness.report.blocks import template
    from harness.vocabulary.path_names import camera_title

    truths = {sample.name: read_truth(out, sample.name) for sample in samples}
    kinds = sorted({damage["kind"] for truth in truths.values() for damage in truth["damages"]})
    info = {"description": facts["name"], "license": facts["licence"]}
    for category in facts["categories"]:
        for split in dict.fromkeys(split for split, _, _ in SPLITS):
            pictures = [
                truths[sample.name]
                for sample in samples
                if (sample.category, sample.split) == (category, split)
            ]
            text = json.dumps(coco_data(pictures, kinds, info), separators=(",", ":"))
            write_text(out / "coco" / f"{category}_{split}.json", text + "\n")
    card = template("dataset_card.md", Path(__file__).parent)
    text = card.render(about=facts, inset=INSET_PX, title=camera_title)
    write_text(out / "README.md", text)
    write_text(out / INDEX, json.dumps({**facts, "samples": [*truths]}, indent=1) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
