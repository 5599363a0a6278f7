"""Stored numbers as distances: codes that mean "no return", the depth unit in metres, and its
origin."""

import math
import re
from typing import Any, NamedTuple

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Reason

UNITS_M = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6, "in": 0.0254, "tum": 1 / 5000}
"""Metres in one stored unit; ``tum`` is the scale of the TUM RGB-D benchmark, 5000 to the metre.
"""
LEGAL_UNITS = (
    "mm, cm, m, um, in (inch), tum (5000 to the metre), or N/m for N to the metre (4000/m)"
)
NEAREST_M = 0.05
FARTHEST_M = 20.0
"""Bounds of a plausible median distance: no time-of-flight camera works nearer or sees farther."""
FARTHEST_ASIDE = (
    4.0  # largest ratio of the median point's distance from the axis to its z: 76 degrees
)
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
    is_narrow = dtype.kind in "iu" and dtype.itemsize == 1
    if is_narrow or dtype.kind not in "iuf":
        problem = (
            "8-bit numbers, which is a picture or a mask" if is_narrow else f"{dtype}, not numbers"
        )
        legal = "integers of 16 bits or more, or floating point"
        fix = (
            "export the depth itself, not a preview"
            if is_narrow
            else "save an array of plain numbers"
        )
        raise UserError(f"{name}: holds {problem}", legal=legal, fix=fix)


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
    stored_z = stored[..., 2] if stored.ndim == 3 else stored
    reason = np.zeros(stored_z.shape, np.uint8)
    reason[stored_z == 0] = Reason.NO_RETURN
    if stored_z.dtype.kind == "f":
        reason[~np.isfinite(stored_z)] = Reason.NOT_FINITE
    notes = []
    for code in no_return_codes(stored_z[reason == Reason.VALID]):
        coded = stored_z == code
        reason[coded] = Reason.NO_RETURN
        notes.append(f"{code:.10g} is read as no return, {100 * coded.mean():.2g} % of pixels")
    valid = reason == Reason.VALID
    behind = (stored_z < 0) & valid
    turned = valid.any() and behind.sum() > TURNED_SHARE * valid.sum()
    if turned:
        share = f"z is negative in {100 * behind.sum() / valid.sum():.3g} % of the points"
        notes.append(
            f"{share}: the cloud was turned by 180 degrees about x, to y down and z forward"
        )
        behind = ~behind & valid
    elif behind.sum() > max(
        (0.5 if stored.ndim == 2 else 1 - TURNED_SHARE) * valid.sum(), SHARED_CODE
    ):
        problem = f"{name}: {100 * behind.sum() / valid.sum():.0f} % of the points lie behind the camera (z below 0)"
        fix = "transform the cloud (from y up, z back: negate y and z; from x forward, z up: take -y, -z, x)"
        raise UserError(problem, legal=CAMERA_FRAME, fix=fix)
    reason[behind] = Reason.OUT_OF_RANGE
    xy_m = None
    if stored.ndim == 3:
        reason[~np.isfinite(stored[..., :2]).all(axis=-1) & (reason == Reason.VALID)] = (
            Reason.NOT_FINITE
        )
        xy_m = stored[..., :2].astype(np.float64) * (scale_m, -scale_m if turned else scale_m)
        xy_m[reason != Reason.VALID] = np.nan
    z_m = (stored_z * np.float64(-scale_m if turned else scale_m)).astype(np.float32)
    z_m[reason != Reason.VALID] = np.nan
    return Frame(name, z_m, reason, xy_m=xy_m, rgb=rgb, amplitude=amplitude, notes=tuple(notes))


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
    is_integer = stored.dtype.kind in "iu"
    negative = stored[stored < 0]
    if (
        SHARED_CODE <= negative.size < stored.size
        and (codes_below_zero := np.unique(negative)).size <= 3
    ):
        # a surface's distances differ from pixel to pixel; codes do not
        codes += [float(code) for code in codes_below_zero]
    distances = stored[stored > 0]
    while distances.size:
        top = distances.max().item()
        below = distances[distances < top]
        # 16-bit numbers are often divided by 1000 before they are stored in metres
        is_largest = (
            top == np.iinfo(stored.dtype).max if is_integer else bool(np.isclose(top, 65.535, 1e-6))
        )
        bits = math.log2(top + 3) if top < 2**32 else 0
        below_power = bits >= 11 and top == int(top) and 2 ** int(bits) - top in (0, 1, 2)
        shared = (
            distances.size - below.size >= SHARED_CODE
            and below.size > 0
            and top > 1.25 * below.max()
        )
        if not (is_largest or (below_power and shared)):
            break
        codes.append(float(top))
        distances = below
    # Between neighbours that differ by a factor of four, an octave is empty: most frames need no
    # sorting.
    if (
        distances.size
        and not np.bincount((octaves := np.frexp(distances)[1]) - octaves.min()).all()
    ):
        different = np.unique(distances)
        ratios = different[1:] / different[:-1].astype(np.float64)
        far = np.flatnonzero(ratios >= ISOLATED)
        far = far[(far >= FEW_CODES) & (far >= len(different) - 1 - FEW_CODES)]
        isolated = different[far[0] + 1 :] if far.size else different[:0]
        near_gaps = np.flatnonzero(ratios[:FEW_CODES] >= ISOLATED)
        if is_integer and near_gaps.size and len(different) - near_gaps[-1] - 1 > FEW_CODES:
            isolated = np.concatenate([different[: near_gaps[-1] + 1], isolated])
        codes += [float(code) for code in isolated]
    return tuple(codes)


