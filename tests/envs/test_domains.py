"""Every disturbance and every parameter as a target, and what drag, wind and a push do to a flight."""

import math
from dataclasses import fields, replace

import pytest
import torch

from envs import SYSTEMS, Domain, Dynamics, InputError, make_dynamics, make_env, make_system, parse_target
from envs.domains import DISTURBANCES, SCALAR, WIND_DRAG
from envs.quadrotor import Quadrotor

HOVERING = torch.tensor([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
HOVER = torch.tensor(Quadrotor().trim_action, dtype=torch.float64)


def parameters(system):
    """Names of the numbers that make up a robot, and of its groups of them."""
    numbers = [f.name for f in fields(system) if isinstance(getattr(system, f.name), float) and f.name != "dt"]
    return [*numbers, *system.groups]


def every(what):
    """(system, name) for each disturbance or parameter of each system."""
    return [(name, entry) for name in SYSTEMS for entry in what(make_system(name))]


def check_that_it_matters(system, target, nothing, draw):
    """`target` changes the next state in torch and in CasADi by the same, `nothing` doesn't."""
    state, action = draw(system, 16)
    source, same = Dynamics(system), make_dynamics(system, nothing)
    torch.testing.assert_close(same(state, action), source(state, action), atol=1e-14, rtol=0)
    changed = make_dynamics(system, target)
    difference = changed(state, action) - source(state, action)
    assert difference.abs().max() > 1e-9

    def twin(dynamics):
        return torch.from_numpy(dynamics.casadi()(state.T.numpy(), action.T.numpy()).full()).T

    torch.testing.assert_close(twin(changed) - twin(source), difference, atol=1e-12, rtol=0)
    torch.testing.assert_close(twin(same), twin(source), atol=1e-14, rtol=0)


@pytest.mark.parametrize(("system", "name"), every(parameters))
def test_every_parameter_matters_and_left_as_it_is_it_does_not(system, name, draw):
    system = make_system(system)
    if getattr(system, name, 1.0) == 0:
        check_that_it_matters(system, f"{name}=0.1", f"{name}=0", draw)
    else:
        check_that_it_matters(system, f"{name}=x1.1", f"{name}=x1", draw)


@pytest.mark.parametrize(("system", "name"), every(lambda system: DISTURBANCES))
def test_every_disturbance_matters_and_vanishes_at_zero_strength(system, name, draw):
    """Given as a `Domain`: a fixed wing has its own parameter `wind`, which text means there."""
    system = make_system(system)
    strong, zero = (Domain(disturbances=((name, strength),)) for strength in ((0.3, 0.0, 0.0), (0.0, 0.0, 0.0)))
    check_that_it_matters(system, strong, zero, draw)


@pytest.mark.parametrize(("system", "name"), every(lambda system: sorted(set(DISTURBANCES) - set(parameters(system)))))
def test_every_disturbance_can_be_written_as_text(system, name):
    assert parse_target(f"{name}=0.3", make_system(system)).disturbances == ((name, (0.3, 0.0, 0.0)),)


def test_the_empty_target_is_the_source(robot, draw):
    state, action = draw(robot, 5)
    assert parse_target("", robot) == Domain()
    assert torch.equal(make_dynamics(robot)(state, action), Dynamics(robot)(state, action))


def along(system, state, action, target, scalars):
    """Extra acceleration over ground (n, 3) that a target gives, from a short Euler step."""
    short = replace(system, dt=1e-6)
    source, changed = (make_dynamics(short, t, "euler")(state, action) for t in ("", target))
    before, after = (torch.stack(system.velocity(scalars(system, s)), -1) for s in (source, changed))
    return (after - before) / short.dt


@pytest.mark.parametrize("name", ["quadrotor", "fixed_wing"])
def test_disturbances_of_aircraft_are_the_formulas_over_ground(name, draw, scalars, vary):
    """Whatever frame the system keeps its velocity in."""
    system = vary(make_system(name), 1)
    state, action = draw(system, 20)
    v = torch.stack(system.velocity(scalars(system, state)), -1)
    speed = v.norm(dim=-1, keepdim=True)
    close = {"atol": 1e-4, "rtol": 1e-4}
    torch.testing.assert_close(along(system, state, action, "drag=0.3", scalars), -0.3 * v, **close)
    torch.testing.assert_close(along(system, state, action, "quadratic_drag=0.2", scalars), -0.2 * speed * v, **close)
    pushed = torch.tensor([0.5, -0.2, 0.1], dtype=torch.float64).expand_as(v)
    torch.testing.assert_close(along(system, state, action, "push=0.5,-0.2,0.1", scalars), pushed, **close)


def fall(target, seconds):
    """Vertical velocity of a quadrotor that falls from rest without thrust."""
    dynamics = make_dynamics(replace(Quadrotor(), thrust_min=0.0), target)
    state, action = HOVERING, torch.tensor([-1.0, 0, 0, 0], dtype=torch.float64)
    for _ in range(round(seconds / dynamics.dt)):
        state = dynamics(state, action)
    return state[9].item()


@pytest.mark.parametrize("rate", [0.3, 2.0])
def test_a_falling_quadrotor_under_linear_drag_approaches_its_terminal_velocity(rate):
    for seconds in (0.5, 1.5):
        assert fall(f"drag={rate}", seconds) == pytest.approx(-9.81 / rate * (1 - math.exp(-rate * seconds)), rel=1e-4)
    assert fall(f"drag={rate}", 14 / rate) == pytest.approx(-9.81 / rate, rel=1e-5)


@pytest.mark.parametrize("strength", [0.05, 1.0])
def test_a_falling_quadrotor_under_quadratic_drag_approaches_its_terminal_velocity(strength):
    terminal = math.sqrt(9.81 / strength)
    assert fall(f"quadratic_drag={strength}", 1.0) == pytest.approx(-terminal * math.tanh(9.81 / terminal), rel=1e-3)
    assert fall(f"quadratic_drag={strength}", 10 * terminal / 9.81) == pytest.approx(-terminal, rel=1e-6)


def hover_from(velocity, target, steps):
    state, dynamics = HOVERING.clone(), make_dynamics("quadrotor", target)
    state[7:10] = torch.tensor(velocity)
    for _ in range(steps):
        state = dynamics(state, HOVER)
    return state


def test_horizontal_speed_decays_at_the_rate_of_the_drag_and_covers_its_integral():
    state, left = hover_from((2.0, -1.0, 0.0), "drag=0.3", 30), math.exp(-0.3 * 3.0)
    assert state[7:10].tolist() == pytest.approx([2 * left, -left, 0], abs=1e-6)
    assert state[:3].tolist() == pytest.approx([2 * (1 - left) / 0.3, -(1 - left) / 0.3, 0], abs=1e-6)


def test_a_push_acts_at_rest():
    state = hover_from((0.0, 0.0, 0.0), "push=0.5,-0.2,0.1", 10)
    assert state[7:10].tolist() == pytest.approx([0.5, -0.2, 0.1])
    assert state[:3].tolist() == pytest.approx([0.25, -0.1, 0.05])


@pytest.mark.parametrize("target", [f"{name}=0.7" for name in SCALAR])
def test_drag_does_nothing_at_rest(target):
    torch.testing.assert_close(hover_from((0.0, 0.0, 0.0), target, 10), HOVERING, atol=1e-12, rtol=0)


def test_a_quadrotor_with_rotor_drag_drifts_with_the_wind():
    target = f"drag={WIND_DRAG} wind=2,-1,0"
    assert hover_from((2.0, -1.0, 0.0), target, 20)[7:10].tolist() == pytest.approx([2, -1, 0])
    assert hover_from((0.0, 0.0, 0.0), target, 200)[7:10].tolist() == pytest.approx([2, -1, 0], abs=0.01)


def test_disturbances_add_up(robot, draw):
    """In an Euler step velocities change by the sum, in either order; texts may be one or several."""
    state, action = draw(robot, 10)
    rows = [robot.State._fields.index(name) for name in robot.accelerations]

    def change(target):
        source = make_dynamics(robot, "", "euler")(state, action)
        return (make_dynamics(robot, target, "euler")(state, action) - source)[:, rows]

    expected = change("drag=0.3") + change("push=1,2,3")
    torch.testing.assert_close(change("drag=0.3 push=1,2,3"), expected)
    torch.testing.assert_close(change(("push=1,2,3", "drag=0.3")), expected)


def test_a_parameter_and_a_disturbance_combine(robot, draw):
    state, action = draw(robot, 10)
    heavier = make_dynamics(robot, "mass=x1.2").system
    expected = make_dynamics(heavier, "drag=0.3")(state, action)
    for target in ("drag=0.3 mass=x1.2", ["mass=x1.2", "drag=0.3"]):
        torch.testing.assert_close(make_dynamics(robot, target)(state, action), expected)


def test_a_later_change_of_the_same_parameter_builds_on_the_earlier_one():
    assert dict(parse_target("mass=2 mass=x0.5", Quadrotor()).changes) == {"mass": 1.0}
    assert dict(parse_target("mass=x3 mass=2", Quadrotor()).changes) == {"mass": 2.0}


@pytest.mark.parametrize(("system", "group"), [(name, group) for name in SYSTEMS for group in make_system(name).groups])
def test_a_group_scales_all_its_members(system, group):
    system = make_system(system)
    changed = parse_target(f"{group}=x1.5", system).apply(system)
    for field in fields(system):
        if field.name in system.groups[group]:
            assert getattr(changed, field.name) == 1.5 * getattr(system, field.name)
        elif getattr(system, field.name) is not None:
            assert getattr(changed, field.name) == getattr(system, field.name)


def test_a_changed_airframe_leaves_its_controller_believing_in_the_old_one():
    changed = parse_target("mass=x1.2 inertia=x1.3", Quadrotor()).apply(Quadrotor())
    assert changed.mass == 1.2 * Quadrotor().mass
    assert changed.believed == Quadrotor().believed


@pytest.mark.parametrize(
    ("system", "item", "says"),
    [
        ("quadrotor", "drg=0.3", "expected one of drag, quadratic_drag, push, wind"),
        ("cartpole", "thrust_loss=0.1", "cartpole has no 'thrust_loss'"),
        ("quadrotor", "dt=0.2", "quadrotor has no 'dt'"),
        ("quadrotor", "drag", "expected NAME=VALUE"),
        ("quadrotor", "drag=", "expected NAME=VALUE"),
        ("quadrotor", "=0.3", "expected NAME=VALUE"),
        ("quadrotor", "drag=strong", "'strong' is not a number"),
        ("quadrotor", "drag=nan", "'nan' is not a finite number"),
        ("quadrotor", "push=0,inf,0", "'inf' is not a finite number"),
        ("quadrotor", "drag=-0.3", "at least 0"),
        ("quadrotor", "drag=1,2,3", "expected one number"),
        ("fixed_wing", "quadratic_drag=1,2,3", "expected one number"),
        ("quadrotor", "push=1,2", "three (x,y,z)"),
        ("quadrotor", "push=1,,2", "'' is not a number"),
        ("quadrotor", "mass=nan", "'nan' is not a finite number"),
        ("quadrotor", "mass=xinf", "'inf' is not a finite number"),
        ("quadrotor", "mass=x", "'' is not a number"),
        ("quadrotor", "mass=-1", "mass is -1, expected"),
        ("quadrotor", "mass=0", "mass is 0, expected"),
        ("quadrotor", "mass=x-1", "mass is -0.723, expected"),
        ("quadrotor", "inertia=0.1", "give a factor such as inertia=x1.2"),
        ("quadrotor", "thrust_loss=1.5", "thrust_loss is 1.5, expected"),
        ("quadrotor", "thrust_min=30", "thrust_min 30 is not below thrust_max"),
        ("quadrotor", "gravity=-9.81", "gravity is -9.81, expected"),
        ("cartpole", "mass=1.2", "cart_mass, pole_mass"),
        ("cartpole", "pole_half_length=x-2", "pole_half_length is -1, expected"),
        ("fixed_wing", "elevator_limit=3", "elevator_limit is 3, expected"),
        ("fixed_wing", "wind=1,2,3", "'1,2,3' is not a number"),
    ],
)
def test_a_target_that_makes_no_sense_is_refused_in_one_line_that_names_it(system, item, says):
    with pytest.raises(InputError) as refusal:
        make_dynamics(system, f"push=0.1 {item}")
    message = str(refusal.value)
    assert "\n" not in message
    assert message.startswith("--target ")
    assert f"{item}: " in message
    assert says in message


@pytest.mark.parametrize("make", [make_system, make_dynamics, make_env])
def test_an_unknown_system_is_refused_in_one_line_that_lists_the_known(make):
    with pytest.raises(InputError) as refusal:
        make("submarine")
    assert str(refusal.value) == "--system submarine: expected one of cartpole, quadrotor, fixed_wing"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_robot_with_a_parameter_that_is_not_finite_is_refused(nominal, value):
    for field in fields(nominal):
        if isinstance(getattr(nominal, field.name), float):
            with pytest.raises(InputError, match=f"{nominal.name}: {field.name} is .*expected a finite number"):
                replace(nominal, **{field.name: value})


def test_a_factor_on_a_parameter_that_is_zero_is_refused():
    with pytest.raises(InputError, match="thrust_loss is 0, which no factor changes"):
        make_dynamics("quadrotor", "thrust_loss=x1.2")
