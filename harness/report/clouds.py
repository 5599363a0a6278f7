"""Figures of damage as a detector sees it: the residuals of whole clouds and of single damages,
from stored trials.

All residuals share a colour scale: linear within 1 mm, logarithmic beyond, red behind the surface,
blue before it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from harness.records.examples import ExampleCloud, HoleInView, StudyExample, Where
from harness.report.blocks import DAMAGE, ON_IMAGE, svg, template
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage

UNJUDGED_RGB = (185, 190, 196)
"""Grey, for pixels that were not judged."""
SMALL_PX = 200
"""Pictures up to this size are stored without loss."""
JPEG_QUALITY = 88
LEAST_MM = 10.0
"""Least end of the colour scale."""
MOST_DOWN = 3
"""Most examples below one another."""
SMALLEST_RING_PX = 2.5
WIDTH_IN = 10.0
PANEL_PX = 220
"""Side of the picture of one damage."""
GAP_PX = 15
"""Left of each such picture."""
PANEL_STEP_PX = PANEL_PX + GAP_PX
HEAD_PX = 40
"""Height of the two lines above a picture."""
PANEL_HEIGHT_PX = HEAD_PX + PANEL_PX + 62
"""Height of a picture with the lines above and below it."""
KEY_PX = 80
"""Width of the key of colours."""
STOPS = 33
"""Colours of the key, between which it is interpolated."""
TICKS_MM = (-100, -10, -1, 0, 1, 10, 100)
TITLES: dict[Where, str] = {
    "below": "Below the limit",
    "at": "At the limit",
    "above": "Above the limit",
}
SIZES: dict[Where, str] = {"below": "Smaller", "at": "Middle", "above": "Larger"}
"""Titles for set-ups without a limit within the sizes inspected."""

# ---------------------------------------------------------------- whole clouds


def residual_figure(clouds: Sequence[ExampleCloud]) -> str:
    """Draw each cloud's residuals, the pixels of findings, and rings at the true holes (dashed if
    not found)."""
    norm = residual_norm(np.concatenate([cloud.residual_mm[cloud.inside] for cloud in clouds]))
    boxes = [_box(cloud.inside) for cloud in clouds]
    heights_in = [_height_in(box) for box in boxes]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(clouds), 1, squeeze=False)[:, 0]
        for axes, cloud, box in zip(panels, clouds, boxes, strict=True):
            residual_mm = np.where(cloud.inside, cloud.residual_mm, np.nan)
            picture = _image(axes, residual_mm, cloud.detected, norm)
            marked = 0
            for hole in cloud.truth:
                is_marked = _is_marked(cloud, hole)
                marked += is_marked
                _ring(axes, hole, is_marked)
            left, right, low, top = box
            axes.set(xlim=(left, right), ylim=(low, top), ylabel="row (pixels)")
            axes.set_title(
                f"{many(cloud.frames, 'frame')}, distance behind the fitted surface:"
                f" {marked} of {len(cloud.truth)} holes marked"
            )
            residual_bar(figure, picture, "mm", cax=axes.inset_axes((1.012, 0.0, 0.013, 1.0)))
        panels[-1].set_xlabel("column (pixels)")

    alt = (
        "Range residual of each pixel in millimetres, with detected pixels and a ring at each true"
        " hole."
    )
    return svg("residual", (WIDTH_IN, sum(heights_in) + 0.75 * len(clouds)), alt, draw)


def _box(inside: np.ndarray) -> tuple[float, float, float, float]:
    """Return the ends (left, right, low, top) of a crop (h, w) bool, or of all pixels if it is
    empty."""
    v, u = np.nonzero(inside if inside.any() else np.ones_like(inside))
    return u.min() - 0.5, u.max() + 0.5, v.max() + 0.5, v.min() - 0.5


def _height_in(box: tuple[float, float, float, float]) -> float:
    left, right, low, top = box
    return min(max(0.92 * WIDTH_IN * (low - top) / (right - left), 1.1), 7.0)


def _is_marked(cloud: ExampleCloud, hole: HoleInView) -> bool:
    """Return whether a finding has a pixel on the hole."""
    v, u = np.indices(cloud.detected.shape)
    on_hole = np.hypot(u - hole.u_px, v - hole.v_px) <= max(hole.radius_px, 0.75)
    return bool(cloud.detected[on_hole].any())


def _ring(axes: Axes, hole: HoleInView, is_marked: bool) -> None:
    """Draw a ring around a hole, dashed if it is not marked, with its number above."""
    radius = max(hole.radius_px, SMALLEST_RING_PX)
    turn = np.linspace(0, 2 * np.pi, 65)
    u = hole.u_px + radius * np.cos(turn)
    v = hole.v_px + radius * np.sin(turn)
    axes.plot(u, v, color=ON_IMAGE, lw=1.2, ls="-" if is_marked else (0, (2.5, 1.8)))
    above = (hole.u_px, hole.v_px - radius)
    axes.annotate(
        hole.hole,
        above,
        (0, 2.5),
        color=ON_IMAGE,
        textcoords="offset points",
        ha="center",
        fontsize=9,
    )


# ---------------------------------------------------------------- single damages


def examples_figure(
    name: str, examples: Sequence[StudyExample], title: str, *, by_limit: bool = True
) -> str:
    """Draw a set-up's examples with a common colour scale, in mm from the middle of each crop. The
    columns are below, at and above the limit, or sizes if not ``by_limit``."""
    titles = TITLES if by_limit else SIZES
    columns = [_column(examples, where) for where in get_args(Where)]
    return _examples_svg(name, columns, title, titles)


def sight_figure(name: str, examples: Sequence[StudyExample], title: str) -> str:
    """Draw the example that is nearest to a set-up's limit: what the camera saw of damage that it
    can just find."""
    nearest = min(examples, key=lambda example: example.where != "at")
    return _examples_svg(name, [[nearest]], title, TITLES)


def _examples_svg(
    name: str,
    columns: Sequence[Sequence[StudyExample]],
    title: str,
    titles: Mapping[Where, str],
) -> str:
    """Return the examples of each column, one below another, and the key of their colours.
    Matplotlib would take 0.2 s for it, thirty times as long."""
    shown = [example for column in columns for example in column]
    norm = residual_norm(np.concatenate([example.residual_mm.ravel() for example in shown]))
    limit_mm = float(norm.vmax or LEAST_MM)
    panels = []
    for number, column in enumerate(columns):
        for row, example in enumerate(column):
            panel = _panel(example, norm, titles)
            panel["x"] = PANEL_STEP_PX * number + GAP_PX
            panel["y"] = PANEL_HEIGHT_PX * row
            panels.append(panel)
    captions = "; ".join(_caption(example, titles) for example in shown)
    shares = np.linspace(0, 1, STOPS)
    colours = residual_rgb(np.asarray(norm.inverse(shares)), norm)
    return template("examples.svg").render(
        name=name,
        alt=f"{title}: {captions}.",
        width=PANEL_STEP_PX * len(columns) + KEY_PX,
        height=PANEL_HEIGHT_PX * max(len(column) for column in columns),
        side=PANEL_PX,
        head=HEAD_PX,
        panels=panels,
        finding=DAMAGE,
        rim=ON_IMAGE,
        stops=[(f"{share:.4g}", css(rgb)) for share, rgb in zip(shares, colours, strict=True)],
        ticks=[(float(norm(mm)), signed(mm)) for mm in ticks_within(limit_mm)],
    )


def _panel(example: StudyExample, norm: SymLogNorm, titles: Mapping[Where, str]) -> dict[str, Any]:
    """Return what the template shows of an example: its crop with the rim, its size above and its
    outcome below."""
    height, width = example.residual_mm.shape
    scale = PANEL_PX / max(height, width)
    step_px = 10 / example.pitch_mm
    ticks = []
    for text, offset_px in (("−10", -step_px), ("0", 0.0), ("10 mm", step_px)):
        ticks.append((round(scale * (width / 2 + offset_px), 1), text))
    rows, columns = np.nonzero(example.detected)
    marks = []
    for row, column in zip(rows, columns, strict=True):
        marks.append(f"M{column + 0.3:.1f} {row + 0.3:.1f}h.4v.4h-.4z")
    rim = [f"{u + 0.5:.2f} {v + 0.5:.2f}" for u, v in example.outline_px]
    pod = f", POD {example.pod:.2f}" if np.isfinite(example.pod) else ""
    return {
        "title": titles[example.where],
        "size": f"{example.diameter_mm:.1f} × {example.depth_mm:.3g} mm{pod}",
        "scale": round(scale, 3),
        "pixels": (width, height),
        "image": data_url(residual_rgb(example.residual_mm, norm)),
        "found": "".join(marks),
        "rim": f"M{'L'.join(rim)}Z",
        "ticks": ticks,
        "outcome": _outcome(example).split(", "),
        "tone": "yes" if example.hit else "no",
    }


def _column(examples: Sequence[StudyExample], where: Where) -> list[StudyExample]:
    """Return the first examples of a column, smallest first."""
    chosen = [example for example in examples if example.where == where]
    chosen.sort(key=lambda example: (example.diameter_mm, example.board))
    return chosen[:MOST_DOWN]


def _caption(example: StudyExample, titles: Mapping[Where, str]) -> str:
    column = titles[example.where].lower()
    return f"{example.diameter_mm:.1f} mm, {column}, {_outcome(example)}"


def _outcome(example: StudyExample) -> str:
    word = "hit" if example.hit else "missed"
    if not np.isfinite(example.score):
        return f"{word}: no pixel was judged"
    return f"{word}: score {example.score:.3g}, threshold {example.threshold:.3g}"


# ---------------------------------------------------------------- the common colour scale


def residual_norm(residual_mm: np.ndarray) -> SymLogNorm:
    """Return the colour scale for residuals (any shape): linear within 1 mm, logarithmic beyond."""
    from matplotlib.colors import SymLogNorm

    finite_mm = np.abs(residual_mm[np.isfinite(residual_mm)])
    limit_mm = LEAST_MM
    if finite_mm.size:
        limit_mm = max(LEAST_MM, float(np.quantile(finite_mm, 0.9995)))
    return SymLogNorm(
        linthresh=1,
        linscale=1.2,
        vmin=-limit_mm,
        vmax=limit_mm,
        base=10,
    )


def _image(
    axes: Axes,
    residual_mm: np.ndarray,
    detected: np.ndarray,
    norm: SymLogNorm,
) -> AxesImage:
    """Draw residuals (h, w) with a dot on each pixel of a finding."""
    red, green, blue = UNJUDGED_RGB
    axes.set_facecolor((red / 255, green / 255, blue / 255))
    axes.grid(visible=False)
    picture = axes.imshow(residual_mm, norm=norm, cmap="RdBu_r", aspect="equal")
    v, u = np.nonzero(detected)
    axes.plot(u, v, "o", color=DAMAGE, ms=1.1, mew=0)
    return picture


def residual_bar(
    figure: Figure | SubFigure, picture: ScalarMappable, label: str, **position: Any
) -> None:
    """Draw the colour bar with round numbers; ``position`` is passed to `Figure.colorbar`."""
    limit_mm = picture.get_clim()[1] or LEAST_MM
    bar = figure.colorbar(picture, extend="both", **position)
    bar.set_label(label)
    ticks_mm = ticks_within(limit_mm)
    bar.set_ticks(ticks_mm, labels=[signed(mm) for mm in ticks_mm])
    bar.minorticks_off()


def ticks_within(limit_mm: float) -> list[int]:
    """Return the round numbers on a scale up to a limit."""
    return [mm for mm in TICKS_MM if abs(mm) <= limit_mm]


def signed(mm: int) -> str:
    """Return a number with its sign; 0 has none."""
    return f"{mm:+d}".replace("-", "−") if mm else "0"


def residual_rgb(residual_mm: np.ndarray, norm: SymLogNorm) -> np.ndarray:
    """Return (..., 3) uint8: the colours of residuals, grey where nothing was judged."""
    from matplotlib import colormaps

    shares = norm(np.nan_to_num(residual_mm))
    rgb = np.rint(255 * colormaps["RdBu_r"](np.asarray(shares))[..., :3]).astype(np.uint8)
    rgb[~np.isfinite(residual_mm)] = UNJUDGED_RGB
    return np.asarray(rgb)


def css(rgb: np.ndarray) -> str:
    """Return a colour (3,) uint8 for a stylesheet."""
    red, green, blue = rgb
    return f"rgb({red},{green},{blue})"


def data_url(rgb: np.ndarray) -> str:
    """Return a picture as text: JPEG, or PNG if it is small."""
    import cv2

    bgr = np.ascontiguousarray(rgb[..., ::-1])
    small = max(rgb.shape[:2]) <= SMALL_PX
    ending = ".png" if small else ".jpg"
    options = [] if small else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    _, encoded = cv2.imencode(ending, bgr, options)
    kind = "png" if small else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode('ascii')}"
