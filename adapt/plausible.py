"""Whether a record can be in our units: actions within their limits, positions that move as velocities say.

A residual learns from a record in wrong units, too, and a policy that is tuned in it flies well, in the model.
"""

import torch

from adapt.prediction import same_sign
from adapt.stretches import difference
from envs.errors import InputError

BEYOND = 0.5  # share of the transitions with an action beyond its limits that no real flight has
SLACK = 0.01  # [-] beyond a limit that is none
TIMES = 10.0  # as fast, or as slow, as rates of change say: noise and what a model lacks do less
# [m/s, rad/s] root mean square of either, below which noise may be all that moves.
MOVING = {"position": 0.2, "attitude": 0.5}
SURE = 4.0  # standard errors
RATES = {"position": "velocity says", "attitude": "body rates say"}


def check_units(transitions, system):
    """Refuse a record whose numbers can't be in our units.

    Args:
        system: the nominal robot, for how rates of change move it.

    Returns:
        notes, as sentences: that some actions are beyond their limits, if they are.

    Raises:
        InputError: names what doesn't fit, and by how much.
    """
    _check_motion(transitions, system)
    outside = transitions.action.abs() > 1 + SLACK
    rows = int(outside.any(-1).sum())
    if not rows:
        return []
    worst = int(transitions.action.abs().argmax())
    name, value = transitions.action_names[worst % outside.shape[1]], float(transitions.action.flatten()[worst])
    said = f"{rows} of {len(transitions)} have actions beyond [-1, 1], the farthest {name} {value:.3g}"
    if rows > BEYOND * len(transitions):
        raise InputError(f"transitions: {said}: commands, or the limits of the vehicle, are in another unit")
    return [f"{said}; they are kept as they are"]


@torch.no_grad()
def _check_motion(transitions, system):
    """Compare how far the robot moved with how far it does by its rates of change, as recorded."""
    data = transitions.double()
    following = same_sign(data.next_state, data.state, data)
    found, said = (
        difference(system, data.state, states) / data.dt for states in (following, _by_rates(system, data, following))
    )
    for quantity, least in MOVING.items():
        columns = [i for i, one in enumerate(system.quantities) if one == quantity]
        if columns:
            _check_quantity(quantity, found[:, columns], said[:, columns], least)


def _check_quantity(quantity, found, said, least):
    fast, expected = (float(part.square().sum(-1).mean().sqrt()) for part in (found, said))
    if max(fast, expected) > least and not expected / TIMES < fast < expected * TIMES:
        times = f"{fast / max(expected, 1e-12):.3g} times as fast as {RATES[quantity]}"
        raise InputError(f"transitions: {quantity} changes {times}: wrong units, columns or control period")
    likeness = float((found * said).sum() / (found.norm() * said.norm()).clamp(min=1e-12))
    if likeness < -SURE / found.numel() ** 0.5:  # what noise alone may make of it
        raise InputError(
            f"transitions: {quantity} changes the other way than {RATES[quantity]}: wrong signs, axes or columns"
        )


def _by_rates(system, data, following):
    """Where the mean of the rates of change at both ends leads; right for positions and attitudes, see `MOVING`."""
    action = system.Action(*data.action.unbind(-1))
    both = [system.derivative(system.State(*states.unbind(-1)), action) for states in (data.state, following)]
    before, after = (torch.stack(torch.broadcast_tensors(*rates), -1) for rates in both)
    reached = data.state + data.dt * (before + after) / 2
    return torch.stack(tuple(system.project(system.State(*reached.unbind(-1)))), -1)
