"""Checks of the contract of detectors, for the tests of a plug-in's author.

    from harness.testing import check_detector
    from acme.detector import AcmeDetector


    def test_my_detector_keeps_the_contract():
        check_detector(AcmeDetector, settings={"window_px": 7})

Every check is a separate function, listed in `CHECKS`."""

from __future__ import annotations

import inspect
import io
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np

from detectors.interface import Calibratable, Detection, Detector, Evidence, Measurement
from harness.testing.synthetic_clouds import plane, synthetic_clouds, with_gaps, without
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Lens, MapViews, Region, transform_points


def check_detector(
    make: Callable[[], Detector] | type,
    *,
    settings: Mapping[str, Any] | None = None,
    clouds: Sequence[Cloud] | None = None,
) -> None:
    """Run every check on every cloud. Raises AssertionError if the contract of
    `detectors.interface` is broken, and passes on the detector's own exceptions, with a note that
    names the check. ``make`` is a detector's class, whose ``settings_type`` validates ``settings``
    (plain data as in YAML), or a function that makes a new detector at each call. ``clouds`` are
    by default the three of `harness.testing.synthetic_clouds`, 0.7 m from the camera, each with
    damage of centimetres, some of which must be found at some threshold. Use a study to measure
    how good a detector is."""
    settings_type = getattr(make, "settings_type", None)
    build = cast("Callable[..., Detector]", make)
    if settings_type is None and settings is not None:
        raise TypeError(
            "`settings` belong to a detector's class with a `settings_type`, not to a function"
        )

    def made() -> Detector:
        return (
            build()
            if settings_type is None
            else build(settings_type.from_data(dict(settings or {})))
        )

    tried = tuple(synthetic_clouds() if clouds is None else clouds)
    for check in CHECKS:
        try:
            for cloud in tried:
                check(made, cloud)
        except Exception as error:
            error.add_note(f"in {check.__name__}: {inspect.getdoc(check)}")
            raise
    detector = made()
    loud = any(detector.quiet_threshold(cloud, detector.analyse(cloud)) > 0 for cloud in tried)
    require(
        loud,
        ("nothing was found on any cloud at any threshold, so that hardly anything was checked"),
    )


