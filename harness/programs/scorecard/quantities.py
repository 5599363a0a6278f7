"""All quantities that the scorecard measures, each with its conditions and the function that
measures it.

A published figure names a quantity and those conditions that differ from the defaults. A curve is
a quantity over a range of conditions and is measured by the same function. All scenes lie about
the optical axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from harness.programs.scorecard.bench import NOISE, PATTERNED, STEADY, Bench, FrameStack
from harness.programs.scorecard.shadows import rendered_step
from harness.stills.statistics import (
    FLAT_PX,
    Reading,
    correlation_at,
    edge_widths,
    fixed_pattern,
    jackknifed,
    mean_of,
    on_surface_tolerance_m,
    share_of,
    temporal_sigma_m,
)
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import digest
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.common.config import CameraConfig, EffectsConfig

# Height and width in pixels. The patch is narrow, so that at 70 degrees of incidence z varies by
# 6 % to either side on the coarsest camera, and the mean deviation by less than 1 %.
PATCH = (40, 24)
PATTERN_PATCH = (140, 180)
FLOOR_BELOW_M = 1.0
# a frame whose mean lies farther from the median of all has jumped
JUMP_M = 5e-3
# slopes of the nearly frontal plane: 3 degrees, so that all phases of the output's rounding step
# occur
LEAST_TILT = (0.05, 0.02)
EDGE_PATCH = (40, 96)
# distance from the edge within which pixels are counted: more than the widest shadow at 0.75 m,
# under 44 pixels
REACH_PX = 44.0
# pixels across per pixel along the edge: all positions of an edge in a pixel occur, as in ISO
# 12233
SLANT = 0.1
# share of pixels that must have a range for a distance to count as within a camera's range
IN_RANGE = 0.95
# the search for the least range: its limits, the steps outwards, and halvings of the last step
NEAREST_M = 0.1
FARTHEST_M = 20.0
STEP_OUT = 1.25
HALVINGS = 5
ROOM_LIGHT = CameraConfig().ambient_uw_cm2_nm

Distance = Annotated[
    float,
    Field(ge=NEAREST_M, le=FARTHEST_M, description="along the optical axis, in metres"),
]
Albedo = Annotated[
    float, Field(gt=0.0, le=1.0, description="diffuse reflectance, above 0 and up to 1")
]
Ambient = Annotated[float, Field(ge=0.0, le=200.0, description="0 to 200 uW/(cm2 nm)")]
Lag = Annotated[int, Field(ge=0, le=16, description="pixels from 0 to 16")]


class PlaneConditions(Config):
    """An infinite matte plane; ambient light is as in `CameraConfig`. For a continuous-wave
    camera, the sum of the amplitudes may be given instead of the albedo."""

    distance_m: Distance = 1.5
    albedo: Albedo = 0.8
    angle_deg: Annotated[
        float, Field(ge=0.0, le=80.0, description="angle of incidence, 0 to 80 degrees")
    ] = 0.0
    ambient_uw_cm2_nm: Ambient = ROOM_LIGHT
    amplitude_units: (
        Annotated[float, Field(gt=0.0, description="sum over frequencies, in ADC units")] | None
    ) = None
    exposure: Annotated[
        float, Field(gt=0.0, le=100.0, description="length of the exposure over the file's")
    ] = 1.0


class LagConditions(PlaneConditions):
    """Two pixels of a plane at a distance in pixels."""

    lag_x_px: Lag = 1
    lag_y_px: Lag = 0


class PatchConditions(PlaneConditions):
    """Square patches of a plane, each minus its own fitted plane, and a distance between pixels
    within them."""

    patch_px: Annotated[
        int, Field(ge=3, le=70, description="side of a patch in pixels, 3 to 70")
    ] = 38
    apart_px: Annotated[int, Field(ge=0, le=16, description="pixels from 0 to 16")] = 0
    rounded_mm: Annotated[
        float, Field(ge=0.0, le=10.0, description="step of the stored depth, 0 to 10 mm")
    ] = 0.0


class RangesConditions(Config):
    """A nearly frontal matte plane at several distances; ambient light is as in `CameraConfig`."""

    distances_m: Annotated[
        tuple[Distance, ...], Field(min_length=4, description="four or more, in metres")
    ] = (1.0, 1.5, 2.0, 2.5)
    albedo: Albedo = 0.8


class NearConditions(Config):
    """A nearly frontal matte plane that comes nearer; ambient light is as in `CameraConfig`."""

    albedo: Albedo = 0.8
    ambient_uw_cm2_nm: Ambient = ROOM_LIGHT


class StepConditions(Config):
    """A straight edge of a matte plane in front of another, both frontal, 6 degrees off the pixel
    grid. z steps along the image axis ``across``. With ``shadow``, the front is a square on the
    emitter's side and casts its shadow on the back, and light between the surfaces and a floor is
    rendered; without, both are infinite and lit directly."""

    distance_m: Distance = 0.75
    step_mm: Annotated[
        float, Field(ge=0.5, le=5e3, description="from front to back, 0.5 to 5000 mm")
    ] = 50.0
    albedo: Albedo = 0.6
    across: Literal["x", "y"] = "x"
    shadow: bool = False
    front_mm: (
        Annotated[
            float, Field(ge=10.0, le=3e3, description="side of the square front, 10 to 3000 mm")
        ]
        | None
    ) = None
    back_albedo: Albedo | None = None
    floor_below_m: Annotated[
        float, Field(ge=0.05, le=10.0, description="floor below the lens, 0.05 to 10 m")
    ] = FLOOR_BELOW_M

    @model_validator(mode="after")
    def _shadow_has_surroundings(self) -> Self:
        has_front = self.front_mm is not None
        has_back = self.back_albedo is not None
        if self.shadow and not (has_front and has_back):
            raise ValueError("a shadow needs front_mm and back_albedo: its light is rendered")
        if not self.shadow and (has_front or has_back):
            raise ValueError("front_mm and back_albedo belong to a shadow")
        return self


_WORDS: dict[str, Callable[[Any], str]] = {
    "distance_m": "{:g} m".format,
    "distances_m": lambda v: f"{min(v):g} to {max(v):g} m",
    "albedo": "albedo {:g}".format,
    "angle_deg": lambda v: f"{v:g}°" if v else "",
    "ambient_uw_cm2_nm": lambda v: "" if v == ROOM_LIGHT else f"ambient {v:g} µW/(cm² nm)",
    "amplitude_units": lambda v: "" if v is None else f"amplitudes {v:g}",
    "exposure": lambda v: "" if v == 1 else f"{v:g} times the exposure",
    "step_mm": "step {:g} mm".format,
    "across": "across {}".format,
    "shadow": lambda v: "shadowed" if v else "",
    "front_mm": lambda v: f"front {v:g} mm" if v else "",
    "back_albedo": lambda v: f"back of albedo {v:g}" if v else "",
    "floor_below_m": lambda v: "" if v == FLOOR_BELOW_M else f"floor {v:g} m below",
    "patch_px": "patches of {:g} px".format,
    "apart_px": lambda v: f"{v:g} px apart" if v else "",
    "rounded_mm": lambda v: f"stored in steps of {v:g} mm" if v else "",
    "lag_px": "lag {} px".format,
}


def in_words(conditions: Config) -> str:
    """Return conditions as a short text with units: ``1.5 m, albedo 0.8``."""
    data = conditions.to_data()
    if data.get("amplitude_units") is not None:
        del data["albedo"]
    if "lag_x_px" in data:
        data["lag_px"] = (data.pop("lag_x_px"), data.pop("lag_y_px"))
    return ", ".join(filter(None, (_WORDS[key](value) for key, value in data.items())))


def scene_of(conditions: Config) -> tuple[str, dict[str, Any]]:
    """Return the scene for conditions; conditions that share a scene, such as lags on a plane,
    give equal results."""
    shared = _plane(conditions) if isinstance(conditions, PlaneConditions) else conditions
    return type(shared).__name__, shared.to_data()


def _plane(c: PlaneConditions) -> PlaneConditions:
    return PlaneConditions(**{key: getattr(c, key) for key in PlaneConditions.model_fields})


Measure = Callable[[Bench, Any], Reading]


@dataclass(frozen=True)
class Quantity:
    """A quantity that the scorecard measures."""

    name: str
    title: str
    """Words for tables and pages."""
    unit: str
    """mm or px; empty for ratios."""
    conditions: type[Config]
    """Conditions of a measurement, with their defaults."""
    measure: Measure
    effects: EffectsConfig
    """Effects of the camera that are on while it is measured."""
    says: str
    """Sentence for the page: what is measured."""


QUANTITIES: dict[str, Quantity] = {}


def _quantity(
    title: str, conditions: type[Config], effects: EffectsConfig = NOISE
) -> Callable[[Measure], Measure]:
    """Register a measuring function. The ending of its name is the unit; the page quotes its
    docstring's start."""

    def listed(measure: Measure) -> Measure:
        name = measure.__name__
        says = " ".join((measure.__doc__ or "").partition("\n\n")[0].split())
        ending = name.rpartition("_")[2]
        unit = ending if ending in ("mm", "px") else ""
        QUANTITIES[name] = Quantity(
            name=name,
            title=title,
            unit=unit,
            conditions=conditions,
            measure=measure,
            effects=effects,
            says=says,
        )
        return measure

    return listed


