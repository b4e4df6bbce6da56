"""Model predictive control: closed forms, an independent solver, and what happens when a solve fails."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from adapt.residual_dynamics import ResidualConfig
from adapt.residual_kinds import make_residual
from envs import SYSTEMS, make_dynamics, make_env, make_task
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.system import System, Task
from policies import generated_code, mpc_solvers
from policies.evaluate import evaluate
from policies.evaluate import test_episodes as held_back
from policies.modes import plan_cost
from policies.mpc import MPC

SOLVERS = ("fatrop", "rti", "ipopt")
needs_a_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("gcc", "cc", "clang")), reason="no C compiler"
)


class Where(NamedTuple):
    position: Any
    velocity: Any


class Push(NamedTuple):
    force: Any


@dataclass(frozen=True)
class Cart(System):
    """A double integrator on a slope: RK4 solves it exactly, so a step is x' = A x + B (u - trim)."""

    name: ClassVar[str] = "cart"
    State: ClassVar[type] = Where
    Action: ClassVar[type] = Push
    accelerations: ClassVar[tuple[str, ...]] = ("velocity",)
    residual_input_names: ClassVar[tuple[str, ...]] = ("velocity",)
    dt: float = 0.2
    gain: float = 3.0  # [m/s^2]
    slope: float = 0.3  # [-] what holds it

    @property
    def trim_action(self):
        return Push(self.slope)

    def derivative(self, x, u):
        return Where(x.velocity, self.gain * (u.force - self.slope))

    def velocity(self, x):
        return x.velocity, 0, 0

    def accelerate(self, x, acceleration):
        return {"velocity": acceleration[0]}

    def residual_inputs(self, x, u):
        return (x.velocity,)


@dataclass(frozen=True)
class Park(Task):
    """Come to rest at the origin, or wherever a test puts the reference."""

    reference_names: ClassVar[tuple[str, ...]] = ("position",)
    state_weights: ClassVar[dict[str, float]] = {"position": 2.0, "velocity": 0.5}
    action_weights: ClassVar[dict[str, float]] = {"force": 0.7}
    sets: ClassVar[tuple[str, ...]] = ("park",)
    system: Cart = Cart()
    set: str = "park"
    steps: int = 10
    horizon: int = 7

    def _unused(self, *args):
        raise NotImplementedError

    episodes = start = reference = observe = window = distance = diverged = score = _unused


def seen(state, reference, **more):
    """What an MPC reads, in double precision."""
    state, reference = torch.as_tensor(state).double(), torch.as_tensor(reference).double()
    return TensorDict({"state": state, "reference": reference, **more}, batch_size=state.shape[:-1])


def parked(*states, at=0.0):
    """States of the cart, to be brought to a position."""
    return seen(list(states), torch.full((len(states), Park().horizon, 1), at))


