"""Adapters of cameras against stand-ins with the interface that their makers document: units,
lens, times and ends."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from detectors.sources import SOURCES, open_source
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens
from tests.support.plug_in_packages import offer

ROOT = Path(__file__).resolve().parents[3]
WIDTH = 4
HEIGHT = 3
DISTORTION = (0.5, -0.02, 2e-5, -7e-5, -0.003, 0.9, 0.09, -0.01)
LENS = Lens(WIDTH, HEIGHT, 150.0, 151.0, 1.5, 1.25)
BENT = Lens(WIDTH, HEIGHT, 150.0, 151.0, 1.5, 1.25, DISTORTION)


def stored(number: int) -> np.ndarray:
    """Depth (h, w) of a frame, with one pixel that has none."""
    numbers = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) + 4000 + number
    numbers[1, 2] = 0
    return numbers


def install(monkeypatch: pytest.MonkeyPatch, name: str, **members: Any) -> None:
    module = ModuleType(name)
    for key, value in members.items():
        setattr(module, key, value)
    monkeypatch.setitem(sys.modules, name, module)


def read(name: str, count: int, path: Path | None = None) -> tuple[Lens, float, list[Frame]]:
    """Return lens, unit and the first frames of a source, after it was closed."""
    with open_source(name, path) as stream:
        frames = [frame for _, frame in zip(range(count), stream.frames, strict=False)]
        return stream.lens, stream.unit_m, frames


def assert_frame(frame: Frame, number: int, unit_m: float, time_s: float) -> None:
    expected = np.where(stored(number) > 0, stored(number) * unit_m, np.nan)
    np.testing.assert_allclose(frame.z_m, expected, rtol=1e-6)
    assert frame.time_s == pytest.approx(time_s)


# ---------------------------------------------------------------- pyrealsense2


class RealSense:
    """librealsense: a pipeline that is started by a configuration."""

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self.log: list[str] = []
        self.model = "brown"

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        install(
            monkeypatch,
            "pyrealsense2",
            pipeline=lambda: self,
            config=lambda: self,
            stream=SimpleNamespace(depth="depth"),
            distortion=SimpleNamespace(none="none", brown_conrady="brown", ftheta="ftheta"),
        )

    def enable_stream(self, stream: str) -> None:
        self.log.append(f"enable {stream}")

    def enable_device_from_file(self, path: str, repeat_playback: bool) -> None:
        assert not repeat_playback
        self.log.append(f"play {Path(path).name}")

    def start(self, config: object) -> RealSense:
        assert config is self
        return self

    def get_device(self) -> RealSense:
        return self

    def as_playback(self) -> RealSense:
        return self

    def set_real_time(self, is_real_time: bool) -> None:
        self.log.append(f"real time {is_real_time}")

    def first_depth_sensor(self) -> SimpleNamespace:
        return SimpleNamespace(get_depth_scale=lambda: float(np.float32(0.00025)))

    def get_stream(self, stream: str) -> SimpleNamespace:
        assert stream == "depth"
        stated = SimpleNamespace(
            width=WIDTH, height=HEIGHT, fx=150.0, fy=151.0, ppx=1.5, ppy=1.25, model=self.model
        )
        stated.coeffs = [0.0] * 5 if self.model == "brown" else [0.1] * 5
        profile = SimpleNamespace(get_intrinsics=lambda: stated)
        return SimpleNamespace(as_video_stream_profile=lambda: profile)

    def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, Any]:
        number = len([entry for entry in self.log if entry == "frame"])
        if number == self.frames:
            return False, None
        self.log.append("frame")
        depth = SimpleNamespace(
            get_data=lambda: stored(number), get_timestamp=lambda: 1000.0 + 33.0 * number
        )
        return True, SimpleNamespace(get_depth_frame=lambda: depth)

    def stop(self) -> None:
        self.log.append("stop")


def test_realsense_plays_a_recording_to_its_end(monkeypatch, tmp_path: Path):
    camera = RealSense(3)
    camera.install(monkeypatch)
    (tmp_path / "a.db3").write_bytes(b"")
    lens, unit_m, frames = read("realsense", 9, tmp_path / "a.db3")
    assert (lens, unit_m, len(frames)) == (LENS, 0.00025, 3)
    assert_frame(frames[2], 2, 0.00025, 1.066)
    assert camera.log[:3] == ["enable depth", "play a.db3", "real time False"]
    assert camera.log[-1] == "stop"


def test_a_live_realsense_that_falls_silent_is_told_and_stopped(monkeypatch):
    camera = RealSense(2)
    camera.install(monkeypatch)
    with pytest.raises(UserError, match="realsense: no frame came for 5 s"):
        read("realsense", 9)
    assert camera.log[-1] == "stop" and "real time False" not in camera.log


def test_a_lens_model_that_is_not_opencvs_is_refused(monkeypatch):
    camera = RealSense(2)
    camera.model = "ftheta"
    camera.install(monkeypatch)
    with pytest.raises(UserError, match="lens model ftheta"):
        read("realsense", 1)
    assert camera.log[-1] == "stop"


# ---------------------------------------------------------------- pyk4a


class AzureKinect:
    """pyk4a: a device, or a playback, that gives captures."""

    def __init__(self, frames: int) -> None:
        self.numbers: Iterator[int] = iter(range(frames))
        self.log: list[str] = []

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        install(
            monkeypatch,
            "pyk4a",
            Config=lambda **settings: settings,
            ColorResolution=SimpleNamespace(OFF=0),
            DepthMode=SimpleNamespace(NFOV_UNBINNED=2),
            FPS=SimpleNamespace(FPS_30=2),
            CalibrationType=SimpleNamespace(DEPTH=0),
            PyK4A=self.device,
            PyK4APlayback=self.playback,
        )

    def device(self, config: dict[str, Any]) -> AzureKinect:
        assert config["depth_mode"] == 2 and config["color_resolution"] == 0
        return self

    def playback(self, path: Path) -> AzureKinect:
        self.log.append(path.name)
        return self

    def start(self) -> None:
        self.log.append("start")

    def open(self) -> None:
        self.log.append("open")

    def stop(self) -> None:
        self.log.append("stop")

    def close(self) -> None:
        self.log.append("close")

    @property
    def calibration(self) -> SimpleNamespace:
        matrix = np.array([[150.0, 0, 1.5], [0, 151.0, 1.25], [0, 0, 1]])
        return SimpleNamespace(
            get_camera_matrix=lambda camera: matrix,
            get_distortion_coefficients=lambda camera: np.array(DISTORTION),
        )

    def get_capture(self, timeout: int) -> SimpleNamespace:
        assert timeout == 5000
        number = next(self.numbers, None)
        if number is None:
            raise RuntimeError("K4ATimeoutException")
        depth = None if number == 1 else stored(number)
        infrared = np.full((HEIGHT, WIDTH), 900 + number, np.uint16)
        stamp = 800_222 + 33_333 * number
        return SimpleNamespace(depth=depth, ir=infrared, depth_timestamp_usec=stamp)

    def get_next_capture(self) -> SimpleNamespace:
        try:
            return self.get_capture(5000)
        except RuntimeError:
            raise EOFError from None


def test_k4a_plays_a_recording_and_leaves_captures_without_depth_out(monkeypatch, tmp_path: Path):
    camera = AzureKinect(4)
    camera.install(monkeypatch)
    (tmp_path / "a.mkv").write_bytes(b"")
    lens, unit_m, frames = read("k4a", 9, tmp_path / "a.mkv")
    assert (lens, unit_m, len(frames)) == (BENT, 0.001, 3)
    assert_frame(frames[1], 2, 0.001, 0.866888)
    assert frames[1].amplitude is not None and frames[1].amplitude[0, 0] == 902
    assert camera.log == ["a.mkv", "open", "close"]


def test_a_live_k4a_is_started_and_stopped(monkeypatch):
    camera = AzureKinect(3)
    camera.install(monkeypatch)
    assert len(read("k4a", 1)[2]) == 1
    assert camera.log == ["start", "stop"]
    with pytest.raises(UserError, match="camera k4a: K4ATimeoutException"):
        read("k4a", 9)


# ---------------------------------------------------------------- pyorbbecsdk


class Femto:
    """pyorbbecsdk: a pipeline whose frames are bytes with a scale in millimetres."""

    def __init__(self, model: str = "K6") -> None:
        self.enabled: list[str] = []
        self.count = 0
        self.is_stopped = False
        self.model = model

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        install(
            monkeypatch,
            "pyorbbecsdk",
            Pipeline=lambda: self,
            Config=lambda: self,
            OBSensorType=SimpleNamespace(DEPTH_SENSOR="depth", IR_SENSOR="ir"),
            OBFormat=SimpleNamespace(Y16="Y16"),
            OBCameraDistortionModel=SimpleNamespace(
                NONE="NONE", BROWN_CONRADY="BC", BROWN_CONRADY_K6="K6"
            ),
        )

    def get_stream_profile_list(self, sensor: str) -> SimpleNamespace:
        return SimpleNamespace(get_default_video_stream_profile=lambda: f"profile of {sensor}")

    def enable_stream(self, profile: str) -> None:
        self.enabled.append(profile)

    def start(self, config: object) -> None:
        assert config is self

    def stop(self) -> None:
        self.is_stopped = True

    def _frame(self, numbers: np.ndarray) -> SimpleNamespace:
        k1, k2, p1, p2, k3, k4, k5, k6 = DISTORTION
        bent = SimpleNamespace(k1=k1, k2=k2, k3=k3, k4=k4, k5=k5, k6=k6, p1=p1, p2=p2)
        bent.model = self.model
        stated = SimpleNamespace(width=WIDTH, height=HEIGHT, fx=150.0, fy=151.0, cx=1.5, cy=1.25)
        profile = SimpleNamespace(get_intrinsic=lambda: stated, get_distortion=lambda: bent)
        number = self.count
        return SimpleNamespace(
            get_data=lambda: np.frombuffer(numbers.tobytes(), np.uint8),
            get_width=lambda: WIDTH,
            get_height=lambda: HEIGHT,
            get_format=lambda: "Y16",
            get_depth_scale=lambda: 0.25,
            get_timestamp_us=lambda: 5_000_000 + 33_333 * number,
            get_stream_profile=lambda: SimpleNamespace(as_video_stream_profile=lambda: profile),
        )

    def wait_for_frames(self, timeout_ms: int) -> SimpleNamespace | None:
        if self.count == 3:
            return None
        depth = self._frame(stored(self.count))
        infrared = self._frame(np.full((HEIGHT, WIDTH), 700, np.uint16))
        self.count += 1
        return SimpleNamespace(get_depth_frame=lambda: depth, get_ir_frame=lambda: infrared)


def test_a_femto_states_millimetres_in_one_number(monkeypatch):
    camera = Femto()
    camera.install(monkeypatch)
    lens, unit_m, frames = read("femto", 2)
    assert (lens, unit_m) == (BENT, 0.00025)
    assert_frame(frames[1], 1, 0.00025, 5.033333)
    assert frames[0].amplitude is not None and (frames[0].amplitude == 700).all()
    assert camera.enabled == ["profile of depth", "profile of ir"] and camera.is_stopped


def test_a_femto_that_falls_silent_or_has_another_lens_is_told(monkeypatch):
    Femto().install(monkeypatch)
    with pytest.raises(UserError, match="femto: no frame came"):
        read("femto", 9)
    Femto("INVERSE_BROWN_CONRADY").install(monkeypatch)
    with pytest.raises(UserError, match="lens model INVERSE_BROWN_CONRADY"):
        read("femto", 1)


# ---------------------------------------------------------------- depthai


class Oak:
    """depthai 3: a node whose output has a queue."""

    def __init__(self, platform: str, coefficients: list[float]) -> None:
        self.platform = platform
        self.coefficients = coefficients
        self.output = ""
        self.count = 0
        self.is_stopped = False

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        install(
            monkeypatch,
            "depthai",
            Pipeline=lambda: self,
            node=SimpleNamespace(ToF="ToF"),
            CameraBoardSocket=SimpleNamespace(AUTO=-1),
            ToFConfig=SimpleNamespace(Profile=SimpleNamespace(MID_RANGE=1)),
            Platform=SimpleNamespace(RVC2="RVC2", RVC4="RVC4"),
            CameraModel=SimpleNamespace(Perspective="perspective"),
        )

    def create(self, node: str) -> Oak:
        assert node == "ToF"
        return self

    def build(self, boardSocket: int, profile: int) -> SimpleNamespace:
        assert (boardSocket, profile) == (-1, 1)
        return SimpleNamespace(rawDepth=self._queue("rawDepth"), depth=self._queue("depth"))

    def _queue(self, name: str) -> SimpleNamespace:
        def created() -> Oak:
            self.output = name
            return self

        return SimpleNamespace(createOutputQueue=created)

    def getDefaultDevice(self) -> SimpleNamespace:
        return SimpleNamespace(getPlatform=lambda: self.platform)

    def start(self) -> None:
        assert self.output

    def stop(self) -> None:
        self.is_stopped = True

    def get(self, timeout: timedelta) -> SimpleNamespace | None:
        if self.count == 3:
            return None
        number = self.count
        self.count += 1
        seen = SimpleNamespace(
            getDistortionModel=lambda: "perspective",
            getIntrinsicMatrix=lambda: [[150.0, 0, 1.5], [0, 151.0, 1.25], [0, 0, 1]],
            getDistortionCoefficients=lambda: self.coefficients,
        )
        return SimpleNamespace(
            getFrame=lambda: stored(number),
            getTimestampDevice=lambda: timedelta(seconds=7, milliseconds=40 * number),
            getTransformation=lambda: seen,
        )


@pytest.mark.parametrize(("platform", "output"), [("RVC2", "rawDepth"), ("RVC4", "depth")])
def test_an_oak_gives_the_depth_before_its_filters_where_it_has_it(monkeypatch, platform, output):
    camera = Oak(platform, [*DISTORTION, 0, 0, 0, 0, 0, 0])
    camera.install(monkeypatch)
    lens, unit_m, frames = read("oak", 2)
    assert (lens, unit_m, camera.output) == (BENT, 0.001, output)
    assert_frame(frames[1], 1, 0.001, 7.04)
    assert camera.is_stopped


def test_an_oak_with_thin_prisms_is_refused(monkeypatch):
    Oak("RVC2", [*DISTORTION, 0.1, 0, 0, 0, 0, 0]).install(monkeypatch)
    with pytest.raises(UserError, match="thin prism"):
        read("oak", 1)


# ---------------------------------------------------------------- the plug-in point


@pytest.mark.parametrize("name", sorted(SOURCES.names()))
def test_a_package_that_is_absent_is_named_with_the_line_to_type(monkeypatch, name: str):
    modules = {
        "femto": "pyorbbecsdk",
        "k4a": "pyk4a",
        "oak": "depthai",
        "realsense": "pyrealsense2",
    }
    monkeypatch.setitem(sys.modules, modules[name], None)
    with pytest.raises(UserError, match=f"needs the package {modules[name]}") as caught:
        read(name, 1)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    if "tofpod[" in str(caught.value.fix):
        (package,) = extras["optional-dependencies"][name]
        assert package.startswith(modules[name])


def test_another_package_offers_a_camera(monkeypatch, tmp_path: Path):
    (tmp_path / "acme_camera.py").write_text(
        "from contextlib import contextmanager\n"
        "import numpy as np\n"
        "from detectors.sources.interface import DepthPicture, stream_of\n"
        "from harness.vocabulary.geometry import Lens\n\n"
        "@contextmanager\n"
        "def open_acme(path):\n"
        "    picture = DepthPicture(0.5, np.full((2, 2), 800, np.uint16), 1e-3, Lens(2, 2, 9, 9, 1, 1))\n"
        "    yield stream_of('acme', 'Acme 3', iter([picture]))\n\n"
        "broken = 3\n"
    )
    entries = {"acme": "acme_camera:open_acme", "broken": "acme_camera:broken"}
    offer(monkeypatch, tmp_path, "acme", "tofpod.sources", entries)
    _, unit_m, (frame,) = read("acme", 9)
    assert unit_m == 1e-3 and frame.time_s == 0.5 and frame.z_m[0, 0] == np.float32(0.8)
    with pytest.raises(UserError, match="is not a function"):
        read("broken", 1)
    with pytest.raises(UserError, match="did you mean 'realsense'"):
        read("realsence", 1)


def test_cameras_that_play_nothing_say_so(tmp_path: Path):
    (tmp_path / "a.bag").write_bytes(b"")
    for name in ("femto", "oak"):
        with pytest.raises(UserError, match="plays no recording"):
            read(name, 1, tmp_path / "a.bag")
    with pytest.raises(UserError, match="no such file"):
        read("k4a", 1, tmp_path / "b.mkv")
