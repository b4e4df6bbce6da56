"""What a robot (`System`) and a job for it (`Task`) must define.

The equations of a system are written once, over named scalars. torch tensors and CasADi symbols share `+ - * / **` and
the methods `.sin() .cos() .tan() .sqrt() .tanh() .exp() .arctan()`, so the same body runs in training, in model
predictive control and in the residual. `atan2`, `clamp` and `where` are not shared: use smooth saturations.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import ClassVar, NamedTuple

import torch

from envs.errors import InputError


class Axis(NamedTuple):
    """How a state is shown to people: in words, and as `factor` times its value in `unit`."""

    label: str
    unit: str
    factor: float = 1.0  # -1 turns a coordinate that points down into an altitude


@dataclass(frozen=True)
class System(ABC):
    """A robot: physical parameters as fields, equations of motion as methods.

    Derived quantities are properties, never stored. Policies act in [-1, 1]; `derivative` scales to physical units.
    """

    name: ClassVar[str]
    State: ClassVar[type]  # NamedTuple of the state's scalars; its field order is the order of every state tensor
    Action: ClassVar[type]  # NamedTuple of the action's scalars, each in [-1, 1]
    accelerations: ClassVar[tuple[str, ...]]  # state rows that a force or torque acts on
    residual_input_names: ClassVar[tuple[str, ...]]  # of `residual_inputs`
    # What each entry of `difference` is, "position", "velocity", "attitude" or "rates": sensors err by kind.
    quantities: ClassVar[tuple[str, ...]] = ()
    bounds: ClassVar[dict[str, tuple[float, float]]] = {}  # open interval of each checked parameter
    groups: ClassVar[dict[str, tuple[str, ...]]] = {}  # one name for several fields that are scaled together
    axes: ClassVar[dict[str, Axis]] = {}  # how states are shown; those without one go by their name
    filmed_from: ClassVar[tuple[float, float]] = (-60.0, 25.0)  # [deg] azimuth and elevation it is filmed from
    drawn: ClassVar[bool] = False  # whether `envs.drawing` draws it, so that a policy can see it through a `Camera`

    dt: float  # [s] control period

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float | int) and not math.isfinite(value):
                raise InputError(f"{self.name}: {field.name} is {value}, expected a finite number")
            low, high = self.bounds.get(field.name, (-math.inf, math.inf))
            if isinstance(value, float | int) and not low < value < high:
                open_ended = "more than 0" if low == 0 else "0 or more"
                wanted = f"between {low:g} and {high:g}" if high < math.inf else open_ended
                raise InputError(f"{self.name}: {field.name} is {value:g}, expected {wanted}")

    @abstractmethod
    def derivative(self, x, u):
        """Rate of change of every state scalar [unit/s], as a `State`."""

    @abstractmethod
    def velocity(self, x):
        """Velocity of the robot in world axes, a 3-tuple [m/s]."""

    @abstractmethod
    def accelerate(self, x, acceleration):
        """What an external force per mass [m/s^2, world axes] adds to the derivative: {state name: rate}."""

    @abstractmethod
    def residual_inputs(self, x, u):
        """What an unmodelled force may depend on: scalars of order one, invariant to translation.

        An iterable in the order of `residual_input_names`, cheap and likely ones first: a residual that needs only the
        first few reads no further.
        """

    def residual_rates(self, x, residual):
        """What a residual, one scalar for each of `accelerations`, adds to the derivative: {state name: rate}."""
        return dict(zip(self.accelerations, residual, strict=True))

    def project(self, x):
        """Put a state back on its manifold after a step (unit quaternions)."""
        return x

    def difference(self, x, y):
        """What leads from state `x` to `y`: scalars in the tangent space of `x`, which a learned model predicts."""
        return tuple(b - a for a, b in zip(x, y, strict=True))

    def displaced(self, x, delta):
        """The state that `delta` leads to from `x`: the inverse of `difference`."""
        return self.State(*(a + d for a, d in zip(x, delta, strict=True)))

    def configured(self):
        """The same robot with its controller's beliefs fixed, so that a changed airframe no longer changes them."""
        return self

    def place(self, x):
        """Where a state of floats is seen, (x, y, z) with z up [m]: the point whose trail is drawn."""
        return tuple(getattr(x, name, 0 * x[0]) for name in ("px", "py", "pz"))

    def outline(self, x, size):
        """Lines to draw a state of floats by, each a list of points (x, y, z) with z up [m]; closed ones are filled.

        `size` [m] is about the radius that the robot should appear with, where its own is too small to be seen.
        """
        return []

    @property
    def trim_action(self):
        """The action that costs nothing, as an `Action` of floats: hover, or the middle of every range."""
        return self.Action(*(0.0 for _ in self.Action._fields))


