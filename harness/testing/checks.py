"""The contract of `detectors.interface.Detector`, one check each: a function that makes the detector, and a cloud."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np

from detectors.interface import Detection, Detector, Measurement
from harness.testing.clouds import with_gaps, without
from harness.testing.contract import Look, Make, broken, no_crash, pixels_of, require, same
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError

STRONGEST = 5
"""Findings of one cloud that are looked at one by one."""
CENTRE_MARGIN_M = 0.02
"""Distance outside the cloud's extent up to which the centre of a finding may lie."""

T = TypeVar("T")


def declares_itself(make: Make, cloud: Cloud) -> None:
    """A name, a version from 1, and settings that are a Config whose defaults are legal and survive being stored."""
    detector = make()
    require(isinstance(detector.name, str) and detector.name != "", "`name` is no text")
    version = detector.version
    require(type(version) is int and version >= 1, f"`version` is {version!r}: a whole number from 1 is wanted")
    settings_type: Any = getattr(type(detector), "settings_type", None)
    is_config = isinstance(settings_type, type) and issubclass(settings_type, Config)
    require(is_config, "the class has no `settings_type` that is a harness.vocabulary.config.Config")
    with no_crash("`settings_type()`, the settings with all defaults,"):
        settings = settings_type()
    with no_crash("`settings_type.from_data` of the stored defaults"):
        restored = settings_type.from_data(settings.to_data())
    require(restored == settings, "settings that are stored and read again are not the same")


def gives_sound_evidence(make: Make, cloud: Cloud) -> None:
    """Images of the cloud's size, no score where there is no point, none infinite, some finite, a scale above 0."""
    _sound(Look.at(make(), cloud))


def gives_the_same_twice(make: Make, cloud: Cloud) -> None:
    """The same bits for the same cloud: again, after another cloud, and from a detector made anew."""
    detector = make()
    first = _all_of(Look.at(detector, cloud))
    require(same(first, _all_of(Look.at(detector, cloud))), "the second time the same cloud gave another result")
    other = Look.at(detector, with_gaps(cloud, seed=9))
    other.find(other.quiet / 2)
    require(same(first, _all_of(Look.at(detector, cloud))), "after another cloud the same one gave another result")
    require(same(first, _all_of(Look.at(make(), cloud))), "a detector made anew gave another result")


def keeps_its_input(make: Make, cloud: Cloud) -> None:
    """Neither the cloud nor the evidence is written to, not even for a moment."""
    given = _with_arrays(cloud, np.ndarray.copy)
    look = Look.at(make(), given)
    require(same(given, cloud), "`analyse` changed the cloud that it was given")
    kept = _with_arrays(look.evidence, np.ndarray.copy)
    _all_of(look)
    require(same(given, cloud), "`find`, `quiet_threshold` or `measure` changed the cloud")
    require(same(look.evidence, kept), "`find`, `quiet_threshold` or `measure` changed the evidence")
    protected = Look.at(make(), _with_arrays(_with_arrays(cloud, np.ndarray.copy), _read_only))
    _all_of(replace(protected, evidence=_with_arrays(protected.evidence, _read_only)))


def orders_findings_by_score(make: Make, cloud: Cloud) -> None:
    """Strongest first, each above the threshold; at its own score a finding is gone, just below it is there."""
    look = Look.at(make(), cloud)
    for threshold in look.thresholds():
        found = look.find(threshold)
        scores = np.array([finding.score for finding in found], dtype=float)
        require(np.isfinite(scores).all(), f"at a threshold of {threshold:g} a finding's score is not finite")
        low = float(scores.min(initial=np.inf))
        require(low > threshold, f"a finding scores {low:g}, no more than the threshold of {threshold:g}")
        require((np.diff(scores) <= 0).all(), f"at a threshold of {threshold:g} the strongest finding is not first")
        for finding in found[:STRONGEST]:
            gone, there = (look.find(at) for at in (finding.score, float(np.nextafter(finding.score, 0.0))))
            require(
                not np.isin(finding.pixels, pixels_of(gone)).any() and np.isin(finding.pixels, pixels_of(there)).any(),
                f"a finding scores {finding.score:g}, but that is not the threshold at which it vanishes",
            )


