"""Boards of a data set: plans them, writes the files of each, and reads the files.

Every board is one average of frames of one unit of a camera. No two splits share boards;
``validation`` and ``test`` have those of a study of the same experiment. Several views and real
captures are not included."""

import io
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detectors.pixels.masks import shrunk
from detectors.recordings.arrays import load_npz
from harness.experiment.schema import Experiment, Point
from harness.programs.dataset.exchange import depth_units, on_window, picture_bytes, run_lengths
from harness.records.rows import Role
from harness.runs.plan import RenderJob, batch_of, trial_point, unit_of
from harness.trials.board import load_board
from harness.trials.trial import Trial, cloud_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import (
    RECORD_BYTES,
    TEXT_BYTES,
    bounded_bytes,
    strict_json,
    write_bytes,
    write_text,
)
from harness.vocabulary.geometry import MM, Reason, Region
from harness.vocabulary.path_names import differing, names_of, value_text
from harness.vocabulary.provenance import check_version
from harness.vocabulary.seeds import canonical_json
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.truth import truth_of

DATASET_VERSION = 1  # written into ``dataset.json``; increased when the meaning of a file changes
INDEX = "dataset.json"
TRUTH = "truth.json"
CLOUD = "cloud.npz"
SPLITS: tuple[tuple[str, Role, float], ...] = (
    ("train", "learning", 0.3),
    ("validation", "calibration", 0.2),
    ("test", "hole_free", 0.1),
    ("test", "damaged", 0.4),
)
"""Split, purpose of its boards, and their share of all boards of a category."""
FEWEST = 10  # fewest boards of a category, so that every split has one
# rim of the board that is not inspected: the reach of the cameras' windows and edges, plus a pixel
INSET_PX = 4
BRIGHTEST = 0.995  # quantile of a picture's intensity that is shown as white
AGAIN = "run the command that wrote the data set again"


@dataclass(frozen=True)
class Sample:
    """One board: the render that it needs, and the trial whose average it is. ``label``: good, a
    kind, or combined."""

    category: str
    split: str
    label: str
    number: int
    render: RenderJob
    task: Trial

    @property
    def name(self) -> str:
        """The board's place in the data set: ``category/split/label/number``."""
        return f"{self.category}/{self.split}/{self.label}/{self.number:04d}"


def categories_of(experiment: Experiment) -> dict[str, Point]:
    """Return the points whose clouds differ, by names formed from the axes of source and
    capture."""
    points: dict[str, Point] = {}
    for point in experiment.points:
        if not point.is_variation:
            points.setdefault(
                canonical_json([point.frames_key, point.config.capture.to_data()]), point
            )
    axes = [path for path in experiment.config.sweep if path.startswith(("source.", "capture."))]
    values = {path: [point.values[path] for point in points.values()] for path in axes}
    axes = [path for path in axes if any(value != values[path][0] for value in values[path])]
    names = names_of(axes)
    points_by_name = dict[str, Point]()
    for point in points.values():
        words = []
        for path, axis_value in ((path, point.values[path]) for path in axes):
            text = value_text(
                path,
                differing(axis_value, (value for value in values[path] if value != axis_value)),
            )
            words.append(f"{names[path]} {text}" if text[:1].isdigit() else text)
        name = re.sub(r"[^A-Za-z0-9.]+", "_", " ".join(words)).strip("_.") or experiment.config.name
        points_by_name[name if name not in points_by_name else f"{name}_{len(points_by_name)}"] = (
            point
        )
    return points_by_name


def samples_of(experiment: Experiment, boards: int, cache: Path) -> list[Sample]:
    """Plan the boards of every category. Raises UserError if the experiment has no random
    boards."""
    samples = []
    for category, point in categories_of(experiment).items():
        source = point.config.simulated
        seed = point.config.seed
        study = point.config.study
        if source.views or not isinstance(source.target, DrawnTargetConfig):
            fix = "take one with `target: {name: drawn, ...}`, such as detection_limit"
            raise UserError(
                f"{experiment.config.name}: has no random boards that are seen in one view", fix=fix
            )
        for split, role, share in SPLITS:
            for number in range(round(share * boards)):
                units: tuple[CameraConfig, ...] = ()
                if study and study.units:
                    unit = number % study.units if role == "damaged" else number
                    units = (unit_of(source.camera, seed, role, unit),)
                batch = batch_of(
                    source.target.drawn(role, number), role, source, cache, number, units
                )
                (ref,), (job,) = batch.before(0), batch.renders
                kinds = {
                    damage.kind for damage in truth_of(ref.target, ref.target.pose.T_camera_board)
                }
                label = (
                    "good" if role != "damaged" else kinds.pop() if len(kinds) == 1 else "combined"
                )
                task = Trial(
                    views=(ref,),
                    seed=seed,
                    role=role,
                    repeat=0,
                    points=(trial_point(point, None, None),),
                    board=number,
                )
                samples.append(Sample(category, split, label, number, job, task))
    return samples


def seen_region(render: RenderJob) -> Region:
    """Render a view unless it is cached; return the region of the sensor that its frames cover."""
    camera = camera_of(render.camera)
    view, _ = cached_view(render.target, camera.optics, render.config, render.folder)
    return SimulatedUnit(camera, render.camera, view).region


