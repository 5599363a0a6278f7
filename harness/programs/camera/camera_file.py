"""The camera file that reproduces the captures: the refitted model of a known camera, or an
empirical camera.

A refitted model has the unit's own lens, gain, fixed pattern, displaced frames and, if the
captures show it, gate for faint pixels; all other numbers are those of the known camera. The
surfaces' albedo is stated and not measured."""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

from harness.programs.camera import measure
from harness.programs.camera.measure import Characteristics, StillCapture
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import MM, Lens
from scenes.closed_form import image_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.calibration import with_number
from scenes.sensor.camera import (
    AnyCamera,
    camera_names,
    camera_of,
    guessed_precision,
    is_camera_path,
    load_camera,
    numbers_of_lens,
    read_camera,
)
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.common.unit import taps_of
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.source import SimulatedUnit

SEED = 1
UNIT = CameraConfig(
    effects=EffectsConfig().model_copy(update={"unit_offset": False, "warm_up_drift": False})
)
"""Effects of a simulated unit that captures of a real unit also show."""
STEPS = 5  # most steps of the fit of the gain
CLOSE = 0.01  # relative error of the noise at which the fit ends
FARTHEST = 100.0  # largest change of the gain
FEW_FRAMES = 12  # frames that are simulated for each step
# width of a blurred edge from 10 % to 90 % of its step, in standard deviations of the Gaussian
EDGE_SHARE = 2.56
UNKNOWN = "not determined by the captures"


def camera_of_size(lens: Lens) -> str:
    """Return the only simulated camera with the lens's size, if possible not a guessed one; else
    raise UserError."""
    sizes = {name: load_camera(name).nominal_lens for name in camera_names()}
    fitting = [
        name
        for name, size in sizes.items()
        if (size.width, size.height) == (lens.width, lens.height)
    ]
    measured_cameras = [name for name in fitting if not guessed_precision(load_camera(name))]
    if len(measured_cameras or fitting) == 1:
        return (measured_cameras or fitting)[0]
    pixels = f"{lens.width} x {lens.height} pixels"
    problem = f"no simulated camera has {pixels}"
    fix = "record the camera's own depth images, not those of a colour camera or of another mode"
    if fitting:
        problem = f"several cameras have {pixels}: {', '.join(fitting)}"
        fix = "name the capture's camera with --camera"
    legal = ", ".join(f"{name} {size.width} x {size.height}" for name, size in sizes.items())
    raise UserError(problem, legal=legal, fix=fix)


def with_lens(name: str, lens: Lens) -> AnyCamera:
    """Return a known camera with the capture's lens. Raises UserError for an unknown camera or
    another size."""
    nominal = load_camera(name).nominal_lens
    if (nominal.width, nominal.height) != (lens.width, lens.height):
        raise UserError(
            f"the capture has {lens.width} x {lens.height} pixels, but {name} has {nominal.width} "
            f"x {nominal.height}",
            legal="a capture in the simulated mode of the camera, not aligned to another "
            "camera's pixels",
            fix="name the capture's camera, or record the camera's own depth images",
        )
    return camera_of(CameraConfig(name=name, numbers=numbers_of_lens(lens)))


class Stated(NamedTuple):
    """A number of a camera file."""

    section: str
    """Section of the file; empty for the top level."""
    key: str
    value: Any
    source: str
    """Sentence on the origin of the value."""
    tag: str = "O"
    """Kind of origin: O for "measured on the owner's captures", M for "assumed"."""


def write_camera(
    path: Path,
    title: str,
    like: str | None,
    measured: Characteristics,
    albedo: float,
    rate: Stated,
    by_gauge: Sequence[Stated] = (),
) -> AnyCamera:
    """Write the camera file, refitted from a known camera ``like`` or empirical, and return the
    camera. What a gauge shows takes the place of what the captures do. Raises UserError if the
    known camera has another image size, or if the file cannot be written."""
    names = ", ".join(capture.name for capture in measured.captures)
    source = f"measured by tofpod characterise on {names}, {date.today().isoformat()}"
    declared = (
        _refitted(like, measured, albedo, source) if like else _empirical(measured, albedo, source)
    )
    facts = [*_of_unit(measured, source), *declared]
    better = {(fact.section, fact.key): fact for fact in by_gauge}
    facts = [fact for fact in facts if (fact.section, fact.key) not in better]
    facts += better.values()
    if like and is_camera_path(like):
        like = os.path.relpath(like, path.parent)  # a path is relative to the file that names it
    lines = [
        "# Tags: O measured on the owner's captures, M assumed.",
        *(f"# {doubt}" for doubt in measured.doubts),
    ]
    kind = f"like: {json.dumps(like)}" if like else "kind: empirical"
    lines += [f"name: {path.stem}", f"title: {json.dumps(title)}", kind]
    for section in dict.fromkeys(fact.section for fact in (*facts, rate)):
        lines += [f"{section}:"] if section else []
        indent = "  " if section else ""
        for fact in (*facts, rate):
            if fact.section == section:
                value = f"value: {_text(fact.value)}"
                origin = f"tag: {fact.tag}, source: {json.dumps(fact.source)}"
                lines.append(f"{indent}{fact.key}: {{{value}, {origin}}}")
    write_text(path, "\n".join(lines) + "\n")
    return read_camera(path)