@lru_cache(maxsize=8)
def plane_stack(
    bench: Bench,
    c: PlaneConditions,
    effects: EffectsConfig = NOISE,
    frames: int | None = None,
    unit: int = 1,
    patch: tuple[int, int] = PATCH,
) -> FrameStack:
    """Return frames of a plane about the axis; all measurements of a plane with the same effects
    share them."""
    slope_x = max(float(np.tan(np.radians(c.angle_deg))), LEAST_TILT[0])
    albedo = c.albedo
    if c.amplitude_units is not None:
        camera = bench.camera
        if not isinstance(camera, AmcwCamera):
            problem = f"{camera.name}: does not support amplitude_units"
            raise UserError(problem, fix="give the plane's albedo")
        photons = camera.photons
        electrons = c.amplitude_units * photons.electrons_per_unit.value * c.distance_m**2
        contrast = sum(camera.modulation.contrast.value)
        albedo = electrons / (photons.signal_electrons.value * contrast)
    # on a plane, light and ambient light are proportional to the albedo and to the exposure
    albedo *= c.exposure
    # exposures of a scene share their random numbers
    scene = c.to_data()
    del scene["exposure"]
    region = bench.patch(*patch)
    view = plane_view(bench.camera, region, c.distance_m, albedo, slope_x, LEAST_TILT[1])
    return bench.taken(
        view,
        effects,
        frames or bench.effort.noise_frames,
        "plane",
        digest([scene, effects.to_data()]),
        unit,
        unit_seed=unit,
        ambient_uw_cm2_nm=c.ambient_uw_cm2_nm,
    )


