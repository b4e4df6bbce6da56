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
# [m/s, rad/s] speed, or what rates say of it, below which noise may be all that moves.
MOVING = {"position": 0.2, "attitude": 0.5}
SURE = 4.0  # standard errors
RATES = {"position": "velocity says", "attitude": "body rates say"}


def check_units(transitions, system):
    """Refuse a record whose numbers can't be in our units.

    Args:
        system: the nominal robot, for how rates of change move it.

    Returns:
        notes, as sentences: what is odd, but may be so.

    Raises:
        InputError: names what doesn't fit, and by how much.
    """
    return [*_check_motion(transitions, system), *_check_actions(transitions)]


def _check_actions(transitions):
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
    notes = []
    for quantity in MOVING:
        columns = [i for i, one in enumerate(system.quantities) if one == quantity]
        if columns:
            _check_speed(quantity, found[:, columns], said[:, columns])
            notes += _check_direction(quantity, found[:, columns], said[:, columns])
    return notes


def _check_speed(quantity, found, said):
    fast, expected = (float(part.norm(dim=-1).median()) for part in (found, said))  # a crash has some absurd rows
    if max(fast, expected) > MOVING[quantity] and not expected / TIMES < fast < expected * TIMES:
        times = f"{fast / max(expected, 1e-12):.3g} times as fast as {RATES[quantity]}"
        raise InputError(f"transitions: {quantity} changes {times}: wrong units, columns or control period")


def _check_direction(quantity, found, said):
    cosines = torch.nn.functional.cosine_similarity(found, said, dim=-1)
    if cosines.mean() > -SURE / found.numel() ** 0.5:  # chance makes this of noise
        return []
    against = f"{quantity} changes the other way than {RATES[quantity]}: wrong signs, axes or columns"
    if quantity == "attitude":  # which a robot out of control may turn to and fro in one control period
        return [f"{against}, unless it shakes"]
    raise InputError(f"transitions: {against}")


def _by_rates(system, data, following):
    """Where the mean of the rates of change at both ends leads; right for what has its rates among the states."""
    action = system.Action(*data.action.unbind(-1))
    both = [system.derivative(system.State(*states.unbind(-1)), action) for states in (data.state, following)]
    before, after = (torch.stack(torch.broadcast_tensors(*rates), -1) for rates in both)
    reached = data.state + data.dt * (before + after) / 2
    return torch.stack(tuple(system.project(system.State(*reached.unbind(-1)))), -1)
