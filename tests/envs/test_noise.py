"""Measurement noise: how far sensors err, who sees it, and that neither the flight nor its score does."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs, step_mdp

from envs import SYSTEMS, Domain, Dynamics, InputError, make_dynamics, make_env, make_system, make_task, parse_target
from envs.dynamics import sensed
from envs.env import TrackingEnv, measured

PRESET = {"position": 0.001, "velocity": 0.02, "attitude": math.radians(0.5), "rates": 0.05}
STATES = {
    "position": {"x", "px", "py", "pz"},
    "velocity": {"v", "vx", "vy", "vz", "u_b", "v_b", "w_b"},
    "attitude": {"theta", "qw", "qx", "qy", "qz"},
    "rates": {"omega", "p", "q", "r"},
}


@pytest.fixture(scope="module", params=SYSTEMS)
def system(request):
    return request.param


def noisy_env(system, target="noise=1", size=3, steps=6, seed=0, dtype=torch.float64, **options):
    """Short flights of five episodes."""
    task = make_task(system, steps=steps)
    return TrackingEnv(
        make_dynamics(system, target), task, task.episodes(5, "train", 0).to(dtype), (size,), seed=seed, **options
    )


def drawn_actions(env, scale=0.1):
    """An actor that looks at nothing and draws small actions about trim, the same ones each time it is made."""
    generator, trim = torch.Generator().manual_seed(1), env.dynamics.system.trim_action

    def draw(state):
        noise = scale * torch.randn(len(state), len(trim), generator=generator)
        return state.new_tensor(trim) + noise.to(state)

    return TensorDictModule(draw, ["state"], ["action"])


def errors(env, tensordict):
    """What leads from the true states to the measured ones, in the tangent space (..., d)."""
    states = (tensordict["state"], tensordict["measured"])
    x, y = (env.dynamics.system.State(*part.unbind(-1)) for part in states)
    return torch.stack(env.dynamics.system.difference(x, y), -1)


# --- how far sensors err ---------------------------------------------------------------------------------------------


def test_every_system_says_which_states_each_entry_of_its_tangent_space_moves(system, draw, scalars):
    system = make_system(system)
    x = scalars(system, draw(system, 4)[0])
    assert len(system.quantities) == len(system.difference(x, x))
    for i, kind in enumerate(system.quantities):
        delta = [torch.full_like(x[0], 0.1 * (i == k)) for k in range(len(system.quantities))]
        moved = system.displaced(x, delta)
        changed = {name for name, a, b in zip(x._fields, x, moved, strict=True) if not torch.allclose(a, b, atol=1e-9)}
        assert changed
        assert changed <= STATES[kind]


@pytest.mark.parametrize("factor", [1, 0.5, 3])
def test_sensors_err_by_the_preset_times_the_factor_without_bias(system, factor):
    n = 4000
    env = noisy_env(system, f"noise={factor}", n)
    error = errors(env, env.reset())
    expected = torch.tensor([factor * PRESET[kind] for kind in env.dynamics.system.quantities], dtype=torch.float64)
    assert ((error.std(0) / expected - 1).abs() < 4.5 / math.sqrt(2 * n)).all()
    assert (error.mean(0).abs() < 4.5 * expected / math.sqrt(n)).all()


def test_the_errors_of_different_entries_and_steps_have_nothing_to_do_with_each_other(system):
    n = 4000
    env = noisy_env(system, size=n)
    flown = env.rollout(2, drawn_actions(env), break_when_any_done=False)
    error = errors(env, flown).flatten(1)  # both steps side by side
    correlation = torch.corrcoef(error.T) - torch.eye(error.shape[1])
    assert correlation.abs().max() < 5 / math.sqrt(n)


@pytest.mark.parametrize("name", ["quadrotor", "fixed_wing"])
def test_an_aircraft_is_measured_0_5_degrees_about_each_axis_away_and_stays_a_rotation(name):
    n = 4000
    env = noisy_env(name, size=n)
    now = env.rollout(3, drawn_actions(env), break_when_any_done=False)[:, -1]
    true, seen = now["state"][:, 3:7], now["measured"][:, 3:7]
    torch.testing.assert_close(seen.norm(dim=-1), torch.ones(n, dtype=torch.float64), rtol=0, atol=1e-12)
    angle = 2 * (true * seen).sum(-1).abs().clamp(max=1).acos()
    assert float(angle.square().mean().sqrt().rad2deg()) == pytest.approx(0.5 * math.sqrt(3), rel=0.04)
    way = (now["measured"] - now["state"])[:, :3].norm(dim=-1)
    assert float(way.square().mean().sqrt()) == pytest.approx(0.001 * math.sqrt(3), rel=0.04)


def test_noise_combines_with_everything_and_leaves_the_step_as_it_is(system, draw):
    dynamics = make_dynamics(system, "noise=0.5 drag=0.3 mass=x1.2")
    assert dynamics.noise == tuple(0.5 * PRESET[kind] for kind in dynamics.system.quantities)
    state, action = draw(dynamics.system, 5)
    assert torch.equal(dynamics(state, action), make_dynamics(system, "drag=0.3 mass=x1.2")(state, action))
    assert Domain(noise=0.5).deviations(dynamics.system) == dynamics.noise


def test_the_last_of_several_factors_counts_and_zero_is_none(system):
    assert parse_target("noise=1 noise=0.5", make_system(system)) == Domain(noise=0.5)
    assert parse_target("noise=0", make_system(system)) == Domain()
    assert make_dynamics(system, "noise=0").noise == make_dynamics(system).noise == ()


@pytest.mark.parametrize("value", ["-1", "x2", "1,2", "abc", "nan", "inf", ""])
def test_noise_that_is_no_factor_is_refused_in_one_line(system, value):
    with pytest.raises(InputError) as refusal:
        make_dynamics(system, f"drag=0.3 noise={value}")
    assert str(refusal.value).startswith(f"--target noise={value}: ")
    assert "\n" not in str(refusal.value)


def test_noise_that_does_not_fit_is_refused_from_python_too():
    with pytest.raises(InputError, match="noise is -1, expected a factor of at least 0"):
        Domain(noise=-1.0)
    with pytest.raises(InputError, match="cartpole: noise has 3 entries, expected 4"):
        Dynamics(make_system("cartpole"), noise=(0.1, 0.1, 0.1))


def test_a_robot_that_does_not_say_what_its_states_are_has_no_noise():
    class Unnamed(type(make_system("cartpole"))):
        quantities = ()

    assert make_dynamics(Unnamed(), "drag=0.3").noise == ()
    with pytest.raises(InputError, match="--target noise=1: noise: cartpole doesn't say what its states are"):
        make_dynamics(Unnamed(), "noise=1")


# --- who sees it -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(), (3,)], ids=["single", "batch"])
def test_the_specs_are_those_of_the_data(system, size):
    env = make_env(system, "drag=0.3 noise=1", batch_size=size, episodes=5)
    check_env_specs(env)
    assert env.observation_spec["measured"].shape == env.observation_spec["state"].shape
    check_env_specs(noisy_env(system, anywhere=True, threshold=0.2))


def test_a_policy_sees_what_was_measured_of_every_state(system):
    env = noisy_env(system, "drag=0.3 noise=1")
    flown = env.rollout(4, drawn_actions(env), break_when_any_done=False)
    for now in (flown.reshape(-1), flown["next"].reshape(-1)):
        rows, step, state = env.episodes[now["episode"].squeeze(-1)], now["step"].squeeze(-1), now["measured"]
        assert torch.equal(measured(now), state)
        reference = env.task.reference(rows, step, state)
        for key, expected in (
            ("reference", reference),
            ("window", env.task.window(state, reference)),
            ("observation", env.task.observe(state)),
        ):
            assert torch.equal(now[key], expected), key
        assert not torch.equal(now["observation"], env.task.observe(now["state"]))


def test_what_was_measured_at_the_end_of_a_step_is_what_is_seen_at_the_beginning_of_the_next(system):
    env = noisy_env(system)
    flown = env.rollout(5, drawn_actions(env), break_when_any_done=False)
    assert torch.equal(flown["next", "measured"][:, :-1], flown["measured"][:, 1:])
    assert torch.equal(flown["next", "observation"][:, :-1], flown["observation"][:, 1:])


def test_the_true_flight_and_its_rewards_and_ends_know_nothing_of_it(system):
    flights = []
    for target in ("drag=0.3", "drag=0.3 noise=20"):
        env, record = noisy_env(system, target, size=5, threshold=0.15), []
        now, actor = env.reset(TensorDict({"episode": torch.arange(5)[:, None]}, 5)), drawn_actions(env, 0.5)
        for _ in range(6):  # nobody begins again: where would be drawn
            record.append(env.step(actor(now)))
            now = step_mdp(record[-1])
        flights.append(torch.stack(record, 1))
    exact, noisy = flights
    for key in ("state", "step", "action", *(("next", name) for name in ("state", "reward", "done", "diverged"))):
        assert torch.equal(exact[key], noisy[key]), key
    assert exact["next", "truncated"][:, :5].any()  # beyond the threshold
    assert not torch.equal(exact["observation"], noisy["observation"])


def test_without_noise_there_is_no_such_key_and_nothing_is_drawn(system):
    env = noisy_env(system, "drag=0.3 noise=0")
    rows = TensorDict({"episode": torch.arange(3)[:, None]}, 3)
    before = env.generator.get_state()
    flown = env.rollout(3, drawn_actions(env), tensordict=env.reset(rows), auto_reset=False, break_when_any_done=False)
    assert torch.equal(env.generator.get_state(), before)
    described = {"state", "episode", "step", "observation", "window", "reference", "diverged"}
    assert set(env.observation_spec.keys()) == described
    ends = {"done", "terminated", "truncated"}
    assert set(flown.keys()) == {*described, *ends, "action", "next"}
    assert set(flown["next"].keys()) == {*described, *ends, "reward"}
    assert torch.equal(measured(flown), flown["state"])


# --- what it is drawn from -------------------------------------------------------------------------------------------


def test_the_same_seed_measures_the_same_and_another_one_differently(system):
    def seen(env):
        return env.rollout(3, drawn_actions(env), break_when_any_done=False)["measured"]

    first = seen(noisy_env(system, seed=3))
    assert torch.equal(seen(noisy_env(system, seed=3)), first)
    assert not torch.equal(seen(noisy_env(system, seed=4)), first)
    again = noisy_env(system, seed=4)
    again.set_seed(3)
    assert torch.equal(seen(again), first)


def test_seeding_by_a_generator_leaves_it_as_it_is_and_follows_its_state(system):
    generator, seen = torch.Generator().manual_seed(5), []
    for _ in range(2):
        env, before = noisy_env(system), generator.get_state()
        env.seed_noise(generator)
        assert torch.equal(generator.get_state(), before)
        seen.append(env.reset()["measured"])
    torch.rand((), generator=generator)
    env.seed_noise(generator)
    assert torch.equal(*seen)
    assert not torch.equal(env.reset()["measured"], seen[0])


def test_who_flies_on_while_others_begin_again_keeps_what_was_measured(system):
    env = noisy_env(system)
    now = step_mdp(env.rollout(3, drawn_actions(env), break_when_any_done=False)[:, -1])
    before = now.clone()
    now["_reset"] = torch.tensor([[False], [True], [False]])
    now = env.reset(now)
    assert now["step"].flatten().tolist() == [3, 0, 3]
    for key in ("measured", "observation"):
        assert torch.equal(now[key][[0, 2]], before[key][[0, 2]])
    far = torch.tensor([6 * PRESET[kind] for kind in env.dynamics.system.quantities], dtype=torch.float64)
    assert (errors(env, now)[1].abs() < far).all()  # of the new start
    assert torch.equal(now["observation"], env.task.observe(now["measured"]))


def test_going_on_from_a_tensordict_keeps_what_was_measured_and_draws_it_where_it_is_missing(system):
    env = noisy_env(system)
    middle = step_mdp(env.rollout(3, drawn_actions(env), break_when_any_done=False)[:, -1])
    place = ("state", "episode", "step")
    again = env.reset(middle.select(*place, "measured"), set_state=True)
    for key in ("measured", "observation", "window", "reference"):
        assert torch.equal(again[key], middle[key]), key
    drawn = env.reset(middle.select(*place), set_state=True)
    assert torch.equal(drawn["state"], middle["state"])
    assert not torch.equal(drawn["measured"], middle["measured"])


def test_gradients_through_a_noisy_flight_are_those_through_a_plain_loop_with_the_same_errors(system):
    env, generator = noisy_env(system, "drag=0.3 noise=1"), torch.Generator().manual_seed(0)
    task, dynamics = env.task, env.dynamics
    start = env.reset(TensorDict({"episode": torch.tensor([[0], [3], [1]])}, 3))
    sizes = start["observation"].shape[-1] + start["window"].flatten(-2).shape[-1], env.action_spec.shape[-1]
    weights = 0.3 * torch.randn(sizes, generator=generator, dtype=torch.float64) / sizes[0] ** 0.5
    weights.requires_grad_()

    def act(observation, window):
        return torch.cat((observation, window.flatten(-2)), -1).tanh() @ weights

    actor = TensorDictModule(act, ["observation", "window"], ["action"])
    flown = env.rollout(5, actor, tensordict=start.clone(), auto_reset=False, break_when_any_done=False)
    (gradient,) = torch.autograd.grad(flown["next", "reward"].sum(), weights)

    rows, step, state, cost = env.episodes[[0, 3, 1]], torch.zeros(3, dtype=torch.long), start["state"], 0
    env.set_seed(0)  # the first errors it draws are those of the start, again
    for _ in range(5):
        seen = sensed(dynamics.system, state, dynamics.noise, env.generator)
        action = act(task.observe(seen), task.window(seen, task.reference(rows, step, seen)))
        goal = task.reference(rows, step, state)[:, task.rewarded]
        state, step = dynamics(state, action), step + 1
        cost = cost + task.cost(state, action, goal).sum()
    torch.testing.assert_close(flown["next", "reward"].sum(), -cost)
    assert gradient.abs().max() > 0
    torch.testing.assert_close(gradient, torch.autograd.grad(-cost, weights)[0])
