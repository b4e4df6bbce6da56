"""TrackingEnv keeps the contract of TorchRL and adds nothing to the dynamics."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs, step_mdp

from envs import SYSTEMS, make_dynamics, make_env, make_task
from envs.env import TrackingEnv

TARGETS = {"source": "", "target": "drag=0.3 mass=x1.2"}


@pytest.fixture(scope="module", params=SYSTEMS)
def system(request):
    return request.param


@pytest.fixture(scope="module")
def tasks():
    """Short tasks of every system and five of their episodes, float64."""
    short = {name: make_task(name, steps=6) for name in SYSTEMS}
    return {name: (task, task.episodes(5, "train", 0).double()) for name, task in short.items()}


def short_env(system, tasks, target="", batch_size=(3,), seed=0):
    return TrackingEnv(make_dynamics(system, target), *tasks[system], batch_size, seed=seed)


def linear_policy(env):
    """tanh of a linear map of observation and window, float64."""
    example = env.reset()
    n = example["observation"].shape[-1] + example["window"].flatten(-2).shape[-1]
    net = torch.nn.Linear(n, env.action_spec.shape[-1], dtype=torch.float64)

    def act(observation, window):
        return 0.3 * net(torch.cat((observation, window.flatten(-2)), -1)).tanh()

    return net, act


def as_module(act):
    return TensorDictModule(act, in_keys=["observation", "window"], out_keys=["action"])


@pytest.mark.parametrize("batch_size", [(), (3,)], ids=["single", "batch"])
@pytest.mark.parametrize("target", TARGETS)
def test_the_specs_are_those_of_the_data(system, target, batch_size):
    env = make_env(system, TARGETS[target], batch_size=batch_size, episodes=5)
    check_env_specs(env)
    assert env.batch_size == batch_size


def test_double_precision_episodes_make_a_double_precision_environment(system, tasks):
    env = short_env(system, tasks)
    check_env_specs(env)
    assert env.rollout(2)["next", "state"].dtype == torch.float64


def test_it_runs_in_a_collector(system, tasks):
    env = short_env(system, tasks, "drag=0.3")
    _, act = linear_policy(env)
    collector = Collector(
        env, as_module(act), frames_per_batch=24, total_frames=48, auto_register_policy_transforms=False
    )
    dynamics, frames = make_dynamics(system, "drag=0.3"), 0
    for batch in collector:
        frames += batch.numel()
        expected = dynamics(batch["state"], batch["action"])
        torch.testing.assert_close(batch["next", "state"], expected)  # also after the resets at step 6
        assert (batch["step"] < 6).all()
    collector.shutdown()
    assert frames == 48


@pytest.mark.parametrize("target", TARGETS)
def test_the_gradient_through_a_rollout_is_that_through_a_plain_loop(system, target, tasks):
    env = short_env(system, tasks, TARGETS[target])
    (net, act), (task, episodes), dynamics = linear_policy(env), tasks[system], make_dynamics(system, TARGETS[target])
    rows = torch.tensor([[0], [3], [1]])
    start = env.reset(TensorDict({"episode": rows}, batch_size=3))
    flown = env.rollout(5, as_module(act), tensordict=start, auto_reset=False, break_when_any_done=False)
    flown["next", "reward"].sum().backward()

    rows, step, cost = episodes[rows.squeeze(-1)], torch.zeros(3, dtype=torch.long), 0
    state, parameters = task.start(rows, step), list(net.parameters())
    for _ in range(5):
        reference = task.reference(rows, step, state)
        action = act(task.observe(state), task.window(state, reference))
        state, step = dynamics(state, action), step + 1
        cost = cost + task.cost(state, action, reference[:, task.rewarded]).sum()
    torch.testing.assert_close(flown["next", "reward"].sum(), -cost)
    for parameter, expected in zip(parameters, torch.autograd.grad(-cost, parameters), strict=True):
        assert expected.abs().max() > 0
        torch.testing.assert_close(parameter.grad, expected)


def test_a_step_is_the_dynamics_and_the_reward_minus_the_cost_against_the_rewarded_reference_point(system, tasks, draw):
    env, (task, episodes) = short_env(system, tasks, "drag=0.3"), tasks[system]
    now = env.reset()
    now["action"] = draw(task.system, 3)[1]
    following = env.step(now)["next"]
    expected = make_dynamics(system, "drag=0.3")(now["state"], now["action"])
    torch.testing.assert_close(following["state"], expected)
    goal = task.reference(episodes[now["episode"].squeeze(-1)], torch.zeros(3, dtype=torch.long), now["state"])[
        :, task.rewarded
    ]
    torch.testing.assert_close(following["reward"], -task.cost(expected, now["action"], goal).unsqueeze(-1))
    assert (following["step"] == 1).all()
    assert torch.equal(following["episode"], now["episode"])
    torch.testing.assert_close(following["observation"], task.observe(expected))


def test_the_reward_of_a_cart_at_rest_is_the_best_and_one_that_only_slows_down_is_not_at_its_goal():
    env = make_env("cartpole")
    now = env.reset()
    rewards = []
    for speed in (0.0, 0.1):
        now["state"], now["action"] = torch.tensor([0.0, speed, 0.0, 0.0]), torch.zeros(1)
        rewards.append(env.step(now.clone())["next", "reward"].item())
    assert rewards[0] == 0
    assert rewards[1] == pytest.approx(
        -3 * 0.1**2, rel=0.05
    )  # the weight of the speed: all of it counts, not the tenth


def test_reset_starts_episodes_at_random_or_those_it_is_given(system, tasks):
    env, (task, episodes) = short_env(system, tasks), tasks[system]
    rows = torch.tensor([[4], [0], [2]])
    given = env.reset(TensorDict({"episode": rows}, batch_size=3))
    assert torch.equal(given["episode"], rows)
    torch.testing.assert_close(given["state"], task.start(episodes[[4, 0, 2]], torch.zeros(3, dtype=torch.long)))
    drawn = torch.cat([env.reset()["episode"] for _ in range(20)])
    assert set(drawn.flatten().tolist()) == set(range(5))


def test_reset_without_set_state_forgets_where_a_robot_was(system, tasks):
    """A TensorDict that carries a state is no choice of episodes."""
    env = short_env(system, tasks)
    now = env.rollout(2)[:, -1]
    fresh = torch.stack([env.reset(now, set_state=False)["episode"] for _ in range(10)])
    assert (fresh != now["episode"]).any()


def test_reset_with_set_state_goes_on_from_the_given_state(system, tasks):
    env = short_env(system, tasks)
    middle = step_mdp(env.rollout(3)[:, -1])
    again = env.reset(middle.select("state", "episode", "step"), set_state=True)
    for key in ("state", "episode", "step", "observation", "window"):
        assert torch.equal(again[key], middle[key])


def test_the_domain_survives_a_partial_reset(system, tasks, draw):
    """Physical parameters that travel in the TensorDict would be lost; drag stays."""
    env, dynamics = short_env(system, tasks, "drag=0.7"), make_dynamics(system, "drag=0.7")
    now = env.rollout(3, break_when_any_done=False)[:, -1]
    now = step_mdp(now)
    now["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(now.clone())
    assert after["step"].flatten().tolist() == [3, 0, 3]
    assert torch.equal(after["state"][[0, 2]], now["state"][[0, 2]])
    assert not torch.equal(after["state"][1], now["state"][1])
    after["action"] = draw(dynamics.system, 3)[1]
    following = env.step(after)["next", "state"]
    torch.testing.assert_close(following, dynamics(after["state"], after["action"]))
    assert not torch.allclose(following, make_dynamics(system)(after["state"], after["action"]), rtol=0, atol=1e-6)


def test_the_same_seed_draws_the_same_episodes(system, tasks):
    def drawn(seed):
        env = short_env(system, tasks, seed=seed)
        return torch.cat([env.reset()["episode"] for _ in range(10)]).flatten().tolist()

    assert drawn(0) == drawn(0) != drawn(1)
    env = short_env(system, tasks, seed=1)
    env.set_seed(0)
    assert torch.cat([env.reset()["episode"] for _ in range(10)]).flatten().tolist() == drawn(0)


def test_drawing_episodes_leaves_the_global_generator_alone(system, tasks):
    env, before = short_env(system, tasks), torch.get_rng_state()
    env.reset()
    assert torch.equal(torch.get_rng_state(), before)


def zero_action(env):
    n = env.action_spec.shape[-1]
    return TensorDictModule(lambda state: torch.zeros(*state.shape[:-1], n).to(state), ["state"], ["action"])


def test_it_is_truncated_at_its_last_step_and_not_before(system, tasks):
    env = short_env(system, tasks)
    flown = env.rollout(20, zero_action(env))
    assert flown.shape == (3, 6)
    expected = torch.tensor([False] * 5 + [True]).expand(3, 6)
    assert torch.equal(flown["next", "truncated"].squeeze(-1), expected)
    assert torch.equal(flown["next", "done"].squeeze(-1), expected)
    assert not flown["next", "terminated"].any()


def test_it_terminates_when_it_has_diverged(system, tasks):
    env = short_env(system, tasks)
    now = env.reset()
    lost = now["state"].clone()
    lost[1] += 100 * (-1) ** torch.arange(lost.shape[-1])
    lost[2] = torch.nan
    now = env.reset(now.select("episode", "step").set("state", lost), set_state=True)
    following = env.step(zero_action(env)(now))["next"]
    for key in ("diverged", "terminated", "done"):
        assert following[key].flatten().tolist() == [False, True, True], key
    assert not following["truncated"].any()


def test_a_fixed_wing_that_arrives_terminates_without_having_diverged(tasks):
    env = short_env("fixed_wing", tasks, batch_size=(1,))
    now = env.reset()
    now["state"][:, :3] = env.episodes[now["episode"].flatten()] - torch.tensor([0.2, 0, 0])
    following = env.step(zero_action(env)(env.reset(now.select("state", "episode", "step"), set_state=True)))["next"]
    assert following["terminated"].all() and following["done"].all()
    assert not following["diverged"].any()


def test_a_given_split_and_task_are_flown(system):
    env = make_env(system, split="validation", episodes=4, seed=3)
    assert torch.equal(env.episodes, env.task.episodes(4, "validation", 3))
    assert torch.equal(env.episodes, make_task(system).episodes(4, "validation", 3))
    task = make_task(system, steps=17)
    assert make_env(system, task=task, episodes=2).task is task
    assert make_env(system, task=task.sets[-1], episodes=2).task.set == task.sets[-1]


def training_env(system, tasks, size=200, **options):
    """Starts anywhere, and cuts off who strays 1 m (rad) from the reference."""
    return TrackingEnv(make_dynamics(system), *tasks[system], (size,), anywhere=True, threshold=1.0, **options)


@pytest.mark.parametrize("batch_size", [(), (3,)], ids=["single", "batch"])
def test_the_specs_hold_where_episodes_start_anywhere_and_are_cut_off(system, batch_size):
    task = make_task(system)
    episodes = task.episodes(5, "train", 0)
    check_env_specs(TrackingEnv(make_dynamics(system), task, episodes, batch_size, anywhere=True, threshold=0.2))


def test_an_episode_that_starts_anywhere_is_on_its_reference_at_that_step(system, tasks):
    env, (task, episodes) = training_env(system, tasks), tasks[system]
    now = env.reset()
    assert set(now["step"].flatten().tolist()) == set(range(task.steps))
    rows, step = episodes[now["episode"].squeeze(-1)], now["step"].squeeze(-1)
    torch.testing.assert_close(now["state"], task.start(rows, step))
    assert not now["diverged"].any()
    assert not torch.equal(env.reset()["step"], now["step"])


def test_an_episode_that_would_have_arrived_starts_at_its_beginning():
    task = make_task("fixed_wing")
    env = TrackingEnv(make_dynamics("fixed_wing"), task, task.episodes(5, "train", 0), (400,), anywhere=True)
    now = env.reset()
    rows, step = env.episodes[now["episode"].squeeze(-1)], now["step"].squeeze(-1)
    assert not task.arrived(rows, step, now["state"]).any()
    assert 80 < step.max() < 90  # 50 m at 11.5 m/s and a little more for the way sideways
    assert (step == 0).float().mean() > 0.15  # the others of 120 steps


def strayed(system, tasks, metres):
    """An environment and its next TensorDict for robots that are moved off by some distance while at step 2."""
    task, episodes = tasks[system]
    env = training_env(system, tasks, size=4)
    step = torch.full((4, 1), 2)
    state = task.start(episodes[:4], step.squeeze(-1))
    axis = {"cartpole": 2}.get(system, 1)  # the pole's angle, or a position to the side
    env.dynamics = lambda state, action: state + metres * torch.eye(state.shape[-1], dtype=state.dtype)[axis]
    now = env.reset(TensorDict({"state": state, "episode": torch.arange(4)[:, None], "step": step}, 4), set_state=True)
    now["action"] = torch.zeros(4, len(task.system.Action._fields), dtype=torch.float64)
    return env, now


@pytest.mark.parametrize(("metres", "cut_off"), [(0.0, False), (0.15, False), (0.25, True), (float("nan"), True)])
def test_who_strays_beyond_the_threshold_is_cut_off_and_one_within_it_goes_on(system, tasks, metres, cut_off):
    size = 1 if system == "cartpole" else 4  # a quadrotor's reference itself moves by some decimetres in a step
    env, now = strayed(system, tasks, size * metres)
    env.threshold = size * 0.2
    following = env.step(now)["next"]
    assert following["truncated"].all() == cut_off == following["truncated"].any()
    assert following["done"].all() == cut_off
    env.threshold = None
    assert not env.step(now)["next", "truncated"].any()


def test_a_robot_whose_rates_are_not_numbers_is_cut_off_although_it_is_in_its_place(system, tasks):
    env, now = strayed(system, tasks, 0.0)
    still = env.dynamics
    env.dynamics = lambda state, action: (
        still(state, action) * torch.tensor([1.0] * (state.shape[-1] - 1) + [torch.nan])
    )
    assert env.step(now)["next", "truncated"].all()


def test_who_is_cut_off_is_put_back_on_a_reference_at_a_random_step(system, tasks):
    env, now = strayed(system, tasks, 10.0)
    task, episodes = tasks[system]
    drawn = []
    for _ in range(30):
        _, fresh = env.step_and_maybe_reset(now.clone())
        rows, step = episodes[fresh["episode"].squeeze(-1)], fresh["step"].squeeze(-1)
        torch.testing.assert_close(fresh["state"], task.start(rows, step))
        drawn += step.tolist()
    assert set(drawn) == set(range(task.steps))
