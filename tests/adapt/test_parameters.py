"""Refitting parameters: those that differ are found, with honest errors, through noise; what is open is said."""

from dataclasses import replace

import pytest
import torch

from adapt import collect, fit_parameters, report
from adapt.fit_parameters import search, undetermined
from adapt.parameter_losses import OneStep, Shooting, least_squares
from adapt.parameter_residual import changed, own_parameters
from adapt.residual import fit_residual
from adapt.residual_dynamics import ResidualConfig
from adapt.residual_kinds import load_residual, make_residual
from adapt.transitions import Transitions
from envs import make_dynamics, make_system
from envs.dynamics import Dynamics
from envs.errors import InputError
from policies.checkpoints import load_policy

NOISE = {"x": 1e-3, "v": 0.02, "theta": 0.0087, "omega": 0.05, "p": 0.05, "q": 0.05, "r": 0.05}
NOISE |= dict.fromkeys(("px", "py", "pz"), 1e-3) | dict.fromkeys(("vx", "vy", "vz", "u_b", "v_b", "w_b"), 0.02)
NOISE |= dict.fromkeys(("qw", "qx", "qy", "qz"), 0.0044)  # half a degree


def flown(name, target, n, noise=None):
    """Transitions (float64) that the shipped policy flies in a target; `noise` seeds that of the measured states."""
    policy = load_policy(name)
    task = policy.task
    data = collect(policy.actor(), (make_dynamics(name, target), task, task.episodes(20, "train", 9)), n, 0.1)
    data = replace(data, **{key: getattr(data, key).double() for key in ("state", "action", "next_state")})
    return data if noise is None else measured(data, noise)


def measured(data, seed):
    """The same with noise; the end of a transition and the beginning of the next are one measurement."""
    size = torch.tensor([NOISE[name] for name in data.state_names], dtype=torch.float64)
    draw = torch.Generator().manual_seed(seed)
    ends = data.next_state + size * torch.randn(data.state.shape, generator=draw, dtype=torch.float64)
    state = data.state + size * torch.randn(data.state.shape, generator=draw, dtype=torch.float64)
    follows = torch.cat((torch.tensor([False]), (data.next_state[:-1] == data.state[1:]).all(-1)))
    state[follows] = ends[:-1][follows[1:]]
    if "qw" in data.state_names:
        for part in (state, ends):
            part[:, 3:7] /= part[:, 3:7].norm(dim=-1, keepdim=True)
    return replace(data, state=state, next_state=ends)


@pytest.mark.parametrize(
    ("name", "target", "truth"),
    [
        ("quadrotor", "drag=0.3", {"drag": 0.3}),
        ("quadrotor", "quadratic_drag=0.1", {"quadratic_drag": 0.1}),
        ("quadrotor", "wind=2", {"push_x": 0.6}),  # rotor drag of 0.3 1/s times 2 m/s
        ("quadrotor", "mass=x1.3", {"mass": 0.9399}),
        ("quadrotor", "drag=0.3 mass=x1.2", {"drag": 0.3, "mass": 0.8676}),
        ("cartpole", "push=1", {"push_x": 1.0}),
        ("cartpole", "track_friction=0.1", {"track_friction": 0.1}),
    ],
)
def test_the_parameters_that_differ_are_found_and_no_others(name, target, truth):
    found = search(Dynamics(make_system(name)), flown(name, target, 60))
    assert found.values == pytest.approx(truth, rel=1e-4)
    assert all(error < 1e-4 for error in found.errors.values())


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_where_nothing_differs_nothing_is_found(name):
    assert search(Dynamics(make_system(name)), flown(name, "", 60)).values == {}


def test_noise_of_the_measured_states_makes_up_nothing():
    """One step at a time a fast yaw rate that noise has made up seems to decay faster than it should."""
    data = flown("quadrotor", "", 200, noise=1)
    assert search(Dynamics(make_system("quadrotor")), data).values == {}


