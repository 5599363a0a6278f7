"""The cloud that turns: what is packed comes out again, and a browser turns it when dragged."""

from __future__ import annotations

import base64
import re

import numpy as np
import pytest

from harness.records.examples import Circle3d, Scene3d
from harness.report.view3d import (
    MOST_POINTS,
    NO_RESIDUAL,
    packed,
    view3d_html,
    write_view3d,
)
from tests.support.browser import opened
from tests.support.synthetic_perspectives import map_example


def numbers(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def places(data) -> np.ndarray:
    return np.array(data["low"]) + numbers(data["places"], "<u2").reshape(-1, 3) * data["step"]


def test_points_come_back_within_a_step_and_colours_as_they_were():
    example = map_example(3).scene
    data = packed(example)
    assert data["count"] == data["total"] == len(example.points_mm)
    span = np.ptp(example.points_mm, axis=0)
    assert np.abs(places(data) - example.points_mm).max(axis=0) == pytest.approx(
        span / 65535 / 2, rel=0.01
    )
    assert (numbers(data["rgb"], "<u1").reshape(-1, 3) == example.rgb).all()
    assert (numbers(data["view"], "<u1") == example.view_of).all()
    assert (numbers(data["detected"], "<u1").astype(bool) == example.detected).all()
    assert (
        np.abs(numbers(data["residual"], "<i2") * 0.01 - example.residual_mm).max() <= 0.005 + 1e-9
    )
    kinds = [circle["kind"] for circle in data["circles"]]
    assert [kinds.count(kind) for kind in ("found", "missed", "finding", "false call")] == [
        8,
        3,
        8,
        1,
    ]


def test_a_cameras_frame_is_turned_to_the_viewer():
    points = np.array([[1.0, 2.0, 700.0], [3.0, 5.0, 710.0], [np.nan, 0.0, 0.0]])
    ring = Circle3d(np.array([1.0, 2.0, 700.0]), np.array([0.0, 0.0, -1.0]), 4.0, "A", "finding")
    residual = np.array([np.nan, 1e6, 0.0])
    data = packed(Scene3d(points, "camera", residual_mm=residual, circles=(ring,)))
    assert places(data) == pytest.approx(np.array([[1.0, -2.0, -700.0], [3.0, -5.0, -710.0]]))
    assert data["circles"][0]["centre"] == [1.0, -2.0, -700.0]
    assert data["circles"][0]["normal"] == [0.0, 0.0, 1.0]
    assert numbers(data["residual"], "<i2").tolist() == [NO_RESIDUAL, 32767]
    assert data["rgb"] is data["view"] is data["detected"] is None


def test_of_too_many_points_the_detected_ones_are_kept():
    n = MOST_POINTS + 1000
    rng = np.random.default_rng(0)
    points = rng.uniform(-300, 300, (n, 3))
    detected = np.zeros(n, bool)
    detected[:: n // 40] = True
    scene = Scene3d(points, "board", detected=detected)
    data = packed(scene)
    assert (data["count"], data["total"]) == (MOST_POINTS, n)
    assert numbers(data["detected"], "<u1").sum() == detected.sum()
    assert packed(scene) == data
    assert len(view3d_html(scene, "T")) < 5e6


def test_a_cloud_without_points_is_refused():
    with pytest.raises(ValueError, match="no finite point"):
        packed(Scene3d(np.full((3, 3), np.nan), "board"))


def test_the_page_needs_nothing_from_outside_and_escapes_what_it_is_given(tmp_path):
    ring = Circle3d(np.zeros(3), np.array([0.0, 0.0, 1.0]), 4.0, "</script><b>", "missed")
    scene = Scene3d(np.zeros((4, 3)), "board", circles=(ring,), facts=(("views", "<2>"),))
    text = write_view3d(tmp_path / "a.html", scene, "A & B").read_text()
    assert "<title>A &amp; B</title>" in text
    assert "&lt;2&gt;" in text
    assert text.count("</script>") == 1
    assert not re.findall(r"(?:src|href)=|https?:|import\(|fetch\(|XMLHttpRequest", text)
    assert "damage, missed" in text
    assert "finding that matches no damage" not in text
    assert "needs WebGL" in text
    assert write_view3d(tmp_path / "b.html", scene, "A & B").read_text() == text


DRAG = """<script>
function sum() {
  const pixels = new Uint8Array(4 * canvas.width * canvas.height);
  draw(); gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return pixels.reduce((total, value, at) => (total * 31 + value * (at % 97)) % 1000003, 7);
}
const point = (kind, clientX, clientY) => canvas.dispatchEvent(
  new PointerEvent(kind, { pointerId: 1, clientX, clientY, buttons: 1, bubbles: true }));
canvas.setPointerCapture = () => {};
const said = [gl ? 1 : 0, sum(), sum()];
point("pointerdown", 300, 200); point("pointermove", 400, 230); point("pointerup", 400, 230);
said.push(sum(), eye.yaw.toFixed(3), eye.pitch.toFixed(3));
canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -400, cancelable: true }));
said.push(sum(), eye.zoom.toFixed(3));
document.querySelector('[value="residual"]').click(); said.push(sum());
canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "0" }));
document.querySelector('[value="camera"]').click(); said.push(sum());
document.body.dataset.said = said.join(" ");
</script></body>"""


def test_a_browser_turns_the_cloud_when_it_is_dragged(tmp_path):
    page = view3d_html(map_example(2, points=2000).scene, "T").replace("</body>", DRAG)
    path = tmp_path / "turn.html"
    path.write_text(page)
    shown = opened(
        path,
        path.parent,
        "--window-size=900,600",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    )
    if "data-said" not in shown:
        assert 'style="display: block;"' in shown  # it says what is missing ...
        pytest.skip("this Chromium has no WebGL, not even in software")
    _, first, again, turned, yaw, pitch, zoomed, zoom, recoloured, back = (
        re.search(r'data-said="([^"]+)"', shown).group(1).split()
    )
    assert first == again
    # 100 and 30 pixels of 0.006; exp(0.6)
    assert (yaw, pitch, zoom) == ("0.600", "0.180", "1.822")
    assert len({first, turned, zoomed, recoloured}) == 4
    assert back == first


def test_a_browser_without_webgl_says_so(tmp_path):
    path = write_view3d(tmp_path / "flat.html", map_example(2, points=500).scene, "T")
    shown = opened(path, path.parent, "--window-size=900,600", "--disable-gpu", "--disable-3d-apis")
    assert re.search(r'<p id="missing" role="alert" style="display: block;">', shown)
