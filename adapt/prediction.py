"""How well dynamics predict what was recorded, over one control period and ahead in open loop."""

from dataclasses import replace

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
    return same_sign(following, transitions.next_state, transitions)


def same_sign(states, like, transitions):
    """States (N, n) whose quaternions, of which q and -q are the same attitude, have the sign of those in `like`."""
    if not set(QUATERNION) <= set(transitions.state_names):
        return states
    columns = [transitions.state_names.index(name) for name in QUATERNION]
    agrees = (states[:, columns] * like[:, columns]).sum(-1, keepdim=True) >= 0
    sign = torch.ones_like(states)
    sign[:, columns] = torch.where(agrees, 1.0, -1.0).to(states).expand(-1, 4)
    return states * sign


def bound(dynamics, transitions):
    """Dynamics that see the context of the transitions, row by row, if they take any."""
    if not isinstance(dynamics, ResidualDynamics) or not dynamics.config.context_names:
        return dynamics
    if transitions.context_names != dynamics.config.context_names:
        wanted, found = ", ".join(dynamics.config.context_names), ", ".join(transitions.context_names) or "none"
        raise InputError(f"transitions: the residual sees the context {wanted}, these have {found}")
    return dynamics.with_context(transitions.context)


@torch.no_grad()
def acceleration_error(dynamics, transitions):
    """Root mean square of the norm of the acceleration error over one control period [m/s^2]."""
    return prediction_error(dynamics, transitions)["acceleration"]


@torch.no_grad()
def open_loop_error(dynamics, transitions, seconds=1.0):
    """RMS errors of position [m] and velocity [m/s] after `seconds`, with the recorded actions and no correction.

    Starts at every transition that has as long a recorded future; a context keeps the value it has at the start.

    Raises:
        InputError: when no recorded trajectory is that long.
    """
    steps = max(1, round(seconds / transitions.dt))
    starts = _unbroken(transitions, steps)
    if not len(starts):
        raise InputError(f"validation: no recorded trajectory lasts {seconds:g} s; give longer flights")
    flown = bound(dynamics, transitions.select(starts))
    state = transitions.state[starts]
    for k in range(steps):
        state = flown(state, transitions.action[starts + k])
    missed = state - transitions.next_state[starts + steps - 1]
    rows = {name: [i for i, row in enumerate(transitions.state_names) if row in GROUPS[name]] for name in GROUPS}
    return {name: float(missed[:, rows[name]].square().sum(-1).mean().sqrt()) for name in ("position", "velocity")}


def _unbroken(transitions, steps):
    """The rows that `steps` transitions follow from, each beginning where the one before ended."""
    joined = (transitions.next_state[:-1] == transitions.state[1:]).all(-1)
    joined &= transitions.trajectory[:-1] == transitions.trajectory[1:]
    if len(joined) < steps - 1:
        return torch.zeros(0, dtype=torch.long)
    return (joined.unfold(0, steps - 1, 1).all(-1) if steps > 1 else joined.new_ones(len(transitions))).nonzero()[:, 0]


def prediction_report(dynamics, transitions, context=None):
    """The figures of both kinds, as the report on a recorded flight gives them.

    `context` (c), such as the mean that a policy is tuned with, stands in for the recorded one.
    """
    if context is not None:
        transitions = replace(transitions, context=context.expand(len(transitions), -1))
    ahead = open_loop_error(dynamics, transitions)
    return {
        "acceleration": acceleration_error(dynamics, transitions),
        "position_1s": ahead["position"],
        "velocity_1s": ahead["velocity"],
    }
