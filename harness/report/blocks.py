"""The parts of pages: a skeleton with the one stylesheet, and blocks. Plain text is escaped, `Markup` is not.

page(title, answer, [heading("Limits"), LIMITS.grid(rows).html(), figure(figures, "curves", "Each stroke is ...")])
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from harness.vocabulary.versions import GENERATOR

if TYPE_CHECKING:
    from jinja2 import Template

HERE = Path(__file__).parent
SHOWN_FIRST = (
    *("commit", "dirty", "seed", "started", "machine", "mitsuba_variant"),
    *("indirect_noise_mm", "renders", "versions"),
)
"""Keys of the provenance that a page names in any case, as not recorded where they are missing."""
SHOWN_APART = ("command", "seconds", "failures")
"""Keys of the provenance with a section of their own."""
ANSWERS = {"borne out": ("✓", "yes"), "not borne out": ("✗", "no"), "undecided": ("?", "open")}


def template(name: str, folder: Path | None = None) -> Template:
    """A template of ``folder``, which may use those of this one, or of this one; a missing name is an error, text is
    escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([place for place in (folder, HERE) if place]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {
        "generator": GENERATOR,
        "style": Markup((HERE / "style.css").read_text(encoding="utf-8")),
        "figure": figure,
        "warning_blocks": lambda texts: joined(map(warning, texts)),
        "closing": "",
    }
    return environment.get_template(name)


def page(
    title: str, answer: str, body: Iterable[Markup], under: Iterable[Markup] = (), warnings: Iterable[str] = ()
) -> str:
    """A whole page: ``title``, ``warnings``, the ``answer`` in large letters, what stands ``under`` it, the body."""
    parts = {"body": joined(body), "under": joined(under), "warnings": joined(map(warning, warnings))}
    return template("page.html").render(title=title, answer=answer, **parts)


def tag(name: str, *content: str | Markup, **attributes: str) -> Markup:
    """An element; attributes without a value are left out, ``kind`` is its class."""
    named = ((key.replace("_", "-") if key != "kind" else "class", value) for key, value in attributes.items() if value)
    said = Markup("").join(Markup(' {}="{}"').format(key, value) for key, value in named)
    return Markup("<{0}{1}>{2}</{0}>").format(Markup(name), said, joined(content, ""))


def joined(parts: Iterable[str | Markup], between: str = "\n") -> Markup:
    """All parts in their order."""
    return Markup(between).join(escape(part) for part in parts)


def heading(text: str) -> Markup:
    """A section's heading."""
    return tag("h2", text)


def subheading(text: str) -> Markup:
    """A heading within a section."""
    return tag("h3", text)


def paragraph(*content: str | Markup) -> Markup:
    """A paragraph."""
    return tag("p", *content)


def note(*content: str | Markup) -> Markup:
    """A paragraph in small grey letters."""
    return tag("p", *content, kind="note")


def warning(text: str) -> Markup:
    """A warning, which stands before the answer."""
    return tag("p", f"warning: {text}", kind="fail")


def bullets(items: Iterable[str | Markup]) -> Markup:
    """A list."""
    return tag("ul", joined(tag("li", item) for item in items))


def figure(figures: Mapping[str, str], name: str, caption: str) -> Markup:
    """A figure of ``figures`` (SVG text by name) with its caption, or that no data for it were kept."""
    if name not in figures:
        return note("No data for this figure were kept.")
    return tag("figure", tag("div", Markup(figures[name]), kind="scroll"), tag("figcaption", caption), id=name)


def fold(summary: str, *content: str | Markup, is_open: bool = False) -> Markup:
    """Content that a click on its summary shows."""
    start = Markup("<details open>") if is_open else Markup("<details>")
    return start + tag("summary", summary) + joined(content) + Markup("</details>")


def folded(tables: Sequence[tuple[str, Markup]]) -> list[Markup]:
    """Titled tables: the first open below its title, the others folded."""
    return [
        joined([subheading(title), content]) if not place else fold(title, content)
        for place, (title, content) in enumerate(tables)
    ]


def links(targets: Iterable[tuple[str, str]]) -> Markup:
    """Links to (words, file)."""
    return joined((tag("a", words, href=file) for words, file in targets), " ")


def badge(answer: str, *, brief: bool = False) -> Markup:
    """A verdict on a claim as a mark with its words, or in brief as the mark alone."""
    mark, kind = ANSWERS[answer]
    if not brief:
        return tag("span", f"{mark} {answer}", kind=f"badge {kind}")
    return tag("span", mark, kind=f"badge {kind}", title=answer, role="img", aria_label=answer)


def facts(rows: Iterable[tuple[str, str]]) -> Markup:
    """A table of names and values."""
    lines = (tag("tr", tag("th", name, scope="row"), tag("td", value)) for name, value in rows)
    return tag("table", tag("tbody", joined(lines)), kind="prov")


def command_of(command: str) -> list[Markup]:
    """The command that made a page."""
    return [subheading("Command"), tag("pre", command)]


def closing(provenance: Mapping[str, Any], experiment_yaml_text: str, left_out: str = "") -> list[Markup]:
    """The sections of every page of a sweep: failures, cost, provenance, the experiment. ``left_out``: a sentence on
    frames that were left out of averages."""
    failures = [
        f"{each['what']}: {each['why']}" if isinstance(each, Mapping) and set(each) == {"what", "why"} else plain(each)
        for each in provenance.get("failures", ())
    ]
    several = len(failures) > 1
    parts = [heading("Failures"), paragraph("No trial failed.")]
    if failures:
        parts[1] = paragraph(
            f"{len(failures)} part{'s' * several} of the experiment failed and {'are' if several else 'is'} missing "
            "from every number above."
        )
        parts += [tag("p", text, kind="fail") for text in failures]
    parts += [paragraph(left_out)] if left_out else []
    parts += [heading("Cost"), _cost({stage: float(s) for stage, s in dict(provenance.get("seconds", {})).items()})]
    others = [key for key in provenance if key not in SHOWN_FIRST and key not in SHOWN_APART]
    rows = [
        (key.replace("_mm", " (mm)").replace("_", " "), plain(provenance.get(key, "not recorded")))
        for key in (*SHOWN_FIRST, *others)
    ]
    parts += [heading("Provenance"), facts(rows), *command_of(provenance.get("command", "not recorded"))]
    return [*parts, fold("The resolved experiment", tag("pre", experiment_yaml_text))]


def _cost(seconds: Mapping[str, float]) -> Markup:
    """Seconds by stage, with a bar for the share of the longest."""
    if not seconds:
        return paragraph("Not recorded.")
    longest = max(seconds.values()) or 1.0
    heads = [tag("th", "stage"), tag("th", "seconds", kind="n"), tag("th", "share of the longest", kind="share")]
    rows = [
        tag(
            "tr",
            tag("td", stage),
            tag("td", f"{value:.1f}", kind="n"),
            tag("td", tag("span", kind="bar", style=f"width:{100 * value / longest:.1f}%")),
        )
        for stage, value in seconds.items()
    ]
    return tag("table", tag("thead", tag("tr", *heads)), tag("tbody", joined(rows)))


def plain(value: Any) -> str:
    """A recorded value as text: yes and no, ``name: value`` pairs, lists; never Python's own notation."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {plain(part)}" for key, part in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(plain(part) for part in value) or "none"
    if value is None:
        return "not recorded"
    return value if isinstance(value, str) else json.dumps(value, default=str)
