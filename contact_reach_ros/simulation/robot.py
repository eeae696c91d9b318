"""The simulated robot as its driver sees it: commands in, joint states out."""

from __future__ import annotations

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.simulation.drive import Drive
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.simulation.settings import TICK, TICK_NS, WatchdogSettings, check_period
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres

_SPHERES_EVERY = 20
_MESHES_EVERY = 40
"""Steps between observations of meshes, whose messages are large."""


class SimulatedRobot:
    """Plant and drive of one scene.

    Attributes
    ----------
    plant
        The physics.
    drive
        The robot's own watchdog.
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

        Raises
        ------
        SettingsError
            If the period is not a whole number of milliseconds.
        """
        self._ticks = check_period(period)
        self.scene = scene
        self.plant = plant or Plant(scene, noise_seed=noise_seed)
        self.drive = Drive(self.plant, watchdog or WatchdogSettings())
        self.start_ns = 0
        has_mesh = any(obstacle.is_deformable for obstacle in scene.obstacles)
        self._obstacles_every = _MESHES_EVERY if has_mesh else _SPHERES_EVERY

    @property
    def now_ns(self) -> int:
        """Time of the robot's clock, ns."""
        return self.start_ns + self.plant.steps * TICK_NS

    @property
    def stop_reason(self) -> str:
        """Why the drive stopped the arm; empty if it did not."""
        return self.drive.stop_reason

    @property
    def is_open(self) -> bool:
        """Whether the arm has been handed over: the brakes are open, or were before a stop."""
        return self.drive.is_open

    def reset(self) -> None:
        """Release a stop of the drive, if there is one: the brakes open after steady commands."""
        if self.drive.stop_reason:
            self.drive.reset()

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (n,), N m; `clock_ns` is the time of the watchdogs' clock.

        Raises `InputError` if the drive refuses it.
        """
        self.drive.command(torque, clock_ns)

    def step(self, clock_ns: int) -> list[InputError]:
        """Advance by one period; returns the errors of commands that were refused on arrival: here, none is late."""
        return [error for tick in range(self._ticks) for error in self._tick(clock_ns + tick * TICK_NS)]

    def _tick(self, clock_ns: int) -> list[InputError]:
        self.drive.tick(clock_ns)
        return []

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
