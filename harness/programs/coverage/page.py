"""The coverage page: a part, coloured by the smallest damage that is found at each place."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from harness.programs.coverage.statistics import Findable, Patches, Seen
from harness.programs.coverage.tables import GOALS, POSES
from harness.records.examples import Scene3d
from harness.report.blocks import command_of, heading, note, page, tag
from harness.report.view3d import view3d_html
from harness.vocabulary.text import many, percent

COLOURS = (
    "#fde725",
    "#a0da39",
    "#4ac16d",
    "#1fa187",
    "#277f8e",
    "#365c8d",
    "#46327e",
    "#b3261e",
    "#8a8f96",
)
"""Seven steps of viridis (van der Walt and Smith, 2015), light for small damage; red for none;
grey for not judged."""
METHOD = (
    "Each patch has the detector's unit of score, an angle of incidence and a distance. The "
    "score of damage as a "
    "function of its size and of these three, and its scatter, were estimated from boards "
    "of the family in random "
    "poses, at the experiment's own threshold. A patch is not judged if the detector judges "
    "nothing there, if it is "
    "hidden or out of view, or if it is steeper than all inspected damage. Of several "
    "poses, only the best counts."
)


def scene_of(patches: Patches, limits_mm: np.ndarray, findable: Findable) -> Scene3d:
    """Return the part, coloured by its limits (n,) in classes of equal logarithmic width."""
    is_known = np.isfinite(limits_mm)
    low, high = (
        (limits_mm[is_known].min(), limits_mm[is_known].max())
        if is_known.any()
        else findable.sizes_mm
    )
    ends = np.geomspace(low, high * 1.0001, len(COLOURS) - 1)
    step = np.where(
        is_known,
        np.searchsorted(ends, limits_mm, side="right") - 1,
        len(COLOURS) - 2 + np.isnan(limits_mm),
    )
    words = [f"{low:.2g} to {high:.2g} mm" for low, high in pairwise(ends)]
    key = list(
        zip(
            [*words, f"none up to {findable.sizes_mm[1]:.3g} mm", "not judged"],
            COLOURS,
            strict=True,
        )
    )
    palette = np.array(
        [[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in COLOURS], np.uint8
    )
    shown = f"{findable.size_of} found 9 times in 10"
    used = np.unique(step).tolist()
    return Scene3d(
        1e3 * patches.points_m,
        "board",
        rgb=palette[step],
        shown=shown,
        key=tuple(key[n] for n in used),
    )


def answer(
    findable: Findable, patches: Patches, limits_mm: np.ndarray, size_mm: float, poses: int
) -> str:
    """State the shares of the face on which damage of a size is found, on which no size is, and
    that is not judged."""
    share = f"{percent(patches.share(limits_mm <= size_mm))} %"
    blind = f"{percent(patches.share(np.isinf(limits_mm)))} %"
    unknown = f"{percent(patches.share(np.isnan(limits_mm)))} %"
    return (
        f"Damage with a {findable.size_of} of {size_mm:.3g} mm is found nine times in ten "
        f"on {share} of the face in "
        f"{many(poses, 'pose')}. On {blind} nothing up to {findable.sizes_mm[1]:.3g} mm is "
        f"found so often; {unknown} is "
        "not judged."
    )


def warnings_of(findable: Findable, seen_by_view: Mapping[Any, Seen]) -> list[str]:
    """Return warnings that the figures are unreliable."""
    warnings = [findable.doubt] if findable.doubt else []
    unseen = sum(bool(np.isinf(view.deviation_m).all()) for view in seen_by_view.values())
    if unseen:
        warnings.append(
            f"the detector judges nothing in {unseen} of the {len(seen_by_view)} simulated poses"
        )
    return warnings


def coverage_html(
    name: str,
    sentence: str,
    first: str,
    scene: Scene3d,
    poses: Sequence[Mapping[str, Any]],
    goals: Sequence[Mapping[str, Any]],
    warnings: Sequence[str],
    command: str,
) -> str:
    """Return the page as text; it needs no network. ``sentence`` is the answer, ``first`` the note
    below it."""
    turns = tag(
        "iframe",
        srcdoc=view3d_html(scene, name),
        kind="turns",
        title="the part; drag it to turn it",
    )
    ways = [heading("Ways to the goal"), GOALS.grid(goals).html()] if goals else []
    body = [
        turns,
        *ways,
        heading("Poses"),
        POSES.grid(poses).html(),
        note(METHOD),
        *command_of(command),
    ]
    return page(f"Coverage: {name}", sentence, body, [note(first)], warnings)
