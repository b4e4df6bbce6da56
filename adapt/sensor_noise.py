"""How far the sensors err that recorded a flight: what the dynamics that were fitted to it leave of it."""

import torch

from adapt.parameter_losses import Shooting
from envs.errors import InputError

EXACT = 1e-4  # [m, m/s, rad, rad/s] noise that is none


@torch.no_grad()
def sensor_noise(dynamics, transitions):
    """Standard deviations (d,) of the measured states in the tangent space, as `envs.dynamics.Sensed` takes them.

    From stretches of flight that the dynamics predict from an estimated first state. What they don't know of the robot
    counts as noise, too. Nothing where states are exact, or no stretch is long enough to tell.
    """
    data = transitions.double()
    try:
        shooting = Shooting(dynamics, data)
        shooting.settle(dynamics)
    except (ValueError, InputError):
        return ()
    known = shooting.noise.isfinite().all() and shooting.noise.max() > EXACT
    return tuple(shooting.noise.tolist()) if known else ()