@dataclass(frozen=True)
class Task(ABC):
    """A job: how episodes start, the reference over the horizon, what a policy sees, the cost and the metric.

    An episode is one row of a tensor (N, ...), whose meaning belongs to the task: a reference trajectory, a target
    point, a starting state. `system` is the nominal robot; the dynamics that an episode is flown in may differ.
    Shapes below: B episodes, n states, m actions, H the horizon, r reference entries.
    """

    metric: ClassVar[str]  # what tables report
    unit: ClassVar[str]
    reference_names: ClassVar[tuple[str, ...]]  # states that the reference prescribes; the others are wanted at zero
    state_weights: ClassVar[dict[str, float]]
    action_weights: ClassVar[dict[str, float]]  # on the squared distance from the trim action
    rewarded: ClassVar[int] = 0  # row of the reference that the reward of a single step is about: the next state's own
    sets: ClassVar[tuple[str, ...]]  # names of the families of episodes; the first is the default
    reads_waypoints: ClassVar[bool] = False  # whether `set` may name a CSV file
    encoder: ClassVar[str]  # how a policy reads the reference: "conv", "linear" or "none"
    layers: ClassVar[tuple[int, ...]] = (64, 64, 64, 64)  # neurons of the policy's hidden layers in the paper
    thresholds: ClassVar[tuple[float, float]]  # first and last divergence threshold of the curriculum
    speeds: ClassVar[tuple[float, ...]] = (1.0,)  # speeds of the curriculum
    views: ClassVar[tuple[tuple[str, str], ...]] = ()  # pictures of a flight: pairs of states, or "t" and a state
    trace_name: ClassVar[str] = "distance to reference"  # what `trace` is
    trace_unit: ClassVar[str] = "m"
    camera: ClassVar[object] = None  # a field of tasks whose robot can be drawn: through which a policy sees it

    system: System
    set: str
    steps: int  # [-] length of an episode in control periods
    horizon: int = 10

    def __post_init__(self):
        if self.horizon < 1:
            raise InputError(f"horizon is {self.horizon}, expected at least 1")
        if self.set not in self.sets and not (self.reads_waypoints and self.set.endswith(".csv")):
            known = ", ".join(self.sets) + (", or a CSV file of waypoints" if self.reads_waypoints else "")
            raise InputError(f"--set {self.set}: expected one of {known}")

    @abstractmethod
    def episodes(self, n, split, seed, speed=1.0):
        """Draw `n` episodes of a split ("train", "validation", "test"): (n, ...). `speed` < 1 makes them slower."""

    @abstractmethod
    def start(self, episodes, step):
        """The state (B, n) on the reference of `episodes` (B, ...) at `step` (B,)."""

    @abstractmethod
    def reference(self, episodes, step, state):
        """The next H reference points after `step` (B,), seen from `state` (B, n): (B, H, r)."""

    @abstractmethod
    def observe(self, state):
        """What a policy sees of the state (B, n): (B, o)."""

    @abstractmethod
    def window(self, state, reference):
        """What a policy sees of the reference (B, H, r): (B, H, w)."""

    @abstractmethod
    def distance(self, episodes, step, state):
        """Distance (B,) of a state to its reference at `step`: what the curriculum's threshold limits."""

    @abstractmethod
    def diverged(self, episodes, step, state):
        """Whether an episode has failed (B,)."""

    def arrived(self, episodes, step, state):
        """Whether an episode has ended well before its last step (B,)."""
        return torch.zeros(state.shape[:-1], dtype=torch.bool, device=state.device)

    @abstractmethod
    def score(self, episodes, states):
        """Metric (B,) and success (B,) of the flown states (B, steps + 1, n); what follows an end is to be ignored."""

    def path(self, episodes):
        """The reference (N, steps + 1, r) to draw, NaN where nothing is prescribed; default: where `start` stands."""
        places = [self.system.State._fields.index(name) for name in self.reference_names]
        return self._over_time(lambda step: self.start(episodes, step)[:, places], episodes)

    def trace(self, episodes, states):
        """The error (N, steps + 1) over time to draw of flown states (N, steps + 1, n)."""
        return self._over_time(lambda step: self.distance(episodes, step, states[:, int(step[0])]), episodes)

    def _over_time(self, function, episodes):
        """Stack what a function of a step (N,) gives at every step of the task."""
        steps = torch.arange(self.steps + 1, device=episodes.device)
        return torch.stack([function(step.expand(len(episodes))) for step in steps], 1)

    def cost(self, state, action, reference):
        """Weighted squared deviations (...) of state (..., n) from reference (..., r) and of action from trim."""
        spread, state_weights, trim, action_weights = cost_tables(self, state.dtype, state.device)
        deviation = (state - reference @ spread).square() @ state_weights
        return deviation + (action - trim).square() @ action_weights


@lru_cache(maxsize=64)
def cost_tables(task, dtype, device):
    """The quadratic cost of a task as tensors: `spread` (r, n), state weights (n,), trim (m,), action weights (m,).

    `spread` places the entries of a reference at their states.
    """
    names = task.system.State._fields
    table = {"dtype": dtype, "device": device}
    spread = torch.tensor([[float(a == b) for b in names] for a in task.reference_names], **table)
    state_weights = torch.tensor([task.state_weights.get(name, 0.0) for name in names], **table)
    action_weights = torch.tensor([task.action_weights.get(name, 0.0) for name in task.system.Action._fields], **table)
    return spread, state_weights, torch.tensor(task.system.trim_action, **table), action_weights
