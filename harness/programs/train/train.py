"""``tofpod train EXPERIMENT --out network.npz``: trains a network for the detector `learned`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.runs.options import add_engine_options, add_overrides, engine_options
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from detectors.methods.network import Network
    from harness.experiment.schema import Experiment
    from harness.programs.train.pictures import LabelledPicture
    from harness.runs.jobs import JobEngine
    from harness.runs.plan import SweepPlan

MOST_CHANNELS = 256
MOST_PASSES = 10_000
HELD_OUT = 8
"""One in so many boards is not trained on; the loss on it tells whether the network learned the
boards by heart."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file, or the name of one that comes with tofpod, with random boards and a "
        "detector with a network",
    )
    add_overrides(parser, "study.boards=20")
    add("--out", type=Path, required=True, metavar="FILE", help="the network's file, .npz")
    passes = "how often each picture is shown (default: 6)"
    add("--passes", type=whole_number(MOST_PASSES), default=6, metavar="N", help=passes)
    channels = "outputs of each layer (default: 16)"
    add("--channels", type=whole_number(MOST_CHANNELS), default=16, metavar="N", help=channels)
    results = "results folder, whose stored renders are used and extended (default: results)"
    add("--results", type=Path, default=Path("results"), metavar="DIR", help=results)
    add_engine_options(parser)


@program(
    _options,
    "Train the network of the detector `learned` on the damaged boards of an experiment: all its "
    "cameras, numbers of frames and kinds of damage. The same file, seed and machine give the "
    "same weights.",
    "tofpod train training --out network.npz",
    "tofpod train training --set study.boards=20 --passes 3 --out network.npz",
    epilog="Name the file in an experiment: detector: {name: learned, settings: {network: "
    "network.npz}}. Train on other boards and units than those that are judged.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from threadpoolctl import threadpool_limits

    from detectors.methods.network import write_network
    from harness.experiment.load import load_experiment
    from harness.runs.engines import engine_of
    from harness.runs.plan import plan_of
    from harness.vocabulary.provenance import record
    from scenes.render.cache import in_use

    if options.out.suffix != ".npz":
        raise UserError(f"--out {options.out}: is not a name of a network", legal="name.npz")
    run_options = engine_options(options)
    if not run_options.shard.is_whole:
        raise UserError("--shard: a network is trained on all boards", fix="leave it out")
    experiment = load_experiment(options.experiment, options.overrides).at_stated_values()
    if experiment.config.study is None:
        fix = "take one with `study`, such as training"
        raise UserError(f"{experiment.config.name}: has no random boards", fix=fix)
    cache = options.results / ".cache" / "renders"
    plan = plan_of(experiment, cache)
    names = sorted({point.config.detector.name for point in experiment.points})
    with in_use(cache), engine_of(run_options, names) as engine:
        pictures = _pictures(plan, engine)
    # with more threads the order of sums would change from run to run
    with threadpool_limits(1):
        network, losses = _trained(
            pictures,
            seed=experiment.config.seed,
            channels=options.channels,
            passes=options.passes,
        )
    facts = {
        **_about(experiment, plan, pictures),
        "channels": options.channels,
        "passes": options.passes,
        "losses": losses,
        "provenance": record(command),
    }
    write_network(options.out, _with_facts(network, facts))
    print(f"wrote {options.out}: {network.weight_count} weights, reach {network.reach_px} pixels")
    return 0


def _with_facts(network: Network, facts: dict[str, Any]) -> Network:
    from dataclasses import replace

    return replace(network, facts=facts)


def _pictures(plan: SweepPlan, engine: JobEngine) -> list[LabelledPicture]:
    """Return the pictures of all boards of a plan, in its order. Raises UserError if a board
    failed."""
    from harness.programs.train.pictures import boards_of, pictures_of_board
    from harness.runs.job_batches import carried_out, render_missing
    from harness.runs.jobs import Job

    renders = {}
    for group in plan.groups:
        for batch in group.then:
            if batch.role == "damaged":
                renders.update({job.path: job for job in batch.renders})
    _say(f"{len(renders)} views")
    for failure in render_missing(renders.values(), engine):
        raise UserError(f"{failure.what}: {failure.in_short}")
    boards = boards_of(plan)
    jobs = []
    for number, board in enumerate(boards):
        jobs.append(Job(f"board {number}", "trials", pictures_of_board, (board,)))
    pictures_by_job = {}
    for job, ended in carried_out(jobs, engine):
        if ended.is_bug:
            raise RuntimeError(ended.why)
        if ended.state != "done":
            raise UserError(f"{job.name}: {ended.why.strip() or ended.state}")
        pictures_by_job[job.name] = ended.value
    pictures = [picture for job in jobs for picture in pictures_by_job[job.name]]
    _say(f"{len(pictures)} pictures of {len(boards)} draws")
    return pictures


def _trained(
    pictures: Sequence[LabelledPicture],
    *,
    seed: int,
    channels: int,
    passes: int,
) -> tuple[Network, list[list[float]]]:
    """Return the network, and the mean loss of each pass on the pictures trained on and on those
    held out."""
    from harness.programs.train.gradients import AdamDescent, gradient_of, loss_of, new_network
    from harness.programs.train.pictures import example_of, prior_of
    from harness.vocabulary.seeds import random_stream

    shown = [picture for picture in pictures if picture.board % HELD_OUT != HELD_OUT - 1]
    held_out = [picture for picture in pictures if picture.board % HELD_OUT == HELD_OUT - 1]
    network = new_network(channels, prior_of(shown), random_stream(seed, "weights"))
    descent = AdamDescent(network, passes * len(shown))
    losses = []
    for number in range(passes):
        stream = random_stream(seed, "pass", number)
        total = 0.0
        for index in stream.permutation(len(shown)).tolist():
            sign = float(stream.choice([1.0, -1.0]))
            loss, gradients = gradient_of(network, example_of(shown[index], sign))
            descent.step(gradients)
            total += loss
        held_out_loss = 0.0
        for picture in held_out:
            for sign in (1.0, -1.0):
                example = example_of(picture, sign)
                held_out_loss += loss_of(network.log_odds(example.pictures), example)
        means = [total / len(shown)]
        text = f"pass {number + 1} of {passes}: loss {means[0]:.5f}"
        if held_out:
            means.append(held_out_loss / (2 * len(held_out)))
            text += f", held out {means[1]:.5f}"
        losses.append(means)
        _say(text)
    return network, losses


def _about(
    experiment: Experiment, plan: SweepPlan, pictures: Sequence[LabelledPicture]
) -> dict[str, Any]:
    """Return what the network was trained on: ``content`` is a digest of everything that
    determines the pictures."""
    from harness.runs.plan import PACKAGES, trial_code
    from harness.vocabulary.provenance import source_digest
    from harness.vocabulary.seeds import digest

    cameras = []
    frames = []
    boards = []
    code = []
    for group in plan.groups:
        for point in group.points:
            camera = point.config.simulated.camera
            cameras.append(camera.name)
            frames.append(point.config.capture.frames)
            code.append(source_digest(trial_code(point.config.detector.name), PACKAGES))
        for batch in group.then:
            if batch.role == "damaged":
                boards.append([path.stem for path in batch.paths])
    seeds = {
        "noise": experiment.config.seed,
        "boards": getattr(experiment.config.simulated.target, "seed", None),
        "unit": experiment.config.simulated.camera.unit_seed,
    }
    return {
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "content": digest([code, boards, experiment.digest]),
        "cameras": sorted(set(cameras)),
        "frames": sorted(set(frames)),
        "seeds": seeds,
        "pictures": len(pictures),
    }


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
