"""Stored numbers as distances: codes that mean "no return", the depth unit in metres, and its
origin."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Reason

UNITS_M = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6, "in": 0.0254, "tum": 1 / 5000}
"""Metres in one stored unit; ``tum`` is that of the TUM RGB-D benchmark, 5000 to the metre."""
LEGAL_UNITS = (
    "mm, cm, m, um, in (inch), tum (5000 to the metre), or N/m for N to the metre (4000/m)"
)
NEAREST_M = 0.05
FARTHEST_M = 20.0
"""Bounds of a plausible median distance: no time-of-flight camera works nearer or sees farther."""
FARTHEST_ASIDE = 4.0
"""Largest ratio of the median point's distance from the axis to its z: 76 degrees."""
LARGEST_M = 1e7
"""Largest number, as metres, that is a distance in any unit; larger ones overflow later."""
SIDEMOST = 20.0
"""The same ratio for a single point: no lens sees 87 degrees aside, and few such points would
stretch the picture until it does not fit into memory."""
RAYS_TELL = 3.0
"""Ratio of bends that distinguishes lengths along rays from z: real captures' z has 0.1 to 0.5, a
pipe's up to 2."""
COMMON_STEPS_M = (1e-3, 2.5e-4, 2e-4, 1e-4)
"""Rounding steps that cameras store: 1 mm (Kinects), 0.25 mm (L515), 0.2 mm (TUM), 0.1 mm."""
CAMERA_FRAME = "the camera's frame: x right, y down, z forward from the lens"
TURNED_SHARE = 0.99
"""Least share of points with z below 0 for which the cloud is turned: no camera measures behind
itself."""


def metres_per_unit(unit: str) -> float:
    """Return metres in one stored unit. Raises UserError for an unknown unit."""
    if unit in UNITS_M:
        return UNITS_M[unit]
    counted = re.fullmatch(r"(\d+(?:\.\d+)?)/m", unit)
    if counted and float(counted.group(1)) > 0:
        return 1.0 / float(counted.group(1))
    raise UserError(f"--unit {unit}: no such unit", legal=LEGAL_UNITS)


def default_metres(dtype: np.dtype) -> float:
    """Return the usual unit of stored numbers: millimetres for integers, metres for floating
    point."""
    return UNITS_M["mm"] if dtype.kind in "iu" else UNITS_M["m"]


def refuse_narrow(name: str, dtype: np.dtype) -> None:
    """Raise UserError if the numbers cannot be distances: 8 bit, boolean, complex, text or
    objects."""
    legal = "integers of 16 bits or more, or floating point"
    if dtype.kind not in "iuf":
        fix = "save an array of plain numbers"
        raise UserError(f"{name}: holds {dtype}, not numbers", legal=legal, fix=fix)
    if dtype.kind in "iu" and dtype.itemsize == 1:
        problem = f"{name}: holds 8-bit numbers, which is a picture or a mask"
        fix = "export the depth itself, not a preview"
        raise UserError(problem, legal=legal, fix=fix)


