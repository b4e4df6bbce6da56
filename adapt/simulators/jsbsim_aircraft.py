"""The Piper J-3 Cub that ships with JSBSim (Berndt 2004), flown as the small aircraft that it is a scaled copy of.

Two aircraft move alike where lengths go with a scale L, times with its root, masses with its cube (Froude's similarity;
Wolowicz et al. 1979, "Similitude requirements and scaling relationships", NASA TP-1435). The scale is chosen so that
the mass agrees; the Cub, 35 ft wide, then has the span and the speed of the small aircraft to within a tenth. Elevator,
aileron and rudder are geared so that full deflection gives the same moment coefficient. Its lift, drag and stability,
engine and propeller are left to learn.
"""

import math

import jsbsim
import numpy as np

from adapt.simulators.attitude import angles, quaternion

FOOT, SLUG = 0.3048, 14.59390  # [m], [kg]
SUBSTEPS = 16  # of JSBSim in a control period
ALTITUDE = 500.0  # [ft]
# Moment coefficients of the model at full deflection, as the file of the aircraft gives them.
FULL = {"elevator": -1.2004 * 0.14, "aileron": 0.3498 * 0.31, "rudder": -0.0565 * 0.52}
VELOCITIES, RATES = ("u-fps", "v-fps", "w-fps"), ("p-rad_sec", "q-rad_sec", "r-rad_sec")


class JsbsimAircraft:
    """Plant of a `FixedWing`; the propeller's speed and the lag of the air are beyond its state."""

    def __init__(self, system, aircraft="J3Cub"):
        jsbsim.FGJSBBase().debug_lvl = 0
        self.dt, self.fdm = system.dt, jsbsim.FGFDMExec(None)
        self.fdm.load_model(aircraft)
        self._begin(np.array((0.0, 0, 0, 1, 0, 0, 0, 10, 0, 0, 0, 0, 0)), scale=1.0)
        self.scale = (self.fdm["inertia/mass-slugs"] * SLUG / system.mass) ** (1 / 3)
        self.root = math.sqrt(self.scale)
        self.fdm.set_dt(system.dt * self.root / SUBSTEPS)
        wanted = {
            "elevator": system.pitch[3] * system.elevator_limit,
            "aileron": system.roll[3] * system.aileron_limit,
            "rudder": system.yaw[4] * system.rudder_limit,
        }
        self.gears = {name: wanted[name] / FULL[name] for name in FULL}

    def _begin(self, state, scale):
        roll, pitch, yaw = angles(*state[3:7])
        values = {"h-sl-ft": ALTITUDE, "lat-gc-deg": 0.0, "long-gc-deg": 0.0, "terrain-elevation-ft": -1000.0}
        values |= {"phi-rad": roll, "theta-rad": pitch, "psi-true-rad": yaw}
        values |= dict(zip(VELOCITIES, state[7:10] * math.sqrt(scale) / FOOT, strict=True))
        values |= dict(zip(RATES, state[10:13] / math.sqrt(scale), strict=True))
        for name, value in values.items():
            self.fdm[f"ic/{name}"] = value
        self.fdm["fcs/throttle-cmd-norm"], self.fdm["fcs/mixture-cmd-norm"] = 0.5, 1.0
        for name in FULL:  # the surfaces of the flight before
            self.fdm[f"fcs/{name}-cmd-norm"] = 0.0
        self.fdm.run_ic()
        self.fdm["propulsion/set-running"] = -1

    def reset(self, state):
        """Begin at a state with the engine running at half throttle."""
        self._begin(state, self.scale)
        self.start = state[:3] - self._place()
        return self._state()

    def step(self, state, action):
        """One control period from where it is."""
        self.fdm["fcs/throttle-cmd-norm"] = (1 + action[0]) / 2
        for name, value in zip(FULL, action[1:], strict=True):
            self.fdm[f"fcs/{name}-cmd-norm"] = self.gears[name] * value
        for _ in range(SUBSTEPS):
            self.fdm.run()
        return self._state()

    def _place(self):
        north, east, up = (self.fdm[f"position/from-start-neu-{axis}-ft"] for axis in "neu")
        return np.array((north, east, -up)) * FOOT / self.scale

    def _state(self):
        attitude = quaternion(*(self.fdm[f"attitude/{angle}-rad"] for angle in ("phi", "theta", "psi")))
        velocity = np.array([self.fdm[f"velocities/{name}"] for name in VELOCITIES]) * FOOT / self.root
        rates = np.array([self.fdm[f"velocities/{name}"] for name in RATES]) * self.root
        return np.concatenate((self.start + self._place(), attitude, velocity, rates))


def make(system):
    """The plant of `--plant jsbsim`."""
    return JsbsimAircraft(system)
