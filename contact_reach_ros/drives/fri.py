"""KUKA's FRI behind lbr_fri_ros2_stack, without ROS: settings of the driver, its states, and the check of stiffness."""

from __future__ import annotations

import cmath
import math
from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arm.robot_file import parse_xml
from contact_reach_ros.drives.settings import LbrSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.timing import NANOSECONDS

SESSION = ("IDLE", "MONITORING_WAIT", "MONITORING_READY", "COMMANDING_WAIT", "COMMANDING_ACTIVE")
"""States of an FRI session; commands are taken in the last one only."""
QUALITY = ("POOR", "FAIR", "GOOD", "EXCELLENT")
"""Qualities of the connection; FRI commands from GOOD on."""
_GOOD = QUALITY.index("GOOD")
COMMAND_MODE = ("NO_COMMAND_MODE", "POSITION", "WRENCH", "TORQUE")
"""What FRI takes from its client."""
PLUGIN = "lbr_ros2_control::SystemInterface"
"""Hardware component of the driver, in its `robot_description`."""
CONFIG = "lbr_system_config.yaml"
"""File of `lbr_description` with the settings of that component."""

POSITION_TAU = 0.04
"""Time constant with which the commanded position follows its target, s: the default of the later driver."""
_CUTOFF, _TAU = "measured_torque_cutoff_frequency", "measured_torque_tau"

_RATE_TOLERANCE = 0.01
_SKIPPED, _SKIP_MEMORY, _MOST_SKIPPED = 1.5, 0.02, 10
"""Mean number of FRI's steps from state to state above which the driver is too slow; the weight of each, and the most
that count, so that one pause is no slow driver."""
_DRIFT = 1e-4
"""By how much, at most, the robot's clock runs faster than this machine's, as a share."""
_CLOCK_SET_NS = NANOSECONDS // 2
_CHECK_PAUSE_S = 0.05
"""After a longer pause the stiffness is measured anew."""
_PAUSE_S = 1.0
"""After a longer pause velocity and unfiltered torque are unknown again."""


class LbrDriver(NamedTuple):
    """Settings of the driver, from its `robot_description`."""

    position_gain: float
    """p of the PID that the driver of 2024 adds to its commanded position in each step; 0 for later ones, which filter
    that position with `position_tau`."""
    position_tau: float
    """s."""
    torque_cutoff: float
    """Of the filter of measured torques of 2024, Hz; 0 for later ones."""
    torque_tau: float
    """Time constant of the later filter, s."""

    @property
    def generation(self) -> str:
        """In words."""
        return "of 2024" if self.position_gain else "later than 2024"

    def torque_share(self, period: float) -> float:
        """α of the driver's filter y ← y + α (τ − y), which takes a step in each of FRI's periods, s."""
        if self.torque_cutoff:
            cosine = math.cos(2.0 * math.pi * self.torque_cutoff * period)
            return cosine - 1.0 + math.sqrt(cosine**2 - 4.0 * cosine + 3.0)
        return -math.expm1(-period / self.torque_tau) if self.torque_tau else 1.0


def read_driver(description: str, has_commanded: bool) -> LbrDriver:
    """Recognise the driver by the hardware parameters in its `robot_description`.

    `has_commanded`: whether its states contain the commanded position, as with version 1 of FRI.

    Raises
    ------
    InputError
        If it is none of the known ones, or set so that torques cannot be commanded; the message names the setting.
    """
    try:
        hardware = parse_xml(description, "robot_description").iter("hardware")
    except SettingsError as error:
        raise InputError(str(error)) from error
    found = next((each for each in hardware if (each.findtext("plugin") or "").strip() == PLUGIN), None)
    if found is None:
        raise InputError(
            f"robot_description has no hardware {PLUGIN}: expected that of lbr_bringup's hardware.launch.py"
        )
    values = {each.get("name", ""): (each.text or "").strip().lower() for each in found.iter("param")}
    mode = values.get("client_command_mode", "")
    if mode != "torque":
        raise InputError(f"client_command_mode is {mode or 'missing'}; expected torque: set it in {CONFIG}")
    if _TAU in values:
        return LbrDriver(0.0, _number(values, "joint_position_tau"), 0.0, _number(values, _TAU))
    if _CUTOFF not in values:
        raise InputError(
            f"the hardware has the parameters {', '.join(sorted(values))}; expected {_CUTOFF}, as the driver of 2024, "
            f"or {_TAU}, as later ones: is it another version of lbr_fri_ros2_stack?"
        )
    if values.get("open_loop") != "false":
        raise InputError(f"open_loop is true: the driver reports what it commands; set open_loop: false in {CONFIG}")
    gain, cutoff = _number(values, "pid_p"), _number(values, _CUTOFF)
    if not gain > 0.0 or any(_number(values, name) for name in ("pid_i", "pid_d")):
        raise InputError(f"expected pid_p above 0, as 0.1, with pid_i and pid_d 0: set them in {CONFIG}")
    if not cutoff > 0.0:
        raise InputError(f"{_CUTOFF} is {cutoff:g}; expected more than 0 Hz: set it in {CONFIG}")
    if not has_commanded:
        raise InputError("the driver of 2024 with FRI 2 does not report the position it commands: use a later driver")
    return LbrDriver(gain, 0.0, cutoff, 0.0)


