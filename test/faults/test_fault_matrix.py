"""Every fault in lockstep: the arm ends still or at the goal, within its limits, and somebody says why.

`pytest test/faults` runs all lines, with `--quick` one for each kind of fault and end; with `--write-faults` it writes
what it finds to docs/faults.md.
"""

from cases import CASES, KINDS
from conftest import run_case
from page import PAGE, row_head


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        cases = CASES
        if metafunc.config.getoption("--quick"):
            cases = {(tuple(map(type, case.faults)), case.end): case for case in reversed(CASES)}.values()
        metafunc.parametrize("case", cases, ids=[case.name for case in cases])


def test_required_end(case):
    _, lacking = run_case(case)
    assert not lacking


def test_matrix_has_every_kind_and_no_case_twice():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 80
    assert sum(case.planner == "small" for case in CASES) >= len(CASES) / 2
    assert {type(fault) for case in CASES for fault in case.faults} == set(KINDS)


def test_page_lists_every_kind():
    text = PAGE.read_text()
    for kind in KINDS:
        assert row_head(kind) in text, f"docs/faults.md lacks {kind.__name__}: run pytest test/faults --write-faults"
