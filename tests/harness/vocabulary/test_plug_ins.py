"""Detectors and cameras by name, tofpod's own and those of other packages, and the program that
lists them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import detectors
from detectors import detector_names, detector_type, load_detector
from detectors.filters import filter_names
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from detectors.sources import SOURCES
from harness import __version__
from harness.programs.keeping.ls import main
from harness.vocabulary.errors import UserError
from harness.vocabulary.plug_ins import PlugIns
from scenes.sensor import camera as cameras
from scenes.sensor.camera import CAMERA_FOLDER, camera_file, camera_names, load_camera
from tests.support.plug_in_packages import offer

OWN_DETECTORS = (
    "fpfh_memory",
    "learned",
    "local",
    "m3c2",
    "matched",
    "plane_ransac",
    "thesis",
)


MINE = f"{__name__}:Mine"


class Plain:
    """Says nothing of its settings."""


class Mine(ThesisDetector):
    """The thesis' by another name."""

    name = "mine"


class Raises(ThesisDetector):
    """Cannot be made."""

    name = "raises"

    def __init__(self, settings: ThesisConfig) -> None:
        raise ZeroDivisionError("no luck")


def mistake(call, *arguments) -> UserError:
    with pytest.raises(UserError) as caught:
        call(*arguments)
    return caught.value


def listed(capsys: pytest.CaptureFixture[str], kind: str) -> dict[str, list[dict]]:
    assert main([kind, "--json"]) == 0
    rows: dict[str, list[dict]] = {}
    for row in json.loads(capsys.readouterr().out)[kind]:
        rows.setdefault(row["name"], []).append(row)
    return rows


# ---------------------------------------------------------------- the registry


def test_a_plug_in_is_found_without_importing_it_and_gone_when_uninstalled(monkeypatch, tmp_path):
    with monkeypatch.context() as patched:
        offer(patched, tmp_path, "acme", detectors.GROUP, {"mine": MINE, "off": "nope:X"})
        assert detector_names() == tuple(sorted((*OWN_DETECTORS, "mine", "off")))
        assert isinstance(load_detector("mine", {}), Mine)
    assert detector_names() == OWN_DETECTORS


def test_a_package_that_is_installed_later_is_found(monkeypatch, tmp_path):
    offer(
        monkeypatch,
        tmp_path,
        "first",
        detectors.GROUP,
        {"one": "detectors.methods.thesis:ThesisDetector"},
    )
    assert "one" in detector_names() and "two" not in detector_names()
    offer(
        monkeypatch,
        tmp_path,
        "second",
        detectors.GROUP,
        {"two": "detectors.methods.thesis:ThesisDetector"},
    )
    assert {"one", "two"} <= set(detector_names())


def test_installed_packages_are_read_once(monkeypatch):
    import harness.vocabulary.plug_ins as plug_ins

    read = []
    monkeypatch.setattr(plug_ins, "entry_points", lambda group: read.append(group) or ())
    registry = PlugIns("tofpod.nothing", "thing", dict)
    assert [registry.names() for _ in range(3)] == [(), (), ()] and read == ["tofpod.nothing"]


def test_a_name_taken_twice_is_an_error_that_names_both_and_leaves_others_alone(
    monkeypatch, tmp_path
):
    offer(
        monkeypatch,
        tmp_path / "a",
        "acme",
        detectors.GROUP,
        {"thesis": "acme.found:Detector", "x": "p:A"},
    )
    offer(monkeypatch, tmp_path / "b", "bolt", detectors.GROUP, {"x": "q:B", "mine": MINE})
    message = str(mistake(load_detector, "thesis", {}))
    assert "2 detectors are called 'thesis'" in message
    offers = (
        f"detectors.methods.thesis:ThesisDetector (tofpod {__version__}) "
        "and acme.found:Detector (acme 1.2)"
    )
    assert offers in message
    assert "p:A (acme 1.2) and q:B (bolt 1.2)" in str(mistake(detector_type, "x"))
    assert detector_type("mine") is Mine


