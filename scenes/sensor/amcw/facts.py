"""The numbers of a continuous-wave imager, as in its file, and the phase unwrapping that its
frequencies allow."""

from __future__ import annotations

from functools import cached_property, lru_cache
from itertools import product
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR
from scenes.optics import Optics
from scenes.sensor.facts import (
    CameraFacts,
    ConeFacts,
    Fact,
    LimitFacts,
    NonNegative,
    Positive,
    PositiveEach,
    PositiveInt,
    Share,
    ShareEach,
    SmoothPatternFacts,
    checked,
)


class UnwrapTable(NamedTuple):
    """Tables that convert phases at f = 1, 2 or 3 frequencies to half the light's path.
    ``lattice`` (f,) float32: integers m with f_k = m_k f_0. ``combination`` (f - 1, f) float32:
    integer rows orthogonal to m, which sum the wrapped phases to whole numbers. These are a key of
    the wrap counts: ``sizes`` and ``offset`` (f - 1,) int32 of the keys, ``wraps`` (f, keys)
    float32, -1 for none. ``metres_per_turn`` (f,) float32. ``unambiguous_m``: c / 2 f_0."""

    lattice: np.ndarray
    combination: np.ndarray
    sizes: np.ndarray
    offset: np.ndarray
    wraps: np.ndarray
    metres_per_turn: np.ndarray
    unambiguous_m: float


@lru_cache(maxsize=64)
def unwrap_table(
    frequencies_hz: tuple[float, ...], fusion: Literal["least_squares", "mean"]
) -> UnwrapTable:
    """Return the table for one to three frequencies. Raises UserError if they have no common base
    frequency."""
    lattice, base_hz = _integer_ratios(frequencies_hz)
    combination = _orthogonal_rows(lattice)
    counts = _wrap_counts(lattice)
    keys = counts @ combination.T
    offset = -keys.min(axis=0)
    sizes = keys.max(axis=0) + offset + 1
    # a single frequency has no keys: its table has one entry, the count 0
    strides = np.array([np.prod(sizes[row + 1 :], dtype=int) for row in range(sizes.size)], int)
    table = np.full((np.prod(sizes, dtype=int), lattice.size), -1, np.float32)
    table[(keys + offset) @ strides] = counts
    unambiguous_m = SPEED_OF_LIGHT_AIR / (2 * base_hz)
    weights = (
        lattice / (lattice**2).sum()
        if fusion == "least_squares"
        else np.full(lattice.size, 1 / lattice.sum())
    )
    return UnwrapTable(
        lattice.astype(np.float32),
        combination.astype(np.float32),
        sizes.astype(np.int32),
        offset.astype(np.int32),
        np.ascontiguousarray(table.T),
        (unambiguous_m * weights).astype(np.float32),
        unambiguous_m,
    )


def _integer_ratios(frequencies_hz: tuple[float, ...]) -> tuple[np.ndarray, float]:
    """Return the smallest integers m and the base frequency with f = m * base, to 1e-6."""
    frequencies = np.array(frequencies_hz)
    lowest = frequencies.min()
    for divisor in range(1, 65):
        multiples = frequencies / (lowest / divisor)
        if np.abs(multiples - np.round(multiples)).max() < 1e-6 * divisor:
            return np.round(multiples).astype(np.int64), float(lowest / divisor)
    legal = "frequencies that are integer multiples (the lowest at most 64 times) of a common one"
    what = f"modulation frequencies {[f / 1e6 for f in frequencies_hz]} MHz share no base frequency"
    raise UserError(what, legal=legal)


def _wrap_counts(lattice: np.ndarray, noise_turns: float = 0.03) -> np.ndarray:
    """Return the wrap counts (n, f) that occur within the unambiguous range."""
    distance = (np.arange(0, 1, 1 / (64 * int(lattice.max()))) + 1e-9)[:, None] * lattice
    errors = sorted(
        product((-noise_turns, 0.0, noise_turns), repeat=lattice.size),
        key=lambda e: -sum(abs(x) for x in e),
    )
    wraps = np.concatenate([np.floor(distance + np.array(error)) for error in errors]).astype(
        np.int64
    )
    return wraps[(wraps >= 0).all(axis=1) & (wraps < lattice).all(axis=1)]


def _orthogonal_rows(lattice: np.ndarray, reach: int = 16) -> np.ndarray:
    """Return the shortest independent integer rows t (f - 1, f) with t . m = 0 that distinguish
    all wrap counts."""
    if lattice.size < 3:
        return (
            np.array([[-lattice[1], lattice[0]]])
            if lattice.size == 2
            else np.empty((0, 1), np.int64)
        )
    rows = [
        np.array(t)
        for t in product(range(-reach, reach + 1), repeat=3)
        if any(t) and np.dot(t, lattice) == 0
    ]
    rows.sort(key=lambda t: (int((t**2).sum()), tuple(-t)))
    # a pair that spans the whole orthogonal lattice has |t1 x t2| = |m|; a longer cross product
    # would confuse wraps
    for second in rows[1:]:
        if (np.cross(rows[0], second) ** 2).sum() == (lattice**2).sum():
            return np.stack([rows[0], second])
    raise UserError(
        f"modulation frequency ratios {lattice.tolist()} cannot be unwrapped within {reach} turns"
    )