def frame_of(
    name: str,
    stored: np.ndarray,
    scale_m: float,
    rgb: np.ndarray | None = None,
    amplitude: np.ndarray | None = None,
) -> Frame:
    """Convert stored depth (h, w) or points (h, w, 3) in units of ``scale_m`` metres to a frame. 0
    and `no_return_codes` mean no return. Depth that is negative throughout is turned. Raises
    UserError if most, not all, is negative."""
    is_depth = stored.ndim == 2
    stored_z = stored if is_depth else stored[..., 2]
    reason = np.zeros(stored_z.shape, np.uint8)
    reason[stored_z == 0] = Reason.NO_RETURN
    if stored_z.dtype.kind == "f":
        reason[~np.isfinite(stored_z)] = Reason.NOT_FINITE
    notes = []
    for code in no_return_codes(stored_z[reason == Reason.VALID]):
        is_code = stored_z == code
        reason[is_code] = Reason.NO_RETURN
        notes.append(f"{code:.10g} is read as no return, {100 * is_code.mean():.2g} % of pixels")
    is_beyond = _is_beyond(stored, scale_m) & (reason == Reason.VALID)
    if not is_depth:
        is_beyond &= np.isfinite(stored[..., :2]).all(axis=-1)
    if is_beyond.any():
        reason[is_beyond] = Reason.OUT_OF_RANGE
        share = f"{100 * is_beyond.mean():.2g} % of pixels"
        notes.append(f"numbers that are no place before a camera are left out, {share}")
    valid = reason == Reason.VALID
    behind = (stored_z < 0) & valid
    behind_count = behind.sum()
    valid_count = valid.sum()
    # depth has no points behind the lens that a transformation would explain
    tolerated = (0.5 if is_depth else 1 - TURNED_SHARE) * valid_count
    turned = valid.any() and behind_count > TURNED_SHARE * valid_count
    if turned:
        notes.append(
            f"z is negative in {100 * behind_count / valid_count:.3g} % of the points: the cloud "
            "was turned by 180 degrees about x, to y down and z forward"
        )
        behind = ~behind & valid
    elif behind_count > max(tolerated, SHARED_CODE):
        raise UserError(
            f"{name}: {100 * behind_count / valid_count:.0f} % of the points lie behind the "
            "camera (z below 0)",
            legal=CAMERA_FRAME,
            fix="transform the cloud (from y up, z back: negate y and z; "
            "from x forward, z up: take -y, -z, x)",
        )
    reason[behind] = Reason.OUT_OF_RANGE
    signed_m = -scale_m if turned else scale_m
    xy_m = None
    if not is_depth:
        is_finite = np.isfinite(stored[..., :2]).all(axis=-1)
        reason[~is_finite & (reason == Reason.VALID)] = Reason.NOT_FINITE
        xy_m = stored[..., :2].astype(np.float64) * (scale_m, signed_m)
        xy_m[reason != Reason.VALID] = np.nan
    z_m = (stored_z * np.float64(signed_m)).astype(np.float32)
    z_m[reason != Reason.VALID] = np.nan
    return Frame(
        name=name,
        z_m=z_m,
        reason=reason,
        xy_m=xy_m,
        rgb=rgb,
        amplitude=amplitude,
        notes=tuple(notes),
    )


def _is_beyond(stored: np.ndarray, scale_m: float) -> np.ndarray:
    """Return where depth (h, w) or points (h, w, 3) are too large for a distance, or too far aside
    for any lens."""
    with np.errstate(invalid="ignore", over="ignore"):
        if stored.ndim == 2:
            return np.abs(stored.astype(np.float64)) > LARGEST_M / scale_m
        points = np.abs(stored.astype(np.float64))
        across = np.hypot(points[..., 0], points[..., 1])
        is_large = (points > LARGEST_M / scale_m).any(axis=-1)
        is_aside = across > SIDEMOST * points[..., 2]
    # where most are aside, the cloud is in another frame, which `refuse_far_aside` says
    judged = is_aside[np.isfinite(across) & (points[..., 2] > 0)]
    is_other_frame = judged.size > 0 and judged.mean() > 0.5
    return np.asarray(is_large if is_other_frame else is_large | is_aside)


SHARED_CODE = 20  # pixels that must share a number before it can be a full scale
ISOLATED = 4.0
"""Factor between codes and all distances: a wall four times as far as the rest has more than a few
distances."""
FEW_CODES = 8


def no_return_codes(stored: np.ndarray) -> tuple[float, ...]:
    """Return the numbers among ``stored`` (n,), finite and not 0, that cannot be distances: they
    mean "no return". Four kinds: the largest number of the type (in metres, 65.535); a full scale
    of fewer bits (4095, 65534 ..) that many pixels share, well beyond all others; at most
    `FEW_CODES` different numbers that are `ISOLATED` times farther than all others or, for
    integers, nearer; at most three negative numbers. Codes amid distances are not found."""
    codes: list[float] = []
    negative = stored[stored < 0]
    if SHARED_CODE <= negative.size < stored.size:
        different = np.unique(negative)
        # a surface's distances differ from pixel to pixel; codes do not
        if different.size <= 3:
            codes += [float(code) for code in different]
    distances = stored[stored > 0]
    while distances.size:
        top = distances.max().item()
        nearer = distances[distances < top]
        count = distances.size - nearer.size
        is_shared = count >= SHARED_CODE and nearer.size > 0 and top > 1.25 * nearer.max()
        if not _is_largest(top, stored.dtype) and not (is_shared and _is_full_scale(top)):
            break
        codes.append(float(top))
        distances = nearer
    codes += [float(code) for code in _isolated(distances)]
    return tuple(codes)


