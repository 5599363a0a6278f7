"""`tofpod record`: what it writes is what it read, `tofpod detect` reads it without an option, and
its lines say what the frames show."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from detectors import sources
from detectors.recordings import open_capture
from detectors.sources.interface import Stream, without_frames
from harness import detect
from harness.programs.record import record
from harness.programs.record.watching import WarmUp, Watch, drift_of
from harness.vocabulary.geometry import MM, Frame, Lens, Reason
from tests.support import recorded_plane as plane

LENS = Lens(width=120, height=90, fx=100.0, fy=100.0, cx=59.5, cy=44.5)
NOISE_M = 2 * MM
RATE_HZ = 10.0


def frame(
    number: int,
    *,
    noise_m: float = NOISE_M,
    farther_m: float = 0.0,
    left_px: int = 0,
    missing: float = 0.0,
) -> Frame:
    """A frame of a plate at 0.7 m before a wall at 1.1 m."""
    v, u = np.mgrid[: LENS.height, : LENS.width]
    is_plate = (np.abs(u + left_px - 60) < 35) & (np.abs(v - 45) < 25)
    rng = np.random.default_rng([3, number])
    z_m = np.where(is_plate, 0.7 + farther_m, 1.1) + noise_m * rng.normal(size=u.shape)
    z_m[rng.random(u.shape) < missing] = np.nan
    reason = np.where(np.isnan(z_m), Reason.NO_RETURN, Reason.VALID).astype(np.uint8)
    return Frame(f"frame {number}", z_m.astype(np.float32), reason, time_s=50 + number / RATE_HZ)


def watched(frames: Iterator[Frame]) -> list:
    watch = Watch(Stream("plate", LENS, 1e-4, iter(())))
    seconds = [watch.add(frame, frame.time_s or 0.0) for frame in frames]
    return [second for second in [*seconds, watch.ended()] if second is not None]


# ---------------------------------------------------------------- what the lines say


def test_noise_fill_rate_and_the_target_of_each_second():
    seconds = watched(frame(i, missing=0.1) for i in range(25))
    assert [(second.frames, round(second.time_s, 1)) for second in seconds] == [
        (10, 0.9),
        (20, 1.9),
        (25, 2.4),
    ]
    for second in seconds:
        assert second.noise_m == pytest.approx(NOISE_M, rel=0.03)
        assert second.fill_rate == pytest.approx(0.9, abs=0.01)
        assert second.target is not None and second.target.is_whole
        assert "target in view: 0.70 m away" in second.line and "noise 2.0" in second.line
        size = re.search(r"(\d+) x (\d+) mm", second.line)
        # 69 x 49 pixels at 0.7 m and a focal length of 100 pixels
        assert size and [int(side) for side in size.groups()] == pytest.approx([483, 343], rel=0.01)


def test_a_target_at_the_pictures_edge_is_cut_off_and_one_that_moves_is_sought_again():
    *_, before, after = watched(frame(i, left_px=0 if i < 60 else 40) for i in range(70))
    assert before.target.is_whole and not before.is_new and not np.isnan(before.drift.per_s)
    assert after.is_new and not after.target.is_whole
    assert "cut off by the picture's edge" in after.line
    # a drift from one place to the other would be none
    assert after.drift.change_m == 0 and np.isnan(after.drift.per_s)


def test_a_frame_that_is_displaced_as_a_whole_counts_in_nothing():
    first, second = watched(frame(i, farther_m=0.017 if i == 2 else 0.0) for i in range(20))
    assert (first.left_out, second.left_out) == (1, 0)
    assert "1 frame displaced" in first.line and "displaced" not in second.line
    assert first.noise_m == pytest.approx(NOISE_M, rel=0.05)
    assert abs(second.drift.change_m) < 0.1 * MM and not second.is_new


def test_without_a_surface_no_target_is_in_view():
    nothing = replace(
        frame(0),
        z_m=np.full((LENS.height, LENS.width), np.nan, np.float32),
        reason=np.full((LENS.height, LENS.width), Reason.NO_RETURN, np.uint8),
    )
    (second,) = watched(iter([nothing, nothing]))
    assert second.target is None and second.fill_rate == 0
    assert "noise -" in second.line and "no target in view" in second.line


def levels(minutes: float, noise_m: float = 0.02 * MM) -> list[tuple[float, float]]:
    """Two minutes of a camera that moves by 2 mm with a time constant of 20 minutes, from some
    minutes after it was switched on."""
    rng = np.random.default_rng(5)
    times_s = np.arange(120.0)
    moved_m = 2 * MM * (1 - np.exp(-(minutes + times_s / 60) / 20))
    return list(zip(times_s, moved_m - moved_m[0] + rng.normal(0, noise_m, 120), strict=True))


def test_a_camera_warms_up_until_it_drifts_by_less_than_matters():
    cold = drift_of(levels(0))
    assert cold.is_warming and cold.change_m == pytest.approx(0.19 * MM, abs=0.06 * MM)
    # the slope in the middle of the two minutes
    assert cold.per_s == pytest.approx(2 * MM / 1200 * np.exp(-1 / 20), rel=0.05)
    assert cold.error_per_s == pytest.approx(0.02 * MM / np.sqrt(120 * 120**2 / 12), rel=0.2)
    assert "still warming up" in cold.text
    warm = drift_of(levels(60))
    assert not warm.is_warming and "settled" in warm.text
    assert not drift_of(levels(0, noise_m=1 * MM)).is_warming, "chance explains this slope"
    assert np.isnan(drift_of(levels(0)[:5]).per_s) and not WarmUp(0, np.nan, np.nan).is_warming


def test_the_drift_of_frames_is_that_of_the_target():
    seconds = watched(frame(i, farther_m=0.05 * MM * i) for i in range(100))
    # 0.5 mm in a second
    assert seconds[-1].drift.change_m == pytest.approx(4.5 * MM, abs=0.1 * MM)
    assert seconds[-1].drift.per_s == pytest.approx(0.5 * MM, rel=0.03)
    assert seconds[-1].drift.is_warming


def test_a_drift_below_the_step_of_stored_distances_is_seen():
    drawn = (frame(i, noise_m=0.7 * MM, farther_m=0.004 * MM * i) for i in range(100))
    in_millimetres = (replace(frame, z_m=np.round(frame.z_m, 3)) for frame in drawn)
    seconds = watched(in_millimetres)
    assert seconds[-1].drift.change_m == pytest.approx(0.36 * MM, abs=0.01 * MM)
    assert seconds[-1].drift.per_s == pytest.approx(0.04 * MM, rel=0.05)


# ---------------------------------------------------------------- what is written


def test_what_is_recorded_from_a_file_is_what_it_holds(tmp_path: Path, capsys):
    stored = plane.write_open3d_folder(tmp_path / "stored", 40, 1.0)
    out = tmp_path / "out"
    assert record.main(["--from", str(stored), "--out", str(out), "--frames", "35"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-2].startswith("the frames state no times: 30 a second are assumed")
    assert printed[-1] == f"35 frames in {out}: tofpod detect {out}"
    assert sum("noise" in line for line in printed) == 2
    copy = open_capture([out])
    assert copy.lens == plane.LENS
    assert copy.unit_text == "depth unit 1 mm, from intrinsic.json"
    before = list(open_capture([stored]).frames())
    for frame_before, frame_after in zip(before[:35], copy.frames(), strict=True):
        np.testing.assert_array_equal(frame_after.z_m, frame_before.z_m)
    facts = json.loads((out / "recording.json").read_text())
    assert facts["frames"] == len(facts["times_s"]) == 35 and not facts["times_are_stated"]
    assert facts["seconds"][0]["noise_mm"] == pytest.approx(1.04, rel=0.05)
    assert facts["seconds"][0]["target"].startswith("target ")


@contextmanager
def open_simulated(path: Path | None) -> Iterator[Stream]:
    """A camera with a unit of 0.1 mm, amplitude, and a hole of 40 mm in the plate."""

    def frames() -> Iterator[Frame]:
        v, u = np.mgrid[: LENS.height, : LENS.width]
        is_hole = np.hypot(u - 70, v - 40) < 3
        for number in range(60):
            drawn = frame(number, noise_m=1 * MM)
            z_m = np.where(is_hole, drawn.z_m + np.float32(0.02), drawn.z_m)
            amplitude = np.full(u.shape, 500.0 + number, np.float32)
            yield replace(drawn, z_m=np.round(z_m, 4), amplitude=amplitude)
        raise KeyboardInterrupt

    yield Stream("simulated", LENS, 1e-4, frames())


def test_a_camera_is_recorded_until_ctrl_c_and_detect_reads_it_without_an_option(
    tmp_path: Path, capsys, monkeypatch
):
    module = SimpleNamespace(opened=open_simulated)
    monkeypatch.setitem(sys.modules, "simulated_camera", module)
    monkeypatch.setitem(sources.BUILT_IN, "simulated", "simulated_camera:opened")
    out = tmp_path / "out"
    assert record.main(["--camera", "simulated", "--out", str(out)]) == 0
    assert "ended by Ctrl-C" in capsys.readouterr().out
    copy = open_capture([out])
    frames = list(copy.frames())
    assert len(frames) == 60 and frames[7].amplitude is not None
    assert frames[7].amplitude[0, 0] == 507
    assert len(copy.files) == 60 + 60 + 1
    assert detect.main([str(out), "--detector", "matched"]) == 0
    found = capsys.readouterr().out
    assert "depth unit 0.1 mm, from intrinsic.json" in found
    assert found.startswith("One hole found")
    assert record.main(["--camera", "simulated", "--out", str(out)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_what_came_before_a_camera_fell_silent_is_kept(tmp_path: Path, capsys, monkeypatch):
    @contextmanager
    def opened(path: Path | None) -> Iterator[Stream]:
        def frames() -> Iterator[Frame]:
            yield from (frame(number) for number in range(15))
            raise without_frames("simulated")

        yield Stream("simulated", LENS, 1e-4, frames())

    monkeypatch.setitem(sys.modules, "simulated_camera", SimpleNamespace(opened=opened))
    monkeypatch.setitem(sources.BUILT_IN, "simulated", "simulated_camera:opened")
    out = tmp_path / "out"
    assert record.main(["--camera", "simulated", "--out", str(out)]) == 2
    assert "no frame came" in capsys.readouterr().err
    facts = json.loads((out / "recording.json").read_text())
    assert facts["frames"] == 15 and [second["frames"] for second in facts["seconds"]] == [10, 15]
    assert len(list((out / "depth").glob("*.png"))) == 15


def test_only_watching_writes_nothing(tmp_path: Path, capsys, monkeypatch):
    stored = plane.write_open3d_folder(tmp_path / "stored", 3)
    monkeypatch.chdir(tmp_path)
    assert record.main(["--from", str(stored)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["stored"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing is named that gives frames"),
        (["--from", "nowhere"], "no such file or folder"),
        (["--camera", "kinect"], "there is no camera to record with 'kinect'"),
        (["--camera", "oak", "--unit", "mm"], "--unit: concerns files that tofpod reads"),
        (["--from", "cloud.ply"], "holds points, not depth images"),
        (["--from", "cloud.ply", "--rate", "0"], "--rate 0"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, capsys, monkeypatch, words: list[str], message: str):
    plane.write_ply(tmp_path / "cloud.ply", plane.points_m(plane.depth_mm()))
    monkeypatch.chdir(tmp_path)
    assert record.main(words) == 2
    assert message in capsys.readouterr().err


def test_distances_that_do_not_fit_are_told(tmp_path: Path, capsys):
    z_m = np.full((3, 40, 50), 0.8) + 1e-5 * np.arange(3)[:, None, None]
    z_m[:, 30:] = 6.9
    np.save(tmp_path / "far.npy", z_m + 1e-6 * np.arange(50))
    lens = {"fx": 60.0, "fy": 60.0, "cx": 25.0, "cy": 20.0}
    (tmp_path / "intrinsic.json").write_text(json.dumps(lens))
    out = tmp_path / "out"
    assert record.main(["--from", str(tmp_path / "far.npy"), "--out", str(out)]) == 0
    assert "warning: 1500 distances beyond 6.55 m are left out" in capsys.readouterr().err
    assert json.loads((out / "recording.json").read_text())["distances_left_out"] == 1500
    (copied, *_) = open_capture([out]).frames()
    np.testing.assert_allclose(copied.z_m[:30], z_m[0, :30], atol=0.06 * MM)
    assert np.isnan(copied.z_m[30:]).all()
