"""How far the sensors err that recorded a flight, by what the dynamics that were fitted to it leave of it."""

import torch

from adapt.parameter_losses import Shooting
from envs.errors import InputError

EXACT = 1e-3  # [m, m/s, rad, rad/s] largest noise that is none: no sensors measure velocity and rates so well


@torch.no_grad()
def sensor_noise(dynamics, transitions):
    """Standard deviations (d,) of the measured states in the tangent space, as `envs.dynamics.Sensed` takes them.

    From stretches of flight that the dynamics predict from an estimated first state. What they don't know of the robot
    makes the prediction stray smoothly, while noise jumps from one control period to the next: it is told by second
    differences of what is left (Gasser et al. 1986, Residual variance and residual pattern in nonlinear regression).
    An effect of the actions that the dynamics can't express, such as a lag, jumps as noise does and is counted as such.
    Nothing where states are exact, or no stretch is long enough to tell.
    """
    data = transitions.double()
    try:
        shooting = Shooting(dynamics, data)
        *_, left = shooting.settle(dynamics)
    except (ValueError, InputError):
        return ()
    jumps = left.diff(n=2, dim=1).square().mean((0, 1))
    noise = (jumps / 6).sqrt()  # of white noise of variance 1, second differences have 1 + 4 + 1
    return tuple(noise.tolist()) if noise.isfinite().all() and noise.max() > EXACT else ()
