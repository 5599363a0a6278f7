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


def _markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def table(checks: Sequence[WallCheck]) -> str:
    """What the program prints: the three tables in plain columns."""
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
    parts = [
        _set_up(checks, camera),
        _temporal(checks),
        _spatial(checks),
        _pattern(checks, camera),
        _why(checks),
    ]
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
    return f"""# The simulated Azure Kinect beside a real one

This page compares the camera model with a public set of Azure Kinect wall frames ({len(checks[0].wall.z_m)} frames of
a static camera, NFOV unbinned, 640 x 576,
whole millimetres; everything except two plaster walls is masked out). {planes[0].upper()}{planes[1:]}.

<!-- artefact: azure_walls -->

<!-- end: azure_walls -->

![{_ALT}]({FIGURE})

A plane is fitted robustly to each wall (1/z of a plane is a linear function of the rays' slopes x/z and y/z). The
plane is rendered in closed form, and the simulated camera takes as many frames of it as were recorded. The same
analysis is applied to the real and the simulated frames. Nothing is fitted to make them agree. The public set states
no lens parameters, so the camera file's nominal lens is used, with its principal point at
({lens.cx:.0f}, {lens.cy:.0f}). The walls' albedo at 850 nm is not known; both are assumed to have {albedo}, the albedo
of the calibration point. Pixels within 3 px of a wall's edge are left out, because their filter window also receives
light from other surfaces. "Lit cone" means the pixels within 32.5 degrees of the axis, half of the smaller angle of
view in the specification. Beyond it, the real light decreases towards the edge of the lit field; the light on the
closed-form plane does not. The camera file limits the lit field by a polygon; this check ignores it, so that every
measured pixel has a simulated one.

To repeat the comparison:

    python tests/validation/azure_walls.py FOLDER"""


_ALT = (
    "Six panels: temporal deviation against range and angle, correlation and fixed pattern of "
    "both walls"
)


def _tilt_deg(check: WallCheck) -> float:
    _, slope_x, slope_y = check.wall.plane
    return float(np.degrees(np.arctan(np.hypot(slope_x, slope_y))))


def _temporal(checks: Sequence[WallCheck]) -> str:
    inner = _listed(f"{_span([b.ratio for b in c.by_range_inner])} ({c.wall.name})" for c in checks)
    complete = _listed(f"{_span([b.ratio for b in c.by_range])} ({c.wall.name})" for c in checks)
    needed = _listed(f"{c.needed_albedo:.2f} ({c.wall.name})" for c in checks)
    rows = [row for check in checks for row in _sigma_rows(check)]
    ratios = [np.array([b.ratio for b in c.by_range_inner]) for c in checks]
    spread = max(float(np.abs(r / r.mean() - 1).max()) for r in ratios)
    return f"""## Temporal deviation against range

The table gives the standard deviation over frames, as rms over the pixels of each range bin of 0.1 m. Bins of fewer
than 300 pixels are left out. The ratio is simulated to measured.

{_markdown(SIGMA_HEAD, rows)}

The ratio of simulated to measured deviation is {inner} in the lit cone and {complete} over whole walls. The simulated
deviation grows with range like the measured one (each wall's ratios in the lit cone lie within {100 * spread:.0f} % of
their mean), but it is too small. With an albedo of {needed} instead of the assumed one, the deviations in the lit cone
would be equal; these albedos are reported, but not used."""


def _spatial(checks: Sequence[WallCheck]) -> str:
    rows = [row for check in checks for row in _correlation_rows(check)]
    gaps = {
        jitter: max(
            np.abs(c.correlation["measured", jitter] - c.correlation["simulated", jitter]).max()
            for c in checks
        )
        for jitter in (True, False)
    }
    real, ours = (
        _listed(f"{_mm(c.jitter_m[i])} mm ({c.wall.name})" for c in checks) for i in (0, 1)
    )
    return f"""## Spatial correlation of the temporal noise

{_markdown(CORRELATION_HEAD, rows)}

The table gives the correlation between the noise of pixels that are 1 to 5 px apart (the lag). Each real frame has a
small range error that all its pixels share (jitter): the mean over all pixels of a wall varies from frame to frame by
{real}. In the simulation it varies by {ours}. The file's jitter was set from these frames, at the brightness that each
wall's noise requires; with the brighter walls simulated here it is smaller. Independent pixels would give 0.03 mm. Jitter increases the correlation at all lags alike.
"Jitter off" means that each frame's mean is subtracted: measured and simulated correlations then differ by at most
{gaps[False]:.3f} at lags 1 to 5. With jitter they differ by at most {gaps[True]:.3f}."""


