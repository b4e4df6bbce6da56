"""The low-level controller of a quadrotor: from collective thrust and body rates, as commanded, to the rotors."""

import numpy as np


class RateControl:
    """Force and torque for an action, as `envs.quadrotor.Quadrotor` says, for the airframe that it is configured with.

    Args:
        system: `Quadrotor` with gains and limits.
        mass: [kg] of the airframe.
        inertia: (3,) or (3, 3) [kg m^2] of the airframe.
    """

    def __init__(self, system, mass, inertia):
        self.mass, self.inertia = mass, np.diag(inertia) if np.ndim(inertia) == 1 else np.asarray(inertia)
        self.gains = np.array([getattr(system, f"rate_gain_{axis}") for axis in "xyz"])
        self.limits = np.array([getattr(system, f"rate_limit_{axis}") for axis in "xyz"])
        self.lowest, self.highest = system.thrust_min, system.thrust_max

    def force(self, action):
        """Collective thrust [N] of an action (4,)."""
        return self.mass * (self.lowest + (self.highest - self.lowest) * (1 + action[0]) / 2)

    def torque(self, rates, action):
        """Torque (3,) [N m] at body rates (3,): J K (w_des - w) + w x J w."""
        wanted = self.gains * (self.limits * action[1:] - rates)
        return self.inertia @ wanted + np.cross(rates, self.inertia @ rates)


def lead(wanted, speeds, law, lag):
    """The command that brings slow rotors to the wanted speeds with a lag [s] of one's choice; inverts their law.

    They follow a command c by a (c - s) + b (c^2 - s^2), with other a and b upwards than downwards; this is set to
    (wanted - s) / lag and solved for c. What a motor can't take is left to the caller to cut off.

    Args:
        wanted: (r,) speeds of the rotors that are sought.
        speeds: (r,) that they have, in the same unit as the command.
        law: (4,) a and b upwards, a and b downwards, in 1/s and 1/s over the unit of a speed.
    """
    change = (wanted - speeds) / lag
    a, b = np.where(change > 0, law[:2, None], law[2:, None])
    sought = np.maximum(a * speeds + b * speeds**2 + change, 1e-6)  # no command is below a stand-still
    return 2 * sought / (a + np.sqrt(a**2 + 4 * b * sought))