def _number(values: dict[str, str], name: str) -> float:
    try:
        number = float(values[name])
    except (KeyError, ValueError):
        number = math.nan
    if not 0.0 <= number < math.inf:
        raise InputError(f"{name} is {values.get(name, 'missing')}; expected a number from 0: set it in {CONFIG}")
    return number


class StiffnessCheck:
    """Finds the stiffness of KUKA's joint impedance control, which must be zero, before any command is passed on.

    The commanded position swings by `SWING` around the measured one, under torques that hold the arm softly. Where
    there is a spring between both, the measured torque swings with their difference; without one, nothing happens.

    Attributes
    ----------
    is_over
        Whether enough has been seen.
    problem
        Why torques must not be sent; empty once they may.
    """

    SWING = 0.003
    """rad; the joints swing alternately, so that even an arm that follows moves its tip by millimetres only."""
    FREQUENCY = 5.0
    """Hz."""
    SETTLING, DURATION = 0.2, 0.8
    """Time until the swing is steady, and that of the measurement, in whole swings, s."""
    LEAST = 25.0
    """Stiffness that counts, Nm/rad: several times what the noise of the torques looks like."""

    def __init__(self, arm: Arm) -> None:
        self.is_over = False
        self.problem = "the stiffness of KUKA's joint impedance control is being measured"
        self._names = arm.joint_names
        self._signs = np.where(np.arange(arm.n) % 2, -1.0, 1.0)
        self._time = 0.0
        self._first: Array | None = None
        self._sums = np.zeros((3, arm.n), complex)

    @property
    def offset(self) -> Array:
        """By how much the commanded position must differ from the measured one now (n,), rad."""
        swing = 0.0 if self.is_over else self.SWING * math.sin(2.0 * math.pi * self.FREQUENCY * self._time)
        return swing * self._signs

    def take(self, elapsed: float, commanded: Array, q: Array, torque: Array) -> None:
        """Take a state.

        Parameters
        ----------
        elapsed
            Time since the last one, s.
        commanded, q
            Commanded and measured positions (n,), rad.
        torque
            Measured torques without those that were sent (n,), N m.
        """
        self._time += elapsed
        since = self._time - self.SETTLING
        if since < 0.0 or self.is_over:
            return
        if since > self.DURATION:
            self._conclude()
            return
        values = np.array([torque, commanded - q, commanded])
        self._first = values if self._first is None else self._first
        window = elapsed * math.sin(math.pi * since / self.DURATION) ** 2
        self._sums += window * cmath.exp(-2j * math.pi * self.FREQUENCY * since) * (values - self._first)

    def _conclude(self) -> None:
        self.is_over = True
        torque, difference, commanded = self._sums
        amplitude = 4.0 / self.DURATION * np.abs(commanded)
        joint = int(np.argmin(amplitude))
        if amplitude[joint] < 0.2 * self.SWING:
            self.problem = (
                f"the commanded position of {self._names[joint]} does not follow: activate "
                "lbr_torque_command_controller, let nobody else command, and call the adapter's ~/reset"
            )
            return
        stiffness = (torque * difference.conj()).real / np.abs(difference) ** 2
        joint = int(np.argmax(stiffness))
        self.problem = ""
        if not stiffness[joint] <= self.LEAST:
            self.problem = (
                f"KUKA's joint impedance control has a stiffness of about {stiffness[joint]:.0f} Nm/rad on "
                f"{self._names[joint]}; expected 0: set new JointImpedanceControlMode(0, 0, 0, 0, 0, 0, 0) in "
                "LBRServer.java, synchronise the controller, and start LBRServer and lbr_bringup again; if somebody "
                "moved the arm meanwhile, call the adapter's ~/reset"
            )


