"""tofpod from Python, as ``import tofpod`` (or ``harness.api``): a facade over the programs.

Build a target, render what a camera sees of it, draw noisy frames, average them, and search for
damage:

    >>> import tofpod
    >>> board = tofpod.target(
    ...     {
    ...         "name": "custom",
    ...         "board": {"width_mm": 160, "height_mm": 100, "thickness_mm": 20},
    ...         "holes": [
    ...             {
    ...                 "id": 1,
    ...                 "diameter_mm": 20,
    ...                 "centre_mm": [30, 0],
    ...                 "kind": "blind",
    ...                 "depth_mm": 12,
    ...             }
    ...         ],
    ...     }
    ... )
    >>> unit = tofpod.render(board, "azure_kinect_nfov", bounces=0)
    >>> cloud = tofpod.average(tofpod.frames(unit, 50))
    >>> found = tofpod.detect(cloud, "thesis", threshold=8.0, crop={"kind": "auto", "inset_px": 4})
    >>> len(found.findings), found.findings[0].kind
    (1, 'hole')
    >>> figure = tofpod.plot(found)  # a Matplotlib Figure

The examples below continue this one. For a real capture, start with `load`; `sweep` runs whole
experiments. A program's error message is raised as a `UserError`. Units are SI unless a name
states another unit.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from detectors import load_detector
from detectors.averages.average import AverageConfig
from detectors.averages.average import average as averaged
from detectors.filters import functions_named, load_filter
from detectors.filters.interface import DepthFilter, DepthFunction, FunctionFilter
from detectors.filters.stream import FilteredFrames
from detectors.recordings import open_capture
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import read_record
from harness.experiment.load import load_experiment
from harness.inspection.arguments import CANDIDATES, DEFAULT_DETECTOR, rate_text
from harness.inspection.choosing import candidate_of, chosen
from harness.inspection.judging import judged
from harness.report.findings import Finding, Judged, findings_figure
from harness.report.study_figures import draw_overlay
from harness.runs.options import EngineOptions
from harness.target import declared
from harness.vocabulary.declaration.diagnose import settings_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, FrameSource
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = [
    "Cloud",
    "Finding",
    "UserError",
    "average",
    "detect",
    "filtered",
    "filters",
    "findings_table",
    "frames",
    "limits",
    "load",
    "plot",
    "plot_pod",
    "render",
    "sweep",
    "table",
    "target",
]


def target(
    what: str | Path | Mapping[str, Any], board: int = 0, *, hole_free: bool = False
) -> TargetConfig:
    """Return a target by its name, from a YAML or JSON file, or from a declaration as plain data.
    ``board`` selects a damaged board of a family (``name: drawn``). Raises UserError with every
    mistake in the declaration.

    >>> len(tofpod.target("thesis").damages), len(tofpod.target("thesis", hole_free=True).damages)
    (11, 0)
    >>> damage = {"kind": "through", "per_board": 3, "diameter_mm": [2, 8]}
    >>> family = {"name": "drawn", "damage": damage}
    >>> len(tofpod.target(family, board=7).damages)
    3
    """
    config = declared(what, board)
    return config.hole_free() if hole_free else config


def render(
    target: TargetConfig,
    camera: str,
    *,
    unit_seed: int = 1,
    cache: str | Path = "results/.cache/renders",
    **work: Any,
) -> SimulatedUnit:
    """Render what a unit of a camera sees of a target, without noise. ``unit_seed`` draws the
    unit's fixed pattern; ``cache`` is the folder for stored renders; ``work`` holds settings of
    `scenes.optics.RenderConfig`, such as ``bounces``. Raises UserError if the camera is unknown or
    does not see the target.

    >>> unit = tofpod.render(board, "kinect_v2", bounces=0)
    >>> unit.region.shape[1] > 50
    True
    """
    config = settings_of(CameraConfig, {"name": camera, "unit_seed": unit_seed}, "camera")
    facts = camera_of(config)
    settings = settings_of(RenderConfig, work, "render")
    view, _ = cached_view(
        target.at_wavelength(facts.optics.wavelength_nm), facts.optics, settings, Path(cache)
    )
    return SimulatedUnit(facts, config, view)


def frames(unit: SimulatedUnit, count: int, seed: int = 1) -> FrameSource:
    """Return ``count`` simulated frames, which are drawn while they are read. ``seed`` draws the
    noise.

    >>> [frame.z_m.shape == unit.region.shape for frame in tofpod.frames(unit, 2).frames()]
    [True, True]
    """
    if count < 1:
        raise UserError(f"{count} frames", legal="1 or more")
    return unit.capture(count, seed, "api")


def load(*paths: str | Path, unit: str | None = None) -> FrameSource:
    """Open a real capture (files or a folder) of any format that ``tofpod detect``
    reads. ``unit`` is that of the stored depth, such as ``mm`` or ``4000/m``, if the files do not
    state it. Raises UserError."""
    return open_capture([Path(path) for path in paths], unit=unit)


def filtered(
    frames: FrameSource, depth_filter: str | DepthFunction, **settings: Any
) -> FrameSource:
    """Return frames through a filter: one by name with its settings, or a function from z (h, w)
    in metres, NaN where missing, to z of the same size. Raises UserError.

    >>> smooth = tofpod.average(tofpod.filtered(tofpod.frames(unit, 3), "median", kernel_size=3))
    >>> nearer = tofpod.filtered(tofpod.frames(unit, 3), lambda z_m: z_m - 0.1)
    >>> nearer.region == smooth.region
    True
    """
    chosen: DepthFilter
    if isinstance(depth_filter, str):
        chosen = load_filter(depth_filter, settings)
    else:
        chosen = FunctionFilter("function", depth_filter)
    return FilteredFrames(frames, chosen)


def average(frames: FrameSource, method: str = "mean", **settings: Any) -> Cloud:
    """Average all frames to a cloud, whose ``points_m`` (h, w, 3) are in the camera's frame, NaN
    where invalid. ``settings`` are those of `detectors.averages.average.AverageConfig`. Raises
    UserError.

    >>> tofpod.average(tofpod.frames(unit, 3), "median").n_frames
    3
    """
    return averaged(frames, settings_of(AverageConfig, {"method": method, **settings}, "average"))


def detect(
    cloud: Cloud, detector: str = DEFAULT_DETECTOR, threshold: float | None = None, **settings: Any
) -> Judged:
    """Search for damage. Without a ``threshold`` (in units of the detector's score), the cloud's
    own noise sets it, as in ``tofpod detect``; ``evidence.warnings`` of the result say
    if that is not reliable. ``settings`` are those of the detector. By default, the detector
    is chosen as by ``tofpod detect`` (with a ``threshold`` it is the first of `CANDIDATES`); all
    candidates have the ``settings``, and choose the shape of their surface unless these state it.
    Raises UserError if the cloud cannot be judged.

    >>> tofpod.detect(cloud, "thesis", threshold=-1)
    Traceback (most recent call last):
    ...
    harness.vocabulary.errors.UserError: threshold -1
    """
    if threshold is not None and not 0 < threshold < float("inf"):
        raise UserError(f"threshold {threshold:g}", legal="a number above 0")
    options = argparse.Namespace(threshold=threshold, quiet_capture=None, false_calls=None)
    names: tuple[str, ...] = (detector,)
    if detector == DEFAULT_DETECTOR:
        settings = {"surface": {"shape": "auto"}, **settings}
        names = CANDIDATES if threshold is None else CANDIDATES[:1]
    candidates = []
    for name in names:
        loaded = load_detector(name, settings), settings
        candidates.append(candidate_of(options, loaded, cloud, lambda _: (float("nan"), "")))
    best = candidates[0]
    if len(candidates) > 1:
        best = chosen(candidates, cloud, rate_text(options))
    return judged(best.detector, cloud, best.evidence, best.threshold)


def findings_table(found: Judged) -> pd.DataFrame:
    """Return the findings of `detect` as a DataFrame, strongest first; the columns are the fields
    of `Finding`.

    >>> tofpod.findings_table(found)[["kind", "size_from"]].values.tolist()
    [['hole', 'model']]
    """
    import pandas as pd

    return pd.DataFrame(
        [asdict(finding) for finding in found.findings], columns=[*Finding.__dataclass_fields__]
    )


def plot(found: Judged, title: str = "") -> Figure:
    """Draw the residual in mm with a numbered circle at each finding."""
    return findings_figure(found.cloud, found.evidence, found.detections, title)


def sweep(
    experiment: str | Path, *changes: str, out: str | Path = "results", jobs: int = 1
) -> Path:
    """Run an experiment, or its missing trials, and return its results folder. ``changes`` are
    those of ``--set``, such as ``"repeats=5"``. With ``jobs`` above 1 it starts processes, so that
    a script needs ``if __name__ == "__main__":``. Raises UserError for a wrong experiment, or if
    trials failed.

    >>> tofpod.sweep("averaging", "repeats=0")
    Traceback (most recent call last):
    ...
    harness.vocabulary.declaration.yaml_source.DeclarationError: ...
    """
    from harness.runs.study import run_study  # imports pandas

    loaded = load_experiment(Path(experiment), changes)
    out = Path(out)
    code = run_study(
        loaded,
        out,
        EngineOptions(jobs=jobs, serial=jobs == 1),
        f"tofpod.sweep({str(experiment)!r})",
    )
    if code == 130:
        raise KeyboardInterrupt
    if code:
        raise UserError(
            f"{experiment}: trials failed, as printed above",
            fix="correct the cause and run it again",
        )
    return loaded.folder(out)


def filters(
    *filters: str | DepthFunction,
    experiment: str | Path = "filters",
    changes: Sequence[str] = (),
    out: str | Path = "results",
    jobs: int = 1,
) -> pd.DataFrame:
    """State what filters cost, as ``tofpod filters`` does, and return its table, which
    `results/README.md` describes. ``filters`` are names, YAML with settings, or functions as in
    `filtered`, which run in this process; none: those of the experiment. Raises UserError as
    `sweep`.

    >>> tofpod.filters("medain")
    Traceback (most recent call last):
    ...
    harness.vocabulary.declaration.yaml_source.DeclarationError: ...
    """
    # found by name: the core imports no program
    judging = import_module("harness.programs.filters.judging")
    functions = {}
    names = []
    for entry in filters:
        if isinstance(entry, str):
            names.append(entry)
        else:
            names.append(entry.__name__)
            functions[entry.__name__] = entry
    with functions_named(functions):
        overrides = [*changes, *([judging.filter_axis(names)] if names else [])]
        judging.refuse_other_studies(load_experiment(Path(experiment), overrides))
        folder = sweep(experiment, *overrides, out=out, jobs=1 if functions else jobs)
    judging.judged_filters(folder, f"tofpod.filters(experiment={str(experiment)!r})")
    return table(folder, "filters")


def table(folder: str | Path, name: str) -> pd.DataFrame:
    """Read a table of a results folder (`results/README.md` describes them). Raises UserError if
    it is missing."""
    import pandas as pd

    tables = {path.stem: path for path in sorted(Path(folder).glob("*.parquet"))}
    if name not in tables:
        raise UserError(
            f"{folder}: has no table {name!r}",
            legal=", ".join(tables) or "a folder that a sweep wrote",
        )
    return pd.read_parquet(tables[name])


def limits(folder: str | Path) -> tuple[SetUpLimit, ...]:
    """Return the detection limits of a study, such as ``results/detection_limit/latest``, with
    ``a90_mm``, ``a90_95``, ``statement`` (the curve) and so on. Raises UserError if the folder
    holds no study."""
    return tuple(limit_of(record) for record in read_record(Path(folder)).set_ups)


def plot_pod(limits: Sequence[SetUpLimit]) -> Figure:
    """Draw the POD curves of `limits` with their bands in a single chart."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 5.0), layout="constrained")
    draw_overlay(figure, limits)
    return figure
