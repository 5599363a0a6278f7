"""Result folders and stored renders, listed and removed: nothing that is not tofpod's, nothing in
use, no way out."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from detectors import detector_type
from harness.programs.keeping import clean, ls
from harness.records.outputs import run_at
from harness.runs.jobs import Ended
from harness.runs.journal import Journal
from harness.runs.results_folder import latest_run, point_to
from harness.runs.shards import locked
from harness.vocabulary.files import size_text
from harness.vocabulary.geometry import Region
from harness.vocabulary.provenance import RESULTS_VERSION
from scenes.closed_form import plane_view
from scenes.render.cache import in_use, write_view
from scenes.sensor.camera import load_camera
from scenes.sensor.common.config import EffectsConfig

ROOT = Path(__file__).resolve().parents[4]
DAY_S = 86_400.0


def results(out: Path, digest: str, name: str = "study", records: int = 0, **said: object) -> Path:
    """A folder of results; with a provenance where anything is said of it."""
    folder = out / name / digest
    folder.mkdir(parents=True)
    (folder / "experiment.yaml").write_text("# tofpod experiment 1\nname: study\n")
    journal = Journal(folder / "journal")
    for number in range(records):
        journal.write(f"damaged-{number:05d}-{number:016x}", Ended("done", value='{"runs":[]}'))
    if said:
        complete = {
            "results_version": RESULTS_VERSION,
            "started": "2026-11-21T10:00:00+00:00",
            "commit": "abcdef0123",
        }
        (folder / "provenance.json").write_text(json.dumps({**complete, "dirty": True, **said}))
        (folder / "report.html").write_text("<html>")
    return folder


def listed(capsys: pytest.CaptureFixture[str], out: Path, *more: str) -> dict[str, dict]:
    assert ls.main(["results", *more, "--results", str(out), "--json"]) == 0
    return {row["digest"]: row for row in json.loads(capsys.readouterr().out)}


# ---------------------------------------------------------------- what is listed


def test_every_state_of_a_folder(tmp_path, capsys):
    results(tmp_path, "0" * 16, trials={"done": 5, "resumed": 4, "failed": 0}, records=9)
    results(tmp_path, "1" * 16, trials={"done": 5, "resumed": 0, "failed": 2}, records=7)
    results(tmp_path, "2" * 16, records=3)
    (results(tmp_path, "3" * 16) / "provenance.json").write_text("{")
    (tmp_path / "study" / ("4" * 16)).mkdir()
    results(tmp_path, "5" * 16, trials={"done": 5}, results_version=RESULTS_VERSION + 1)
    running = results(tmp_path, "6" * 16, records=1)
    results(tmp_path, "7" * 16, name="wall", trials={"done": 1})
    with locked(running):
        rows = listed(capsys, tmp_path)
    states = {digest[0]: row["state"] for digest, row in rows.items()}
    assert states == dict(
        zip(
            "01234567",
            [
                "complete",
                "unfinished",
                "unfinished",
                "broken",
                "broken",
                "complete",
                "running",
                "complete",
            ],
            strict=True,
        )
    )
    notes = {digest[0]: row["note"] for digest, row in rows.items()}
    assert notes["0"] == "complete: 9 trials"
    assert notes["1"] == "unfinished: 5 trials, 2 failed"
    assert notes["2"] == "unfinished: 3 records"
    assert notes["3"].startswith("broken: provenance.json")
    assert f"results version {RESULTS_VERSION + 1}" in notes["5"]
    assert notes["6"] == "running: 1 record"
    assert rows["0" * 16]["size_bytes"] >= 9 * 100 and rows["0" * 16]["date"].startswith(
        "2026-11-21"
    )
    assert set(listed(capsys, tmp_path, "wall")) == {"7" * 16}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        b'{"trials": 3}',
        b'{"trials": {"done": -1}, "started": 5, "commit": ["x"]}',
    ],
)
def test_whatever_a_provenance_holds_the_list_goes_on(tmp_path, capsys, content):
    (results(tmp_path, "0" * 16) / "provenance.json").write_bytes(content)
    results(tmp_path, "1" * 16, trials={"done": 1})
    rows = listed(capsys, tmp_path)
    assert rows["1" * 16]["state"] == "complete" and len(rows) == 2
    assert ls.main(["results", "--results", str(tmp_path)]) == 0


def test_the_list_as_text_fits_a_terminal(tmp_path, capsys):
    results(tmp_path, "0" * 16, trials={"done": 5, "resumed": 4, "failed": 0}, records=9)
    results(tmp_path, "2" * 16, records=3)
    assert ls.main(["results", "--results", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "  study"
    assert lines[2].split() == [
        "0" * 16,
        "2026-11-21",
        *lines[2].split()[2:4],
        "complete:",
        "9",
        "trials",
    ]
    assert lines[3].endswith("unfinished: 3 records")
    listed = [line for line in lines if str(tmp_path) not in line]
    assert len(listed) == 3
    assert max(map(len, listed)) <= 100


def test_neither_links_nor_other_folders_are_results(tmp_path, capsys):
    out = tmp_path / "out"
    there = results(tmp_path / "elsewhere", "0" * 16, records=2)
    (out / "study").mkdir(parents=True)
    (out / "study" / ("1" * 16)).symlink_to(there)
    (out / "linked").symlink_to(there.parent)
    (out / "baselines").mkdir()
    (out / "baselines" / "regression.json").write_text("{}")
    assert listed(capsys, out) == {}
    assert listed(capsys, tmp_path / "nowhere") == {}
    assert ls.main(["results", "nothing", "--results", str(out)]) == 2
    assert "has no results of 'nothing'" in capsys.readouterr().err


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Three renders used 1, 10 and 40 days ago, the last one damaged, and a file that a killed
    process left."""
    folder = tmp_path / ".cache" / "renders"
    view = plane_view(load_camera("azure_kinect_nfov"), Region(200, 210, 300, 310), 0.8, 0.5)
    for letter, days in (("a", 1), ("b", 10), ("c", 40)):
        path = folder / f"{letter * 16}.npz"
        write_view(path, view)
        if letter == "c":
            path.write_bytes(path.read_bytes()[:-50])
        os.utime(path, (time.time() - days * DAY_S,) * 2)
    left_over = folder / f".{'d' * 16}.abcd1234.part.npz"
    left_over.write_bytes(b"x")
    os.utime(left_over, (time.time() - 2 * DAY_S,) * 2)
    (folder / "mine.txt").write_text("mine")
    return folder


