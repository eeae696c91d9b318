"""When plans are requested, and what for; the core that makes them only takes notes."""

import dataclasses
import math

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS
from plans import StayingCore

from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, PlanningError, UnreachableError
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.goal_progress import GoalPhase
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.planner import Planner
from contact_reach_ros.planning.settings import (
    GIVE_WAY,
    IGNORE,
    REACTIONS,
    ReplanningSettings,
    UnexpectedContactSettings,
)
from contact_reach_ros.world.goal import FREE, Goal
from contact_reach_ros.world.rigid import Block
from contact_reach_ros.world.spheres import Spheres

SETTINGS = ReplanningSettings(period=0.03, latency=0.04, require_obstacles=False)
GOAL = Goal([0.5, 0.1, 0.3])
OTHER_GOAL = Goal([0.4, -0.2, 0.4], FREE)
BEYOND = Goal([5.0, 0.0, 0.0])
TIP, ROTATION = RobotModel(ARM).tip_pose(HOME)
BESIDE = Goal(TIP + np.array([0.02, 0.0, 0.0]))


def make(
    core: StayingCore | None = None, reaction: str = GIVE_WAY, settings: ReplanningSettings = SETTINGS, **others
) -> Planner:
    return Planner(ARM, core, settings, UnexpectedContactSettings(reaction=reaction), **others)


def state(tick: int, q: np.ndarray = HOME) -> JointState:
    return JointState(tick * TICK_NS, q, REST, None)


def touch(force: float = 10.0, is_excessive: bool = False) -> Contact:
    pushed = force * ROTATION[:, 0]
    torque = RobotModel(ARM).jacobian_at(HOME)[:3].T @ pushed
    return Contact(ARM.link_names[-1], TIP, pushed, torque, is_excessive)


def begin(planner: Planner, goal: Goal = GOAL) -> Planner:
    """It sees the arm at tick 0 and takes a goal."""
    assert planner.request(state(0)) is None
    planner.command(goal)
    return planner


def requests(planner: Planner, first: int, last: int) -> dict[int, Request]:
    """What is requested for the states of the ticks from first to last, by tick."""
    made = {tick: planner.request(state(tick)) for tick in range(first, last + 1)}
    return {tick: request for tick, request in made.items() if request is not None}


@pytest.fixture
def core() -> StayingCore:
    return StayingCore()


@pytest.fixture
def planner(core) -> Planner:
    """With a goal, after the first request at tick 0."""
    planner = begin(make(core))
    assert list(requests(planner, 0, 0)) == [0]
    return planner


class TestRequests:
    def test_with_a_goal_one_is_made_at_once_and_then_whenever_the_period_is_over(self, planner):
        assert list(requests(planner, 1, 100)) == [30, 60, 90]
        assert requests(make(), 0, 100) == {}

    def test_it_is_all_that_a_plan_depends_on(self, planner):
        spheres = Spheres(TIP[None] + 1.0, TIP[None] + 1.0, np.array([0.1]), np.array([100.0]), np.array([30.0]))
        planner.see(spheres)
        given = JointState(30 * TICK_NS, HOME + 0.01, REST + 0.1, None)
        request = planner.request(given)
        assert request.q is given.q and request.v is given.v
        assert (request.state_ns, request.effect_ns) == (30 * TICK_NS, 70 * TICK_NS)
        np.testing.assert_array_equal(request.goal.position, GOAL.position)
        assert request.spheres is spheres

    @pytest.mark.parametrize(("field", "value"), [("q", math.nan), ("v", math.inf)])
    def test_a_state_that_is_not_finite_is_refused_and_forgotten(self, planner, field, value):
        before = planner.state
        bad = state(30)._replace(**{field: np.where(np.arange(ARM.n) == 2, value, 0.0)})
        with pytest.raises(InputError, match="joint_states: position and velocity must be finite"):
            planner.request(bad)
        assert planner.state is before
        assert planner.request(state(30)) is not None


