"""Table, figure and page of `azure_walls`: all numbers from the check, the reasons in words."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import optimize

from harness.report import blocks as canvas
from harness.report.blocks import BLUE, GREY, INK, ORANGE
from harness.vocabulary.geometry import MM

if TYPE_CHECKING:
    from azure_walls import FixedPattern, SigmaBin, WallCheck

    from scenes.sensor.amcw.facts import AmcwCamera

FIGURE = "azure_walls.svg"
TABLES = "azure_walls.txt"
COLOURS = {"measured": INK, "simulated": ORANGE}
WALL_COLOURS = (BLUE, ORANGE)
WINDOW_PX = 5


def white_before_m(pattern: FixedPattern) -> float:
    """The part of a pattern that is white before the engine's window of 5, told by its triangle up
    to lag 5; below 0 where the estimate of its variance is."""
    # c(0) - c(k) = p^2 k/5 + q k^2 - r k^4 up to the window: white noise makes the line, a smooth
    # field the rest
    k = np.arange(1.0, WINDOW_PX + 1)
    rows = np.column_stack([k / WINDOW_PX, k**2, k**4])
    falls = pattern.covariance_m2[0] - pattern.covariance_m2[1 : WINDOW_PX + 1]
    white = float(np.linalg.lstsq(rows, falls, rcond=None)[0][0])
    return float(np.sign(white) * np.sqrt(abs(white)))


def length_px(pattern: FixedPattern) -> float:
    """Length l of a Gaussian autocorrelation exp(-k^2 / 2 l^2) over lags 0 to 12."""
    lag = np.arange(13)
    relative = pattern.covariance_m2[:13] / pattern.covariance_m2[0]
    result = optimize.least_squares(
        lambda p: p[0] * np.exp(-(lag**2) / (2 * p[1] ** 2)) - relative, [1.0, 5.0]
    )
    return float(abs(result.x[1]))


def _mm(value_m: float, digits: int = 2) -> str:
    return f"{value_m / MM:.{digits}f}"


def _listed(values: Iterable[str]) -> str:
    *first, last = values
    return f"{', '.join(first)} and {last}" if first else last


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _simulated(check: WallCheck, value: Callable[[FixedPattern], float]) -> float:
    return _rms(value(pattern) for pattern in check.simulated_patterns)


# ---------------------------------------------------------------- tables


def _sigma_rows(check: WallCheck) -> list[list[str]]:
    inner = {b.at: b for b in check.by_range_inner}
    rows = []
    for b in check.by_range:
        lit = inner.get(b.at)
        cells = (
            [str(lit.pixels), _mm(lit.measured_m), _mm(lit.simulated_m), f"{lit.ratio:.2f}"]
            if lit
            else ["-"] * 4
        )
        complete = [str(b.pixels), _mm(b.measured_m), _mm(b.simulated_m), f"{b.ratio:.2f}"]
        rows.append([check.wall.name, f"{b.at - 0.05:.1f}-{b.at + 0.05:.1f}", *cells, *complete])
    return rows


SIGMA_HEAD = [
    *("wall", "z / m", "lit cone: pixels", "measured / mm", "simulated / mm", "ratio"),
    *("whole wall: pixels", "measured / mm", "simulated / mm", "ratio"),
]
CORRELATION_HEAD = [
    "wall",
    "axis",
    "lag",
    "measured",
    "simulated",
    "measured, jitter off",
    "simulated, jitter off",
]
PATTERN_HEAD = ["wall", "quantity", "measured", "simulated, units 1 to 5", "measured / simulated"]


def _correlation_rows(check: WallCheck) -> list[list[str]]:
    columns = [
        check.correlation[holder, jitter]
        for jitter in (True, False)
        for holder in ("measured", "simulated")
    ]
    return [
        [
            check.wall.name,
            "xy"[axis],
            str(lag + 1),
            *(f"{round(c[axis, lag], 2) + 0.0:.2f}" for c in columns),
        ]
        for axis in (0, 1)
        for lag in range(columns[0].shape[1])
    ]


def _pattern_rows(check: WallCheck) -> list[list[str]]:
    kinds: list[tuple[str, Callable[[FixedPattern], float], float]] = [
        ("standard deviation / mm", lambda p: p.std_m, MM),
        ("correlation length / px", length_px, 1.0),
        ("white before the window / mm", white_before_m, MM),
    ]
    rows = []
    for name, value, unit in kinds:
        real = value(check.pattern)
        ours = [value(p) / unit for p in check.simulated_patterns]
        spread = " ".join(f"{v:.2f}" for v in ours)
        rows.append(
            [check.wall.name, name, f"{real / unit:.2f}", spread, f"{real / unit / _rms(ours):.2f}"]
        )
    return rows


def table(checks: Sequence[WallCheck]) -> str:
    """What the program prints and stores: the three tables in plain columns."""
    parts = []
    for head, rows_of in (
        (SIGMA_HEAD, _sigma_rows),
        (CORRELATION_HEAD, _correlation_rows),
        (PATTERN_HEAD, _pattern_rows),
    ):
        lines = [head, *(row for check in checks for row in rows_of(check))]
        widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
        parts.append(
            "\n".join(
                "  ".join(c.rjust(w) for c, w in zip(line, widths, strict=True)) for line in lines
            )
        )
    return "\n\n".join(parts)


# ---------------------------------------------------------------- figure


def figure(checks: Sequence[WallCheck]) -> str:
    """The figure as SVG text: deviation against range and angle, correlation, fixed pattern."""

    def draw(figure: Any) -> None:
        grid = figure.subplots(2, 3)
        _draw_sigma(grid[0, 0], checks)
        _draw_ratio(grid[1, 0], checks)
        for column, check in enumerate(checks[:2], start=1):
            _draw_correlation(grid[0, column], check)
            _draw_pattern(grid[1, column], check)

    text = (
        "Temporal deviation, its correlation and the fixed pattern of real walls beside their "
        "simulation"
    )
    return canvas.svg("azure-walls", (13.0, 8.0), text, draw)


def _draw_sigma(axes: Any, checks: Sequence[WallCheck]) -> None:
    for check, colour, marker in zip(checks, WALL_COLOURS, "os", strict=False):
        for name, value, style in (
            ("measured", "measured_m", "-"),
            ("simulated", "simulated_m", "--"),
        ):
            bins: list[SigmaBin] = check.by_range_inner
            face = colour if name == "measured" else "white"
            x = [b.at for b in bins]
            y = [getattr(b, value) / MM for b in bins]
            axes.plot(
                x,
                y,
                style,
                marker=marker,
                color=colour,
                mfc=face,
                label=f"{check.wall.name} wall, {name}",
            )
    axes.set(
        title="Temporal deviation, lit cone",
        xlabel="distance z / m",
        ylabel="standard deviation / mm",
        ylim=(0, None),
    )
    axes.legend(loc="lower right")


def _draw_ratio(axes: Any, checks: Sequence[WallCheck]) -> None:
    for check, colour, marker in zip(checks, WALL_COLOURS, "os", strict=False):
        x = [b.at for b in check.by_angle]
        y = [b.ratio for b in check.by_angle]
        axes.plot(x, y, "-", marker=marker, color=colour, label=f"{check.wall.name} wall")
    axes.set(
        title="Deviation, simulated by measured",
        xlabel="angle to the optical axis / degrees",
        ylabel="ratio",
        ylim=(0, 1.05),
    )
    axes.legend(loc="lower left")


def _draw_correlation(axes: Any, check: WallCheck) -> None:
    lags = np.arange(1, check.correlation["measured", True].shape[1] + 1)
    axes.plot(lags, np.clip(1 - lags / 5, 0, None), ":", color=GREY, label="box of 5, no rounding")
    for holder, colour in COLOURS.items():
        for axis, marker, shift in ((0, "o", -0.06), (1, "s", 0.06)):
            c = check.correlation[holder, False][axis]
            face = colour if axis == 0 else "white"
            axes.plot(
                lags + shift,
                c,
                marker,
                color=colour,
                mfc=face,
                label=f"{holder}, along {'xy'[axis]}",
            )
    axes.set(
        title=f"Temporal noise, {check.wall.name} wall, jitter off",
        xlabel="lag / px",
        ylabel="correlation",
        ylim=(-0.1, 1),
        xticks=lags,
    )
    axes.legend(loc="upper right")


def _draw_pattern(axes: Any, check: WallCheck) -> None:
    lags = np.arange(check.pattern.covariance_m2.size)
    for i, pattern in enumerate(check.simulated_patterns):
        label = "simulated, five units" if i == 0 else None
        axes.plot(lags, pattern.covariance_m2 / MM**2, color=ORANGE, lw=0.9, label=label)
    axes.plot(lags, check.pattern.covariance_m2 / MM**2, "o-", ms=4, color=INK, label="measured")
    axes.axhline(0, color=GREY, lw=0.8)
    axes.set(
        title=f"Fixed pattern, {check.wall.name} wall",
        xlabel="lag / px (mean of x and y)",
        ylabel="covariance / mm²",
    )
    axes.legend(loc="upper right")


# ---------------------------------------------------------------- page


def page(checks: Sequence[WallCheck], camera: AmcwCamera) -> str:
    """The documentation page, in Markdown."""
    parts = [_answer(checks), _set_up(checks, camera), _numbers(checks, camera), _why(checks)]
    return "\n\n".join(_reflowed(block) for part in parts for block in part.split("\n\n")) + "\n"


def _reflowed(block: str) -> str:
    """Prose and list items filled to 118 columns, once the numbers are in."""
    if block.startswith(("#", "|", "    ", "![")):
        return block
    items = re.split(r"\n(?=- )", block)
    return "\n".join(
        textwrap.fill(
            " ".join(item.split()), 118, subsequent_indent="  " if item.startswith("- ") else ""
        )
        for item in items
    )


def _answer(checks: Sequence[WallCheck]) -> str:
    inner = _listed(f"{_span([b.ratio for b in c.by_range_inner])} ({c.wall.name})" for c in checks)
    complete = _listed(f"{_span([b.ratio for b in c.by_range])} ({c.wall.name})" for c in checks)
    gap = max(
        np.abs(c.correlation["measured", False] - c.correlation["simulated", False]).max()
        for c in checks
    )
    times = _listed(f"{c.pattern.std_m / _simulated(c, lambda p: p.std_m):.2f}" for c in checks)
    return f"""# See the simulated Azure Kinect beside a real one

