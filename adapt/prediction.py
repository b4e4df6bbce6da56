"""How well dynamics predict flights that they have not seen, over one control period and ahead in open loop."""

import torch

from adapt.residual import bound, predict
from envs.errors import InputError


@torch.no_grad()
def acceleration_error(dynamics, transitions):
    """Root mean square of the norm of the acceleration error over one control period [m/s^2]."""
    rows = _rows(transitions, ("vx", "vy", "vz", "u_b", "v_b", "w_b", "v"))
    missed = (predict(dynamics, transitions) - transitions.next_state)[:, rows]
    return float(missed.square().sum(-1).mean().sqrt() / transitions.dt)


@torch.no_grad()
def open_loop_error(dynamics, transitions, seconds=1.0):
    """RMS errors of position [m] and velocity [m/s] after `seconds`, with the recorded actions and no correction.

    Starts at every transition that has as long a recorded future; a context keeps the value it has at the start.

    Raises:
        InputError: when no recorded trajectory is that long.
    """
    steps = max(1, round(seconds / transitions.dt))
    index = torch.arange(len(transitions) - steps + 1)
    whole = transitions.trajectory[index] == transitions.trajectory[index + steps - 1] if len(index) else index.bool()
    starts = index[whole]
    if not len(starts):
        raise InputError(f"validation: no recorded trajectory lasts {seconds:g} s; give longer flights")
    flown = bound(dynamics, transitions.select(starts))
    state = transitions.state[starts]
    for k in range(steps):
        state = flown(state, transitions.action[starts + k])
    missed = state - transitions.next_state[starts + steps - 1]
    groups = {"position": ("px", "py", "pz", "x"), "velocity": ("vx", "vy", "vz", "u_b", "v_b", "w_b", "v")}
    return {name: float(missed[:, _rows(transitions, g)].square().sum(-1).mean().sqrt()) for name, g in groups.items()}


def prediction_report(dynamics, transitions):
    """The figures of both kinds, as the report on a recorded flight gives them."""
    ahead = open_loop_error(dynamics, transitions)
    return {
        "acceleration": acceleration_error(dynamics, transitions),
        "position_1s": ahead["position"],
        "velocity_1s": ahead["velocity"],
    }


def _rows(transitions, names):
    return [i for i, name in enumerate(transitions.state_names) if name in names]
