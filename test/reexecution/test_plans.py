"""Plans of a bag are solved again, and differences are noticed."""

import copy

import pytest

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError
from contact_reach_ros.reexecution.command import DIFFERENT, IDENTICAL, run_reexecution
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.plans import TOLERANCES, solve_again
from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"
PLAN = 30


@pytest.fixture(scope="module")
def inputs() -> RecordedInputs:
    return RecordedInputs(BagReader(SAMPLE))


def test_a_plan_that_the_bag_lacks_is_refused_with_those_that_it_has(inputs: RecordedInputs) -> None:
    """The sample has a request for each of its plans."""
    last = inputs.bag.topics["/plan/statistics"].message_count
    with pytest.raises(BagError, match=f"sample' lacks plan 9999; expected one of its {last} plans from 1 to {last}"):
        solve_again(inputs, 9999)


def test_plans_without_their_requests_need_the_version_that_recorded_them(inputs: RecordedInputs) -> None:
    without, bag = copy.copy(inputs), inputs.bag
    without.bag = copy.copy(bag)
    without.bag.messages = lambda name: iter(list(bag.messages(name))[:1] if name == "/plan/statistics" else [])
    with pytest.raises(BagError, match=r"sample': no plan .*expected plan/request.*with that version"):
        solve_again(without, 1)


@pytest.mark.slow
class TestSolved:
    @pytest.mark.parametrize("number", [1, PLAN, 70])
    def test_it_is_equal_within_the_tolerances(self, inputs: RecordedInputs, number: int) -> None:
        found = solve_again(inputs, number)
        assert not found.exceeded
        assert set(found.differences) == set(TOLERANCES)

    def test_the_command_says_so_with_its_exit_code(self, monkeypatch, capsys) -> None:
        assert run_reexecution(SAMPLE, plan=PLAN) == IDENTICAL
        assert "EQUAL within tolerances" in capsys.readouterr().out
        monkeypatch.setitem(TOLERANCES, "cost", -1.0)
        assert run_reexecution(SAMPLE, plan=PLAN) == DIFFERENT
        assert "DIFFERENT: cost by" in capsys.readouterr().out