class TestStreams:
    """Goals every 20 ms that move by 0.1 m/s."""

    def follow(self, planner: Planner, first: int, last: int, speed: float = 0.1) -> list[bool]:
        goes_on = []
        for tick in range(first, last, 20):
            planner.request(state(tick))
            goes_on.append(planner.command(Goal([0.5, 0.1 + 1e-3 * speed * tick, 0.3])))
        return goes_on

    def test_they_are_one_goal_from_the_third_on(self):
        planner = make()
        assert self.follow(planner, 0, 100) == [False, False, True, True, True]
        planner.request(state(99))
        assert planner.goal_state.phase is GoalPhase.FOLLOWING
        assert planner.goal_state.elapsed == pytest.approx(0.059)

    def test_plans_are_for_where_the_goal_is_when_they_take_effect(self):
        planner = make()
        self.follow(planner, 0, 200)
        tick, request = next(iter(requests(planner, 181, 210).items()))
        assert request.effect_ns == (tick + 40) * TICK_NS
        np.testing.assert_allclose(request.goal.position, [0.5, 0.1 + 1e-4 * (tick + 40), 0.3], atol=1e-6)
        np.testing.assert_allclose(request.goal.velocity, [0.0, 0.1, 0.0], atol=1e-6)

    def test_goals_sent_after_the_last_state_go_on_with_it(self):
        """As they do when a plan takes long."""
        planner = begin(make())
        sent = [planner.command(Goal([0.5, 0.1 + 1e-4 * tick, 0.3]), tick * TICK_NS) for tick in range(20, 200, 20)]
        assert sent[1:] == [True] * (len(sent) - 1)

    def test_one_that_ends_is_held_where_it_was_last(self):
        planner = make()
        self.follow(planner, 0, 100)
        request = planner.request(state(300))
        np.testing.assert_allclose(request.goal.position, [0.5, 0.108, 0.3], atol=1e-9)
        assert not request.goal.moves
        assert planner.goal_state.phase is GoalPhase.RUNNING

    def test_an_impossible_one_does_not_end_it(self):
        planner = make()
        self.follow(planner, 0, 100)
        with pytest.raises(InputError):
            planner.command(BEYOND)
        assert self.follow(planner, 100, 120) == [True]

    def test_a_stop_ends_it(self):
        planner = make()
        self.follow(planner, 0, 100)
        planner.withdraw("stopped")
        assert self.follow(planner, 100, 120) == [False]


