"""Fixed wing: a small aircraft with linear aerodynamics, and the task of flying through a point.

Beard and McLain (2012), "Small Unmanned Aircraft", eqs. 3.14-3.17 and 4.5-4.20. Lift, drag and moments are linear in
angle of attack and sideslip, which are smoothly limited. Pitch moments scale with the chord, the others with the span.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch

from envs import rigid_body
from envs.errors import InputError
from envs.references import split_generator
from envs.rigid_body import attitude
from envs.system import Axis, System, Task


class State(NamedTuple):
    px: Any
    py: Any
    pz: Any
    qw: Any
    qx: Any
    qy: Any
    qz: Any
    u_b: Any
    v_b: Any
    w_b: Any
    p: Any
    q: Any
    r: Any


class Action(NamedTuple):
    thrust: Any
    elevator: Any
    aileron: Any
    rudder: Any


def limited(angle, limit):
    """An angle that is left alone well inside the limit and never exceeds it: |error| < 0.31 % up to a third of it."""
    square = (angle / limit) * (angle / limit)
    return angle / (1 + square * square).sqrt().sqrt()


@dataclass(frozen=True)
class FixedWing(System):
    """Fixed-wing aircraft.

    | state           | meaning                | frame                    | unit  |
    |-----------------|------------------------|--------------------------|-------|
    | `px, py, pz`    | position               | world: north, east, down | m     |
    | `qw ... qz`     | attitude, scalar first | body to world            | -     |
    | `u_b, v_b, w_b` | velocity over ground   | body: forward, right, down | m/s |
    | `p, q, r`       | angular velocity       | body                     | rad/s |

    | action     | -1 ... 1 is                              |
    |------------|------------------------------------------|
    | `thrust`   | 0 ... `thrust_max`                       |
    | `elevator` | `-elevator_limit` ... `elevator_limit`   |
    | `aileron`  | `-aileron_limit` ... `aileron_limit`     |
    | `rudder`   | `-rudder_limit` ... `rudder_limit`       |
    """

    name: ClassVar[str] = "fixed_wing"
    State: ClassVar[type] = State
    Action: ClassVar[type] = Action
    accelerations: ClassVar[tuple[str, ...]] = ("u_b", "v_b", "w_b", "p", "q", "r")
    residual_input_names: ClassVar[tuple[str, ...]] = (
        *("u_b - cruise", "v_b", "w_b"),
        *("down in body x", "down in body y", "down in body z"),
        *("p", "q", "r", *Action._fields),
        *(f"{axis} in body {own}" for axis in ("north", "east") for own in "xyz"),
    )
    quantities: ClassVar[tuple[str, ...]] = tuple(
        kind for kind in ("position", "attitude", "velocity", "rates") for _ in range(3)
    )
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("dt", "mass", "inertia_x", "inertia_y", "inertia_z", "thrust_max"), (0.0, math.inf)),
        **dict.fromkeys(("elevator_limit", "aileron_limit", "rudder_limit", "incidence_limit"), (0.0, math.pi / 2)),
        **dict.fromkeys(("wing_area", "chord", "span"), (0.0, math.inf)),
        **dict.fromkeys(("gravity", "air_density"), (-1e-9, math.inf)),
        "thrust_loss": (-1.0, 1.0),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "inertia": ("inertia_x", "inertia_y", "inertia_z", "inertia_xz"),
    }
    axes: ClassVar[dict[str, Axis]] = {
        **{"px": Axis("north", "m"), "py": Axis("east", "m"), "pz": Axis("altitude", "m", -1.0)},
        "u_b": Axis("velocity forward", "m/s"),
        "v_b": Axis("velocity right", "m/s"),
        "w_b": Axis("velocity down", "m/s"),
        **{rate: Axis(f"{name} rate", "rad/s") for rate, name in zip("pqr", ("roll", "pitch", "yaw"), strict=True)},
    }
    filmed_from: ClassVar[tuple[float, float]] = (-70.0, 18.0)

    dt: float = 0.05  # [s] control period
    mass: float = 1.01  # [kg] this and what follows: reference implementation of Wiedemann, Wuest et al. (2023)
    inertia_x: float = 0.04766  # [kg m^2]
    inertia_y: float = 0.05005  # [kg m^2]
    inertia_z: float = 0.09558  # [kg m^2]
    inertia_xz: float = -0.00105  # [kg m^2]
    gravity: float = 9.81  # [m/s^2]
    air_density: float = 1.225  # [kg/m^3]
    wing_area: float = 0.276  # [m^2]
    chord: float = 0.185  # [m]
    span: float = 1.54  # [m]
    thrust_angle: float = 0.16535  # [rad] thrust line below the body x axis
    thrust_max: float = 7.0  # [N]
    elevator_limit: float = math.radians(20)  # [rad]
    aileron_limit: float = math.radians(2.5)  # [rad]
    rudder_limit: float = math.radians(20)  # [rad]
    incidence_limit: float = math.radians(10)  # [rad] of angle of attack and sideslip
    thrust_loss: float = 0.0  # [-] share of the commanded thrust that is not delivered
    wind: float = 0.0  # [m/s] steady wind towards world x (north): a tail wind at the start of the task
    crosswind: float = 0.0  # [m/s] steady wind towards world y (east)
    downdraught: float = 0.0  # [m/s] steady wind towards world z (down)
    lift: tuple[float, ...] = (0.39, 4.5321, 0.318, 0.527)  # [-] of 1, alpha, q, elevator
    drag: tuple[float, ...] = (0.0765, 0.3346, 0.354, 0.004)
    pitch: tuple[float, ...] = (0.02, -1.4037, -0.1324, -0.4236)
    side: tuple[float, ...] = (-0.033, -0.1, 0.039, 0.0, 0.225)  # [-] of beta, p, r, aileron, rudder
    roll: tuple[float, ...] = (-0.081, -0.529, 0.159, -0.453, 0.005)
    yaw: tuple[float, ...] = (0.189, -0.083, -0.948, -0.041, -0.077)

    def __post_init__(self):
        System.__post_init__(self)
        if not self.inertia_xz * self.inertia_xz < self.inertia_x * self.inertia_z:
            raise InputError(f"fixed_wing: inertia_xz is {self.inertia_xz:g}, too large for inertia_x and inertia_z")

    def derivative(self, x, u):
        velocity, rates = (x.u_b, x.v_b, x.w_b), (x.p, x.q, x.r)
        down = rigid_body.axis_z(rigid_body.inverse(attitude(x)))
        force, torque = self.wrench(x, u)
        turning = rigid_body.cross(rates, velocity)
        linear = tuple(force[i] / self.mass + self.gravity * down[i] - turning[i] for i in range(3))
        return State(
            *rigid_body.to_world(attitude(x), velocity),
            *rigid_body.quaternion_rates(attitude(x), rates),
            *linear,
            *self._angular_acceleration(rates, torque),
        )

    def wrench(self, x, u):
        """Force [N] and torque [N m] of air and propeller in body axes, gravity excluded."""
        wind = rigid_body.to_body(attitude(x), (self.wind, self.crosswind, self.downdraught))
        ua, va, wa = x.u_b - wind[0], x.v_b - wind[1], x.w_b - wind[2]
        plane = (ua * ua + wa * wa + CALM).sqrt()  # airspeed in the plane of symmetry
        speed = (ua * ua + va * va + wa * wa + CALM).sqrt()
        alpha = limited((wa * ua / (ua * ua + CALM)).arctan(), self.incidence_limit)  # of wa / ua
        beta = limited((va / plane).arctan(), self.incidence_limit)
        half_chord, half_span = self.chord / 2 / speed, self.span / 2 / speed
        elevator, aileron, rudder = (
            self.elevator_limit * u.elevator,
            self.aileron_limit * u.aileron,
            self.rudder_limit * u.rudder,
        )
        symmetric = (1, alpha, half_chord * x.q, elevator)
        lateral = (beta, half_span * x.p, half_span * x.r, aileron, rudder)
        pressure = 0.5 * self.air_density * self.wing_area * speed * speed
        lift, drag, pitch = (pressure * _weighted(c, symmetric) for c in (self.lift, self.drag, self.pitch))
        side, roll, yaw = (pressure * _weighted(c, lateral) for c in (self.side, self.roll, self.yaw))
        thrust = (1 - self.thrust_loss) * self.thrust_max / 2 * (1 + u.thrust)
        cos, sin = ua / plane, wa / plane
        ahead, down = _direction(self.thrust_angle)
        force = (ahead * thrust - drag * cos + lift * sin, side, down * thrust - drag * sin - lift * cos)
        return force, (self.span * roll, self.chord * pitch, self.span * yaw)

    def _angular_acceleration(self, rates, torque):
        """Euler's equation with the product of inertia I_xz [rad/s^2]."""
        p, q, r = rates
        ix, iy, iz, ixz = self.inertia_x, self.inertia_y, self.inertia_z, self.inertia_xz
        gyroscopic = rigid_body.cross(rates, (ix * p - ixz * r, iy * q, iz * r - ixz * p))
        roll, pitch, yaw = (torque[i] - gyroscopic[i] for i in range(3))
        determinant = ix * iz - ixz * ixz
        return (iz * roll + ixz * yaw) / determinant, pitch / iy, (ixz * roll + ix * yaw) / determinant

    def velocity(self, x):
        return rigid_body.to_world(attitude(x), (x.u_b, x.v_b, x.w_b))

    def accelerate(self, x, acceleration):
        return dict(zip(("u_b", "v_b", "w_b"), rigid_body.to_body(attitude(x), acceleration), strict=True))

    def residual_inputs(self, x, u):
        """Body velocity relative to a cruise of 11.5 m/s, world axes in body axes, body rates, action."""
        back = rigid_body.inverse(attitude(x))
        yield from (x.u_b - CRUISE, x.v_b, x.w_b)
        yield from rigid_body.axis_z(back)
        yield from (x.p, x.q, x.r, *u)
        yield from rigid_body.axis_x(back)
        yield from rigid_body.axis_y(back)

    def place(self, x):
        """North, west, up."""
        return x.px, -x.py, -x.pz

    def outline(self, x, size):
        """Fuselage, wing, tail plane and fin."""
        lines = (
            ((0.9, 0, 0), (-0.9, 0, 0)),
            ((0.25, -1, 0), (0.25, 1, 0)),
            ((-0.8, -0.35, 0), (-0.8, 0.35, 0)),
            ((-0.7, 0, 0), (-0.9, 0, -0.35), (-0.9, 0, 0)),
        )
        centre = self.place(x)
        turned = [[rigid_body.to_world(attitude(x), [size * c for c in point]) for point in line] for line in lines]
        return [[(centre[0] + n, centre[1] - e, centre[2] - d) for n, e, d in line] for line in turned]

    def project(self, x):
        return rigid_body.with_unit_attitude(x)

    def difference(self, x, y):
        """Way and rotation vector in the body axes of `x`, changes of body velocity and body rates."""
        return *rigid_body.pose_difference(x, y), *(b - a for a, b in zip(x[7:], y[7:], strict=True))

    def displaced(self, x, delta):
        pose = rigid_body.pose_displaced(x, delta[:6])
        return State(*pose, *(a + d for a, d in zip(x[7:], delta[6:], strict=True)))


