"""The design of a solid gauge, and its files: STL, 3MF with the marks as a second part, drawing,
truth, and a form for a calliper."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.stills.solid_body import inlay_of, solid_of
from harness.stills.solid_gauge import (
    SOLID_VERSION,
    VERSION_KEY,
    SolidGauge,
    SolidGroove,
    SolidMark,
    SolidPocket,
    SolidSphere,
    SolidStep,
    SolidUncertainty,
    calliper_form,
)
from harness.vocabulary.files import write_bytes, write_text

if TYPE_CHECKING:
    import trimesh

PRINT_MM = 180.0
"""Side of a printed plate: a bed of 200 mm keeps a rim for the first layer's skirt."""
CUT_MM = 270.0
# x, y and height of the centres; different heights tell scale from bias, and no two arrangements
# of three are alike
SPHERES_MM = (
    (-29, 74, 25),
    (29, 74, 60),
    (74, 8, 40),
    (31, -74, 75),
    (-26, -74, 33),
    (-74, -8, 50),
)
STEPS_MM = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
GROOVES_MM = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
POCKETS_MM = (2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0)
DEPTHS_MM = (4.0, 2.0, 1.0)
PRINTED = SolidUncertainty(place_mm=0.1, scale=0.002)
"""Assumed of a filament printer; a calliper replaces it."""
CUT = SolidUncertainty(place_mm=0.02, scale=0.0002)
"""Assumed of a milling machine with balls set by a gauge."""


def designed(is_cut: bool) -> SolidGauge:
    """Return the gauge for a printer, or the larger one for a machine: all lengths in the ratio of
    the plates, but the marks' relief."""
    share = CUT_MM / PRINT_MM if is_cut else 1.0

    def places(values: Iterable[float], pitch_mm: float) -> list[float]:
        """Return places in a row of elements about the middle."""
        count = len(tuple(values))
        return [share * pitch_mm * (k - (count - 1) / 2) for k in range(count)]

    corner_mm = share * 74.0
    corners = ((-1, 1), (1, 1), (1, -1), (-1, -1))
    marks = []
    for code, (x, y) in enumerate(corners):
        mark = SolidMark(code=code, x_mm=x * corner_mm, y_mm=y * corner_mm, side_mm=share * 24.0)
        marks.append(mark)
    spheres = []
    for number, (x, y, z) in enumerate(SPHERES_MM, start=1):
        sphere = SolidSphere(
            name=f"sphere {number}",
            x_mm=share * x,
            y_mm=share * y,
            z_mm=share * z,
            diameter_mm=share * 30.0,
        )
        spheres.append(sphere)
    steps = []
    for height_mm, x_mm in zip(STEPS_MM, places(STEPS_MM, 20.0), strict=True):
        step = SolidStep(
            name=f"step {share * height_mm:g}",
            x_mm=x_mm,
            y_mm=share * 42.0,
            side_mm=share * 20.0,
            height_mm=share * height_mm,
        )
        steps.append(step)
    grooves = []
    for width_mm, x_mm in zip(GROOVES_MM, places(GROOVES_MM, 17.0), strict=True):
        groove = SolidGroove(
            name=f"groove {share * width_mm:g}",
            x_mm=x_mm,
            y_mm=share * -38.0,
            width_mm=share * width_mm,
            length_mm=share * 26.0,
            depth_mm=share * 4.0,
        )
        grooves.append(groove)
    pockets = []
    for depth_mm, y_mm in zip(DEPTHS_MM, (20.0, 4.0, -12.0), strict=True):
        for diameter_mm, x_mm in zip(POCKETS_MM, places(POCKETS_MM, 16.0), strict=True):
            pocket = SolidPocket(
                name=f"pocket {share * diameter_mm:g} x {share * depth_mm:g}",
                x_mm=x_mm,
                y_mm=share * y_mm,
                diameter_mm=share * diameter_mm,
                depth_mm=share * depth_mm,
            )
            pockets.append(pocket)
    return SolidGauge(
        made="cut" if is_cut else "printed",
        dictionary="DICT_6X6_50",
        width_mm=share * PRINT_MM,
        height_mm=share * PRINT_MM,
        thickness_mm=share * 7.0,
        mark_depth_mm=0.6,
        post_mm=share * 12.0,
        marks=tuple(marks),
        spheres=tuple(spheres),
        steps=tuple(steps),
        grooves=tuple(grooves),
        pockets=tuple(pockets),
        uncertainty=CUT if is_cut else PRINTED,
    )


# ---------------------------------------------------------------- files

CONTENT_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
RELATIONS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0"
 Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""
MODEL = """<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US"
 xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<resources>
<basematerials id="1">
<base name="white" displaycolor="#E8E8E8"/><base name="black" displaycolor="#101010"/>
</basematerials>
{objects}
<object id="4" type="model" name="gauge"><components>
<component objectid="2"/><component objectid="3"/>
</components></object>
</resources>
<build><item objectid="4"/></build>
</model>
"""


