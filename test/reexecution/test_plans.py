"""Plans of a bag are solved again, and differences are noticed."""

import copy

import pytest

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError
from contact_reach_ros.reexecution.command import DIFFERENT, IDENTICAL, run_reexecution
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.plans import TOLERANCES, RecordedPlans
from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"
PLAN = 30


@pytest.fixture(scope="module")
def plans() -> RecordedPlans:
    return RecordedPlans(RecordedInputs(BagReader(SAMPLE)))


def test_the_sample_has_a_request_for_each_of_its_plans(plans: RecordedPlans) -> None:
    assert plans.numbers == list(range(1, 1 + plans._inputs.bag.topics["/plan/statistics"].message_count))


def test_a_plan_that_the_bag_lacks_is_refused_with_those_that_it_has(plans: RecordedPlans) -> None:
    with pytest.raises(BagError, match=r"sample' lacks plan 9999; expected one of its \d+ plans from 1 to \d+"):
        plans.solve(9999)


def test_plans_without_their_requests_need_the_version_that_recorded_them(plans: RecordedPlans) -> None:
    inputs, bag = copy.copy(plans._inputs), plans._inputs.bag
    inputs.bag = copy.copy(bag)
    inputs.bag.messages = lambda name: iter(list(bag.messages(name))[:1] if name == "/plan/statistics" else [])
    with pytest.raises(BagError, match=r"sample': no plan .*expected plan/request.*with that version"):
        RecordedPlans(inputs)


@pytest.mark.slow
class TestSolved:
    def test_it_is_equal_within_the_tolerances(self, plans: RecordedPlans) -> None:
        for number in (plans.numbers[0], PLAN, plans.numbers[-1]):
            found = plans.solve(number)
            assert not found.exceeded, (number, found.exceeded)
            assert set(found.differences) == set(TOLERANCES)

    def test_the_command_says_so_with_its_exit_code(self, plans: RecordedPlans, monkeypatch, capsys) -> None:
        monkeypatch.setattr("contact_reach_ros.reexecution.plans.RecordedPlans", lambda _: plans)
        assert run_reexecution(SAMPLE, plan=PLAN) == IDENTICAL
        assert "EQUAL within tolerances" in capsys.readouterr().out
        monkeypatch.setitem(TOLERANCES, "cost", -1.0)
        assert run_reexecution(SAMPLE, plan=PLAN) == DIFFERENT
        assert "DIFFERENT: cost by" in capsys.readouterr().out