def test_a_drag_is_found_through_noise():
    found = search(Dynamics(make_system("quadrotor")), flown("quadrotor", "drag=0.3", 100, noise=0))
    assert list(found.values) == ["drag"]
    assert abs(found.values["drag"] - 0.3) < 4 * found.errors["drag"] < 0.03
    names = [name for name in make_system("quadrotor").State._fields if name not in ("qw", "qx", "qy", "qz")]
    tangent = [NOISE[name] for name in (*names[:3], "theta", "theta", "theta", *names[3:])]
    assert found.noise == pytest.approx(tangent, rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("length", [99, 11])  # [control periods] of a flight; those of 11 make two stretches of 10
def test_the_standard_errors_are_those_of_many_repetitions(length):
    base, exact = Dynamics(make_system("quadrotor")), flown("quadrotor", "drag=0.3", 99)
    exact.trajectory[:] = torch.arange(99) // length
    found = [search(base, measured(exact, seed), ("drag",)) for seed in range(20)]
    misses = torch.tensor([(one.values["drag"] - 0.3) / one.errors["drag"] for one in found])
    assert 0.5 < misses.square().mean() < 1.6


def test_what_is_counted_twice_makes_no_parameter_surer():
    """A flight of 11 gives two stretches that share nine of ten transitions."""
    base, data = Dynamics(make_system("quadrotor")), flown("quadrotor", "drag=0.3", 88, noise=0)
    data.trajectory[:] = torch.arange(88) // 11
    shorter = data.select(torch.arange(88) % 11 < 10)
    doubts = [search(base, part, ("drag",)).errors["drag"] for part in (data, shorter)]
    assert 0.8 < doubts[0] / doubts[1] < 1.1


def hovering(n=40):
    """Transitions of a quadrotor that stays where it is."""
    system = make_system("quadrotor")
    state = torch.zeros(n, 13, dtype=torch.float64)
    state[:, 3] = 1
    action = torch.tensor(system.trim_action, dtype=torch.float64).expand(n, -1)
    rows = torch.zeros(n, dtype=torch.int64)
    return Transitions(state, action, state, rows, system.dt, "quadrotor", system.State._fields, system.Action._fields)


def test_hover_alone_does_not_tell_thrust_from_gravity():
    with pytest.raises(
        InputError, match=r"don't determine mass, gravity: .*mass.*gravity changes no prediction"
    ) as error:
        search(Dynamics(make_system("quadrotor")), hovering(), ("mass", "gravity"))
    assert "\n" not in str(error.value)


def test_what_has_no_effect_at_all_is_named():
    with pytest.raises(InputError, match="a change of drag changes no prediction"):
        search(Dynamics(make_system("quadrotor")), hovering(), ("mass", "drag"))


def test_the_undetermined_direction_is_that_of_the_effects():
    """Twice the effect of the first is that of the second: +1 of the first with -0.5 of the second changes nothing."""
    effects = torch.randn(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert undetermined(effects, ("a", "b")) == ""
    effects[:, 1] = 2 * effects[:, 0]
    assert undetermined(effects, ("a", "b")) in ("+1 a with -0.5 b", "-1 a with +0.5 b")


def test_parameters_that_act_alike_are_told():
    found = search(Dynamics(make_system("quadrotor")), flown("quadrotor", "thrust_loss=0.15", 60))
    (name,) = found.values
    assert {name, *found.alike[name]} >= {"mass", "thrust_loss"}


def fallen_short(noise=None):
    """Hover (float64) of a quadrotor whose motors give nine tenths of the commanded thrust, as five flights."""
    system = make_system("quadrotor")
    half = (system.thrust_max - system.thrust_min) / 2
    data = hovering(100)
    action = data.action.clone()
    action[:, 0] = (system.gravity / 0.9 - system.thrust_min) / half - 1
    data = replace(data, action=action, trajectory=torch.arange(100) // 20)
    return data if noise is None else measured(data, noise)


@pytest.mark.parametrize("noise", [None, 0])
@pytest.mark.parametrize("kind", ["parameters", "auto"])
def test_hover_alone_says_what_thrust_cannot_be_told_from_and_in_which_direction(kind, noise):
    """In hover thrust / mass = gravity: d mass / mass = - d gravity / gravity, and thrust lost acts as mass gained."""
    _, fit = fit_residual(fallen_short(noise), Dynamics(make_system("quadrotor")), kind)
    assert fit.kind == "parameters"
    assert fit.parameters["mass"][0] == pytest.approx(0.723 / 0.9, rel=1e-3)
    undoing = fit.alike["mass"]
    assert undoing["gravity"] == pytest.approx(-9.81 * 0.9 / 0.723, rel=2e-3)
    assert undoing["push_z"] == pytest.approx(9.81 * 0.9 / 0.723, rel=2e-3)
    assert undoing["thrust_loss"] == pytest.approx(-0.9 / 0.723, rel=2e-3)
    (table,) = report.parameter_table(
        {"parameters": {"mass": {"value": 0.8, "standard_error": 0, "model": 0.7}}, "alike": fit.alike}
    )
    assert "so much undoes +1 of it" in table
    assert "gravity -12.2" in table


def test_the_direction_that_is_told_changes_no_prediction():
    base, data = Dynamics(make_system("quadrotor")), fallen_short()
    _, fit = fit_residual(data, base, "parameters")
    mass, little = fit.parameters["mass"][0], 1e-5

    def moved(**values):
        dynamics = changed(base, {"mass": mass, **values})
        return float(
            (dynamics(data.state, data.action) - changed(base, {"mass": mass})(data.state, data.action)).abs().max()
        )

    alone = moved(mass=mass + little)
    told = {name: amount for name, amount in fit.alike["mass"].items() if amount is not None}
    assert {"gravity", "thrust_loss"} <= told.keys()
    for name, amount in told.items():
        there = own_parameters(base.system).get(name, 0.0) + little * amount
        assert moved(mass=mass + little, **{name: there}) < 1e-3 * alone


def test_the_direction_is_that_beside_the_other_fitted_parameters():
    """A drag that is fitted too doesn't hide that mass and thrust can't be told apart."""
    _, fit = fit_residual(
        flown("quadrotor", "drag=0.3 thrust_loss=0.15", 100), Dynamics(make_system("quadrotor")), "parameters"
    )
    assert fit.parameters.keys() == {"mass", "drag"}
    assert fit.alike["mass"]["thrust_loss"] == pytest.approx(-1 / fit.parameters["mass"][0], rel=1e-3)


@pytest.mark.parametrize("value", [1e30, 1e160])
def test_states_that_are_no_flight_crash_nothing(value):
    """What a glitch of a sensor leaves in a file is finite, but no step can be predicted from it."""
    data = flown("cartpole", "drag=1", 60)
    following, state = data.next_state.clone(), data.state.clone()
    following[20], state[21] = value, value
    try:
        residual, _ = fit_residual(replace(data, next_state=following, state=state), Dynamics(make_system("cartpole")))
    except InputError as error:
        assert str(error).startswith("transitions: ")
    else:
        assert residual(data.state[:5], data.action[:5]).isfinite().all()


def test_stretches_that_nothing_can_be_predicted_from_are_refused():
    data = flown("cartpole", "drag=1", 60)
    state, following = data.state.clone(), data.next_state.clone()
    following[20] = state[21] = torch.inf
    loss = Shooting(Dynamics(make_system("cartpole")), replace(data, state=state, next_state=following))
    with pytest.raises(InputError, match="no flight can be predicted from such states"):
        loss.linearised({}, ("gravity",))


def test_where_all_data_together_run_away_what_was_found_without_some_stays(monkeypatch):
    """Held-out flight may contradict the rest, so that no values explain both."""
    data, whole = flown("quadrotor", "drag=0.3", 60), fit_parameters.settle
    monkeypatch.setattr(
        fit_parameters, "settle", lambda loss, *rest: None if len(loss.data) == len(data) else whole(loss, *rest)
    )
    _, fit = fit_residual(data, Dynamics(make_system("quadrotor")), "parameters")
    assert fit.parameters["drag"][0] == pytest.approx(0.3, rel=1e-4)


def test_named_parameters_are_all_fitted():
    data = flown("quadrotor", "drag=0.3", 60)
    found = search(Dynamics(make_system("quadrotor")), data, ("drag", "mass"))
    assert found.values == pytest.approx({"drag": 0.3, "mass": 0.723}, rel=1e-5)


def test_the_effects_are_those_of_small_changes():
    base, data = Dynamics(make_system("quadrotor")), flown("quadrotor", "drag=0.3", 30, noise=0)
    for loss in (OneStep(base, data), Shooting(base, data)):
        left, effects = loss.linearised({"drag": 0.3}, ("drag", "mass"))
        assert effects.shape == (len(left), 2)
        again, _ = loss.linearised({"drag": 0.3}, ())
        assert again == pytest.approx(left, abs=0.02 * float(left.abs().max()))


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_every_parameter_of_a_system_can_be_changed_and_changes_the_motion(name):
    base = Dynamics(make_system(name))
    policy = load_policy(name)
    state = policy.task.start(policy.task.episodes(5, "train", 0), torch.full((5,), 3)).double()
    state = state + 0.05 * torch.randn(state.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    action = 0.3 * torch.ones(5, len(base.system.Action._fields), dtype=torch.float64)
    for one, value in own_parameters(base.system).items():
        moved = changed(base, {one: value + 0.05 * max(abs(value), 0.1)})(state, action)
        assert not torch.equal(moved, base(state, action)), one


def residual_of(parameters, values, name="quadrotor"):
    residual = make_residual(make_dynamics(name), ResidualConfig("parameters", 0, factors=(), parameters=parameters))
    residual.values = torch.tensor(values, dtype=torch.float64)
    return residual


def test_least_squares_do_not_depend_on_what_the_memory_held_before():
    effects = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    for _ in range(20):
        torch.ones(3, dtype=torch.int32)  # and freed, so that the next three integers are likely to lie there
        found = least_squares(effects, torch.ones(3, 1, dtype=torch.float64))
        torch.testing.assert_close(found[:, 0], torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64))


def test_a_parameter_residual_is_the_target_that_has_these_parameters(tmp_path):
    residual = residual_of(("mass", "drag", "push_y"), (0.723 * 1.2, 0.3, 0.4))
    target = make_dynamics("quadrotor", "mass=x1.2 drag=0.3 push=0,0.4,0")
    data = flown("quadrotor", "", 20)
    wanted = target(data.state, data.action)
    torch.testing.assert_close(residual(data.state, data.action), wanted, rtol=0, atol=1e-12)
    residual.save(tmp_path / "residual.safetensors")
    again = load_residual(tmp_path / "residual.safetensors", make_dynamics("quadrotor"))
    assert torch.equal(again(data.state, data.action), residual(data.state, data.action))
    planned = again.casadi()(data.state[3].numpy(), data.action[3].numpy()).full()[:, 0]
    assert planned == pytest.approx(wanted[3].numpy(), abs=1e-12)


def test_the_fit_returns_a_residual_that_predicts(tmp_path):
    data = flown("quadrotor", "drag=0.3", 60)
    residual, report = fit_residual(data, make_dynamics("quadrotor"), "parameters")
    assert report.parameters["drag"][0] == pytest.approx(0.3, rel=1e-5)
    assert report.after["acceleration"] < 1e-5 < report.before["acceleration"]
    assert residual.config.parameters == ("drag",)


@pytest.mark.parametrize(
    ("kind", "parameters", "words"),
    [
        ("parameters", ("masss",), "quadrotor has no 'masss'; expected one of mass"),
        ("acceleration", ("mass",), "parameters mass: are fitted by kind parameters, not acceleration"),
    ],
)
def test_wrong_parameters_are_refused(kind, parameters, words):
    with pytest.raises(InputError, match=words):
        fit_residual(flown("quadrotor", "", 20), make_dynamics("quadrotor"), kind, parameters=parameters)


class Drifting:
    """A loss that asks, wherever it is, for the same step of a parameter once more."""

    noise, spent, repeated = None, 0, 1.0

    def __init__(self, base, step):
        self.base, self.step = base, step

    def linearised(self, values, names):
        changed(self.base, values)
        return torch.full((2,), self.step, dtype=torch.float64), torch.ones(2, len(names), dtype=torch.float64)


@pytest.mark.parametrize(("step", "found"), [(-0.12, True), (-0.13, False), (-0.4, False), (0.13, True)])
def test_values_that_no_robot_can_have_are_none_in_whichever_step_they_are_reached(step, found):
    base = Dynamics(make_system("cartpole"))
    assert 8 * -0.12 > -1 > 8 * -0.13  # of a mass, in its size: the last of eight steps makes it negative
    assert (fit_parameters.settle(Drifting(base, step), ("cart_mass",), {}) is not None) == found