UNIT_KEYS = (
    "depthscale",
    "depthunits",
    "depthunit",
    "depthfactor",
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
    **{"mm": (0.867, 0.15), "4000/m": (0.08, 0.0), "tum": (0.03, 0.0), "10000/m": (0.015, 0.0)},
    **{"cm": (0.003, 0.04), "um": (0.005, 0.01), "in": (0.0003, 0.01), "m": (0.0, 0.8)},
    # units and how common each is among integers and floating-point numbers: guesses that hardly move
    # a decision
}
NEAR_M = (
    0.8,
    1.8,
)  # middle and spread (a factor) of the usual distances of targets: 95 % are within 0.25 to 2.6 m
NEAR_LIMIT_M = 0.15
FAR_FLOOR = 0.05
"""A distance above the first has at least the second as its share of the most common distance's
weight."""
SURE = 0.98
LIKELY = 0.75
SHOWN = 0.003
"""Probabilities: no warning from the first on; below the second, the user must decide; below the
third, not listed."""
MILLIMETRE_SIZES = {
    **{
        (640, 576): 4.5,
        (320, 288): 6.0,
        (512, 512): 3.5,
        (1024, 1024): 3.0,
        (512, 424): 8.0,
        (256, 192): 8.0,
    }
    # image sizes of cameras that all store 1 mm and the median distance in metres that they can reach
}
QUARTER_SIZES = {(1024, 768): 20.0, (640, 480): 2.0, (1280, 720): 2.0, (1920, 1080): 2.0}
"""Image sizes of cameras with 0.25 mm (L515, Helios; colour to which the L515 is aligned), and
their added weight."""


class Unit(NamedTuple):
    """Metres in one stored number, and the ``origin`` of this unit. ``warning``: a reason for
    doubt, else ""."""

    scale_m: float
    origin: str
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
        if counted is None or counted.group(2).rstrip("s") not in ("", *UNIT_NAMES):
            continue
        try:
            number = float(counted.group(1) or 1.0)
        except ValueError:
            continue
        unit_m = UNIT_NAMES.get(counted.group(2).rstrip("s"))
        scales = (
            [number * unit_m]
            if unit_m
            else [number, number * 1e-3, 1.0 / number if number else 0.0]
        )
        fitting = {scale for scale in scales if 0.1 <= median * scale <= 10.0}
        if len(fitting) == 1:
            return fitting.pop()
    return None


