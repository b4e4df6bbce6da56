"""What holds for one control period of every robot: integration, gradients, torch and CasADi alike."""

from dataclasses import replace

import pytest
import torch

from envs import SYSTEMS, Dynamics, InputError, make_dynamics

TARGETS = ("", "drag=0.3", "quadratic_drag=0.1 push=0.5,0.1,-0.3", "wind=2 mass=x1.2", "gravity=x0.9 drag=1")


def median_order(system, draw, integrator, substeps):
    """Median over states of log2 of the error ratio when the step is halved."""
    state, action = draw(system, 40)
    exact = Dynamics(system, substeps=100)(state, action)
    coarse, fine = (
        (Dynamics(system, integrator=integrator, substeps=n)(state, action) - exact).norm(dim=-1)
        for n in (substeps, 2 * substeps)
    )
    return (coarse / fine).log2().median().item()


@pytest.mark.parametrize(("integrator", "order", "substeps"), [("euler", 1, 20), ("rk4", 4, 16)])
def test_the_error_of_an_integrator_falls_with_its_order(robot, draw, integrator, order, substeps):
    assert median_order(robot, draw, integrator, substeps) == pytest.approx(order, abs=0.35)


def test_runge_kutta_is_the_default(robot, draw):
    state, action = draw(robot, 3)
    assert torch.equal(Dynamics(robot)(state, action), Dynamics(robot, integrator="rk4")(state, action))


def test_euler_goes_along_the_derivative(robot, draw, derivative):
    state, action = draw(robot, 10)
    line = state + robot.dt * derivative(robot, state, action)
    projected = torch.stack(tuple(robot.project(robot.State(*line.unbind(-1)))), -1)
    torch.testing.assert_close(Dynamics(robot, integrator="euler")(state, action), projected)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_substeps_are_steps_of_a_part_of_the_period(integrator, draw):
    cartpole = SYSTEMS["cartpole"][0]()  # nothing is put back on a manifold between its steps
    state, action = draw(cartpole, 5)
    short = Dynamics(replace(cartpole, dt=cartpole.dt / 4), integrator=integrator)
    expected = state
    for _ in range(4):
        expected = short(expected, action)
    torch.testing.assert_close(Dynamics(cartpole, integrator=integrator, substeps=4)(state, action), expected)


def test_quaternions_have_norm_one_after_any_step(robot, draw):
    fields = robot.State._fields
    at = [i for i, name in enumerate(fields) if name in ("qw", "qx", "qy", "qz")]
    state, action = draw(robot, 20)
    rates = [i for i, name in enumerate(fields) if name in ("p", "q", "r")]
    state[:, rates] *= 5
    for integrator in ("euler", "rk4"):
        following = Dynamics(robot, integrator=integrator)(state, 5 * action)
        torch.testing.assert_close(following[:, at].norm(dim=-1), torch.full((20,), float(bool(at))).double())


def test_nothing_depends_on_where_the_robot_is(robot, draw, scalars):
    state, action = draw(robot, 10)
    moved, place = state.clone(), [i for i, name in enumerate(robot.State._fields) if name in ("x", "px", "py", "pz")]
    moved[:, place] += torch.tensor([3.0, -7.0, 11.0][: len(place)], dtype=torch.float64)
    dynamics = make_dynamics(robot, "drag=0.3 push=1")
    difference = dynamics(moved, action) - dynamics(state, action)
    torch.testing.assert_close(difference, moved - state)
    here, there = (tuple(robot.residual_inputs(*scalars(robot, s, action))) for s in (state, moved))
    torch.testing.assert_close(torch.stack(here), torch.stack(there))


def test_velocity_is_the_rate_of_the_position(robot, draw, derivative, scalars):
    state, action = draw(robot, 10)
    rates = derivative(robot, state, action)
    place = [i for i, name in enumerate(robot.State._fields) if name in ("x", "px", "py", "pz")]
    velocity = torch.stack(robot.velocity(scalars(robot, state)), -1)
    torch.testing.assert_close(velocity[:, : len(place)], rates[:, place])


def test_a_residual_has_one_rate_for_each_acceleration(robot, draw, scalars):
    state, _ = draw(robot, 4)
    residual = tuple(torch.ones(4, dtype=torch.float64) for _ in robot.accelerations)
    assert set(robot.residual_rates(scalars(robot, state), residual)) == set(robot.accelerations)