def _deviation(stack: FrameStack) -> Reading:
    return jackknifed(stack.z_m, lambda z: temporal_sigma_m(z) / MM)


@_quantity("temporal deviation", PlaneConditions)
def temporal_sigma_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation of a pixel's z over frames, rms over pixels, noise alone."""
    return _deviation(plane_stack(bench, c))


@_quantity("random error", PlaneConditions, EffectsConfig())
def random_error_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation of a pixel's z over frames, with whole-frame jitter and jumps, rms over
    pixels."""
    return _deviation(plane_stack(bench, c, EffectsConfig(), bench.effort.whole_frames))


@_quantity("jitter of whole frames", PlaneConditions, EffectsConfig())
def frame_jitter_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation over frames of the mean z of 25,000 pixels, without frames that jumped."""
    stack = plane_stack(bench, c, EffectsConfig(), patch=PATTERN_PATCH)
    means_m = np.nanmean(stack.z_m, axis=(1, 2))
    from_median_m = np.abs(means_m - np.median(means_m))
    steady_m = means_m[from_median_m < JUMP_M]

    def deviation_mm(steady: np.ndarray) -> float:
        return float(steady.std(ddof=1)) / MM

    return jackknifed(steady_m, deviation_mm)


@_quantity("noise correlation", LagConditions)
def noise_correlation(bench: Bench, c: LagConditions) -> Reading:
    """Correlation of the temporal noise of two pixels, noise alone."""
    z_m = plane_stack(bench, _plane(c)).z_m
    return jackknifed(z_m, lambda frames: correlation_at(frames, True, c.lag_x_px, c.lag_y_px))


