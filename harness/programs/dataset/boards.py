"""Boards of a data set: plans them, writes the files of each, and reads the files.

Every board is one average of frames of one unit of a camera. No two splits share boards;
``validation`` and ``test`` have those of a study of the same experiment. Several views and real
captures are not included."""

import io
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detectors.pixels.masks import shrunk
from detectors.recordings.arrays import load_npz
from harness.experiment.schema import Experiment, Point
from harness.programs.dataset.exchange import depth_units, on_window, picture_bytes, run_lengths
from harness.programs.dataset.stored import (
    IndexFacts,
    TruthFacts,
    refuse_odd_arrays,
    refuse_odd_facts,
)
from harness.records.rows import Role
from harness.runs.plan import RenderJob, batch_of, trial_point, unit_of
from harness.trials.board import LabelledCloud, load_board
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
from scenes.target.truth import Damage, truth_of

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
    """One board of the data set."""

    category: str
    split: str
    """train, validation or test."""
    label: str
    """good, the only kind of its damages, or combined."""
    number: int
    render: RenderJob
    """The view that the board needs."""
    task: Trial
    """The trial whose average is the board's cloud."""

    @property
    def name(self) -> str:
        """The board's place in the data set: ``category/split/label/number``."""
        return f"{self.category}/{self.split}/{self.label}/{self.file}"

    @property
    def file(self) -> str:
        """The name of the board's folder and pictures."""
        return f"{self.number:04d}"

    def folder(self, out: Path) -> Path:
        """The board's own folder in the data set ``out``."""
        return out / "boards" / self.name


def categories_of(experiment: Experiment) -> dict[str, Point]:
    """Return the points whose clouds differ, by names formed from the axes of source and
    capture."""
    points: dict[str, Point] = {}
    for point in experiment.points:
        if not point.is_variation:
            key = canonical_json([point.frames_key, point.config.capture.to_data()])
            points.setdefault(key, point)
    axes = [path for path in experiment.config.sweep if path.startswith(("source.", "capture."))]
    values = {path: [point.values[path] for point in points.values()] for path in axes}
    axes = [path for path in axes if any(value != values[path][0] for value in values[path])]
    names = names_of(axes)
    points_by_name = dict[str, Point]()
    for point in points.values():
        words = []
        for path in axes:
            axis_value = point.values[path]
            differing_values = (value for value in values[path] if value != axis_value)
            text = value_text(path, differing(axis_value, differing_values))
            words.append(f"{names[path]} {text}" if text[:1].isdigit() else text)
        name = re.sub(r"[^A-Za-z0-9.]+", "_", " ".join(words)).strip("_.") or experiment.config.name
        if name in points_by_name:
            name = f"{name}_{len(points_by_name)}"
        points_by_name[name] = point
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
                target = source.target.drawn(role, number)
                batch = batch_of(target, role, source, cache, number, units)
                (ref,) = batch.before(0)
                (job,) = batch.renders
                truth = truth_of(ref.target, ref.target.pose.T_camera_board)
                kinds = {damage.kind for damage in truth}
                label = "good"
                if role == "damaged":
                    label = kinds.pop() if len(kinds) == 1 else "combined"
                task = Trial(
                    views=(ref,),
                    seed=seed,
                    role=role,
                    repeat=0,
                    points=(trial_point(point, None, None),),
                    board=number,
                )
                sample = Sample(
                    category=category,
                    split=split,
                    label=label,
                    number=number,
                    render=job,
                    task=task,
                )
                samples.append(sample)
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
    arrays = _arrays(labelled, truth, window)
    white = float(np.quantile(arrays["intensity"], BRIGHTEST)) or 1.0
    for path, content in _files(out, sample, arrays, white).items():
        write_bytes(path, content, durable=False)
    camera = sample.task.views[0].camera
    picture = f"{sample.category}/{sample.split}/{sample.label}/rgb/{sample.file}.png"
    facts_of_board = {
        "file_name": picture,
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
        "damages": [_facts_of(flaw, labelled, window) for flaw in truth],
    }
    truth_text = json.dumps(facts_of_board, allow_nan=False) + "\n"
    write_text(sample.folder(out) / TRUTH, truth_text, durable=False)


