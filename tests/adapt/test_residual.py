import copy
import pickle
from dataclasses import replace

import pytest
import torch

from adapt.fit_acceleration import unexplained
from adapt.prediction import prediction_error
from adapt.residual import FitSettings, fit_residual
from adapt.residual_dynamics import ResidualConfig
from adapt.residual_kinds import load_residual, make_residual
from adapt.transitions import Transitions
from envs import make_dynamics, make_system
from envs.errors import InputError

SYSTEMS = ("cartpole", "quadrotor", "fixed_wing")
KINDS = ("acceleration", "state")
# Targets that the linear part expresses exactly, and the share of the error that 30 transitions may leave.
EXACT = [
    ("quadrotor", "drag=0.3", 1e-3),
    ("quadrotor", "quadratic_drag=0.1", 1e-3),
    ("quadrotor", "mass=x1.2", 1e-3),
    ("quadrotor", "drag=0.2 mass=x1.1 quadratic_drag=0.05", 0.05),
    ("fixed_wing", "drag=0.3", 1e-3),
]
FAST = FitSettings(steps=200)


def states(name, n, seed, spread=1.0):
    """Random states and actions of a system, around its start; float64."""
    generator = torch.Generator().manual_seed(seed)
    system = make_system(name)
    width = len(system.State._fields)
    state = 0.2 * spread * torch.randn(n, width, generator=generator, dtype=torch.float64)
    if "qw" in system.State._fields:
        state[:, 3] += 1
        state[:, 3:7] = torch.nn.functional.normalize(state[:, 3:7], dim=-1)
        state[:, 7:10] *= 10
    if name == "fixed_wing":
        state[:, 7] = 11.5 + state[:, 7] / 2
        state[:, 8:10] /= 4
    action = torch.rand(n, len(system.Action._fields), generator=generator, dtype=torch.float64) - 0.5
    return state, action


def flights(name, target, n, seed=0, steps=10, spread=1.0, dynamics=None):
    """Transitions in flights of `steps`, from random states under slowly changing random actions; float32 as flown."""
    dynamics = dynamics or make_dynamics(name, target)
    generator = torch.Generator().manual_seed(seed + 100)
    count = -(-n // steps)
    state, action = states(name, count, seed, spread)
    rows = []
    for _ in range(steps):
        change = torch.randn(action.shape, generator=generator, dtype=torch.float64)
        action = (action + 0.3 * change).clamp(-1, 1)
        following = dynamics(state, action)
        rows.append((state, action, following))
        state = following
    parts = [torch.stack(part, 1).flatten(0, 1)[:n].float() for part in zip(*rows, strict=True)]
    trajectory = torch.arange(count).repeat_interleave(steps)[:n]
    system = make_system(name)
    names = (system.State._fields, system.Action._fields)
    return Transitions(*parts, trajectory, system.dt, name, *names)


def random_residual(name, kind, seed=1):
    """A residual whose every part is at work."""
    residual = make_residual(make_dynamics(name), ResidualConfig(kind))
    generator = torch.Generator().manual_seed(seed)
    for tensor_name, tensor in residual.named_buffers():
        if tensor_name in ("weights", "bias", "network.last", "network.last_bias"):
            tensor.copy_(0.03 * torch.randn(tensor.shape, generator=generator, dtype=torch.float64))
    return residual


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_unfitted_residual_is_the_source_bit_for_bit(name, kind, dtype):
    source = make_dynamics(name)
    state, action = (part.to(dtype) for part in states(name, 50, 0))
    following = make_residual(source, ResidualConfig(kind))(state, action)
    wanted = source(state, action)
    if kind == "state":  # which puts the quaternion on its manifold once more
        system = source.system
        wanted = torch.stack(system.project(system.State(*wanted.unbind(-1))), -1)
    assert torch.equal(following, wanted)
    assert following.dtype == dtype


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_finite_differences(name, kind):
    residual = random_residual(name, kind)
    state, action = states(name, 2, 0)
    assert not torch.allclose(residual(state, action), residual.base(state, action))
    assert torch.autograd.gradcheck(residual, (state.requires_grad_(), action.requires_grad_()))


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", KINDS)
def test_detached_the_value_stays_and_the_gradient_is_that_of_the_base(name, kind):
    residual = random_residual(name, kind)
    detached = copy.copy(residual)
    detached.detach = True
    state, action = (part.requires_grad_() for part in states(name, 5, 0))
    torch.testing.assert_close(detached(state, action), residual(state, action))
    gradients = [
        torch.autograd.grad(f(state, action).square().mul(torch.arange(1, state.shape[-1] + 1)).sum(), (state, action))
        for f in (
            lambda s, a: detached(s, a),
            lambda s, a: residual.base(s, a) + (residual(s, a) - residual.base(s, a)).detach(),
        )
    ]
    for mine, wanted in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, wanted)
    for output in range(state.shape[-1]):
        mine, wanted = (
            torch.autograd.grad(f(state, action)[:, output].sum(), state)[0] for f in (detached, residual.base)
        )
        torch.testing.assert_close(mine, wanted)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", KINDS)
