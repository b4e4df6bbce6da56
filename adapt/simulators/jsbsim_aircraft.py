"""The Piper J-3 Cub that ships with JSBSim (Berndt 2004), flown as a small aircraft that moves like it.

Lengths are divided by a scale that makes the masses agree, times by its root (Froude's similarity, see the vehicle
`j3cub`). Left to learn are the wind, the curves of the tables, and the propeller's thrust over speed, wash and torque.
"""

import jsbsim
import numpy as np

from adapt.simulators.attitude import angles, quaternion

FOOT, SLUG = 0.3048, 14.59390  # [m], [kg]
SUBSTEPS = 16  # of JSBSim in a control period
# Deflection [rad] at a command of 1, negative where the moment that it gives is.
SURFACES = {"elevator": -0.14, "aileron": 0.31, "rudder": -0.52}
SITE = {"h-sl-ft": 500.0, "lat-gc-deg": 0.0, "long-gc-deg": 0.0, "terrain-elevation-ft": -1000.0}
ANGLES = ("phi-rad", "theta-rad", "psi-true-rad")
VELOCITIES, RATES = ("u-fps", "v-fps", "w-fps"), ("p-rad_sec", "q-rad_sec", "r-rad_sec")


class JsbsimAircraft:
    """Plant of a `FixedWing` in a steady wind [m/s, where it blows to]; the propeller's speed is beyond its state."""

    def __init__(self, system, wind=(1.0, 0.5, 0.0)):
        jsbsim.FGJSBBase().debug_lvl = 0
        self.dt, self.wind, self.gears, self.fdm = system.dt, np.array(wind), {}, jsbsim.FGFDMExec(None)
        self.fdm.load_model("J3Cub")
        self.fdm.run_ic()  # weighs it
        self.scale = (self.fdm["inertia/mass-slugs"] * SLUG / system.mass) ** (1 / 3)
        self.root = self.scale**0.5
        self.fdm.set_dt(system.dt * self.root / SUBSTEPS)
        moments = (system.pitch[3], system.roll[3], system.yaw[4])
        for (name, full), moment in zip(SURFACES.items(), moments, strict=True):
            self.gears[name] = np.copysign(getattr(system, f"{name}_limit"), moment) / full

    def reset(self, state):
        """Begin at a state, the engine running steadily at half throttle."""
        values = *angles(*state[3:7]), *(state[7:10] * self.root / FOOT), *(state[10:13] / self.root)
        for name, value in (SITE | dict(zip(ANGLES + VELOCITIES + RATES, values, strict=True))).items():
            self.fdm[f"ic/{name}"] = value
        self._command((0.0, 0.0, 0.0, 0.0))
        self.fdm.run_ic()
        for axis, value in zip(("north", "east", "down"), self.wind * self.root / FOOT, strict=True):
            self.fdm[f"atmosphere/wind-{axis}-fps"] = value
        self.fdm["propulsion/set-running"] = -1
        self.fdm.suspend_integration()
        self.fdm.run()  # tells the engine of the throttle
        self.fdm.resume_integration()
        self.fdm.get_propulsion().get_steady_state()
        self.start = state[:3] - self._place()
        return self._state()

    def step(self, state, action):
        """One control period from where it is."""
        self._command(action)
        for _ in range(SUBSTEPS):
            self.fdm.run()
        return self._state()

    def _command(self, action):
        self.fdm["fcs/throttle-cmd-norm"], self.fdm["fcs/mixture-cmd-norm"] = (1 + action[0]) / 2, 1.0
        for (name, gear), value in zip(self.gears.items(), action[1:], strict=True):
            self.fdm[f"fcs/{name}-cmd-norm"] = gear * value

    def _place(self):
        moved = [self.fdm[f"position/from-start-neu-{axis}-ft"] for axis in "neu"]
        return np.multiply(moved, (1, 1, -1)) * FOOT / self.scale

    def _state(self):
        attitude = quaternion(*(self.fdm[f"attitude/{angle}-rad"] for angle in ("phi", "theta", "psi")))
        velocity, rates = ([self.fdm[f"velocities/{name}"] for name in names] for names in (VELOCITIES, RATES))
        moving = np.array(velocity) * FOOT / self.root, np.array(rates) * self.root
        return np.concatenate((self.start + self._place(), attitude, *moving))


def make(system):
    """The plant of `--plant jsbsim`."""
    return JsbsimAircraft(system)
