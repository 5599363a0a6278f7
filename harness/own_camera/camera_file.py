"""The camera file that repeats what captures show: a known camera's model refitted, or an empirical camera.

A refitted model takes the unit's lens, gain, fixed pattern, displaced frames and, where the capture tells it, the gate
of faint pixels; all else stays the known camera's. The simulated surfaces have one albedo, which is stated and not
measured, and the gain holds for it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from harness.own_camera.measure import WIDEST_PX, Characteristics, StillCapture, characteristics, surfaces_of
from harness.scorecard.capture import twin_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import MM, Lens
from scenes.closed_form import image_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.calibration import with_number
from scenes.sensor.camera import AnyCamera, CameraConfig, EffectsConfig, is_camera_path, read_camera
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.source import SimulatedUnit
from scenes.sensor.unit import taps_of

SEED = 1
UNIT = EffectsConfig().model_copy(update={"unit_offset": False, "warm_up_drift": False})
"""Effects of a simulated unit that captures of a real one show too."""
STEPS, CLOSE, FARTHEST, FEW_FRAMES = 5, 0.01, 100.0, 12
"""Steps of the gain's fit, the relative error at which it ends, the largest change, and frames of a step."""
EDGE_SHARE = 2.56
"""Width of a blurred edge, in deviations of the Gaussian, between a tenth and nine tenths of its step."""
USUAL_RATE = 30.0


class Stated(NamedTuple):
    """One number of a camera's file; tag O is "measured on the owner's captures"."""

    section: str
    key: str
    value: Any
    source: str
    tag: str = "O"


@dataclass(frozen=True)
class Origin:
    """A camera file's own words: ``title``, names of the captures, frames per second with their tag and source, and
    the surface's assumed albedo."""

    title: str
    captures: str
    rate: Stated
    albedo: float

    @property
    def source(self) -> str:
        """Words that name the captures and the day."""
        return f"measured by harness.characterise on {self.captures}, {date.today().isoformat()}"


def write_camera(path: Path, like: str | None, found: Characteristics, origin: Origin) -> AnyCamera:
    """Write the camera's file, of a known camera ``like`` or empirical, and return the camera. Raises UserError where
    the known camera has another image size, and where the file cannot be written."""
    facts = list(_refitted(like, found, origin) if like else _empirical(found, origin))
    if like and is_camera_path(like):
        like = os.path.relpath(like, path.parent)  # a path counts from the file that names it
    kind = f"like: {json.dumps(like)}" if like else "kind: empirical"
    lines = [f"# {one}" for one in ("Tags: O measured on the owner's captures, M assumed.", *found.doubts())]
    lines += [f"name: {path.stem}", f"title: {json.dumps(origin.title)}", kind]
    sections = dict.fromkeys(fact.section for fact in facts)
    for section in sections:
        own = [fact for fact in facts if fact.section == section]
        lines += [f"{section}:"] if section else []
        for fact in own:
            told = f"{{value: {_text(fact.value)}, tag: {fact.tag}, source: {json.dumps(fact.source)}}}"
            lines.append(f"{'  ' if section else ''}{fact.key}: {told}")
    write_text(path, "\n".join(lines) + "\n")
    return read_camera(path)


def _text(value: Any) -> str:
    if isinstance(value, list | tuple | np.ndarray):
        return f"[{', '.join(map(_text, value))}]"
    return str(value) if isinstance(value, int) else f"{float(f'{float(value):.5g}')!r}".replace("e-0", "e-")


def _lens(lens: Lens, source: str) -> Iterator[Stated]:
    for key in ("width", "height", "fx", "fy", "cx", "cy"):
        yield Stated("lens", f"{key}_px", getattr(lens, key), source)
    yield Stated("lens", "distortion", lens.distortion if any(lens.distortion) else (), source)


def _frames(found: Characteristics, source: str) -> Iterator[Stated]:
    yield Stated("unit", "jump_rate", found.jumped / found.frames, f"{found.jumped} of {found.frames} frames; {source}")
    yield Stated("unit", "jump_mm", found.jump_m / MM, source)
    yield Stated("unit", "jitter_mm", found.jitter_m / MM, source)


