"""Quadrotor: a rigid body under collective thrust with a body-rate controller, and the task of tracking a path.

Equations as in the Flightmare simulator (Song et al. 2020) with the mass, inertia and gains used by Wiedemann, Wuest
et al. (2023). The low-level controller commands a force and a torque for the mass and inertia it was configured with;
the airframe answers with its own. In the nominal robot the two are equal and cancel.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch

from envs import references, rigid_body
from envs.errors import InputError
from envs.flatness import FlightLimits, flatness
from envs.rigid_body import attitude
from envs.shapes import NAMED
from envs.system import Axis, System, Task
from envs.waypoints import read_waypoints


class State(NamedTuple):
    px: Any
    py: Any
    pz: Any
    qw: Any
    qx: Any
    qy: Any
    qz: Any
    vx: Any
    vy: Any
    vz: Any
    p: Any
    q: Any
    r: Any


class Action(NamedTuple):
    thrust: Any
    p_des: Any
    q_des: Any
    r_des: Any


@dataclass(frozen=True)
class Quadrotor(System):
    """Quadrotor that takes collective thrust and body rates.

    | state         | meaning                     | frame          | unit  |
    |---------------|-----------------------------|----------------|-------|
    | `px, py, pz`  | position                    | world, z up    | m     |
    | `qw ... qz`   | attitude, scalar first      | body to world  | -     |
    | `vx, vy, vz`  | velocity                    | world          | m/s   |
    | `p, q, r`     | angular velocity            | body           | rad/s |

    | action                | -1 ... 1 is                                              |
    |-----------------------|----------------------------------------------------------|
    | `thrust`              | `thrust_min` ... `thrust_max`, per mass                  |
    | `p_des, q_des, r_des` | minus to plus `rate_limit_x`, `rate_limit_y`, `rate_limit_z` |
    """

    name: ClassVar[str] = "quadrotor"
    State: ClassVar[type] = State
    Action: ClassVar[type] = Action
    accelerations: ClassVar[tuple[str, ...]] = ("vx", "vy", "vz", "p", "q", "r")
    residual_input_names: ClassVar[tuple[str, ...]] = (
        *("forward velocity", "left velocity", "up velocity"),
        *("up in body x", "up in body y", "up in body z"),
        *("p", "q", "r", *Action._fields),
        *(f"{axis} in body {own}" for axis in ("world x", "world y") for own in "xyz"),
    )
    quantities: ClassVar[tuple[str, ...]] = tuple(
        kind for kind in ("position", "attitude", "velocity", "rates") for _ in range(3)
    )
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(
            ("dt", "mass", "inertia_x", "inertia_y", "inertia_z", "rate_gain_x", "rate_gain_y", "rate_gain_z")
            + ("thrust_max", "rate_limit_x", "rate_limit_y", "rate_limit_z")
            + ("controller_mass", "controller_inertia_x", "controller_inertia_y", "controller_inertia_z"),
            (0.0, math.inf),
        ),
        **dict.fromkeys(("gravity", "thrust_min"), (-1e-9, math.inf)),
        "thrust_loss": (-1.0, 1.0),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {"inertia": ("inertia_x", "inertia_y", "inertia_z")}
    axes: ClassVar[dict[str, Axis]] = {
        **{"px": Axis("x", "m"), "py": Axis("y", "m"), "pz": Axis("altitude", "m")},
        **{f"v{axis}": Axis(f"velocity {axis}", "m/s") for axis in "xyz"},
        **{rate: Axis(f"{name} rate", "rad/s") for rate, name in zip("pqr", ("roll", "pitch", "yaw"), strict=True)},
    }

    dt: float = 0.1  # [s] control period, Wiedemann, Wuest et al. (2023)
    mass: float = 0.723  # [kg] reference implementation of the paper, like the inertia and the gains
    inertia_x: float = 0.026055  # [kg m^2] mass / 12 * arm^2 * 4.5 with an arm of 0.31 m
    inertia_y: float = 0.026055  # [kg m^2]
    inertia_z: float = 0.040530  # [kg m^2] mass / 12 * arm^2 * 7
    rate_gain_x: float = 16.6  # [1/s] gain of the body-rate controller
    rate_gain_y: float = 16.6  # [1/s]
    rate_gain_z: float = 5.0  # [1/s]
    gravity: float = 9.81  # [m/s^2]
    thrust_min: float = 2.31  # [m/s^2] collective thrust per mass at -1
    thrust_max: float = 17.31  # [m/s^2] at +1
    rate_limit_x: float = 0.5  # [rad/s] commanded body rate at 1, Wiedemann, Wuest et al. (2023)
    rate_limit_y: float = 0.5  # [rad/s]
    rate_limit_z: float = 0.5  # [rad/s]
    thrust_loss: float = 0.0  # [-] share of the commanded thrust that is not delivered
    controller_mass: float | None = None  # [kg] what the controller was configured with; None: the airframe's
    controller_inertia_x: float | None = None  # [kg m^2]
    controller_inertia_y: float | None = None  # [kg m^2]
    controller_inertia_z: float | None = None  # [kg m^2]

    def __post_init__(self):
        System.__post_init__(self)
        if not self.thrust_min < self.thrust_max:
            raise InputError(f"quadrotor: thrust_min {self.thrust_min:g} is not below thrust_max {self.thrust_max:g}")

    @property
    def believed(self):
        """Mass [kg] and inertia (x, y, z) [kg m^2] that the low-level controller was configured with."""
        mass = self.mass if self.controller_mass is None else self.controller_mass
        axes = [(getattr(self, f"controller_inertia_{axis}"), getattr(self, f"inertia_{axis}")) for axis in "xyz"]
        return mass, tuple(own if belief is None else belief for belief, own in axes)

    def configured(self):
        mass, inertia = self.believed
        beliefs = {f"controller_inertia_{axis}": value for axis, value in zip("xyz", inertia, strict=True)}
        return replace(self, controller_mass=mass, **beliefs)

    @property
    def thrust_share(self):
        """Delivered over commanded thrust per mass [-]: losses, and a mass that the controller is wrong about."""
        return (1 - self.thrust_loss) * self.believed[0] / self.mass

    @property
    def trim_action(self):
        middle, half = (self.thrust_max + self.thrust_min) / 2, (self.thrust_max - self.thrust_min) / 2
        return Action((self.gravity / self.thrust_share - middle) / half, 0.0, 0.0, 0.0)

    @property
    def flight_limits(self):
        """The limits that a reference must respect."""
        rates = (self.rate_limit_x, self.rate_limit_y, self.rate_limit_z)
        thrusts = (self.thrust_share * self.thrust_min, self.thrust_share * self.thrust_max)
        return FlightLimits(self.gravity, *thrusts, *rates)

    def derivative(self, x, u):
        thrust = (self.thrust_max + self.thrust_min) / 2 + (self.thrust_max - self.thrust_min) / 2 * u.thrust
        thrust = thrust * self.thrust_share
        up = rigid_body.axis_z(attitude(x))
        return State(
            *(x.vx, x.vy, x.vz),
            *rigid_body.quaternion_rates(attitude(x), (x.p, x.q, x.r)),
            *(thrust * up[0], thrust * up[1], thrust * up[2] - self.gravity),
            *self._angular_acceleration(x, u),
        )

    def _angular_acceleration(self, x, u):
        """Answer of the airframe to the torque J0 K (w_des - w) + w x J0 w of the rate controller [rad/s^2]."""
        inertia = (self.inertia_x, self.inertia_y, self.inertia_z)
        believed = self.believed[1]
        limits = (self.rate_limit_x, self.rate_limit_y, self.rate_limit_z)
        gains = (self.rate_gain_x, self.rate_gain_y, self.rate_gain_z)
        rates, wanted = (x.p, x.q, x.r), (u.p_des, u.q_des, u.r_des)
        surplus = [b - own for b, own in zip(believed, inertia, strict=True)]
        answer = []
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            control = (believed[i] / inertia[i] * gains[i]) * (limits[i] * wanted[i] - rates[i])
            gyroscopic = (surplus[k] - surplus[j]) / inertia[i]
            answer.append(control + gyroscopic * rates[j] * rates[k])
        return answer

    def velocity(self, x):
        return x.vx, x.vy, x.vz

    def accelerate(self, x, acceleration):
        return dict(zip(("vx", "vy", "vz"), acceleration, strict=True))

    def residual_inputs(self, x, u):
        """Body velocity, world axes in body axes, body rates, action: blind to position.

        Up tells the tilt. The other two tell the heading, without which a wind has no direction.
        """
        back = rigid_body.inverse(attitude(x))
        yield from rigid_body.to_world(back, (x.vx, x.vy, x.vz))
        yield from rigid_body.axis_z(back)
        yield from (x.p, x.q, x.r, *u)
        yield from rigid_body.axis_x(back)
        yield from rigid_body.axis_y(back)

    def residual_rates(self, x, residual):
        """Acceleration in body axes [m/s^2] and angular acceleration [rad/s^2]."""
        force = rigid_body.to_world(attitude(x), residual[:3])
        return dict(zip(self.accelerations, (*force, *residual[3:]), strict=True))

    def outline(self, x, size):
        """Two crossed arms with a rotor at each end."""
        arm, rotor = 0.7 * size, 0.3 * size
        ends = [(a * arm / math.sqrt(2), b * arm / math.sqrt(2)) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        turns = [math.tau * i / 16 for i in range(17)]
        lines = [[(*ends[i], 0.0), (*ends[i + 2], 0.0)] for i in range(2)]
        lines += [[(a + rotor * math.cos(t), b + rotor * math.sin(t), 0.1 * size) for t in turns] for a, b in ends]
        return [[_moved(x, point) for point in line] for line in lines]

    def project(self, x):
        return rigid_body.with_unit_attitude(x)

    def difference(self, x, y):
        """Way, rotation vector and change of velocity in the body axes of `x`, change of body rates."""
        faster = rigid_body.to_body(attitude(x), tuple(b - a for a, b in zip(x[7:10], y[7:10], strict=True)))
        return *rigid_body.pose_difference(x, y), *faster, *(b - a for a, b in zip(x[10:], y[10:], strict=True))

    def displaced(self, x, delta):
        faster = (*rigid_body.to_world(attitude(x), delta[6:9]), *delta[9:])
        return State(*rigid_body.pose_displaced(x, delta[:6]), *(a + d for a, d in zip(x[7:], faster, strict=True)))


def _moved(x, point):
    """A point of the body in world coordinates."""
    return tuple(a + b for a, b in zip((x.px, x.py, x.pz), rigid_body.to_world(attitude(x), point), strict=True))


@dataclass(frozen=True)
class Tracking(Task):
    """Follow a path in space and time.

    An episode is a reference of flat points (steps + horizon + 1, 12), see `envs.flatness`. It starts on the reference,
    with the attitude and body rates that flatness gives. `set` is a random set, a named curve, or a CSV file of
    waypoints. Metric: mean distance to the reference; success: never 5 m off.
    """

    metric: ClassVar[str] = "mean position error"
    unit: ClassVar[str] = "m"
    reference_names: ClassVar[tuple[str, ...]] = ("px", "py", "pz", "vx", "vy", "vz")
    # The paper weighs actions in [0, 1] with 5 and 0.1; ours span [-1, 1], twice as wide.
    state_weights: ClassVar[dict[str, float]] = {
        **dict.fromkeys(("px", "py", "pz"), 10.0),
        **dict.fromkeys(("vx", "vy", "vz"), 1.0),
        **dict.fromkeys(("p", "q", "r"), 0.1),
    }
    action_weights: ClassVar[dict[str, float]] = {
        "thrust": 5 / 4,
        **dict.fromkeys(("p_des", "q_des", "r_des"), 0.1 / 4),
    }
    sets: ClassVar[tuple[str, ...]] = (*references.RANDOM_SETS, *NAMED)
    reads_waypoints: ClassVar[bool] = True
    encoder: ClassVar[str] = "conv"
    thresholds: ClassVar[tuple[float, float]] = (0.1, 2.0)
    speeds: ClassVar[tuple[float, ...]] = (0.5, 0.75, 1.0)
    views: ClassVar[tuple[tuple[str, str], ...]] = (("px", "py"), ("t", "pz"))
    trace_name: ClassVar[str] = "position error"
    limit: ClassVar[float] = 5.0  # [m] farther off the reference is a failure

    system: Quadrotor = Quadrotor()
    set: str = "paper"
    steps: int = 100

    def episodes(self, n, split, seed, speed=1.0):
        span = {"steps": self.steps + self.horizon + 1, "dt": self.system.dt}
        if self.set in references.RANDOM_SETS:
            chance = {"limits": self.system.flight_limits, "generator": references.split_generator(split, seed)}
            return references.random_polynomials(n, kind=self.set, speed=speed, **span, **chance)
        if self.set in NAMED:
            return NAMED[self.set](**span).expand(n, -1, -1)
        return read_waypoints(self.set, **span).expand(n, -1, -1)

    def start(self, episodes, step):
        point = episodes[torch.arange(len(episodes), device=episodes.device), step]
        _, quaternion, rates = flatness(point, self.system.gravity)
        return torch.cat((point[:, :3], quaternion, point[:, 3:6], rates), -1)

    def reference(self, episodes, step, state):
        ahead = step.unsqueeze(-1) + torch.arange(1, self.horizon + 1, device=step.device)
        ahead = ahead.clamp(max=episodes.shape[1] - 1)
        return episodes[torch.arange(len(episodes), device=step.device).unsqueeze(-1), ahead, :6]

    def observe(self, state):
        x = State(*state.unbind(-1))
        q, velocity = attitude(x), (x.vx, x.vy, x.vz)
        axes = (*rigid_body.axis_x(q), *rigid_body.axis_y(q))
        return torch.stack((*velocity, *rigid_body.to_body(q, velocity), *axes, x.p, x.q, x.r), -1)

    def window(self, state, reference):
        """Reference positions and velocities (B, H, 6) less those of a robot that keeps its present velocity.

        The paper gives positions relative to the robot and velocities as they are. Ours is a linear combination of its
        inputs, but small when the robot is on its way: on equal terms the error after training is three times smaller.
        """
        ahead = self.system.dt * torch.arange(1, self.horizon + 1, device=state.device, dtype=state.dtype)
        position, velocity = state[..., None, :3], state[..., None, 7:10]
        kept = position + ahead.unsqueeze(-1) * velocity
        return torch.cat((reference[..., :3] - kept, reference[..., 3:] - velocity), -1)

    def distance(self, episodes, step, state):
        point = episodes[torch.arange(len(episodes), device=step.device), step, :3]
        return (state[..., :3] - point).norm(dim=-1)

    def diverged(self, episodes, step, state):
        return ~(self.distance(episodes, step, state) <= self.limit)

    def score(self, episodes, states):
        error = (states[:, 1:, :3] - episodes[:, 1 : self.steps + 1, :3]).norm(dim=-1)
        return error.mean(-1), (error <= self.limit).all(-1)
