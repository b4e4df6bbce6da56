"""A Crazyflie of drone-models (Learning Systems and Robotics Lab, TU Munich), fitted on real flights.

Its rigid body has measured thrust and torque curves, a drag fitted on real flights, and rotors that take 0.1 s to
follow. Our rate controller runs at 500 Hz, as a firmware does, and leads the rotors: by their published law they get
the command that brings them to the wanted speed with a lag of `LAG`, as far as a motor can. What is left to learn is
the drag, what is left of the lag, and motors at their limits.

The attitude is integrated here: drone-models 0.1 takes a quaternion with the scalar last and gives the rate of one with
the scalar first; it says itself that only the angular velocity is to be used.
"""

import os

import numpy as np

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # drone-models refuses to be imported without it where scipy already is

from drone_models.core import load_params, parametrize
from drone_models.first_principles import dynamics

from adapt.simulators.rate_control import RateControl, lead
from envs.rigid_body import quaternion_rates

SUBSTEPS = 50  # of the rate controller, and of the integration, in a control period
LAG = 0.02  # [s] lag that is left of the rotors


class DroneModelsCrazyflie:
    """Plant of a `Quadrotor`; `drone` is an airframe of drone-models. The rotors' speeds are beyond its state."""

    def __init__(self, system, drone="cf2x_L250"):
        self.dt, published = system.dt, load_params("first_principles", drone)
        self.rates = parametrize(dynamics, drone)
        self.control = RateControl(system, published["mass"], published["J"])
        self.law, self.thrust = published["rotor_dyn_coef"], published["rpm2thrust"]
        self.limits = np.array((published["thrust_min"], published["thrust_max"]))
        arms = published["L"] * published["mixing_matrix"][:2]
        yaw = published["thrust2torque"] * published["mixing_matrix"][2:]
        self.mixing = np.linalg.inv(np.vstack((np.ones(4), arms, yaw)))
        self.range = self._speeds(self.limits)
        self.hover = self._speeds(np.full(4, -published["mass"] * published["gravity_vec"][2] / 4))

    def _speeds(self, forces):
        """Rotor speeds [rpm] for the forces (4,) [N] of the rotors: the root of the published quadratic."""
        constant, linear, square = self.thrust
        forces = np.clip(forces, *self.limits)
        return (np.sqrt(linear**2 - 4 * square * (constant - forces)) - linear) / (2 * square)

    def reset(self, state):
        """Begin at a state with the rotors at hover."""
        self.now = [state[:3], state[3:7], state[7:10], state[10:13], self.hover]
        return self._state()

    def step(self, state, action):
        """One control period from where it is, by explicit Euler as the simulator of drone-models does."""
        for _ in range(SUBSTEPS):
            position, attitude, velocity, rates, rotors = self.now
            wrench = (self.control.force(action), *self.control.torque(rates, action))
            command = lead(self._speeds(self.mixing @ wrench), rotors, self.law, LAG).clip(*self.range)
            changes = list(self.rates(position, np.roll(attitude, -1), velocity, rates, command, rotors))
            changes[1] = np.array(quaternion_rates(attitude, rates))
            self.now = [a + self.dt / SUBSTEPS * b for a, b in zip(self.now, changes, strict=True)]
            self.now[1] = self.now[1] / np.linalg.norm(self.now[1])
        return self._state()

    def _state(self):
        return np.concatenate(self.now[:4])


def make(system):
    """The plant of `--plant drone-models`."""
    return DroneModelsCrazyflie(system)
