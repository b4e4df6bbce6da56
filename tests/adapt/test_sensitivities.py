"""First-order changes of a flight agree with flights that really were changed a little."""

import pytest
import torch

from adapt import collect
from adapt.sensitivities import apart, of_kicks, of_start, step_slopes
from adapt.stretches import cut, difference, displaced
from envs import make_dynamics
from policies.checkpoints import load_policy

LITTLE = 1e-5


@pytest.fixture(params=["cartpole", "quadrotor", "fixed_wing"])
def flight(request):
    policy, dynamics = load_policy(request.param), make_dynamics(request.param)
    task = policy.task
    data = collect(policy.actor(), (dynamics, task, task.episodes(5, "train", 9)), 24)
    cuts = cut(data, 8)
    path = cuts.predicted(dynamics, cuts.measured[:, 0].double())
    return dynamics, cuts, path, step_slopes(dynamics, path[:, :-1], cuts.action.double())


def test_a_change_of_the_start_arrives_where_a_changed_flight_arrives(flight):
    dynamics, cuts, path, slopes = flight
    change = LITTLE * torch.randn(slopes.shape[-1], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    other = cuts.predicted(dynamics, displaced(dynamics.system, path[:, 0], change))
    expected = difference(dynamics.system, path, other)
    torch.testing.assert_close(of_start(slopes) @ change, expected, rtol=1e-3, atol=1e-3 * LITTLE)


def test_kicks_on_the_way_add_up_to_a_flight_with_those_kicks(flight):
    dynamics, cuts, path, slopes = flight
    generator = torch.Generator().manual_seed(1)
    kicks = LITTLE * torch.randn(*slopes.shape[:3], generator=generator, dtype=torch.float64)
    states = [path[:, 0]]
    for kick, action in zip(kicks.unbind(1), cuts.action.unbind(1), strict=True):
        states.append(displaced(dynamics.system, dynamics(states[-1], action), kick))
    expected = difference(dynamics.system, path, torch.stack(states, 1))
    found = of_kicks(slopes, kicks[..., None])[..., 0]
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=2e-3 * LITTLE)


def test_what_is_left_apart_from_a_basis_is_orthogonal_to_it_and_the_rest_is_in_it():
    generator = torch.Generator().manual_seed(2)
    vectors, basis = (torch.randn(4, 9, c, generator=generator, dtype=torch.float64) for c in (3, 2))
    left = apart(vectors, basis)
    assert (basis.mT @ left).abs().max() < 1e-12
    both = torch.cat((basis, vectors - left), -1)
    assert torch.linalg.matrix_rank(both).tolist() == [2, 2, 2, 2]
    assert apart(vectors, basis[..., :0]) is vectors