def is_silent_at_the_quiet_threshold(make: Make, cloud: Cloud) -> None:
    """Nothing is found there, something just below it, and it is the strongest finding's score; 0 where nothing can be
    found."""
    look = Look.at(make(), cloud)
    quiet = look.quiet
    require(np.isfinite(quiet) and quiet >= 0, f"the quiet threshold is {quiet:g}: a number from 0 is wanted")
    loud = len(look.find(quiet))
    require(loud == 0, f"at the quiet threshold of {quiet:g} there are {loud} findings")
    below = look.find(float(np.nextafter(quiet, 0.0))) if quiet > 0 else ()
    require(quiet == 0 or len(below) > 0, f"just below the quiet threshold of {quiet:g} nothing is found")
    for threshold in look.thresholds():
        found = look.find(threshold)
        strongest = found[0].score if found else float("nan")
        require(
            strongest == quiet,
            f"at a threshold of {threshold:g} the strongest finding scores {strongest:g}, but {quiet:g} is quiet",
        )


def finds_no_more_at_higher_thresholds(make: Make, cloud: Cloud) -> None:
    """Raising the threshold takes pixels away from the findings and adds none."""
    look = Look.at(make(), cloud)
    lower, thresholds = pixels_of(look.find(0.0)), (*look.thresholds(), look.quiet)
    for before, threshold in pairwise(thresholds):
        pixels = pixels_of(look.find(threshold))
        added = int((~np.isin(pixels, lower)).sum())
        require(added == 0, f"raising the threshold from {before:g} to {threshold:g} adds {added} pixels to findings")
        lower = pixels


def finds_valid_pixels(make: Make, cloud: Cloud) -> None:
    """Pixels are ascending flat indices of valid points; centres are finite and lie within the cloud."""
    look = Look.at(make(), cloud)
    for threshold in look.thresholds():
        for finding in look.find(threshold):
            _sound_finding(cloud, finding)


def survives_missing_pixels(make: Make, cloud: Cloud) -> None:
    """Evidence and findings stay sound where a twentieth of the pixels, a block and a column are gone."""
    gaps = with_gaps(cloud, seed=5)
    look = Look.at(make(), gaps)
    _sound(look)
    for finding in look.find(look.quiet / 2):
        _sound_finding(gaps, finding)
        _measured(look, finding)


def refuses_an_empty_cloud(make: Make, cloud: Cloud) -> None:
    """A cloud without any point is the user's mistake, told as a UserError; one with a single point is no crash."""
    detector = make()
    nothing = np.ones_like(cloud.valid)
    require(_unless_refused(detector, without(cloud, nothing)) is None, "a cloud without any point was not refused")
    nothing.reshape(-1)[np.flatnonzero(cloud.valid)[:1]] = False
    look = _unless_refused(detector, without(cloud, nothing))
    if look is not None:
        _all_of(look)


def measures_extents(make: Make, cloud: Cloud) -> None:
    """Each finding has a finite extent and centre, its own score, and a number of points."""
    look = Look.at(make(), cloud)
    for finding in look.find(look.quiet / 2)[:STRONGEST]:
        _measured(look, finding)


def survives_pickling(make: Make, cloud: Cloud) -> None:
    """The detector, unused and used, and all that it gives can be sent to another process and is the same there."""

    def sent(value: Any, what: str) -> Any:
        with no_crash(f"pickling {what}"):
            return pickle.loads(pickle.dumps(value))

    unused = sent(make(), "the detector")
    detector = make()
    result = _all_of(Look.at(detector, cloud))
    require(same(sent(result, "a result"), result), "a result that was pickled is not the same")
    for arrived in (unused, sent(detector, "the detector, once used,")):
        require(same(_all_of(Look.at(arrived, cloud)), result), "a detector that was pickled gave another result")


# ---------------------------------------------------------------- what several checks ask


