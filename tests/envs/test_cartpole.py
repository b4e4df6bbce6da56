"""Mechanics of a cart with a uniform rod, for default and other parameters."""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd.functional import jacobian, jvp

from envs import Dynamics
from envs.cartpole import FRICTION_SPEED, CartPole


@pytest.fixture(params=[None, 1, 2], ids=str)
def cartpole(request, vary):
    return CartPole() if request.param is None else vary(CartPole(), request.param)


@pytest.fixture
def frictionless(cartpole):
    return replace(cartpole, track_friction=0.0, hinge_friction=0.0)


def energy(system, state):
    """Kinetic and potential energy [J] of the cart and a uniform rod of length 2 l, hinged at its end."""
    _, v, theta, omega = state.unbind(-1)
    m, length = system.pole_mass, system.pole_half_length
    centre = (v + length * omega * theta.cos()) ** 2 + (length * omega * theta.sin()) ** 2
    spin = m * (2 * length) ** 2 / 12 * omega**2
    return (system.cart_mass * v**2 + m * centre + spin) / 2 + m * system.gravity * length * theta.cos()


def momentum(system, state):
    """Momentum [kg m/s] of cart and rod along the rail."""
    _, v, theta, omega = state.unbind(-1)
    return system.cart_mass * v + system.pole_mass * (v + system.pole_half_length * omega * theta.cos())


def rail_friction(system, state, rates):
    """Coulomb friction [N]: the coefficient times the load on the rail, which the moving rod changes."""
    _, v, theta, omega = state.unbind(-1)
    lift = -system.pole_half_length * (rates[..., 3] * theta.sin() + omega**2 * theta.cos())  # of the rod's centre
    load = (system.cart_mass + system.pole_mass) * system.gravity + system.pole_mass * lift
    return system.track_friction * (v / FRICTION_SPEED).tanh() * load


def test_the_energy_changes_by_the_power_of_the_force_less_that_of_both_frictions(cartpole, draw, derivative):
    rubbing = replace(cartpole, track_friction=0.2, hinge_friction=0.05)
    state, action = draw(rubbing, 50)
    rates = derivative(rubbing, state, action)
    _, power = jvp(lambda s: energy(rubbing, s), (state,), (rates,))
    force = rubbing.force_limit * action[:, 0] - rail_friction(rubbing, state, rates)
    torch.testing.assert_close(power, force * state[:, 1] - rubbing.hinge_friction * state[:, 3] ** 2)


def test_the_momentum_along_the_rail_changes_by_the_force_less_the_friction(cartpole, draw, derivative):
    rubbing = replace(cartpole, track_friction=0.2, hinge_friction=0.05)
    state, action = draw(rubbing, 50)
    rates = derivative(rubbing, state, action)
    _, change = jvp(lambda s: momentum(rubbing, s), (state,), (rates,))
    force = rubbing.force_limit * action[:, 0] - rail_friction(rubbing, state, rates)
    torch.testing.assert_close(change, force)


def test_the_momentum_gained_in_one_period_is_force_times_time(frictionless, draw):
    state, action = draw(frictionless, 20)
    gained = momentum(frictionless, Dynamics(frictionless, substeps=20)(state, action)) - momentum(frictionless, state)
    torch.testing.assert_close(gained, frictionless.force_limit * action[:, 0] * frictionless.dt, atol=1e-7, rtol=1e-7)


def test_energy_is_conserved_without_friction_and_force(frictionless, draw):
    state, action = draw(frictionless, 10)
    before, dynamics = energy(frictionless, state), Dynamics(frictionless, substeps=10)
    for _ in range(40):
        state = dynamics(state, 0 * action)
    torch.testing.assert_close(energy(frictionless, state), before, atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("friction", ["track_friction", "hinge_friction"])
def test_friction_only_takes_energy_out(frictionless, draw, friction):
    rubbing = replace(frictionless, **{friction: 0.05})
    state, action = draw(rubbing, 10)
    dynamics = Dynamics(rubbing, substeps=20)
    for _ in range(10):
        before, state = energy(rubbing, state), dynamics(state, 0 * action)
        assert (energy(rubbing, state) < before).all()


def rate_of_falling(system):
    """sqrt(g / (l (4/3 - m / (M + m)))) [1/s], of the pole on a free cart."""
    share = system.pole_mass / (system.cart_mass + system.pole_mass)
    return math.sqrt(system.gravity / (system.pole_half_length * (4 / 3 - share)))


def linearised(system, derivative, theta):
    state, action = torch.tensor([0.0, 0.0, theta, 0.0], dtype=torch.float64), torch.zeros(1).double()
    return torch.linalg.eigvals(jacobian(lambda s: derivative(system, s, action), state))


def test_the_upright_pole_falls_at_the_rate_of_the_closed_form(frictionless, derivative):
    eigenvalues = linearised(frictionless, derivative, 0.0).real.sort().values
    rate = rate_of_falling(frictionless)
    assert eigenvalues.tolist() == pytest.approx([-rate, 0, 0, rate], abs=1e-9)


def test_the_hanging_pole_swings_at_the_frequency_of_the_closed_form(frictionless):
    frequency, swing = rate_of_falling(frictionless), 1e-4
    state = torch.tensor([0.0, 0.0, math.pi + swing, 0.0], dtype=torch.float64)
    dynamics = Dynamics(frictionless, substeps=20)
    for k in range(1, 41):
        state = dynamics(state, torch.zeros(1).double())
        expected = math.pi + swing * math.cos(frequency * k * frictionless.dt)
        assert state[2].item() == pytest.approx(expected, abs=1e-3 * swing)


def test_an_external_force_does_what_the_same_force_does_as_an_action(cartpole, draw, derivative, scalars):
    rubbing = replace(cartpole, track_friction=0.2)
    state, action = draw(rubbing, 20)
    acceleration = torch.linspace(-3, 3, 20).double()
    extra = acceleration.unsqueeze(-1) * (rubbing.cart_mass + rubbing.pole_mass) / rubbing.force_limit
    difference = derivative(rubbing, state, action + extra) - derivative(rubbing, state, action)
    added = rubbing.accelerate(scalars(rubbing, state), (acceleration, acceleration, acceleration))
    assert set(added) == {"v", "omega"}
    torch.testing.assert_close(torch.stack((added["v"], added["omega"]), -1), difference[:, [1, 3]])


def test_only_the_part_of_a_force_along_the_rail_moves_anything(cartpole, draw, scalars):
    x = scalars(cartpole, draw(cartpole, 5)[0])
    added = cartpole.accelerate(x, (0 * x.v, 1 + 0 * x.v, 1 + 0 * x.v))
    assert all(rate.abs().max() == 0 for rate in added.values())
