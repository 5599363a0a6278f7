"""Light transport against closed forms, quadrature and its own noise estimate."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR
from scenes.closed_form import plane_view
from scenes.optics import Quadrilaterals, RenderConfig, footprint_of
from scenes.render import scene as variant
from scenes.render.cache import cached_view, render_key
from scenes.render.direct import OffFace, cast, direct_light
from scenes.render.face import face_triangles
from scenes.render.indirect import PathWork, gather_at_points, gather_in_pixels
from scenes.render.range_noise import range_change_m
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.render.view import indirect_light, render_view, target_region
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.camera import load_camera
from scenes.target.custom import TargetConfig
from scenes.target.mesh import TargetPart, build_target, look_up
from scenes.target.thesis import ThesisTargetConfig

ROOT = Path(__file__).resolve().parents[3]
CAMERA = load_camera("azure_kinect_nfov")
EMITTER = CAMERA.optics.emitter_m
WAVE = 2 * np.pi * np.array(CAMERA.frequencies_hz) / SPEED_OF_LIGHT_AIR


def quad(
    corners: list[list[float]],
    name: str = "plane",
    albedo: float = 0.5,
) -> TargetPart:
    mesh = trimesh.Trimesh(np.array(corners), [[0, 1, 2], [0, 2, 3]], process=False)
    return TargetPart(
        name=name,
        mesh=mesh,
        uv=None,
        albedo_850=albedo,
        texture_850=None,
        rgb=(0.5, 0.5, 0.5),
        texture_rgb=None,
    )


def frontal(
    z: float,
    x0: float = -2,
    x1: float = 2,
    name: str = "plane",
    albedo: float = 0.5,
) -> TargetPart:
    return quad([[x0, -2, z], [x1, -2, z], [x1, 2, z], [x0, 2, z]], name, albedo)


def light_on(lit, lens, region):
    footprint = footprint_of(lens, region, CAMERA.optics.beam_fwhm_rad)
    return direct_light(lit, lens.region_slopes(region), footprint, CAMERA.frequencies_hz)


def whole_pixels(lens, region, rows, cols):
    """All sub-rays of pixels, for a path tracer that knows no face."""
    footprint = Quadrilaterals(lens, region)
    slopes = footprint.slopes(rows, cols, footprint.grid())
    count = np.full(len(rows), slopes.shape[1])
    return OffFace(
        np.arange(len(rows)), count, np.ones(len(rows)), slopes.reshape(-1, 2).astype(np.float32)
    )


def scene_of(*parts: TargetPart, camera=CAMERA):
    return lit_scene(load_mitsuba(), parts, camera.optics)


SLOPES = np.stack(
    np.meshgrid(np.linspace(-0.4, 0.4, 21), np.linspace(-0.3, 0.3, 15)), axis=-1
).reshape(-1, 2)


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (0.35, -0.2)])
def test_plane_range_to_micrometres_and_amplitude_by_lambert(a, b):
    """z = 0.8 + a x + b y: range, path and amplitude albedo cos/d^2 in closed form."""
    plan = ((-1.5, -1.5), (1.5, -1.5), (1.5, 1.5), (-1.5, 1.5))
    corners = [[x, y, 0.8 + a * x + b * y] for x, y in plan]
    hits = cast(scene_of(quad(corners, albedo=0.37)), SLOPES)
    z = 0.8 / (1 - a * SLOPES[:, 0] - b * SLOPES[:, 1])
    points = np.column_stack([SLOPES, np.ones(len(SLOPES))]) * z[:, None]
    range_m = np.linalg.norm(points, axis=1)
    to_emitter = EMITTER - points
    leg_m = np.linalg.norm(to_emitter, axis=1)
    normal = np.array([a, b, -1]) / np.sqrt(a * a + b * b + 1)
    cosine = (to_emitter @ normal) / leg_m
    assert np.abs(hits.range_m - range_m).max() < 1e-6
    assert np.abs(hits.path_m - range_m - leg_m).max() < 1e-6
    assert hits.amplitude == pytest.approx(0.37 * cosine / leg_m**2, rel=2e-6)


def test_light_outside_the_cone_is_none_and_the_roll_off_linear_in_the_cosine():
    slopes = np.array([[np.tan(np.deg2rad(t)), 0.0] for t in (30, 40, 45)])
    hits = cast(scene_of(frontal(1.0, -3, 3)), slopes)
    on_axis = (1.0 - EMITTER[2]) / np.hypot(slopes[:, 0] - EMITTER[0], 1.0 - EMITTER[2])
    full, cutoff = np.cos(np.deg2rad([38.0, 42.0]))
    share = np.clip((on_axis - cutoff) / (full - cutoff), 0, 1)
    assert hits.amplitude == pytest.approx(
        share * 0.5 * on_axis**3 * on_axis / (1.0 - EMITTER[2]) ** 2 / on_axis, rel=1e-4
    )
    assert 0 < share[1] < 1
    assert share[2] == 0


def test_step_edge_mixes_phasors_by_area():
    """A plate that covers part of a pixel: the phasor is the area-weighted sum of both planes'
    phasors."""
    lens = CAMERA.nominal_lens
    from harness.vocabulary.geometry import Region

    region = Region(330, 336, 316, 328)
    edge_x = 0.7 * lens.slopes(np.array(321.8), np.array(333.0))[0]
    lit = scene_of(frontal(0.7, -2, float(edge_x), "near"), frontal(0.75, -2, 2, "far"))
    light = light_on(lit, lens, region)
    column = 322 - region.col0
    assert light.fine[:, column].all()
    roughly = np.ones(region.shape, bool)
    slopes = lens.region_slopes(region)
    footprint = footprint_of(lens, region, None)
    rough = direct_light(
        lit,
        slopes,
        footprint,
        CAMERA.frequencies_hz,
        None,
        roughly,
    )
    assert (
        not rough.fine.any()
    )  # 16 sub-rays lie in four columns: the edge is wrong by half of one at most
    assert np.abs(rough.coverage - light.coverage).max() < 1 / 8 + 1 / 256
    assert rough.off_face.share.max() == 1.0
    near_light = light_on(scene_of(frontal(0.7)), lens, region).phasor[:, :, column]
    far_light = light_on(scene_of(frontal(0.75)), lens, region).phasor[:, :, column]
    # the edge stands 0.3 px right of the pixel's left border; the lens sees a little of the far
    # plane shadowed by the plate (emitter 14 mm to the left: 1 mm wide, 0.7 px), so between 0.3
    # and 1.0 px nothing comes
    # back
    assert light.coverage[:, column] == pytest.approx(1 - 0.3, abs=1 / 16)
    shadow_px = (EMITTER[0] * -1 * 0.05 / 0.7) / (0.75 / lens.fx)
    lit_share = max(0.7 - shadow_px, 0)
    expected = 0.3 * near_light + lit_share * far_light
    assert np.abs(light.phasor[:, :, column] - expected).max() < 0.07 * np.abs(near_light).max()


def test_hole_walls_shadow_the_floor():
    """Blind hole, floor lit exactly where the emitter sees it through the mouth: two circles'
    intersection."""
    target = build_target(
        TargetConfig.from_data(
            {
                "name": "custom",
                "board": {"width_mm": 200, "height_mm": 200, "thickness_mm": 60},
                "holes": [
                    {
                        "id": 1,
                        "kind": "blind",
                        "diameter_mm": 40,
                        "depth_mm": 50,
                        "centre_mm": [0, 0],
                    }
                ],
                "pose": {"distance_m": 0.5, "tilt_x_deg": 0, "tilt_y_deg": 0},
                "backing": None,
                "room": None,
            }
        )
    )
    data = CAMERA.to_data()
    data["emitter"]["position_mm"]["value"] = [-100.0, 0.0, 1.0]
    camera = AmcwCamera.from_data(data)
    emitter = camera.optics.emitter_m
    grid = np.linspace(-0.019, 0.019, 41)
    x, y = np.stack(np.meshgrid(grid, grid)).reshape(2, -1)
    keep = np.hypot(x, y) < 0.0185
    x = x[keep]
    y = y[keep]
    hits = cast(scene_of(*target.parts, camera=camera), np.column_stack([x, y]) / 0.55)
    on_floor = np.abs(hits.range_m - 0.55 * np.sqrt(1 + (x**2 + y**2) / 0.55**2)) < 1e-5
    assert on_floor.mean() > 0.9
    t = (0.5 - emitter[2]) / (0.55 - emitter[2])
    mouth = np.hypot(emitter[0] + t * (x - emitter[0]), emitter[1] + t * (y - emitter[1]))
    clear = np.abs(mouth - 0.02) > 1e-4
    assert ((mouth < 0.02) == (hits.amplitude > 0))[on_floor & clear].all()
    assert 0.02 < (hits.amplitude[on_floor] == 0).mean() < 0.5


def test_one_bounce_in_a_corner_equals_quadrature_and_lengthens_the_range():
    """A 90-degree corner: floor y = 0.3 and wall z = 1; the wall's light by way of the floor, once
    reflected."""
    wall = quad([[-1, -1, 1.0], [1, -1, 1.0], [1, 0.3, 1.0], [-1, 0.3, 1.0]], "wall", 0.8)
    floor = quad([[-1, 0.3, 0.2], [1, 0.3, 0.2], [1, 0.3, 1.0], [-1, 0.3, 1.0]], "floor", 0.6)
    lit = scene_of(wall, floor)
    point = np.array([0.05, 0.2, 1.0])
    light = gather_at_points(
        lit,
        point[None],
        np.array([[0.0, 0, -1]]),
        PathWork(CAMERA.frequencies_hz, 0, seed=3),
        65536,
    )
    xs = np.linspace(-1, 1, 1601)
    zs = np.linspace(0.2, 1.0, 1601)
    xs = (xs[1:] + xs[:-1]) / 2
    zs = (zs[1:] + zs[:-1]) / 2
    q = np.stack(np.broadcast_arrays(xs[None, :], 0.3, zs[:, None]), axis=-1)
    to_emitter = EMITTER - q
    leg = np.linalg.norm(to_emitter, axis=-1)
    on_axis = (q[..., 2] - EMITTER[2]) / leg
    full, cutoff = np.cos(np.deg2rad([38.0, 42.0]))
    sent = np.clip((on_axis - cutoff) / (full - cutoff), 0, 1) * -to_emitter[..., 1] / leg**3
    gap = q - point
    d = np.linalg.norm(gap, axis=-1)
    kernel = (
        0.6
        * sent
        * (-gap[..., 2] / d)
        * (gap[..., 1] / d)
        / (np.pi * d**2)
        * (2 / 1600)
        * (0.8 / 1600)
    )
    for f, wave in enumerate(WAVE):
        expected = (kernel * np.exp(1j * wave * (leg + d))).sum()
        assert abs(light.mean(axis=0)[f, 0] - expected) < 0.004 * abs(expected)
    slope = point[:2] / point[2]
    rays = OffFace(np.zeros(1, int), np.ones(1, int), np.ones(1), slope[None].astype(np.float32))
    pixel = gather_in_pixels(lit, rays, PathWork(CAMERA.frequencies_hz, 4, seed=3), 8192)
    hit = cast(lit, slope[None])
    direct = hit.amplitude * np.exp(1j * WAVE * hit.path_m)
    assert (np.angle((direct + pixel.mean(axis=0)[:3, 0]) / direct) > 0).all()


def test_paths_are_those_of_before():
    """Few paths, whose sum is far from the truth: it moves with any change of their directions."""
    wall = quad([[-1, -1, 1.0], [1, -1, 1.0], [1, 0.3, 1.0], [-1, 0.3, 1.0]], "board", 0.8)
    floor = quad([[-1, 0.3, 0.2], [1, 0.3, 0.2], [1, 0.3, 1.0], [-1, 0.3, 1.0]], "floor", 0.6)
    lit = scene_of(wall, floor)
    work = PathWork(CAMERA.frequencies_hz, 2, seed=3)
    points_m = np.array([[0.05, 0.2, 1.0], [-0.3, 0.1, 1.0]])
    normals = np.array([[0.0, 0.0, -1.0]] * 2)
    at_points = gather_at_points(lit, points_m, normals, work, 64)
    bright = np.eye(4)
    bright[:3, 3] = [0.0, -0.35, 1.0]
    bright[:3, :3] = np.diag([1.0, -0.65, -1.0])
    towards_wall = gather_at_points(lit, points_m[:1], normals[:1], work, 64, bright)
    slopes = np.array([[0.05, 0.2], [0.0, 0.45], [0.1, 0.5]], np.float32)
    rays = OffFace(np.array([3, 8]), np.array([1, 2]), np.ones(2), slopes)
    in_pixels = gather_in_pixels(lit, rays, work, np.array([32, 64]))
    later = gather_in_pixels(lit, rays, work, 32, after=32)
    lights = (at_points, towards_wall, in_pixels, later)
    phasors = np.concatenate([light.mean(axis=0)[0] for light in lights])
    assert phasors == pytest.approx(np.array(PATHS), rel=1e-4)


PATHS = [
    0.0322413 - 0.108666j,
    0.0394013 - 0.047496j,
    0.0407574 - 0.0914795j,
    -0.0775502 - 0.00463892j,
    -0.0697903 - 0.0358554j,
    -0.0762188 - 0.0015777j,
    -0.0680803 - 0.0382905j,
]
SMALL = ThesisTargetConfig.from_data({"name": "thesis"}).declare()
QUICK = RenderConfig(
    face_samples=1024,
    hole_samples=64,
    rest_samples=16,
    bounces=3,
)


@pytest.fixture(scope="module")
def thesis_view():
    return render_view(build_target(SMALL), CAMERA.optics, QUICK)


def test_albedo_texture_is_looked_up_where_the_target_says(thesis_view):
    """The amplitude over cos/d^2 is the part's own albedo at the same place, grain and all."""
    target = build_target(SMALL)
    lit = scene_of(*target.parts)
    slopes = thesis_view.slopes[40:60:2, 30:120:3].reshape(-1, 2)
    hits = cast(lit, slopes)
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    points = (
        rays
        / np.linalg.norm(
            rays,
            axis=1,
            keepdims=True,
        )
        * hits.range_m[:, None]
    )
    to_emitter = EMITTER - points
    leg = np.linalg.norm(to_emitter, axis=1)
    normal = target.T_camera_board[:3, 2]
    board = target.parts[0]
    height = (points - target.T_camera_board[:3, 3]) @ normal
    on_board = (hits.surface == 0) & (np.abs(height) < 1e-5)
    assert on_board.sum() > 250
    albedo = hits.amplitude * leg**3 / (to_emitter @ normal)
    expected = look_up(board.texture_850, hits.uv)
    assert expected[on_board].std() > 0.01
    assert albedo[on_board] == pytest.approx(expected[on_board], abs=0.004)


