"""The headline of a study of references: what it says is true of every set-up."""

from __future__ import annotations

import numpy as np
import pytest

from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.tables.references import reference_gains, reference_headline
from tests.support.synthetic_study import SetUp, Study, study_record

SCAN = {"kind": "scan"}
GOOD_PARTS = {"kind": "good_parts", "parts": 20}
SHAPE = "source.target.board.shape"


def limits_of(a50_mm: dict[str, tuple[float, float, float]]) -> list[SetUpLimit]:
    """The limits of each shape without a reference, with a scan and with good parts."""
    set_ups = []
    for shape, sizes_mm in a50_mm.items():
        for reference, size_mm in zip((None, SCAN, GOOD_PARTS), sizes_mm, strict=True):
            axes = {SHAPE: {"kind": shape}, "compared_with": reference}
            name = f"shape={shape}, compared with={reference}"
            set_ups.append(SetUp(variant=name, axes=axes, a50_mm=size_mm, width_mm=0.4))
    record = study_record(Study(set_ups=tuple(set_ups), boards=8, hole_free_boards=4))
    return [limit_of(set_up, draws=20) for set_up in record.set_ups]


def share(limit: SetUpLimit) -> str:
    return f"{100 * limit.hits / limit.inspections:.0f}"


def test_the_reference_that_helps_on_every_part_is_named() -> None:
    # a scan helps on the panel only
    limits = limits_of({"flat": (8.0, 8.0, 5.0), "panel": (9.0, 4.0, 6.0)})
    none_flat, _, parts_flat, none_panel, _, parts_panel = limits
    sentence = reference_headline(limits)
    assert sentence == (
        f"With 20 good parts {share(parts_panel)} to {share(parts_flat)} % of the damage is found,"
        f" without a reference {share(none_panel)} to {share(none_flat)} %."
    )
    assert len(sentence.split()) <= 20
    scan, _ = reference_gains(limits)
    assert scan.p_values[0] > 0.1
    assert scan.p_values[1] < 1e-3


def test_no_reference_is_praised_for_one_part() -> None:
    limits = limits_of({"flat": (8.0, 8.0, 8.2), "panel": (8.0, 4.0, 4.5)})
    sentence = reference_headline(limits)
    assert sentence.startswith("No reference clearly helps everywhere: ")
    none_flat, _, _, none_panel, _, _ = limits
    without = sorted([share(none_flat), share(none_panel)], key=int)
    assert sentence.endswith(f" {' to '.join(dict.fromkeys(without))} % without.")
    assert len(sentence.split()) <= 20


def test_a_gain_is_judged_over_boards() -> None:
    (gain, _) = reference_gains(limits_of({"flat": (8.0, 7.4, 5.0)}))
    limits = limits_of({"flat": (8.0, 7.4, 5.0)})
    without = limits[0].record.inspected
    scan = limits[1].record.inspected
    difference = [
        scan.hit[scan.board == n].sum() - without.hit[without.board == n].sum() for n in range(8)
    ]
    mean = np.mean(difference)
    t = mean / (np.std(difference, ddof=1) / np.sqrt(8))
    assert gain.shares - gain.without == pytest.approx([sum(difference) / len(without.hit)])
    # of the t distribution with 7 degrees of freedom: 1.415, 1.895, 2.998 at 10, 5 and 1 %
    levels = np.interp(t, [1.415, 1.895, 2.998], [0.1, 0.05, 0.01])
    assert gain.p_values[0] == pytest.approx(levels, abs=0.012)


def test_other_studies_have_no_such_headline() -> None:
    limits = limits_of({"flat": (8.0, 7.4, 5.0)})
    assert reference_headline(limits[1:]) == ""
    assert reference_headline([]) == ""
