"""KUKA's controller with LBRServer, and the driver lbr_fri_ros2_stack on it, over the simulated arm; without ROS.

Both generations of the driver, as its sources have them: `lbr_fri_ros2/src/filters.cpp`, `interfaces/state.cpp`,
`interfaces/torque_command.cpp` and `async_client.cpp`. What KUKA's controller does with an overlay is the torque of its
spring, K (commanded − measured), on top of that which carries the arm.
"""

import math
from types import SimpleNamespace

import numpy as np

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.drives.command_guard import CommandGuard, Phase
from contact_reach_ros.drives.fri import PLUGIN, FriStates
from contact_reach_ros.drives.settings import LBR, AdapterSettings, LbrSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.timing import NANOSECONDS

OF_2024, LATER = "2024", "later"
CONFIGS = {
    OF_2024: {
        "client_command_mode": "torque",
        "pid_p": 0.1,
        "pid_i": 0.0,
        "pid_d": 0.0,
        "measured_torque_cutoff_frequency": 10,
        "open_loop": "false",
    },
    LATER: {
        "client_command_mode": "torque",
        "joint_position_tau": 0.04,
        "measured_torque_tau": 0.1,
        "open_loop": "true",
    },
}
"""Hardware parameters of lbr_system_config.yaml by generation, in torque mode as our page wants it."""
FARTHEST = 0.05
"""Difference of commanded and measured position at which KUKA's controller ends the session, rad."""
SESSION_AFTER = 0.2
"""When commands are taken, s."""


def described(config):
    """A robot_description with hardware parameters."""
    params = "".join(f'<param name="{name}">{value}</param>' for name, value in config.items())
    hardware = f"<hardware><plugin>{PLUGIN}</plugin>{params}</hardware>"
    return (
        f'<robot name="lbr"><ros2_control name="lbr_system_interface" type="system">{hardware}</ros2_control></robot>'
    )


class CarriedPlant(Plant):
    """The simulated arm of a drive that carries it by its own model: commands are on top of that."""

    def __init__(self, scene, **options):
        super().__init__(scene, **options)
        self.own_model = RobotModel(self.arm)

    def step(self, command=None):
        super().step(None if command is None else command + self.own_model.gravity_at(self.joint_positions))


