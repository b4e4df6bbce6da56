"""How far dynamics with given parameters are from recorded flights, and what a change of each parameter does to that.

Two losses, with one interface: `linearised(values, names)` gives what is missed and the effects of the parameters, in
units of what is left, so that an ordinary least-squares step follows.

`OneStep` compares accelerations over one control period. It is quick, and right where states are exact. Noise of the
measured states, though, enters the inputs as well as the outputs, which biases parameters (errors in variables), and a
difference over a short period drowns in it. `Shooting` compares whole stretches of flight with a prediction from an
initial state that is estimated along with the parameters (Bock's multiple shooting without continuity; an output-error
model in Ljung 1999, ch. 5), so that noise is averaged over the stretch and enters no input.
"""

import torch

from adapt.parameter_residual import changed, nominal
from adapt.prediction import predict
from adapt.sparse_ridge import blocks
from adapt.stretches import cut, difference, displaced
from envs.errors import InputError

STEP = 1e-4  # [-] of a parameter's size, or of a state, for central differences
SIZE = 0.1  # smallest size that a parameter is taken to have, in its own unit
NEGLIGIBLE = 1e-4  # [m/s^2, rad/s^2] what needs no explanation
LENGTH = 10  # control periods of a stretch
SETTLING = 10  # most Gauss-Newton steps of the initial states after a change of the parameters
SETTLED = 1e-3  # [-] change of the estimated noise at which they have settled
FLOOR = 1e-6  # [m, m/s, rad, rad/s] smallest noise that a state is taken to have


def size(system, name):
    """The size of a parameter, in its unit."""
    return max(abs(nominal(system, name)), SIZE)


def central(evaluate, base, values, name):
    """The difference of `evaluate(dynamics)` by a parameter in its size: central, one-sided at a bound."""
    here, step = values.get(name, nominal(base.system, name)), STEP * size(base.system, name)
    ends = []
    for shift in (step, -step):
        try:
            dynamics = changed(base, {**values, name: here + shift})
        except InputError:  # beyond what makes sense
            dynamics, shift = changed(base, values), 0.0
        ends.append((evaluate(dynamics), shift))
    (ahead, above), (behind, below) = ends
    return (ahead - behind) * size(base.system, name) / (above - below)


class OneStep:
    """Accelerations over one control period. Residuals are in rows of transitions, outputs side by side."""

    noise = None  # none is estimated

    def __init__(self, base, data):
        self.base, self.data = base, data
        self.rows = [data.state_names.index(name) for name in base.system.accelerations]
        self.folds = blocks(data.trajectory).repeat_interleave(len(self.rows))

    @torch.no_grad()
    def missed(self, dynamics):
        """The accelerations (N, k) that dynamics miss over a control period."""
        return (self.data.next_state - predict(dynamics, self.data))[:, self.rows] / self.data.dt

    def linearised(self, values, names):
        """What is missed (R,) and the effects (R, p) of the parameters `names` in their sizes, at the given values."""
        left = self.missed(changed(self.base, values))
        spread = left.square().mean(0).sqrt()
        weights = 1 / spread.clamp(min=max(NEGLIGIBLE, 1e-3 * float(spread.max())))
        effects = [-(central(self.missed, self.base, values, name) * weights).flatten() for name in names]
        return (left * weights).flatten(), _columns(effects, left.numel())


class Shooting:
    """Stretches of flight from estimated initial states. Residuals are those of each stretch, apart from its start.

    Raises:
        ValueError: no flight is as long as the shortest stretch.
    """

    def __init__(self, base, data):
        self.base = base
        self.flown = cut(data, LENGTH)
        self.start = self.flown.measured[:, 0]
        self.noise = None  # (d,) of the measured states, in the tangent space
        self.folds = blocks(self.flown.trajectory)

    @torch.no_grad()
    def linearised(self, values, names):
        """See `OneStep`; the initial states are estimated anew for the given values."""
        dynamics = changed(self.base, values)
        for _ in range(SETTLING):
            left, inner = self.flown.missed(dynamics, self.start), self._inner(dynamics)
            if self._estimate_noise(left):
                break
            change = torch.linalg.lstsq(
                inner / self._scale(left), (left / self.noise).flatten(1).unsqueeze(-1)
            ).solution
            self.start = displaced(self.base.system, self.start, change.squeeze(-1))
        basis, _ = torch.linalg.qr(inner / self._scale(left))
        effects = [-central(lambda d: self.flown.missed(d, self.start), self.base, values, name) for name in names]
        rest = [self._apart(part, basis) for part in (left, *effects)]
        return rest[0].flatten(), _columns([part.flatten() for part in rest[1:]], rest[0].numel())

    def _inner(self, dynamics):
        """The effects (M, (T + 1) d, d) of the initial states: central differences, all directions in one batch."""
        dimensions = len(difference(self.base.system, self.start[:1], self.start[:1])[0])
        steps = STEP * torch.eye(dimensions, dtype=self.start.dtype)
        ends = [displaced(self.base.system, self.start, sign * steps[:, None]) for sign in (1, -1)]
        ahead, behind = (self.flown.missed(dynamics, end) for end in ends)  # (d, M, T + 1, d)
        return -((ahead - behind) / (2 * STEP)).flatten(2).permute(1, 2, 0)

    def _estimate_noise(self, left):
        """Take the noise from what is left; whether it is as it was."""
        before, self.noise = self.noise, left.square().mean((0, 1)).sqrt().clamp(min=FLOOR)
        return before is not None and bool(((self.noise - before).abs() < SETTLED * before).all())

    def _scale(self, left):
        return self.noise.repeat(left.shape[1])[:, None]

    def _apart(self, left, basis):
        """What no initial state explains of residuals, in units of the noise: (M, (T + 1) d)."""
        flat = (left / self.noise).flatten(1).unsqueeze(-1)
        return (flat - basis @ (basis.mT @ flat)).squeeze(-1)


def _columns(parts, rows):
    return torch.stack(parts, -1) if parts else torch.zeros(rows, 0, dtype=torch.float64)