@_quantity("valid fraction", PlaneConditions)
def valid_fraction(bench: Bench, c: PlaneConditions) -> Reading:
    """Share of pixels about the axis that have a range."""
    # all neighbours that the camera's own filter mixes count as a single pixel
    pixels_each = (2 * bench.camera.optics.margin_px + 1) ** 2
    stack = plane_stack(bench, c, NOISE, bench.effort.few_frames)
    return share_of(np.isfinite(stack.z_m), pixels_each)


@_quantity("least range", NearConditions)
def least_range_mm(bench: Bench, c: NearConditions) -> Reading:
    """Nearest distance at which 95 % of the pixels about the axis have a range, to 1 %."""

    def in_range(distance_m: float) -> bool:
        plane = PlaneConditions(distance_m=distance_m, **c.to_data())
        return valid_fraction(bench, plane).value >= IN_RANGE

    optics = bench.camera.optics
    far_m = max(optics.nearest_m, NEAREST_M)
    farthest_m = min(optics.farthest_m, FARTHEST_M)
    while not in_range(far_m):
        far_m *= STEP_OUT
        if far_m > farthest_m:
            return Reading(float("nan"))
    near_m = far_m / STEP_OUT
    for _ in range(HALVINGS):
        middle_m = max((near_m + far_m) / 2, NEAREST_M)
        if in_range(middle_m):
            far_m = middle_m
        else:
            near_m = middle_m
    return Reading(far_m / MM)


def _left_of_patches(z_m: np.ndarray, n: int) -> np.ndarray:
    """Return z (h, w) as square patches (patches, n, n) minus each patch's own plane, mm."""
    v, u = np.mgrid[:n, :n].reshape(2, -1) - n / 2
    plane = np.column_stack([np.ones(n * n), u, v])
    height, width = z_m.shape
    pixels = []
    for row in range(0, height - n + 1, n):
        for column in range(0, width - n + 1, n):
            pixels.append(z_m[row : row + n, column : column + n].ravel())
    patches = np.stack(pixels, axis=1) / MM
    fitted = plane @ np.linalg.lstsq(plane, patches)[0]
    return np.asarray((patches - fitted).T.reshape(-1, n, n))


@lru_cache(maxsize=4)
def _single_frames(bench: Bench, c: PlaneConditions) -> tuple[np.ndarray, ...]:
    """Return one frame's z (h, w) for each of several units, cached for all patches of this
    plane."""
    frames = []
    for unit in range(1, bench.effort.few_frames + 1):
        stack = plane_stack(bench, c, PATTERNED, 1, unit, PATTERN_PATCH)
        frames.append(stack.z_m[0])
    return tuple(frames)