def _text(value: Any) -> str:
    if isinstance(value, tuple | np.ndarray):
        return f"[{', '.join(map(_text, value))}]"
    return str(value) if isinstance(value, int) else repr(float(f"{float(value):.5g}"))


def _of_unit(measured: Characteristics, source: str) -> Iterator[Stated]:
    """Yield the numbers that files of both kinds take from the captures."""
    lens = measured.captures[0].lens
    jumps_m = measured.jumps_m
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        yield Stated("lens", f"{key}_px", getattr(lens, key), f"lens of the recording; {source}")
    distortion = lens.distortion if any(lens.distortion) else ()
    yield Stated("lens", "distortion", distortion, f"lens of the recording; {source}")
    yield Stated(
        "unit",
        "jump_rate",
        len(jumps_m) / measured.frames,
        f"{len(jumps_m)} of {measured.frames} frames; {source}",
    )
    yield Stated("unit", "jump_mm", jumps_m.mean() / MM if len(jumps_m) else 0.0, source)
    yield Stated("unit", "jitter_mm", measured.jitter_m / MM, source)
    yield Stated(
        "engine", "output_step_mm", _step_mm(measured), f"step of the stored depth; {source}"
    )


def _step_mm(measured: Characteristics) -> float:
    """Return the rounding step of the stored captures; a micrometre for numbers that are not
    rounded."""
    return measured.captures[0].step_m / MM or 1e-3


def _empirical(measured: Characteristics, albedo: float, source: str) -> Iterator[Stated]:
    law = measured.law
    pattern = measured.pattern
    drops = measured.dropouts
    edge = measured.edge
    yield Stated(
        "", "wavelength_nm", 850.0, f"selects the albedo of simulated surfaces; {UNKNOWN}", tag="M"
    )
    for key, value in (
        ("offset_mm", 0.0),
        ("drift_mm", 0.0),
        ("drift_min", 20.0),
        ("drift_ramp", 0.0),
    ):
        yield Stated(
            "unit", key, value, f"constant error and drift after power-on are {UNKNOWN}", tag="M"
        )
    if measured.has_amplitude:
        yield Stated("light", "amplitude_at_1m", law.light_at_1m, source)
    else:
        yield Stated("light", "amplitude_at_1m", 1.0, "amplitudes are not recorded", tag="M")
    yield Stated("light", "albedo", albedo, "assumed of the recorded surface", tag="M")
    yield Stated("noise", "range_mm", law.range_m / MM, source)
    yield Stated("noise", "sigma_mm", law.sigma_m / MM, source)
    for key, value, error in zip(
        ("range_exponent", "brightness_exponent"), law.exponents, law.errors, strict=True
    ):
        if np.isfinite(error):
            yield Stated("noise", key, value, f"standard error {error:.2g}; {source}")
        else:
            yield Stated("noise", key, value, f"assumed: {UNKNOWN}", tag="M")
    pattern_mm = 0.0
    doubt = "not determined without a flat surface"
    if pattern is not None:
        pattern_mm = pattern.field.rms_m / MM
        doubt = "; ".join((source, *pattern.field.warnings))
    yield Stated("fixed_pattern", "deviation_mm", pattern_mm, doubt)
    along_x, along_y = measured.correlation
    yield Stated("noise", "rows", taps_of(along_y), source)
    yield Stated("noise", "columns", taps_of(along_x), source)
    along_x = along_y = np.ones(1)
    if measured.pattern_correlation is not None:
        along_x, along_y = measured.pattern_correlation
    yield Stated("fixed_pattern", "rows", taps_of(along_y), doubt)
    yield Stated("fixed_pattern", "columns", taps_of(along_x), doubt)
    yield Stated("dropouts", "amplitude", np.nan_to_num(drops.amplitude, nan=1.0), source)
    yield Stated(
        "dropouts",
        "share",
        drops.share,
        f"of {int(drops.pixels.sum())} pixels on surfaces; {source}",
    )
    if edge is None:
        yield Stated("edge", "gap_px", 0.0, f"edges are {UNKNOWN}", tag="M")
        yield Stated("edge", "blur_px", 0.0, f"edges are {UNKNOWN}", tag="M")
    else:
        of_edges = f"{edge.lines} lines of pixels across edges; {source}"
        is_blurred = edge.flying_px > 0.05
        blur_px = (edge.gap_px + edge.flying_px) / EDGE_SHARE if is_blurred else 0.0
        yield Stated("edge", "gap_px", edge.gap_px, of_edges)
        yield Stated("edge", "blur_px", blur_px, of_edges)
    yield Stated(
        "edge",
        "least_step_mm",
        20.0,
        "smaller steps are assumed to lose no return; not measured",
        tag="M",
    )
    yield Stated("engine", "min_range_mm", 0.0, f"limits of range are {UNKNOWN}", tag="M")
    yield Stated("engine", "max_range_mm", 20_000.0, f"limits of range are {UNKNOWN}", tag="M")


