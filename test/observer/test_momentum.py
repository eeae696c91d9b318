"""The momentum observer on an arm that is exactly its model."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS, ideal_plant

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.simulation.plant import TICK, Actuation

SETTINGS = MomentumSettings()
TICKS_PER_LAG = round(1.0 / SETTINGS.gain / TICK)


class Observed:
    """The simulated arm, softly held, and the observer that knows what holds it but not what else acts."""

    def __init__(
        self, start: np.ndarray = HOME, settings: MomentumSettings = SETTINGS, cutoff: float = np.inf, **plant
    ) -> None:
        """`cutoff`: of the low-pass through which the observer sees the torque, Hz."""
        self.plant = ideal_plant(start, **plant)
        self.plant.set_actuation(Actuation.COMMANDED)
        self.observer = MomentumObserver(settings, RobotModel(ARM))
        self.observer.update(start, REST, None, 0)
        self._start = start
        self._seen = None
        self._share = 1.0 - np.exp(-2.0 * np.pi * cutoff * TICK)
        self._model = RobotModel(ARM)

    def step(self, external: np.ndarray = REST) -> np.ndarray:
        """One tick with an external torque on the joints; returns the residual."""
        q, v = self.plant.data.qpos[: ARM.n].copy(), self.plant.data.qvel[: ARM.n].copy()
        self._model.update(q, v)
        inertia = np.diag(self._model.mass_matrix)
        command = self._model.bias - inertia * (400.0 * (q - self._start) + 40.0 * v)
        self.plant.step(command + external)
        reading = self.plant.read()
        self._seen = command if self._seen is None else self._seen + self._share * (command - self._seen)
        return self.observer.update(reading.q, reading.v, self._seen, self.plant.steps * TICK_NS)


@pytest.mark.parametrize("joint", [0, 3, 6])
def test_residual_follows_a_torque_step_as_a_first_order_lag(joint):
    observed = Observed()
    external = np.eye(ARM.n)[joint] * (10.0 if joint < 4 else 1.0)
    residuals = np.array([observed.step(external) for _ in range(8 * TICKS_PER_LAG)])
    shares = residuals[:, joint] / external[joint]
    ticks = np.arange(1, len(shares) + 1)
    reached = np.interp(1.0 - np.exp(-1.0), shares, ticks) * TICK
    assert reached == pytest.approx(1.0 / SETTINGS.gain, rel=0.05)
    np.testing.assert_allclose(shares, 1.0 - np.exp(-SETTINGS.gain * ticks * TICK), rtol=0, atol=0.02)
    cross_talk = np.delete(residuals, joint, axis=1)
    assert np.abs(cross_talk).max() < 0.02 * external[joint]


def test_force_at_the_flange_is_given_back_as_a_wrench():
    observed = Observed(HOME + 0.1)
    model = RobotModel(ARM)
    wrench = np.array([8.0, -6.0, 10.0, 0.4, 0.8, -0.5])
    for _ in range(40 * TICKS_PER_LAG):
        model.update(observed.plant.data.qpos[: ARM.n].copy(), REST)
        residual = observed.step(model.jacobian.T @ wrench)
    np.testing.assert_allclose(residual, model.jacobian.T @ wrench, rtol=0, atol=0.02)
    # The damping of the pseudo-inverse takes a share of what the arm hardly feels.
    np.testing.assert_allclose(observed.observer.flange_wrench(damping=1e-4), wrench, rtol=0, atol=0.05)
    np.testing.assert_allclose(observed.observer.flange_wrench(), wrench, rtol=0, atol=0.15 * np.linalg.norm(wrench))


@pytest.mark.parametrize(("kind", "friction"), [("viscous_friction", 2.0), ("coulomb_friction", 0.5)])
def test_known_friction_of_moving_joints_is_not_taken_for_a_push(kind, friction):
    true = (friction, 0.0) if kind == "viscous_friction" else (0.0, friction)
    largest = {}
    for expected in (0.0, friction):
        observed = Observed(settings=MomentumSettings(**{kind: (expected,) * ARM.n}), friction=true)
        observed.plant.data.qvel[:] = 0.5
        observed.observer = MomentumObserver(observed.observer.settings, RobotModel(ARM))
        # These go on for a while; joints at rest stick, with less than the whole dry friction.
        moving = [0, 2, 4]
        largest[expected] = np.abs([observed.step()[moving] for _ in range(40)]).max()
        assert np.abs(observed.plant.data.qvel[moving]).min() > 0.1
    assert largest[friction] < 0.1
    assert largest[0.0] > 0.4


def settled(settings: MomentumSettings, torque: np.ndarray) -> np.ndarray:
    """Residual of an arm at rest at home on which this torque is said to act."""
    observer = MomentumObserver(settings, RobotModel(ARM))
    for tick in range(20 * TICKS_PER_LAG):
        residual = observer.update(HOME, REST, torque, tick * TICK_NS)
    return residual


def test_arm_that_compensates_gravity_itself():
    gravity, push = RobotModel(ARM).gravity_at(HOME), np.array([3.0, -2.0, 1.0, 4.0, 0.5, 0.2, -0.1])
    np.testing.assert_allclose(settled(SETTINGS, gravity - push), push, atol=1e-6)
    compensated = MomentumSettings(gravity_in_torque=False)
    np.testing.assert_allclose(settled(compensated, -push), push, atol=1e-6)
    # The wrong choice is seen as the whole weight.
    np.testing.assert_allclose(settled(compensated, gravity), -gravity, atol=1e-6)


@pytest.mark.parametrize("rotors_in_torque", [True, False])
def test_torque_measured_behind_the_rotors_does_not_hold_what_accelerates_them(rotors_in_torque):
    observer = MomentumObserver(MomentumSettings(rotors_in_torque=rotors_in_torque), RobotModel(ARM))
    model = RobotModel(ARM)
    acceleration = 20.0
    for tick in range(61):
        time = 1e-3 * tick
        v = np.full(ARM.n, acceleration * time)
        q = HOME + 0.5 * acceleration * time**2
        # What acted in the middle of the step before.
        middle = time - 5e-4
        model.update(HOME + 0.5 * acceleration * middle**2, np.full(ARM.n, acceleration * middle))
        torque = model.mass_matrix @ np.full(ARM.n, acceleration) + model.bias
        if not rotors_in_torque:
            torque = torque - ARM.joints[0].armature * acceleration
        residual = observer.update(q, v, torque, tick * TICK_NS)
    # The rotors' share would be 0.01 kg m² · 20 rad/s² = 0.2 Nm on every joint.
    assert np.abs(residual).max() < 0.05


def test_steps_of_varying_length_are_taken_as_they_come():
    external, gravity = np.array([4.0, -6.0, 2.0, 3.0, -1.0, 1.0, 0.5]), RobotModel(ARM).gravity_at(HOME)
    stamps = np.cumsum(np.random.default_rng(0).integers(300_000, 2_500_000, 150))
    observer = MomentumObserver(SETTINGS, RobotModel(ARM))
    for stamp_ns in stamps.tolist():
        residual = observer.update(HOME, REST, gravity - external, stamp_ns)
        elapsed = 1e-9 * (stamp_ns - stamps[0])
        np.testing.assert_allclose(residual, external * (1.0 - np.exp(-SETTINGS.gain * elapsed)), rtol=0, atol=0.1)
    assert observer.gaps == 0


class TestInterruptions:
    """A residual of some size, and then a state that cannot be used."""

    @pytest.fixture
    def observed(self) -> Observed:
        observed = Observed()
        for _ in range(30):
            observed.step(np.full(ARM.n, 1.0))
        assert np.abs(observed.observer.residual).min() > 0.5
        return observed

    def test_gap_freezes_the_residual_is_counted_and_passes(self, observed):
        observer, gravity = observed.observer, RobotModel(ARM).gravity_at(HOME)
        before = observer.residual.copy()
        # After 20 ms without states the arm moves otherwise; the jump in momentum must not be seen.
        residual = observer.update(HOME, np.full(ARM.n, 0.5), REST, (30 + 20) * TICK_NS)
        np.testing.assert_array_equal(residual, before)
        assert observer.gaps == 1
        observer.update(HOME, REST, gravity, 70 * TICK_NS)
        residual = observer.update(HOME, REST, gravity, 71 * TICK_NS)
        np.testing.assert_allclose(residual, before * np.exp(-SETTINGS.gain * TICK), rtol=1e-9, atol=1e-9)

    @pytest.mark.filterwarnings("ignore::RuntimeWarning")
    @pytest.mark.parametrize(("field", "value"), [("position", np.inf), ("velocity", np.nan), ("torque", np.inf)])
    def test_state_that_is_not_finite_is_refused_and_forgotten(self, observed, field, value):
        observer = observed.observer
        before = observer.residual.copy()
        gravity = RobotModel(ARM).gravity_at(HOME)
        state = {"position": HOME.copy(), "velocity": REST.copy(), "torque": gravity.copy()}
        # Two that cancel in a sum are no better.
        state[field][[2, 5]] = value, -value
        residual = observer.update(state["position"], state["velocity"], state["torque"], 31 * TICK_NS)
        np.testing.assert_array_equal(residual, before)
        assert observer.refused == 1
        for _ in range(20 * TICKS_PER_LAG):
            observed.step()
        assert observer.refused == 1
        assert observer.gaps == 0
        assert np.isfinite(observer.flange_wrench()).all()
        np.testing.assert_allclose(observer.residual, 0, atol=1e-3)


def filtered_run(cutoff, settings, push=0.0):
    """Residuals of an arm that swings, and is pushed at half-time, whose torque arrives behind a low-pass."""
    observed = Observed(settings=settings, cutoff=cutoff)
    observed.plant.data.qvel[:] = [0.8, -0.6, 0.7, 0.8, -1.0, 0.9, 1.0]
    observed.observer = MomentumObserver(observed.observer.settings, RobotModel(ARM))
    return np.array([observed.step(push * np.eye(ARM.n)[1] * (tick >= 200)) for tick in range(400)])


def test_torques_behind_a_low_pass_are_no_push_if_the_observer_follows_it():
    follows = MomentumSettings(torque_cutoff=10.0)
    assert np.abs(filtered_run(10.0, SETTINGS)).max() > 3.0
    assert np.abs(filtered_run(10.0, follows)).max() < 0.25
    pushed = filtered_run(10.0, follows, push=10.0)[:, 1] / 10.0
    # The lag of the residual, and that of the filter.
    assert 0.028 < (np.argmax(pushed > 1.0 - np.exp(-1.0)) - 200) * TICK < 0.045
    assert pushed[-1] == pytest.approx(1.0, abs=0.03)
