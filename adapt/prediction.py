"""How well dynamics predict what was recorded, over one control period and ahead in open loop."""

import torch

from adapt.residual_dynamics import ResidualDynamics
from adapt.transitions import QUATERNION
from envs.errors import InputError

# Rows of the state by what they measure: prediction errors are reported for each group that a system has.
GROUPS = {
    "position": ("px", "py", "pz", "x"),
    "velocity": ("vx", "vy", "vz", "u_b", "v_b", "w_b", "v"),
    "attitude": (*QUATERNION, "theta"),
    "rates": ("p", "q", "r", "omega"),
}


@torch.no_grad()
def prediction_error(dynamics, transitions):
    """One-step errors of dynamics: root mean square of the norm of each group of rows in `GROUPS` that the system has.

    position [m], velocity [m/s], attitude [- for quaternions, else rad], rates [rad/s], and `acceleration` [m/s^2] and
    `angular_acceleration` [rad/s^2], the errors of velocity and rates over the control period.
    """
    difference = predict(dynamics, transitions) - transitions.next_state
    names = transitions.state_names
    errors = {}
    for group, members in GROUPS.items():
        if rows := [i for i, name in enumerate(names) if name in members]:
            errors[group] = float(difference[:, rows].square().sum(-1).mean().sqrt())
    for rate, group in (("acceleration", "velocity"), ("angular_acceleration", "rates")):
        if group in errors:
            errors[rate] = errors[group] / transitions.dt
    return errors


def predict(dynamics, transitions):
    """Next states (N, n) that dynamics predict; a quaternion has the sign of the recorded one."""
    following = bound(dynamics, transitions)(transitions.state, transitions.action)
    if set(QUATERNION) <= set(transitions.state_names):
        columns = [transitions.state_names.index(name) for name in QUATERNION]
        agrees = (following[:, columns] * transitions.next_state[:, columns]).sum(-1, keepdim=True) >= 0
        sign = torch.ones_like(following)
        sign[:, columns] = torch.where(agrees, 1.0, -1.0).to(following).expand(-1, 4)
        following = following * sign
    return following


def bound(dynamics, transitions):
    """Dynamics that see the context of the transitions, row by row, if they take any."""
    if isinstance(dynamics, ResidualDynamics) and dynamics.config.context_names:
        return dynamics.with_context(transitions.context)
    return dynamics


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
