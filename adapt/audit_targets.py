"""Random cases of the audit: what differs in a target, how much of it is flown, and how the record of it is spoilt.

Names are all that `--target` knows. Strengths are log-uniform, from what nobody notices to what may bring the robot
down; a change that `parse_target` refuses is drawn again.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from adapt.parameter_residual import own_parameters
from envs.domains import DISTURBANCES, SCALAR, parse_target
from envs.errors import InputError
from envs.registry import make_system

UNCHANGED, SINGLE = 0.1, 0.45  # shares of cases without a change and with one; the others have up to `MOST_CHANGES`
MOST_CHANGES = 4
NOISY, SPOILT = 0.3, 0.3  # shares of cases with measurement noise and with a spoilt record
NOISE = (0.3, 1.5)  # [-] factor on `envs.domains.NOISE`
TRANSITIONS = (10, 2000)
DECADES = 2.0  # over which strengths are spread
# Largest factor on a parameter: a payload as heavy as the robot, but geometry is known better.
FACTOR = 2.0
FACTORS = {
    **dict.fromkeys(("wing_area", "chord", "span", "air_density", "pole_half_length"), 1.3),
    **dict.fromkeys(("thrust_min", "thrust_max", "incidence_limit"), 1.5),
    "gravity": 1.2,
}
# Least and greatest value that is added to parameters which are zero or next to nothing in the model.
ADDED = {
    "thrust_loss": (0.0, 0.5),  # [-]
    "thrust_angle": (-0.2, 0.2),  # [rad]
    "track_friction": (0.0, 0.3),  # [-] of a dry bearing
    "hinge_friction": (0.0, 0.05),  # [N m s]
    "wind": (-5.0, 5.0),  # [m/s] this and the next two: on an aircraft that cruises at 11.5 m/s
    "crosswind": (-3.0, 3.0),
    "downdraught": (-2.0, 2.0),
}
STRENGTHS = {"drag": 1.0, "quadratic_drag": 0.3, "push": 3.0, "wind": 10.0}  # [1/s, 1/m, m/s^2, m/s]
SPOILS = ("shuffled", "swapped", "flipped", "late", "stale", "duplicated")


@dataclass(frozen=True)
class Case:
    """What is flown, and what is done to the record before anything is learned from it."""

    system: str
    index: int
    seed: int
    target: str  # as `--target` takes it; empty where nothing differs
    transitions: int
    spoilt: str  # one of `SPOILS`, or empty
    columns: tuple[int, ...]  # actions that are swapped, or the one that is flipped
    share: float  # of the record that is stale or duplicated
    other: str  # target that the stale part was recorded in
    chance: int  # seed of the flights and of the adaptation

    @property
    def row(self):
        """The columns of the audit's table that tell what was drawn."""
        noise = next((item.removeprefix("noise=") for item in self.target.split() if item.startswith("noise=")), 0)
        names = ("system", "index", "seed", "target", "corruption", "transitions")
        return {name: getattr(self, name) for name in names} | {"noise": float(noise)}

    @property
    def corruption(self):
        """How the record is spoilt, in words; empty where it isn't."""
        names = make_system(self.system).Action._fields
        actions = " and ".join(names[column] for column in self.columns)
        said = {
            "swapped": f"swapped {actions}",
            "flipped": f"flipped {actions}",
            "stale": f"stale {self.share:.0%} of {self.other}",
            "duplicated": f"duplicated {self.share:.0%}",
        }
        return said.get(self.spoilt, self.spoilt)


def draw(system, index, seed):
    """The `Case` of a system (name) and an index: the same for the same seed, whatever was drawn before."""
    robot = make_system(system)
    generator = np.random.default_rng((seed, index, zlib.crc32(system.encode())))
    target = draw_target(robot, generator)
    if generator.random() < NOISY:
        target = f"{target} noise={generator.uniform(*NOISE):.3g}".strip()
    count = round(float(np.exp(generator.uniform(*np.log(TRANSITIONS)))))
    actions = len(robot.Action._fields)
    possible = [name for name in SPOILS if name != "swapped" or actions > 1]
    spoilt = str(generator.choice(possible)) if generator.random() < SPOILT else ""
    touched = {"swapped": 2, "flipped": 1}.get(spoilt, 0)
    columns = tuple(sorted(generator.choice(actions, touched, replace=False).tolist()))
    share = float(generator.uniform(0.1, 0.9)) if spoilt in ("stale", "duplicated") else 0.0
    other = draw_target(robot, generator, least=1) if spoilt == "stale" else ""
    chance = int(generator.integers(2**31))
    return Case(system, index, seed, target, count, spoilt, columns, share, other, chance)


def draw_target(system, generator, least=0):
    """A target of a system without noise, as text, with at least so many changes."""
    names = parameters(system)
    while True:
        kind = generator.random()
        count = 0 if kind < UNCHANGED else 1 if kind < UNCHANGED + SINGLE else generator.integers(2, MOST_CHANGES + 1)
        chosen = generator.choice(names, max(count, least), replace=False).tolist()
        text = " ".join(f"{name}={strength(system, name, generator)}" for name in chosen)
        try:
            parse_target(text, system)
        except InputError:
            continue
        return text


def parameters(system):
    """All names that a target of a system whose state is seen may change, noise excepted."""
    own = (*own_parameters(system), *system.groups)
    return (*own, *(name for name in DISTURBANCES if name not in own))


def strength(system, name, generator):
    """A value of a parameter or disturbance, as text."""
    share = 10 ** generator.uniform(-DECADES, 0)
    own = own_parameters(system)
    if name in (*own, *system.groups):
        if name in ADDED:
            return f"{own[name] + share * ADDED[name][generator.integers(2) if ADDED[name][0] else 1]:.4g}"
        return f"x{FACTORS.get(name, FACTOR) ** (share * generator.choice((-1, 1))):.4g}"
    if name in SCALAR:
        return f"{share * STRENGTHS[name]:.4g}"
    direction = generator.normal(size=3)
    return ",".join(f"{part:.4g}" for part in share * STRENGTHS[name] * direction / np.linalg.norm(direction))
