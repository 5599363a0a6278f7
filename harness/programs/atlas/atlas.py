"""``tofpod atlas``: computes the limits from which `tofpod ask` answers, camera by camera."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from harness.runs.options import add_engine_options, add_results_folder, engine_options
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped
from harness.vocabulary.program import program

if TYPE_CHECKING:
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
    "Compute limits of damage for each camera, at three distances of its range, and write the"
    f" atlas from which tofpod ask answers ({MADE} in the folder of results). A shard of"
    " today's code is kept, also one that comes with tofpod.",
    "tofpod atlas kinect_v2 --dry-run",
    "tofpod atlas pmd_flexx2 realsense_l515",
    epilog="Then ask: tofpod ask --distance 1m --atlas results/atlas/atlas.json",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.atlas.making import Planned
    from harness.programs.atlas.shards import twins_of
    from harness.programs.atlas.stored import write_atlas
    from scenes.sensor.camera import camera_names

    run_options = engine_options(options)
    if not run_options.shard.is_whole:
        raise UserError("--shard: the atlas has a shard for each camera", fix="name the cameras")
    twins = twins_of(camera_names())
    chosen = _chosen(options.camera, twins)
    atlas_file = options.out / MADE
    stored = _stored(atlas_file)
    totals = [0, 0, 0]
    for names in chosen:
        planned = Planned(names)
        current = stored.get(Path(planned.camera).stem)
        if current is not None and _is_current(current, planned.digests, names):
            print(f"{planned.camera}: of today's code")
            continue
        also = f" (also {', '.join(names[1:])})" if len(names) > 1 else ""
        if options.dry_run:
            work = planned.work(options.out)
            totals = [total + count for total, count in zip(totals, work, strict=True)]
            print(f"{planned.camera}{also}: {_in_words(work)}", flush=True)
            continue
        print(f"{planned.camera}{also}: {len(planned.parts)} distances", flush=True)
        shard = planned.made(options.out, run_options, command)
        if shard is None:
            return 130
        stored[shard.camera] = shard
        write_atlas(atlas_file, list(stored.values()))
    if options.dry_run:
        print(f"in all: {_in_words(totals)}{_bill(options.out, totals)}")
    else:
        write_atlas(atlas_file, list(stored.values()))
        print(f"atlas: {atlas_file}")
    return 0


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


def _in_words(work: list[int] | tuple[int, int, int]) -> str:
    """Return ``84 set-ups, 444 renders, 480 trials``."""
    set_ups, renders, trials = work
    return f"{set_ups} set-ups, {renders} renders, {trials} trials"


def _bill(out: Path, work: list[int]) -> str:
    """Return the processor seconds that the work is expected to cost, by earlier runs."""
    from harness.programs.atlas.parts import EXPERIMENT
    from harness.runs.bill import expected

    text = expected(out, EXPERIMENT, work[1], work[2])
    return f"; {text}" if text else ""


if __name__ == "__main__":
    raise SystemExit(main())