def decided_unit(name: str, stored: np.ndarray, usual_m: float, size: tuple[int, int]) -> Unit:
    """Return the unit of numbers (n,) if nothing states it. ``size``: width and height of the
    image.

    Each of `READINGS` is weighted by how common it is and by the distance that it gives the
    nearest tenth of the points, which usually holds the target (`NEAR_M`). A common divisor of all
    numbers supports the unit in which they are whole millimetres. Image sizes that only cameras
    with 1 mm have support that unit (`MILLIMETRE_SIZES`), and exclude it beyond their range.
    Raises UserError if no reading is clearly the most likely, with their distances."""
    foreground, median = (
        float(q) for q in np.quantile(stored[:: max(1, stored.size // 50_000)], (0.1, 0.5))
    )
    integers = usual_m == UNITS_M["mm"]
    divisor = int(np.gcd.reduce(stored.astype(np.int64))) if integers else 1
    reach_m = MILLIMETRE_SIZES.get(size) if integers else None
    weights = {}
    for unit, commonness in READINGS.items():
        metres = metres_per_unit(unit)
        weight = commonness[0 if integers else 1]
        if reach_m is not None and unit == "mm":
            weight = 0.0 if median * metres > reach_m else 10 * weight
        if integers and unit == "4000/m":
            weight *= QUARTER_SIZES.get(size, 1.0)
        if divisor > 1 and round(1e-3 / metres) == divisor:
            weight *= 100.0
        if not NEAREST_M <= median * metres <= FARTHEST_M:
            weight = 0.0
        off = math.log(max(foreground * metres, 1e-9) / NEAR_M[0]) / math.log(NEAR_M[1])
        weights[unit] = weight * (
            math.exp(-0.5 * off * off) + FAR_FLOOR * (foreground * metres > NEAR_LIMIT_M)
        )
    total = sum(weights.values())
    chances = {unit: weight / total if total > 0 else 0.0 for unit, weight in weights.items()}
    ranked = sorted(chances, key=lambda unit: -chances[unit])
    shown = [
        f"--unit {unit} ({median * metres_per_unit(unit):.3g} m)"
        for unit in ranked
        if chances[unit] > SHOWN
    ]
    best = ranked[0]
    if chances[best] < LIKELY:
        problem = "several units are plausible" if shown else "no usual unit is plausible"
        problem = f"{name}: nothing states the unit of its depth, and {problem} (median stored number {median:.5g})"
        fix = (
            f"pass the unit; median distance in each: {', '.join(shown)}"
            if shown
            else f"--unit: {LEGAL_UNITS}"
        )
        raise UserError(problem, fix=fix)
    scale_m = metres_per_unit(best)
    usual = f"what is usual for {'integers' if integers else 'floating-point numbers'}"
    if math.isclose(scale_m, usual_m):
        if chances[best] >= SURE:
            return Unit(scale_m, usual)
    else:
        usual = f"the data: with {usual}, {1e3 * usual_m:g} mm, the median distance would be {median * usual_m:.4g} m"
    also = f"; others are possible: {', '.join(shown[1:])}" if len(shown) > 1 else ""
    taken = (
        f"{1e3 * scale_m:.4g} mm is taken, which puts the median at {median * scale_m:.3g} m{also}"
    )
    return Unit(
        scale_m, usual, f"nothing states the depth unit; {taken}; state it with --unit {best}"
    )


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
    """Raise UserError if the median distance of a frame with a valid pixel indicates a wrong unit."""
    valid = frame.z_m[np.isfinite(frame.z_m)]
    median_m = float(np.median(valid[:: max(1, valid.size // 50_000)]))
    if NEAREST_M <= median_m <= FARTHEST_M:
        return
    in_each = {unit: median_m / scale_m * metres for unit, metres in UNITS_M.items()}
    fitting = [
        f"--unit {unit} (then {m:.3g} m)"
        for unit, m in in_each.items()
        if NEAREST_M <= m <= FARTHEST_M
    ]
    problem = (
        f"{frame.name}: the median distance would be {median_m:.4g} m, which suggests a wrong unit"
    )
    fix = (
        "pass " + " or ".join(fitting) if fitting else f"state the unit with --unit: {LEGAL_UNITS}"
    )
    raise UserError(
        problem, legal=f"a median between {NEAREST_M:g} m and {FARTHEST_M:g} m", fix=fix
    )


def refuse_far_aside(frame: Frame) -> None:
    """Raise UserError if half of the points are farther off the axis than in any camera's picture."""
    across_m = np.zeros(1) if frame.xy_m is None else np.hypot(*np.moveaxis(frame.xy_m, -1, 0))
    if (aside := float(np.nanmedian(across_m / frame.z_m))) > FARTHEST_ASIDE:
        problem = f"{frame.name}: half of the points lie more than {math.degrees(math.atan(aside)):.0f} degrees"
        problem += " off the camera's axis: the cloud is in another frame, or z has another unit than x and y"
        raise UserError(
            problem,
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
        bends = [_bend(inverse), _bend(inverse * np.sqrt(1.0 + (slopes**2).sum(axis=-1)))]
    if not bends[0] > RAYS_TELL * bends[1]:
        return ""
    problem = f"the numbers look like lengths along the rays, not z: as lengths, surfaces are {bends[0] / bends[1]:.0f}"
    return f"{problem} times as flat. Places and sizes are then wrong: store z, the length times the ray's cosine"


def _bend(image: np.ndarray) -> float:
    far = [(values, max(len(values) // 8, 1)) for values in (image, image.T)]
    bends = [values[2 * n :] - 2 * values[n:-n] + values[: -2 * n] for values, n in far]
    sizes = np.abs(np.concatenate([bend[np.isfinite(bend)] for bend in bends]))
    return float(np.median(sizes)) if sizes.size else math.nan
