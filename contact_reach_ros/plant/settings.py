"""Settings of the simulated robot."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.settings import Settings, setting


@dataclass(frozen=True)
class SensorSettings(Settings):
    """Noise of the joint sensors, as standard deviations, and their resolution."""

    position_noise: float = setting(1e-5, "noise of positions", unit="rad", minimum=0.0, maximum=0.01)
    position_resolution: float = setting(
        1e-5, "resolution of positions, 0 for none", unit="rad", minimum=0.0, maximum=0.01
    )
    velocity_noise: float = setting(1e-3, "noise of velocities", unit="rad/s", minimum=0.0, maximum=0.1)
    torque_noise: float = setting(0.05, "noise of measured torques", unit="Nm", minimum=0.0, maximum=5.0)


@dataclass(frozen=True)
class JointSettings(Settings):
    """Joint friction, which controller and observer do not know, and how the joints come to rest."""

    viscous_friction: float = setting(0.3, "friction per speed", unit="Nm s/rad", minimum=0.0, maximum=50.0)
    coulomb_friction: float = setting(0.2, "dry friction", unit="Nm", minimum=0.0, maximum=50.0)
    hold_damping: float = setting(30.0, "damping of the damped hold", unit="Nm s/rad", minimum=1.0, maximum=500.0)
    brake_torque: float = setting(150.0, "what a closed brake holds", unit="Nm", minimum=1.0, maximum=1000.0)