# ---------------------------------------------------------------- a known camera's model, refitted


def _refitted(like: str, measured: Characteristics, albedo: float, source: str) -> Iterator[Stated]:
    camera = with_lens(like, measured.captures[0].lens)
    if isinstance(camera, EmpiricalCamera) or not measured.surfaces:
        reason = "is an empirical camera"
        if not measured.surfaces:
            reason = "needs flat surfaces for the fit, but none was found"
        raise UserError(
            f"--like {like}: {reason}", fix="leave out --like to write an empirical camera"
        )
    if isinstance(camera, AmcwCamera):
        for key, value in _field(camera, measured):
            camera = with_number(camera, "emitter", key, value)
            yield Stated("emitter", key, value, f"covers every pixel with a return; {source}")
    camera = with_number(camera, "engine", "output_step_mm", _step_mm(measured))
    camera, gain = _gain(camera, measured, albedo)
    yield Stated(
        "photons",
        "signal_electrons",
        gain,
        f"gives the temporal noise at albedo {albedo:g}; {source}",
    )
    again = simulated(camera, measured, albedo, FEW_FRAMES)
    simulated_pattern = measure.characteristics(again).pattern
    if measured.pattern is not None and simulated_pattern is not None:
        times = measured.pattern.field.rms_m / max(simulated_pattern.field.rms_m, 1e-9)
        origin = f"{times:.3g} times the known camera's; {source}"
        doubt = "; ".join((origin, *measured.pattern.field.warnings))
        for key, fact in camera.fixed_pattern.to_data().items():
            if key.endswith("_mm"):
                yield Stated("fixed_pattern", key, fact["value"] * times, doubt)
    level = measured.dropouts.amplitude
    share = measured.dropouts.share
    if share.max() >= 0.5 > share.min() and isinstance(camera, AmcwCamera):
        falling = np.argsort(-share)
        faint = float(np.exp(np.interp(-0.5, -share[falling], np.log(level[falling]))))
        pairs = zip(measured.captures, again, strict=True)
        ratios = [(a.amplitude / b.amplitude)[a.steady & b.steady] for a, b in pairs]  # type: ignore[operator]
        origin = f"half of the pixels with amplitude {faint:.4g} have no return; {source}"
        yield Stated(
            "engine",
            "min_amplitude_units",
            faint / float(np.nanmedian(np.concatenate(ratios))),
            origin,
        )


def _field(camera: AmcwCamera, measured: Characteristics) -> Iterator[tuple[str, Any]]:
    """Yield the emitter's numbers that exclude pixels with a return, widened: the lit polygon, and
    the angle at which the cone's light ends; the light fades over as many degrees as before."""
    often = [np.isfinite(capture.z_m).mean(axis=0) >= 0.5 for capture in measured.captures]
    used_slopes = np.concatenate(
        [capture.slopes[mask] for capture, mask in zip(measured.captures, often, strict=True)]
    )
    if camera.emitter.mask_slopes is not None:
        around = ConvexHull(np.round([*camera.emitter.mask_slopes.value, *used_slopes], 3))
        yield "mask_slopes", tuple(map(tuple, around.points[around.vertices]))
    full_deg = camera.emitter.full_half_angle_deg.value
    cutoff_deg = camera.emitter.cutoff_half_angle_deg.value
    widest_deg = float(np.degrees(np.arctan(np.linalg.norm(used_slopes, axis=1).max())))
    if widest_deg > cutoff_deg:
        yield "cutoff_half_angle_deg", widest_deg + cutoff_deg - full_deg