Contrasts = Annotated[
    Fact[tuple[float, ...]], checked("above 0 and at most 1", lambda value: 0 < value <= 1)
]
Window = Annotated[
    Fact[int],
    checked("an odd number from 1 to 31", lambda value: 0 < value < 32 and value % 2 == 1),
]
Phases = Annotated[
    Fact[int],
    checked("3 or more, to tell phase, amplitude and offset apart", lambda value: value >= 3),
]
# row with the filter's window: `kernels.STRIDE`, repeated here so that declarations compile
# nothing
WIDEST_PX = 2128


class EmitterFacts(ConeFacts):
    """The light source: a point beside the lens with uniform intensity in its cone.
    ``irradiance_w_m2``: on a facing surface on the axis at 1 m; only a reference for ambient
    light. ``mask_slopes``: corners (x/z, y/z), counter-clockwise in the image's axes, of a convex
    polygon outside which the camera gives no range."""

    irradiance_w_m2: Positive
    mask_slopes: Fact[tuple[tuple[float, float], ...]] | None = None

    @model_validator(mode="after")
    def _mask_is_convex(self) -> EmitterFacts:
        if self.mask_slopes is not None:
            # corners of a convex area turn one way: counter-clockwise in axes x right, y down, as
            # in the file
            x, y = np.diff([*self.mask_slopes.value, *self.mask_slopes.value[:2]], axis=0).T
            if len(x) < 4 or not (x[:-1] * y[1:] - y[:-1] * x[1:] > 0).all():
                what = "mask_slopes must be the corners of a convex polygon, counter-clockwise in the image's axes"
                raise ValueError(what)
        return self


class ScatterFacts(Config):
    """Light that reaches the wrong pixels: the lens blurs by a Gaussian of deviation ``blur_px``,
    and a share of the light is spread by a Gaussian of ``stray_px`` instead. A ghost image at a
    distance is not modelled."""

    blur_px: NonNegative
    stray_share: Share
    stray_px: Positive


class ColourFacts(Config):
    """The colour camera, to whose pixels depth images may be aligned. ``turn_deg`` (a rotation
    vector) and ``shift_mm`` map points of the depth camera's frame to its frame. ``distortion``:
    as for every lens."""

    turn_deg: Fact[tuple[float, float, float]]
    shift_mm: Fact[tuple[float, float, float]]
    distortion: Fact[tuple[float, ...]]

    @property
    def T_colour_depth(self) -> np.ndarray:
        """The (4, 4) matrix from the depth camera's frame to the colour camera's."""
        from scipy.spatial.transform import Rotation

        T_colour_depth = np.eye(4)
        T_colour_depth[:3, :3] = Rotation.from_rotvec(self.turn_deg.value, degrees=True).as_matrix()
        T_colour_depth[:3, 3] = np.array(self.shift_mm.value) * MM
        return T_colour_depth


class ModulationFacts(Config):
    """Continuous-wave modulation, one value per frequency except ``phases``. ``contrast``: the
    fundamental's amplitude over the mean light. ``wiggling_residual``: share of harmonics left
    after calibration and by bandwidth."""

    frequencies_hz: PositiveEach
    phases: Phases
    contrast: Contrasts
    wiggling_residual: ShareEach

    @model_validator(mode="after")
    def _one_value_each(self) -> ModulationFacts:
        count = len(self.frequencies_hz.value)
        if not 1 <= count <= 3 or len(set(self.frequencies_hz.value)) != count:
            raise ValueError(
                f"there are {count} frequencies_hz; this kind of camera has 1, 2 or 3, all different"
            )
        for key in ("contrast", "wiggling_residual"):
            if len(getattr(self, key).value) != count:
                raise ValueError(f"{key} needs one value for each of the {count} frequencies_hz")
        try:
            unwrap_table(self.frequencies_hz.value, "least_squares")
        except UserError as mistake:
            raise ValueError(
                f"frequencies_hz: {mistake.message}; legal: {mistake.legal}"
            ) from mistake
        return self


class PhotonFacts(Config):
    """The photon budget: one gain, calibrated at one point. ``signal_electrons``: in both wells in
    one exposure, from albedo 1, facing, on the axis at 1 m. ``full_well_electrons``: of one well
    (None: only the converter saturates). ``exposure_ends_electrons``: in both wells when a pixel's
    exposure ends; its sample is scaled to the full length."""

    signal_electrons: Positive
    calibration_sigma_mm: Positive
    calibration_distance_m: Positive
    calibration_albedo: Positive
    read_noise_electrons: NonNegative
    electrons_per_unit: Positive
    full_well_electrons: Positive | None = None
    exposure_ends_electrons: Positive | None = None
    band_nm: Positive


