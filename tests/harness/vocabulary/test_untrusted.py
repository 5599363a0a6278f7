"""Data that somebody made to harm: no code in it is run, no file written elsewhere; each is one
clear message."""

from __future__ import annotations

import ast
import json
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from detectors.recordings.intrinsics import read_lens
from harness.evaluation.pod.inspections import read_inspections
from harness.evaluation.study.record import read_record
from harness.experiment.load import load_experiment
from harness.inspection.arguments import assign, read_poses
from harness.programs.camera.capture import read_mask
from harness.vocabulary.declaration import yaml_source
from harness.vocabulary.declaration.yaml_source import MAX_NODES, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import bounded_bytes, inside, strict_json, write_text
from tests.support.hostile_files import BOMB, capture_refusal, little_memory, refusal

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def limited() -> Iterator[None]:
    with little_memory():
        yield


# ---- no code from data
# ----------------------------------------------------------------------------------------------

FORBIDDEN = {
    "pickle.load", "pickle.loads", "pickle.Unpickler", "cPickle.load", "dill.load", "dill.loads", "cloudpickle.load",
    "cloudpickle.loads", "joblib.load", "torch.load", "pd.read_pickle", "pandas.read_pickle", "marshal.load",
    "marshal.loads", "shelve.open", "yaml.unsafe_load", "yaml.full_load", "os.system", "eval", "exec", "compile",
    "np.load", "numpy.load", "subprocess.getoutput",
}  # fmt: skip
LOADS = ("np.load", "numpy.load")
SUSPECT = re.compile(rf"\b(?:{'|'.join(map(re.escape, FORBIDDEN))})\(|allow_pickle|YAML\(")
ALLOWED = {
    ("harness/testing/contract.py", "pickle.loads"),
    ("harness/vocabulary/system.py", "exec"),
}
"""A detector that was pickled in the same line: the contract asks whether it can go to another
process. The program by which the standard library starts its server of processes."""


def forbidden_calls(text: str) -> set[str]:
    """Calls in a source text that could run what a file holds; ``np.load`` with
    ``allow_pickle=False`` cannot."""
    result: set[str] = set()
    if not SUSPECT.search(text):  # to parse all sources takes seconds
        return result
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        safe = any(
            keyword.arg == "allow_pickle" and ast.unparse(keyword.value) == "False"
            for keyword in node.keywords
        )
        if name in FORBIDDEN and not (name in LOADS and safe):
            result.add(name)
        if any(
            keyword.arg == "allow_pickle" and ast.unparse(keyword.value) != "False"
            for keyword in node.keywords
        ):
            result.add(f"{name}(allow_pickle)")
        if name.endswith("YAML") and any(
            ast.unparse(keyword.value) == "'unsafe'" for keyword in node.keywords
        ):
            result.add(f"{name}(unsafe)")
    return result


def test_no_code_of_ours_runs_what_a_file_holds():
    result = {
        (path.relative_to(ROOT).as_posix(), name)
        for folder in ("harness", "scenes", "detectors")
        for path in (ROOT / folder).rglob("*.py")
        for name in forbidden_calls(path.read_text(encoding="utf-8"))
    }
    assert result <= ALLOWED


@pytest.mark.parametrize(
    "line",
    [
        "pickle.load(f)",
        "np.load(p)",
        "np.load(p, allow_pickle=True)",
        "eval(x)",
        "pd.read_pickle(p)",
        "torch.load(p)",
        "YAML(typ='unsafe')",
        "joblib.load(p)",
        "np.lib.format.read_array(f, allow_pickle=yes)",
    ],
)
def test_the_search_sees_it(line):
    assert forbidden_calls(line)


def test_the_search_passes_what_is_safe():
    assert not forbidden_calls(
        "np.load(p, allow_pickle=False); json.loads(x); YAML(typ='safe', pure=True); dr.eval(x)"
    )


