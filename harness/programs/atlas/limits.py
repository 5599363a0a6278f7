"""Limits of a camera between the set-ups of the atlas, by the law of its signals
(`harness.programs.atlas.law`): the size found nine times out of ten at conditions, and whether
damage of a given size is found.

An answer holds within the range of the computed set-ups in distance, albedo, frames and depth, in
the noise of a pixel over that depth, and in sizes. Where the law reaches nine in ten at no size
inspected, or already at the smallest, only that is said."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from harness.programs.atlas.law import MIDDLE_ALBEDO, Law
from harness.vocabulary.geometry import MM

FOUND = 0.9
"""Probability of detection at a limit."""
UPPER = 0.975
"""Upper end of intervals at 95 %."""
SIZES = 97
"""Sizes at which the law is evaluated; their logarithms are evenly spaced. Twelve times between
the ends, neighbours differ by 2.6 %, and limits are interpolated between them."""
TOLERANCE = 1e-6
SAME_X = 0.05
"""Difference of x that counts as none: 5 % of the noise, which is known no better."""
AXES = {"distance_m": "m", "frames": "", "albedo": "", "depth_mm": "mm"}
"""The axes of a question, and their units."""


class Outside(Exception):
    """A question that the atlas cannot answer; the text gives the reason and the range of possible
    questions."""


@dataclass(frozen=True)
class Conditions:
    """A question's set-up, or a computed one's."""

    distance_m: float
    """Distance from the camera to the target."""
    albedo: float
    """Of the target, at the camera's wavelength."""
    frames: int
    """Number of averaged frames."""
    depth_mm: float
    """Depth of the damage; of through-holes, distance of the surface behind the part."""


@dataclass(frozen=True)
class FailedSetUp:
    """A set-up in which no damage could be judged, as the camera saw too little of the board."""

    distance_m: float
    """Distance of the boards."""
    albedo: float
    """Of the boards."""
    frames: int
    """Number of averaged frames."""

    def is_no_harder(self, conditions: Conditions) -> bool:
        """Return whether it is not farther, not darker and of as many frames as conditions."""
        return (
            self.distance_m <= conditions.distance_m * (1 + TOLERANCE)
            and self.albedo >= conditions.albedo * (1 - TOLERANCE)
            and self.frames >= conditions.frames
        )


@dataclass(frozen=True)
class PlaneNoise:
    """Depth noise of a camera's pixels before an even plane, over distance and albedo."""

    distance_m: tuple[float, ...]
    """(d,): ascending distances."""
    albedo: tuple[float, ...]
    """(a,): ascending albedos."""
    frame_mm: np.ndarray
    """(d, a): temporal deviation of a frame; NaN where too few pixels have a depth."""
    fixed_mm: np.ndarray
    """(d, a): deviation of what no averaging removes; NaN likewise."""

    def at(self, conditions: Conditions) -> tuple[float, float]:
        """Return the noise of an average, millimetres, and the share of its variance that no
        averaging removes; logarithms of the variances are linear in those of distance and albedo.
        Raises Outside where the camera gives no depth."""
        frame = self._between(self.frame_mm**2, conditions) / conditions.frames
        fixed = self._between(self.fixed_mm**2, conditions)
        if not np.isfinite(frame + fixed):
            raise Outside(
                f"distance {conditions.distance_m:g} m, albedo {conditions.albedo:g}: the camera"
                " gives no depth there or nearby (too much light, or too little)"
            )
        return float(np.sqrt(frame + fixed)), fixed / (frame + fixed)

    def _between(self, variances: np.ndarray, conditions: Conditions) -> float:
        """Interpolate variances (d, a) at conditions."""
        rows, row_shares = _neighbours(self.distance_m, conditions.distance_m)
        columns, column_shares = _neighbours(self.albedo, conditions.albedo)
        corners = np.log(np.maximum(variances[np.ix_(rows, columns)], TOLERANCE))
        return float(np.exp(row_shares @ corners @ column_shares))


