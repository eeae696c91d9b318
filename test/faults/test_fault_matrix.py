"""Every fault in lockstep: the arm ends still or at the goal, within its limits, and somebody says why.

`pytest test/faults` runs all lines, with `--quick` one for each kind of fault and end; with `--write-faults` it writes
what it finds to docs/faults.md.
"""

from arm_simulation import ARM
from cases import CASES
from conftest import run_case
from page import KINDS_HEADING, PAGE, row_head
from page_tables import replaced

from contact_reach_ros.simulation.fault_kinds import fault_kinds, kinds_table
from contact_reach_ros.simulation.fault_schedules import parse_faults


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        cases = CASES
        if metafunc.config.getoption("--quick"):
            cases = {(case.fault.split()[0], case.end): case for case in reversed(CASES)}.values()
        metafunc.parametrize("case", cases, ids=[case.name for case in cases])


def test_required_end(case):
    _, lacking = run_case(case)
    assert not lacking


def test_matrix_has_every_kind_and_no_case_twice():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 120
    assert sum(case.planner == "small" for case in CASES) >= len(CASES) / 2
    played = {fault.name for case in CASES for fault in parse_faults(case.fault, ARM)}
    assert played == set(fault_kinds(ARM))


def test_page_lists_every_case_and_kind():
    text = PAGE.read_text()
    for case in CASES:
        assert row_head(case) in text, f"docs/faults.md lacks {case.name}: run pytest test/faults --write-faults"
    assert sum(text.count(f"\n| {scene} |") for scene in {case.scene for case in CASES}) == len(CASES)
    assert replaced(text, KINDS_HEADING, kinds_table(ARM)) == text
