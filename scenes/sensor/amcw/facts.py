"""The numbers of a continuous-wave imager, as in its file, and the phase unwrapping that its
frequencies allow."""

from __future__ import annotations

from functools import cached_property, lru_cache
from itertools import pairwise, product
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR
from scenes.optics import Optics
from scenes.sensor.common.facts import (
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
    UnitFacts,
    checked,
)


class UnwrapTable(NamedTuple):
    """Tables that convert phases at f = 1, 2 or 3 frequencies to half the light's path. Sums of
    the wrapped phases that are whole numbers are a key of the wrap counts."""

    lattice: np.ndarray
    """(f,) float32: integers m with f_k = m_k f_0."""
    combination: np.ndarray
    """(f - 1, f) float32: integer rows orthogonal to m, which sum the phases to whole numbers."""
    sizes: np.ndarray
    """(f - 1,) int32: number of values of each of these."""
    offset: np.ndarray
    """(f - 1,) int32: what makes the smallest value 0."""
    wraps: np.ndarray
    """(f, keys) float32: whole turns of each frequency; -1 for keys that do not occur."""
    metres_per_turn: np.ndarray
    """(f,) float32: half the path is their sum with the unwrapped phases in turns."""
    unambiguous_m: float
    """c / 2 f_0, after which all frequencies repeat."""


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
    wraps = np.full((np.prod(sizes, dtype=int), lattice.size), -1, np.float32)
    wraps[(keys + offset) @ strides] = counts
    unambiguous_m = SPEED_OF_LIGHT_AIR / (2 * base_hz)
    if fusion == "least_squares":
        weights = lattice / (lattice**2).sum()
    else:
        weights = np.full(lattice.size, 1 / lattice.sum())
    return UnwrapTable(
        lattice=lattice.astype(np.float32),
        combination=combination.astype(np.float32),
        sizes=sizes.astype(np.int32),
        offset=offset.astype(np.int32),
        wraps=np.ascontiguousarray(wraps.T),
        metres_per_turn=(unambiguous_m * weights).astype(np.float32),
        unambiguous_m=unambiguous_m,
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
    in_mhz = [f / 1e6 for f in frequencies_hz]
    raise UserError(f"modulation frequencies {in_mhz} MHz share no base frequency", legal=legal)


def _wrap_counts(lattice: np.ndarray, noise_turns: float = 0.03) -> np.ndarray:
    """Return the wrap counts (n, f) that occur within the unambiguous range, also with errors of
    ``noise_turns``; those of the smallest errors last, as they take precedence."""
    finest_step = 1 / (64 * int(lattice.max()))
    share = np.arange(0, 1, finest_step) + 1e-9
    turns = share[:, None] * lattice
    errors = list(product((-noise_turns, 0.0, noise_turns), repeat=lattice.size))
    errors.sort(key=lambda error: -sum(abs(turn) for turn in error))
    all_wraps = np.concatenate([np.floor(turns + np.array(error)) for error in errors])
    wraps = all_wraps.astype(np.int64)
    in_range = (wraps >= 0).all(axis=1) & (wraps < lattice).all(axis=1)
    return wraps[in_range]


def _orthogonal_rows(lattice: np.ndarray, reach: int = 16) -> np.ndarray:
    """Return the shortest independent integer rows t (f - 1, f) with t . m = 0 that distinguish
    all wrap counts."""
    if lattice.size == 1:
        return np.empty((0, 1), np.int64)
    if lattice.size == 2:
        return np.array([[-lattice[1], lattice[0]]])
    rows = []
    for row in product(range(-reach, reach + 1), repeat=3):
        if any(row) and np.dot(row, lattice) == 0:
            rows.append(np.array(row))
    rows.sort(key=lambda row: (int((row**2).sum()), tuple(-row)))
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
# longest row with the filter's window: `kernels.STRIDE`, repeated here so that declarations
# compile nothing
WIDEST_PX = 2128


class EmitterFacts(ConeFacts):
    """The light source: a point beside the lens with uniform intensity in its cone."""

    irradiance_w_m2: Positive
    """Irradiance of a facing surface on the axis at 1 m; only a reference for ambient light."""
    mask_slopes: Fact[tuple[tuple[float, float], ...]] | None = None
    """Corners (x/z, y/z), counter-clockwise in the image's axes, of a convex polygon outside which
    the camera gives no range."""

    @model_validator(mode="after")
    def _mask_is_convex(self) -> EmitterFacts:
        if self.mask_slopes is not None:
            # corners of a convex area turn one way: counter-clockwise in axes x right, y down, as
            # in the file
            x, y = np.diff([*self.mask_slopes.value, *self.mask_slopes.value[:2]], axis=0).T
            if len(x) < 4 or not (x[:-1] * y[1:] - y[:-1] * x[1:] > 0).all():
                raise ValueError(
                    "mask_slopes must be the corners of a convex polygon, counter-clockwise "
                    "in the "
                    "image's axes"
                )
        return self


class ScatterFacts(Config):
    """Light that reaches the wrong pixels. A ghost image at a distance is not modelled."""

    blur_px: NonNegative
    """Deviation of the Gaussian by which the lens blurs."""
    stray_share: Share
    """Share of the light that is spread farther instead."""
    stray_px: Positive
    """Deviation of the Gaussian that spreads it."""


class ColourFacts(Config):
    """The colour camera, to whose pixels depth images may be aligned."""

    turn_deg: Fact[tuple[float, float, float]]
    """Rotation vector from the depth camera's frame to its frame."""
    shift_mm: Fact[tuple[float, float, float]]
    """Origin of the depth camera's frame in its frame."""
    distortion: Fact[tuple[float, ...]]
    """The coefficients, as for every lens."""

    @property
    def T_colour_depth(self) -> np.ndarray:
        """The (4, 4) matrix from the depth camera's frame to the colour camera's."""
        from scipy.spatial.transform import Rotation

        T_colour_depth = np.eye(4)
        T_colour_depth[:3, :3] = Rotation.from_rotvec(self.turn_deg.value, degrees=True).as_matrix()
        T_colour_depth[:3, 3] = np.array(self.shift_mm.value) * MM
        return T_colour_depth


class ModulationFacts(Config):
    """Continuous-wave modulation."""

    frequencies_hz: PositiveEach
    """One to three frequencies."""
    phases: Phases
    """Number of samples of each frequency, at equal phase steps."""
    contrast: Contrasts
    """The fundamental's amplitude over the mean light, for each frequency."""
    wiggling_residual: ShareEach
    """Share of harmonics left after calibration and by bandwidth, for each frequency."""

    @model_validator(mode="after")
    def _one_value_each(self) -> ModulationFacts:
        count = len(self.frequencies_hz.value)
        if not 1 <= count <= 3 or len(set(self.frequencies_hz.value)) != count:
            raise ValueError(
                f"there are {count} frequencies_hz; this kind of camera has 1, 2 or 3, all "
                "different"
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
    """The photon budget: one gain, calibrated at one point."""

    signal_electrons: Positive
    """Electrons in both wells in one exposure, from albedo 1, facing, on the axis at 1 m."""
    calibration_sigma_mm: Positive
    """Published temporal deviation of single pixels at the calibration point."""
    calibration_distance_m: Positive
    """Distance of the calibration point."""
    calibration_albedo: Positive
    """Albedo of the calibration point."""
    read_noise_electrons: NonNegative
    """Deviation of the reading of one well."""
    electrons_per_unit: Positive
    """Difference of the wells in one unit of the converter."""
    full_well_electrons: Positive | None = None
    """Capacity of one well; None: only the converter saturates."""
    exposure_ends_electrons: Positive | None = None
    """Electrons in both wells when a pixel's exposure ends; its sample is scaled to the full
    length."""
    band_nm: Positive
    """Width of the filter's band, for ambient light."""


class ExposuresFacts(Config):
    """Exposure control: shorter exposures before bright surfaces. They are chosen once for a scene,
    from its light without noise (`scenes.sensor.amcw.exposure.time_shares`)."""

    shares: Fact[tuple[float, ...]]
    """Times that can be chosen, over the longest, to which all other numbers of the file refer."""
    continuous: Fact[bool]
    """True if all times between them can be chosen too."""
    chosen_for: Fact[Literal["frame", "pixel"]]
    """frame: all pixels expose equally long, and samples are not scaled. pixel: each pixel takes
    the longest time that fits, and its samples are scaled to the longest of all."""
    fill: Share
    """Largest share of the wells' and the converter's capacity that light should take."""
    bright_share: Share | None = None
    """Share of a frame's pixels that may take more; they may saturate."""

    @model_validator(mode="after")
    def _times_can_be_chosen(self) -> ExposuresFacts:
        shares = self.shares.value
        falling = all(longer > shorter > 0 for longer, shorter in pairwise(shares))
        if len(shares) < 2 or shares[0] != 1 or not falling:
            raise ValueError("shares must be two numbers or more that fall from 1 and are above 0")
        if self.fill.value == 0:
            raise ValueError("fill must be above 0")
        if self.for_frame != (self.bright_share is not None):
            raise ValueError(
                "bright_share is needed if times are chosen_for a frame, and only then"
            )
        return self

    @property
    def for_frame(self) -> bool:
        """True if all pixels expose equally long."""
        return self.chosen_for.value == "frame"


class ConverterFacts(Config):
    """A companding converter, with unit steps below twice the knee that double per octave above."""

    knee_units: PositiveInt
    """Half of the largest sample of unit steps."""
    full_scale_units: PositiveInt
    """Largest sample."""


class FixedPatternFacts(SmoothPatternFacts):
    """A smooth range error and one of each pixel."""

    pixel_mm: NonNegative
    """Deviation of the error of single pixels."""


class ResidualByAmplitudeFacts(Config):
    """The residual allowed to dim pixels, at least the engine's ``lattice_residual_turns``."""

    scale_turns: Positive
    """Limit at the brightest frequency's amplitude A = 1: it is ``scale_turns`` A^``slope``."""
    slope: Fact[float]
    """Power of the amplitude."""
    greatest_turns: Positive
    """Largest limit."""


class FlyingPixelFacts(Config):
    """The gate on the finished range image, 3x3. A pixel is removed if it lies between nearer and
    farther neighbours, and amplitudes scatter."""

    relative_deviation: NonNegative
    """Smallest deviation of the summed amplitudes over their mean."""
    least_mean_units: NonNegative
    """Smallest mean that the deviation is compared with."""
    near_mm: NonNegative
    """A neighbour reaches more than that nearer,"""
    far_mm: NonNegative
    """and one more than that farther,"""
    most_mm: NonNegative
    """either of them more than that."""


class EngineFacts(LimitFacts):
    """The depth engine: phase-space filter, unwrapping, fusion, gates, output. A gate that is left
    out is not applied."""

    window_px: Window
    """Side of the filter's window."""
    filter_on: Fact[Literal["unit_phasors", "phasors"]]
    """A phasor counts by its weight alone, or by its amplitude too."""
    spatial_sigma_px: Positive | None = None
    """Deviation of the window's Gaussian; None: a box."""
    concentration: NonNegative
    """c of a neighbour's weight exp(-c (1 - cos dphi)) by its phase difference."""
    dim_amplitude_units: NonNegative
    """A centre not brighter than that gets weights by distance alone."""
    drop_dim_neighbours: Fact[bool]
    """True if a brighter centre ignores dimmer neighbours."""
    edges_to_dim: Fact[bool]
    """True if dim neighbours that are not ignored count in the edge sum."""
    fusion: Fact[Literal["least_squares", "mean"]]
    """The rule by which the frequencies' unwrapped phases become one path."""
    amplitude_gains: PositiveEach
    """Multiply each frequency's amplitude before all gates."""
    edge_threshold: Positive | None = None
    """Limit of the sum over the window of (1 - cos dphi)/2."""
    edges_in: Fact[Literal["any", "mean"]]
    """The limit holds for any of the frequencies, or for their mean."""
    lattice_residual_turns: Positive | None = None
    """Limit of the deviation of phases from those of one path."""
    residual_by_amplitude: ResidualByAmplitudeFacts | None = None
    """A wider limit for dim pixels."""
    amplitude_ratio: Share | None = None
    """Limit of (greatest - least) / greatest amplitude of the frequencies."""
    min_amplitude_units: NonNegative
    """Smallest amplitude of any frequency."""
    min_amplitude_sum_units: NonNegative
    """Smallest sum of the frequencies' amplitudes."""
    min_reflectivity_units_mm2: NonNegative | None = None
    """Smallest sum of amplitudes times squared range."""
    min_range_mm: Positive
    """Smallest range."""
    limits_along: Fact[Literal["ray", "axis"]]
    """Direction of the limits of range."""
    flying_pixels: FlyingPixelFacts | None = None
    """The gate on the finished range image."""

    @model_validator(mode="after")
    def _gates_can_hold(self) -> EngineFacts:
        if self.residual_by_amplitude and not self.lattice_residual_turns:
            raise ValueError("residual_by_amplitude needs lattice_residual_turns, its lower limit")
        return self


class AmcwUnitFacts(UnitFacts):
    """Differences between units, and between frames."""

    jitter_at_units: Positive | None = None
    """Median over pixels of the sum of amplitudes at which frames have the jitter, which is
    inversely proportional to it; None: the jitter is the same in any light."""


class AmcwCamera(CameraFacts):
    """A continuous-wave time-of-flight imager: everything that its model needs, as data."""

    kind: Literal["amcw_imager"]
    """Chooses this model."""
    unit: AmcwUnitFacts
    """Differences between units, and between frames."""
    emitter: EmitterFacts
    """The light source."""
    scatter: ScatterFacts | None = None
    """Blur and stray light; None: neither."""
    colour: ColourFacts | None = None
    """The colour camera; None: unknown."""
    modulation: ModulationFacts
    """Frequencies and phases."""
    photons: PhotonFacts
    """The photon budget."""
    exposures: ExposuresFacts | None = None
    """Exposure control; None: all exposures are equally long."""
    converter: ConverterFacts
    """The companding converter."""
    fixed_pattern: FixedPatternFacts
    """Range errors that a unit's frames share."""
    engine: EngineFacts
    """The depth engine."""

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
        if self.exposures is not None:
            self._exposures_fit(self.exposures)
        return self

    def _exposures_fit(self, exposures: ExposuresFacts) -> None:
        if self.photons.exposure_ends_electrons is not None:
            raise ValueError(
                "exposures and photons.exposure_ends_electrons are two rules for one thing; "
                "remove one of them with null"
            )
        if exposures.for_frame and self.engine.min_reflectivity_units_mm2 is not None:
            raise ValueError(
                "engine.min_reflectivity_units_mm2 would reject dark surfaces whenever the "
                "exposures of a frame are shortened: remove it with null"
            )

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Modulation frequencies in the order of the file."""
        return self.modulation.frequencies_hz.value

    @cached_property
    def optics(self) -> Optics:
        """Optics for the render; light reaches a pixel through the engine's windows and the lens's
        blur."""
        half_window_px = self.engine.window_px.value // 2
        flying_px = 1 if self.engine.flying_pixels else 0
        blur_px = int(np.ceil(3 * self.scatter.blur_px.value)) if self.scatter else 0
        return self.optics_with(
            **self.emitter.optics(),
            frequencies_hz=self.frequencies_hz,
            margin_px=half_window_px + flying_px + blur_px,
            farthest_m=self.engine.max_range_mm.value * MM,
            limits_along=self.engine.limits_along.value,
        )
