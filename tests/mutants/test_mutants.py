"""The tool that tries mutants: its kinds of faults, its draw, its verdicts on a tiny tree."""

import subprocess
from pathlib import Path

import pytest

from tests.mutants.__main__ import HERE, ROOT, stored, try_all
from tests.mutants.draw import (
    Equivalents,
    all_mutants,
    drawn,
    entries,
    named,
    numeric_modules,
)
from tests.mutants.kinds import RULES, mutants_of, named_mutant
from tests.mutants.page import MutantTrial, page
from tests.mutants.rooms import room_tests
from tests.mutants.trying import BrokenTests, Tree, run_tests, users_of_kernels

KINDS = {
    "constant": [
        ("y = x + 3", {"y = x + 6", "y = x + 4", "y = x + 0"}),
        ("y = x + 0", {"y = x + 1"}),
        ("y = x + 1", {"y = x + 2", "y = x + 0"}),
        ("y = x + 1e-9", {"y = x + 1.000000001"}),
        ("y = x[True]", set()),
    ],
    "comparison": [
        ("y = x < z", {"y = x <= z", "y = x > z"}),
        ("y = x <= z", {"y = x < z", "y = x >= z"}),
        ("y = x > z", {"y = x >= z", "y = x < z"}),
        ("y = x >= z", {"y = x > z", "y = x <= z"}),
        ("y = x == z", {"y = x != z"}),
        ("y = x != z", {"y = x == z"}),
        (
            "y = a < x <= b",
            {"y = a <= x <= b", "y = a > x <= b"} | {"y = a < x < b", "y = a < x >= b"},
        ),
    ],
    "sign": [
        ("y = a + b", {"y = a - b"}),
        ("y = (a + b) * c", {"y = (a - b) * c", "y = (a + b) / c"}),
        ("y = a / (b - c)", {"y = a * (b - c)", "y = a / (b + c)"}),
        ("y = -a", {"y = a"}),
        ("y -= a", {"y += a"}),
        ("y = name + 'text'", set()),
        ("y = [a] + b", set()),
    ],
    "dropped term": [
        ("y = a + b * c", {"y = a", "y = (b * c)", "y = a + b", "y = a + c"}),
        ("y = (a if c else d) - b", {"y = (a if c else d)", "y = -b"}),
        ("y = a / b", {"y = a"}),
    ],
    "swapped arguments": [
        ("y = f(a, b, 1)", {"y = f(b, a, 1)"}),
        ("y = f(a.x, b.x)", {"y = f(b.x, a.x)"}),
        ("y = f(a, 'b', *c)", set()),
        ("y = np.hypot(a, b)", set()),
    ],
    "negated condition": [
        ("y = a if b and c else d", {"y = a if not (b and c) else d"}),
        ("y = [a for a in b if a]", {"y = [a for a in b if not (a)]"}),
        ("while a: pass", {"while not (a): pass"}),
        ("if not a: pass", set()),
    ],
    "dropped not": [
        ("y = not a", {"y = a"}),
        ("y = ~(a & b) | c", {"y = (a & b) | c"}),
    ],
    "min and max": [
        ("y = min(a, b)", {"y = max(a, b)"}),
        ("y = np.nanmax(a.argmin())", {"y = np.nanmin(a.argmin())", "y = np.nanmax(a.argmax())"}),
        ("y = np.floor(a)", {"y = np.ceil(a)"}),
        ("y = any(a)", {"y = all(a)"}),
    ],
    "and and or": [
        ("y = a and (b or c)", {"y = a or (b or c)", "y = a and (b and c)"}),
        ("y = land and borne", {"y = land or borne"}),
        ("y = a & b", {"y = a | b"}),
    ],
    "dropped function": [
        ("y = abs(a - b)", {"y = (a - b)"}),
        ("y = 1 / np.sqrt(a)", {"y = 1 / (a)"}),
    ],
}
CASES = [(kind, code, mutants) for kind, cases in KINDS.items() for code, mutants in cases]

UNTOUCHED = '''"""A docstring with 3 words, 1 < 2 and not 4."""
import math
version = 4
LAYOUT_VERSION = 5
size: "tuple[int, 3]"
@cached(maxsize=7)
def _options(parser):
    parser.add_argument("--size", default=3, type=int)
def f(count: Literal[2]) -> Literal[3]:
    """Return 5 < 6."""
    print(3, count)
    if count:
        raise UserError(f"{count + 1} is more than 3", count - 1)
    assert count < 3
    axis.plot(count, 4)
    return f"{2 * count:3d}"
'''

SOURCE = """
def area(width, height):
    if width < 0:
        return 0.0
    return width * height


def unwatched(width):
    return width + 1.0
"""
TESTS = """
from scenes.tiny import area, unwatched


def test_area():
    assert area(3.0, 2.0) == 6.0


def test_unwatched():
    assert unwatched(2.0) > 0.0
"""


def texts(kind: str, code: str) -> set[str]:
    mutants = mutants_of("a.py", code.encode())
    return {mutant.mutant for mutant in mutants if mutant.kind == kind}