def test_thesis_view_is_whole(thesis_view):
    view = thesis_view
    assert 25_000 < view.surface.size < 60_000
    assert np.isfinite(view.phasor).all()
    board = view.surface == view.surface_names.index("board")
    assert np.nanmin(view.range_m[board]) > 0.6
    assert (view.intensity * (1 + 3e-4) + 1e-9 >= np.abs(view.phasor).max(axis=0)).all()
    # noise is measured, and small on the board
    assert 0 < np.median(view.indirect_noise_m[board]) < 0.05e-3


@pytest.mark.slow
def test_reported_noise_matches_the_spread_over_seeds(thesis_view):
    """Eight gatherings with other seeds: the spread of the ranges is what each reports, within 35
    %, inside the holes where noise is white from pixel to pixel."""
    target = build_target(SMALL)
    optics = CAMERA.optics
    slopes = thesis_view.slopes
    lit = lit_scene(load_mitsuba(), target.parts, optics, face_triangles(target))
    footprint = footprint_of(optics.lens, thesis_view.region, optics.beam_fwhm_rad)
    direct = direct_light(lit, slopes, footprint, optics.frequencies_hz)
    inside = np.ones(thesis_view.range_m.shape, bool)
    config = QUICK.model_copy(update={"face_samples": 64})
    gathered = [
        indirect_light(
            lit,
            target,
            optics,
            slopes,
            direct,
            inside,
            config.model_copy(update={"seed": seed}),
        )
        for seed in range(8)
    ]
    backing = direct.surface == [part.name for part in lit.parts].index("backing")
    lit_backing = backing & (np.abs(direct.phasor[0]) > 0.1)
    shifts = [
        range_change_m(
            light[:-1, lit_backing], direct.phasor[:, lit_backing], optics.frequencies_hz
        )
        for light, _ in gathered
    ]
    spread = np.sqrt(
        np.var(
            shifts,
            axis=0,
            ddof=1,
        ).mean()
    )
    reported = np.sqrt(np.mean([noise_m[lit_backing] ** 2 for _, noise_m in gathered]))
    assert spread / reported == pytest.approx(1, abs=0.35)