def around(name, n=4, spread=0.1, seed=0):
    """A task, and n states off its reference in mid-episode."""
    task, generator = make_task(name), torch.Generator().manual_seed(seed)
    episodes = task.episodes(n, "validation", seed).double()
    step = torch.randint(task.steps // 2, (n,), generator=generator)
    state = task.start(episodes, step)
    state = state + spread * torch.randn(state.shape, generator=generator, dtype=torch.float64)
    state = make_dynamics(name)(state, torch.tensor(task.system.trim_action).double().expand(n, -1))  # unit attitude
    return task, seen(state, task.reference(episodes, step, state))


def lqr_gains(system, task):
    """Feedback gains (H, 1, 2) of the finite-horizon Riccati recursion."""
    dt, weights = system.dt, task.state_weights
    a, b = np.array([[1, dt], [0, 1]]), system.gain * np.array([[dt**2 / 2], [dt]])
    q, r = np.diag([weights["position"], weights["velocity"]]), task.action_weights["force"]
    p, gains = q, []
    for _ in range(task.horizon):
        gain = b.T @ p @ a / (r + b.T @ p @ b)
        p = q + a.T @ p @ (a - b @ gain)
        gains.append(gain)
    return gains[::-1]


@pytest.mark.parametrize("solver", SOLVERS)
def test_on_a_linear_system_it_is_the_linear_quadratic_regulator(solver):
    task = Park()
    mpc, gains = MPC(Dynamics(task.system), task, solver), lqr_gains(task.system, task)
    for where, at in (([0.1, -0.2], 0.0), ([0.3, 0.05], 0.2)):
        mpc.reset()
        state = torch.tensor([where], dtype=torch.float64)
        action = mpc(parked(where, at=at))["action"]
        assert action.item() == pytest.approx(0.3 - (gains[0] @ (state[0].numpy() - [at, 0])).item(), abs=1e-4)
        actions, states = mpc.plan()
        before = np.concatenate((state.numpy(), states[:-1]))  # the whole plan is the feedback along itself
        expected = [0.3 - (gain @ (x - [at, 0])).item() for gain, x in zip(gains, before, strict=True)]
        assert actions.ravel() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("name", SYSTEMS)
def test_fatrop_finds_the_plan_of_ipopt(name):
    task, given = around(name)
    fast, oracle = MPC(make_dynamics(name), task), MPC(make_dynamics(name), task, "ipopt")
    fast(given), oracle(given)
    assert fast.failures == oracle.failures == 0
    costs = []
    for mpc in (fast, oracle):
        plans = torch.stack([torch.from_numpy(mpc.plan(row)[0]) for row in range(4)])
        costs.append(plan_cost(make_dynamics(name), task, given["state"], plans, given["reference"]))
    torch.testing.assert_close(*costs, rtol=1e-4, atol=1e-6)
    for row in range(4):
        np.testing.assert_allclose(fast.plan(row)[0][0], oracle.plan(row)[0][0], atol=5e-3)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_plan_of_ipopt_costs_no_less_when_anything_is_changed(name):
    """The cost of `task.cost` along torch's dynamics: neither the problem nor its solver is asked."""
    task, given = around(name, n=1)
    dynamics = make_dynamics(name)
    mpc = MPC(dynamics, task, "ipopt")
    mpc(given)
    plan = torch.from_numpy(mpc.plan()[0]).unsqueeze(0)
    best = plan_cost(dynamics, task, given["state"], plan, given["reference"])
    generator = torch.Generator().manual_seed(0)
    other = plan + 0.01 * torch.randn(200, *plan.shape[1:], generator=generator, dtype=torch.float64)
    states, references = (given[key].expand(200, *given[key].shape[1:]) for key in ("state", "reference"))
    costs = plan_cost(dynamics, task, states, other.clamp(-1, 1), references)
    assert (costs > best - 1e-9).all()


@pytest.mark.parametrize("name", SYSTEMS)
def test_real_time_iterations_converge_to_the_plan_of_ipopt(name):
    task, given = around(name, n=1)
    dynamics = make_dynamics(name)
    oracle = MPC(dynamics, task, "ipopt")
    oracle(given)
    solver = mpc_solvers.make_solver(dynamics, task, "rti")
    solver._far = None  # it must not help
    parameters = np.concatenate((given["state"].ravel().numpy(), given["reference"].ravel().numpy()))
    expected = np.concatenate(oracle.plan(), 1).ravel()
    found = expected + 0.01 * np.random.default_rng(0).standard_normal(len(expected))
    for _ in range(10):
        found = solver.solve(found, parameters, warm=True)
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_real_time_iteration_is_one_quadratic_program():
    task = Park()
    solver = mpc_solvers.make_solver(Dynamics(task.system), task, "rti")
    run, count = solver._step.run, []
    solver._step.run = lambda: count.append(run())
    solver._far = None
    parameters = np.concatenate(([0.1, 0.2], np.zeros(task.horizon)))
    found = solver.solve(np.zeros(3 * task.horizon), parameters, warm=True)
    assert len(count) == 1
    assert found[0] == pytest.approx(0.3 - (lqr_gains(task.system, task)[0] @ [0.1, 0.2]).item(), abs=1e-6)


@pytest.mark.parametrize("reason", ["GAP", "RESIDUAL"])
def test_a_real_time_iteration_that_is_not_good_enough_is_left_to_an_interior_point_method(monkeypatch, reason):
    monkeypatch.setattr(mpc_solvers, reason, -1.0)
    task, given = around("cartpole", n=1)
    mpc, converged = MPC(make_dynamics("cartpole"), task, "rti"), MPC(make_dynamics("cartpole"), task)
    for _ in range(3):
        torch.testing.assert_close(mpc(given.clone())["action"], converged(given.clone())["action"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("solver", ["fatrop", "rti"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_planned_states_are_those_of_the_dynamics_and_actions_stay_in_bounds(name, solver):
    task, given = around(name, spread=0.3)
    dynamics, mpc = make_dynamics(name), MPC(make_dynamics(name), task, solver)
    for _ in range(3):
        answer = mpc(given)["action"]
        assert mpc.failures == 0
        assert answer.abs().max() <= 1
        for row in range(len(given)):
            actions, states = mpc.plan(row)
            state = given["state"][row]
            for action, planned in zip(torch.from_numpy(actions), states, strict=True):
                state = dynamics(state, action)
                np.testing.assert_allclose(state.numpy(), planned, atol=3e-3 if solver == "rti" else 1e-4)
        given = given.set("state", dynamics(given["state"], answer))
    assert (answer.abs() > 0.999).any() or name == "cartpole"  # the bounds are at work


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_action_that_would_exceed_its_range_is_at_its_end(solver):
    mpc = MPC(Dynamics(Cart()), Park(), solver)
    assert mpc(parked([9.0, 0.0], [-9.0, 0.0]))["action"].ravel().tolist() == pytest.approx([-1, 1], abs=1e-5)
    assert mpc.failures == 0


@pytest.mark.parametrize("solver", [pytest.param("fatrop", marks=pytest.mark.slow), "rti"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_closed_loop_beats_doing_nothing(name, solver):
    task, dynamics = make_task(name), make_dynamics(name)
    episodes = held_back(task, 2, "validation")
    trim = torch.tensor(task.system.trim_action)
    idle = TensorDictModule(lambda state: trim.expand(len(state), -1), in_keys=["state"], out_keys=["action"])
    mpc = MPC(dynamics, task, solver)
    flown, idled = evaluate(mpc, dynamics, task, episodes), evaluate(idle, dynamics, task, episodes)
    assert flown.summary["success"] == 1
    assert (~idled.table.success | (flown.table.error < 0.2 * idled.table.error)).all()
    assert mpc.failures == 0


def test_an_environment_rolls_it_out():
    env = make_env("cartpole", batch_size=(2,), split="validation", episodes=5)
    mpc = MPC(env.dynamics, env.task, "rti")
    flight = env.rollout(250, mpc)
    assert flight.shape == (2, 250)
    assert env.action_spec.is_in(flight["action"][:, 0])
    assert flight["action"].dtype == torch.float32
    assert not flight["next", "terminated"].any()
    assert mpc.calls == 500


@pytest.mark.parametrize("solver", ["fatrop", "rti"])
def test_a_batch_is_solved_row_by_row(solver):
    task, dynamics = make_task("quadrotor"), make_dynamics("quadrotor")
    episodes = held_back(task, 3, "validation").double()
    task = make_task("quadrotor", steps=6)
    together = evaluate(MPC(dynamics, task, solver), dynamics, task, episodes).actions
    alone = [evaluate(MPC(dynamics, task, solver), dynamics, task, episodes[i : i + 1]).actions for i in range(3)]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=1e-9)


def test_batches_may_have_any_shape():
    mpc, flat = MPC(Dynamics(Cart()), Park()), MPC(Dynamics(Cart()), Park())
    states = 0.1 * torch.arange(12).reshape(6, 2)
    expected = flat(parked(*states.tolist()))["action"]
    given = seen(states.reshape(2, 3, 2), torch.zeros(2, 3, 7, 1))
    assert torch.equal(mpc(given)["action"], expected.reshape(2, 3, 1))
    assert mpc(seen(states[0], torch.zeros(7, 1)))["action"].shape == (1,)
    assert mpc(seen(torch.zeros(0, 2), torch.zeros(0, 7, 1)))["action"].shape == (0, 1)


class Spy:
    """Stands before a solver: notes whether each solve is warm, and fails when told to."""

    def __init__(self, mpc):
        self.solver, self.warm, self.fail = mpc._solver, [], False
        mpc._solver = self

    def solve(self, guess, parameters, warm):
        self.warm.append(warm)
        return None if self.fail else self.solver.solve(guess, parameters, warm)


def at(step, episode=0):
    """The cart at a step of an episode."""
    return seen([[1.0, 0.0]], torch.zeros(1, 7, 1), step=torch.tensor([[step]]), episode=torch.tensor([[episode]]))


def test_a_failed_solve_is_counted_and_goes_on_with_the_plan_before():
    mpc = MPC(Dynamics(Cart()), Park())
    spy = Spy(mpc)
    mpc(at(0))
    planned = mpc.plan()[0].ravel()
    spy.fail = True
    followed = [mpc(at(step))["action"].item() for step in range(1, 10)]
    assert followed == pytest.approx([*planned[1:], *[planned[-1]] * 3])
    assert (mpc.calls, mpc.failures) == (10, 9)
    spy.fail = False
    again = mpc(at(10))["action"].item()
    assert mpc.failures == 9
    assert again == pytest.approx(planned[0], abs=1e-4)  # nothing is left of the failures
    assert spy.warm == [False, True, *[False] * 9]


def test_a_solver_that_gives_up_is_counted_and_a_cold_row_takes_the_trim_action(monkeypatch):
    monkeypatch.setitem(mpc_solvers.OPTIONS, "fatrop", {"print_level": 0, "max_iter": 1})
    task, given = around("quadrotor", n=2)
    mpc = MPC(make_dynamics("quadrotor"), task)
    action = mpc(given)["action"]
    assert (mpc.calls, mpc.failures) == (2, 2)
    torch.testing.assert_close(action, torch.tensor(task.system.trim_action).double().expand(2, -1))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e5, 1e30])
@pytest.mark.parametrize("solver", ["fatrop", "rti"])
def test_a_state_that_is_not_finite_or_far_from_any_robot_is_counted_and_harms_no_other(solver, bad):
    task, given = around("quadrotor", n=2)
    mpc, alone = MPC(make_dynamics("quadrotor"), task, solver), MPC(make_dynamics("quadrotor"), task, solver)
    broken = given.clone()
    broken["state"][0] = bad
    action = mpc(broken)["action"]
    assert (mpc.calls, mpc.failures) == (2, 1)
    assert action[0].tolist() == pytest.approx(task.system.trim_action)
    assert torch.equal(action[1], alone(given[1:].clone())["action"][0])
    mpc(given)
    assert mpc.failures == 1  # and it recovers


def test_a_reference_that_is_not_finite_is_counted():
    mpc = MPC(Dynamics(Cart()), Park())
    assert mpc(parked([1.0, 0.0], at=float("nan")))["action"].item() == 0.3
    assert mpc.failures == 1


def test_a_row_that_is_done_is_not_solved():
    mpc = MPC(Dynamics(Cart()), Park())
    given = parked([1.0, 0.0], [1.0, 0.0]).set("done", torch.tensor([[True], [False]]))
    action = mpc(given)["action"]
    assert action[0] == 0.3
    assert action[1] != 0.3
    assert mpc.calls == 1


def test_only_the_next_step_of_the_same_episode_starts_from_the_plan_before():
    mpc = MPC(Dynamics(Cart()), Park())
    spy = Spy(mpc)
    flights = [(0, 0), (1, 0), (2, 0), (4, 0), (5, 0), (6, 1), (7, 1), (7, 1), (0, 1), (1, 1)]
    for step, episode in flights:
        mpc(at(step, episode))
    assert spy.warm == [False, True, True, False, True, False, True, False, False, True]


def test_without_a_step_every_solve_is_warm_until_a_reset_or_another_batch():
    mpc = MPC(Dynamics(Cart()), Park())
    spy = Spy(mpc)
    for rows in (1, 1, 2, 2):
        mpc(parked(*[[1.0, 0.0]] * rows))
    mpc.reset()
    mpc(parked(*[[1.0, 0.0]] * 2))
    mpc(at(0))
    assert spy.warm == [False, True, False, False, True, True, False, False, False]


def test_a_plan_from_a_warm_start_is_that_from_a_cold_one():
    task, given = around("fixed_wing", n=1)
    mpc, fresh = MPC(make_dynamics("fixed_wing"), task), MPC(make_dynamics("fixed_wing"), task)
    dynamics = make_dynamics("fixed_wing")
    for _ in range(4):
        fresh.reset()
        warm, cold = mpc(given.clone())["action"], fresh(given.clone())["action"]
        torch.testing.assert_close(warm, cold, rtol=0, atol=2e-3)
        given["state"] = dynamics(given["state"], cold)


@pytest.fixture
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "apg-adapt"


@needs_a_compiler
@pytest.mark.parametrize("solver", SOLVERS)
def test_compiled_code_does_the_same_and_is_compiled_once(empty_cache, solver):
    task = Park()
    plain, compiled = MPC(Dynamics(Cart()), task, solver), MPC(Dynamics(Cart()), task, solver, compile=True)
    assert (plain.compiled, compiled.compiled) == (False, True)
    for _ in range(3):
        given = parked([0.5, 0.3], [4.0, 0.3])
        torch.testing.assert_close(compiled(given.clone())["action"], plain(given.clone())["action"], rtol=0, atol=1e-6)
    files = {file: file.stat().st_mtime_ns for file in empty_cache.iterdir()}
    assert MPC(Dynamics(Cart()), task, solver, compile=True).compiled
    assert {file: file.stat().st_mtime_ns for file in empty_cache.iterdir()} == files
    assert MPC(Dynamics(Cart(gain=2.0)), task, solver, compile=True).compiled  # another robot, other code
    assert len(list(empty_cache.iterdir())) == 2 * len(files)


@needs_a_compiler
def test_a_damaged_library_is_compiled_again(empty_cache):
    source = "int answer(void) { return 42; }"
    library = generated_code.shared_library(source)
    good = library.read_bytes()
    library.unlink()
    library.write_bytes(good[: len(good) // 2])
    assert generated_code.shared_library(source).read_bytes() == good
    assert len(list(empty_cache.iterdir())) == 1


@needs_a_compiler
def test_two_that_compile_at_once_end_with_one_whole_library(empty_cache):
    source = "\n".join(f"int f{i}(int x) {{ return x + {i}; }}" for i in range(50))
    with ThreadPoolExecutor(4) as pool:
        libraries = set(pool.map(generated_code.shared_library, [source] * 4))
    assert [file for file in empty_cache.iterdir()] == list(libraries)


@pytest.mark.parametrize("compiler", ["none", "failing"])
@pytest.mark.parametrize("solver", ["fatrop", "rti"])
def test_without_a_working_compiler_it_runs_uncompiled_with_one_warning(
    empty_cache, monkeypatch, tmp_path, compiler, solver
):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    if compiler == "failing":
        (tmp_path / "gcc").write_text("#!/bin/sh\nexit 3\n")
        (tmp_path / "gcc").chmod(0o755)
    said = "no C compiler found" if compiler == "none" else "gcc failed with status 3"
    with pytest.warns(UserWarning, match=said) as warned:
        mpc = MPC(Dynamics(Cart()), Park(), solver, compile=True)
    assert len(warned) == 1
    assert not mpc.compiled
    plain = MPC(Dynamics(Cart()), Park(), solver)
    assert torch.equal(mpc(parked([0.2, 0.1]))["action"], plain(parked([0.2, 0.1]))["action"])


def test_a_cache_that_cannot_be_written_is_a_warning(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="MPC runs uncompiled"):
        assert not MPC(Dynamics(Cart()), Park(), compile=True).compiled


def residual_with_network(name, kind):
    """A residual whose network does something."""
    residual = make_residual(make_dynamics(name), ResidualConfig(kind, hidden=16))
    network = residual.network
    network.last += 0.02 * torch.randn(network.last.shape, generator=torch.Generator().manual_seed(1)).double()
    return residual


@pytest.mark.parametrize("kind", ["acceleration", "state"])
@pytest.mark.parametrize("solver", ["fatrop", "rti"])
def test_it_plans_through_the_network_of_a_residual(kind, solver):
    import casadi

    residual = residual_with_network("quadrotor", kind)
    task, given = around("quadrotor", n=1)
    assert isinstance(mpc_solvers.make_problem(residual, task).gaps, casadi.MX)
    mpc, nominal = MPC(residual, task, solver), MPC(make_dynamics("quadrotor"), task, solver)
    action = mpc(given.clone())["action"]
    assert mpc.failures == 0
    assert (action - nominal(given.clone())["action"]).abs().max() > 1e-3
    state, (actions, states) = given["state"], mpc.plan()
    for action, planned in zip(torch.from_numpy(actions), states, strict=True):
        state = residual(state, action)
        np.testing.assert_allclose(state[0].detach().numpy(), planned, atol=1e-4)


def test_scalar_dynamics_are_written_out_in_scalars():
    import casadi

    problem = mpc_solvers.make_problem(make_dynamics("quadrotor", "drag=0.3"), make_task("quadrotor"))
    assert isinstance(problem.gaps, casadi.SX)


def test_a_model_of_the_target_flies_the_target_better_than_the_nominal_one():
    task, target = make_task("quadrotor", steps=40), make_dynamics("quadrotor", "drag=0.3")
    episodes = held_back(make_task("quadrotor"), 2, "validation")
    true, nominal = (MPC(model, task, "rti") for model in (target, make_dynamics("quadrotor")))
    errors = [evaluate(mpc, target, task, episodes).table.error.mean() for mpc in (true, nominal)]
    assert errors[0] < errors[1] / 2


def test_an_unknown_solver_is_refused():
    with pytest.raises(InputError, match="--solver magic: expected one of fatrop, rti, ipopt"):
        MPC(Dynamics(Cart()), Park(), "magic")


def test_a_solver_that_casadi_was_built_without_is_refused_and_others_are_named(monkeypatch):
    import casadi

    monkeypatch.setattr(casadi, "has_nlpsol", lambda name: name == "ipopt")
    with pytest.raises(InputError, match=r"--solver fatrop: not in this build of casadi; it has ipopt, rti"):
        MPC(Dynamics(Cart()), Park())
    MPC(Dynamics(Cart()), Park(), "rti")  # its cold starts are left to ipopt then
    monkeypatch.setattr(casadi, "has_conic", lambda name: False)
    with pytest.raises(InputError, match=r"--solver rti: not in this build of casadi; it has ipopt$"):
        MPC(Dynamics(Cart()), Park(), "rti")


def test_real_time_iterations_do_without_hpipm(monkeypatch):
    import casadi

    task = Park()
    monkeypatch.setattr(casadi, "has_conic", lambda name: name == "qrqp")
    mpc, gains = MPC(Dynamics(task.system), task, "rti"), lqr_gains(task.system, task)
    for _ in range(2):
        action = mpc(parked([0.1, -0.2]))["action"].item()
        assert action == pytest.approx(0.3 - (gains[0] @ [0.1, -0.2]).item(), abs=1e-4)


def test_what_it_cannot_plan_for_is_refused():
    class Crooked(Park):
        def cost(self, state, action, reference):
            return state.abs().sum(-1)

    with pytest.raises(InputError, match="Crooked has a cost of its own"):
        MPC(Dynamics(Cart()), Crooked())
    with pytest.raises(InputError, match=r"has no casadi\(\)"):
        MPC(torch.nn.Linear(1, 1), Park())
    with pytest.raises(InputError, match="reference of 5 points, expected the horizon 7"):
        MPC(Dynamics(Cart()), Park())(seen([[0.0, 0.0]], torch.zeros(1, 5, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "limit"), [("quadrotor", 0.005), ("fixed_wing", 0.001), ("cartpole", 0.008)])
def test_the_error_on_validation_episodes_is_small(name, limit):
    task, dynamics = make_task(name), make_dynamics(name)
    mpc = MPC(dynamics, task, "rti")
    result = evaluate(mpc, dynamics, task, held_back(task, 20, "validation"))
    assert result.summary["success"] == 1
    assert result.summary["mean"] < limit
    assert mpc.failures == 0


def test_it_plans_from_what_was_measured_where_sensors_err():
    env = make_env("quadrotor", "noise=1", batch_size=(2,), split="validation", episodes=5)
    now = env.reset()
    seen = now.select("measured", "reference").rename_key_("measured", "state")
    actions = [MPC(env.dynamics, env.task)(what.clone())["action"] for what in (now, seen, now.exclude("measured"))]
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


@pytest.mark.parametrize("words", ["KeyboardInterrupt", "process failed"])
def test_an_interrupt_within_a_solver_is_no_failed_plan(words):
    """CasADi tells of Ctrl-C in two ways, of which neither is a `KeyboardInterrupt`."""

    def failing():
        raise RuntimeError(words)

    mpc = MPC(make_dynamics("cartpole"), make_task("cartpole"))
    buffer = mpc._solver._solver
    buffer._run = failing
    with pytest.raises(KeyboardInterrupt if words == "KeyboardInterrupt" else RuntimeError):
        buffer.run()


def test_an_interrupt_that_casadi_returns_from_is_one():
    def returning():
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    mpc = MPC(make_dynamics("cartpole"), make_task("cartpole"))
    mpc._solver._solver._run = returning
    with pytest.raises(KeyboardInterrupt):
        mpc._solver._solver.run()
