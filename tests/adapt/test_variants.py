"""One compiled step for all values of the parameters is the step of each robot that has these values."""

from dataclasses import dataclass

import pytest
import torch

from adapt import variants as module
from adapt.parameter_residual import candidates, changed, nominal
from adapt.variants import Variants
from envs import SYSTEMS, make_dynamics, make_task
from envs.cartpole import CartPole
from envs.dynamics import Dynamics
from envs.errors import InputError
from policies.generated_code import CompilerError


def flown(system, n=20):
    """States in flight and actions, in double precision."""
    generator, task = torch.Generator().manual_seed(0), make_task(system)
    state = task.start(task.episodes(n, "train", 0), torch.zeros(n, dtype=torch.long)).double()
    state = state + 0.1 * torch.randn(state.shape, generator=generator, dtype=state.dtype)
    return state, 2 * torch.rand(n, len(system.Action._fields), generator=generator, dtype=state.dtype) - 1


def compiles(variants):
    return not isinstance(variants({}), Dynamics)


@pytest.mark.parametrize("target", ["", "drag=0.3 mass=x1.2"], ids=["source", "target"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_step_with_parameters_as_inputs_is_that_of_the_robot_that_has_them(name, target):
    base = make_dynamics(name, target)
    variants, (state, action) = Variants(base), flown(base.system)
    assert compiles(variants)
    for parameter in candidates(base.system):
        values = {parameter: 1.01 * nominal(base.system, parameter) + 1e-3}
        torch.testing.assert_close(variants(values)(state, action), changed(base, values)(state, action))
    both = {"gravity": 9.7, "push_x": 0.4, "drag": 0.2}
    torch.testing.assert_close(variants(both)(state, action), changed(base, both)(state, action))
    assert variants(both).system == changed(base, both).system


def test_states_and_actions_are_broadcast_and_keep_their_kind():
    base = make_dynamics("quadrotor")
    state, action = flown(base.system)
    many = state[:, None].float().expand(20, 3, -1)
    found = Variants(base)({"drag": 0.3})(many, action[:, None].float())
    assert (found.shape, found.dtype) == (many.shape, torch.float32)
    torch.testing.assert_close(found, changed(base, {"drag": 0.3})(many, action[:, None].float()))


def test_values_without_physical_sense_are_refused():
    with pytest.raises(InputError, match="cart_mass is -1, expected more than 0"):
        Variants(make_dynamics("cartpole"))({"cart_mass": -1.0})


@dataclass(frozen=True)
class Branching(CartPole):
    """A robot of one's own whose equations ask for a parameter's value."""

    def derivative(self, x, u):
        found = super().derivative(x, u)
        return found._replace(v=2 * found.v) if self.cart_mass > 2 else found


@pytest.mark.parametrize("missing", ["symbols", "compiler"])
def test_what_cant_be_compiled_is_flown_by_its_equations(missing, monkeypatch):
    base = Dynamics(Branching() if missing == "symbols" else CartPole(dt=0.04))
    if missing == "compiler":

        def none(*_, **__):
            raise CompilerError("no C compiler found")

        monkeypatch.setattr(module, "compile_batches", none)
    variants, (state, action) = Variants(base), flown(base.system)
    assert not compiles(variants)
    values = {"cart_mass": 3.0}
    torch.testing.assert_close(variants(values)(state, action), changed(base, values)(state, action))