def _gain(camera: Any, measured: Characteristics, albedo: float) -> tuple[Any, float]:
    """Return the camera that reproduces the captures' temporal noise, and its gain, by secants on
    the logarithms."""
    wanted = {(face.capture, face.number): face.temporal.value for face in measured.surfaces}
    tried = []
    gain = start = camera.photons.signal_electrons.value
    for _ in range(STEPS):
        camera = with_number(camera, "photons", "signal_electrons", gain)
        simulated_surfaces = [
            face
            for stack in simulated(camera, measured, albedo, FEW_FRAMES)
            for face in measure.surfaces_of(stack)
        ]
        ratios = [
            np.log(face.temporal.value / wanted[face.capture, face.number])
            for face in simulated_surfaces
        ]
        log_gain = np.log(gain)
        # without a surface, the light is too dim, which counts as too noisy
        log_ratio = float(np.mean(ratios)) if ratios else 1.0
        tried.append((log_gain, log_ratio))
        if abs(log_ratio) < CLOSE:
            break
        slope = -0.6
        if len(tried) > 1:
            last_gain, last_ratio = tried[-2]
            slope = (log_ratio - last_ratio) / (log_gain - last_gain or 1.0)
        ahead = log_gain - log_ratio / min(slope, -0.2)
        gain = float(np.exp(np.clip(ahead, np.log(start / FARTHEST), np.log(start * FARTHEST))))
    return camera, float(np.exp(log_gain))


def simulated(
    camera: AnyCamera, measured: Characteristics, albedo: float, frames: int | None = None
) -> list[StillCapture]:
    """Return the captures as a unit of the camera would have recorded them: the same surfaces (by
    smooth fits) with the recorded brightness and the same number of frames, or ``frames``. Not
    simulated: relief finer than the fits, light between surfaces, the emitter's shadow behind an
    edge, and the scene beside the surfaces."""
    return [
        _again(camera, capture, albedo, frames or len(capture.z_m), number)
        for number, capture in enumerate(measured.captures)
    ]


def _again(
    camera: AnyCamera, capture: StillCapture, albedo: float, frames: int, number: int
) -> StillCapture:
    """Return a capture as a unit of the camera would have recorded it; ``number`` selects the
    noise."""
    z_m = capture.mean_m
    lens = camera.nominal_lens
    config = UNIT.model_copy(update={"name": camera.name})
    if capture.planes:
        labels = np.zeros(z_m.shape, int)
        for label, (_, mask) in enumerate(capture.planes, start=1):
            labels[mask] = label
        distance, nearest = ndimage.distance_transform_edt(labels == 0, return_indices=True)
        labels = np.where(distance <= measure.WIDEST_PX / 2, labels[tuple(nearest)], 0)
        halves = labels[None]
        if not isinstance(camera, EmpiricalCamera):  # its edges are steps between pixels
            # half of each pixel along an edge lies on the other surface, which is the mean over
            # all positions of edges
            halves = np.stack([labels, np.where(labels > 0, ndimage.maximum_filter(labels, 3), 0)])
        z_m = np.full(halves.shape, np.nan)
        for label, shape_m in enumerate(capture.shapes_m, start=1):
            z_m = np.where(halves == label, shape_m, z_m)
    layers = z_m.size / capture.cosine.size
    light = albedo * capture.cosine / (z_m * capture.stretch) ** 2 / layers
    light *= camera.optics.cone(capture.slopes)
    unit = SimulatedUnit(camera, config, image_view(camera, lens.whole, z_m, light))
    if capture.amplitude is not None:
        first_frame = next(iter(unit.capture(1, SEED).frames()))
        ratio = capture.amplitude / measure.mean_amplitude([first_frame.amplitude])
        relative = np.nan_to_num(ratio / np.nanmedian(ratio[capture.steady]), nan=1.0)
        ratio = np.clip(relative, 0.02, 50.0)
        unit = SimulatedUnit(camera, config, image_view(camera, lens.whole, z_m, light * ratio))
    taken = list(unit.capture(frames, SEED, "own camera", number).frames())
    amplitude = None
    if capture.amplitude is not None:
        amplitude = measure.mean_amplitude([frame.amplitude for frame in taken])
    z_m = np.stack([frame.z_m for frame in taken])
    return replace(capture, z_m=z_m, amplitude=amplitude, step_m=camera.z_step_m)