def write_board(out: Path, sample: Sample, window: Region) -> None:
    """Write all files of a board on the ``window`` that its category shares; the truth last, to
    allow resuming."""
    (point,) = sample.task.points
    set_up = load_board(sample.task.views[0])
    labelled = set_up.labelled(cloud_of(sample.task, point))
    cloud = labelled.cloud
    truth = () if sample.task.hole_free else labelled.truth

    def put(values: np.ndarray, outside: float) -> np.ndarray:
        return on_window(values, cloud.region, window, outside)

    damage = np.zeros(cloud.region.shape, np.uint16)
    for flaw in truth:
        damage.ravel()[labelled.outlines[flaw.id]] = flaw.id
    intensity = (
        np.zeros(damage.shape) if cloud.amplitude is None else np.nan_to_num(cloud.amplitude)
    )
    arrays = {
        "points_m": put(cloud.points_m.astype(np.float32), np.nan),
        "intensity": put(intensity.astype(np.float32), 0.0),
        "reason": put(cloud.reason, Reason.OUTSIDE_MASK),
        "count": put(cloud.count.astype(np.uint16), 0),
        "damage": put(damage, 0),
        "inspected": put(shrunk(np.isfinite(labelled.places_m[..., 0]), 2 * INSET_PX + 1), False),
        "board_xy_m": put(labelled.places_m.astype(np.float32), np.nan),
    }
    mask = arrays["damage"]
    points = arrays["points_m"]
    valid = np.isfinite(points[..., 2])
    white = float(np.quantile(arrays["intensity"], BRIGHTEST)) or 1.0
    shown = np.clip(arrays["intensity"] / white, 0, 1)
    grey = np.repeat(np.rint(255 * shown).astype(np.uint8)[..., None], 3, axis=2)
    file = f"{sample.number:04d}"
    folder = out / "boards" / Path(sample.name).parent
    mvtec = out / "." / Path(sample.name).parent
    stored = io.BytesIO()
    np.savez_compressed(stored, **arrays)  # type: ignore[arg-type]
    files = {
        folder / file / CLOUD: stored.getvalue(),
        folder / file / "depth.png": picture_bytes(".png", depth_units(points[..., 2])),
        folder / file / "intensity.png": picture_bytes(
            ".png", np.rint(65535 * shown).astype(np.uint16)
        ),
        folder / file / "valid.png": picture_bytes(".png", np.uint8(255) * valid),
        folder / file / "mask.png": picture_bytes(".png", mask),
        mvtec / "rgb" / f"{file}.png": picture_bytes(".png", grey),
        mvtec / "xyz" / f"{file}.tiff": picture_bytes(
            ".tiff", np.where(valid[..., None], points, 0)[..., ::-1]
        ),
    }
    if sample.split == "test":
        files[mvtec / "gt" / f"{file}.png"] = picture_bytes(".png", np.uint8(255) * (mask > 0))
    for path, content in files.items():
        write_bytes(path, content, durable=False)
    camera = sample.task.views[0].camera
    damages = []
    for flaw in truth:
        damage_mask = np.zeros(damage.shape, bool)
        damage_mask.ravel()[labelled.outlines[flaw.id]] = True
        rows, columns = np.nonzero(damage_mask := put(damage_mask, False))
        box = [int(n) for n in (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)]
        facts = {
            "pixels": len(rows),
            "bbox": box,
            "run_lengths": run_lengths(damage_mask),
            "line_m": flaw.line_m.tolist(),
        }
        damages.append(
            {**flaw.to_row(), "seen_depth_mm": labelled.seen_depth_m[flaw.id] / MM, **facts}
        )
    facts_of_board = {
        "file_name": f"{sample.category}/{sample.split}/{sample.label}/rgb/{file}.png",
        "height": window.shape[0],
        "width": window.shape[1],
        "board": sample.number,
        "camera": camera.name,
        "unit_seed": camera.unit_seed,
        "frames_used": cloud.n_frames,
        "lens": cloud.lens and asdict(cloud.lens),
        "window_px": asdict(window),
        "T_camera_board": set_up.T_camera_board.tolist(),
        "intensity_at_65535": white,
        "damages": damages,
    }
    write_text(
        folder / file / TRUTH, json.dumps(facts_of_board, allow_nan=False) + "\n", durable=False
    )


def read_index(folder: Path) -> dict[str, Any]:
    """Read a data set's ``dataset.json``; ``samples`` is None while the data set is unfinished.
    Raises UserError."""
    data = _read_json(folder / INDEX, RECORD_BYTES, "name a folder that tofpod dataset wrote")
    check_version(data.get("dataset_version"), DATASET_VERSION, folder / INDEX, "a data set")
    return data


def read_truth(folder: Path, name: str) -> dict[str, Any]:
    """Read the truth of a board by its name. Raises UserError."""
    return _read_json(folder / "boards" / name / TRUTH, TEXT_BYTES, AGAIN)


def _read_json(file: Path, most_bytes: int, fix: str) -> dict[str, Any]:
    try:
        return dict(strict_json(bounded_bytes(file, most_bytes)))
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{file}: cannot be read ({error})", fix=fix) from error


def read_arrays(folder: Path, name: str, *wanted: str) -> list[np.ndarray]:
    """Read arrays of a board's ``cloud.npz``. Raises UserError."""
    file = folder / "boards" / name / CLOUD
    stored = load_npz(file)
    if missing := set(wanted) - stored.keys():
        raise UserError(f"{file}: lacks {', '.join(sorted(missing))}", fix=AGAIN)
    return [stored[array_name] for array_name in wanted]
