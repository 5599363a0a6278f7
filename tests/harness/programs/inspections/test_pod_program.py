"""The program `tofpod pod`: what it reads, what it says, what it writes, and the mistakes it
explains."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.pod.inspections import read_inspections
from harness.evaluation.pod.statement import drawn_sizes, state_hits, state_signals
from harness.programs.inspections.pod import main
from harness.vocabulary.provenance import RESULTS_VERSION

SIZES = np.linspace(0.5, 12.0, 60)


def hits(sizes: np.ndarray = SIZES, seed: int = 4) -> np.ndarray:
    """A logit curve with a50 = 4 and a width of 1."""
    return (np.random.default_rng(seed).random(len(sizes)) < 1 / (1 + np.exp(4 - sizes))).astype(
        int
    )


def table(path: Path, **columns: Any) -> Path:
    rows = zip(*columns.values(), strict=True)
    path.write_text(
        "\n".join([",".join(columns), *(",".join(str(value) for value in row) for row in rows)])
        + "\n"
    )
    return path


def stated(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "pod.json").read_text()))


# ---- what it says
# ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unsaved")
def test_the_handbooks_hits_and_misses(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """MIL-HDBK-1823A example 3, logit on the size as it is: a50 .1156, a90 .1709, a90/95 .1974,
    deviance 77."""
    file = str(shared_data / "pod" / "example3_hitmiss.csv")
    asked = [
        "--hit",
        "hit.miss",
        "--size",
        "length.inch",
        "--unit",
        "inch",
        "--link",
        "logit",
        "--no-log",
    ]
    assert main([file, *asked, "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    printed = capsys.readouterr().out
    assert statement["results_version"] == RESULTS_VERSION
    assert (statement["a50"], statement["a90"]) == pytest.approx((0.1156, 0.1709), abs=5e-5)
    assert statement["a90_95"]["size"] == pytest.approx(0.1974, abs=5e-5)
    assert statement["a90_95"]["method"] == "likelihood ratio"
    assert (statement["inspections"], statement["targets"], statement["hits"]) == (134, 134, 92)
    by_log = next(row for row in statement["models"] if row["model"] == "logit, ln size")
    assert by_log["a90_95"]["size"] == pytest.approx(0.2106, abs=5e-5)
    deviances = [row["deviance"] for row in statement["models"]]
    assert deviances == sorted(deviances)
    assert len(deviances) == 8
    assert "A flaw of 0.20 inch is found" in printed
    assert [row["model"] for row in statement["models"] if row["chosen"]] == ["logit, size"]


@pytest.mark.usefixtures("unsaved")
def test_the_handbooks_signals(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """MIL-HDBK-1823A example 1: a50 8.8, a90 12.69, a90/95 13.68 with the signal against ln
    size."""
    file = str(shared_data / "pod" / "example1_ahat.csv")
    limits = ["--left", "50", "--right", "1375", "--decision", "200"]
    asked = ["--ahat", "Test B", "--size", "size", *limits, "--log", "--no-log-signal"]
    assert main([file, *asked, "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    assert statement["a50"] == pytest.approx(8.80, abs=0.005)
    assert statement["a90"] == pytest.approx(12.69, abs=0.005)
    assert statement["a90_95"]["size"] == pytest.approx(13.68, abs=0.005)
    assert statement["numbers"]["mu"] == pytest.approx(2.175, abs=5e-4)
    assert "A flaw of 14 is found" in capsys.readouterr().out


@pytest.mark.usefixtures("unsaved")
def test_without_a_choice_the_least_deviance_decides(tmp_path: Path) -> None:
    file = table(tmp_path / "a.csv", size=SIZES, hit=hits())
    assert main([str(file), "--hit", "hit", "--size", "size", "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    assert statement["models"][0]["chosen"]
    assert statement["model"] == min(statement["models"], key=lambda row: row["deviance"])["model"]
    assert statement["a50"] < statement["a90"] < statement["a90_95"]["size"]


@pytest.mark.usefixtures("unsaved")
def test_the_limit_is_the_average_of_the_models_that_fit_about_as_well(tmp_path: Path) -> None:
    """The curve is the best model's, the limit that of all within 2 of its deviance; a model asked
    for is alone."""
    sizes = np.linspace(0.5, 10.0, 400)
    file = str(table(tmp_path / "a.csv", size=sizes, hit=hits(sizes)))
    assert main([file, "--hit", "hit", "--size", "size", "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    page = (tmp_path / "pod.html").read_text()
    close_models = [
        row
        for row in statement["models"]
        if row["deviance"] <= statement["models"][0]["deviance"] + 2
    ]
    assert 1 < len(close_models) < len(statement["models"])
    assert [row for row in statement["models"] if row["in_a90_95"]] == close_models
    of_models = [row["a90_95"]["size"] for row in close_models]
    assert 0.97 * min(of_models) < statement["a90_95"]["size"] < max(of_models)
    assert statement["a90_95"]["method"] == "average over models"
    assert f"{len(close_models)} of the models are within 2 of the least" in page
    assert page.count("(compared)") == len(close_models) - 1
    alone = [
        "--link",
        close_models[0]["model"].partition(",")[0],
        "--log" if "ln" in close_models[0]["model"] else "--no-log",
    ]
    assert main([file, "--hit", "hit", "--size", "size", *alone, "--out", str(tmp_path)]) == 0
    assert stated(tmp_path)["a90_95"]["size"] == close_models[0]["a90_95"]["size"]


@pytest.mark.usefixtures("unsaved")
def test_limits_that_hang_on_the_model_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twenty targets do not tell links apart."""
    sparse = table(tmp_path / "few.csv", size=SIZES[::3], hit=hits(SIZES[::3]))
    assert main([str(sparse), "--size", "size", "--hit", "hit", "--out", str(tmp_path)]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("warning: ")
    assert "a90/95 differ" in first
    limits = [
        row["a90_95"]["size"] or np.inf for row in stated(tmp_path)["models"] if row["in_a90_95"]
    ]
    assert max(limits) > 1.05 * min(limits)
    assert len(stated(tmp_path)["warnings"]) == 1
    assert "a90/95 differ" in (tmp_path / "pod.html").read_text()


@pytest.mark.usefixtures("unsaved")
def test_repeats_are_not_targets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every target inspected five times, alike each time: the limit is that of the targets."""
    single = read_inspections(table(tmp_path / "one.csv", size=SIZES, hit=hits()), "size", ["hit"])
    once = state_hits(single, link="logit", log_size=False)
    repeated = {
        "size": np.repeat(SIZES, 5),
        "hit": np.repeat(hits(), 5),
        "hole": np.repeat(np.arange(60), 5),
    }
    file = str(table(tmp_path / "many.csv", **repeated))
    asked = ["--hit", "hit", "--size", "size", "--link", "logit", "--no-log", "--target", "hole"]
    assert main([file, *asked, "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    assert statement["a90_95"]["size"] == pytest.approx(once.bound.value, rel=1e-6)
    assert (statement["inspections"], statement["targets"]) == (300, 60)


@pytest.mark.usefixtures("unsaved")
def test_what_is_not_demonstrated_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Detection that hardly grows with size supports no limit; exit code 0, no number anywhere."""
    sizes = np.arange(1.0, 21.0)
    file = table(
        tmp_path / "weak.csv", size=sizes, hit=(np.arange(20) % 2) | (sizes > 18).astype(int)
    )
    asked = ["--hit", "hit", "--size", "size", "--link", "logit", "--no-log"]
    assert main([str(file), *asked, "--out", str(tmp_path)]) == 0
    limit = stated(tmp_path)["a90_95"]
    assert limit["size"] is None
    assert not limit["demonstrated"]
    assert limit["why"]
    assert (
        "a90/95 is not demonstrated: a constant probability is not rejected"
        in capsys.readouterr().out
    )
    assert "not demonstrated" in (tmp_path / "pod.html").read_text()


@pytest.mark.parametrize(
    "model", [{"link": "logit", "log_size": False}, {}], ids=["one model", "several"]
)
def test_the_band_reaches_90_percent_at_the_limit(tmp_path: Path, model: dict) -> None:
    read = read_inspections(table(tmp_path / "a.csv", size=SIZES, hit=hits()), "size", ["hit"])
    statement = state_hits(read, **model)
    lower, upper = statement.band
    rising = np.maximum.accumulate(lower)
    assert float(np.interp(0.9, rising, statement.sizes)) == pytest.approx(
        statement.bound.value, rel=2e-3
    )
    assert np.all(lower <= statement.curve.pod(statement.sizes) + 1e-9)
    assert np.all(statement.curve.pod(statement.sizes) <= upper + 1e-9)


@pytest.mark.usefixtures("unsaved")
def test_a_ceiling_that_the_data_ask_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fifth of the targets is hidden and never found: the first line says so."""
    sizes = np.linspace(0.5, 12.0, 200)
    is_found = hits(sizes) & (np.arange(200) % 5 != 0)
    file = table(tmp_path / "a.csv", size=sizes, hit=is_found)
    asked = [
        str(file),
        "--hit",
        "hit",
        "--size",
        "size",
        "--link",
        "logit",
        "--no-log",
        "--out",
        str(tmp_path),
    ]
    assert main(asked) == 0
    ceiling = next(
        test for test in stated(tmp_path)["tests"] if test["test"].startswith("a ceiling")
    )
    assert ceiling["p"] < 0.01
    printed = capsys.readouterr().out
    assert (
        "warning: the curve has no floor or ceiling, and the data suggest "
        in printed.partition(str(file))[0]
    )
    assert "warning: the curve has no floor or ceiling" in (tmp_path / "pod.html").read_text()


def signals(sizes: np.ndarray) -> np.ndarray:
    """Signals of 100 a unit of size, scattered by 80."""
    return 100 * sizes + np.random.default_rng(7).normal(0, 80, len(sizes))


@pytest.mark.usefixtures("unsaved")
def test_signals_measured_repeatedly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same signal four times over is one signal: same curve, same limit; and the wrong one
    beside it."""
    sizes = np.linspace(1, 10, 50)
    once = state_signals(
        read_inspections(
            table(tmp_path / "one.csv", size=sizes, signal=signals(sizes)),
            "size",
            ["signal"],
            hits=False,
        ),
        decision=400,
        log_size=False,
        log_signal=False,
    )
    repeated = {
        "size": np.repeat(sizes, 4),
        "signal": np.repeat(signals(sizes), 4),
        "hole": np.repeat(range(50), 4),
    }
    asked = [
        "--ahat",
        "signal",
        "--size",
        "size",
        "--decision",
        "400",
        "--target",
        "hole",
        "--no-log",
    ]
    file = str(table(tmp_path / "a.csv", **repeated))
    assert main([file, *asked, "--no-log-signal", "--out", str(tmp_path)]) == 0
    statement = stated(tmp_path)
    assert statement["a90_95"]["size"] == pytest.approx(once.bound.value, rel=1e-5)
    assert statement["a50"] < statement["a90"] < statement["a90_95"]["size"]
    assert statement["a90"] == pytest.approx(4 + 0.8 * 1.2816, rel=0.05)
    assert float(np.interp(0.9, once.band[0], once.sizes)) == pytest.approx(
        once.bound.value, rel=2e-3
    )


@pytest.mark.usefixtures("unsaved")
def test_unflawed_sites_give_the_probability_of_a_false_positive(tmp_path: Path) -> None:
    """2,000 sites with noise of 150 +- 100 and a decision at 400, censored at 50: PFP = 1 - F(2.5)
    = 0.62 %."""
    noise = np.random.default_rng(3).normal(150, 100, 2000)
    sizes = np.concatenate([np.linspace(1, 10, 50), np.zeros(2000)])
    responses = np.concatenate([signals(np.linspace(1, 10, 50)), noise])
    file = table(
        tmp_path / "a.csv", size=sizes, signal=responses, hit=(responses > 400).astype(int)
    )
    asked = ["--ahat", "signal", "--decision", "400", "--left", "50", "--no-log", "--no-log-signal"]
    assert main([str(file), "--size", "size", *asked, "--out", str(tmp_path)]) == 0
    numbers = stated(tmp_path)["numbers"]
    calls = int((noise > 400).sum())
    assert (numbers["unflawed sites"], numbers["false positives"]) == (2000, calls)
    assert numbers["PFP by the noise's normal law"] == pytest.approx(0.0062, rel=0.2)
    assert numbers["PFP"] == calls / 2000 < numbers["PFP's 95 % upper bound"] < 0.012
    assert main([str(file), "--size", "size", "--hit", "hit", "--out", str(tmp_path)]) == 0
    assert stated(tmp_path)["numbers"]["false positives"] == calls
    assert stated(tmp_path)["inspections"] == 50


def test_mistakes_with_signals_are_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = np.linspace(1, 10, 50)
    file = str(
        table(tmp_path / "a.csv", size=sizes, signal=signals(sizes), falling=-signals(sizes))
    )
    for column, asked, part in (
        ("falling", ["--decision", "-400"], "does not grow with size"),
        ("signal", ["--decision", "400", "--left", "500"], "decision 400 lies outside"),
        (
            "signal",
            ["--decision", "400", "--left", "0", "--log-signal"],
            "need logarithms of values <= 0",
        ),
        ("falling", ["--decision", "400", "--log-signal"], "which has no logarithm"),
    ):
        assert (
            main([file, "--ahat", column, "--size", "size", *asked, "--out", str(tmp_path / "out")])
            == 2
        )
        assert part in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("unsaved")
def test_small_studies_and_separation_are_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = table(tmp_path / "a.csv", size=np.arange(12), hit=(np.arange(12) > 5).astype(int))
    assert main([str(file), "--hit", "hit", "--size", "size", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "11 independent targets; MIL-HDBK-1823A asks for at least 60" in printed
    assert "Firth" in printed
    assert "1 of 12 inspections are of unflawed sites" in " ".join(printed.split())


# ---- what it writes
# ------------------------------------------------------------------------------------------------


def test_same_input_same_bytes(tmp_path: Path) -> None:
    import cv2

    file = table(tmp_path / "a.csv", size=SIZES, hit=hits())
    asked = [str(file), "--hit", "hit", "--size", "size", "--out", str(tmp_path / "out")]
    written = []
    for _ in range(2):
        assert main(asked) == 0
        written.append(
            [(tmp_path / "out" / name).read_bytes() for name in ("pod.json", "pod.png", "pod.html")]
        )
    assert written[0] == written[1]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "pod.html",
        "pod.json",
        "pod.png",
    ]
    picture = cv2.imread(str(tmp_path / "out" / "pod.png"))
    assert picture is not None
    assert picture.shape == (832, 1376, 3)
    assert picture.std() > 10


def test_the_page_stands_alone_and_escapes(tmp_path: Path) -> None:
    file = table(tmp_path / "a<b>.csv", **{r"size & $\no$": SIZES, "hit": hits()})
    asked = ["--hit", "hit", "--size", r"size & $\no$", "--unit", "$", "--out", str(tmp_path)]
    assert main([str(file), *asked]) == 0
    page = (tmp_path / "pod.html").read_text()
    assert "a&lt;b&gt;.csv" in page
    assert "a<b>" not in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert page.count('<svg role="img"') == 1
    assert page.count("(used)") == 1


def test_drawn_sizes_hold_data_and_near_marks() -> None:
    sizes = drawn_sizes(np.array([1.0, 5.0]), False, (6.0, float("inf"), 40.0))
    assert sizes[0] <= 1.0
    assert 6.0 < sizes[-1] < 10.0
    assert np.all(np.diff(sizes) > 0)
    assert np.all(drawn_sizes(np.array([0.01, 5.0]), True, ()) > 0)


# ---- what it reads
# ------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    sizes=st.lists(st.floats(0, 1e6, allow_subnormal=False).filter(bool), min_size=10, max_size=14),
    separator=st.sampled_from([",", ";", "\t"]),
    mark=st.booleans(),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_any_separator_mark_and_line_end(
    tmp_path_factory: pytest.TempPathFactory,
    sizes: list[float],
    separator: str,
    mark: bool,
    end: str,
) -> None:
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    # with a semicolon or a tab between columns, a comma is the decimal mark
    texts = [repr(size) if separator == "," else repr(size).replace(".", ",") for size in sizes]
    rows = [
        separator.join(("a", "h", "t")),
        *(separator.join((text, "1", "x y")) for text in texts),
        "",
    ]
    path.write_bytes(end.join(rows).encode("utf-8-sig" if mark else "utf-8"))
    read = read_inspections(path, "a", ["h"])
    assert read.size.tolist() == sizes
    assert read.line.tolist() == list(range(2, len(sizes) + 2))


TRUE = [0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 1234.5]


def written(head: str, sizes: str, misses_and_hits: str, between: str = ",") -> str:
    """A table whose sizes are written by the format ``sizes``; misses and hits in turn, as these
    two words."""
    words = misses_and_hits.split()
    rows = (sizes.format(size) + between + words[k % 2] for k, size in enumerate(TRUE))
    return f"{head}größe{between}hit\n" + "\n".join(rows)


GERMAN = {ord("."): ",", ord(","): "."}


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (written("", "{}", "0 1"), "utf-16"),
        (written("", "{}", "0 1"), "latin-1"),
        (written("", "{}", "No yes", ";").translate(GERMAN), "utf-8"),
        (written("", "{:,}", "0 1", ";").translate(GERMAN), "cp1252"),
        (written("", '"{:,}"', "MISS hit"), "utf-8-sig"),
        (written("sep=|\n", "{}", "False True", "|"), "utf-8"),
        (written("", "{:,}", "0.0 1.0", "\t").replace(",", "'"), "utf-8"),
        (
            written(
                "Inspection of blade 7, May\n\n# two inspectors\n", "{}", "No yes", ";"
            ).translate(GERMAN),
            "utf-8",
        ),
    ],
)
def test_tables_as_people_have_them(tmp_path: Path, text: str, encoding: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode(encoding))
    read = read_inspections(path, "größe", ["hit"])
    assert read.size.tolist() == TRUE
    assert read.response.tolist() == [0.0, 1.0] * 5
    assert read.notes == ()