def stl_of(body: trimesh.Trimesh) -> bytes:
    """Return a body as binary STL."""
    content = body.export(file_type="stl")
    assert isinstance(content, bytes)
    return content


def model_3mf(body: trimesh.Trimesh, inlay: trimesh.Trimesh) -> bytes:
    """Return a 3MF package of one object with two parts: the white body and the black inlay."""
    parts = ((2, "body", 0, body), (3, "marks", 1, inlay))
    objects = "\n".join(_object_3mf(*part) for part in parts)
    buffer = io.BytesIO()
    files = {
        "[Content_Types].xml": CONTENT_TYPES,
        "_rels/.rels": RELATIONS,
        "3D/3dmodel.model": MODEL.format(objects=objects),
    }
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in files.items():
            # a fixed date, so that equal gauges give equal files
            package.writestr(zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0)), text)
    return buffer.getvalue()


def _object_3mf(number: int, name: str, material: int, mesh: trimesh.Trimesh) -> str:
    corners = [f'<vertex x="{x:.6g}" y="{y:.6g}" z="{z:.6g}"/>' for x, y, z in mesh.vertices]
    faces = [f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in mesh.faces.tolist()]
    head = f'<object id="{number}" type="model" name="{name}" pid="1" pindex="{material}"><mesh>'
    vertices = f"<vertices>{''.join(corners)}</vertices>"
    return f"{head}{vertices}<triangles>{''.join(faces)}</triangles></mesh></object>"


def drawing_svg(gauge: SolidGauge) -> bytes:
    """Return the gauge from above at a scale of 1:1, with the sizes of all elements."""
    from harness.programs.inspections.gauge_page import draw_marks, sheet, svg_of
    from harness.report.blocks import INK

    wide = gauge.width_mm + 2
    high = gauge.height_mm + 2
    figure, axes = sheet((-wide / 2, -high / 2, wide, high), "gauge")
    from matplotlib.patches import Circle, FancyBboxPatch, Rectangle

    line: dict[str, Any] = {"fill": False, "ec": INK, "lw": 0.4}
    corner = (-gauge.width_mm / 2, -gauge.height_mm / 2)
    axes.add_patch(Rectangle(corner, gauge.width_mm, gauge.height_mm, **line))
    draw_marks(axes, gauge.marks, gauge.dictionary)
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 5, "color": INK}
    for ball in gauge.spheres:
        axes.add_patch(Circle((ball.x_mm, ball.y_mm), ball.diameter_mm / 2, **line))
        axes.add_patch(Circle((ball.x_mm, ball.y_mm), gauge.post_mm / 2, ls=":", **line))
        text = f"Ø {ball.diameter_mm:g}\n+{ball.z_mm:g}"
        axes.annotate(text, (ball.x_mm, ball.y_mm), **style)
    for step in gauge.steps:
        half_mm = step.side_mm / 2
        corner = (step.x_mm - half_mm, step.y_mm - half_mm)
        axes.add_patch(Rectangle(corner, step.side_mm, step.side_mm, **line))
        axes.annotate(f"+{step.height_mm:g}", (step.x_mm, step.y_mm), **style)
    for groove in gauge.grooves:
        corner = (groove.x_mm - groove.width_mm / 2, groove.y_mm - groove.length_mm / 2)
        round_ends = f"round,pad=0,rounding_size={groove.width_mm / 2}"
        axes.add_patch(
            FancyBboxPatch(corner, groove.width_mm, groove.length_mm, boxstyle=round_ends, **line)
        )
        below_mm = groove.y_mm - groove.length_mm / 2 - 3
        text = f"{groove.width_mm:g} wide, -{groove.depth_mm:g}"
        axes.annotate(text, (groove.x_mm, below_mm), **style)
    for pocket in gauge.pockets:
        axes.add_patch(Circle((pocket.x_mm, pocket.y_mm), pocket.diameter_mm / 2, **line))
        below_mm = pocket.y_mm - pocket.diameter_mm / 2 - 2
        text = f"Ø {pocket.diameter_mm:g}, -{pocket.depth_mm:g}"
        axes.annotate(text, (pocket.x_mm, below_mm), **style)
    return svg_of(figure)


def write_solid(folder: Path, gauge: SolidGauge) -> tuple[str, ...]:
    """Write all files of a gauge; return their names. Raises UserError if they cannot be
    written."""
    body = solid_of(gauge)
    truth = json.dumps({VERSION_KEY: SOLID_VERSION, **gauge.to_data()}, indent=1)
    write_bytes(folder / "gauge.stl", stl_of(body))
    names = ["gauge.stl"]
    if gauge.made == "printed":
        write_bytes(folder / "gauge.3mf", model_3mf(body, inlay_of(gauge)))
        names.append("gauge.3mf")
    write_bytes(folder / "gauge.svg", drawing_svg(gauge))
    write_text(folder / "gauge.json", truth + "\n")
    write_text(folder / "calliper.csv", calliper_form(gauge))
    return (*names, "gauge.svg", "gauge.json", "calliper.csv")