def _empirical(found: Characteristics, origin: Origin) -> Iterator[Stated]:
    law, source, lens, capture = found.law, origin.source, found.captures[0].lens, found.captures[0]
    not_told = "not told by the captures"
    yield Stated("", "wavelength_nm", 850.0, "names the albedo of simulated surfaces; the captures do not tell it", "M")
    yield from _lens(lens, f"lens of the recording; {source}")
    yield origin.rate
    yield Stated("unit", "offset_mm", 0.0, f"a constant error of range is {not_told}", "M")
    for key, value in (("drift_mm", 0.0), ("drift_min", 20.0), ("drift_ramp", 0.0)):
        yield Stated("unit", key, value, f"drift after power-on is {not_told}", "M")
    yield from _frames(found, source)
    unknown = "1 stands for the amplitude, which is not recorded"
    light = (law.light_at_1m, source, "O") if found.has_amplitude else (1.0, unknown, "M")
    yield Stated("light", "amplitude_at_1m", *light)
    yield Stated("light", "albedo", origin.albedo, "assumed of the recorded surface", "M")
    yield Stated("noise", "range_mm", law.range_m / MM, source)
    yield Stated("noise", "sigma_mm", law.sigma_m / MM, source)
    for key, value, error in (
        ("range_exponent", law.range_exponent, law.range_exponent_se),
        ("brightness_exponent", law.light_exponent, law.light_exponent_se),
    ):
        told = (f"standard error {error:.2g}; {source}", "O") if np.isfinite(error) else (f"assumed: {not_told}", "M")
        yield Stated("noise", key, value, *told)
    yield from _filters("noise", found.correlation, source, "O")
    pattern = found.pattern
    doubt = "not told without a flat surface" if pattern is None else "; ".join((source, *pattern.field.warnings))
    yield Stated("fixed_pattern", "deviation_mm", 0.0 if pattern is None else pattern.field.rms_m / MM, doubt)
    shared = np.ones((2, 1)) if found.pattern_correlation is None else found.pattern_correlation
    yield from _filters("fixed_pattern", shared, doubt, "O")
    drops, order = found.dropouts, np.argsort(found.dropouts.amplitude)
    yield Stated("dropouts", "amplitude", np.where(np.isnan(drops.amplitude), 1.0, drops.amplitude)[order], source)
    yield Stated("dropouts", "share", drops.share[order], f"of {int(drops.pixels.sum())} pixels on surfaces; {source}")
    edge, none = found.edge, f"edges are {not_told}"
    lines = "" if edge is None else f"{edge.lines} lines of pixels across edges of {edge.step_m / MM:.0f} mm; {source}"
    blur_px = 0.0 if edge is None else (edge.gap_px + edge.flying_px) / EDGE_SHARE if edge.flying_px > 0.05 else 0.0
    told = (lines, "O") if edge is not None else (none, "M")
    yield Stated("edge", "gap_px", 0.0 if edge is None else edge.gap_px, *told)
    yield Stated("edge", "blur_px", blur_px, *told)
    yield Stated("edge", "least_step_mm", 20.0, "steps below it are taken to cost no return; not measured", "M")
    yield Stated("engine", "min_range_mm", 0.0, f"limits of range are {not_told}", "M")
    yield Stated("engine", "max_range_mm", 20_000.0, f"limits of range are {not_told}", "M")
    step_mm = capture.step_m / MM if capture.step_m > 0 else 1e-3
    yield Stated("engine", "output_step_mm", step_mm, f"step of the stored depth; {source}")


def _filters(section: str, correlation: np.ndarray, source: str, tag: str) -> Iterator[Stated]:
    """Yield the filters that give neighbours this correlation (2, lags) along x and y."""
    for key, along in (("rows", correlation[1]), ("columns", correlation[0])):
        yield Stated(section, key, np.asarray(taps_of(along), float), source, tag)


# ---------------------------------------------------------------- a known camera's model, refitted


def _refitted(like: str, found: Characteristics, origin: Origin) -> Iterator[Stated]:
    source = origin.source
    camera = twin_of(like, found.captures[0].lens, origin.albedo).camera
    if isinstance(camera, EmpiricalCamera) or not found.surfaces:
        what = "is an empirical camera" if found.surfaces else "is refitted on flat surfaces, and none was found"
        raise UserError(f"--like {like}: {what}", fix="leave out --like: the file is then an empirical camera")
    yield from _lens(found.captures[0].lens, f"lens of the recording; {source}")
    camera, gain = _gain(camera, found, origin.albedo)
    yield Stated("photons", "signal_electrons", gain, f"gives the temporal noise, albedo {origin.albedo:g}; {source}")
    yield from _frames(found, source)
    if found.pattern is not None:
        own = characteristics(simulated(camera, found, origin.albedo, FEW_FRAMES)).pattern
        times = found.pattern.field.rms_m / max(own.field.rms_m, 1e-9) if own is not None else 1.0
        doubt = "; ".join((f"{times:.3g} times the known camera's; {source}", *found.pattern.field.warnings))
        for key, fact in camera.fixed_pattern.to_data().items():
            if key.endswith("_mm"):
                yield Stated("fixed_pattern", key, fact["value"] * times, doubt)
    faint = _half_lost(found)
    if faint is not None and isinstance(camera, AmcwCamera):
        stack = simulated(camera, found, origin.albedo, 1)
        pairs = [(one.mean_amplitude, own.mean_amplitude) for one, own in zip(found.captures, stack, strict=True)]
        ratio = float(
            np.nanmedian(np.concatenate([(a / b).ravel() for a, b in pairs if a is not None and b is not None]))
        )
        told = f"half of the pixels of amplitude {faint:.4g} return nothing; {source}"
        yield Stated("engine", "min_amplitude_units", faint / ratio, told)