def test_nodes_on_the_face_agree_with_paths_through_each_pixel(thesis_view):
    """Indirect light on the face: interpolation from nodes against a path tracer through the same
    pixels.

    Compared as range over 300 pixels: within 4 standard errors of the difference and 0.02 mm."""
    target = build_target(SMALL)
    lit = scene_of(*target.parts)
    lens = CAMERA.nominal_lens
    pixels = np.meshgrid([22, 70], np.arange(30, 400, 4), indexing="ij")
    rows, cols = np.stack(pixels).reshape(2, -1)
    work = PathWork(CAMERA.frequencies_hz, QUICK.bounces, seed=9)
    traced = gather_in_pixels(lit, whole_pixels(lens, thesis_view.region, rows, cols), work, 2048)
    direct = thesis_view.phasor_direct[:, rows, cols]
    indirect = thesis_view.phasor[:, rows, cols] - direct
    f = np.array(CAMERA.frequencies_hz)[:, None]
    difference = np.imag((traced.mean(axis=0, dtype=complex)[:3] - indirect) / direct)
    error_m = (SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()) * difference).sum(axis=0)
    assert abs(error_m.mean()) < max(4 * error_m.std() / np.sqrt(error_m.size), 0.02e-3)


def test_target_out_of_view_is_refused():
    pose = SMALL.pose.model_copy(update={"offset_x_mm": 2000.0})
    aside = SMALL.model_copy(update={"pose": pose})
    with pytest.raises(UserError, match="the target is out of view of Azure Kinect"):
        target_region(build_target(aside), CAMERA.optics)


