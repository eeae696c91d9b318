"""Every fault in lockstep: the arm ends still or at the goal, within its limits, and somebody says why.

`pytest test/faults` runs all lines, with `--quick` the first, and one of each kind of fault that ends still.
"""

from pathlib import Path

from cases import CASES, KINDS, REACHED
from conftest import run_case

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        cases = CASES
        if metafunc.config.getoption("--quick"):
            last_first = sorted(CASES, key=lambda case: case.end == REACHED)[::-1]
            cases = [CASES[0], *{type(case.faults[0]): case for case in last_first if case.faults}.values()]
        metafunc.parametrize("case", cases, ids=[case.name for case in cases])


def test_required_end(case):
    assert not run_case(case)


def test_page_lists_every_kind_with_its_required_ends():
    text = PAGE.read_text()
    for kind in KINDS:
        cases = [case for case in CASES if any(isinstance(fault, kind) for fault in case.faults)]
        assert cases, kind
        reached = sum(case.end == REACHED for case in cases)
        row = f"| `{kind.__name__}` | {' '.join(kind.__doc__.split())} | {reached} | {len(cases) - reached} |"
        assert row in text, f"docs/faults.md lacks the row {row}"
