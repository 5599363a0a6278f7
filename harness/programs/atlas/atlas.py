"""``tofpod atlas``: computes the laws from which `tofpod ask` answers, camera by camera."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from harness.runs.options import add_engine_options, add_results_folder, engine_options
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped
from harness.vocabulary.program import program
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from harness.programs.atlas.making import Planned, Work
    from harness.programs.atlas.stored import CameraLimits

MADE = Path("atlas") / "atlas.json"
"""The atlas that is written, in the folder of results."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "camera",
        nargs="*",
        help="cameras by name, or files of your own (default: all that come with tofpod)",
    )
    add_results_folder(parser)
    add("--dry-run", action="store_true", help="list the shards with their bill; run nothing")
    add_engine_options(parser)


@program(
    _options,
    "Compute how well damage shows for each camera, at six distances of its range, and write the"
    f" atlas from which tofpod ask answers ({MADE} in the folder of results). A shard of"
    " today's code is kept, also one that comes with tofpod; a shard that was interrupted resumes.",
    "tofpod atlas kinect_v2 --dry-run",
    "tofpod atlas pmd_flexx2 realsense_l515",
    epilog="Then ask: tofpod ask --distance 1m --atlas results/atlas/atlas.json",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.atlas.making import DETECTOR, Planned, renders_of
    from harness.programs.atlas.shards import twins_of
    from harness.programs.atlas.stored import write_atlas
    from harness.runs.engines import engine_of
    from scenes.render.cache import trim_cache
    from scenes.sensor.camera import camera_names

    run_options = engine_options(options)
    if not run_options.shard.is_whole:
        raise UserError("--shard: the atlas has a shard for each camera", fix="name the cameras")
    twins = twins_of(camera_names())
    atlas_file = options.out / MADE
    stored = _stored(atlas_file)
    to_make = []
    for names in _chosen(options.camera, twins):
        planned = Planned(names)
        current = stored.get(Path(planned.camera).stem)
        if current is not None and _is_current(current, planned.digests, names):
            print(f"{planned.camera}: of today's code")
        else:
            to_make.append(planned)
    if options.dry_run:
        _list(to_make, options.out, 1 if run_options.serial else run_options.jobs)
        return 0
    try:
        with engine_of(run_options, {DETECTOR}, renders_of(options.out)) as engine:
            for planned in to_make:
                print(
                    f"{_named(planned.names)}: {many(len(planned.parts), 'distance')}", flush=True
                )
                shard = planned.made(
                    options.out, engine, command, retry_failed=run_options.retry_failed
                )
                for line in _summary(shard):
                    print(f"  {line}", flush=True)
                stored[shard.camera] = shard
                write_atlas(atlas_file, list(stored.values()))
    except KeyboardInterrupt:
        print(f"\ninterrupted; finished trials are kept. To continue:\n  {command}")
        return 130
    write_atlas(atlas_file, list(stored.values()))
    if run_options.cache_limit_gb is not None:
        trim_cache(renders_of(options.out), round(run_options.cache_limit_gb * 1e9))
    print(f"atlas: {atlas_file}")
    return 0


def _list(to_make: list[Planned], out: Path, processes: int) -> None:
    """Print the work on each camera, and what all is expected to cost."""
    from harness.programs.atlas.making import EXPERIMENT, Work
    from harness.runs import expected

    total = Work(parts=0, renders=0, trials=0)
    for planned in to_make:
        work = planned.work(out)
        total = Work(
            parts=total.parts + work.parts,
            renders=total.renders + work.renders,
            trials=total.trials + work.trials,
        )
        print(f"{_named(planned.names)}: {_in_words(work)}", flush=True)
    all_work = expected.RunWork(total.renders, total.trials)
    cost = expected.expected(out, EXPERIMENT, "study", all_work, processes)
    print(f"in all: {_in_words(total)}; {cost}")


def _summary(shard: CameraLimits) -> list[str]:
    """Return what could not be computed of a camera, and how well its laws hold."""
    lines = list(shard.problems)
    for kind, limits in shard.kinds.items():
        hits = sum(set_up.hits for set_up in limits.set_ups)
        sites = sum(set_up.sites for set_up in limits.set_ups)
        error = limits.law.error
        holds = "too few tell how well its law holds"
        if error == error:
            holds = f"signals at distances left out depart by {100 * error:.0f} %"
        lines.append(f"{kind}: {hits} of {sites} found; {holds}")
    return lines


def _named(names: tuple[str, ...]) -> str:
    """Return a camera's name, and those of its twins."""
    also = f" (also {', '.join(names[1:])})" if len(names) > 1 else ""
    return f"{names[0]}{also}"


def _chosen(asked: list[str], twins: dict[str, list[str]]) -> list[list[str]]:
    """Return the cameras to compute, each with its twins."""
    if not asked:
        return list(twins.values())
    chosen: dict[str, list[str]] = {}
    for name in asked:
        group = next((names for names in twins.values() if name in names), [name])
        chosen[group[0]] = group
    return list(chosen.values())


def _stored(atlas_file: Path) -> dict[str, CameraLimits]:
    """Return the shards that come with tofpod and, in their place, those made here."""
    from harness.programs.atlas.stored import STORED, read_atlas

    shards: dict[str, CameraLimits] = {}
    for path in (shipped("baselines") / STORED, atlas_file):
        if path.is_file():
            shards.update({shard.camera: shard for shard in read_atlas(path)})
    return shards


def _is_current(shard: CameraLimits, digests: dict[str, str], names: list[str]) -> bool:
    """Return whether a shard is of today's code, for the same cameras."""
    stems = [Path(name).stem for name in names]
    return shard.about.get("digests") == digests and list(shard.titles) == stems


def _in_words(work: Work) -> str:
    """Return ``6 distances, 168 renders, 192 trials``."""
    return f"{many(work.parts, 'distance')}, {work.renders} renders, {work.trials} trials"


if __name__ == "__main__":
    raise SystemExit(main())