def _patch_products(bench: Bench, c: PatchConditions) -> tuple[np.ndarray, np.ndarray]:
    """Return (units, patches) in mm^2: the variance about each patch's plane in a frame, and the
    product at the lag."""
    n = c.patch_px
    k = c.apart_px
    variances = []
    products = []
    for z_m in _single_frames(bench, _plane(c)):
        stored_m = z_m
        if c.rounded_mm:
            step_m = c.rounded_mm * MM
            stored_m = np.round(z_m / step_m) * step_m
        residual_mm = _left_of_patches(stored_m, n)
        beside = residual_mm[:, :, k:] * residual_mm[:, :, : n - k]
        below = residual_mm[:, k:] * residual_mm[:, : n - k]
        variances.append(residual_mm.var(axis=(1, 2)))
        products.append((beside.mean(axis=(1, 2)) + below.mean(axis=(1, 2))) / 2)
    return np.array(variances), np.array(products)


@_quantity("deviation within patches", PatchConditions, PATTERNED)
def patch_deviation_mm(bench: Bench, c: PatchConditions) -> Reading:
    """Standard deviation of a single frame about the patch's own plane, with noise and fixed
    pattern: median over patches, mean over units."""
    variance, _ = _patch_products(bench, c)
    return mean_of(np.sqrt(np.median(variance, axis=1)))


@_quantity("pattern within patches", PatchConditions, PATTERNED)
def patch_pattern_mm(bench: Bench, c: PatchConditions) -> Reading:
    """Standard deviation about the patch's own plane that two averages of different frames share:
    rms over patches, mean over units."""
    deviations_mm = []
    for unit in range(1, min(bench.effort.units, 5) + 1):
        frames = bench.effort.noise_frames // 4
        stack = plane_stack(bench, _plane(c), PATTERNED, frames, unit, PATTERN_PATCH)
        even = _left_of_patches(stack.z_m[::2].mean(axis=0), c.patch_px)
        odd = _left_of_patches(stack.z_m[1::2].mean(axis=0), c.patch_px)
        deviations_mm.append(float(np.sqrt(max((even * odd).mean(), 0.0))))
    return mean_of(deviations_mm)


@_quantity("correlation within patches", PatchConditions, PATTERNED)
def patch_correlation(bench: Bench, c: PatchConditions) -> Reading:
    """Correlation between pixels of a single frame about the patch's own plane, mean over rows and
    columns."""
    variance, product = _patch_products(bench, c)
    return mean_of(product.mean(axis=1) / variance.mean(axis=1))


@_quantity("systematic error", PlaneConditions, STEADY)
def systematic_error_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Largest absolute mean error of z among ten units, one hour after power-on, direct light
    only."""
    errors = []
    for unit in range(1, bench.effort.units + 1):
        stack = plane_stack(bench, c, STEADY, bench.effort.few_frames, unit)
        error_m = (stack.z_m - stack.true_z_m)[np.isfinite(stack.z_m)]
        errors.append(abs(error_m.mean()) / MM if error_m.size else np.nan)
    return Reading(float(np.fmax.reduce(errors)))


@_quantity("error over range", RangesConditions, STEADY)
def error_over_range_mm(bench: Bench, c: RangesConditions) -> Reading:
    """Standard deviation over distances of a unit's mean error of z over pixels and frames."""
    errors_mm = []
    for distance_m in c.distances_m:
        plane = PlaneConditions(distance_m=distance_m, albedo=c.albedo)
        stack = plane_stack(bench, plane, STEADY)
        errors_mm.append(float(np.nanmean(stack.z_m - stack.true_z_m)) / MM)
    return Reading(float(np.std(errors_mm, ddof=1)))


