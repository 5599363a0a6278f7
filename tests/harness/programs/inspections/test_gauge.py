"""A gauge board: its template is true to scale, and a capture of the drilled board gives hits and
misses."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from detectors.interface import Evidence
from harness import sweep
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import read_record
from harness.programs.inspections import design_statistics as plan
from harness.programs.inspections import gauge, pod
from harness.programs.inspections.gauge_board import Gauge, read_gauge, seen_on
from harness.programs.inspections.gauge_page import (
    MARGIN_MM,
    PAPER_MM,
    draw_board,
    template_pdf,
    tiles_of,
)
from harness.report.findings import Judged
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import (
    MM,
    Lens,
    invert,
    rays_of,
    rotation_xyz_deg,
    transform_points,
)
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom
from tests.support.plain_clouds import cloud_of_points

CAMERA = "azure_kinect_nfov"
LENS = Lens(width=640, height=480, fx=700.0, fy=700.0, cx=320.3, cy=239.2)
GIVEN = ["--diameters", "2:12", "--a50", "5", "--a90", "7", "--targets", "24"]
DEPTH_M = 0.02
NEVER_FOUND_MM = 3.5
NOISE_MM = 0.4
THRESHOLD = 8


@pytest.fixture(scope="module")
def gauge_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gauge") / "out"
    assert gauge.main([*GIVEN, "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize(("largest_mm", "is_told"), [(10, True), (11, False)])
def test_sizes_that_would_not_show_a_larger_a90_are_told(
    largest_mm: int, is_told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A guess of 7 mm may be too small by a factor of 1.5."""
    sizes = ["--diameters", f"2:{largest_mm}", "--a50", "5", "--a90", "7", "--targets", "10"]
    assert gauge.main([*sizes, "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert ("warning: " in printed) == is_told
    assert ("the true a90 is 10.5 mm, which no hole of 2 to 10 mm would show" in printed) == is_told


def test_the_truth_holds_what_was_designed(gauge_folder: Path):
    (board,) = read_gauge(gauge_folder / "gauge.json").boards
    sizes = np.array([hole.diameter_mm for hole in board.holes])
    assert len(sizes) == 24
    assert set((sizes * 2 % 1).tolist()) == {0.0}
    assert sizes.min() >= 2
    assert sizes.max() <= 12
    assert ((sizes > 4) & (sizes < 8)).sum() >= 8  # where the guessed curve rises
    centres_mm = np.array([(hole.x_mm, hole.y_mm) for hole in board.holes])
    distances_mm = np.linalg.norm(centres_mm[:, None] - centres_mm[None], axis=-1) + 1e3 * np.eye(
        24
    )
    assert distances_mm.min() > 2 * read_gauge(gauge_folder / "gauge.json").hit_radius_mm
    for mark in board.marks:
        beside = np.abs(centres_mm - [mark.x_mm, mark.y_mm]).max(axis=1) - sizes / 2
        assert beside.min() > mark.side_mm / 2 + 3


def test_the_template_is_true_to_scale(gauge_folder: Path):
    """The SVG states its size; the drawing, in pixels of 0.2 mm, shows the codes where the truth
    has them."""
    from matplotlib.figure import Figure

    board_read = read_gauge(gauge_folder / "gauge.json")
    (board,) = board_read.boards
    size = re.search(
        r'width="([\d.]+)pt" height="([\d.]+)pt"', (gauge_folder / "board-1.svg").read_text()
    )
    assert size is not None
    np.testing.assert_allclose(
        [float(size[k]) / 72 * 25.4 for k in (1, 2)], [board.width_mm + 2, board.height_mm + 2]
    )
    pdf = template_pdf(board_read.boards, board_read.dictionary, "letter")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert box is not None
    assert sorted(float(box[k]) / 72 * 25.4 for k in (1, 2)) == pytest.approx(
        sorted(PAPER_MM["letter"]), abs=0.01
    )

    figure = Figure(figsize=(board.width_mm / 25.4, board.height_mm / 25.4))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(
        xlim=(-board.width_mm / 2, board.width_mm / 2),
        ylim=(-board.height_mm / 2, board.height_mm / 2),
    )
    axes.set_axis_off()
    draw_board(axes, board, board_read.dictionary)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=127)
    picture = cv2.imdecode(np.frombuffer(buffer.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    codes = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50))
    corners, marker_ids, _ = codes.detectMarkers(picture)
    assert sorted(marker_ids.ravel().tolist()) == [mark.code for mark in board.marks]
    for code, corner in zip(marker_ids.ravel(), corners, strict=True):
        mark = board.marks[int(code)]
        centre = corner.reshape(4, 2).mean(axis=0) + 0.5
        centre_mm = (centre / 5 - [board.width_mm / 2, board.height_mm / 2]) * [1, -1]
        np.testing.assert_allclose(centre_mm, [mark.x_mm, mark.y_mm], atol=0.3)


@pytest.mark.parametrize("paper", list(PAPER_MM))
def test_tiles_cover_the_board_and_overlap(paper: str):
    for size in ((100.0, 80.0), (400.0, 300.0), (900.0, 200.0)):
        sheet, tile_corners = tiles_of(*size, paper)
        room = np.array(sheet) - [2 * MARGIN_MM, 2 * MARGIN_MM + 12]
        for x, y in np.random.default_rng(1).uniform(0, 1, (200, 2)) * size:
            assert any(
                x_mm <= x <= x_mm + room[0] and low <= y <= low + room[1]
                for x_mm, low in tile_corners
            )


def picture(truth: Gauge, place_mm: np.ndarray, hidden: tuple[int, ...] = ()) -> np.ndarray:
    """The board's picture (h, w, 3) with its marks, whose pixels lie at places (h, w, 2) on it."""
    (board,) = truth.boards
    rgb = np.full((*place_mm.shape[:2], 3), 90, np.uint8)
    rgb[(np.abs(place_mm) < np.array([board.width_mm, board.height_mm]) / 2).all(axis=-1)] = 215
    marker_codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, truth.dictionary))
    for mark in board.marks:
        if mark.code not in hidden:
            tag = cv2.aruco.generateImageMarker(marker_codes, mark.code, 8)
            cell = np.floor(
                ((place_mm - [mark.x_mm, mark.y_mm]) * [1, -1] / mark.side_mm + 0.5) * 8
            ).astype(int)
            inside = ((cell >= 0) & (cell < 8)).all(axis=-1)
            rgb[inside] = tag[cell[inside][:, 1], cell[inside][:, 0]][:, None] // 2 + 60
    return rgb