STRONGEST = 5  # findings of a cloud that are checked individually
# distance outside the cloud's extent up to which the centre of a finding may lie
CENTRE_MARGIN_M = 0.02
# share of the highest score: robust fits stop early, and the order of sums affects rounding
SCORE_TOLERANCE = 0.01
CROP_TOLERANCE = 0.01  # share of the pixels: a crop may decide differently at the target's rim
PLACE_TOLERANCE_M = 1e-4
SHIFT_M = 0.037
QUARTER_TURN = np.array([[0.0, 1.0, 0, 0], [-1.0, 0.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
"""T_turned_cloud of `numpy.rot90`, for an image with x right and y down."""

Make = Callable[[], Detector]
T = TypeVar("T")


def require(kept: bool | np.bool_, message: str) -> None:
    """Raise AssertionError unless this part of the contract is kept; unlike assert, it also works
    with python -O."""
    if not kept:
        raise AssertionError(message)


@dataclass(frozen=True)
class Look:
    """A detector's evidence on a cloud."""

    detector: Detector
    cloud: Cloud
    evidence: Evidence

    @classmethod
    def at(cls, detector: Detector, cloud: Cloud) -> Look:
        """Analyse a cloud that can be judged."""
        return cls(detector, cloud, detector.analyse(cloud))

    @property
    def quiet(self) -> float:
        """The quiet threshold."""
        return float(self.detector.quiet_threshold(self.cloud, self.evidence))

    def find(self, threshold: float) -> tuple[Detection, ...]:
        """Return the findings above a threshold."""
        return tuple(self.detector.find(self.cloud, self.evidence, threshold))

    def thresholds(self) -> tuple[float, ...]:
        """Return ascending thresholds from 0 to the quiet threshold, at the scores of pixels,
        where findings change."""
        scores = self.evidence.score[np.isfinite(self.evidence.score)]
        quiet = self.quiet
        high = np.quantile(scores, [0.5, 0.9, 0.99, 0.999]).tolist() if len(scores) else []
        steps = {0.0, *high, *(share * quiet for share in (0.25, 0.5, 0.75, 0.95))}
        return tuple(sorted(step for step in steps if 0.0 <= step < quiet))

    def measured(self, finding: Detection) -> Measurement:
        """Measure a finding, and check that the numbers are valid."""
        measurement = self.detector.measure(self.cloud, self.evidence, finding)
        diameter = measurement.extent_diameter_m
        centre = np.asarray(measurement.extent_centre_m)
        require(np.isfinite(diameter) and diameter >= 0, f"`extent_diameter_m` is {diameter:g}")
        require(
            centre.shape == (3,) and np.isfinite(centre).all(),
            "`extent_centre_m` is not 3 finite numbers",
        )
        require(
            measurement.score == finding.score,
            f"`measure` gives score {measurement.score:g}, the finding {finding.score:g}",
        )
        require(measurement.points >= 1, f"`measure` gives {measurement.points} points")
        return measurement

    def everything(self) -> tuple[Any, ...]:
        """Return all results of a detector on a cloud."""
        quiet = self.quiet
        findings = self.find(quiet / 2)
        return (
            self.evidence,
            quiet,
            findings,
            [self.measured(finding) for finding in findings[:STRONGEST]],
        )


def declares_itself(make: Make, cloud: Cloud) -> None:
    """Check the name, the version (at least 1), and the settings: a Config with legal defaults
    that can be stored."""
    detector = make()
    require(isinstance(detector.name, str) and detector.name != "", "`name` is not a text")
    version = detector.version
    require(
        type(version) is int and version >= 1,
        f"`version` is {version!r}: it must be a whole number, 1 or more",
    )
    settings_type: Any = getattr(type(detector), "settings_type", None)
    is_config = isinstance(settings_type, type) and issubclass(settings_type, Config)
    require(
        is_config, "the class has no `settings_type` that is a harness.vocabulary.config.Config"
    )
    settings = settings_type()
    restored = settings_type.from_data(settings.to_data())
    require(restored == settings, "settings that are stored and read again are not the same")


def gives_sound_evidence(make: Make, cloud: Cloud) -> None:
    """Check that images have the cloud's size, that only points have scores, some finite, and that
    the scale is > 0."""
    _sound(Look.at(make(), cloud))


def gives_the_same_twice(make: Make, cloud: Cloud) -> None:
    """Check that the same cloud gives the same bits: again, after another cloud, and with a new
    detector."""
    detector = make()
    first = Look.at(detector, cloud).everything()
    require(
        _same(first, Look.at(detector, cloud).everything()),
        "the same cloud gave another result the second time",
    )
    Look.at(detector, with_gaps(cloud, seed=9)).everything()
    again = Look.at(detector, cloud).everything()
    require(_same(first, again), "the same cloud gave another result after another cloud")
    require(_same(first, Look.at(make(), cloud).everything()), "a new detector gave another result")


def keeps_its_input(make: Make, cloud: Cloud) -> None:
    """Check that the detector never writes to the cloud or the evidence, not even temporarily."""
    original = _with_arrays(cloud, np.ndarray.copy)
    look = Look.at(make(), original)
    require(_same(original, cloud), "`analyse` changed the cloud that it was given")
    kept = _with_arrays(look.evidence, np.ndarray.copy)
    look.everything()
    require(_same(original, cloud), "`find`, `quiet_threshold` or `measure` changed the cloud")
    require(
        _same(look.evidence, kept), "`find`, `quiet_threshold` or `measure` changed the evidence"
    )
    protected = Look.at(make(), _with_arrays(cloud, _read_only))
    replace(protected, evidence=_with_arrays(protected.evidence, _read_only)).everything()


def orders_findings_by_score(make: Make, cloud: Cloud) -> None:
    """Check that findings are sorted by score, exceed the threshold, and vanish at a threshold
    equal to their score."""
    look = Look.at(make(), cloud)
    for threshold in look.thresholds():
        findings = look.find(threshold)
        scores = np.array([finding.score for finding in findings], dtype=float)
        require(
            np.isfinite(scores).all(),
            f"at a threshold of {threshold:g} a finding's score is not finite",
        )
        low = float(scores.min(initial=np.inf))
        require(
            low > threshold,
            f"a finding scores {low:g}, no more than the threshold of {threshold:g}",
        )
        require(
            (np.diff(scores) <= 0).all(),
            f"at a threshold of {threshold:g} the strongest finding is not first",
        )
        for finding in findings[:STRONGEST]:
            gone = look.find(finding.score)
            kept = look.find(float(np.nextafter(finding.score, 0.0)))
            require(
                not np.isin(finding.pixels, _pixels_of(gone)).any()
                and np.isin(finding.pixels, _pixels_of(kept)).any(),
                (
                    f"a finding scores {finding.score:g}, but that is not the threshold at "
                    "which it vanishes"
                ),
            )


def is_silent_at_the_quiet_threshold(make: Make, cloud: Cloud) -> None:
    """Check that the quiet threshold is the strongest finding's score (0 for none): silent there,
    but not below it."""
    look = Look.at(make(), cloud)
    quiet = look.quiet
    require(
        np.isfinite(quiet) and quiet >= 0,
        f"the quiet threshold is {quiet:g}; it must be finite and at least 0",
    )
    loud = len(look.find(quiet))
    require(loud == 0, f"at the quiet threshold of {quiet:g} there are {loud} findings")
    below = look.find(float(np.nextafter(quiet, 0.0))) if quiet > 0 else ()
    require(
        quiet == 0 or len(below) > 0,
        f"just below the quiet threshold of {quiet:g} nothing is found",
    )
    for threshold in look.thresholds():
        findings = look.find(threshold)
        strongest = findings[0].score if findings else float("nan")
        message = (
            f"at a threshold of {threshold:g} the strongest finding scores {strongest:g}, but "
            f"{quiet:g} is quiet"
        )
        require(strongest == quiet, message)


def finds_no_more_at_higher_thresholds(make: Make, cloud: Cloud) -> None:
    """Check that a higher threshold only removes pixels from the findings."""
    look = Look.at(make(), cloud)
    lower = _pixels_of(look.find(0.0))
    thresholds = (*look.thresholds(), look.quiet)
    for before, threshold in pairwise(thresholds):
        pixels = _pixels_of(look.find(threshold))
        added = int((~np.isin(pixels, lower)).sum())
        require(
            added == 0,
            (
                f"raising the threshold from {before:g} to {threshold:g} adds {added} pixels to "
                "findings"
            ),
        )
        lower = pixels


def finds_valid_pixels(make: Make, cloud: Cloud) -> None:
    """Check that pixels are ascending flat indices of valid points, and that centres lie within
    the cloud."""
    look = Look.at(make(), cloud)
    _sound_findings(look, *look.thresholds())


def survives_missing_pixels(make: Make, cloud: Cloud) -> None:
    """Check evidence and findings on a cloud without 5 % of its pixels, a block and a column."""
    look = Look.at(make(), with_gaps(cloud, seed=5))
    _sound(look)
    _sound_findings(look, look.quiet / 2)
    look.everything()


def refuses_an_empty_cloud(make: Make, cloud: Cloud) -> None:
    """Check that a cloud without points raises a UserError, and that a cloud with a single point
    causes no crash."""
    detector = make()
    gone = np.ones_like(cloud.valid)
    for points in (0, 1):
        gone.reshape(-1)[np.flatnonzero(cloud.valid)[:points]] = False
        few_points = without(cloud, gone)
        try:
            look = Look(detector, few_points, detector.analyse(few_points))
        except UserError:
            continue
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            text = (
                f"a cloud with {points} valid points is not refused by a UserError but ends in "
                f"{message}"
            )
            raise AssertionError(text) from error
        require(points > 0, "a cloud without any point was not refused")
        look.everything()


def survives_pickling(make: Make, cloud: Cloud) -> None:
    """Check that the detector (unused and used) and its results are the same in another process."""

    def sent(value: Any) -> Any:
        return pickle.loads(pickle.dumps(value))

    unused = sent(make())
    detector = make()
    result = Look.at(detector, cloud).everything()
    require(_same(sent(result), result), "a result that was pickled is not the same")
    for arrived in (unused, sent(detector)):
        require(
            _same(Look.at(arrived, cloud).everything(), result),
            "a detector that was pickled gave another result",
        )


def learns_plain_arrays(make: Make, cloud: Cloud) -> None:
    """Check that learning returns reproducible arrays that can be stored, and that the detector
    works with them."""
    detector = make()
    if not isinstance(detector, Calibratable):
        return
    before = Look.at(make(), cloud).everything()
    clouds = [plane(seed=seed, damage=()) for seed in range(8)]
    learned = dict(detector.calibrate([_with_arrays(clean, _read_only) for clean in clouds]))
    again = dict(detector.calibrate([_with_arrays(clean, _read_only) for clean in clouds]))
    require(_same(learned, again), "the same clouds gave another learned state the second time")
    file = io.BytesIO()
    np.savez(file, **learned)  # type: ignore[arg-type]
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        restored = dict(stored)
    require(
        _same(learned, restored),
        "the learned state changes when it is stored: it must be plain arrays",
    )
    taught: Any = detector.calibrated(restored)
    require(
        (taught.name, taught.version) == (detector.name, detector.version),
        "learning changed name or version",
    )
    require(
        _same(before, Look.at(detector, cloud).everything()), "learning changed the detector itself"
    )
    for check in (gives_sound_evidence, is_silent_at_the_quiet_threshold, survives_pickling):
        check(lambda: taught, cloud)


def turns_with_the_cloud(make: Make, cloud: Cloud) -> None:
    """Check the results for a camera that is turned by 90 degrees about its optical axis, with its
    grid and lens."""
    pixels = _grid_turned(cloud, np.arange(cloud.valid.size).reshape(cloud.valid.shape))
    turned = Look.at(make(), turned_once(cloud))
    _compare(Look.at(make(), cloud), turned, pixels, QUARTER_TURN, "turned by 90 degrees")


def moves_with_the_cloud(make: Make, cloud: Cloud) -> None:
    """Check the results for a map (a cloud with parallel samples) that is moved away by 37 mm
    along its axis."""
    base = replace(cloud, projection="parallel", lens=None, map_views=None)
    step = cloud.z_step_m
    shift = np.eye(4)
    shift[2, 3] = round(SHIFT_M / step) * step if step > 0 else SHIFT_M
    moved = replace(base, points_m=transform_points(shift, base.points_m))
    pixels = np.arange(cloud.valid.size).reshape(cloud.valid.shape)
    _compare(
        Look.at(make(), base),
        Look.at(make(), moved),
        pixels,
        shift,
        f"moved by {1e3 * shift[2, 3]:.0f} mm",
    )


CHECKS = (
    declares_itself,
    gives_sound_evidence,
    gives_the_same_twice,
    keeps_its_input,
    orders_findings_by_score,
    is_silent_at_the_quiet_threshold,
    finds_no_more_at_higher_thresholds,
    finds_valid_pixels,
    survives_missing_pixels,
    refuses_an_empty_cloud,
    survives_pickling,
    learns_plain_arrays,
    turns_with_the_cloud,
    moves_with_the_cloud,
)


def _sound(look: Look) -> None:
    shape = look.cloud.valid.shape
    evidence = look.evidence
    for name in ("score", "residual_m", "surface_z_m"):
        image = np.asarray(getattr(evidence, name))
        require(
            image.shape == shape,
            f"`{name}` has the shape {image.shape}; the cloud's grid is {shape}",
        )
        require(image.dtype.kind == "f", f"`{name}` holds {image.dtype}, which cannot hold NaN")
    score = evidence.score
    scale = float(evidence.scale_m)
    count = int(np.isfinite(score[~look.cloud.valid]).sum())
    require(count == 0, f"{count} pixels without a point have a score; it must be NaN")
    require(not np.isinf(score).any(), "a score is infinite")
    require(
        np.isfinite(score).any(),
        "no pixel has a score; a cloud that cannot be judged must raise a UserError",
    )
    require(
        np.isfinite(scale) and scale > 0, f"`scale_m` is {scale:g}: it must be a length above 0"
    )


def _sound_findings(look: Look, *thresholds: float) -> None:
    cloud = look.cloud
    points = cloud.points_m[cloud.valid]
    low = points.min(axis=0) - CENTRE_MARGIN_M
    high = points.max(axis=0) + CENTRE_MARGIN_M
    for finding in (finding for threshold in thresholds for finding in look.find(threshold)):
        pixels = np.asarray(finding.pixels)
        centre = np.asarray(finding.centre_m)
        require(
            pixels.ndim == 1 and pixels.dtype.kind in "iu",
            "a finding's pixels are not a row of whole numbers",
        )
        require(len(pixels) > 0, "a finding has no pixels")
        require(
            (np.diff(pixels.astype(np.int64)) > 0).all(),
            "a finding's pixels are not in strictly ascending order",
        )
        require(
            pixels[0] >= 0 and pixels[-1] < cloud.valid.size,
            "a finding's pixels reach beyond the cloud's grid",
        )
        invalid = int((~cloud.valid.reshape(-1)[pixels]).sum())
        require(invalid == 0, f"{invalid} pixels of a finding have no point")
        require(
            centre.shape == (3,) and np.isfinite(centre).all(),
            "a finding's `centre_m` is not 3 finite numbers",
        )
        is_inside = bool(((low <= centre) & (centre <= high)).all())
        require(
            is_inside, f"a finding's centre {np.round(centre, 4).tolist()} m lies outside the cloud"
        )


def _pixels_of(findings: tuple[Detection, ...]) -> np.ndarray:
    return np.unique(
        np.concatenate(
            [np.zeros(0, np.int64), *(np.asarray(finding.pixels) for finding in findings)]
        )
    )


def _same(a: Any, b: Any) -> bool:
    """Return whether two values hold the same bits: arrays, numbers, text, and dataclasses or
    mappings of them."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a = np.asarray(a)
        b = np.asarray(b)
        return a.shape == b.shape and bool(
            np.array_equal(a, b, equal_nan=a.dtype.kind == b.dtype.kind == "f")
        )
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(
            _same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__
        )
    if isinstance(a, list | tuple):
        return isinstance(b, list | tuple) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict):
        return (
            isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
        )
    return bool(a == b) or (a != a and b != b)


def _with_arrays(value: T, change: Callable[[np.ndarray], np.ndarray]) -> T:
    """Return a copy of a dataclass with changed arrays."""
    values = {field.name: getattr(value, field.name) for field in fields(cast(Any, value))}
    changed = {
        name: change(array) for name, array in values.items() if isinstance(array, np.ndarray)
    }
    return cast(T, replace(cast(Any, value), **changed))


def _read_only(array: np.ndarray) -> np.ndarray:
    read_only = array.copy()
    read_only.setflags(write=False)
    return read_only


def turned_once(cloud: Cloud) -> Cloud:
    """Return the cloud that the same camera gives when it is turned by 90 degrees about its
    optical axis."""
    names = ("reason", "count", "variance_m2", "rgb", "amplitude", "mean_variance_m2")
    images = {name: getattr(cloud, name) for name in names}
    turned: dict[str, Any] = {
        name: _grid_turned(cloud, image) for name, image in images.items() if image is not None
    }
    turned["points_m"] = _grid_turned(cloud, transform_points(QUARTER_TURN, cloud.points_m))
    if (views := cloud.map_views) is not None:
        turned["map_views"] = MapViews(
            QUARTER_TURN @ views.T_cloud_cameras, views.shares, views.pixel_m[::-1]
        )
    if not cloud.organised:
        return replace(cloud, lens=None, **turned)
    lens = cloud.lens
    region = cloud.region
    width = lens.width if lens is not None else region.col1
    turned["region"] = Region(width - region.col1, width - region.col0, region.row0, region.row1)
    if lens is not None:
        k1, k2, p1, p2, *further_coefficients = lens.distortion
        distortion = (k1, k2, -p2, p1, *further_coefficients)
        turned["lens"] = Lens(
            lens.height, width, lens.fy, lens.fx, lens.cy, width - 1 - lens.cx, distortion
        )
    return replace(cloud, **turned)


def _grid_turned(cloud: Cloud, image: np.ndarray) -> np.ndarray:
    """Return an image turned by 90 degrees; a cloud without a grid keeps the order of its
    points."""
    return np.ascontiguousarray(np.rot90(image)) if cloud.organised else image


def _compare(
    before: Look, after: Look, pixels: np.ndarray, T_after_before: np.ndarray, motion: str
) -> None:
    """Compare scores and findings; ``pixels`` (h, w) holds the flat index before of each pixel
    afterwards."""
    was = before.evidence.score.reshape(-1)[pixels]
    now = after.evidence.score
    changed = int((np.isfinite(was) != np.isfinite(now)).sum())
    require(
        changed <= CROP_TOLERANCE * now.size,
        f"{motion}, {changed} of {now.size} pixels gained or lost their score",
    )
    tolerance = SCORE_TOLERANCE * max(float(np.nanmax(was)), 1e-12)
    changes = {
        "a score": float(np.nanmax(np.abs(was - now))),
        "the quiet threshold": abs(before.quiet - after.quiet),
    }
    for quantity, difference in changes.items():
        require(
            difference <= tolerance,
            f"{motion}, {quantity} changed by {difference:g} (allowed {tolerance:g})",
        )

    # findings are compared in the middle of the widest gap between scores from a fifth of the
    # quiet threshold to it; if no gap is wider than the tolerance on both sides, a tolerable
    # change of a score can change
    # findings
    scores = np.unique(before.evidence.score[np.isfinite(before.evidence.score)])
    scores = scores[(scores >= 0.2 * before.quiet) & (scores <= before.quiet)]
    gaps = np.diff(scores)
    if not len(gaps) or gaps.max() <= 2 * tolerance:
        return
    threshold = float(scores[gaps.argmax()] + gaps.max() / 2)
    flat = pixels.reshape(-1)
    of_before = {frozenset(finding.pixels.tolist()): finding for finding in before.find(threshold)}
    of_after = {
        frozenset(flat[finding.pixels].tolist()): finding for finding in after.find(threshold)
    }
    lost = (
        f"{len(of_before.keys() - of_after.keys())} of {len(of_before)} findings have other pixels"
    )
    require(of_before.keys() == of_after.keys(), f"{motion}, {lost}, and there are {len(of_after)}")
    for key, finding in of_before.items():
        moved_to = transform_points(T_after_before, finding.centre_m)
        distance_m = float(
            np.linalg.norm(np.asarray(moved_to) - np.asarray(of_after[key].centre_m))
        )
        require(
            distance_m <= PLACE_TOLERANCE_M,
            f"{motion}, a finding's centre moved by {1e3 * distance_m:.2f} mm",
        )
        sizes = (
            before.measured(finding).extent_diameter_m,
            after.measured(of_after[key]).extent_diameter_m,
        )
        grown = abs(sizes[1] - sizes[0])
        require(
            grown <= PLACE_TOLERANCE_M,
            f"{motion}, a finding's extent changed by {1e3 * grown:.2f} mm",
        )