def _neighbours(nodes: Sequence[float], value: float) -> tuple[list[int], np.ndarray]:
    """Return the nodes around a value and their shares, linear in the logarithm; a single one if
    it stands there."""
    above = int(np.searchsorted(nodes, value * (1 - TOLERANCE)))
    above = min(above, len(nodes) - 1)
    is_node = abs(nodes[above] / value - 1) < 10 * TOLERANCE
    if is_node or above == 0:
        return [above], np.ones(1)
    share = float(np.log(value / nodes[above - 1]) / np.log(nodes[above] / nodes[above - 1]))
    return [above - 1, above], np.array([1 - share, share])


@dataclass(frozen=True)
class Answer:
    """The limit at conditions."""

    sizes_mm: np.ndarray
    """(s,): ascending sizes, as far as they were inspected."""
    middle: np.ndarray
    """(s,): the law's ln(signal / threshold) there, above what is found nine times out of ten."""
    half: np.ndarray
    """(s,): half the width of its 95 % interval."""
    grows: bool
    """Whether larger damage is never harder to find; a wide dent of the same depth is."""
    error: float
    """Deviation of ln(signal / threshold) between the law and a set-up that was left out."""

    @cached_property
    def rank_mm(self) -> float:
        """Key that sorts answers: the size found 90 % of the time, 0 if that is below the sizes
        inspected and infinite if it is above."""
        return self._first(self.middle)

    @property
    def a90_mm(self) -> float:
        """Size found 90 % of the time; NaN if it is not within the sizes inspected."""
        return self.rank_mm if 0 < self.rank_mm < np.inf else np.nan

    @cached_property
    def low_mm(self) -> float:
        """Lower end of its 95 % interval, infinite above the sizes inspected. Below them signals
        fall at least in proportion to the size, as those of an ideal filter do (of what is
        narrower than a pixel, with its square): the end is the smallest that this allows."""
        highest = self.middle + self.half
        if highest[0] >= 0:
            return float(self.sizes_mm[0] * np.exp(-highest[0]))
        return self._first(highest)

    @cached_property
    def high_mm(self) -> float:
        """Upper end of its interval, from which on damage is surely found: the smallest size
        inspected if even that is, infinite above them."""
        return max(self._first(self.middle - self.half), float(self.sizes_mm[0]))

    @property
    def found_mm(self) -> float:
        """The smallest size inspected if even that is surely found, else NaN."""
        smallest_mm = float(self.sizes_mm[0])
        return smallest_mm if self.high_mm == smallest_mm else np.nan

    @property
    def missed_mm(self) -> float:
        """The largest size inspected if the limit surely lies above it, else NaN."""
        return float(self.sizes_mm[-1]) if self.low_mm == np.inf else np.nan

    @cached_property
    def lost_mm(self) -> float:
        """Size above `high_mm` from which on damage is not surely found again; NaN if there is
        none."""
        if not np.isfinite(self.high_mm) or self.grows:
            return np.nan
        is_lost = (self.sizes_mm >= self.high_mm) & (self.middle - self.half < 0)
        return float(self.sizes_mm[is_lost][0]) if is_lost.any() else float(self.sizes_mm[-1])

    @cached_property
    def size_error(self) -> float:
        """The error in terms of the limit: relative deviation of a90 between the law and a set-up
        that was left out; NaN without a limit."""
        if np.isnan(self.a90_mm):
            return np.nan
        slopes = np.gradient(self.middle, np.log(self.sizes_mm))
        slope = float(np.interp(np.log(self.a90_mm), np.log(self.sizes_mm), slopes))
        return self.error / slope if slope > 0 else np.nan

    def verdict(self, size_mm: float) -> str:
        """Return whether damage of this size is found 9 times out of 10: yes, no or undecided."""
        is_larger = size_mm > self.sizes_mm[-1] * (1 + TOLERANCE)
        is_smaller = size_mm < self.sizes_mm[0] * (1 - TOLERANCE)
        if is_larger and not self.grows:
            return "undecided"
        log_size = np.log(size_mm)
        log_sizes = np.log(self.sizes_mm)
        middle = np.interp(log_size, log_sizes, self.middle)
        middle -= max(log_sizes[0] - log_size, 0.0)  # at least so much lower, as in `low_mm`
        half = np.interp(log_size, log_sizes, self.half)
        if middle - half >= 0 and not is_smaller:
            return "yes"
        return "no" if middle + half < 0 and not is_larger else "undecided"

    def _first(self, values: np.ndarray) -> float:
        """Return the smallest size with a value of 0 or more, interpolated; 0 if it is the first,
        infinity if none has."""
        reached = np.flatnonzero(values >= 0)
        if not len(reached):
            return np.inf
        index = int(reached[0])
        if index == 0:
            return 0.0
        share = -values[index - 1] / (values[index] - values[index - 1])
        below_mm = self.sizes_mm[index - 1]
        return float(below_mm * (self.sizes_mm[index] / below_mm) ** share)