def face_before_camera() -> tuple[np.ndarray, np.ndarray]:
    """The face of a board in front of the lens: z (h, w), and the places (h, w, 2) on it in mm."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ rotation_xyz_deg(6.0, -9.0, 3.0)
    T[:3, 3] = 0.01, -0.005, 0.42
    rays = rays_of(LENS.region_slopes(LENS.whole))
    normal = T[:3, 2]
    centre = T[:3, 3]
    z_m = (centre @ normal) / (rays @ normal)
    return z_m, transform_points(invert(T), rays * z_m[..., None])[..., :2] / MM


def captured(folder: Path, truth: Gauge, hidden: tuple[int, ...] = ()) -> Path:
    """The drilled board as a camera without a model would see it: holes above a size are steps,
    with noise."""
    (board,) = truth.boards
    z_m, board_xy_mm = face_before_camera()
    on_board = (np.abs(board_xy_mm) < np.array([board.width_mm, board.height_mm]) / 2).all(axis=-1)
    z_m = np.where(on_board, z_m, z_m + 0.3)
    for hole in board.holes:
        if hole.diameter_mm > NEVER_FOUND_MM:
            z_m += DEPTH_M * (
                np.linalg.norm(board_xy_mm - [hole.x_mm, hole.y_mm], axis=-1) < hole.diameter_mm / 2
            )
    rgb = picture(truth, board_xy_mm, hidden)
    for name in ("depth", "color"):
        (folder / name).mkdir(parents=True)
    for number in range(3):
        noise = np.random.default_rng([2, number]).normal(size=z_m.shape) * NOISE_MM
        cv2.imwrite(
            str(folder / "depth" / f"{number}.png"), np.rint(z_m / MM + noise).astype(np.uint16)
        )
        cv2.imwrite(str(folder / "color" / f"{number}.png"), cv2.GaussianBlur(rgb, (3, 3), 0))
    sizes = {
        "width": LENS.width,
        "height": LENS.height,
        "intrinsic_matrix": LENS.matrix.T.ravel().tolist(),
    }
    (folder / "intrinsic.json").write_text(json.dumps(sizes))
    return folder


@pytest.mark.parametrize(
    ("shown_in", "is_read"), [("colour", True), ("infrared", False), ("infrared alone", True)]
)
def test_marks_are_read_in_colour_and_without_it_in_infrared(
    gauge_folder: Path, shown_in: str, is_read: bool
) -> None:
    truth = read_gauge(gauge_folder / "gauge.json")
    z_m, place_mm = face_before_camera()
    marks = picture(truth, place_mm)
    blank = np.full_like(marks, 200)
    infrared = {"colour": blank, "infrared": marks, "infrared alone": marks}[shown_in][..., 0]
    rgb = {"colour": marks, "infrared": blank, "infrared alone": None}[shown_in]
    rays = rays_of(LENS.region_slopes(LENS.whole))
    cloud = cloud_of_points(
        rays * z_m[..., None], lens=LENS, rgb=rgb, amplitude=40.0 * infrared.astype(float)
    )
    flat = np.zeros(z_m.shape)
    judged = Judged(cloud, Evidence(flat, flat, z_m, 1e-3), (), ())
    if is_read:
        seen = seen_on(truth, judged, "plane 1", 5.0)
        assert "4 marks" in seen.notes[0]
        assert [row.found for row in seen.rows] == ["miss"] * 24
    else:
        with pytest.raises(UserError, match="no board is recognised"):
            seen_on(truth, judged, "plane 1", 5.0)


@pytest.mark.usefixtures("unsaved")
@pytest.mark.usefixtures("unpictured")
def test_a_capture_of_the_board_gives_hits_and_misses(
    gauge_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    truth = read_gauge(gauge_folder / "gauge.json")
    arguments = [
        str(captured(tmp_path / "seen", truth)),
        "--gauge",
        str(gauge_folder / "gauge.json"),
    ]
    assert gauge.main(["read", *arguments, "--out", str(tmp_path / "found")]) == 0
    printed = capsys.readouterr().out
    assert "4 marks" in printed
    # beside the deepest hole, a bump of half a millimetre
    assert "gauge: 20 hits, 4 misses, 0 holes not judged, 1 false call\n" in printed
    lines = (tmp_path / "found" / "gauge.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    assert [row["target"] for row in rows] == [f"board-1:{n}" for n in range(1, 25)]
    for row, hole in zip(rows, truth.boards[0].holes, strict=True):
        assert row["found"] == ("hit" if hole.diameter_mm > NEVER_FOUND_MM else "miss"), row
        if row["found"] == "hit":
            assert float(row["offset_mm"]) < 1.0
        assert row["detector"].startswith("matched ")
        assert float(row["threshold"]) > 3
        assert row["hit_radius_mm"] == "12"
    table = str(tmp_path / "found" / "gauge.csv")
    asked = ["--size", "diameter_mm", "--hit", "found", "--target", "target", "--unit", "mm"]
    assert pod.main([table, *asked, "--out", str(tmp_path / "pod")]) == 0

    hidden = captured(tmp_path / "hidden", truth, hidden=(0, 2))
    assert gauge.main(["read", str(hidden), "--gauge", str(gauge_folder / "gauge.json")]) == 2
    assert "no board is recognised" in capsys.readouterr().err
    (tmp_path / "no.json").write_text('{"gauge_version": 1, "boards": []}')
    assert gauge.main(["read", str(hidden), "--gauge", str(tmp_path / "no.json")]) == 2
    assert "boards" in capsys.readouterr().err


def seen_by(
    config: CameraConfig, truth: Gauge, tilt_deg: tuple[float, float], seed: int, folder: Path
) -> Path:
    """Write a frame of the board, rendered 0.5 m before this camera, as a capture of depth with a
    picture; its path."""
    (board,) = truth.boards
    holes = tuple(
        custom.HoleConfig(
            id=hole.id, diameter_mm=hole.diameter_mm, centre_mm=(hole.x_mm, hole.y_mm)
        )
        for hole in board.holes
    )
    target = custom.TargetConfig(
        board=custom.BoardConfig(
            width_mm=board.width_mm,
            height_mm=board.height_mm,
            thickness_mm=12.7,
            shape=custom.FlatConfig(),
        ),
        holes=holes,
        backing=custom.BackingConfig(distance_mm=20.0),
        material=custom.MaterialConfig(albedo_850=0.6, grain_contrast=0.0),
        pose=custom.PoseConfig(distance_m=0.5, tilt_x_deg=tilt_deg[0], tilt_y_deg=tilt_deg[1]),
    )
    camera = camera_of(config)
    view, _ = cached_view(
        target,
        camera.optics,
        RenderConfig(hole_noise_mm=0.3, face_samples=2048),
        folder / "renders",
    )
    unit = SimulatedUnit(camera, config, view)
    (frame,) = unit.capture(1, seed, "gauge").frames()
    T = target.pose.T_camera_board
    slopes = unit.view.slopes[unit.cut]
    rays = rays_of(slopes)
    on_board = rays * ((T[:3, 3] @ T[:3, 2]) / (rays @ T[:3, 2]))[..., None]
    place_mm = transform_points(invert(T), on_board)[..., :2] / MM
    window = camera.nominal_lens.whole
    cut = unit.region.within(camera.nominal_lens.whole)
    depth = np.zeros(window.shape, np.uint16)
    colour = np.full((*window.shape, 3), 90, np.uint8)
    depth[cut] = np.rint(np.nan_to_num(frame.z_m) / MM)
    colour[cut] = picture(truth, place_mm)
    for name, image in (("depth", depth), ("color", colour)):
        (folder / "seen" / name).mkdir(parents=True)
        cv2.imwrite(str(folder / "seen" / name / "0.png"), image)
    return folder / "seen"


@pytest.mark.slow
def test_the_combined_limit_covers_the_truth_of_a_camera_that_the_study_has_wrong(tmp_path: Path):
    """The real camera has five times the fixed pattern of the study's, whose limit is too small.
    Holes of a rendered gauge board before the real camera correct it, in three campaigns of 24
    holes. The truth is the same study with the real camera: of the same detector, threshold, hit
    radius, material and distance. Its holes keep as clear of the edge as the gauge's, as the crop
    takes those near it; so no false call (all of them lie on the rim) counts as a hit."""
    numbers = {"fixed_pattern.smooth_mm": 3.0, "fixed_pattern.pixel_mm": 4.0}
    experiment = Path(__file__).resolve().parents[4] / "experiments" / "detection_limit.yaml"
    judged = {"crop": {"kind": "auto"}, "surface": {"shape": "auto"}}  # as tofpod detect has them
    changes = [
        "source.target.distance_m=0.5",
        "detector.name=local",
        f"detector.settings={json.dumps(judged)}",
        f"threshold={{k: {THRESHOLD}}}",
        "matching.radius_mm=12.0",
        "source.target.material.grain_contrast=0.0",
        "study.boards=16",
        "study.hole_free_boards=4",
        "capture.frames=1",
        "source.target.room=null",
        f"source.target.edge_mm={2 * gauge.EDGE_MM}",
        "source.target.damage={kind: through, per_board: 8, diameter_mm: [2, 12]}",
        f"sweep={json.dumps({'source.camera.numbers': [{}, numbers]})}",
    ]
    arguments = [text for change in changes for text in ("--set", change)]
    assert sweep.main([str(experiment), *arguments, "--out", str(tmp_path / "study")]) == 0
    study = tmp_path / "study" / "detection_limit" / "latest"
    simulated, real = [limit_of(set_up) for set_up in read_record(study).set_ups]
    truth_mm = real.statement.a90
    assert simulated.statement.bound.value < truth_mm

    sizes = [
        "--diameters",
        "2:12",
        "--study",
        str(study),
        "--set-up",
        simulated.record.label,
        "--targets",
        "24",
    ]
    assert gauge.main([*sizes, "--out", str(tmp_path / "gauge")]) == 0
    truth = read_gauge(tmp_path / "gauge" / "gauge.json")
    for seed, tilt_deg in enumerate([(5.0, -4.0), (-3.0, 6.0), (2.0, 1.0)]):
        out = tmp_path / str(seed)
        arguments = [
            str(seen_by(CameraConfig(name=CAMERA, numbers=numbers), truth, tilt_deg, seed, out))
        ]
        arguments += ["--intrinsics", CAMERA, "--detector", "local", "--threshold", str(THRESHOLD)]
        arguments += [
            "--gauge",
            str(tmp_path / "gauge" / "gauge.json"),
            "--out",
            str(out / "found"),
        ]
        assert gauge.main(["read", *arguments]) == 0
        arguments = [
            str(out / "found" / "gauge.csv"),
            "--size",
            "diameter_mm",
            "--hit",
            "found",
            "--board-size",
            "board",
        ]
        arguments += [
            "--prior",
            str(study),
            "--set-up",
            simulated.record.label,
            "--out",
            str(out / "pod"),
        ]
        assert pod.main(arguments) == 0
        mapod = json.loads((out / "pod" / "mapod.json").read_text())
        last = mapod["after_each_board"][-1]
        print(
            f"simulated {simulated.statement.a90:.2f}, truth {truth_mm:.2f}, {last}, quoted "
            f"{mapod['a90_95']}"
        )
        assert mapod["counted_otherwise"] == ""
        assert truth_mm <= last["a90_95"] < 2 * truth_mm
        assert truth_mm <= mapod["a90_95"] < 2 * truth_mm
        assert simulated.statement.a90 < last["a90"]
        assert simulated.statement.bound.value < mapod["a90_95"]


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (["--a50", "5"], "exactly one curve"),
        (["--diameters", "12:2", "--a50", "5", "--a90", "7"], "--diameters"),
        (["--a50", "5", "--a90", "7", "--board-size", "60x60"], "a larger --board-size"),
        (["--a50", "5", "--a90", "7", "--board-size", "big"], "280x190|270x175"),
        (["--a50", "5", "--a90", "7", "--apart", "10"], "--apart"),
        (["--a50", "5", "--a90", "7", "--board-size", "175xnan"], "280x190|270x175"),
        (["--a50", "5", "--a90", "7", "--depths", "5:2"], "--depths 5:2"),
    ],
)
def test_mistakes_are_explained(
    wrong: list[str],
    word: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    planned = plan.design  # whose simulated studies are most of the time
    monkeypatch.setattr(
        plan, "design", lambda *arguments, **how: planned(*arguments, **how | {"studies": 10})
    )
    base = [] if "--diameters" in wrong else ["--diameters", "2:12"]
    assert gauge.main([*base, *wrong, "--targets", "24", "--out", str(tmp_path / "none")]) == 2
    assert re.search(word, capsys.readouterr().err)
    assert not (tmp_path / "none").exists()
