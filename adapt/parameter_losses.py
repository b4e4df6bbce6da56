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

from adapt.parameter_residual import nominal
from adapt.prediction import predict
from adapt.sensitivities import apart, of_kicks, of_start, step_slopes
from adapt.sparse_ridge import blocks
from adapt.stretches import cut, difference, displaced
from adapt.variants import Variants
from envs.errors import InputError

STEP = 1e-4  # [-] of a parameter's size, for central differences
SIZE = 0.1  # smallest size that a parameter is taken to have, in its own unit
NEGLIGIBLE = 1e-4  # [m/s^2, rad/s^2] what needs no explanation
LENGTH = 10  # control periods of a stretch
SETTLING = 10  # most Gauss-Newton steps of the initial states after a change of the parameters
SETTLED = 1e-3  # [-] change of the estimated noise at which they have settled
FLOOR = 1e-6  # [m, m/s, rad, rad/s] smallest noise that a state is taken to have


def size(system, name):
    """The size of a parameter, in its unit."""
    return max(abs(nominal(system, name)), SIZE)


def central(evaluate, variants, values, name):
    """The difference of `evaluate(dynamics)` by a parameter in its size: central, one-sided at a bound."""
    system = variants.base.system
    here, step = values.get(name, nominal(system, name)), STEP * size(system, name)
    ends = []
    for shift in (step, -step):
        try:
            dynamics = variants({**values, name: here + shift})
        except InputError:  # beyond what makes sense
            dynamics, shift = variants(values), 0.0
        ends.append((evaluate(dynamics), shift))
    (ahead, above), (behind, below) = ends
    return (ahead - behind) * size(system, name) / (above - below)


def least_squares(effects, left):
    """The changes (…, p, c) whose effects (…, R, p) come closest to `left` (…, R, c), of these the smallest."""
    # not torch's default, gelsy: it reads memory that it hasn't set, so results, even ranks, differ from run to run
    # (https://github.com/pytorch/pytorch/issues/187411)
    return torch.linalg.lstsq(effects, left, driver="gelsd").solution


class OneStep:
    """Accelerations over one control period. Residuals are in rows of transitions, outputs side by side."""

    noise = None  # none is estimated
    spent, repeated = 0, 1.0  # residuals that estimated states take up, and how often each transition is counted

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
        variants = Variants(self.base)
        left = self.missed(variants(values))
        spread = left.square().mean(0).sqrt()
        weights = 1 / spread.clamp(min=max(NEGLIGIBLE, 1e-3 * float(spread.max())))
        effects = [-(central(self.missed, variants, values, name) * weights).flatten() for name in names]
        return (left * weights).flatten(), torch.stack(effects, -1) if names else left.new_zeros(left.numel(), 0)


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
        self.spent = difference(base.system, self.start, self.start).numel()
        self.repeated = self.flown.repeated

    @torch.no_grad()
    def linearised(self, values, names):
        """See `OneStep`; the initial states are estimated anew for the given values.

        Raises:
            InputError: states or values from which no flight can be predicted.
        """
        variants = Variants(self.base)
        path, slopes, inner, left = self.settle(variants(values))
        parts = torch.cat((left[..., None], of_kicks(slopes, self._kicks(path, variants, values, names))), -1)
        rest = apart(self._scaled(parts), self._scaled(inner)).flatten(0, 1)
        return rest[:, 0], rest[:, 1:]

    def settle(self, dynamics):
        """Estimate the initial states and the noise.

        Returns:
            the path (M, T + 1, n), the slopes of its steps and of its states by the first, and what is missed.
        """
        system, path = self.base.system, self.flown.predicted(dynamics, self.start)
        slopes = step_slopes(dynamics, path[:, :-1], self.flown.action)
        inner = of_start(slopes)
        for _ in range(SETTLING):
            left = self.flown.missed(system, path)
            if self._estimate_noise(left):
                break
            if not left.isfinite().all() or not inner.isfinite().all():  # LAPACK fails on them
                raise InputError("transitions: no flight can be predicted from such states; remove what isn't flight")
            change = least_squares(self._scaled(inner), self._scaled(left[..., None]))
            self.start = displaced(system, self.start, change.squeeze(-1))
            path = self.flown.predicted(dynamics, self.start)
        return path, slopes, inner, left

    def _kicks(self, path, variants, values, names):
        """What a change of each parameter, in its size, adds to every step of the path: (M, T, d, p)."""
        before, after = path[:, :-1], path[:, 1:]

        def step(dynamics):
            return difference(dynamics.system, after, dynamics(before, self.flown.action))

        kicks = [central(step, variants, values, name) for name in names]
        return torch.stack(kicks, -1) if names else before.new_zeros(*before.shape[:2], len(self.noise), 0)

    def _estimate_noise(self, left):
        """Take the noise from what is left; whether it is as it was."""
        before, self.noise = self.noise, left.square().mean((0, 1)).sqrt().clamp(min=FLOOR)
        return before is not None and bool(((self.noise - before).abs() < SETTLED * before).all())

    def _scaled(self, parts):
        """Changes (M, T + 1, d, c) in units of the noise, as the rows (M, (T + 1) d, c) of each stretch."""
        return (parts / self.noise[:, None]).flatten(1, 2)