def test_the_cache_is_counted(cache, tmp_path, capsys):
    assert ls.main(["cache", "--results", str(tmp_path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["renders"], facts["leftovers"]) == (3, 1)
    assert facts["size_bytes"] == sum(path.stat().st_size for path in cache.glob("[abc]*.npz"))
    assert facts["longest_unused_days"] == pytest.approx(40, abs=0.01)
    assert ls.main(["cache", "--results", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "40.0 days" in text
    assert ls.main(["cache", "--results", str(tmp_path / "none")]) == 0


def test_what_tells_runs_apart_and_the_limits_found_are_listed(tmp_path, capsys):
    for digest, frames, size in (("0" * 16, 1, "5.314"), ("1" * 16, 50, "")):
        folder = results(tmp_path, digest, trials={"done": 5})
        settings = (
            f"name: study\ncapture: {{frames: {frames}}}\nseed: 3\nsource: {{target: "
            f"{{distance_m: 0.{frames}}}}}\n"
        )
        (folder / "experiment.yaml").write_text(f"# tofpod experiment 1\n{settings}")
        rows = f'"far, {frames} frames",{size},{"demonstrated" if size else "not demonstrated"}\n'
        rows += "near,3.2,demonstrated\n" if size else ""
        (folder / "limits.csv").write_text(f"set_up,a90_95_mm,a90_95_verdict\n{rows}")
    point_to(folder)
    rows = listed(capsys, tmp_path)
    assert rows["0" * 16]["differs"] == {"capture.frames": 1, "source.target.distance_m": 0.1}
    assert rows["0" * 16]["limits"][0] == {
        "set_up": "far, 1 frames",
        "verdict": "demonstrated",
        "a90_95_mm": 5.314,
    }
    assert rows["1" * 16]["is_latest"] and not rows["0" * 16]["is_latest"]
    assert ls.main(["results", "--results", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[3] == "      a90/95 3.20 mm (near) to 5.31 mm (far, 1 frames)"
    assert lines[4] == "      frames=1, distance=0.1 m"
    assert lines[5].endswith("complete: 5 trials, latest")
    assert lines[6] == "      a90/95 not demonstrated"


@pytest.mark.parametrize(
    "content", [b"", b"a,b\n1,2\n", b"\xff", b"set_up,a90_95_mm,a90_95_verdict\nx,y,z\n"]
)
def test_whatever_stands_in_settings_and_limits_the_list_goes_on(tmp_path, capsys, content):
    results(tmp_path, "0" * 16, trials={"done": 5})
    folder = results(tmp_path, "1" * 16, trials={"done": 5})
    (folder / "limits.csv").write_bytes(content)
    (folder / "experiment.yaml").write_bytes(b"# tofpod experiment 1\n[" + content)
    rows = listed(capsys, tmp_path)
    assert rows["1" * 16]["limits"] == [] and rows["1" * 16]["differs"] == {}


# ---------------------------------------------------------------- the newest run


def test_latest_is_a_relative_link_that_follows_the_newest_run(tmp_path):
    first = results(tmp_path, "1" * 16, trials={"done": 1}, started="2026-11-21")
    second = results(tmp_path, "2" * 16, trials={"done": 1}, started="2026-11-22")
    link = first.parent / "latest"
    for run in (first, second, first):
        point_to(run)
        assert os.readlink(link) == run.name
        assert read_text(link / "report.html") == "<html>"
    assert sorted(path.name for path in first.parent.iterdir()) == [
        first.name,
        second.name,
        "latest",
    ]


def read_text(path: Path) -> str:
    return path.read_text()


def refused(*_: object) -> None:
    raise OSError("none here")


def test_latest_is_a_text_where_there_are_no_links(tmp_path, monkeypatch):
    monkeypatch.setattr("os.symlink", refused)
    first = results(tmp_path, "1" * 16, trials={"done": 1})
    second = results(tmp_path, "2" * 16, trials={"done": 1})
    for run in (first, second):
        point_to(run)
        assert run_at(run.parent / "latest") == run
    assert clean.main(["results", f"study/{second.name}", "--yes", "--results", str(tmp_path)]) == 0
    assert not (first.parent / "latest").exists()


def test_a_latest_that_cannot_be_made_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("os.replace", refused)
    run = results(tmp_path, "0" * 16, trials={"done": 1})
    point_to(run)
    assert f"the newest run is {run}" in capsys.readouterr().err and latest_run(run.parent) is None


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_a_latest_of_somebody_else_is_left_alone(tmp_path, capsys, kind):
    run = results(tmp_path, "0" * 16, trials={"done": 1})
    theirs = run.parent / "latest"
    (tmp_path / "goal").mkdir()
    {
        "file": lambda: theirs.write_text("my notes"),
        "folder": theirs.mkdir,
        "link": lambda: theirs.symlink_to("../goal"),
    }[kind]()
    point_to(run)
    assert "was not written by tofpod" in capsys.readouterr().err
    assert clean.main(["results", "study", "--yes", "--results", str(tmp_path)]) == 0
    assert os.path.lexists(theirs) and not run.exists()


def test_latest_neither_counts_twice_nor_outlives_its_run(tmp_path, capsys):
    first = results(tmp_path, "1" * 16, trials={"done": 1}, started="2026-11-21")
    second = results(tmp_path, "2" * 16, trials={"done": 1}, started="2026-11-22")
    point_to(second)
    assert set(listed(capsys, tmp_path)) == {first.name, second.name}
    assert clean.main(["results", "study/latest", "--yes", "--results", str(tmp_path)]) == 2
    assert clean.main(["results", f"study/{first.name}", "--yes", "--results", str(tmp_path)]) == 0
    assert latest_run(second.parent) == second.name
    assert clean.main(["results", "study", "--yes", "--results", str(tmp_path)]) == 0
    assert not first.parent.exists()


# ---------------------------------------------------------------- what is removed


def left_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.name != ".lock"}


@pytest.mark.parametrize(
    ("arguments", "kept"),
    [
        (["--keep", "0MB"], ""),
        (["--keep", "1GB"], "abc"),
        (["--all"], ""),
        (["--all", "--dry-run"], "abc"),
    ],
)
def test_renders_go_by_size(cache, tmp_path, capsys, arguments, kept):
    assert clean.main(["cache", *arguments, "--yes", "--results", str(tmp_path)]) == 0
    leftover = {f".{'d' * 16}.abcd1234.part.npz"} if "--dry-run" in arguments else set()
    assert left_in(cache) == {"mine.txt", *(f"{letter * 16}.npz" for letter in kept), *leftover}
    printed = capsys.readouterr().out
    assert ("would remove 4 stored renders" in printed) == ("--dry-run" in arguments)


def test_a_cache_in_use_is_refused(cache, tmp_path, capsys):
    with in_use(cache):
        assert clean.main(["cache", "--all", "--yes", "--results", str(tmp_path)]) == 2
    assert "a sweep that is running uses these renders" in capsys.readouterr().err
    assert len(left_in(cache)) == 5


def test_a_cache_that_is_a_link_is_refused(cache, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / ".cache").symlink_to(cache.parent)
    assert clean.main(["cache", "--all", "--yes", "--results", str(out)]) == 2
    assert "is a link" in capsys.readouterr().err and len(left_in(cache)) == 5


class Terminal:
    """A standard input at which somebody sits, or nobody."""

    def __init__(self, *, is_there: bool) -> None:
        self._is_there = is_there

    def isatty(self) -> bool:
        return self._is_there


def test_nothing_is_removed_unasked(cache, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", Terminal(is_there=False))
    assert clean.main(["cache", "--all", "--results", str(tmp_path)]) == 2
    assert "--yes" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", Terminal(is_there=True))
    for answer, code, count in (("", 1, 5), ("n", 1, 5), ("y", 0, 1)):
        monkeypatch.setattr("builtins.input", lambda _, answer=answer: answer)
        assert clean.main(["cache", "--all", "--results", str(tmp_path)]) == code
        assert len(left_in(cache)) == count
    assert clean.main(["cache", "--results", str(tmp_path)]) == 2


def test_results_go_and_what_is_not_tofpods_stays(tmp_path, capsys):
    first = results(tmp_path, "0" * 16, records=2, trials={"done": 2})
    for name in (
        "map-2-50.html",
        "limits.csv",
        "limits.parquet",
        "compare.json",
        "thresholds.csv",
        "claims.csv",
    ):
        (first / name).write_text("x")
    second = results(tmp_path, "1" * 16, records=2, trials={"done": 2})
    (second / "notes.md").write_text("mine")
    (second / "journal" / "notes.md").write_text("mine")
    (second / "outside").symlink_to(tmp_path.parent)
    assert clean.main(["results", "study", "--dry-run", "--results", str(tmp_path)]) == 0
    assert (first / "provenance.json").exists() and not (first / ".lock").exists()
    assert clean.main(["results", "study", "--yes", "--results", str(tmp_path)]) == 0
    assert not first.exists()
    assert {str(path.relative_to(second)) for path in second.rglob("*")} == {
        "notes.md",
        "journal",
        "journal/notes.md",
        "outside",
    }
    assert "is kept" in capsys.readouterr().err and tmp_path.parent.is_dir()
    (second / "notes.md").unlink()


def written_days_ago(folder: Path, days: float) -> int:
    """Set the time of all files of a folder. Returns their size."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    for path in files:
        os.utime(path, (time.time() - days * DAY_S,) * 2)
    return sum(path.stat().st_size for path in files)


def test_the_oldest_results_go_until_the_rest_fits(tmp_path, capsys, monkeypatch):
    oldest = results(tmp_path, "0" * 16, records=2, trials={"done": 2})
    older = results(tmp_path, "1" * 16, records=2, name="wall", trials={"done": 2})
    new = results(tmp_path, "2" * 16, records=2, trials={"done": 2})
    stranger = tmp_path / "photos" / ("3" * 16)
    stranger.mkdir(parents=True)
    (stranger / "report.html").write_text("mine")
    sizes = [written_days_ago(oldest, 9), written_days_ago(older, 5), written_days_ago(new, 1)]
    kept_bytes = f"{(sizes[1] + sizes[2]) / 1e3}kB"
    keep = ["results", "--results", str(tmp_path), "--keep"]
    monkeypatch.setattr("sys.stdin", Terminal(is_there=False))
    assert clean.main([*keep, kept_bytes]) == 2 and oldest.exists()
    assert "cannot ask whether to remove" in capsys.readouterr().err
    assert clean.main([*keep, kept_bytes, "--yes"]) == 0
    assert not oldest.exists() and older.exists() and new.exists()
    assert clean.main([*keep, kept_bytes, "--yes"]) == 0 and older.exists()
    assert "nothing to remove" in capsys.readouterr().out
    with locked(older):
        assert clean.main([*keep, "0GB", "--yes"]) == 0
    assert older.exists() and not new.exists()
    assert (stranger / "report.html").read_text() == "mine"


def test_the_oldest_results_of_one_experiment_go(tmp_path):
    oldest = results(tmp_path, "0" * 16, name="wall", trials={"done": 2})
    old = results(tmp_path, "1" * 16, trials={"done": 2})
    new = results(tmp_path, "2" * 16, trials={"done": 2})
    sizes = [written_days_ago(oldest, 9), written_days_ago(old, 5), written_days_ago(new, 1)]
    keep = ["--keep", f"{sizes[2] / 1e3}kB", "--yes", "--results", str(tmp_path)]
    assert clean.main(["results", "study", *keep]) == 0
    assert oldest.exists() and new.exists() and not old.exists()


def test_the_plain_list_ends_with_the_sizes_that_clean_bounds(cache, tmp_path, capsys):
    folder = results(tmp_path, "0" * 16, records=2, trials={"done": 2})
    size_bytes = written_days_ago(folder, 1)
    assert ls.main(["--results", str(tmp_path)]) == 0
    stored, renders = capsys.readouterr().out.splitlines()[-2:]
    assert stored == f"results in {tmp_path}: 1 folder, {size_text(size_bytes)}"
    cached_bytes = sum(path.stat().st_size for path in cache.glob("[abc]*.npz"))
    assert renders.startswith(f"cache: 3 renders, {size_text(cached_bytes)};")


def test_a_folder_that_only_looks_like_results_is_left_alone(tmp_path, capsys):
    stranger = tmp_path / "photos" / ("0" * 16)
    stranger.mkdir(parents=True)
    (stranger / "report.html").write_text("mine")
    assert clean.main(["results", "photos", "--yes", "--results", str(tmp_path)]) == 2
    assert "not a results folder" in capsys.readouterr().err
    assert (stranger / "report.html").read_text() == "mine"


def test_a_running_sweep_keeps_all_results_that_were_named(tmp_path, capsys):
    first = results(tmp_path, "0" * 16, records=2)
    second = results(tmp_path, "1" * 16, records=2)
    with locked(second):
        assert clean.main(["results", "study", "--yes", "--results", str(tmp_path)]) == 2
    assert "another sweep" in capsys.readouterr().err
    assert all(len(Journal(one / "journal")) == 2 for one in (first, second))


@pytest.mark.parametrize(
    "name",
    [
        "..",
        "../study",
        "study/..",
        "/etc",
        ".cache",
        "study/",
        "study/0",
        "none",
        "",
        "study/" + "9" * 16,
    ],
)
def test_names_that_name_no_results(tmp_path, capsys, name):
    results(tmp_path, "0" * 16, records=1)
    assert clean.main(["results", name, "--yes", "--results", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: ")


@pytest.mark.parametrize(
    "arguments",
    [
        ["results", "study", "--all"],
        ["cache", "study", "--all"],
    ],
)
def test_options_of_the_other_kind_are_refused(tmp_path, capsys, arguments):
    kept = results(tmp_path, "0" * 16, records=1)
    assert clean.main([*arguments, "--yes", "--results", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: ") and kept.exists()


def test_results_that_are_links_are_refused(tmp_path, capsys):
    there = results(tmp_path / "elsewhere", "0" * 16, records=1)
    out = tmp_path / "out"
    (out / "mine").mkdir(parents=True)
    (out / "mine" / ("0" * 16)).symlink_to(there)
    (out / "study").symlink_to(there.parent)
    for name in ("study", f"study/{'0' * 16}", f"mine/{'0' * 16}"):
        assert clean.main(["results", name, "--yes", "--results", str(out)]) == 2
        assert "is a link" in capsys.readouterr().err
    assert (there / "experiment.yaml").exists()


# ---------------------------------------------------------------- words


def test_help_of_clean_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['x', '--help']\nimport harness.programs.keeping.clean as "
        "program\n"
        "try: program.main()\nexcept SystemExit as end: assert end.code == 0\n"
        "heavy = {'mitsuba', 'numpy', 'scipy', 'numba', 'pandas', 'pydantic'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_reference_has_every_key_of_experiments_and_the_site_every_page(capsys):
    assert ls.main(["keys"]) == 0
    printed = capsys.readouterr().out
    for position, keys in (
        ("## Experiments\n", ("name", "source", "study", "sweep")),
        (
            "### `source[kind=simulated].target[name=drawn].damage[kind=blind]`\n",
            ("diameter_mm", "depth_mm"),
        ),
        ("### `source[kind=simulated].camera.effects`\n", tuple(EffectsConfig.model_fields)),
        (
            "## Settings of the detector `matched`\n",
            tuple(detector_type("matched").settings_type.model_fields),
        ),
    ):
        section = printed.partition(position)[2].partition("\n#")[0]
        assert section and all(f"\n| `{key}` |" in section for key in keys), position
    assert "| `per_board` | a whole number from 1 to" in printed and "required" in printed
    created = {"index.md", "reference.md", "contributing.md"}
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} | created
    listed = set(re.findall(r"[a-z_]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert listed == pages
