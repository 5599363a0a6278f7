"""Camera files, what an experiment may change of them, and what a camera can and cannot look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.experiment.load import lens_numbers, load_experiment
from harness.sweep import main
from harness.vocabulary.errors import UserError
from scenes.perspectives import check_in_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.calibration import _main as calibration_program
from scenes.sensor.camera import (
    CAMERA_FOLDER,
    camera_names,
    camera_of,
    guessed_precision,
    lens_named,
    load_camera,
    read_camera,
)
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.facts import unfolded_slope
from scenes.target.mesh import build_target
from tests.support.declared_targets import target_from_data

AZURE = (CAMERA_FOLDER / "azure_kinect_nfov.yaml").read_text()
SMOKE = "experiments/smoke.yaml"


def thesis(**facts):
    return target_from_data({"name": "thesis", **facts}).declare()


@pytest.mark.parametrize("name", camera_names())
def test_every_camera_file_is_read_and_names_its_sources(name):
    camera = load_camera(name)
    assert camera.name == name
    lens = camera.optics.lens
    assert 0 < lens.cx < lens.width
    assert 0 < lens.cy < lens.height


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        (
            "fx_px: {value: 504.647",
            "fx_px: {value: 0.0",
            ":12:10: `lens.fx_px`: the value is 0.0; it must be above 0",
        ),
        ("width_px: {value: 640", "width_px: {valu: 640", "`lens.width_px` lacks the key `value`"),
        ("  width_px: {value: 640", "  widht_px: {value: 640", "did you mean: width_px"),
        ("[0.5825, 0.0061", "[-3.0, 0.0061", "distortion folds the image: it turns back at 0.202"),
        ("kind: amcw_imager", "kind: amcw_imgr", "did you mean: amcw_imager"),
        ("kind: amcw_imager\n", "", "the file lacks the key `kind`"),
        (
            "name: azure_kinect_nfov",
            "name: other",
            "`name` is other, but the file is azure_kinect_nfov.yaml",
        ),
        (
            "wavelength_nm: {value: 850.0",
            "wavelength_nm: {value: 850000.0",
            "from 300 to 2000 nanometres",
        ),
        ("tag: W", "tag: Q", "is none of the legal values"),
        ("lens:", "lens: [", "azure_kinect_nfov.yaml:"),
        ("[-14.0, 0.0, 1.0]", "[-14.0, .nan, 1.0]", "emitter.position_mm"),
    ],
)
def test_a_bad_camera_file_is_one_message_with_file_line_and_key(tmp_path, old, new, wanted):
    assert old in AZURE
    path = tmp_path / "azure_kinect_nfov.yaml"
    path.write_text(AZURE.replace(old, new, 1))
    with pytest.raises(UserError) as caught:
        read_camera(path)
    assert wanted in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_kind_that_is_a_list_is_refused(tmp_path):
    path = tmp_path / "azure_kinect_nfov.yaml"
    path.write_text(AZURE.replace("kind: amcw_imager", "kind: [amcw_imager]"))
    with pytest.raises(UserError, match=r"`kind` is .*none of the legal values"):
        read_camera(path)


def test_impossible_frequencies_are_named(tmp_path):
    path = tmp_path / "azure_kinect_nfov.yaml"
    path.write_text(AZURE.replace("[198.0e+6", "[-198.0e+6", 1))
    with pytest.raises(UserError, match="frequencies_hz"):
        read_camera(path)


OWN = "name: own\ntitle: my own\nlike: azure_kinect_nfov\n"


def test_a_camera_like_another_states_only_what_differs(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(
        OWN
        + "photons: {signal_electrons: {value: 600.0, tag: M, source: guess}}\n"
        + "engine: {edge_threshold: null}\n"
    )
    camera = load_camera(str(path))
    azure = load_camera("azure_kinect_nfov")
    assert (camera.name, camera.title) == ("own", "my own")
    assert camera.photons.signal_electrons.value == 600.0
    assert camera.photons.band_nm == azure.photons.band_nm
    assert camera.engine.edge_threshold is None
    assert camera.engine.window_px == azure.engine.window_px
    assert camera.lens == azure.lens
    assert not camera.modes
    second = tmp_path / "second.yaml"
    second.write_text("name: second\ntitle: of that\nlike: own.yaml\n")
    assert load_camera(str(second)).photons.signal_electrons.value == 600.0


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("name: own\ntitle: t\nlike: azure_kinect_nfv\n", "azure_kinect_nfov"),
        ("name: own\ntitle: t\nlike: own.yaml\n", "own.yaml:3:7: `like` chains"),
        ("name: own\ntitle: t\nlike: [a]\n", "own.yaml:3:7: `like` is not the name of a camera"),
        (
            OWN + "photons: {signal_electrons: {value: -1.0, tag: M, source: guess}}\n",
            "own.yaml:4:",
        ),
        (OWN + "lens: {fx: {value: 1.0, tag: M, source: guess}}\n", "unknown key `fx` in `lens`"),
        (
            OWN + "modulation: {frequencies_hz: {value: [2.0e+7], tag: M, source: guess}}\n",
            "own.yaml:4:13: `modulation`: contrast needs one value for each",
        ),
    ],
)
def test_mistakes_in_a_camera_like_another_are_told_where_they_stand(tmp_path, text, wanted):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_camera(path)
    assert wanted in str(caught.value)


def test_an_experiment_names_a_camera_by_its_file(tmp_path, capsys):
    (tmp_path / "own.yaml").write_text(OWN)
    (tmp_path / "a.yaml").write_text(Path(SMOKE).read_text())
    by_name = load_experiment(tmp_path / "a.yaml", ["source.camera.name=azure_kinect_nfov"])
    text = (tmp_path / "a.yaml").read_text()
    assert "name: azure_kinect_nfov" in text
    (tmp_path / "a.yaml").write_text(text.replace("name: azure_kinect_nfov", "name: ./own.yaml", 1))
    by_file = load_experiment(tmp_path / "a.yaml")
    assert camera_of(by_file.points[0].config.source.camera).name == "own"
    assert by_file.points[0].digest != by_name.points[0].digest
    axis = f"sweep={{source.camera.name: [azure_kinect_nfov, {tmp_path / 'own.yaml'}]}}"
    swept = load_experiment(SMOKE, [axis, "sensitivity=null"])
    assert [point.variant for point in swept.points] == ["camera=azure_kinect_nfov", "camera=own"]
    assert (
        main(
            [
                SMOKE,
                "--dry-run",
                "--out",
                str(tmp_path / "out"),
                "--set",
                "source.camera.name=./no.yaml",
            ]
        )
        == 2
    )
    assert "there is no such file" in capsys.readouterr().err


@pytest.mark.parametrize("mode", load_camera("azure_kinect_nfov").modes)
def test_a_mode_is_a_camera_that_knows_the_others(mode):
    assert lens_named(mode).plain == load_camera(mode).nominal_lens
    assert lens_named(mode).mode == mode
    assert len(lens_named(mode).others) == 4
    data = load_camera("azure_kinect_nfov").to_data() | {"modes": {mode: {"width_px": 1}}}
    assert AmcwCamera.from_data(data).modes == (mode,)  # as older files say it


def test_a_guess_of_the_precision_states_its_range(tmp_path):
    path = tmp_path / "own.yaml"
    for range_, legal in (
        ("range: [300.0, 1200.0],", True),
        ("range: [600.0, 600.0],", True),
        ("range: [700.0, 1200.0],", False),
        ("range: [100.0, 500.0],", False),
        ("", False),
    ):
        fact = f"{{value: 600.0, tag: G, {range_} source: guess}}"
        path.write_text(OWN + f"photons: {{signal_electrons: {fact}}}\n")
        if legal:
            assert read_camera(path).photons.signal_electrons.range is not None
        else:
            with pytest.raises(UserError, match="`range`"):
                read_camera(path)


@pytest.mark.parametrize("tag", ["R", "D", "S", "W", "O", "C", "M", "U"])
def test_a_number_with_any_tag_may_state_its_range(tmp_path, tag):
    path = tmp_path / "own.yaml"
    fact = f"{{value: 600.0, tag: {tag}, range: [300.0, 1200.0], source: test}}"
    path.write_text(OWN + f"photons: {{signal_electrons: {fact}}}\n")
    camera = read_camera(path)
    assert camera.photons.signal_electrons.range == (300.0, 1200.0)
    assert guessed_precision(camera) == ""


def test_each_of_several_values_lies_in_the_range(tmp_path):
    path = tmp_path / "own.yaml"
    for least, legal in ((0.4, True), (0.6, False)):
        fact = f"{{value: [0.5, 0.7, 0.9], tag: M, range: [{least}, 1.0], source: test}}"
        path.write_text(OWN + f"modulation: {{contrast: {fact}}}\n")
        if legal:
            read_camera(path)
        else:
            with pytest.raises(UserError, match="the value is 0.5; its `range` is 0.6 to 1.0"):
                read_camera(path)


def test_an_experiment_may_leave_the_range_of_a_number():
    config = CameraConfig(name="femto_bolt_nfov", numbers={"photons.signal_electrons": 9999.0})
    gain = camera_of(config).photons.signal_electrons
    assert gain.value == 9999.0
    assert gain.range is None


def test_a_lens_may_fold_outside_its_field(tmp_path):
    wide = (
        "lens:\n"
        "  width_px: {value: 1024, tag: R, source: s}\n"
        "  height_px: {value: 1024, tag: R, source: s}\n"
        "  cx_px: {value: 513.738, tag: R, source: s}\n"
        "  cy_px: {value: 513.338, tag: R, source: s}\n"
    )
    path = tmp_path / "own.yaml"
    path.write_text(OWN + wide)
    with pytest.raises(UserError, match="folds the image"):
        read_camera(path)
    path.write_text(OWN + wide + "  field_half_angle_deg: {value: 60.0, tag: R, source: s}\n")
    camera = read_camera(path)
    outside = camera.lens.outside_field(camera.nominal_lens.whole)
    # the circle of 120 degrees just fits the sensor of 1024 x 1024 pixels
    radius_px = np.sqrt((~outside).sum() / np.pi)
    assert 511 < radius_px < 513
    assert outside[0, 0]
    assert not outside[512, 512]
    # and so do the directions
    just_in = np.array([[-np.tan(np.deg2rad(59.9)), 0.0, 1.0]])
    just_out = np.array([[-np.tan(np.deg2rad(60.1)), 0.0, 1.0]])
    assert camera.images(just_in).all()
    assert not camera.images(just_out).any()


def test_distortion_unfolds_up_to_where_its_slope_vanishes():
    # r (1 - r^2) grows until r = 1/sqrt 3, where it is 2 / (3 sqrt 3)
    folded = unfolded_slope((-1.0, 0, 0, 0, 0, 0, 0, 0))
    assert folded == pytest.approx(2 / 3**1.5, abs=1e-6)
    assert unfolded_slope((0.0,) * 8) == np.inf
    assert unfolded_slope((0.1, 0, 0, 0, 0, 0, 0, 0)) == np.inf
    # the image of a rational model with a pole goes on for ever
    assert unfolded_slope((0, 0, 0, 0, 0, -1.0, 0, 0)) == np.inf


def test_an_experiment_replaces_numbers_of_a_camera():
    camera = camera_of(
        CameraConfig(numbers={"lens.fx_px": 500.0, "emitter.position_mm": [-20.0, 0.0, 0.0]})
    )
    nominal = load_camera("azure_kinect_nfov")
    assert camera.optics.lens.fx == 500.0
    assert camera.lens.fx_px.tag == "U"
    assert camera.optics.emitter_m.tolist() == [-0.02, 0.0, 0.0]
    assert camera.optics.lens.fy == nominal.optics.lens.fy
    assert camera.optics.content() != nominal.optics.content()
    assert camera_of(CameraConfig()) is nominal
    with pytest.raises(UserError, match=r"no number 'lens.fx'; did you mean 'lens.f[xy]_px'"):
        camera_of(CameraConfig(numbers={"lens.fx": 500.0}))
    with pytest.raises(UserError, match=r"lens.fx_px.*above 0"):
        camera_of(CameraConfig(numbers={"lens.fx_px": -1.0}))
    with pytest.raises(
        UserError, match=r"modulation.contrast.value` is 0.5: it should be a list"
    ) as caught:
        camera_of(CameraConfig(numbers={"modulation.contrast": 0.5}))
    assert "Value error" not in str(caught.value)


def test_albedos_near_850_nm_hold_and_others_must_be_declared():
    target = thesis()
    for wavelength_nm in (830.0, 850.0, 860.0, 870.0):
        assert target.at_wavelength(wavelength_nm).material.albedo_850 == 0.6
    with pytest.raises(UserError, match="no albedo at 940 nm"):
        target.at_wavelength(940.0)
    entry = {
        "wavelength_nm": 940.0,
        "board": 0.5,
        "tape": 0.4,
        "backing": 0.3,
        "floor": 0.2,
        "back_wall": 0.1,
    }
    at_945 = thesis(other_wavelengths=[entry]).at_wavelength(945.0)
    albedos = {part.name: part.albedo_850 for part in build_target(at_945).parts}
    assert albedos["board"] == pytest.approx(0.5, rel=1e-3)
    assert (albedos["tape_1"], albedos["backing"], albedos["floor"], albedos["back_wall"]) == (
        0.4,
        0.3,
        0.2,
        0.1,
    )
    with pytest.raises(UserError, match="at 940 nm there is no albedo for tape, floor"):
        partial = {key: value for key, value in entry.items() if key not in ("tape", "floor")}
        thesis(other_wavelengths=[partial]).at_wavelength(940.0)


def test_the_nearest_declared_albedo_counts():
    entry = {
        "wavelength_nm": 860.0,
        "board": 0.2,
        "tape": 0.4,
        "backing": 0.3,
        "floor": 0.2,
        "back_wall": 0.1,
    }
    target = thesis(other_wavelengths=[entry])
    assert target.at_wavelength(860.0).material.albedo_850 == 0.2
    assert target.at_wavelength(850.0).material.albedo_850 == 0.6


def test_a_board_s_albedo_elsewhere_may_follow_its_own():
    entry = {
        "wavelength_nm": 940.0,
        "board": "as_at_850",
        "tape": 0.4,
        "backing": 0.3,
        "floor": 0.2,
        "back_wall": 0.1,
    }
    for albedo in (0.2, 0.6):
        board = {
            "name": "custom",
            "board": {"width_mm": 90.0, "height_mm": 80.0, "thickness_mm": 9.0},
        }
        target = target_from_data(
            {**board, "material": {"albedo_850": albedo}, "other_wavelengths": [entry]}
        )
        assert target.at_wavelength(940.0).material.albedo_850 == albedo


def test_a_target_out_of_sight_or_range_is_told_before_anything_runs():
    optics = load_camera("azure_kinect_nfov").optics
    check_in_view(thesis(), optics)
    check_in_view(thesis(distance_m=0.35), optics)  # its ends are out of view, its middle is seen
    with pytest.raises(UserError, match="the target is out of view"):
        check_in_view(thesis(offset_y_mm=900.0), optics)
    with pytest.raises(UserError, match="none of the target's 11 damages is in view"):
        check_in_view(thesis(offset_y_mm=400.0), optics)
    partly = type(optics)(**{**optics.__dict__, "nearest_m": 0.72})
    check_in_view(thesis(), partly)
    # all of the face nearer than 0.5 m along the axis, though not along the rays
    with pytest.raises(UserError, match=r"to 0\.4\d+ m from the camera"):
        check_in_view(thesis(distance_m=0.46), load_camera("kinect_v2").optics)
    from_900_mm = type(optics)(**{**optics.__dict__, "nearest_m": 0.9})
    with pytest.raises(UserError, match=r"lies 0.\d+ to 0.\d+ m from the camera"):
        check_in_view(thesis(), from_900_mm)


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("source.target.offset_x_mm=1500.0", "smoke.yaml:9:11: the target is out of view"),
        ("source.camera.numbers={lens.fx_px: 0.0}", "lens.fx_px"),
        ("source.camera.numbers={wavelength_nm: 940.0}", "the target has no albedo at 940 nm"),
        ("source.render.seed=5000000", "less than or equal to 1000000"),
        ("source.camera.name=azure_kinect_nfv", "did you mean: azure_kinect_nfov"),
        ("source.camera.effects.wigling=true", "did you mean: source.camera.effects.wiggling"),
    ],
)
def test_mistakes_about_cameras_end_with_one_message(override, wanted, capsys, tmp_path):
    assert main([SMOKE, "--dry-run", "--out", str(tmp_path), "--set", override]) == 2
    assert wanted in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_recordings_own_lens_takes_the_nominal_ones_place(shared_data):
    recording = next((shared_data / "azure_mkv").glob("*.mkv"))
    numbers = lens_numbers(recording, ["azure_kinect_nfov"])
    (point, *_) = load_experiment(SMOKE, [], recording).points
    lens = camera_of(point.config.source.camera).optics.lens
    nominal = load_camera("azure_kinect_nfov").optics.lens
    assert lens.fx == numbers["lens.fx_px"] != nominal.fx
    # five published units agree to 0.3 px in focal length and scatter by some 10 px in their
    # centre
    assert abs(lens.fx - nominal.fx) < 1
    assert abs(lens.cx - nominal.cx) < 20
    with pytest.raises(UserError, match=r"512 x 424"):
        lens_numbers(recording, ["kinect_v2"])


def test_calibrating_an_unknown_camera_is_one_message(capsys):
    assert calibration_program(["nope"]) == 2
    assert "there is no camera 'nope'" in capsys.readouterr().err


def test_one_value_on_an_axis_tells_no_set_ups_apart():
    several = load_experiment(
        "experiments/cameras.yaml",
        [
            "sweep.source.target.distance_m=[0.75]",
            "sweep.source.camera.unit_seed=[1]",
            "sensitivity=null",
        ],
    )
    names = ("azure_kinect_nfov", "kinect_v2", "realsense_l515")
    assert {point.variant for point in several.points} == {f"camera={name}" for name in names}


def test_a_calibration_that_is_none_is_refused(tmp_path, capsys):
    path = tmp_path / "not.mkv"
    path.write_bytes(b"no recording")
    assert (
        main([SMOKE, "--dry-run", "--out", str(tmp_path / "out"), "--calibration", str(path)]) == 2
    )
    assert "not.mkv" in capsys.readouterr().err


def test_the_camera_of_the_documentation_is_legal(tmp_path):
    text = Path("docs/add_a_camera.md").read_text()
    block = text.split("    # blaze101.yaml\n", 1)[1].split("\n\nEvery number", 1)[0]
    path = tmp_path / "blaze101.yaml"
    path.write_text("\n".join(line[4:] for line in block.splitlines()))
    camera = load_camera(str(path))
    assert camera.photons.signal_electrons.range == (6400.0, 102000.0)
    albedos = "[{wavelength_nm: 940.0, board: 0.6, backing: 0.6, floor: 0.3, back_wall: 0.6}]"
    changes = [f"source.camera.name={path}", f"source.target.other_wavelengths={albedos}"]
    (point, *_) = load_experiment("experiments/detection_limit.yaml", changes).points
    assert camera_of(point.config.source.camera) == camera


def test_what_a_guessed_gain_means_is_told(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(
        OWN
        + (
            "photons: {signal_electrons: {value: 600.0, tag: G, range: [150.0, 2400.0], source: "
            "s}}\n"
        )
    )
    assert guessed_precision(load_camera(str(path))).endswith("which may be 0.5 to 2 times as much")
    assert guessed_precision(load_camera("azure_kinect_nfov")) == ""