def test_a_board_that_exceeds_the_view_is_rendered_as_far_as_it_is_seen():
    """A plate larger than the field: its direct light is that of an endless plane, to the last
    pixel of the sensor, and what lies within the view is as on a plate that ends inside."""
    camera = load_camera("azure_kinect_nfov_binned")
    large = TargetConfig.from_data({
        "name": "custom",
        "board": {"width_mm": 1700.0, "height_mm": 1200.0, "thickness_mm": 10.0},
        "holes": [{
            "id": 1,
            "diameter_mm": 30.0,
            "centre_mm": [-60.0, 20.0],
            "kind": "blind",
            "depth_mm": 8.0,
        }],
        "material": {"albedo_850": 0.6, "grain_contrast": 0.0},
        "pose": {"distance_m": 0.6, "tilt_x_deg": 12.0, "tilt_y_deg": -16.0},
    })  # fmt: skip
    assert target_region(build_target(large), camera.optics) == camera.nominal_lens.whole
    view = render_view(build_target(large), camera.optics, RenderConfig(bounces=0))
    normal = large.pose.T_camera_board[:3, 2]
    slope_x = -normal[0] / normal[2]
    slope_y = -normal[1] / normal[2]
    plane = plane_view(
        camera,
        camera.nominal_lens.whole,
        0.6,
        0.6,
        slope_x,
        slope_y,
    )
    lit = ~hole_pixels(view, large) & (
        np.hypot(view.slopes[..., 0], view.slopes[..., 1]) < np.tan(np.deg2rad(34))
    )
    np.testing.assert_allclose(view.range_m[lit], plane.range_m[lit], rtol=1e-5)
    assert np.abs(view.phasor_direct[:, lit] / plane.phasor[:, lit] - 1).max() < 5e-3
    board = large.board.model_copy(update={"width_mm": 200.0, "height_mm": 150.0})
    small = render_view(
        build_target(large.model_copy(update={"board": board})),
        camera.optics,
        RenderConfig(bounces=0),
    )
    inner = np.s_[:, 20:-20, 20:-20]
    same = view.phasor_direct[:, *small.region.within(view.region)]
    assert np.abs(small.phasor_direct[inner] / same[inner] - 1).max() < 1e-2


