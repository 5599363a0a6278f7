"""Whether a flat field belongs to a capture: its own frames, another unit's pattern, and places
that both show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.averages.flat_agreement import (
    _is_surely_rougher,
    _Maps,
    frame_digests,
    places_doubt,
    refuse_unfit,
    shared_places,
)
from detectors.averages.flat_captures import flattened, separated
from detectors.averages.flat_field import FlatField, corrected, load_flat_field, save_flat_field
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame, LeftOut
from tests.detectors.averages.test_flat_field import LENS, NOISE_M, capture, pattern, wall

FRAMES = 10
POSES_M = ((0.55, 0.0, 0.0), (0.55, 0.04, 0.01), (1.0, 0.0, 0.0), (1.0, 0.05, -0.02))


def frames_of(
    number: int,
    pose_m: tuple[float, float, float] = POSES_M[0],
    fixed_m: np.ndarray | None = None,
    shape_m: np.ndarray | None = None,
) -> list[Frame]:
    """The frames of a capture, each with noise of its own."""
    shape_m = wall(0.0) if shape_m is None else shape_m
    z_m = capture(number, shape_m, pose_m, fixed_m, noise_m=0.0).points_m[..., 2]
    rng = np.random.default_rng([5, number])
    frames = []
    for index in range(FRAMES):
        noisy_m = (z_m + rng.normal(0, NOISE_M, z_m.shape)).astype(np.float32)
        frames.append(Frame(f"{number}-{index}", noisy_m, np.zeros(z_m.shape, np.uint8)))
    return frames


def cloud_of(frames: list[Frame]) -> Cloud:
    stack_m = np.stack([frame.z_m.astype(float) for frame in frames])
    z_m = stack_m.mean(axis=0)
    slopes = LENS.region_slopes(LENS.whole)
    points_m = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    return Cloud(
        points_m,
        np.zeros(z_m.shape, np.uint8),
        np.full(z_m.shape, len(frames)),
        stack_m.var(axis=0, ddof=min(1, len(frames) - 1)),
        LENS.whole,
        0.0,
        len(frames),
        lens=LENS,
    )


def field_of(captures: list[list[Frame]]) -> FlatField:
    """The flat field of captures, with the digests of their frames."""
    everywhere = np.ones((LENS.height, LENS.width), bool)
    flat = [flattened(cloud_of(frames), everywhere, "wall") for frames in captures]
    digests = frame_digests(frame for frames in captures for frame in frames)
    return replace(separated(flat, LENS).field, frames=digests)


def refused(frames: list[Frame], field: FlatField) -> str:
    """The message, "" if the flat field is accepted."""
    try:
        refuse_unfit(cloud_of(frames), frames, field, "unit.npz")
    except UserError as mistake:
        return str(mistake)
    return ""


@pytest.fixture(scope="module")
def field() -> FlatField:
    return field_of([frames_of(number, pose_m) for number, pose_m in enumerate(POSES_M)])


@pytest.mark.parametrize("number", [10, 11, 12])
def test_other_captures_of_the_unit_are_accepted(field: FlatField, number: int):
    assert refused(frames_of(number), field) == ""
    assert refused(frames_of(number, shape_m=wall(2 * MM)), field) == ""


def test_a_capture_that_is_in_the_flat_field_is_refused(field: FlatField):
    message = refused(frames_of(2, POSES_M[2]), field)
    assert "was made from this capture: 10 of its frames are in both" in message
    mixed = [*frames_of(10)[:9], frames_of(0)[3]]
    assert "1 of its frames are in both" in refused(mixed, field)


@pytest.mark.parametrize("captures", [1, 2])
def test_without_names_the_noise_tells_whose_frames_they_are(captures: int):
    """As in files of earlier versions; half of the noise is the least that shows."""
    captures_made = [frames_of(number) for number in range(captures)]
    unnamed = replace(field_of(captures_made), frames=frozenset())
    assert "holds the noise of this capture" in refused(captures_made[0], unnamed)
    assert refused(frames_of(10), unnamed) == ""


def test_frames_that_were_left_out_do_not_count_as_noise():
    """A frame that jumps by 20 mm, in one half only, would look like much noise."""
    captures = [frames_of(0)]
    unnamed = replace(field_of(captures), frames=frozenset())
    frames = frames_of(10)
    jump = replace(frames[0], name="jump", z_m=frames[0].z_m + pattern().astype(np.float32) * 40)
    cloud = replace(cloud_of(frames), left_out=(LeftOut("jump", "jumps"),))
    refuse_unfit(cloud, [*frames, jump], unnamed, "unit.npz")
    with pytest.raises(UserError, match="holds the noise"):
        refuse_unfit(cloud_of(frames), [*frames, jump], unnamed, "unit.npz")


def test_another_unit_s_flat_field_is_refused(field: FlatField):
    unrelated = frames_of(10, fixed_m=pattern()[::-1, ::-1])
    assert "makes this capture rougher, from" in refused(unrelated, field)


def test_a_flat_field_of_noise_only_is_accepted():
    """It takes nothing away; what it adds is less than a tenth."""
    bare = np.zeros((LENS.height, LENS.width))
    captures = [frames_of(number, fixed_m=bare) for number in range(8)]
    assert refused(frames_of(10, fixed_m=bare), field_of(captures)) == ""


def test_few_frames_or_pixels_are_not_judged(field: FlatField):
    assert refused(frames_of(10)[:1], field) == ""
    little = np.full(field.error_m.shape, np.nan)
    little[:20, :20] = field.error_m[:20, :20]
    assert refused(frames_of(10), replace(field, error_m=little)) == ""


def dented(depth_m: float, u: int = 90, v: int = 60, radius_px: int = 6) -> np.ndarray:
    rows, columns = np.mgrid[: LENS.height, : LENS.width]
    return depth_m * (np.hypot(rows - v, columns - u) < radius_px)


def test_damage_in_both_is_doubted_unless_the_camera_moved():
    """The wall has a dent of 2.5 mm, and the camera stands still: the correction takes it away."""
    damaged = pattern() + dented(2.5 * MM)
    field = field_of([frames_of(number, fixed_m=damaged) for number in range(2)])
    assert not field.moved
    cloud = corrected(cloud_of(frames_of(10, fixed_m=damaged)), field)
    text = places_doubt(cloud, field, "unit.npz")
    assert "stand out alike at one place as wide as damage" in text
    (shared,) = shared_places(cloud, field)
    assert np.hypot(*(shared - (90, 60))) < 6
    assert places_doubt(cloud, replace(field, moved=True), "unit.npz") == ""
    sound = corrected(cloud_of(frames_of(10)), field)
    assert places_doubt(sound, field, "unit.npz") == "", "the dent is in the flat field only"


def test_a_pattern_that_the_capture_shows_as_well_is_not_doubted(field: FlatField):
    still = replace(field, moved=False)
    for shape_m in (wall(0.0), wall(2 * MM)):
        cloud = corrected(cloud_of(frames_of(10, shape_m=shape_m)), still)
        assert places_doubt(cloud, still, "unit.npz") == ""


def test_frames_and_movement_are_stored(field: FlatField, tmp_path):
    assert field.moved and len(field.frames) == len(POSES_M) * FRAMES
    path = tmp_path / "unit.npz"
    save_flat_field(path, field)
    stored = load_flat_field(path)
    assert (stored.frames, stored.moved) == (field.frames, True)
    with np.load(path) as arrays:
        early = {name: arrays[name] for name in arrays if name not in ("frames", "moved")}
    np.savez(path, **early)
    assert load_flat_field(path).frames == frozenset()


@pytest.mark.parametrize(
    ("shared", "variance_of_noise", "is_rougher"),
    [(1.0, 1.0, False), (0.0, 1.0, False), (0.0, 0.25, True)],
)
def test_a_correction_is_rough_beyond_the_noise_of_its_map(
    shared: float, variance_of_noise: float, is_rougher: bool
) -> None:
    """The map is the capture's pattern, noise alone, or a pattern that the capture lacks."""
    rng = np.random.default_rng(8)
    capture_m = 1e-3 * rng.standard_normal(16_000)
    noise_m = 1e-3 * rng.standard_normal(16_000)
    maps = _Maps(
        capture_m=capture_m,
        field_m=shared * capture_m + noise_m,
        variance_m2=np.full(16_000, variance_of_noise * 1e-6),
        block=np.arange(16_000) % 16,
        counts=np.ones((160, 100), bool),
    )
    assert _is_surely_rougher(maps) == is_rougher
