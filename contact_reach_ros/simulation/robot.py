"""The simulated robot as its driver sees it: commands in, joint states out, and a watchdog between them and the arm."""

from __future__ import annotations

import math

from contact_reach_ros.arm import Array, JointState, checked_torque
from contact_reach_ros.errors import StopCode, StopReason
from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.simulation.settings import TICK, TICK_NS, WatchdogSettings, check_period
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres

HOLD_AFTER = 0.02
"""Time without a command after which the damped hold begins, s."""
STOP_AFTER = 0.1
"""Time without a command after which the brakes close and stay closed, s."""
OPEN_AFTER = 0.5
"""Time of steady commands after which the brakes open, s: a controller that is starting up pauses now and then."""
_SPHERES_EVERY = 20
_MESHES_EVERY = 40
"""Steps between observations of meshes, whose messages are large."""


class SimulatedRobot:
    """The arm of one scene behind its drive, which watches commands and speeds.

    The brakes are closed until commands have arrived for `open_after` seconds without a gap of `HOLD_AFTER`, so that a
    controller that is still starting up does not get the arm. From then on, `HOLD_AFTER` seconds without a command
    trigger the damped hold, and `STOP_AFTER` seconds a stop that is latched until `reset`. A joint that is too fast by
    the drive's own sensors triggers a stop too, even if the joint states that it sends are faulty.

    With `enabled: false` it does not watch for silence, and holds the last torque for ever.

    Attributes
    ----------
    plant
        The physics.
    stop_reason
        Why the drive stopped the arm; empty while it does not.
    is_open
        Whether the arm has been handed over: the brakes are open, or were before a stop.
    start_ns
        Stamp of the state before the first step, ns.
    """

    def __init__(
        self,
        scene: Scene,
        watchdog: WatchdogSettings | None = None,
        noise_seed: int | None = None,
        period: float = TICK,
        plant: Plant | None = None,
        open_after: float = OPEN_AFTER,
    ) -> None:
        """Build the robot at the scene's start.

        Parameters
        ----------
        scene
            Scene, with its mismatch.
        watchdog
            Settings; None for the defaults.
        noise_seed
            Seed of sensor noise; None for the scene's.
        period
            Time between joint states, s; the physics still advances at 1 kHz.
        plant
            The physics of the scene; None for `Plant`.
        open_after
            Time of steady commands after which the brakes open, s.

        Raises
        ------
        SettingsError
            If the period is not a whole number of milliseconds.
        """
        self._ticks = check_period(period)
        self.scene = scene
        self.plant = plant or Plant(scene, noise_seed=noise_seed)
        self.stop_reason = ""
        self.is_open = False
        self.start_ns = 0
        settings, arm = watchdog or WatchdogSettings(), self.plant.arm
        self._open_ns = int(open_after * NANOSECONDS)
        self._hold_ns = int(HOLD_AFTER * NANOSECONDS)
        self._stop_ns = int(STOP_AFTER * NANOSECONDS)
        self._watches_silence = settings.enabled
        self._speed_limits = [(settings.speed_share or math.inf) * limit for limit in arm.velocity_limits.tolist()]
        self._command: Array | None = None
        self._command_ns = self._steady_since_ns = 0
        has_mesh = any(obstacle.is_deformable for obstacle in scene.obstacles)
        self._obstacles_every = _MESHES_EVERY if has_mesh else _SPHERES_EVERY

    @property
    def now_ns(self) -> int:
        """Time of the robot's clock, ns."""
        return self.start_ns + self.plant.steps * TICK_NS

    def stop(self, reason: str) -> None:
        """Close the brakes until `reset`; the first reason is kept."""
        self.stop_reason = self.stop_reason or reason

    def reset(self) -> None:
        """Release a stop, if there is one."""
        if self.stop_reason:
            self.restart()

    def restart(self) -> None:
        """Close the brakes, without a stop: they open again after steady commands."""
        self.stop_reason, self._command, self.is_open = "", None, False

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (n,), N m, that arrived at `clock_ns`, the time of the watchdogs' clock.

        Raises `InputError` if it has the wrong size or is not finite; the last one stays in force.
        """
        checked_torque(torque, self.plant.arm.n)
        if self._command is None or clock_ns - self._command_ns > self._hold_ns:
            self._steady_since_ns = clock_ns
        self._command = torque
        self._command_ns = clock_ns

    def step(self, clock_ns: int) -> None:
        """Advance by one period."""
        for tick in range(self._ticks):
            self._tick(clock_ns + tick * TICK_NS)

    def _tick(self, clock_ns: int) -> None:
        """Advance the plant by one tick under the present command."""
        self.plant.set_actuation(self._actuation(clock_ns))
        self.plant.step(self._command)

    def _actuation(self, clock_ns: int) -> Actuation:
        """What moves the joints now; stops where the commands are silent, or a joint is too fast."""
        silence = clock_ns - self._command_ns
        if self._command is not None and silence <= self._hold_ns:
            self.is_open = self.is_open or clock_ns - self._steady_since_ns >= self._open_ns
        if self.is_open and not self.stop_reason:
            self._watch_speed()
        if self.stop_reason or not self.is_open:
            return Actuation.BRAKED
        if not self._watches_silence or silence <= self._hold_ns:
            return Actuation.COMMANDED
        if silence <= self._stop_ns:
            return Actuation.DAMPED_HOLD
        self.stop(StopReason(StopCode.NO_COMMAND, f"no command for {silence / NANOSECONDS * 1000:.0f} ms"))
        return Actuation.BRAKED

    def _watch_speed(self) -> None:
        names, speeds = self.plant.arm.joint_names, self.plant.data.qvel.tolist()
        for name, speed, limit in zip(names, speeds, self._speed_limits, strict=False):
            if not -limit <= speed <= limit:
                text = f"{name} moves with {abs(speed):.2f} rad/s, permitted {limit:.2f} rad/s"
                self.stop(StopReason(StopCode.SPEED_LIMIT, text))

    def read(self) -> list[JointState]:
        """The present joint state. Each call draws new sensor noise."""
        return [self.plant.read()._replace(stamp_ns=self.now_ns)]

    def shows_obstacles(self) -> bool:
        """Whether the obstacles are published now, also where there are none: every few steps."""
        return self.plant.steps % self._obstacles_every == 0

    def obstacles(self) -> Spheres | None:
        """The obstacles when an observation of them is due; None in between."""
        if not self.shows_obstacles():
            return None
        return obstacle_spheres(self.scene, self.plant.obstacle_positions())

    def contact_forces(self) -> Array:
        """Contact force on each of the arm's contact links, N."""
        return self.plant.contact_forces()
