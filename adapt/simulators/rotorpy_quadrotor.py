"""The AscTec Hummingbird in RotorPy (Folk, Paulos and Kumar 2023): rotor drag, parasitic drag, motor lag and wind.

Our rate controller runs at its own rate above RotorPy's motor mixing. It is configured with the mass and inertia that
RotorPy publishes, so that these cancel; what is left to learn is the air and the motors.
"""

import numpy as np
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

from adapt.simulators.rate_control import RateControl

SUBSTEPS = 10  # of the rate controller in a control period
GRAVITY = 9.81  # [m/s^2] RotorPy's own


class RotorpyQuadrotor:
    """Plant of a `Quadrotor`; the speeds of the rotors are beyond its state.

    Args:
        system: `Quadrotor` with gains and limits.
        wind: steady wind [m/s] in world axes.
        parameters: of the airframe, as RotorPy's vehicles have them.
    """

    def __init__(self, system, wind=(1.0, 0.5, 0.0), parameters=quad_params):
        self.dt, self.wind = system.dt, np.array(wind)
        self.vehicle = Multirotor(parameters, control_abstraction="cmd_ctbm")
        self.control = RateControl(system, self.vehicle.mass, self.vehicle.inertia)
        self.hover = np.full(4, np.sqrt(self.vehicle.mass * GRAVITY / 4 / self.vehicle.k_eta))

    def reset(self, state):
        """Begin at a state with the rotors at hover."""
        attitude = np.roll(state[3:7], -1)  # RotorPy has the scalar last
        self.now = {"x": state[:3], "v": state[7:10], "q": attitude, "w": state[10:13]}
        self.now |= {"wind": self.wind, "rotor_speeds": self.hover.copy()}
        return self._state()

    def step(self, state, action):
        """One control period from where it is."""
        for _ in range(SUBSTEPS):
            torque = self.control.torque(self.now["w"], action)
            command = {"cmd_thrust": self.control.force(action), "cmd_moment": torque}
            self.now = self.vehicle.step(self.now, command, self.dt / SUBSTEPS)
        return self._state()

    def _state(self):
        now = self.now
        return np.concatenate((now["x"], np.roll(now["q"], 1), now["v"], now["w"]))


def make(system):
    """The plant of `--plant rotorpy`."""
    return RotorpyQuadrotor(system)