class KukaRobot(SimulatedRobot):
    """The arm behind the driver, as `lbr/state` and `lbr/command/torque` show it.

    Attributes
    ----------
    ended
        Why the session has ended; empty while it lasts.
    """

    def __init__(self, scene, period, generation=LATER, stiffness=0.0, fri=1, noise_seed=None, **config):
        """`stiffness` in Nm/rad; `config`: hardware parameters that differ from those that the driver ships."""
        plant = CarriedPlant(scene, noise_seed=noise_seed)
        super().__init__(scene, WatchdogSettings(enabled=False), period=period, plant=plant, open_after=0.0)
        self.period, self.generation, self.stiffness, self.fri = period, generation, stiffness, fri
        self.config = CONFIGS[generation] | config
        self.ended = ""
        self._position = self._torque = np.full(self.plant.arm.n, np.nan)
        """The driver's command_target_."""
        self._sent = np.zeros(self.plant.arm.n)
        self._measured_torque = self._external = np.zeros(self.plant.arm.n)
        self._seen = self.plant.read()
        self._reported = self._commanded = self._seen.q
        self._message = None
        self.exchange()

    @property
    def description(self):
        """The driver's robot_description, as far as it is about ros2_control."""
        return described(self.config)

    def aim(self, position):
        """Take the position of a command."""
        self._position = np.array(position)

    def command(self, torque, clock_ns):
        """Take the torque of a command."""
        self._torque = np.array(torque)

    def end(self, why):
        """End the session: KUKA's controller closes the brakes."""
        self.ended = self.ended or why
        self.stop(self.ended)

    def step(self, clock_ns):
        super().step(clock_ns)
        self.exchange()

    def _tick(self, clock_ns):
        spring = self.stiffness * (self._commanded - self.plant.joint_positions)
        super().command(self._sent + spring, clock_ns)
        super()._tick(clock_ns)

    def read(self):
        return [self._seen]

    def message(self):
        """The fields of LBRState at the last cycle."""
        return self._message

    @property
    def session(self):
        if self.ended:
            return 1
        return 4 if self.plant.time > SESSION_AFTER else 3

    def exchange(self):
        """One exchange of FRI: a state comes, and the command for it goes."""
        self._seen = state = super().read()[0]
        carried = self.plant.own_model.gravity_at(state.q)
        # Before the first step the simulated sensors show nothing.
        torque = np.where(np.isnan(state.torque), carried, state.torque)
        self._measured_torque = self._filtered(self._measured_torque, torque)
        external = self.plant.data.qfrc_constraint[: self.plant.arm.n]
        self._external = self._filtered(self._external, external)
        stamp = {"time_stamp_sec": state.stamp_ns // NANOSECONDS, "time_stamp_nano_sec": state.stamp_ns % NANOSECONDS}
        open_loop = self.config["open_loop"] == "true" and self.generation == OF_2024
        self._reported = self._commanded if open_loop and self.session == 4 else state.q
        self._message = {
            "sample_time": self.period,
            "session_state": self.session,
            "connection_quality": 3,
            "client_command_mode": 3,
            "control_mode": 2,
            **stamp,
            "measured_joint_position": self._reported,
            "measured_torque": self._measured_torque,
            "external_torque": self._external,
        }
        if self.fri == 1:
            self._message["commanded_joint_position"] = self._commanded
        self._follow()

    def _follow(self):
        unset = np.isnan(self._position).any() or np.isnan(self._torque).any()
        if self.session != 4:
            self._commanded, self._sent = self._reported, np.zeros_like(self._sent)
        elif self.generation == OF_2024:
            if unset:
                self._commanded, self._sent = self._reported, np.zeros_like(self._sent)
            else:
                gain = float(self.config["pid_p"])
                self._commanded = self._commanded + gain * (self._position - self._reported)
                self._sent = self._torque
        elif not unset:
            tau = float(self.config["joint_position_tau"])
            share = 1.0 - math.exp(-self.period / tau)
            self._commanded = self._commanded + share * (self._position - self._commanded)
            self._sent = self._torque
        far = np.abs(self._commanded - self.plant.joint_positions).max()
        if far > FARTHEST:
            self.end(f"the commanded position is {far:.3f} rad from the measured one")

    def _filtered(self, before, value):
        if self.generation == OF_2024:
            cosine = math.cos(2.0 * math.pi * float(self.config["measured_torque_cutoff_frequency"]) * self.period)
            share = cosine - 1.0 + math.sqrt(cosine**2 - 4.0 * cosine + 3.0)
        else:
            share = 1.0 - math.exp(-self.period / float(self.config["measured_torque_tau"]))
        return before + share * (value - before)


def as_message(robot):
    """The last LBRState, without its package."""
    return SimpleNamespace(**robot.message())


class Guarded:
    """What robots for `Stack` behind the adapter's guard have in common."""

    stop_reason = ""
    faults = ()
    """Commands may be refused."""

    def obstacles(self):
        return self.robot.obstacles()

    def contact_forces(self):
        return self.robot.contact_forces()

    def reset(self):
        pass


class Adapted(Guarded):
    """A robot for `Stack`: KUKA's arm behind the adapter, whose parts are the real ones.

    Attributes
    ----------
    moved
        Farthest that the tip has been from where it was at the start, m.
    problem
        Why the last command was not passed on; empty if it was.
    """

    def __init__(self, robot, settings=None):
        self.robot, arm, period = robot, robot.plant.arm, robot.period
        self.states = FriStates(arm, settings or LbrSettings(), period, is_simulated=True)
        self.states.describe(robot.description, robot.fri == 1)
        hold = ContactBudget().resolve(arm).handover_thresholds
        self.guard = CommandGuard(arm, AdapterSettings(kind=LBR, gravity_compensation=False), period, hold)
        self.problem, self.moved = "", 0.0
        self._start = robot.plant.tip_position
        # A stamp of zero is no time.
        robot.step(0)

    def command(self, torque, clock_ns):
        self.problem = self.states.problem
        if self.problem:
            if self.states.expect_commands():
                self.guard.hold()
            raise InputError(self.problem)
        self._send(self.guard.command(torque, clock_ns), clock_ns)

    def step(self, clock_ns):
        if self.states.problem and self.guard.phase is Phase.PASSING:
            self.guard.stop(self.states.problem)
        self._send(self.guard.watch(clock_ns), clock_ns)
        self.robot.step(clock_ns)
        self.moved = max(self.moved, float(np.linalg.norm(self.robot.plant.tip_position - self._start)))

    def read(self):
        state = self.states.read(as_message(self.robot), 0)
        if state is not None:
            self.guard.see(state, self.robot.now_ns)
        return [] if state is None else [state]

    def _send(self, torque, clock_ns):
        if torque is not None:
            self.robot.aim(self.states.position_for(torque))
            self.robot.command(torque, clock_ns)