@pytest.mark.parametrize(("kind", "code", "expected"), CASES)
def test_every_kind_does_what_it_says(kind: str, code: str, expected: set[str]):
    assert texts(kind, code) == expected


def test_every_kind_is_tested():
    assert set(KINDS) == set(RULES)


def test_messages_and_annotations_are_left_alone():
    mutants = {
        (mutant.function, mutant.mutant) for mutant in mutants_of("a.py", UNTOUCHED.encode())
    }
    assert mutants == {("f", "if not (count):")}


def test_a_mutant_changes_nothing_but_its_expression():
    """Also behind characters of several bytes, and over several lines."""
    data = "größe = 'µm'; y = (a  # x + y\n     + b)\nz = 'µ', b   - c  # as it is\n".encode()
    changed = {mutant.applied(data).decode() for mutant in mutants_of("a.py", data)}
    assert "größe = 'µm'; y = (a  # x + y\n     + b)\nz = 'µ', b   + c  # as it is\n" in changed
    assert "größe = 'µm'; y = (b)\nz = 'µ', b   - c  # as it is\n" in changed


def test_equal_lines_are_told_apart_and_functions_named():
    code = b"class A:\n    def f(self):\n        x = a + b\n        x = a + b\n"
    signs = [mutant for mutant in mutants_of("a.py", code) if mutant.kind == "sign"]
    assert [mutant.function for mutant in signs] == ["A.f", "A.f"]
    assert [mutant.repeat for mutant in signs] == [0, 1]
    assert len({mutant.key for mutant in signs}) == 2


def test_the_draw_depends_on_the_seed_and_on_content_alone():
    lines = [f"def f{number}():\n    return a{number} * {number} + b" for number in range(40)]
    mutants = mutants_of("room/a.py", "\n".join(lines).encode())
    chosen = drawn(mutants, 20, 1)
    assert drawn(list(reversed(mutants)), 20, 1) == chosen
    assert drawn(mutants, 20, 2) != chosen
    assert set(drawn(mutants, 10, 1)) < set(chosen)
    moved = mutants_of("other/a.py", ("# a comment\n\n" + "\n".join(lines)).encode())
    assert [mutant.key[1:] for mutant in drawn(moved, 20, 1)] == [
        mutant.key[1:] for mutant in chosen
    ]


def test_of_an_expression_one_mutant_at_most_is_drawn():
    mutants = mutants_of("a.py", b"y = 7\nz = 8\n")
    assert len(mutants) == 6
    assert [mutant.original for mutant in drawn(mutants, 100, 1)] == ["y = 7", "z = 8"]


def test_a_named_fault_is_found_by_its_function_and_text():
    function = b"def f():\n    return max(\n        a,\n        b,\n    )\n"
    code = function + b"def g():\n    return max(a, b)\n"
    mutant = named_mutant("a.py", code, "f", "max(a, b)", "min(a, b)")
    assert mutant is not None
    assert (
        mutant.applied(code) == b"def f():\n    return min(a, b)\ndef g():\n    return max(a, b)\n"
    )
    assert named_mutant("a.py", code, "h", "max(a, b)", "min(a, b)") is None, (
        "it stands there twice"
    )
    moved = named_mutant("a.py", function, "h", "max(a, b)", "min(a, b)")
    assert moved is not None, "a function may be renamed"
    assert named_mutant("a.py", code, "f", "max(a, c)", "min(a, b)") is None


def test_the_lists_can_be_read(tmp_path: Path):
    fields = ["file", "function", "original", "replaced", "says", "test"]
    listed = entries(HERE / "named.yaml")
    assert len(listed) >= 17
    assert all(list(entry) == fields for entry in listed)
    assert all(isinstance(text, str) for entry in listed for text in entry.values())
    fields = ["file", "function", "original", "mutant", "reason"]
    assert all(list(entry) == fields for entry in entries(HERE / "equivalent.yaml"))


def test_a_listed_fault_is_sought_in_all_modules_if_its_file_has_moved(tiny: Path, tmp_path: Path):
    listed = tmp_path / "named.yaml"
    entry = "- {file: old.py, function: area, original: width < 0, replaced: width > 0}\n"
    listed.write_text(entry + entry.replace("width < 0", "width < 1"))
    mutants, lost = named(tiny, listed)
    assert [mutant.mutant for mutant in mutants] == ["if width > 0:"]
    assert lost == ["old.py: area does not have once: width < 1"]


def test_an_equivalent_mutant_keeps_its_reason_until_its_text_changes(tiny: Path, tmp_path: Path):
    listed = tmp_path / "equivalent.yaml"
    entry = "- {file: harness/tiny.py, function: area, original: if width < 0:, reason: None is 0,"
    listed.write_text(f"{entry} mutant: if width <= 0:}}\n{entry} mutant: if width <= 1:}}\n")
    equivalents = Equivalents(listed)
    mutants = [mutant for mutant in all_mutants(tiny, "*") if mutant.kind == "comparison"]
    reasons = {mutant.mutant: equivalents.reason(mutant) for mutant in mutants}
    assert reasons == {"if width <= 0:": "None is 0", "if width > 0:": None}
    assert equivalents.stale(tiny) == ["tiny.py | area | if width < 0: | if width <= 1:"]