class TestGoals:
    def test_it_holds_the_orientation_of_the_last_state(self):
        planner, turned = make(), HOME + 0.3
        planner.request(state(0, turned))
        planner.command(GOAL)
        np.testing.assert_allclose(planner.goal.rotation, RobotModel(ARM).tip_pose(turned)[1], atol=1e-12)
        assert planner.request(state(0, turned)).goal is planner.goal

    def test_further_goals_hold_that_of_the_first_and_not_one_turned_on_the_way(self):
        planner = begin(make())
        first = planner.goal.rotation
        planner.request(state(10, HOME + 0.3))
        planner.command(Goal([0.5, 0.12, 0.3]))
        np.testing.assert_array_equal(planner.goal.rotation, first)
        planner.withdraw()
        planner.command(GOAL)
        np.testing.assert_allclose(planner.goal.rotation, RobotModel(ARM).tip_pose(HOME + 0.3)[1], atol=1e-12)

    @pytest.mark.parametrize("goal", [GOAL, BEYOND])
    def test_before_the_first_state_it_is_refused_and_never_moves_the_arm(self, goal):
        planner = make()
        with pytest.raises(InputError, match=r"^goal: there is no joint state yet; .* send the goal again"):
            planner.command(goal)
        assert not planner.has_goal and planner.goal_state is None
        assert requests(planner, 0, 100) == {}

    def test_an_old_one_is_refused_and_the_one_before_stays(self, planner):
        planner.request(state(5000))
        planner.command(GOAL)
        before = planner.goal
        for sent in (1, 1000, 2999):
            with pytest.raises(InputError, match=r"^goal: its stamp is .* s older .* expected 2 s at most"):
                planner.command(OTHER_GOAL, sent * TICK_NS)
            assert planner.goal is before and planner.goal_state.phase is GoalPhase.ACCEPTED
        # Just young enough, now, and from a clock that is ahead.
        for sent in (3000, 0, 5000, 10**9):
            planner.command(GOAL, sent * TICK_NS)
            assert planner.goal is not before

    @pytest.mark.parametrize(("gap", "phase"), [(2000, GoalPhase.ACCEPTED), (2001, GoalPhase.WITHDRAWN)])
    def test_a_gap_in_the_states_ends_it(self, planner, gap, phase):
        planner.request(state(gap))
        assert planner.goal_state.phase is phase
        assert bool(requests(planner, gap + 1, gap + 100)) is (phase is GoalPhase.ACCEPTED)
        if phase is GoalPhase.WITHDRAWN:
            assert planner.goal_state.reason.startswith("no joint state came for 2.0 s, more than 2 s")

    def test_a_plan_that_took_long_is_no_gap_in_the_states_and_the_next_gap_is_one(self, planner):
        planner.took(3_000_000_000)
        planner.request(state(3100))
        assert planner.has_goal
        planner.request(state(6200))
        assert planner.goal_state.reason.startswith("no joint state came for 3.1 s")

    def test_another_one_replaces_it_from_the_next_request_on(self, planner):
        planner.command(OTHER_GOAL)
        (request,) = requests(planner, 1, 30).values()
        np.testing.assert_array_equal(request.goal.position, OTHER_GOAL.position)
        assert request.goal.rotation is None

    def test_one_of_any_orientation_holds_what_the_tip_has_there_and_is_free_again_elsewhere(self):
        planner, turned = begin(make(), Goal(TIP, FREE)), HOME + np.r_[np.zeros(6), 0.3]
        for tick, q, held in ((0, HOME, HOME), (30, turned, HOME), (60, HOME + 0.3, None), (90, turned, turned)):
            request = planner.request(state(tick, q))
            rotation = request.rotation
            assert request.goal.rotation is None and planner.goal_state.angle == 0.0
            if held is None:
                assert rotation is None
            else:
                np.testing.assert_allclose(rotation, RobotModel(ARM).tip_pose(held)[1], atol=1e-12)
        planner.command(Goal(TIP, FREE))
        assert planner.request(state(120, HOME + 0.3)).rotation is None

    @pytest.mark.parametrize(("goal", "holds"), [(Goal(TIP), True), (BESIDE, False)])
    def test_a_tip_that_has_rested_there_for_half_a_second_is_to_hold(self, goal, holds):
        planner = begin(make(), goal)
        first, *_, last = requests(planner, 1, 600).values()
        assert not first.holds and last.holds is holds

    def test_one_that_moves_holds_no_orientation_of_its_own(self):
        planner = begin(make(), Goal(TIP, FREE))
        for tick in range(10, 80, 10):
            request = planner.request(state(tick))
            planner.command(Goal(TIP + 0.00005 * tick, FREE), tick * TICK_NS)
        assert request.goal.moves and request.rotation is None

    @pytest.mark.parametrize(
        "goal",
        [BEYOND, Goal([0.5, 0, 0.3], np.ones(4))],
    )
    def test_one_that_is_refused_leaves_the_one_before(self, planner, goal):
        before = planner.goal
        with pytest.raises(InputError, match=r"^goal: "):
            planner.command(goal)
        assert planner.goal is before
        assert list(requests(planner, 1, 60)) == [30, 60]

    def test_one_that_is_withdrawn_leads_to_no_plans_and_only_another_one_does(self, planner, core):
        planner.withdraw("pushed")
        assert planner.goal is None and core.resets == 1
        assert planner.goal_state.phase is GoalPhase.WITHDRAWN and planner.goal_state.reason == "pushed"
        assert requests(planner, 1, 100) == {}
        planner.command(OTHER_GOAL)
        assert list(requests(planner, 101, 140)) == [101, 131]


class TestContacts:
    def objections(self, planner: Planner, ticks: range, contact: Contact | None) -> list[str]:
        made = []
        for tick in ticks:
            planner.request(state(tick))
            made.append(planner.objection(contact))
        return made

    def test_an_unexpected_one_is_objected_to_when_it_lasts_and_the_caller_withdraws(self, planner):
        *early, last = self.objections(planner, range(1, 12), touch())
        assert not any(early) and last.startswith("unexpected contact of 10 N at lbr_link_7")
        assert planner.goal is not None
        # A goal after that has as much time, others in its place have not.
        planner.withdraw(last)
        planner.command(OTHER_GOAL)
        assert not any(self.objections(planner, range(12, 20), touch()))
        planner.command(GOAL)
        assert [bool(why) for why in self.objections(planner, range(20, 24), touch())] == 2 * [False] + 2 * [True]

    def test_short_ones_weak_ones_and_those_without_a_goal_are_no_reason(self, planner):
        for start in range(1, 100, 20):
            assert not any(self.objections(planner, range(start, start + 10), touch()))
            assert not any(self.objections(planner, range(start + 10, start + 20), None))
        assert not any(self.objections(planner, range(100, 200), touch(4.9)))
        planner.withdraw()
        assert not any(self.objections(planner, range(200, 300), touch(is_excessive=True)))

    @pytest.mark.parametrize("reaction", REACTIONS)
    def test_one_beyond_the_permitted_force_is_objected_to_at_once_whatever_the_reaction(self, core, reaction):
        planner = begin(make(core, reaction))
        expected = "contact of 14 N at lbr_link_7, more than the permitted force"
        assert planner.objection(touch(14.0, True)) == expected

    def test_one_that_ignores_contact_objects_to_none_within_it(self, core):
        planner = begin(make(core, IGNORE))
        assert not any(self.objections(planner, range(100), touch()))


