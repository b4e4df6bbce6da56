"""A cart-pole in MuJoCo (Todorov et al. 2012), with Coulomb and viscous friction that the model doesn't know of.

Masses, lengths, gravity and the force limit are those of the system. MuJoCo solves friction as a constraint and takes
50 steps in a control period.
"""

import mujoco
import numpy as np

SUBSTEPS = 50  # in a control period
MODEL = """
<mujoco>
  <option gravity="0 0 {gravity:.9g}" timestep="{timestep:.9g}" integrator="RK4"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" frictionloss="{friction:.9g}" damping="{damping:.9g}"/>
      <inertial pos="0 0 0" mass="{cart_mass:.9g}" diaginertia="1 1 1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="{hinge:.9g}"/>
        <inertial pos="0 0 {half:.9g}" mass="{pole_mass:.9g}" diaginertia="{inertia:.9g} {inertia:.9g} {thin:.9g}"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="rail" gear="{force:.9g}" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class MujocoCartPole:
    """Plant of a `CartPole`; its state is all that MuJoCo knows, so it can be set to one at every step.

    Args:
        system: `CartPole` with the parameters to take over.
        friction: Coulomb friction of the rail [N], 5 % of the weight by default.
        damping: viscous friction of the rail [N s/m]; this and the next: Quanser's linear servo base unit (IP02).
        hinge: viscous friction of the hinge [N m s].
    """

    settable = True

    def __init__(self, system, friction=0.5, damping=5.4, hinge=0.0024):
        self.dt = system.dt
        inertia = system.pole_mass * (2 * system.pole_half_length) ** 2 / 12  # a uniform rod
        self.model = mujoco.MjModel.from_xml_string(
            MODEL.format(
                **{"gravity": -system.gravity, "timestep": system.dt / SUBSTEPS, "force": system.force_limit},
                **{"cart_mass": system.cart_mass, "pole_mass": system.pole_mass, "half": system.pole_half_length},
                **{"friction": friction, "damping": damping, "hinge": hinge},
                **{"inertia": inertia, "thin": 0.01 * inertia},
            )
        )
        self.data = mujoco.MjData(self.model)

    def reset(self, state):
        """Begin at a state (x, v, theta, omega)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = (state[0], state[2]), (state[1], state[3])
        return self._state()

    def step(self, state, action):
        """One control period from a state, or from where it is."""
        if state is not None:
            self.reset(state)
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, SUBSTEPS)
        return self._state()

    def _state(self):
        (x, theta), (v, omega) = self.data.qpos, self.data.qvel
        return np.array((x, v, theta, omega))


def make(system):
    """The plant of `--plant mujoco`."""
    return MujocoCartPole(system)