CRUISE = 11.5  # [m/s] speed at which the task starts
# [m^2/s^2] added to squares of airspeeds: keeps angles, forces and their gradients finite where the air stands still
# about the aircraft, as in a tail wind as fast as it flies. In flight it changes them by less than 1e-8 of themselves.
CALM = 1e-6


def _direction(angle):
    """Cosine and sine of a parameter [rad], which is a number, or a symbol where equations are compiled."""
    return (math.cos(angle), math.sin(angle)) if isinstance(angle, float) else (angle.cos(), angle.sin())


def _weighted(coefficients, values):
    return sum(c * value for c, value in zip(coefficients, values, strict=True))


@dataclass(frozen=True)
class Waypoint(Task):
    """Fly through a point 50 m ahead.

    An episode is its target point (3,). The reference is the straight line from the aircraft to the target, flown at
    constant speed and beyond the target. Metric: distance to the target where the path crosses the target's plane.
    """

    metric: ClassVar[str] = "distance to target"
    unit: ClassVar[str] = "m"
    reference_names: ClassVar[tuple[str, ...]] = ("px", "py", "pz")
    state_weights: ClassVar[dict[str, float]] = dict.fromkeys(("px", "py", "pz"), 10.0)
    action_weights: ClassVar[dict[str, float]] = dict.fromkeys(("elevator", "aileron", "rudder"), 0.1 / 4)
    sets: ClassVar[tuple[str, ...]] = ("waypoint",)
    encoder: ClassVar[str] = "linear"
    thresholds: ClassVar[tuple[float, float]] = (4.0, 20.0)
    views: ClassVar[tuple[tuple[str, str], ...]] = (("px", "pz"), ("px", "py"))
    trace_name: ClassVar[str] = "distance to straight line"
    limit: ClassVar[float] = 20.0  # [m] farther off the straight line is a failure
    nearest: ClassVar[float] = 0.3  # [m] the line is aimed as if the target were at least that far ahead

    system: FixedWing = FixedWing()
    set: str = "waypoint"
    steps: int = 120

    def episodes(self, n, split, seed, speed=1.0):
        sideways = 10 * torch.rand(n, 2, generator=split_generator(split, seed)) - 5
        return torch.cat((torch.full((n, 1), 50.0), sideways), -1)

    def start(self, episodes, step):
        state = episodes.new_zeros(len(episodes), 13)
        state[:, :3] = episodes * (step * self.system.dt * CRUISE / episodes.norm(dim=-1)).unsqueeze(-1)
        state[:, 3] = 1.0
        state[:, 7] = CRUISE
        return state

    def reference(self, episodes, step, state):
        ahead = episodes - state[..., :3]
        forward = ahead[..., :1].clamp(min=self.nearest)
        direction = torch.nn.functional.normalize(torch.cat((forward, ahead[..., 1:]), -1), dim=-1)
        travelled = CRUISE * self.system.dt * torch.arange(1, self.horizon + 1, device=state.device, dtype=state.dtype)
        return state[..., None, :3] + travelled.unsqueeze(-1) * direction.unsqueeze(-2)

    def observe(self, state):
        """Attitude columns, body velocity and body rates (B, 12); not the position."""
        x = State(*state.unbind(-1))
        axes = (*rigid_body.axis_x(attitude(x)), *rigid_body.axis_y(attitude(x)))
        return torch.stack((*axes, x.u_b, x.v_b, x.w_b, x.p, x.q, x.r), -1)

    def window(self, state, reference):
        """The last point of the reference relative to the aircraft (B, 1, 3)."""
        return reference[..., -1:, :] - state[..., None, :3]

    def distance(self, episodes, step, state):
        """Distance to the straight line from the origin through the target."""
        line = torch.nn.functional.normalize(episodes, dim=-1)
        position = state[..., :3]
        return (position - (position * line).sum(-1, keepdim=True) * line).norm(dim=-1)

    def diverged(self, episodes, step, state):
        return ~(self.distance(episodes, step, state) <= self.limit)

    def arrived(self, episodes, step, state):
        return state[..., 0] >= episodes[..., 0]

    def path(self, episodes):
        """The straight line to the target, where it ends."""
        travelled = CRUISE * self.system.dt * torch.arange(self.steps + 1).to(episodes)
        share = (travelled / episodes.norm(dim=-1, keepdim=True)).clamp(max=1)
        return episodes[:, None] * share.unsqueeze(-1)

    def score(self, episodes, states):
        """Interpolates between the last state before the plane and the first behind it."""
        beyond = states[..., 0] >= episodes[:, None, 0]
        crossed = beyond.any(-1)
        after = beyond.to(torch.int8).argmax(-1).clamp(min=1)
        rows = torch.arange(len(states), device=states.device)
        a, b = states[rows, after - 1, :3], states[rows, after, :3]
        share = ((episodes[:, :1] - a[:, :1]) / (b[:, :1] - a[:, :1])).clamp(0, 1)
        miss = (a + share * (b - a) - episodes).norm(dim=-1)
        lost = self.distance(episodes[:, None], None, states) > self.limit
        before = torch.arange(states.shape[1], device=states.device) <= after.unsqueeze(-1)
        return miss, crossed & ~(lost & before).any(-1)