class TestObstacles:
    """Where they are has to be known, and not too old."""

    def requiring(self, **others) -> Planner:
        return make(settings=dataclasses.replace(SETTINGS, require_obstacles=True, max_obstacle_age=0.2), **others)

    def test_before_the_first_ones_goals_are_refused_with_the_remedy(self):
        planner = self.requiring()
        planner.request(state(0))
        with pytest.raises(InputError, match=r"^obstacles: none received yet; .* set require_obstacles to false"):
            planner.command(GOAL)
        assert planner.goal is None and requests(planner, 1, 100) == {}

    def test_goals_and_plans_are_refused_while_they_are_stale(self):
        refused = []
        planner = self.requiring(refuse=lambda what, error: refused.append((what, str(error))))
        planner.see(Spheres.none(), 0)
        begin(planner)
        assert list(requests(planner, 0, 320)) == [0, 30, 60, 90, 120, 150, 180]
        assert [what for what, _ in refused] == 4 * ["plans"]
        assert refused[0][1].startswith("obstacles: last seen 0.210 s ago; expected max_obstacle_age, 0.2 s, at most")
        before = planner.goal
        with pytest.raises(InputError, match=r"^obstacles: last seen 0.320 s ago"):
            planner.command(OTHER_GOAL)
        assert planner.goal is before
        planner.see(Spheres.none(), 321 * TICK_NS)
        assert list(requests(planner, 322, 400)) == [330, 360, 390]

    def test_a_goal_in_a_rigid_body_is_refused_and_the_one_before_stays(self, planner):
        planner.see(Spheres.none((Block("table", (0.4, -0.2, 0.25), (0.3, 0.3, 0.3)),)))
        before = planner.goal
        with pytest.raises(InputError, match=r"deep in the table"):
            planner.command(OTHER_GOAL)
        assert planner.goal is before


def test_the_core_is_asked_for_what_was_requested_and_without_one_no_plan_is_made(planner, core):
    request = planner.request(state(30))
    plan = planner.solve(request)
    assert core.asked == [request]
    assert planner.plan is plan and plan.effect_ns == request.effect_ns
    with pytest.raises(PlanningError, match="no core"):
        make(None).solve(request)


def fail(planner, first: int, attempts: int) -> list[GoalPhase]:
    """Phases of the goal after each of so many plans that are not found."""
    phases = []
    for attempt in range(attempts):
        request = planner.request(state(first + 30 * attempt))
        if request is not None:
            with pytest.raises(PlanningError, match="no way"):
                planner.solve(request)
        phases.append(planner.goal_state.phase)
    return phases


def test_a_goal_without_a_plan_at_the_first_attempts_is_refused_with_the_reason():
    planner = begin(make(StayingCore(failing_after=0)))
    phases = fail(planner, 0, 6)
    assert phases[:4] == 4 * [GoalPhase.ACCEPTED] and phases[-1] is GoalPhase.REFUSED
    assert not planner.has_goal and planner.goal_state.reason == "there is no plan for it: there is no way to the goal"


def test_a_goal_with_a_plan_stays_though_later_ones_are_not_found():
    planner = begin(make(StayingCore(failing_after=1)))
    planner.solve(planner.request(state(0)))
    assert fail(planner, 30, 12) == 12 * [GoalPhase.RUNNING]


def test_a_goal_that_proves_unreachable_on_the_way_is_refused_at_once():
    planner = begin(make(StayingCore(failing_after=1, error=UnreachableError)))
    planner.solve(planner.request(state(0)))
    assert fail(planner, 30, 1) == [GoalPhase.REFUSED]
    assert not planner.has_goal and "there is no way to the goal" in planner.goal_state.reason


def test_the_latency_is_that_of_the_slowest_of_the_last_plans_but_never_less_than_wanted(planner):
    for number, (took, expected) in enumerate([(30, 40), (90, 90), *7 * [(50, 90)], (50, 50)], 1):
        planner.took(took * TICK_NS)
        request = planner.request(state(30 * number))
        assert request.effect_ns - request.state_ns == expected * TICK_NS, number