def test_torch_and_casadi_agree(name, kind):
    for residual in (random_residual(name, kind), random_residual(name, kind)):
        step = residual.casadi()
        state, action = states(name, 5, 3)
        wanted = residual(state, action)
        for s, a, w in zip(state, action, wanted, strict=True):
            following = torch.tensor(step(s.numpy(), a.numpy()).full().ravel())
            torch.testing.assert_close(following, w, rtol=0, atol=1e-10)
        residual.drop_network()


def test_without_its_network_the_linear_part_agrees_with_casadi():
    residual = random_residual("quadrotor", "acceleration")
    residual.drop_network()
    state, action = states("quadrotor", 1, 3)
    following = torch.tensor(residual.casadi()(state[0].numpy(), action[0].numpy()).full().ravel())
    torch.testing.assert_close(following, residual(state, action)[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["quadrotor", "fixed_wing"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_quaternion_stays_a_unit_quaternion(name, kind):
    residual = random_residual(name, kind)
    state, action = states(name, 20, 0)
    for _ in range(10):
        state = residual(state, action)
    torch.testing.assert_close(state[:, 3:7].norm(dim=-1), torch.ones(20, dtype=torch.float64))


def test_position_feels_half_the_push_that_velocity_feels():
    """A constant acceleration a adds a dt to the velocity and a dt^2 / 2 to the position."""
    residual = make_residual(make_dynamics("quadrotor"))
    residual.bias[0] = 2.0
    state, action = states("quadrotor", 5, 0)
    state[:, 3:7], state[:, 10:] = torch.tensor([1.0, 0, 0, 0]), 0.0
    action[:, 1:] = 0.0
    moved = residual(state, action) - residual.base(state, action)
    torch.testing.assert_close(moved[:, 7], torch.full((5,), 0.2, dtype=torch.float64))
    torch.testing.assert_close(moved[:, 0], torch.full((5,), 0.01, dtype=torch.float64))


@pytest.mark.parametrize("name", SYSTEMS)
def test_moving_the_robot_moves_the_prediction_alike(name):
    residual = random_residual(name, "acceleration")
    state, action = states(name, 10, 0)
    shift = torch.zeros(state.shape[-1], dtype=torch.float64)
    shift[: 3 if "px" in residual.system.State._fields else 1] = 7.0
    torch.testing.assert_close(residual(state + shift, action), residual(state, action) + shift)


def test_a_quadrotor_residual_of_body_inputs_does_not_know_north():
    residual = random_residual("quadrotor", "acceleration")
    blind = len(residual.system.residual_input_names)
    assert blind >= 13
    for columns in (slice(13, blind), slice(blind + 13, 2 * blind)):  # whatever tells the heading
        residual.weights[:, columns] = 0.0
    residual.network.first[:, 13:] = 0.0
    state, action = states("quadrotor", 10, 0)
    torch.testing.assert_close(
        residual(yawed(state, 0.7), action), yawed(residual(state, action), 0.7), rtol=0, atol=1e-4
    )


def yawed(state, angle):
    """A quadrotor state turned about the world z axis."""
    c, s = torch.cos(torch.tensor(angle, dtype=torch.float64)), torch.sin(torch.tensor(angle, dtype=torch.float64))
    turn = torch.stack((torch.stack((c, -s)), torch.stack((s, c))))
    half = (1 + c).mul(0.5).sqrt(), (1 - c).mul(0.5).sqrt()
    w, x, y, z = state[:, 3:7].unbind(-1)
    turned = state.clone()
    turned[:, :2], turned[:, 7:9] = state[:, :2] @ turn.T, state[:, 7:9] @ turn.T
    turned[:, 3:7] = torch.stack(
        (half[0] * w - half[1] * z, half[0] * x - half[1] * y, half[0] * y + half[1] * x, half[0] * z + half[1] * w), -1
    )
    return turned


# --- fitting ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "target", "left"), EXACT)
def test_thirty_transitions_are_enough_where_the_force_is_linear(name, target, left):
    """Judged on faster flights than those it has seen; what is left is the rounding of float32."""
    source = make_dynamics(name)
    residual, report = fit_residual(flights(name, target, 30, steps=30), source)
    unseen = flights(name, target, 300, seed=9, spread=1.5)
    before, after = (prediction_error(dynamics, unseen)["acceleration"] for dynamics in (source, residual))
    assert after < left * before
    assert report.network == ()
    assert residual.network is None


def test_linear_drag_is_found_by_name_and_number():
    data = flights("quadrotor", "drag=0.3", 30, steps=30)
    residual, report = fit_residual(data, make_dynamics("quadrotor"), "acceleration")
    torch.testing.assert_close(residual.weights[:3, :3].diagonal(), torch.full((3,), -0.3).double(), rtol=0, atol=1e-3)
    assert [len(report.inputs[row]) for row in ("vx", "vy", "vz", "p", "q", "r")] == [1, 1, 1, 0, 0, 0]
    assert not residual.config.factors


def test_quadratic_drag_is_found_as_speed_times_velocity():
    data = flights("quadrotor", "quadratic_drag=0.1", 30, steps=30)
    residual, report = fit_residual(data, make_dynamics("quadrotor"), "acceleration")
    columns = [residual.feature_names().index(report.inputs[row][0]) for row in ("vx", "vy", "vz")]
    width = len(residual.feature_names()) // 2
    assert columns == [width, width + 1, width + 2]
    found = residual.weights[:3, width : width + 3].diagonal()
    torch.testing.assert_close(found, torch.full((3,), -0.1).double(), rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", SYSTEMS)
def test_nothing_is_learned_where_nothing_is_missing(name):
    source = make_dynamics(name)
    data = flights(name, "", 100)
    residual, report = fit_residual(data, source)
    assert not any(report.inputs.values())
    assert torch.equal(residual(data.state, data.action), source(data.state, data.action))


@pytest.mark.parametrize("name", SYSTEMS)
def test_data_that_excite_nothing_do_not_make_the_residual_explode(name):
    """The same two states over and over: their error may be explained, but states elsewhere stay sane."""
    data = flights(name, "mass=x1.2", 20, steps=2, seed=1)
    still = data.select(torch.arange(2).repeat(15))
    residual, _ = fit_residual(still, make_dynamics(name))
    unseen = flights(name, "mass=x1.2", 100, seed=2)
    after, before = (prediction_error(d, unseen)["velocity"] for d in (residual, make_dynamics(name)))
    assert after < 10 * before


def stubborn(system, x, u):
    """Dry friction: a force that no product of the inputs comes near."""
    return system.accelerate(x, tuple(-3 * (2 * v).tanh() for v in system.velocity(x)))


def test_the_network_stays_where_the_force_is_not_linear():
    source = make_dynamics("cartpole")
    target = replace(source, disturbances=(stubborn,))
    data = flights("cartpole", "", 1000, dynamics=target)
    residual, report = fit_residual(data, source)
    linear, _ = fit_residual(data, source, settings=FitSettings(network=False))
    unseen = flights("cartpole", "", 500, seed=5, dynamics=target)
    errors = [prediction_error(dynamics, unseen)["velocity"] for dynamics in (source, linear, residual)]
    assert "v" in report.network
    assert errors[2] < 0.5 * errors[1]
    assert errors[2] < 0.2 * errors[0]


def test_the_papers_form_learns_too():
    source = make_dynamics("quadrotor")
    residual, report = fit_residual(flights("quadrotor", "drag=0.3", 1000), source, "state", settings=FAST)
    unseen = flights("quadrotor", "drag=0.3", 300, seed=9)
    before, after = (prediction_error(dynamics, unseen)["velocity"] for dynamics in (source, residual))
    assert after < 0.5 * before
    assert report.kind == "state"


def test_what_is_left_unexplained_is_the_push_that_was_there():
    source = make_dynamics("quadrotor")
    residual = make_residual(source, ResidualConfig(hidden=0))
    push = torch.linspace(-1, 1, 6, dtype=torch.float64).expand(20, -1)
    state, action = states("quadrotor", 20, 0)
    system = source.system
    names = (system.State._fields, system.Action._fields)
    following = residual.pushed(state, action, push)
    data = Transitions(state, action, following, torch.zeros(20).long(), 0.1, "quadrotor", *names)
    torch.testing.assert_close(unexplained(residual, data), push)


def with_context(data, context, names):
    return replace(data, context=context, context_names=names)


def test_a_context_tells_two_robots_apart():
    """Half of the flights carry a payload; only the context knows which."""
    light, heavy = flights("quadrotor", "", 100), flights("quadrotor", "mass=x1.3", 100, seed=1)
    both = Transitions(
        *(torch.cat((getattr(light, k), getattr(heavy, k))) for k in ("state", "action", "next_state")),
        torch.cat((light.trajectory, heavy.trajectory + 10)), 0.1, "quadrotor", light.state_names, light.action_names,
    )  # fmt: skip
    marker = torch.cat((torch.zeros(100, 1), torch.ones(100, 1)))
    source = make_dynamics("quadrotor")
    blind, _ = fit_residual(both, source, settings=FAST)
    seeing, report = fit_residual(with_context(both, marker, ("payload",)), source, settings=FAST)
    assert "payload" in report.inputs["vz"]
    errors = [prediction_error(d, with_context(both, marker, ("payload",)))["velocity"] for d in (blind, seeing)]
    assert errors[1] < 0.5 * errors[0]
    fixed = seeing.with_context([1.0])
    torch.testing.assert_close(
        fixed(heavy.state, heavy.action), seeing.with_context(marker[100:])(heavy.state, heavy.action)
    )
    following = torch.tensor(fixed.casadi()(heavy.state[0].numpy(), heavy.action[0].numpy()).full().ravel())
    torch.testing.assert_close(
        following, fixed(heavy.state[:1].double(), heavy.action[:1].double())[0], rtol=0, atol=1e-10
    )
    with pytest.raises(InputError, match="fitted with payload"):
        seeing(heavy.state, heavy.action)
    with pytest.raises(InputError, match="expected the columns payload"):
        seeing.with_context([1.0, 2.0])


def test_the_same_seed_fits_the_same():
    data = flights("cartpole", "track_friction=0.2", 200)
    source = make_dynamics("cartpole")
    first, second = (fit_residual(data, source, "state", seed=4, settings=FAST)[0] for _ in range(2))
    assert torch.equal(first(data.state, data.action), second(data.state, data.action))


# --- files and bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_residual_comes_back_from_its_file(name, kind, tmp_path):
    residual = random_residual(name, kind)
    residual.save(tmp_path / "residual.safetensors")
    state, action = states(name, 10, 0)
    for read in (
        load_residual(tmp_path / "residual.safetensors"),
        load_residual(tmp_path / "residual.safetensors", residual.base),
    ):
        assert torch.equal(read(state, action), residual(state, action))
        assert read.config == residual.config
    assert [path.name for path in tmp_path.iterdir()] == ["residual.safetensors"]


def test_a_fitted_residual_comes_back_without_what_it_dropped(tmp_path):
    residual, _ = fit_residual(flights("quadrotor", "drag=0.3", 50), make_dynamics("quadrotor"))
    residual.save(tmp_path / "residual.safetensors")
    state, action = states("quadrotor", 10, 0)
    assert torch.equal(load_residual(tmp_path / "residual.safetensors")(state, action), residual(state, action))


def test_a_file_of_another_robot_or_none_is_refused(tmp_path):
    path = tmp_path / "residual.safetensors"
    random_residual("quadrotor", "acceleration").save(path)
    with pytest.raises(InputError, match="completes quadrotor, expected cartpole"):
        load_residual(path, make_dynamics("cartpole"))
    with pytest.raises(InputError, match=r"completes mass 0\.723, expected 0\.5"):
        load_residual(path, make_dynamics(replace(make_system("quadrotor"), mass=0.5)))
    with pytest.raises(InputError, match="can't read a residual"):
        load_residual(tmp_path / "none.safetensors")
    flights("quadrotor", "", 20).save(tmp_path / "data.safetensors")
    with pytest.raises(InputError, match="expected 'apg-adapt residual 1'"):
        load_residual(tmp_path / "data.safetensors")


class Bomb:
    def __reduce__(self):
        return (exec, ("raise SystemExit('code of a file was run')",))


def test_a_pickle_is_refused_and_not_run(tmp_path):
    path = tmp_path / "residual.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match="not a safetensors file"):
        load_residual(path)


def test_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "residual.safetensors"
    random_residual("quadrotor", "acceleration").save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="not a safetensors file"):
        load_residual(path)


def test_transitions_that_cannot_teach_are_refused():
    source, data = make_dynamics("quadrotor"), flights("quadrotor", "drag=0.3", 30)
    broken = data.state.clone()
    broken[4, 8] = torch.nan
    for wrong, message in (
        (data.select(slice(0, 9)), "9 transitions, at least 10 are needed"),
        (replace(data, dt=0.05), "control period is 0.05 s, expected 0.1 s"),
        (flights("fixed_wing", "", 30), "recorded on fixed_wing, expected quadrotor"),
        (replace(data, state=broken), "transition 5: state is not finite"),
        (replace(data, state=broken.nan_to_num(1e30)), "transition 5: state is as large as 1e"),
    ):
        with pytest.raises(InputError, match=message):
            fit_residual(wrong, source)
    with pytest.raises(InputError, match="--residual magic: expected one of auto, parameters, linear"):
        fit_residual(data, source, "magic")


def test_data_that_nothing_explains_are_warned_about():
    """Velocities that jump at random: no model predicts them better than that nothing changes."""
    data = flights("quadrotor", "", 200)
    following = data.next_state.clone()
    following[:, 7:10] = data.state[:, 7:10]
    action = data.action.clone()
    _, clean = fit_residual(data, make_dynamics("quadrotor"), settings=FAST)
    mixed = replace(data, next_state=following, action=action[torch.randperm(200, generator=torch.Generator())])
    _, report = fit_residual(mixed, make_dynamics("quadrotor"), settings=FAST)
    assert clean.warnings == ()
    assert any("worse than if nothing changed" in warning for warning in report.warnings)