def _pattern(checks: Sequence[WallCheck], camera: AmcwCamera) -> str:
    facts = camera.fixed_pattern
    rows = [row for check in checks for row in _pattern_rows(check)]
    real = _listed(f"{_mm(c.pattern.std_m)} mm" for c in checks)
    ours = _listed(f"{_mm(_simulated(c, lambda p: p.std_m))} mm" for c in checks)
    length = _listed(f"{length_px(c.pattern):.1f} px" for c in checks)
    white = _listed(f"{_mm(white_before_m(c.pattern))} mm" for c in checks)
    planted = facts.pixel_mm.value / camera.engine.window_px.value
    return f"""## Fixed pattern

The fixed pattern is the average of the frames minus a robustly fitted surface of degree 5 in 1/z. The average still
contains temporal noise: its covariance, divided by the number of frames, is subtracted from the covariance of the
residual at every lag.

{_markdown(PATTERN_HEAD, rows)}

The measured standard deviation is {real}, the Gaussian correlation length {length}; the simulated standard deviation
is {ours} (rms of
five units). The camera file's {facts.smooth_mm.value} mm and {facts.smooth_length_px.value} px apply along the ray
before the filter; the filter, the projection to z and the subtraction of the surface reduce
them. The part of the pattern that is uncorrelated between pixels (white) before the filter window of 5 x 5 pixels
adds a triangle to the covariance. The file's {facts.pixel_mm.value} mm becomes {planted:.2f} mm after the window; the
analysis finds a little less in the simulated walls, and {white} in the real walls."""


def _why(checks: Sequence[WallCheck]) -> str:
    angles = np.concatenate([c.wall.angle_deg[c.wall.mask] for c in checks])
    times = _listed(f"{c.pattern.std_m / _simulated(c, lambda p: p.std_m):.2f}" for c in checks)
    return f"""## Where the simulation deviates, and the likely reasons

- **The simulated temporal noise is too low.** The walls lie {angles.min():.0f} to {angles.max():.0f} degrees off the
  axis. In the model, light decreases with the angle of incidence, with distance and with the lens's cos^4 law, which
  barrel distortion partly cancels. Mechanical vignetting and the emitter's angular profile are not published and not
  modelled; on the axis, where the gain is calibrated, they have no effect. Darker walls (the albedos above) would
  explain the level too, but not why the ratio decreases with the angle.
- **The edge of the lit field.** On the right wall the measured deviation doubles within the last 20 px before the edge
  of the lit field. The renderer's emitter has a linear roll-off between two angles, which are guesses; the closed-form
  plane has no roll-off.
{_polygon(checks)}- **The simulated correlation is slightly too low at lags 1 to 3.** Rounding to whole millimetres adds
  0.29 mm of white noise. Where the simulated deviation is smaller than the real one, the share of this white noise is
  larger and the correlation lower.
- **Real noise is correlated beyond the filter window.** Simulated noise within a frame is uncorrelated at 5 px; real
  noise is still slightly correlated. A frame's error is not the same for all pixels: parts of the walls whose ranges
  differ by 0.6 m even err in opposite directions. [The cameras](cameras.md#jitter-of-frames) says what fits these
  errors; the model displaces the frame as a whole.
- **The fixed patterns agree: measured by simulated {times}.** The two sizes in the camera file were set from these
  frames, so this agreement is not a test. The white part was set from patches of 3 to 15 pixels, which require a
  smaller value than this analysis finds. The measured pattern contains the plaster's own relief and texture, and light
  that walls and ceiling reflect to each other, so it is an upper bound of the camera's pattern. At the first lags its
  covariance decreases faster than a Gaussian; it also has a longer tail and differs between x and y. The model is the
  sum of one isotropic Gaussian field and white noise.
- **The frames show one unit and one pair of walls.** There are {len(checks[0].wall.z_m)} frames. The spread between
  units is not known."""


def _polygon(checks: Sequence[WallCheck]) -> str:
    if min(c.share_in_polygon for c in checks) > 0.99:
        return ""
    share = _listed(f"{100 * c.share_in_polygon:.0f} % ({c.wall.name})" for c in checks)
    return f"""- **The lit field's shape.** The camera file's polygon covers {share} of the pixels that the real
  unit measured: the simulated picture ends too early there.
"""