The simulated noise before two real walls is too low: {inner} times the measured one in the lit cone, {complete} over
whole walls. Its correlation between pixels differs by at most {gap:.3f}. The measured fixed pattern is {times} times
the simulated one.

![{_ALT}]({FIGURE})

<!-- artefact: azure_walls -->

<!-- end: azure_walls -->"""


_ALT = (
    "Six panels: temporal deviation against range and angle, correlation and fixed pattern of "
    "both walls"
)


def _set_up(checks: Sequence[WallCheck], camera: AmcwCamera) -> str:
    lens = camera.nominal_lens
    albedo = camera.photons.calibration_albedo.value
    planes = _listed(
        f"the {c.wall.name} wall is {c.wall.z_m[:, c.wall.mask].mean(0).min():.2f} to "
        f"{c.wall.z_m[:, c.wall.mask].mean(0).max():.2f} m away and {_tilt_deg(c):.0f} "
        "degrees from frontal "
        f"({c.wall.mask.sum():,} pixels)"
        for c in checks
    )
    return f"""A public set has {len(checks[0].wall.z_m)} frames of a static camera (NFOV unbinned, whole
millimetres); everything except two plaster walls is masked out: {planes}. A plane is fitted to each wall and rendered
in closed form. The simulated camera takes as many frames of it, and one analysis is applied to both.

    python tests/validation/azure_walls.py FOLDER