def _arrays(
    labelled: LabelledCloud, truth: Sequence[Damage], window: Region
) -> dict[str, np.ndarray]:
    """Return the arrays of `CLOUD` by name, on the window."""
    cloud = labelled.cloud
    damage = np.zeros(cloud.region.shape, np.uint16)
    for flaw in truth:
        damage.ravel()[labelled.outlines[flaw.id]] = flaw.id
    intensity = np.zeros(cloud.region.shape)
    if cloud.amplitude is not None:
        intensity = np.nan_to_num(cloud.amplitude)
    inspected = shrunk(np.isfinite(labelled.places_m[..., 0]), 2 * INSET_PX + 1)

    def put(values: np.ndarray, outside: float) -> np.ndarray:
        return on_window(values, cloud.region, window, outside)

    return {
        "points_m": put(cloud.points_m.astype(np.float32), np.nan),
        "intensity": put(intensity.astype(np.float32), 0.0),
        "reason": put(cloud.reason, Reason.OUTSIDE_MASK),
        "count": put(cloud.count.astype(np.uint16), 0),
        "damage": put(damage, 0),
        "inspected": put(inspected, False),
        "board_xy_m": put(labelled.places_m.astype(np.float32), np.nan),
    }


def _files(
    out: Path, sample: Sample, arrays: dict[str, np.ndarray], white: float
) -> dict[Path, bytes]:
    """Return the contents of a board's files but its truth. ``white``: the intensity that pictures
    show as white."""
    mask = arrays["damage"]
    points_m = arrays["points_m"]
    valid = np.isfinite(points_m[..., 2])
    shown = np.clip(arrays["intensity"] / white, 0, 1)
    grey = np.repeat(np.rint(255 * shown).astype(np.uint8)[..., None], 3, axis=2)
    grey_16_bits = np.rint(65535 * shown).astype(np.uint16)
    z_y_x = np.where(valid[..., None], points_m, 0)[..., ::-1]
    stored = io.BytesIO()
    np.savez_compressed(stored, **arrays)  # type: ignore[arg-type]
    folder = sample.folder(out)
    mvtec = out / Path(sample.name).parent
    files = {
        folder / CLOUD: stored.getvalue(),
        folder / "depth.png": picture_bytes(".png", depth_units(points_m[..., 2])),
        folder / "intensity.png": picture_bytes(".png", grey_16_bits),
        folder / "valid.png": picture_bytes(".png", np.uint8(255) * valid),
        folder / "mask.png": picture_bytes(".png", mask),
        mvtec / "rgb" / f"{sample.file}.png": picture_bytes(".png", grey),
        # OpenCV stores the channels of a picture in reverse
        mvtec / "xyz" / f"{sample.file}.tiff": picture_bytes(".tiff", z_y_x),
    }
    if sample.split == "test":
        is_damaged = picture_bytes(".png", np.uint8(255) * (mask > 0))
        files[mvtec / "gt" / f"{sample.file}.png"] = is_damaged
    return files


def _facts_of(flaw: Damage, labelled: LabelledCloud, window: Region) -> dict[str, Any]:
    """Return what the truth of a board says about one damage."""
    region = labelled.cloud.region
    is_damaged = np.zeros(region.shape, bool)
    is_damaged.ravel()[labelled.outlines[flaw.id]] = True
    mask = on_window(is_damaged, region, window, False)
    rows, columns = np.nonzero(mask)
    box_px = (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
    return {
        **flaw.to_row(),
        "seen_depth_mm": labelled.seen_depth_m[flaw.id] / MM,
        "pixels": len(rows),
        "bbox": [int(length_px) for length_px in box_px],
        "run_lengths": run_lengths(mask),
        "line_m": flaw.line_m.tolist(),
    }


def read_index(folder: Path) -> dict[str, Any]:
    """Read a data set's ``dataset.json``; ``samples`` is None while the data set is unfinished.
    Raises UserError."""
    data = _read_json(folder / INDEX, RECORD_BYTES, "name a folder that tofpod dataset wrote")
    check_version(data.get("dataset_version"), DATASET_VERSION, folder / INDEX, "a data set")
    refuse_odd_facts(folder / INDEX, data, IndexFacts)
    return data


def read_truth(folder: Path, name: str) -> dict[str, Any]:
    """Read the truth of a board by its name. Raises UserError."""
    file = folder / "boards" / name / TRUTH
    truth = _read_json(file, TEXT_BYTES, AGAIN)
    refuse_odd_facts(file, truth, TruthFacts)
    return truth


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
    refuse_odd_arrays(file, {array_name: stored[array_name] for array_name in wanted})
    return [stored[array_name] for array_name in wanted]