def _unless_refused(detector: Detector, cloud: Cloud) -> Look | None:
    """A look at a cloud that can hardly be judged; None where the detector tells the user so."""
    try:
        return Look(detector, cloud, detector.analyse(cloud))
    except UserError:
        return None
    except Exception as error:
        points = int(cloud.valid.sum())
        what = f"{type(error).__name__}: {error}"
        raise broken(f"a cloud with {points} valid points is not refused by a UserError but ends in {what}") from error


def _sound(look: Look) -> None:
    shape, evidence = look.cloud.valid.shape, look.evidence
    for name in ("score", "residual_m", "surface_z_m"):
        image = np.asarray(getattr(evidence, name))
        require(image.shape == shape, f"`{name}` is an array of {image.shape}; the cloud's grid is {shape}")
        require(image.dtype.kind == "f", f"`{name}` holds {image.dtype}, which knows no NaN")
    score = evidence.score
    told = int(np.isfinite(score[~look.cloud.valid]).sum())
    require(told == 0, f"{told} pixels without a point have a score; NaN is wanted there")
    require(not np.isinf(score).any(), "a score is infinite")
    require(np.isfinite(score).any(), "no pixel has a score; where a cloud cannot be judged, a UserError is wanted")
    scale = float(evidence.scale_m)
    require(np.isfinite(scale) and scale > 0, f"`scale_m` is {scale:g}: a length above 0 is wanted")


def _sound_finding(cloud: Cloud, finding: Detection) -> None:
    pixels, centre = np.asarray(finding.pixels), np.asarray(finding.centre_m)
    require(pixels.ndim == 1 and pixels.dtype.kind in "iu", "a finding's pixels are no (n,) whole numbers")
    require(len(pixels) > 0, "a finding has no pixels")
    require((np.diff(pixels.astype(np.int64)) > 0).all(), "a finding's pixels do not ascend, or one is named twice")
    require(pixels[0] >= 0 and pixels[-1] < cloud.valid.size, "a finding's pixels reach beyond the cloud's grid")
    invalid = int((~cloud.valid.reshape(-1)[pixels]).sum())
    require(invalid == 0, f"{invalid} pixels of a finding have no point")
    require(centre.shape == (3,) and np.isfinite(centre).all(), "a finding's `centre_m` is no (3,) finite numbers")
    points = cloud.points_m[cloud.valid]
    low, high = points.min(axis=0) - CENTRE_MARGIN_M, points.max(axis=0) + CENTRE_MARGIN_M
    inside = bool(((low <= centre) & (centre <= high)).all())
    require(inside, f"a finding's centre {np.round(centre, 4).tolist()} m lies outside the cloud")


def _measured(look: Look, finding: Detection) -> Measurement:
    with no_crash("`measure`"):
        measured = look.detector.measure(look.cloud, look.evidence, finding)
    diameter, centre = measured.extent_diameter_m, np.asarray(measured.extent_centre_m)
    require(np.isfinite(diameter) and diameter >= 0, f"`extent_diameter_m` is {diameter:g}")
    require(centre.shape == (3,) and np.isfinite(centre).all(), "`extent_centre_m` is no (3,) finite numbers")
    told = f"`measure` says score {measured.score:g} of a finding of {finding.score:g}"
    require(measured.score == finding.score, told)
    require(measured.points >= 1, f"`measure` says {measured.points} points")
    return measured


def _all_of(look: Look) -> tuple[Any, ...]:
    """Everything that a detector says of a cloud."""
    quiet = look.quiet
    found = look.find(quiet / 2)
    return look.evidence, quiet, found, [_measured(look, finding) for finding in found[:STRONGEST]]


def _with_arrays(value: T, change: Callable[[np.ndarray], np.ndarray]) -> T:
    """A dataclass whose arrays are changed."""
    held = {field.name: getattr(value, field.name) for field in fields(cast(Any, value))}
    changed = {name: change(array) for name, array in held.items() if isinstance(array, np.ndarray)}
    return cast(T, replace(cast(Any, value), **changed))


def _read_only(array: np.ndarray) -> np.ndarray:
    seen = array.view()
    seen.setflags(write=False)
    return seen