writes this page, its figure and all numbers ([{TABLES}]({TABLES})). Nothing is fitted to make them agree. The lens is
the file's, with its principal point at ({lens.cx:.0f}, {lens.cy:.0f}); both walls have the assumed albedo {albedo}.
Pixels within 3 px of a wall's edge are left out. The lit cone reaches to 32.5 degrees from the axis."""


def _tilt_deg(check: WallCheck) -> float:
    _, slope_x, slope_y = check.wall.plane
    return float(np.degrees(np.arctan(np.hypot(slope_x, slope_y))))


def _numbers(checks: Sequence[WallCheck], camera: AmcwCamera) -> str:
    facts = camera.fixed_pattern
    needed = _listed(f"{c.needed_albedo:.2f} ({c.wall.name})" for c in checks)
    ratios = [np.array([b.ratio for b in c.by_range_inner]) for c in checks]
    spread = max(float(np.abs(r / r.mean() - 1).max()) for r in ratios)
    real = _listed(f"{_mm(c.jitter_m[0])} mm ({c.wall.name})" for c in checks)
    ours = _listed(f"{_mm(c.jitter_m[1])} mm ({c.wall.name})" for c in checks)
    pattern = _listed(f"{_mm(c.pattern.std_m)} mm" for c in checks)
    length = _listed(f"{length_px(c.pattern):.1f} px" for c in checks)
    return f"""- **Noise** grows with range like the measured one: in the lit cone each wall's ratios lie within
  {100 * spread:.0f} % of their mean. Albedos of {needed} would make the deviations equal; they are not used.
- **Jitter**: the mean of a wall varies from frame to frame by {real}, simulated by {ours}. The file's jitter was set
  from these frames, at the brightness that each wall's noise requires.
- **Fixed pattern**: {pattern}, with a correlation length of {length}. The file's {facts.smooth_mm.value} mm and
  {facts.smooth_length_px.value} px were set from these frames, so the agreement is no test. The plaster's own relief
  is in it: an upper bound of the camera's pattern."""


def _why(checks: Sequence[WallCheck]) -> str:
    angles = np.concatenate([c.wall.angle_deg[c.wall.mask] for c in checks])
    return f"""## Where the simulation deviates, and the likely reasons

- **The noise is too low.** The walls lie {angles.min():.0f} to {angles.max():.0f} degrees off the axis. Mechanical
  vignetting and the emitter's angular profile are not published and not modelled; on the axis, where the gain is
  calibrated, they have no effect. Darker walls alone would not explain why the ratio falls with the angle.
- **The edge of the lit field.** On the right wall the measured deviation doubles within the last 20 px; the
  closed-form plane has no roll-off there.
{_polygon(checks)}- **The correlation is slightly too low at lags 1 to 3.** Rounding to whole millimetres adds 0.29 mm of
  white noise, whose share is larger where the simulated noise is smaller.
- **Real noise is correlated beyond the filter window**, and parts of a wall err in opposite directions
  ([jitter](cameras.md#jitter-of-frames)).
- **One unit and one pair of walls**: the spread between units is not known."""


def _polygon(checks: Sequence[WallCheck]) -> str:
    if min(c.share_in_polygon for c in checks) > 0.99:
        return ""
    share = _listed(f"{100 * c.share_in_polygon:.0f} % ({c.wall.name})" for c in checks)
    return f"""- **The lit field's shape.** The camera file's polygon covers {share} of the pixels that the real
  unit measured: the simulated picture ends too early there.
"""