def _half_lost(found: Characteristics) -> float | None:
    """Return the amplitude at which half of the returns are lost; None where the captures do not reach it."""
    level, share = found.dropouts.amplitude, found.dropouts.share
    if len(level) < 2 or share.max() < 0.5 or share.min() > 0.5:
        return None
    order = np.argsort(-share)
    return float(np.exp(np.interp(-0.5, -share[order], np.log(level[order]))))


def _gain(camera: Any, found: Characteristics, albedo: float) -> tuple[Any, float]:
    """Return the camera whose simulated surfaces have the captures' temporal noise, and its gain, by secants on the
    logarithms."""
    start = camera.photons.signal_electrons.value
    wanted = np.array([one.temporal.value for one in found.surfaces])
    tried: list[tuple[float, float]] = []
    gain = start
    for _ in range(STEPS):
        camera = with_number(camera, "photons", "signal_electrons", gain)
        stacks = simulated(camera, found, albedo, FEW_FRAMES)
        own = [one for stack in stacks for one in surfaces_of(stack)]
        tried.append((np.log(gain), float(np.mean(np.log([one.temporal.value for one in own] / wanted)))))
        if abs(tried[-1][1]) < CLOSE:
            break
        slope = -0.6 if len(tried) < 2 else (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0])
        ahead = tried[-1][0] - tried[-1][1] / min(slope, -0.2)
        gain = float(np.exp(np.clip(ahead, np.log(start / FARTHEST), np.log(start * FARTHEST))))
    return camera, gain


# ---------------------------------------------------------------- the captures, simulated again


def simulated(
    camera: AnyCamera, found: Characteristics, albedo: float, frames: int | None = None
) -> list[StillCapture]:
    """Return the captures as a unit of the camera would have taken them: the same surfaces, which the fitted planes
    stand for, as bright as recorded; with as many frames, or ``frames``. Not simulated: the surfaces' own relief, light
    between them, and what lies beside them."""
    return [_again(camera, one, albedo, frames or len(one.z_m), number) for number, one in enumerate(found.captures)]


def _again(camera: AnyCamera, capture: StillCapture, albedo: float, frames: int, number: int) -> StillCapture:
    z_m = capture.mean_m
    if capture.planes:
        labels = np.zeros(z_m.shape, int)
        for place, (_, mask) in enumerate(capture.planes, start=1):
            labels[mask] = place
        distance, nearest = ndimage.distance_transform_edt(labels == 0, return_indices=True)
        labels = np.where(distance <= WIDEST_PX / 2, labels[tuple(nearest)], 0)
        z_m = np.full(z_m.shape, np.nan)
        for place, (plane, _) in enumerate(capture.planes, start=1):
            z_m[labels == place] = plane.z_along_m(capture.slopes[labels == place])
    light = albedo * capture.cosine / (z_m * capture.stretch) ** 2
    config = CameraConfig(name=camera.name, effects=UNIT)

    def unit_before(light: np.ndarray, config: CameraConfig) -> SimulatedUnit:
        return SimulatedUnit(camera, config, image_view(camera, camera.nominal_lens.whole, z_m, light))

    unit = unit_before(light, config)
    if capture.mean_amplitude is not None:
        plain = next(iter(unit.capture(1, SEED).frames())).amplitude
        assert plain is not None
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(plain > 0, capture.mean_amplitude / plain, np.nan)
        ratio /= np.nanmedian(ratio[capture.steady])
        unit = unit_before(light * np.where(np.isfinite(ratio), np.clip(ratio, 0.02, 50), 1.0), config)
    taken = list(unit.capture(frames, SEED, "own camera", number).frames())
    z = np.stack([frame.z_m for frame in taken])
    amplitude = np.stack([frame.amplitude for frame in taken]) if capture.amplitude is not None else None  # type: ignore
    return replace(capture, z_m=z, amplitude=amplitude, step_m=camera.z_step_m)