def _is_largest(number: float, dtype: np.dtype) -> bool:
    """Return whether a number is its type's largest, in metres for floating point: 16-bit numbers
    are often divided by 1000 before they are stored in metres."""
    if dtype.kind in "iu":
        return bool(number == np.iinfo(dtype).max)
    return bool(np.isclose(number, 65.535, 1e-6))


def _is_full_scale(number: float) -> bool:
    """Return whether a number is a power of two of 11 bits or more, or one or two below it."""
    bits = math.log2(number + 3) if number < 2**32 else 0
    return bits >= 11 and number == int(number) and 2 ** int(bits) - number in (0, 1, 2)


def _isolated(distances: np.ndarray) -> np.ndarray:
    """Return the few different numbers among distances (n,) that are `ISOLATED` times farther than
    all others or, for integers, nearer."""
    # Between neighbours that differ by a factor of four, an octave is empty: most frames need no
    # sorting.
    octaves = np.frexp(distances)[1]
    if not distances.size or np.bincount(octaves - octaves.min()).all():
        return distances[:0]
    different = np.unique(distances)
    ratios = different[1:] / different[:-1].astype(np.float64)
    gaps = np.flatnonzero(ratios >= ISOLATED)
    far = gaps[(gaps >= FEW_CODES) & (gaps >= len(different) - 1 - FEW_CODES)]
    isolated = different[far[0] + 1 :] if far.size else different[:0]
    near_gaps = gaps[gaps < FEW_CODES]
    is_integer = distances.dtype.kind in "iu"
    if is_integer and near_gaps.size and len(different) - near_gaps[-1] - 1 > FEW_CODES:
        isolated = np.concatenate([different[: near_gaps[-1] + 1], isolated])
    return isolated


UNIT_KEYS = (
    "depthscale",
    "depthunits",
    "depthunit",
    "depthfactor",
    "factordepth",
    "depthmapfactor",
    "pngdepthscale",
    "zunits",
)
UNIT_NAMES = {
    "mm": 1e-3,
    "millimeter": 1e-3,
    "millimetre": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "meter": 1.0,
    "metre": 1.0,
}
READINGS = {
    "mm": (0.867, 0.15),
    "4000/m": (0.08, 0.0),
    "tum": (0.03, 0.0),
    "10000/m": (0.015, 0.0),
    "cm": (0.003, 0.04),
    "um": (0.005, 0.01),
    "in": (0.0003, 0.01),
    "m": (0.0, 0.8),
}
"""Units and how common each is among integers and among floating-point numbers: guesses that
hardly move a decision."""
USUAL_M = 0.8
USUAL_FACTOR = 1.8
"""Middle and spread (a factor) of the usual distances of targets: 95 % are within 0.25 to 2.6 m."""
NEAR_LIMIT_M = 0.15
FAR_FLOOR = 0.05
"""A distance above `NEAR_LIMIT_M` has at least this share of the most common distance's weight."""
SURE = 0.98  # probability from which there is no warning
LIKELY = 0.75  # probability below which the user must decide
SHOWN = 0.003
"""Probability below which a unit is not listed."""
MILLIMETRE_SIZES = {
    (640, 576): 4.5,
    (320, 288): 6.0,
    (512, 512): 3.5,
    (1024, 1024): 3.0,
    (512, 424): 8.0,
    (256, 192): 8.0,
}
"""Image sizes of cameras that all store 1 mm, and the median distance, metres, that they reach."""
QUARTER_SIZES = {(1024, 768): 20.0, (640, 480): 2.0, (1280, 720): 2.0, (1920, 1080): 2.0}
"""Image sizes of cameras with 0.25 mm (L515, Helios; colour to which the L515 is aligned), and
their added weight."""


class Unit(NamedTuple):
    """The unit of stored distances."""

    # metres in one stored number
    scale_m: float
    # what states or suggests it
    origin: str
    # a reason for doubt, else ""
    warning: str = ""