@dataclass(frozen=True)
class LimitSurface:
    """Limits of one camera and one kind of damage."""

    camera: str
    """Name of the camera."""
    title: str
    """Its title."""
    kind: str
    """Kind of damage."""
    thickness_mm: float
    """Thickness of the boards, which a through-hole adds to the depth that is seen in it."""
    focal_px: float
    """Focal length, which gives the width of a pixel on the target."""
    noise: PlaneNoise
    """The camera's noise."""
    law: Law
    """The law of its signals."""
    failed: tuple[FailedSetUp, ...]
    """Set-ups in which nothing could be judged."""
    sites: int
    """Number of damages that were inspected."""
    hits: int
    """Number of them that were found."""

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The computed range on each axis."""
        return {axis: self.law.ranges[axis] for axis in AXES}

    def at(self, conditions: Conditions) -> Answer:
        """Return the limit at conditions. Raises Outside beyond the computed range."""
        self._check_inside(conditions)
        for failed in self.failed:
            if failed.is_no_harder(conditions):
                raise Outside(
                    f"at {failed.distance_m:g} m, albedo {failed.albedo:g}, frames"
                    f" {failed.frames}, which is no harder, the camera saw too little of boards"
                )
        noise_mm, fixed_share = self.noise.at(conditions)
        depth_mm = conditions.depth_mm
        if self.kind == "through":
            depth_mm += self.thickness_mm
        x = float(np.log(noise_mm / depth_mm))
        lowest, highest = self.law.ranges["x"]
        if not lowest - SAME_X <= x <= highest + SAME_X:
            raise Outside(
                f"noise of {np.exp(x):.2g} of the depth: the atlas has {np.exp(lowest):.2g} to"
                f" {np.exp(highest):.2g}"
            )
        if np.isnan(self.law.error):
            raise Outside(
                f"{self.hits} of {self.sites} such damages were found in all set-ups, too few or"
                " too many to tell how well a law holds between them"
            )
        pixel_mm = pixel_width_mm(conditions.distance_m, self.focal_px)
        log_sizes = np.linspace(*self.law.ranges["log_size_px"], SIZES)
        others = (
            x,
            float(np.log(pixel_mm)),
            fixed_share,
            float(np.log(conditions.albedo / MIDDLE_ALBEDO)),
        )
        mean, deviation = self.law.signal(log_sizes, others)
        factor = special.stdtrit(self.law.degrees, UPPER)
        return Answer(
            sizes_mm=np.exp(log_sizes) * pixel_mm,
            middle=mean - self.law.scatter * special.ndtri(FOUND),
            half=factor * deviation,
            grows=self.kind != "dent",
            error=self.law.error,
        )

    def _check_inside(self, conditions: Conditions) -> None:
        for axis, (lowest, highest) in self.ranges.items():
            value = getattr(conditions, axis)
            if lowest * (1 - TOLERANCE) <= value <= highest * (1 + TOLERANCE):
                continue
            unit = AXES[axis]
            name = axis.partition("_")[0]
            if (self.kind, axis) == ("through", "depth_mm"):
                name = "backing"
            wanted = f"{name} {value:g} {unit}".rstrip()
            raise Outside(f"{wanted}: the atlas has {lowest:g} to {highest:g} {unit}".rstrip())


def pixel_width_mm(distance_m: float, focal_px: float) -> float:
    """Return the width of a pixel on a target at a distance, millimetres."""
    return distance_m / focal_px / MM
