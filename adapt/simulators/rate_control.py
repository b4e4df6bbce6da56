"""The low-level controller of a quadrotor: collective thrust and body rates, as a policy commands them, to a wrench."""

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
