"""What small changes of a flight's beginning, and small kicks on its way, make of the rest of it: to first order.

Shapes: M stretches of T control periods, n states, d directions of the tangent space, c changes.
"""

import torch

from adapt.stretches import difference, displaced

STEP = 1e-4  # of a state, for central differences


def step_slopes(dynamics, states, action):
    """Derivative (…, d, d) of the next state by the state (…, n), in the tangent space, by central differences."""
    system = dynamics.system
    d = difference(system, states, states).shape[-1]
    shifts = STEP * torch.eye(d, dtype=states.dtype)
    ahead, behind = (
        dynamics(displaced(system, states.unsqueeze(-2), sign * shifts), action.unsqueeze(-2)) for sign in (1, -1)
    )
    return (difference(system, behind, ahead) / (2 * STEP)).mT


def of_start(slopes):
    """What a change of the first state in each direction becomes: (M, T + 1, d, d) from slopes (M, T, d, d)."""
    found = [torch.eye(slopes.shape[-1], dtype=slopes.dtype).expand_as(slopes[:, 0])]
    for slope in slopes.unbind(1):
        found.append(slope @ found[-1])
    return torch.stack(found, 1)


def of_kicks(slopes, kicks):
    """What a kick in every step (M, T, d, c) becomes: (M, T + 1, d, c), nothing at the start."""
    found = [torch.zeros_like(kicks[:, 0])]
    for slope, kick in zip(slopes.unbind(1), kicks.unbind(1), strict=True):
        found.append(slope @ found[-1] + kick)
    return torch.stack(found, 1)


def apart(vectors, basis):
    """The part of the columns of `vectors` (…, R, c) that no combination of the columns of `basis` (…, R, b) makes."""
    if not basis.shape[-1]:
        return vectors
    q, _ = torch.linalg.qr(basis)
    return vectors - q @ (q.mT @ vectors)