@_quantity("fixed pattern", PlaneConditions, PATTERNED)
def fixed_pattern_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation over pixels of the average minus a smooth surface and the remaining
    noise, mean of 5 units."""
    deviations_mm = []
    for unit in range(1, min(bench.effort.units, 5) + 1):
        frames = bench.effort.noise_frames // 4
        stack = plane_stack(bench, c, PATTERNED, frames, unit, PATTERN_PATCH)
        where = np.isfinite(stack.z_m).all(axis=0)
        if where.mean() > 0.5:
            pattern = fixed_pattern(np.nan_to_num(stack.z_m), where, stack.slopes, lags=12)
            deviations_mm.append(pattern.std_m / MM)
    return mean_of(deviations_mm)


@lru_cache(maxsize=4)
def _widths(bench: Bench, c: StepConditions) -> dict[str, np.ndarray]:
    """Return widths at a straight edge near the axis; in front, sign (across - slant along) < 0 in
    ideal pixels."""
    camera = bench.camera
    axis = ("x", "y").index(c.across)
    lens = camera.nominal_lens
    region = bench.patch(*EDGE_PATCH) if axis == 0 else bench.patch(*EDGE_PATCH[::-1])
    toward_emitter = -1.0 if camera.optics.emitter_m[axis] < 0 else 1.0
    # in front, sign * (position across) < edge; for a shadow, the front is on the emitter's side
    sign = -toward_emitter if c.shadow else toward_emitter

    def signed_px(slopes: np.ndarray) -> np.ndarray:
        px = slopes * np.array([lens.fx, lens.fy])
        return np.asarray(sign * (px[..., axis] - SLANT * px[..., 1 - axis]))

    front = Plane(c.distance_m)
    back = Plane(c.distance_m + c.step_mm * MM)
    if c.front_mm is not None and c.back_albedo is not None:
        view = rendered_step(
            camera,
            region,
            axis=axis,
            sign=sign,
            slant=SLANT,
            distance_m=c.distance_m,
            step_mm=c.step_mm,
            front_mm=c.front_mm,
            front_albedo=c.albedo,
            wall_albedo=c.back_albedo,
            floor_below_m=c.floor_below_m,
        )
    else:

        def covers(slopes: np.ndarray) -> np.ndarray:
            return signed_px(slopes) < 0

        view = layered_view(camera, region, front, back, covers, c.albedo)
    stack = bench.taken(view, NOISE, bench.effort.few_frames, "step", digest(c.to_data()))
    from_edge = signed_px(lens.region_slopes(stack.region))
    sigma_m = temporal_sigma_m(stack.z_m, np.abs(from_edge) > FLAT_PX)
    tolerance_m = on_surface_tolerance_m(sigma_m, c.step_mm * MM)
    front_z = front.z_along_m(stack.slopes)
    back_z = back.z_along_m(stack.slopes)
    widths = edge_widths(stack.z_m, front_z, back_z, from_edge, tolerance_m, REACH_PX, 2 - axis)
    # pixels so far from the edge that the camera's filter mixes in no other surface
    on_front = from_edge < -FLAT_PX
    on_back = (from_edge > FLAT_PX) & np.isfinite(stack.z_m).all(axis=0)
    return widths | {
        "height": stack.z_m[:, on_back].mean(axis=1) - np.nanmean(stack.z_m[:, on_front], axis=1)
    }


@_quantity("gap at an edge", StepConditions)
def edge_gap_px(bench: Bench, c: StepConditions) -> Reading:
    """Width across an edge of the pixels without a range, including the shadow."""
    return mean_of(_widths(bench, c)["gap"])


@_quantity("flying pixels", StepConditions)
def flying_pixels_px(bench: Bench, c: StepConditions) -> Reading:
    """Width across an edge of the pixels whose range differs from both surfaces by more than four
    standard deviations plus a tenth of the step."""
    return mean_of(_widths(bench, c)["flying"])


@_quantity("edges with flying pixels", StepConditions)
def flying_share(bench: Bench, c: StepConditions) -> Reading:
    """Share of the lines of pixels across an edge that contain a flying pixel."""
    return mean_of(_widths(bench, c)["with_flying"])


@_quantity("height of a step", StepConditions)
def step_height_mm(bench: Bench, c: StepConditions) -> Reading:
    """Mean z of the back minus that of the front, more than 8 pixels from the edge, noise
    alone."""
    return mean_of(_widths(bench, c)["height"] / MM)