def test_a_push_of_the_period_adds_to_the_derivative(robot, draw):
    """What the residual uses: constant extra rates by state name."""
    state, action = draw(robot, 10)
    name, dynamics = robot.accelerations[-1], Dynamics(robot, integrator="euler")
    added = dynamics.advance(state, action, push={name: 0.7}) - dynamics(state, action)
    expected = torch.zeros_like(state)
    expected[:, robot.State._fields.index(name)] = 0.7 * robot.dt
    torch.testing.assert_close(added, expected)


def test_any_batch_shape_gives_the_same_as_one_at_a_time(robot, draw):
    state, action = draw(robot, 6)
    dynamics = Dynamics(robot)
    expected = torch.stack([dynamics(s, a) for s, a in zip(state, action, strict=True)])
    torch.testing.assert_close(dynamics(state, action), expected)
    torch.testing.assert_close(dynamics(state.reshape(2, 3, -1), action.reshape(2, 3, -1)), expected.reshape(2, 3, -1))
    one = dynamics(state[0], action)
    torch.testing.assert_close(one, dynamics(state[:1].expand(6, -1), action))


@pytest.mark.parametrize(
    ("target", "integrator", "substeps"), [*((target, "rk4", 1) for target in TARGETS), ("drag=0.3", "euler", 2)]
)
def test_casadi_steps_as_torch_does(robot, draw, target, integrator, substeps):
    state, action = draw(robot, 10)
    dynamics = make_dynamics(robot, target, integrator, substeps)
    function = dynamics.casadi()
    assert (function.name_in(), function.name_out()) == (["state", "action"], ["next_state"])
    twin = torch.from_numpy(function(state.T.numpy(), action.T.numpy()).full()).T
    torch.testing.assert_close(dynamics(state, action), twin, atol=1e-12, rtol=1e-11)


@pytest.mark.parametrize("target", ["", "drag=0.3"], ids=["source", "drag"])
def test_the_gradient_of_a_step_is_that_of_finite_differences(robot, draw, target):
    state, action = draw(robot, 1)
    dynamics = make_dynamics(robot, target)
    assert torch.autograd.gradcheck(dynamics, (state.requires_grad_(), action.requires_grad_()))


@pytest.mark.parametrize("target", TARGETS[:3])
def test_the_gradient_of_a_cost_through_ten_steps_is_that_of_finite_differences(robot, draw, target):
    """Along random directions of the starts and the actions together."""
    dynamics, task = make_dynamics(robot, target), SYSTEMS[robot.name][1](system=robot)
    start, _ = draw(robot, 3)
    actions = 0.3 * draw(robot, 30)[1].unflatten(0, (10, 3))
    goal = 0.5 * torch.ones(3, len(task.reference_names), dtype=torch.float64)

    def cost(start, actions):
        state, total = start, 0
        for action in actions:
            state = dynamics(state, action)
            total = total + task.cost(state, action, goal)
        return total.sum()

    inputs = (start.requires_grad_(), actions.requires_grad_())
    gradients = torch.autograd.grad(cost(*inputs), inputs)
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        direction = [torch.randn(v.shape, generator=generator, dtype=v.dtype) for v in inputs]
        with torch.no_grad():
            step = 1e-5
            ahead, behind = (cost(start + h * direction[0], actions + h * direction[1]) for h in (step, -step))
        slope = sum((g * d).sum() for g, d in zip(gradients, direction, strict=True))
        torch.testing.assert_close(slope, (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("target", TARGETS[:3])
def test_single_precision_stays_so_and_is_close(robot, draw, target):
    state, action = draw(robot, 10)
    dynamics = make_dynamics(robot, target)
    single = dynamics(state.float(), action.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), dynamics(state, action), rtol=1e-4, atol=1e-4)


def test_a_wrong_integrator_or_number_of_substeps_is_refused():
    with pytest.raises(InputError, match="integrator 'midpoint': expected one of euler, rk4"):
        make_dynamics("cartpole", integrator="midpoint")
    with pytest.raises(InputError, match="substeps is 0, expected at least 1"):
        make_dynamics("cartpole", substeps=0)


def test_the_trim_action_has_one_number_for_each_action(robot):
    assert len(robot.trim_action) == len(robot.Action._fields)
    assert all(isinstance(value, float) for value in robot.trim_action)
