"""CartPole: a pole hinged on a cart that is pushed along a rail, and the task of balancing it at rest.

Barto, Sutton and Anderson (1983), "Neuronlike adaptive elements that can solve difficult learning control problems";
equations in the corrected form of Florian (2007), "Correct equations for the dynamics of the cart-pole system",
eqs. 21-24. The sign of the velocity in the track friction is smoothed, so that it has a gradient.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch

from envs.camera import Camera
from envs.references import split_generator
from envs.system import Axis, System, Task

FRICTION_SPEED = 0.05  # [m/s] the track friction has reached 76 % of its full value here


class State(NamedTuple):
    x: Any
    v: Any
    theta: Any
    omega: Any


class Action(NamedTuple):
    force: Any


@dataclass(frozen=True)
class CartPole(System):
    """Cart on a rail with a pole.

    | state   | meaning                   | unit  |
    |---------|---------------------------|-------|
    | `x`     | position of the cart      | m     |
    | `v`     | velocity of the cart      | m/s   |
    | `theta` | pole angle, 0 = upright   | rad   |
    | `omega` | angular velocity          | rad/s |

    | action  | -1 ... 1 is                      |
    |---------|----------------------------------|
    | `force` | -`force_limit` ... `force_limit` |
    """

    name: ClassVar[str] = "cartpole"
    State: ClassVar[type] = State
    Action: ClassVar[type] = Action
    accelerations: ClassVar[tuple[str, ...]] = ("v", "omega")
    residual_input_names: ClassVar[tuple[str, ...]] = ("v", "sin theta", "cos theta - 1", "omega", "force")
    quantities: ClassVar[tuple[str, ...]] = ("position", "velocity", "attitude", "rates")
    bounds: ClassVar[dict[str, tuple[float, float]]] = {
        **dict.fromkeys(("dt", "cart_mass", "pole_mass", "pole_half_length", "force_limit"), (0.0, math.inf)),
        **dict.fromkeys(("gravity", "track_friction", "hinge_friction"), (-1e-9, math.inf)),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {"mass": ("cart_mass", "pole_mass")}
    axes: ClassVar[dict[str, Axis]] = {
        "x": Axis("cart position", "m"),
        "v": Axis("cart velocity", "m/s"),
        "theta": Axis("pole angle", "deg", 180 / math.pi),
        "omega": Axis("pole rate", "rad/s"),
    }
    filmed_from: ClassVar[tuple[float, float]] = (-90.0, 0.0)
    drawn: ClassVar[bool] = True

    dt: float = 0.05  # [s] control period
    cart_mass: float = 1.0  # [kg] Barto et al.
    pole_mass: float = 0.1  # [kg] Barto et al.
    pole_half_length: float = 0.5  # [m] Barto et al.
    gravity: float = 9.81  # [m/s^2]
    track_friction: float = 0.0005  # [-] Coulomb coefficient between cart and rail, Barto et al.
    hinge_friction: float = 0.000002  # [N m s] viscous coefficient of the hinge, Barto et al.
    force_limit: float = 30.0  # [N] Wiedemann, Wuest et al. (2023)

    def derivative(self, x, u):
        total = self.cart_mass + self.pole_mass
        pole = self.pole_mass * self.pole_half_length
        sin, cos = x.theta.sin(), x.theta.cos()
        friction = self.track_friction * (x.v / FRICTION_SPEED).tanh()
        spin = pole * x.omega * x.omega
        push = -self.force_limit * u.force - spin * (sin + friction * cos)
        torque = self.gravity * sin + cos * (push / total + friction * self.gravity)
        torque = torque - self.hinge_friction / pole * x.omega
        angular = torque / (self.pole_half_length * self._leverage(sin, cos, friction))
        load = total * self.gravity - pole * angular * sin - spin * cos
        linear = (self.force_limit * u.force + spin * sin - pole * angular * cos - friction * load) / total
        return State(x.v, linear, x.omega, angular)

    def _leverage(self, sin, cos, friction):
        """Denominator [-]: 4/3 of a uniform rod less what the moving cart takes off.

        Florian prints the friction here without the sine; only with it does friction take out force times speed.
        """
        return 4 / 3 - self.pole_mass / (self.cart_mass + self.pole_mass) * cos * (cos - friction * sin)

    def velocity(self, x):
        return x.v, 0 * x.v, 0 * x.v

    def accelerate(self, x, acceleration):
        """A force on the cart, per total mass; only its component along the rail moves anything."""
        pole = self.pole_mass * self.pole_half_length / (self.cart_mass + self.pole_mass)
        sin, cos = x.theta.sin(), x.theta.cos()
        friction = self.track_friction * (x.v / FRICTION_SPEED).tanh()
        angular = -cos * acceleration[0] / (self.pole_half_length * self._leverage(sin, cos, friction))
        return {"v": acceleration[0] - pole * angular * (cos - friction * sin), "omega": angular}

    def residual_inputs(self, x, u):
        return x.v, x.theta.sin(), x.theta.cos() - 1, x.omega, u.force

    def mirrored(self, state):
        """The states (..., 4) of the robot seen in a mirror across the rail."""
        return -state

    def place(self, x):
        """The tip of the pole."""
        length = 2 * self.pole_half_length
        return x.x + length * math.sin(x.theta), 0 * x.x, length * math.cos(x.theta)

    def outline(self, x, size):
        """Cart and pole at their true size."""
        width, height = 0.15, 0.15  # [m] half width and height of the cart, whose top is the hinge
        corners = ((-width, 0), (width, 0), (width, -height), (-width, -height), (-width, 0))
        return [[(x.x + dx, 0.0, dz) for dx, dz in corners], [(x.x, 0.0, 0.0), self.place(x)]]


@dataclass(frozen=True)
class Balance(Task):
    """Keep the pole upright at low cart velocity.

    An episode is its starting state (4,). The reference leads in a straight line from the current state to rest.
    Metric: mean |v| over the episode.
    """

    metric: ClassVar[str] = "mean cart speed"
    unit: ClassVar[str] = "m/s"
    reference_names: ClassVar[tuple[str, ...]] = State._fields
    state_weights: ClassVar[dict[str, float]] = {"theta": 10.0, "v": 3.0, "omega": 1.0}
    action_weights: ClassVar[dict[str, float]] = {}
    rewarded: ClassVar[int] = -1  # rest: the rows before it begin where the robot is and ask for little
    sets: ClassVar[tuple[str, ...]] = ("balance",)
    encoder: ClassVar[str] = "none"
    layers: ClassVar[tuple[int, ...]] = (32, 64, 64, 32)
    thresholds: ClassVar[tuple[float, float]] = (0.05, 0.4)
    views: ClassVar[tuple[tuple[str, str], ...]] = (("t", "v"), ("t", "theta"))
    trace_name: ClassVar[str] = "cart speed"
    trace_unit: ClassVar[str] = "m/s"
    angle_limit: ClassVar[float] = math.radians(24)  # [rad]
    rail: ClassVar[float] = 2.4  # [m] half length

    system: CartPole = CartPole()
    set: str = "balance"
    steps: int = 250
    camera: Camera | None = None  # through which a policy sees the robot in place of its state

    def episodes(self, n, split, seed, speed=1.0):
        uniform = 2 * torch.rand(n, 4, generator=split_generator(split, seed)) - 1
        return uniform * torch.tensor([0.15, 0.15, 0.05, 0.15])

    def start(self, episodes, step):
        return episodes.clone()

    def reference(self, episodes, step, state):
        left = 1 - torch.arange(1, self.horizon + 1, device=state.device, dtype=state.dtype) / self.horizon
        return state.unsqueeze(-2) * left.unsqueeze(-1)

    def observe(self, state):
        return state

    def window(self, state, reference):
        return reference[..., :0]

    def distance(self, episodes, step, state):
        return state[..., 2].abs()

    def diverged(self, episodes, step, state):
        return ~((state[..., 2].abs() <= self.angle_limit) & (state[..., 0].abs() <= self.rail))

    def path(self, episodes):
        """At rest and upright, anywhere on the rail."""
        rest = episodes.new_tensor([math.nan, 0.0, 0.0, 0.0])
        return rest.expand(len(episodes), self.steps + 1, -1)

    def trace(self, episodes, states):
        return states[..., 1].abs()

    def score(self, episodes, states):
        failed = self.diverged(None, None, states)
        return states[..., 1:, 1].abs().mean(-1), ~failed.any(-1)