def test_one_offer_seen_twice_is_no_clash(monkeypatch, tmp_path):
    entries = {"mine": MINE}
    offer(monkeypatch, tmp_path / "a", "acme", detectors.GROUP, entries)
    offer(monkeypatch, tmp_path / "b", "acme-mirror", detectors.GROUP, entries)
    assert detector_type("mine") is Mine


@pytest.mark.parametrize(
    ("target", "why"),
    [
        ("no_such_package:Detector", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("detectors.methods.thesis:NoSuch", "AttributeError"),
        (f"{__name__}:Plain", "no `settings_type`"),
        ("detectors.methods.thesis", "no `settings_type`"),
        (MINE, "it is called 'mine', but offered as 'bad'"),
    ],
)
def test_a_broken_plug_in_is_told_with_its_package(monkeypatch, tmp_path, target, why):
    offer(monkeypatch, tmp_path, "acme-tools", detectors.GROUP, {"bad": target})
    message = str(mistake(load_detector, "bad", {}))
    assert f"detector 'bad' ({target}, of the package acme-tools 1.2) cannot be loaded" in message
    assert why in message and "repair or uninstall the package acme-tools" in message


@pytest.fixture
def quitting(monkeypatch, tmp_path) -> None:
    """A plug-in whose module ends the interpreter."""
    (tmp_path / "acme_quits.py").write_text("import sys\nsys.exit('no licence')\n")
    monkeypatch.delitem(sys.modules, "acme_quits", raising=False)
    offer(
        monkeypatch,
        tmp_path,
        "acme-quits",
        detectors.GROUP,
        {"quits": "acme_quits:Detector", "mine": MINE},
    )


def test_a_plug_in_that_ends_the_program_on_import_is_broken(quitting, capsys):
    message = str(mistake(detector_type, "quits"))
    assert "of the package acme-quits 1.2) cannot be loaded: SystemExit: no licence" in message
    rows = listed(capsys, "detectors")
    assert "SystemExit: no licence" in rows["quits"][0]["broken"]
    assert (
        "broken" not in rows["mine"][0] and rows["thesis"][0]["version"] == ThesisDetector.version
    )


def test_what_is_wrong_with_a_built_in_one_keeps_its_traceback(monkeypatch):
    monkeypatch.setitem(detectors.BUILT_IN, "gone", "detectors.no_such_module:X")
    with pytest.raises(ModuleNotFoundError):
        detector_type("gone")


def test_the_nearest_name_is_told_and_it_may_be_a_plug_in(monkeypatch, tmp_path):
    offer(monkeypatch, tmp_path, "acme", detectors.GROUP, {"wavelet": "acme:D"})
    error = mistake(detector_type, "wavlet")
    assert error.message == "there is no detector 'wavlet'; did you mean 'wavelet'?"
    assert error.legal == ", ".join((*OWN_DETECTORS, "wavelet")) and "tofpod.detectors" in (
        error.fix or ""
    )


def test_a_part_of_a_name_finds_it():
    assert "did you mean 'realsense_l515'?" in mistake(load_camera, "l515").message
    assert "did you mean 'azure_kinect_nfov'?" in mistake(load_camera, "Azure").message
    assert "did you mean" not in mistake(load_camera, "nf").message, (
        "two letters are in too many words"
    )


# ---------------------------------------------------------------- cameras


@pytest.fixture
def acme_camera(monkeypatch, tmp_path) -> Path:
    """A package's camera: a Kinect v2 by another name."""
    text = (
        (CAMERA_FOLDER / "kinect_v2.yaml")
        .read_text()
        .replace("name: kinect_v2", "name: acme_tof", 1)
    )
    (tmp_path / "acme_tof.yaml").write_text(text)
    (tmp_path / "acme_cameras.py").write_text(
        "from pathlib import Path\nFILE = Path(__file__).parent / 'acme_tof.yaml'\nTEXT = "
        "str(FILE)\nNUMBER = 7\n"
    )
    offer(monkeypatch, tmp_path, "acme-cameras", cameras.GROUP, {"acme_tof": "acme_cameras:FILE"})
    monkeypatch.delitem(sys.modules, "acme_cameras", raising=False)
    return tmp_path / "acme_tof.yaml"


def test_a_packages_camera_is_read_like_any_other(acme_camera):
    assert {"acme_tof", "azure_kinect_nfov", "kinect_v2", "realsense_l515"} < set(camera_names())
    assert camera_file("acme_tof") == acme_camera
    camera = load_camera("kinect_v2")
    copied = load_camera("acme_tof")
    assert copied.name == "acme_tof" and copied.to_data() == {
        **camera.to_data(),
        "name": "acme_tof",
    }


def test_a_number_that_a_packages_camera_has_not_is_told_with_its_file(acme_camera):
    config = cameras.CameraConfig(name="acme_tof", numbers={"lens.fx": 500.0})
    assert str(acme_camera) in str(mistake(cameras.camera_of, config))
    config = cameras.CameraConfig(name="kinect_v2", numbers={"lens.fx": 500.0})
    assert "scenes/cameras/kinect_v2.yaml" in str(mistake(cameras.camera_of, config))


@pytest.mark.parametrize(
    ("name", "target", "why"),
    [
        ("other", "acme_cameras:TEXT", "needs a file called other.yaml"),
        ("acme", "acme_cameras:NUMBER", "it must be the path of a YAML file, not int"),
        ("nope", "acme_cameras:NOPE", "AttributeError"),
    ],
)
def test_a_packages_camera_that_is_no_file_is_told_with_its_package(
    acme_camera, monkeypatch, name, target, why
):
    offer(monkeypatch, acme_camera.parent / "more", "more-cameras", cameras.GROUP, {name: target})
    message = str(mistake(load_camera, name))
    assert (
        f"camera {name!r} ({target}, of the package more-cameras 1.2) cannot be loaded" in message
        and why in message
    )


def test_a_packages_camera_whose_file_is_gone_is_told(acme_camera):
    acme_camera.unlink()
    assert "there is no such file" in str(mistake(load_camera, "acme_tof"))


# ---------------------------------------------------------------- what is listed


def test_everything_is_listed_with_where_it_comes_from(acme_camera, capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert (
        "detectors (entry points: tofpod.detectors)" in out
        and "cameras (entry points: tofpod.cameras)" in out
    )
    lines = {
        line.split()[0]: line
        for line in out.splitlines()
        if line and "(entry" not in line and not line.startswith("name ")
    }
    assert set(lines) - {"results", "cache:"} == {
        *OWN_DETECTORS,
        *filter_names(),
        *camera_names(),
        *SOURCES.names(),
    }
    assert "Start the first camera" in lines["oak"]
    assert (
        f"tofpod {__version__}" in lines["thesis"]
        and f" {ThesisDetector.version} " in lines["thesis"]
    )
    assert "acme-cameras 1.2" in lines["acme_tof"] and "512 x 424" in lines["acme_tof"]
    assert "0.5 to 4.5 m" in lines["acme_tof"] and "860 nm" in lines["acme_tof"]


def test_broken_ones_and_clashes_are_listed_as_such_and_the_program_succeeds(
    monkeypatch, tmp_path, capsys
):
    entries = {"bad": "no_such:X", "raises": f"{__name__}:Raises", "thesis": f"{__name__}:Plain"}
    offer(monkeypatch, tmp_path, "acme", detectors.GROUP, entries)
    rows = listed(capsys, "detectors")
    assert "No module named 'no_such'" in rows["bad"][0]["broken"]
    assert "ZeroDivisionError: no luck" in rows["raises"][0]["broken"]
    assert [row["package"] for row in rows["thesis"]] == ["tofpod", "acme"]
    assert all("2 detectors are called 'thesis'" in row["broken"] for row in rows["thesis"])
    assert "broken" not in rows["local"][0]
    assert main(["detectors"]) == 0
    assert "broken: detector 'bad'" in capsys.readouterr().out


def test_a_named_detector_shows_its_settings_and_what_is_legal(capsys):
    assert main(["detectors", "thesis", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    settings = {setting["path"]: setting for setting in shown["settings"]}
    assert shown["version"] == ThesisDetector.version and shown["package"] == "tofpod"
    assert settings["surface.degree"] == {
        "path": "surface.degree",
        "value": 3,
        "about": "a whole number from 0 to 8",
    }
    assert settings["crop.kind"]["about"] == "one of none, box, polygon, auto"
    # the listed defaults are all of the settings: they make the same declaration
    rebuilt: dict = {}
    for path, setting in settings.items():
        index = rebuilt
        *groups, leaf = path.split(".")
        for group in groups:
            index = index.setdefault(group, {})
        index[leaf] = setting["value"]
    assert ThesisConfig.from_data(rebuilt) == ThesisConfig()
    assert main(["detectors", "thesis"]) == 0
    text = capsys.readouterr().out
    assert "surface.method" in text and "one of lar, bisquare, lts, least_squares" in text


def test_a_named_camera_shows_every_number_with_its_source(capsys):
    assert main(["cameras", "kinect_v2", "--json"]) == 0
    numbers = {load["path"]: load for load in json.loads(capsys.readouterr().out)["numbers"]}
    facts = load_camera("kinect_v2")
    assert numbers["lens.fx_px"]["value"] == facts.lens.fx_px.value
    assert numbers["lens.fx_px"]["about"].endswith(facts.lens.fx_px.source)
    assert set(numbers) == set(cameras.number_paths(facts.to_data()))


def test_a_name_alone_is_looked_for_in_both_lists(acme_camera, monkeypatch, capsys):
    assert main(["thesis"]) == 0
    alone = capsys.readouterr().out
    assert main(["detectors", "thesis"]) == 0
    assert capsys.readouterr().out == alone
    offer(
        monkeypatch,
        acme_camera.parent / "more",
        "more",
        detectors.GROUP,
        {"mine": MINE, "kinect_v2": "no_such:X"},
    )
    assert main(["acme_tof", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == ["cameras"]
    offer(
        monkeypatch,
        acme_camera.parent / "camera",
        "mine",
        cameras.GROUP,
        {"mine": "acme_cameras:MINE"},
    )
    (acme_camera.parent / "mine.yaml").write_text(
        acme_camera.read_text().replace("name: acme_tof", "name: mine", 1)
    )
    monkeypatch.setattr(
        sys.modules["acme_cameras"], "MINE", acme_camera.parent / "mine.yaml", raising=False
    )
    assert main(["mine", "--json"]) == 0
    pair = json.loads(capsys.readouterr().out)
    assert (pair["detectors"]["package"], pair["cameras"]["columns"]) == ("more", 512)


def test_what_is_neither_a_kind_nor_a_name(capsys):
    for words, nearby in (
        (["thesys"], "thesis"),
        (["l515"], "realsense_l515"),
        (["detector", "thesis"], "detectors"),
    ):
        assert main(words) == 2
        error_text = capsys.readouterr().err
        assert (
            f"there is nothing called {words[0]!r} to list; did you mean {nearby!r}?" in error_text
            and "legal: " in error_text
        )


def test_mistakes_are_one_message(capsys, monkeypatch, tmp_path):
    assert main(["detectors", "thesys"]) == 2
    assert "did you mean 'thesis'" in capsys.readouterr().err
    assert main(["cameras", "azure"]) == 2
    assert "there is no camera 'azure'" in capsys.readouterr().err
    offer(monkeypatch, tmp_path, "acme", detectors.GROUP, {"bad": "no_such:X"})
    assert main(["detectors", "bad"]) == 2
    assert "of the package acme 1.2" in capsys.readouterr().err