def test_the_numeric_modules_are_those_that_compute():
    modules = numeric_modules(ROOT)
    assert {"scenes/optics.py", "detectors/findings/hole_model.py"} <= set(modules)
    assert not {"harness/__init__.py", "harness/sweep.py", "harness/report/page.py"} & set(modules)


def test_every_numeric_module_has_tests():
    for file in numeric_modules(ROOT):
        direct, indirect = room_tests(ROOT, file)
        assert direct or indirect, file


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with one module, which its tests watch in part."""
    root = tmp_path_factory.mktemp("tiny")
    subprocess.run(["git", "init", "--quiet"], cwd=root, check=True)
    (root / "scenes").mkdir()
    (root / "tests" / "scenes").mkdir(parents=True)
    (root / "scenes" / "__init__.py").touch()
    (root / "scenes" / "tiny.py").write_text(SOURCE)
    (root / "tests" / "scenes" / "test_tiny.py").write_text(TESTS)
    return root


def test_a_watched_fault_is_killed_and_an_unwatched_one_lives(tiny: Path, tmp_path: Path):
    mutants = [mutant for mutant in all_mutants(tiny, "*") if mutant.kind == "sign"]
    assert [mutant.function for mutant in mutants] == ["area", "unwatched"]
    records = try_all(mutants, Tree(tiny, tmp_path), tmp_path / "results.jsonl", jobs=2)
    killer = "tests/scenes/test_tiny.py::test_area"
    assert records == {mutants[0].key: ("killed", killer), mutants[1].key: ("survived", "")}
    assert stored(tmp_path / "results.jsonl") == records
    assert (tiny / "scenes" / "tiny.py").read_text() == SOURCE, "the checkout itself is not changed"


def test_an_endless_fault_is_ended(tiny: Path):
    (tiny / "test_endless.py").write_text("def test():\n    while True:\n        pass\n")
    run = run_tests(tiny, ["test_endless.py"], 1.0)
    assert run.state == "timed out"


def test_tests_that_fail_without_a_fault_are_refused(tiny: Path, tmp_path: Path):
    (tiny / "tests" / "scenes" / "test_broken.py").write_text("def test():\n    assert False\n")
    with pytest.raises(BrokenTests, match="test_broken"):
        Tree(tiny, tmp_path).seconds(["tests/scenes/test_broken.py"])


def test_tests_of_a_module_are_those_of_the_nearest_folder(tmp_path: Path):
    tests = tmp_path / "tests"
    (tests / "harness" / "room").mkdir(parents=True)
    (tests / "test_all.py").write_text("import harness.room.deep\n")
    (tests / "harness" / "test_harness.py").touch()
    (tests / "harness" / "test_user.py").write_text("import harness.room.deep\n")
    (tests / "harness" / "room" / "test_a.py").touch()
    (tests / "harness" / "room" / "test_b.py").write_text("from harness.room import deep\n")
    (tests / "harness" / "room" / "test_c.py").write_text("import harness.room.deep\n")
    folder = "tests/harness/room"
    around = ["tests/harness/test_harness.py", "tests/harness/test_user.py"]
    in_room = [f"{folder}/test_a.py", f"{folder}/test_b.py", f"{folder}/test_c.py"]
    direct = [*in_room[1:], around[1]]
    assert room_tests(tmp_path, "harness/room/deep.py") == (direct, in_room[:1])
    assert room_tests(tmp_path, "harness/room/deeper/flat.py") == ([], in_room)
    assert room_tests(tmp_path, "harness/other/flat.py") == ([], around)


def test_kernels_that_contain_a_changed_module_are_compiled_anew(tmp_path: Path):
    room = tmp_path / "detectors"
    room.mkdir()
    (room / "base.py").write_text("LIMIT = 3\n")
    (room / "inner.py").write_text("from detectors.base import LIMIT\n@njit\ndef f(): pass\n")
    (room / "outer.py").write_text("from detectors.inner import f\n@njit\ndef g(): pass\n")
    (room / "plain.py").write_text("from detectors.base import LIMIT\n")
    users = users_of_kernels(tmp_path, "detectors/base.py")
    assert users == ["detectors/inner.py", "detectors/outer.py"]


def test_the_page_counts_equivalent_mutants_apart():
    mutants = mutants_of("scenes/a.py", b"def f():\n    return 7 * a\n")
    outcomes = [
        ("killed", None),
        ("timed out", None),
        ("survived", None),
        ("survived", "No fault."),
    ]
    trials = [
        MutantTrial(mutant, state, "", reason)
        for mutant, (state, reason) in zip(mutants, outcomes, strict=False)
    ]
    text = page(trials, seed=1)
    assert "| scenes | 4 | 2 | 1 | 1 | 67 % (21 to 94) |" in text
    living = text[text.index("## Faults that live") : text.index("## Equivalent")]
    assert trials[2].mutant.mutant in living
    assert trials[3].mutant.mutant not in living
    assert "No fault." in text