class FriStates:
    """Turns the driver's states into joint states, and gives the position that goes with each torque.

    Joint states have the robot's own time steps, on this machine's clock. FRI has no velocities: they are filtered
    differences of positions. The driver filters its torques; as its filter is known, that is undone, exactly, so that
    the observer gets them as fresh as from any other arm. KUKA's controller watches the difference of commanded and
    measured position: the target is as far ahead of a moving arm as the commanded position lags behind the target.

    Attributes
    ----------
    idle
        Why torques do not reach the arm, and KUKA's controller brakes it; empty if they do.
    driver
        Settings of the driver; None before `describe`.
    """

    def __init__(self, arm: Arm, settings: LbrSettings, period: float, is_simulated: bool = False) -> None:
        """`period`: nominal time between states, s; `is_simulated`: whether the robot's clock is everybody's."""
        self.driver: LbrDriver | None = None
        self.idle = self._not_ready = (
            f"no state on {settings.driver}/state yet: start lbr_bringup, and LBRServer on the smartPAD"
        )
        self._undescribed = f"no {settings.driver}/robot_description yet, which tells the driver's settings"
        self._check: StiffnessCheck | None = None
        self._arm, self._settings, self._period, self._is_simulated = arm, settings, period, is_simulated
        self._sign = 1.0 if settings.torque_sign == "positive" else -1.0
        self._q: Array | None = None
        self._filtered = self._commanded = self._target = self._sent = self._v = np.zeros(arm.n)
        self._robot_ns = self._ahead_ns = 0
        """Time of the last state on the robot's clock, and how far this machine's is ahead of it."""
        self._steps = 1.0

    @property
    def problem(self) -> str:
        """Why no torque may be sent; empty when it may."""
        if not self.fits:
            return self._not_ready or self._undescribed
        if self._check is None:
            return "the stiffness of KUKA's joint impedance control has not been measured yet"
        return self._check.problem

    @property
    def delay(self) -> float:
        """Time from a velocity to the torque that answers it, s: two periods of FRI, and the filter of velocities."""
        cutoff = self._settings.velocity_cutoff
        return 2.0 * self._period + (1.0 / (2.0 * math.pi * cutoff) if cutoff else 0.0)

    @property
    def has_states(self) -> bool:
        """Whether a state has come."""
        return self._q is not None

    @property
    def fits(self) -> bool:
        """Whether torques may be sent if the stiffness is zero, which is measured when commands come."""
        return not (self._not_ready or self._undescribed)

    def expect_commands(self) -> bool:
        """Begin to measure the stiffness, unless that is done in this session; returns whether it is being measured."""
        if self._check is None and self.fits:
            self._check = StiffnessCheck(self._arm)
        return self._check is not None and not self._check.is_over

    def reset(self) -> None:
        """Let the stiffness be measured again, unless it is as expected."""
        if self._check is not None and self._check.is_over and self._check.problem:
            self._check = None

    def describe(self, description: str, has_commanded: bool) -> None:
        """Take the driver's `robot_description`; see `read_driver`."""
        before, self.driver = self.driver, None
        try:
            self.driver, self._undescribed = read_driver(description, has_commanded), ""
        except InputError as error:
            self._undescribed = str(error)
        if self.driver is None or self.driver != before:
            self._q = None

    def read(self, message: Any, now_ns: int) -> JointState | None:
        """The joint state in an LBRState, which arrived at `now_ns` of this machine's clock; None for one that repeats.

        Torques are NaN before the second state, and while the driver's settings are unknown.

        Raises
        ------
        InputError
            If positions are not finite; the observer decides about torques.
        """
        q = np.array(message.measured_joint_position, float)
        torque = self._sign * np.array(message.measured_torque, float)
        if not math.isfinite(sum(q.tolist())):
            raise InputError(
                f"{self._settings.driver}/state: measured_joint_position = {q.tolist()}; expected finite values"
            )
        robot_ns = message.time_stamp_sec * NANOSECONDS + message.time_stamp_nano_sec
        elapsed = (robot_ns - self._robot_ns) / NANOSECONDS
        if elapsed:
            follows = self._q is not None and 0.0 < elapsed <= _PAUSE_S
            steps = max(round(elapsed / message.sample_time), 1) if follows and message.sample_time > 0.0 else 1
            self._steps += _SKIP_MEMORY * (min(steps, _MOST_SKIPPED) - self._steps)
        self._not_ready = self._find_problem(message)
        if not elapsed:
            return None
        if not follows or (elapsed > _CHECK_PAUSE_S and self._check is not None and not self._check.is_over):
            self._check = None
        raw = self._unfiltered(torque, message.sample_time, steps) if follows else None
        self._v = self._velocity(q, elapsed) if follows else np.zeros(self._arm.n)
        self._commanded = self._commanded_in(message, q, elapsed, follows)
        if raw is not None and self._check is not None:
            self._check.take(elapsed, self._commanded, q, raw - self._sent)
        self._q, self._robot_ns, self._filtered = q, robot_ns, torque
        self._target = self._find_target(q)
        stamp_ns = robot_ns + self._clock_ahead(now_ns - robot_ns, elapsed)
        return JointState(stamp_ns, q, self._v, np.full(self._arm.n, np.nan) if raw is None else raw)

    def position_for(self, torque: Array) -> Array:
        """The position to command with the next torque (n,), N m: (n,), rad."""
        self._sent = torque
        return self._target

    def _unfiltered(self, torque: Array, period: float, steps: int) -> Array | None:
        """The torque that the driver's filter got (n,), N m: its mean, where steps are missing; None if unknown."""
        if self.driver is None:
            return None
        keep = (1.0 - self.driver.torque_share(period)) ** steps
        return (torque - keep * self._filtered) / (1.0 - keep)

    def _velocity(self, q: Array, elapsed: float) -> Array:
        assert self._q is not None
        share = -math.expm1(-2.0 * math.pi * self._settings.velocity_cutoff * elapsed)
        return self._v + (share or 1.0) * ((q - self._q) / elapsed - self._v)

    def _commanded_in(self, message: Any, q: Array, elapsed: float, follows: bool) -> Array:
        """The position that KUKA's controller has been commanded (n,), rad; version 2 of FRI does not report it."""
        reported = getattr(message, "commanded_joint_position", None)
        if reported is not None or self.driver is None:
            return np.array(reported if reported is not None else q, float)
        tau = self.driver.position_tau
        share = -math.expm1(-elapsed / tau) if tau and follows else 1.0
        return self._commanded + share * (self._target - self._commanded) if follows else q

    def _find_target(self, q: Array) -> Array:
        if self.driver is None:
            return q
        gain = self.driver.position_gain
        ahead = (POSITION_TAU if gain else self.driver.position_tau) * self._v
        wanted = q + ahead if self._check is None or self._check.is_over else q + self._check.offset
        # Each step of the driver of 2024 adds p (target − q) to the commanded position; later ones filter the target.
        return q + self._period / POSITION_TAU / gain * (wanted - self._commanded) if gain else wanted

    def _clock_ahead(self, now_ahead_ns: int, elapsed: float) -> int:
        """How far this machine's clock is ahead of the robot's: as little as any message has shown, but for the drift.

        So the stamps have the robot's steps, not those with which messages arrive.
        """
        if self._is_simulated:
            return 0
        if abs(now_ahead_ns - self._ahead_ns) > _CLOCK_SET_NS:
            self._ahead_ns = now_ahead_ns
        self._ahead_ns = min(self._ahead_ns + round(_DRIFT * max(elapsed, 0.0) * NANOSECONDS), now_ahead_ns)
        return self._ahead_ns

    def _find_problem(self, message: Any) -> str:
        session, quality, mode = message.session_state, message.connection_quality, message.client_command_mode
        self.idle = "" if session == len(SESSION) - 1 else f"the FRI session is {_name(SESSION, session)}"
        if self.idle:
            # LBRServer may come back with another stiffness.
            self._check = None
            return f"{self.idle}; expected {SESSION[-1]}: start LBRServer"
        if quality < _GOOD:
            return f"the FRI connection is {_name(QUALITY, quality)}; expected at least GOOD"
        if mode != COMMAND_MODE.index("TORQUE"):
            return (
                f"FRI takes {_name(COMMAND_MODE, mode)}; expected TORQUE: choose it on the smartPAD and in lbr_bringup"
            )
        if abs(message.sample_time - self._period) > _RATE_TOLERANCE * self._period:
            return (
                f"FRI sends every {1000 * message.sample_time:g} ms, but state_rate is {1 / self._period:g} Hz: start "
                "all nodes with the rate of FRI, and the controller manager with at least that update_rate"
            )
        if self._steps > _SKIPPED:
            return (
                f"states come every {1000 * self._steps * self._period:.1f} ms, FRI sends every "
                f"{1000 * self._period:g} ms: set update_rate of the controller manager to at least "
                f"{1 / self._period:g} in lbr_controllers.yaml"
            )
        return ""


def _name(names: tuple[str, ...], index: int) -> str:
    return names[index] if 0 <= index < len(names) else f"state {index}"