class Touch:
    """An object that makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_arrays_of_objects_are_not_unpickled(tmp_path, suffix):
    array = np.array([Touch(tmp_path / "touched")], object)
    path = tmp_path / f"a{suffix}"
    (np.save if suffix == ".npy" else np.savez)(path, array)
    assert "objects" in capture_refusal(path)
    assert not (tmp_path / "touched").exists()
    np.load(path, allow_pickle=True) if suffix == ".npy" else np.load(path, allow_pickle=True)[
        "arr_0"
    ]
    assert (tmp_path / "touched").exists(), "the file would have done it"


# ---- YAML and JSON
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: !!python/object/apply:os.system ['touch touched']\n", "tag"),
        ("a: !!python/object:pathlib.Path {}\n", "tag"),
        (BOMB, "too many values"),
        ("a: " + "[" * 100_000, "nested too deeply"),
        ("b: {" + "a," * 6_000 + "}", "too many values"),
        ("b: 1\na: [" + "1," * 11_000 + "]", "too many values"),
        ("k: v\n" * 5_000, "duplicate key"),
        ("a: 1\n" * 200_000, "too large"),
    ],
)
def test_hostile_yaml(tmp_path, monkeypatch, text, told):
    monkeypatch.chdir(tmp_path)
    # the limit itself takes seconds
    monkeypatch.setattr(yaml_source, "MAX_NODES", MAX_NODES // 10)
    path = tmp_path / "lens.yaml"
    path.write_text(text)
    message = refusal(lambda: read_yaml(path))
    assert told in message or "at most" in message
    assert not (tmp_path / "touched").exists()


def test_a_hostile_lens_is_refused_as_any_yaml_is(tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text("a: !!python/object/apply:os.system ['touch touched']\n")
    assert "tag" in refusal(lambda: read_lens(path, 640, 576))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[" * 200_000, "too deep"),
        ('{"a": 1, "a": 2}', "the key a occurs twice"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ('{"a": -Infinity}', "not a JSON number"),
        ("9" * 10_000, "digits"),
        ("", "Expecting value"),
    ],
)
def test_strict_json(text, told):
    with pytest.raises(ValueError, match=told):
        strict_json(text.encode())


def test_of_many_mistakes_the_first_are_told(tmp_path):
    text = (ROOT / "experiments" / "smoke.yaml").read_text()
    (tmp_path / "a.yaml").write_text(text + "".join(f"k{i}: 1\n" for i in range(1000)))
    message = refusal(lambda: load_experiment(tmp_path / "a.yaml"))
    assert "100 problems" in message and "unknown key `k0`" in message


def test_many_keys_take_no_long_time(tmp_path):
    path = tmp_path / "lens.json"
    path.write_text("{" + ",".join(f'"k{i}": 1' for i in range(100_000)) + "}")
    assert "holds no lens" in refusal(lambda: read_lens(path, 640, 576))


@pytest.mark.parametrize(
    "content", [b"[" * 200_000, b'{"record_version": 1, "record_version": 1}', b"\0" * 1000]
)
def test_hostile_records(tmp_path, content):
    (tmp_path / "study.json").write_bytes(content)
    assert "is not JSON" in refusal(lambda: read_record(tmp_path))


def test_a_file_that_is_larger_than_it_may_be_is_not_read(tmp_path):
    path = sparse(tmp_path / "study.json")
    assert "more than 256 MiB" in refusal(lambda: read_record(path))
    assert "more than 10 bytes" in refusal(lambda: bounded_bytes(Path("/dev/zero"), 10))


def sparse(path: Path) -> Path:
    """A file that says it is a terabyte long."""
    with path.open("wb") as file:
        file.truncate(1 << 40)
    return path


@pytest.mark.parametrize(
    ("read", "told"),
    [
        (lambda path: read_inspections(path, "size", ["hit"]), "more than 256 MiB"),
        (lambda path: read_poses(path, 1), "more than 16 MiB"),
        (read_mask, "is not a readable image (has more than 512 MiB)"),
    ],
    ids=["inspections", "poses", "mask"],
)
def test_no_reader_takes_in_a_terabyte(tmp_path, read, told):
    assert told in refusal(lambda: read(sparse(tmp_path / "large")))


def test_a_mask_that_states_more_pixels_than_a_picture_has(tmp_path):
    path = tmp_path / "mask.png"
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0)
    content = (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
    )
    content += struct.pack(">I4sI", 0, b"IDAT", zlib.crc32(b"IDAT"))
    path.write_bytes(content)
    assert "is not a readable image (30000 x 30000 pixels)" in refusal(lambda: read_mask(path))


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 10_000, "[1, 2"])
def test_a_setting_that_is_no_yaml_is_refused(text):
    settings: dict[str, object] = {}
    message = refusal(lambda: assign(settings, f"a.b={text}"))
    assert message.startswith("--set: 1 problem") and len(message) < 1000
    assert settings == {}


# ---- names
# ----------------------------------------------------------------------------------------------------------

NAMES = ["..", "../a", "a/b", "/etc/a", "a\\b", "", ".", "a\0b"]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_cannot_leave_the_folder(tmp_path, name):
    with pytest.raises(UserError, match="is not a name for a file or folder"):
        inside(tmp_path, "fine", name)


def test_a_link_cannot_leave_the_folder_but_may_be_it(tmp_path):
    out = tmp_path / "out"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    out.mkdir()
    (out / "study").symlink_to(elsewhere)
    assert "leads out of" in refusal(lambda: inside(out, "study", "abc"))
    (out / "near").symlink_to("study2")
    assert inside(out, "near", "abc") == out / "near" / "abc"
    (tmp_path / "linked").symlink_to(elsewhere)
    assert inside(tmp_path / "linked", "study") == tmp_path / "linked" / "study"


def test_a_link_in_a_files_place_is_replaced_and_not_followed(tmp_path):
    (tmp_path / "precious").write_text("old")
    (tmp_path / "report.html").symlink_to(tmp_path / "precious")
    write_text(tmp_path / "report.html", "new")
    assert (tmp_path / "precious").read_text() == "old" and (
        tmp_path / "report.html"
    ).read_text() == "new"


@pytest.mark.parametrize(
    "name", ["..", "../a", "a/b", "/etc", "a\\b", "a\0b", "a\n", " ", "", ".a", "x" * 65]
)
def test_an_experiments_name_is_plain(tmp_path, name):
    text = (ROOT / "experiments" / "smoke.yaml").read_text()
    lines = [
        f"name: {json.dumps(name)}" if line.startswith("name:") else line
        for line in text.splitlines()
    ]
    (tmp_path / "a.yaml").write_text("\n".join(lines))
    assert "`name`" in refusal(lambda: load_experiment(tmp_path / "a.yaml"))


@pytest.mark.parametrize("path", ["a\0b", "/proc/self/mem", "/dev/zero", "x" * 5000])
def test_odd_paths_of_a_capture(tmp_path, path):
    text = (
        "name: a\nsource:\n  kind: capture\n  paths: [" + json.dumps(path) + "]\n"
        "capture: {frames: 1}\nthreshold: {k: 5.0}\n"
    )
    (tmp_path / "a.yaml").write_text(text)
    assert "a.yaml" in refusal(lambda: load_experiment(tmp_path / "a.yaml"))
