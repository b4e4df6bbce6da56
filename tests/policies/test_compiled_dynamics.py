"""Compiled dynamics are the dynamics: values, derivatives, shapes; and where they can't be had, that is said."""

import pytest
import torch

from adapt import collect
from adapt.residual import fit_residual
from envs import make_dynamics
from envs.dynamics import Dynamics
from policies.checkpoints import load_policy
from policies.compiled_dynamics import CompiledDynamics, fastest
from policies.generated_code import CompilerError

SYSTEMS = ("cartpole", "quadrotor", "fixed_wing")


@pytest.fixture(scope="module")
def flown():
    """Transitions of each robot under drag."""
    data = {}
    for name in SYSTEMS:
        policy = load_policy(name)
        env = make_dynamics(name, "drag=0.3"), policy.task, policy.task.episodes(20, "train", 9)
        data[name] = collect(policy.actor(), env, 120, 0.1)
    return data


def derivatives(dynamics, data, dtype=torch.float64):
    """The next states, and the derivatives of a mixture of them by states and actions."""
    state, action = (part.to(dtype).requires_grad_() for part in (data.state, data.action))
    following = dynamics(state, action)
    mixture = torch.randn(following.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)
    return following.detach(), *torch.autograd.grad((mixture * following).sum(), (state, action))


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("target", ["", "drag=0.3 push=0.2"])
def test_values_and_derivatives_are_those_of_the_equations(name, target, flown):
    dynamics = make_dynamics(name, target)
    expected = derivatives(dynamics, flown[name])
    torch.testing.assert_close(derivatives(CompiledDynamics(dynamics), flown[name]), expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("kind", ["parameters", "linear", "features", "network", "state"])
@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_a_residual_of_any_kind_can_be_compiled(name, kind, flown):
    data = flown[name]
    residual, _ = fit_residual(data, Dynamics(load_policy(name).task.system), kind)
    expected = derivatives(residual.requires_grad_(False), data)
    torch.testing.assert_close(derivatives(CompiledDynamics(residual), data), expected, rtol=1e-6, atol=1e-7)


def test_numbers_keep_their_type_and_batches_their_shape(flown):
    data, compiled = flown["quadrotor"], CompiledDynamics(make_dynamics("quadrotor"))
    single = derivatives(compiled, data, torch.float32)
    assert {part.dtype for part in single} == {torch.float32}
    torch.testing.assert_close(
        single, derivatives(make_dynamics("quadrotor"), data, torch.float32), rtol=1e-4, atol=1e-5
    )
    wide = compiled(data.state[:6].reshape(2, 3, 13), data.action[0])
    torch.testing.assert_close(wide[1, 2], make_dynamics("quadrotor")(data.state[5], data.action[0]))
    assert compiled(data.state[:0], data.action[:0]).shape == (0, 13)
    across = torch.stack((data.state[:5], data.state[5:10]), 1)[:, 1]  # not contiguous
    torch.testing.assert_close(compiled(across, data.action[:5]), compiled(data.state[5:10], data.action[:5]))


def test_a_slope_that_isnt_contiguous_is_read_right(flown):
    data, state = flown["cartpole"], flown["cartpole"].state.clone().requires_grad_()
    other = data.state.clone().requires_grad_()
    for dynamics, start in ((CompiledDynamics(make_dynamics("cartpole")), state), (make_dynamics("cartpole"), other)):
        dynamics(start, data.action)[..., ::2].sum().backward()
    torch.testing.assert_close(state.grad, other.grad)


def test_without_a_compiler_the_equations_are_used_and_the_reason_is_told(monkeypatch):
    def none(source):
        raise CompilerError("no C compiler found (tried gcc)")

    monkeypatch.setattr("policies.compiled_dynamics.shared_library", none)
    dynamics = make_dynamics("cartpole")
    assert fastest(dynamics) == (dynamics, "no C compiler found (tried gcc)")


def test_a_library_that_cannot_be_loaded_is_as_good_as_no_compiler(monkeypatch, tmp_path):
    (tmp_path / "damaged.so").write_text("no machine code")
    monkeypatch.setattr("policies.compiled_dynamics.shared_library", lambda source: tmp_path / "damaged.so")
    dynamics, reason = fastest(make_dynamics("cartpole"))
    assert not isinstance(dynamics, CompiledDynamics)
    assert "damaged.so: can't be loaded" in reason


def test_what_has_no_equations_or_another_gradient_is_left_as_it_is(flown):
    class Other:
        system = make_dynamics("cartpole").system

    other = Other()
    assert fastest(other)[0] is other
    residual, _ = fit_residual(flown["cartpole"], make_dynamics("cartpole"), "linear")
    residual.detach = True
    assert fastest(residual)[0] is residual
