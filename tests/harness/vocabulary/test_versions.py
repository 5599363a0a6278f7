"""Every kind of file that a result folder holds says its version; a newer one is refused, and what
is none, too."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from harness.evaluation.study.record import OLDEST_VERSION, RECORD_VERSION, read_record, record_text
from harness.experiment.load import EXPERIMENT_VERSION, load_experiment, resolved_yaml
from harness.inspection.arguments import POSES_KEY, read_poses
from harness.programs.gate.compare import write_comparison
from harness.programs.gate.page import COMPARISON_VERSION
from harness.programs.gate.verdict import compare_studies
from harness.programs.inspections import design
from harness.records.trials import FINDINGS_OF_CAPTURE, FINDINGS_VERSION
from harness.report.blocks import template
from harness.report.findings import csv_text
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import (
    GENERATOR,
    RESULTS_VERSION,
    check_version,
    stamp_of,
    stamped,
)
from tests.support.synthetic_study import SetUp, Study, study_record

FILE = Path("x.json")
ROOT = Path(__file__).parents[3]
EXPERIMENT = ROOT / "experiments" / "averaging.yaml"
PAGES = [path for path in (ROOT / "harness").rglob("*.html") if "<meta charset" in path.read_text()]
STUDY = study_record(Study((SetUp(),), boards=8, hole_free_boards=2, holes=4))


@pytest.mark.parametrize(("found", "oldest"), [(3, None), (3, 1), (2, 1), (1, 1)])
def test_what_is_known_is_read(found, oldest):
    assert check_version(found, 3, FILE, "a record", oldest=oldest) == found


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (
            4,
            (
                "x.json: was written by a newer tofpod: it is a record of version 4\n  legal: "
                "versions 2 to 3\n  to do: up"
            ),
        ),
        (1, "x.json: is a record of version 1\n  legal: versions 2 to 3\n  to do: run it again"),
        (None, "x.json: is a record that states no version"),
        (True, "states the invalid version 'True'"),
        (2.0, "states the invalid version '2.0'"),
        ("3", "states the invalid version '3'"),
        (-1, "states the invalid version '-1'"),
        ([3], "states the invalid version '[3]'"),
        ("9" * 9999, "states the invalid version '" + "9" * 40 + "'"),
    ],
)
def test_what_is_not_is_refused(found, told):
    with pytest.raises(UserError) as caught:
        check_version(found, 3, FILE, "a record", oldest=2, again="run it again")
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (stamped("experiment", 7) + "name: a\n", 7),
        ("\ufeff# tofpod experiment 7\r\nname: a\n", 7),
        ("# tofpod experiment seven\n", "seven"),
        ("# tofpod experiment\n", ""),
        ("# tofpod experiment ²\n", "²"),
        ("# tofpod results 7\n", None),
        ("name: a\n# tofpod experiment 7\n", None),
        ("# an experiment of mine\n", None),
        ("", None),
    ],
)
def test_the_stamp_of_a_text(text, found):
    assert stamp_of(text, "experiment") == found


@pytest.mark.parametrize(
    ("version", "told"),
    [
        (RECORD_VERSION + 1, f"newer tofpod: it is a record of version {RECORD_VERSION + 1}"),
        (OLDEST_VERSION - 1, f"is a record of version {OLDEST_VERSION - 1}"),
        (None, "states no version"),
        ("one", "states the invalid version 'one'"),
    ],
)
def test_a_studys_record(tmp_path, version, told):
    data = json.loads(record_text(STUDY))
    assert data["record_version"] == RECORD_VERSION
    (tmp_path / "study.json").write_text(json.dumps({**data, "record_version": version}))
    with pytest.raises(UserError, match=told):
        read_record(tmp_path)
    del data["record_version"]
    (tmp_path / "study.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match="is not the record of a study"):
        read_record(tmp_path)


def test_the_baseline_in_the_repository_is_of_this_version():
    assert read_record(ROOT / "results" / "baselines" / "regression.json").set_ups


def test_an_experiment_of_a_result_folder(tmp_path):
    text = resolved_yaml(load_experiment(EXPERIMENT))
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    assert stamp_of(text, "experiment") == EXPERIMENT_VERSION
    assert load_experiment(path).digest == load_experiment(EXPERIMENT).digest
    body = text.partition("\n")[2]
    for line, message in (
        (
            stamped("experiment", EXPERIMENT_VERSION + 1),
            "newer tofpod: it is an experiment of version",
        ),
        (stamped("experiment", 0), "is an experiment of version 0"),
        ("# tofpod experiment x1\n", "states the invalid version 'x1'"),
    ):
        path.write_text(line + body)
        with pytest.raises(UserError, match=message):
            load_experiment(path)
    path.write_text(body)
    assert load_experiment(path).digest == load_experiment(EXPERIMENT).digest, (
        "one written by hand has no stamp"
    )


def test_a_comparison_and_its_page(tmp_path):
    write_comparison(compare_studies(STUDY, STUDY), tmp_path, "tofpod compare A B")
    assert (
        json.loads((tmp_path / "compare.json").read_text())["comparison_version"]
        == COMPARISON_VERSION
    )
    assert (
        f'<meta name="generator" content="{GENERATOR}">' in (tmp_path / "compare.html").read_text()
    )


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_page_names_its_version(path):
    page = template(path.name, path.parent)
    name = path.name
    source = page.environment.loader.get_source(page.environment, name)[0]
    assert (
        '<meta name="generator" content="{{ generator }}">' in source
        and page.globals["generator"] == GENERATOR
    )


def test_findings_carry_it_in_a_column():
    (head,) = csv.reader(io.StringIO(csv_text(())))
    assert head == [column.name for column in FINDINGS_OF_CAPTURE.columns] and FINDINGS_VERSION == 5


@pytest.mark.parametrize(
    ("version", "told"),
    [
        (
            RESULTS_VERSION + 1,
            f"newer tofpod: it is a file of poses of version {RESULTS_VERSION + 1}",
        ),
        (0, "is a file of poses of version 0"),
        ("1", "states the invalid version '1'"),
        (None, "states no version"),
    ],
)
def test_a_file_of_poses(tmp_path, version, told):
    path = tmp_path / "nominal_poses.json"
    pose = [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    path.write_text(json.dumps({"results_version": version, POSES_KEY: [pose]}))
    with pytest.raises(UserError, match=told):
        read_poses(path, 1)
    path.write_text(json.dumps({"results_version": RESULTS_VERSION, POSES_KEY: [pose]}))
    assert read_poses(path, 1)[0].tolist() == [[float(i == j) for j in range(4)] for i in range(4)]


@pytest.mark.usefixtures("unsaved")
def test_a_design_says_it(tmp_path):
    asked = ["--a50", "6", "--a90", "8", "--sizes", "4:10", "--studies", "10", "--targets", "60"]
    assert design.main([*asked, "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "design.json").read_text())["results_version"] == RESULTS_VERSION
