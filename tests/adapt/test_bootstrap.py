"""A bootstrap scatters as much as the fit errs."""

import pytest
import torch

from adapt import collect
from adapt.bootstrap import fit_ensemble, resampled, spread
from adapt.stretches import chains
from envs import make_dynamics
from envs.dynamics import Dynamics
from policies.checkpoints import load_policy


@pytest.fixture(scope="module")
def data():
    policy = load_policy("quadrotor")
    env = make_dynamics("quadrotor", "drag=0.3 noise=1"), policy.task, policy.task.episodes(20, "train", 9)
    return collect(policy.actor(), env, 300, 0.1)


def test_stretches_are_drawn_whole_and_copies_stay_in_one_flight(data):
    drawn = resampled(data, torch.Generator().manual_seed(0))
    assert 0.8 * len(data) < len(drawn) < 1.2 * len(data)
    lengths = {last - first for first, last in chains(drawn)}
    assert lengths == {20}
    known = {tuple(row) for row in torch.cat((data.state, data.action, data.next_state), -1).tolist()}
    rows = [tuple(row) for row in torch.cat((drawn.state, drawn.action, drawn.next_state), -1).tolist()]
    assert set(rows) < known
    flights = {}
    for row, flight in zip(rows, drawn.trajectory.tolist(), strict=True):
        assert flights.setdefault(row, flight) == flight


def test_few_transitions_are_drawn_in_shorter_stretches(data):
    drawn = resampled(data.select(slice(0, 12)), torch.Generator().manual_seed(0))
    assert {last - first for first, last in chains(drawn)} == {2}


def test_members_scatter_about_the_truth_as_their_errors_say(data):
    base = Dynamics(load_policy("quadrotor").task.system)
    members = fit_ensemble(data, base, "parameters", 8, parameters=("drag",))
    values = torch.tensor([float(member.values[0]) for member in members])
    assert len(members) == 8
    assert 0 < float(values.std()) < 0.02
    assert abs(float(values.mean()) - 0.3) < 3 * float(values.std())
    said = float(members[0].errors[0])
    assert said / 4 < float(values.std()) < 4 * said


def test_the_spread_is_that_of_the_predictions(data):
    base = Dynamics(load_policy("quadrotor").task.system)
    members = fit_ensemble(data, base, "parameters", 3, parameters=("drag",))
    state, action = data.state[:50].double(), data.action[:50].double()
    drags = torch.tensor([float(member.values[0]) for member in members], dtype=torch.float64)
    expected = drags.std() * base.dt * state[:, 7:10].abs()  # v' = -drag v
    torch.testing.assert_close(spread(members, state, action)[:, 7:10], expected, rtol=0.1, atol=1e-5)
