"""The simulated robot as its driver sees it: commands in, joint states out, with faults in between."""

from __future__ import annotations

from collections.abc import Sequence

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.simulation.drive import Drive
from contact_reach_ros.simulation.faults import Fault, Faults, UnknownObstacle
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.simulation.settings import TICK, TICK_NS, JointSettings, WatchdogSettings, check_period
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres

_SPHERES_EVERY = 20
_MESHES_EVERY = 40
"""Steps between observations of meshes, whose messages are large."""


class SimulatedRobot:
    """Plant, drive and faults of one scene.

    Attributes
    ----------
    plant
        The physics.
    drive
        The robot's own watchdog.
    faults
        Faults that are injected; None without any, so that they cost nothing.
    start_ns
        Stamp of the state before the first step, ns.
    """

    def __init__(
        self,
        scene: Scene,
        joints: JointSettings | None = None,
        watchdog: WatchdogSettings | None = None,
        faults: Sequence[Fault] = (),
        noise_seed: int | None = None,
        period: float = TICK,
    ) -> None:
        """Build the robot at the scene's start.

        Parameters
        ----------
        scene
            Scene, with its mismatch.
        joints, watchdog
            Settings; None for the defaults.
        faults
            What goes wrong from `start_faults` on.
        noise_seed
            Seed of sensor noise and faults; None for the scene's.
        period
            Time between joint states, s; the physics still advances at 1 kHz.

        Raises
        ------
        SettingsError
            If the period is not a whole number of milliseconds, or the arm cannot have these faults.
        """
        self._ticks = check_period(period)
        self.scene = scene
        self.plant = Plant(
            scene,
            joints or JointSettings(),
            noise_seed,
            next(((each.radius, each.stiffness) for each in faults if isinstance(each, UnknownObstacle)), None),
        )
        self.drive = Drive(self.plant, watchdog or WatchdogSettings())
        self.start_ns = 0
        has_mesh = any(obstacle.is_deformable for obstacle in scene.obstacles)
        self._obstacles_every = _MESHES_EVERY if has_mesh else _SPHERES_EVERY
        seed = scene.seed if noise_seed is None else noise_seed
        self.faults = Faults(faults, seed, self.plant) if faults else None

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

    def start_faults(self) -> None:
        """Count the times of the faults from now on."""
        if self.faults is not None:
            self.faults.start(self.now_ns)

    def command(self, torque: Array, clock_ns: int) -> None:
        """Take a command (n,), N m; `clock_ns` is the time of the watchdogs' clock.

        Raises
        ------
        InputError
            If the drive refuses it. With faults, commands travel first, and `step` returns refusals.
        """
        if self.faults is not None:
            self.faults.send_command(torque, self.now_ns)
        else:
            self.drive.command(torque, clock_ns)

    def step(self, clock_ns: int) -> list[InputError]:
        """Advance by one period; returns the errors of commands that reached the drive and were refused."""
        refused = []
        for tick in range(self._ticks):
            refused += self._tick(clock_ns + tick * TICK_NS)
        return refused

    def _tick(self, clock_ns: int) -> list[InputError]:
        refused = []
        if self.faults is not None:
            for torque in self.faults.commands(self.now_ns):
                try:
                    self.drive.command(torque, clock_ns)
                except InputError as error:
                    refused.append(error)
            self.faults.act(self.now_ns)
        self.drive.tick(clock_ns)
        return refused

    def read(self) -> list[JointState]:
        """The joint states that arrive now; without faults, the present one. Each call draws new sensor noise."""
        state = self.plant.read()._replace(stamp_ns=self.now_ns)
        return [state] if self.faults is None else self.faults.joint_states(state)

    def shows_obstacles(self) -> bool:
        """Whether the obstacles are published now, also where there are none: every few steps, unless they get lost."""
        if self.plant.steps % self._obstacles_every:
            return False
        return self.faults is None or not self.faults.lose_obstacles(self.now_ns)

    def obstacles(self) -> Spheres | None:
        """The obstacles when an observation of them is due; None in between."""
        if not self.shows_obstacles():
            return None
        return obstacle_spheres(self.scene, self.plant.obstacle_positions())

    def contact_forces(self) -> Array:
        """Contact force on each of the arm's contact links, N."""
        return self.plant.contact_forces()