def scale_in(statements: dict[str, Any], median: float) -> float | None:
    """Return metres in one stored number if names with values state it, else None. Values are
    metres (RealSense: 0.001), millimetres (BOP: 0.1), numbers to the metre (Open3D: 1000) or a
    unit's name. They differ by powers of 1000, so the ``median`` stored number decides between
    them."""
    for key, value in statements.items():
        if re.sub("[^a-z]", "", str(key).lower()) not in UNIT_KEYS:
            continue
        counted = re.fullmatch(r"\s*([\d.eE+-]*)\s*([a-z]*)\s*", str(value))
        if counted is None:
            continue
        unit = counted.group(2).rstrip("s")
        if unit not in ("", *UNIT_NAMES):
            continue
        try:
            number = float(counted.group(1) or 1.0)
        except ValueError:
            continue
        if unit:
            scales = [number * UNIT_NAMES[unit]]
        else:
            scales = [number, number * 1e-3, 1.0 / number if number else 0.0]
        fitting = {scale for scale in scales if 0.1 <= median * scale <= 10.0}
        if len(fitting) == 1:
            return fitting.pop()
    return None


def decided_unit(name: str, stored: np.ndarray, usual_m: float, size: tuple[int, int]) -> Unit:
    """Return the unit of numbers (n,) if nothing states it. ``size``: width and height of the
    image. Floating-point numbers count as integers if they are all whole, and too large for metres.

    Each of `READINGS` is weighted by how common it is and by the distance that it gives the
    nearest tenth of the points, which usually holds the target (`USUAL_M`). A common divisor of
    all numbers supports the unit in which they are whole millimetres. Image sizes that only
    cameras with 1 mm have support that unit (`MILLIMETRE_SIZES`), and exclude it beyond their
    range. Raises UserError if no reading is clearly the most likely, with their distances."""
    sample = stored[:: max(1, stored.size // 50_000)]
    foreground = float(np.quantile(sample, 0.1))
    median = float(np.quantile(sample, 0.5))
    is_whole = bool((stored == np.rint(stored)).all())
    integers = usual_m == UNITS_M["mm"] or (is_whole and median > FARTHEST_M)
    if integers:
        usual_m = UNITS_M["mm"]
    divisor = int(np.gcd.reduce(stored.astype(np.int64))) if integers else 1
    weights = {}
    for unit in READINGS:
        weights[unit] = _weight(unit, foreground, median, size if integers else None, divisor)
    total = sum(weights.values())
    chances = {unit: weight / total if total > 0 else 0.0 for unit, weight in weights.items()}
    ranked = sorted(chances, key=lambda unit: -chances[unit])
    shown = []
    for unit in ranked:
        if chances[unit] > SHOWN:
            shown.append(f"--unit {unit} ({median * metres_per_unit(unit):.3g} m)")
    best = ranked[0]
    if chances[best] < LIKELY:
        doubt = "no usual unit is plausible"
        fix = f"--unit: {LEGAL_UNITS}"
        if shown:
            doubt = "several units are plausible"
            fix = f"pass the unit; median distance in each: {', '.join(shown)}"
        problem = (
            f"{name}: nothing states the unit of its depth, and {doubt} "
            f"(median stored number {median:.5g})"
        )
        raise UserError(problem, fix=fix)
    scale_m = metres_per_unit(best)
    origin = f"what is usual for {'integers' if integers else 'floating-point numbers'}"
    if not math.isclose(scale_m, usual_m):
        origin = (
            f"the data: with {origin}, {1e3 * usual_m:g} mm, "
            f"the median distance would be {median * usual_m:.4g} m"
        )
    elif chances[best] >= SURE:
        return Unit(scale_m, origin)
    also = f"; others are possible: {', '.join(shown[1:])}" if len(shown) > 1 else ""
    warning = (
        f"nothing states the depth unit; {1e3 * scale_m:.4g} mm is taken, "
        f"which puts the median at {median * scale_m:.3g} m{also}; state it with --unit {best}"
    )
    return Unit(scale_m, origin, warning)


def _weight(
    unit: str,
    foreground: float,
    median: float,
    size: tuple[int, int] | None,
    divisor: int,
) -> float:
    """Return the weight of a reading. ``foreground``, ``median``: quantiles of the stored numbers.
    ``size``: of an image of integers, None for floating point. ``divisor``: of all numbers."""
    metres = metres_per_unit(unit)
    among_integers, among_floats = READINGS[unit]
    weight = among_floats if size is None else among_integers
    if size in MILLIMETRE_SIZES and unit == "mm":
        weight = 0.0 if median * metres > MILLIMETRE_SIZES[size] else 10 * weight
    if size in QUARTER_SIZES and unit == "4000/m":
        weight *= QUARTER_SIZES[size]
    if divisor > 1 and round(1e-3 / metres) == divisor:
        weight *= 100.0
    if not NEAREST_M <= median * metres <= FARTHEST_M:
        weight = 0.0
    off = math.log(max(foreground * metres, 1e-9) / USUAL_M) / math.log(USUAL_FACTOR)
    floor = FAR_FLOOR * (foreground * metres > NEAR_LIMIT_M)
    return weight * (math.exp(-0.5 * off * off) + floor)


def rounding_step_m(z_m: np.ndarray) -> float:
    """Return the coarsest common rounding step of which all valid distances are multiples; 0 if
    there is none."""
    values = z_m[np.isfinite(z_m)].astype(np.float64)
    for step_m in COMMON_STEPS_M:
        turns = values / step_m
        # 0.02 steps: float32 metres hold 20 m to 1 um, a hundredth of the finest step.
        if values.size and np.abs(turns - np.rint(turns)).max() < 0.02:
            return step_m
    return 0.0


def refuse_implausible(frame: Frame, scale_m: float) -> None:
    """Raise UserError if the median distance of a frame with a valid pixel shows a wrong unit."""
    valid = frame.z_m[np.isfinite(frame.z_m)]
    median_m = float(np.median(valid[:: max(1, valid.size // 50_000)]))
    if NEAREST_M <= median_m <= FARTHEST_M:
        return
    fitting = []
    for unit, metres in UNITS_M.items():
        by_unit_m = median_m / scale_m * metres
        if NEAREST_M <= by_unit_m <= FARTHEST_M:
            fitting.append(f"--unit {unit} (then {by_unit_m:.3g} m)")
    fix = f"state the unit with --unit: {LEGAL_UNITS}"
    if fitting:
        fix = "pass " + " or ".join(fitting)
    raise UserError(
        (
            f"{frame.name}: the median distance would be {median_m:.4g} m, which suggests a "
            "wrong unit"
        ),
        legal=f"a median between {NEAREST_M:g} m and {FARTHEST_M:g} m",
        fix=fix,
    )


def refuse_far_aside(frame: Frame) -> None:
    """Raise UserError if half of the points are farther off the axis than any camera sees."""
    if frame.xy_m is None:
        return
    across_m = np.hypot(frame.xy_m[..., 0], frame.xy_m[..., 1])
    slope = float(np.nanmedian(across_m / frame.z_m))
    if slope > FARTHEST_ASIDE:
        raise UserError(
            f"{frame.name}: half of the points lie more than "
            f"{math.degrees(math.atan(slope)):.0f} degrees off the camera's axis: "
            "the cloud is in another frame, or z has another unit than x and y",
            legal=CAMERA_FRAME,
            fix="move the cloud into the frame of the camera that took it",
        )


def ray_lengths_doubt(z_m: np.ndarray, slopes: np.ndarray) -> str:
    """Return a sentence if ``z_m`` (h, w) looks like lengths along the rays of ``slopes`` (h, w,
    2), else "".

    For a plane, 1/z is a plane over the slopes, so its bends over an eighth of the picture are
    only noise. If z is a length along the ray, that holds for 1/z times the ray's length at z = 1.
    """
    with np.errstate(invalid="ignore"):
        inverse = 1.0 / z_m.astype(np.float64)
        as_z = _bend(inverse)
        as_length = _bend(inverse * np.sqrt(1.0 + (slopes**2).sum(axis=-1)))
    if not as_z > RAYS_TELL * as_length:
        return ""
    return (
        "the numbers look like lengths along the rays, not z: as lengths, surfaces are "
        f"{as_z / as_length:.0f} times as flat. Places and sizes are then wrong: "
        "store z, the length times the ray's cosine"
    )


def _bend(image: np.ndarray) -> float:
    """Return the median size of second differences over an eighth of an image, NaN without any."""
    bends = []
    for values in (image, image.T):
        step = max(len(values) // 8, 1)
        bend = values[2 * step :] - 2 * values[step:-step] + values[: -2 * step]
        bends.append(bend[np.isfinite(bend)])
    sizes = np.abs(np.concatenate(bends))
    return float(np.median(sizes)) if sizes.size else math.nan