class ConverterFacts(Config):
    """A companding converter, with unit steps below twice the knee that double per octave above."""

    knee_units: PositiveInt
    full_scale_units: PositiveInt


class FixedPatternFacts(SmoothPatternFacts):
    """A smooth range error and one of each pixel."""

    pixel_mm: NonNegative


class ResidualByAmplitudeFacts(Config):
    """The lattice residual allowed to dim pixels: ``scale_turns`` A^``slope`` of the brightest
    frequency's amplitude A, at most ``greatest_turns`` and at least the engine's
    ``lattice_residual_turns``."""

    scale_turns: Positive
    slope: Fact[float]
    greatest_turns: Positive


class FlyingPixelFacts(Config):
    """The gate on the finished range image, 3x3. A pixel is removed if its neighbours reach more
    than ``near_mm`` nearer and ``far_mm`` farther, either more than ``most_mm``, and their summed
    amplitudes scatter by ``relative_deviation`` of their mean or more (with a mean of at least
    ``least_mean_units``)."""

    relative_deviation: NonNegative
    least_mean_units: NonNegative
    near_mm: NonNegative
    far_mm: NonNegative
    most_mm: NonNegative


class EngineFacts(LimitFacts):
    """The depth engine: phase-space filter, unwrapping, fusion, gates, output. A gate that is left
    out is not applied. ``filter_on``: each phasor counts by its weight alone (``unit_phasors``),
    or by its amplitude too (``phasors``). ``spatial_sigma_px``: Gaussian of the window; None: a
    box. A centre not brighter than ``dim_amplitude_units`` gets weights by distance alone; if
    ``drop_dim_neighbours``, a brighter centre ignores dimmer neighbours. ``edge_threshold``: limit
    of the sum over the window of (1 - cos dphi)/2, ``edges_in`` any of the frequencies or their
    mean; ``edges_to_dim``: whether it includes such dim neighbours. ``amplitude_gains`` multiply
    each frequency's amplitude before all gates. ``limits_along``: direction of the limits of
    range."""

    window_px: Window
    filter_on: Fact[Literal["unit_phasors", "phasors"]]
    spatial_sigma_px: Positive | None = None
    concentration: NonNegative
    dim_amplitude_units: NonNegative
    drop_dim_neighbours: Fact[bool]
    edges_to_dim: Fact[bool]
    fusion: Fact[Literal["least_squares", "mean"]]
    amplitude_gains: PositiveEach
    edge_threshold: Positive | None = None
    edges_in: Fact[Literal["any", "mean"]]
    lattice_residual_turns: Positive | None = None
    residual_by_amplitude: ResidualByAmplitudeFacts | None = None
    amplitude_ratio: Share | None = None
    min_amplitude_units: NonNegative
    min_amplitude_sum_units: NonNegative
    min_reflectivity_units_mm2: NonNegative | None = None
    min_range_mm: Positive
    limits_along: Fact[Literal["ray", "axis"]]
    flying_pixels: FlyingPixelFacts | None = None

    @model_validator(mode="after")
    def _gates_can_hold(self) -> EngineFacts:
        if self.residual_by_amplitude and not self.lattice_residual_turns:
            raise ValueError("residual_by_amplitude needs lattice_residual_turns, its lower limit")
        return self


class AmcwCamera(CameraFacts):
    """A continuous-wave time-of-flight imager: everything that its model needs, as data."""

    kind: Literal["amcw_imager"]
    emitter: EmitterFacts
    scatter: ScatterFacts | None = None
    colour: ColourFacts | None = None
    modulation: ModulationFacts
    photons: PhotonFacts
    converter: ConverterFacts
    fixed_pattern: FixedPatternFacts
    engine: EngineFacts

    @model_validator(mode="after")
    def _parts_fit_each_other(self) -> AmcwCamera:
        widest_px = WIDEST_PX - self.engine.window_px.value + 1
        if self.lens.width_px.value > widest_px:
            raise ValueError(
                f"lens.width_px is {self.lens.width_px.value}; the model allows at most {widest_px}"
            )
        if len(self.engine.amplitude_gains.value) != len(self.frequencies_hz):
            raise ValueError(
                "engine.amplitude_gains needs one value for each of modulation.frequencies_hz"
            )
        return self

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Modulation frequencies in the order of the file."""
        return self.modulation.frequencies_hz.value

    @cached_property
    def optics(self) -> Optics:
        """Optics for the render; light reaches a pixel through the engine's windows and the lens's
        blur."""
        blur_px = int(np.ceil(3 * self.scatter.blur_px.value)) if self.scatter else 0
        return self.optics_with(
            **self.emitter.optics(),
            frequencies_hz=self.frequencies_hz,
            margin_px=self.engine.window_px.value // 2
            + (1 if self.engine.flying_pixels else 0)
            + blur_px,
            farthest_m=self.engine.max_range_mm.value * MM,
            limits_along=self.engine.limits_along.value,
        )