def hole_pixels(view, target) -> np.ndarray:
    """(h, w) bool: pixels within 3 pixels of the target's only hole."""
    centre = target.pose.T_camera_board[:3] @ [*target.holes[0].centre_m, 0.0, 1.0]
    off_hole = np.linalg.norm(view.slopes - centre[:2] / centre[2], axis=-1)
    return off_hole < 0.035


def test_renders_repeat_exactly_and_the_cache_returns_the_same_view(
    tmp_path,
    thesis_view,
):
    first, hit = cached_view(SMALL, CAMERA.optics, QUICK, tmp_path)
    assert not hit
    second, hit = cached_view(SMALL, CAMERA.optics, QUICK, tmp_path)
    assert hit
    assert np.array_equal(first.phasor, second.phasor) and np.array_equal(
        first.phasor, thesis_view.phasor
    )
    assert second.region == first.region


def test_cache_key_changes_with_what_matters_only():
    base = render_key(SMALL, CAMERA.optics, QUICK)
    assert render_key(SMALL.hole_free(), CAMERA.optics, QUICK) != base
    assert render_key(SMALL, CAMERA.optics, QUICK.model_copy(update={"bounces": 2})) != base
    gate = CAMERA.engine.edge_threshold.model_copy(update={"value": 9.0})
    engine = CAMERA.engine.model_copy(update={"edge_threshold": gate})
    assert render_key(SMALL, CAMERA.model_copy(update={"engine": engine}).optics, QUICK) == base