def test_a_mark_that_may_part_thousands_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a;h\n" + "".join(f"{k},{250 + k};{k % 2}\n" for k in range(1, 12)))
    read = read_inspections(path, "a", ["h"])
    assert read.size[0] == 1.251
    assert read.notes == (
        "a: '1,251' was read as 1.251; write thousands without a mark if it is more",
    )


@pytest.mark.usefixtures("unsaved")
def test_inspectors_in_columns_with_gaps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The handbook's layout: a row for each flaw, a column for each inspector; a flaw is one
    target."""
    first = hits(seed=4)
    second = hits(seed=5).astype(object)
    second[[3, 10]] = ["NA", ""]
    wide = table(tmp_path / "wide.csv", size=SIZES, A=first, B=second)
    read = read_inspections(wide, "size", ["A", "B"])
    assert (len(read.size), read.targets) == (118, 60)
    assert read.notes == ("2 of 120 inspections state no result and are left out",)
    assert read.response[:60].tolist() == first.tolist()
    assert (
        main([str(wide), "--size", "size", "--hit", "A", "--hit", "B", "--out", str(tmp_path)]) == 0
    )
    assert "2 of 120 inspections state no result" in capsys.readouterr().out
    assert (stated(tmp_path)["inspections"], stated(tmp_path)["targets"]) == (118, 60)


@pytest.mark.usefixtures("unsaved")
def test_a_sheet_of_excel_reads_as_its_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in [("size", "hit"), *zip(SIZES.tolist(), hits().tolist(), strict=True), (None, 1)]:
        book.active.append([None, *row])
    book.create_sheet("empty")
    book.save(tmp_path / "a.xlsx")
    read = read_inspections(tmp_path / "a.xlsx", "size", ["hit"])
    same = read_inspections(table(tmp_path / "a.csv", size=SIZES, hit=hits()), "size", ["hit"])
    assert read.size == pytest.approx(same.size, rel=1e-14)
    assert read.response.tolist() == same.response.tolist()
    assert read.unflawed.tolist() == [1.0]
    book["empty"].append(["size"])
    book.save(tmp_path / "a.xlsx")
    assert main([str(tmp_path / "a.xlsx"), *HIT, "--out", str(tmp_path / "out")]) == 2
    assert "has 2 sheets with data: Sheet, empty" in capsys.readouterr().err


GOOD = "a,hit,t\n" + "".join(f"{0.5 * row},{int(row > 6)},t{row}\n" for row in range(1, 13))
HIT = ["--size", "a", "--hit", "hit"]


@pytest.mark.parametrize(
    ("text", "asked", "message_parts"),
    [
        (GOOD, ["--size", "b", "--hit", "hit"], ["no column 'b'", "'a', 'hit', 't'"]),
        (GOOD, ["--size", "a", "--hit", "Hits"], ["no column 'Hits'", "did you mean 'hit'?"]),
        (GOOD, ["--size", "a"], ["no column states what was found", "the program does not guess"]),
        (GOOD, [*HIT, "--ahat", "a"], ["one of them, not both"]),
        (GOOD, ["--size", "a", "--ahat", "hit"], ["--ahat needs --decision"]),
        (GOOD, [*HIT, "--decision", "3"], ["--decision belongs to --ahat"]),
        (GOOD, [*HIT, "--no-log-signal"], ["--log-signal belongs to --ahat"]),
        (
            GOOD,
            ["--size", "a", "--ahat", "t", "--decision", "1", "--link", "logit"],
            ["--link belongs to --hit"],
        ),
        (GOOD, ["--size", "a", "--hit", "a"], ["column 'a' is chosen twice"]),
        (
            GOOD.replace("3.0,0", "3.0,2"),
            HIT,
            ["line 7: hit is '2', which is neither", "1, yes, true", "--ahat"],
        ),
        (
            GOOD.replace("3.0,0", "3.0,perhaps"),
            HIT,
            ["line 7: hit is 'perhaps', which is neither hit nor miss"],
        ),
        (
            GOOD.replace("3.0,0", "3.0,").replace("2.5,0", "2.5,NA").replace("2.0,0", "2.0,-"),
            HIT,
            ["9 rows are too few"],
        ),
        (GOOD.replace("3.0", '"3,0"'), HIT, ["a has numbers with the decimal marks , and ."]),
        (GOOD.replace("3.0,0", "3 mm,0"), HIT, ["line 7: a is '3 mm', not a number"]),
        (GOOD.replace("3.0,0", "inf,0"), HIT, ["line 7: a is 'inf', not a number"]),
        (GOOD.replace("3.0,0", "3,0,0"), HIT, ["line 7: 4 fields, and the header has 3"]),
        (
            GOOD.replace("3.0,0", "-1,0"),
            HIT,
            ["line 7: a is -1, but a size cannot be below 0", "not their logarithms"],
        ),
        (GOOD.replace(",0,", ",1,"), HIT, ["all 12 rows of hit are hits", "both hits and misses"]),
        (GOOD.replace(",1,", ",0,"), HIT, ["all 12 rows of hit are misses"]),
        ("\n".join(GOOD.split("\n")[:10]), HIT, ["9 rows are too few", "at least 10"]),
        (GOOD.replace("a,hit,t", "a,hit,hit"), HIT, ["2 columns are called 'hit'"]),
        (
            GOOD.replace("t4\n", "t3\n"),
            [*HIT, "--target", "t"],
            ["target 't3' has size 1.5 in line 4 and 2 in line 5"],
        ),
        (GOOD.replace("t4\n", "\n"), [*HIT, "--target", "t"], ["line 5: t is empty"]),
        ("", HIT, ["is empty", "a header row"]),
    ],
)
def test_mistakes_are_explained(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    asked: list[str],
    message_parts: list[str],
) -> None:
    file = tmp_path / "a.csv"
    file.write_text(text)
    assert main([str(file), *asked, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    for part in message_parts:
        assert part in error
    assert not (tmp_path / "out").exists()


def test_a_folder_a_missing_file_and_no_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "zeros.csv").write_bytes(bytes(100))
    (tmp_path / "broken.xlsx").write_bytes(b"PK\x03\x04" + bytes(100))
    excel = "Excel file"
    for name, message in (
        ("none.csv", "no such file"),
        (".", "is a directory"),
        ("zeros.csv", "not a text file"),
        ("broken.xlsx", excel),
    ):
        assert main([str(tmp_path / name), *HIT, "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err


def test_detection_that_falls_with_size_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = table(tmp_path / "a.csv", a=SIZES, hit=1 - hits())
    assert main([str(file), *HIT, "--out", str(tmp_path / "out")]) == 2
    assert "does not grow with" in capsys.readouterr().err
