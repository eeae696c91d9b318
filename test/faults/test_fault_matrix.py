"""Every fault in lockstep: the arm ends still or at the goal, within its limits, and somebody says why.

`pytest test/faults --write-faults` writes what it finds to docs/faults.md.
"""

import pytest
from cases import CASES
from conftest import run_case
from page import KINDS_HEADING, PAGE, replaced, row_head

from contact_reach_ros.plant.fault_kinds import KINDS, kinds_table
from contact_reach_ros.plant.fault_schedules import parse_faults


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_required_end(case):
    _, lacking = run_case(case)
    assert not lacking


def test_matrix_has_every_kind_and_no_case_twice():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 40
    assert {fault.KIND for case in CASES for fault in parse_faults(case.fault)} == set(KINDS)


def test_page_lists_every_case_and_kind():
    text = PAGE.read_text()
    for case in CASES:
        assert row_head(case) in text, f"docs/faults.md lacks {case.name}: run pytest test/faults --write-faults"
    assert text.count("\n| free |") + text.count("\n| ball |") + text.count("\n| wall |") == len(CASES)
    assert replaced(text, KINDS_HEADING, kinds_table()) == text