@pytest.mark.slow  # a process that loads both, to see what this machine's libraries do
def test_open3d_before_mitsuba_is_told_apart_from_a_missing_llvm():
    code = "import open3d\nfrom scenes.render.scene import load_mitsuba\nload_mitsuba()\n"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if "cannot open shared object file" in done.stderr:
        pytest.skip("Open3D lacks a system library")
    assert done.returncode == 0 or "Open3D was imported before it" in done.stderr


def test_no_llvm_at_all_names_what_to_install(monkeypatch, tmp_path):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "base_prefix", str(tmp_path))
    mistake = variant._point_to_llvm()
    assert mistake is not None
    assert "karellen-llvm-core" in str(mistake)


def test_direct_light_on_the_face_is_exact_to_ten_micrometres(thesis_view):
    """4 x 4 strata (16 x 16 at edges) against 32 x 32 in every pixel of three strips, two of them
    with tape: range from the fused phases, on the face away from holes and rim."""
    target = build_target(SMALL)
    lit = scene_of(*target.parts)
    lens = CAMERA.nominal_lens
    region = thesis_view.region
    f = np.array(CAMERA.frequencies_hz)[:, None]
    for top in (15, 30, 72):
        rows, cols = np.mgrid[top : top + 4, 20:400].reshape(2, -1)
        footprint = Quadrilaterals(lens, region)
        hits = cast(lit, footprint.slopes(rows, cols, footprint.grid(32)).reshape(-1, 2))
        fine = (
            (hits.amplitude * np.exp(1j * WAVE[:, None] * hits.path_m))
            .reshape(len(f), -1, 32**2)
            .mean(axis=-1)
        )
        turned = np.angle(thesis_view.phasor_direct[:, rows, cols] / fine)
        error_m = (SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()) * turned).sum(axis=0)
        away = (
            np.abs(thesis_view.range_m[rows, cols] - np.median(thesis_view.range_m[rows, cols]))
            < 0.2
        )
        assert np.sqrt((error_m[away] ** 2).mean()) < 2e-6
        assert np.abs(error_m[away]).max() < 1e-5
