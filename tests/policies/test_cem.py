"""The planner finds the optimum that algebra gives, for every row of a batch, and never passes on what isn't finite."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from envs import make_dynamics, make_env, make_system, make_task
from envs.errors import InputError
from policies.cem import CEM, PlannerConfig

CAREFUL = PlannerConfig(candidates=200, elites=20, iterations=8, min_std=0.001)


class Known:
    """Cart and pole as they are, or a double integrator, behind the face of an ensemble of `members` that agree."""

    def __init__(self, step, members=1, outputs=4):
        self.step, self.members, self.outputs = step, members, outputs
        self.system, self.rows = make_task("cartpole").system, []

    def __call__(self, state, action):
        return self.step(state, action)

    def sample(self, state, action, noise):
        self.rows.append(state.shape[:-1].numel())
        return self.step(state, action)


def push(state, action):
    """v grows by the action, nothing else moves."""
    return state + action * state.new_tensor([0.0, 1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def task():
    """Cost: 10 theta² + 3 (v - reference)² + omega²; the reference falls to zero over the horizon."""
    return make_task("cartpole", horizon=4)


def situation(task, speeds, **more):
    """A TensorDict of carts at these speeds."""
    state = torch.zeros(len(speeds), 4)
    state[:, 1] = torch.tensor(speeds)
    reference = task.reference(None, None, state)
    return TensorDict({"state": state, "reference": reference, **more}, batch_size=(len(speeds),))


def at(episode, step, n=1):
    return {"episode": torch.full((n, 1), episode), "step": torch.full((n, 1), step)}


def planner(task, step=push, config=CAREFUL, seed=0, members=1):
    return CEM(Known(step, members), task, config, seed)


def test_the_plan_is_the_optimum_of_a_quadratic_cost(task):
    """With v' = v + u and a cost of (v - reference)² alone, the best action makes up for the difference at once."""
    cem = planner(task)
    now = situation(task, [0.8, -0.4, 0.0], **at(0, 0, 3))
    action = cem(now)["action"]
    expected = now["reference"][:, 0, 1:2] - now["state"][:, 1:2]
    torch.testing.assert_close(action, expected, rtol=0, atol=0.02)
    plan = cem.memory[0]
    assert plan.shape == (3, 4, 1)
    expected = now["reference"][..., 1].diff(dim=1, prepend=now["state"][:, 1:2])
    torch.testing.assert_close(plan[..., 0], expected, rtol=0, atol=0.04)


def test_with_a_price_on_the_action_the_optimum_is_that_of_least_squares():
    """The trade between action and deviation is that of the normal equations, solved by hand for one step."""
    task = make_task("quadrotor", "hover", horizon=1)
    up = task.system.State._fields.index("vz")

    def step(state, action):
        return state + action[..., :1] * torch.nn.functional.one_hot(torch.tensor(up), 13)

    cem = CEM(Known(step, outputs=12), task, replace(CAREFUL, iterations=10))
    state = torch.zeros(1, 13)
    state[0, 3], state[0, up] = 1.0, -0.5
    action = cem(TensorDict({"state": state, "reference": torch.zeros(1, 1, 6)}, batch_size=(1,)))["action"]
    trim = task.system.trim_action.thrust
    # min (u - 0.5)^2 + 1.25 (u - trim)^2
    assert float(action[0, 0]) == pytest.approx((0.5 + 1.25 * trim) / 2.25, abs=0.02)
    assert action[0, 1:].abs().max() < 0.1


def test_the_action_stays_in_bounds_where_the_optimum_lies_beyond(task):
    cem = planner(task)
    action = cem(situation(task, [30.0, -30.0], **at(0, 0, 2)))["action"]
    assert action.abs().max() <= 1
    assert cem.memory[0].abs().max() <= 1  # nor does any later part of a plan promise more than can be flown
    torch.testing.assert_close(action, torch.tensor([[-1.0], [1.0]]), rtol=0, atol=0.05)


def test_a_batch_is_planned_as_well_as_each_row_alone(task):
    """The same robot in every row: actions scatter about the same mean as those of single planners do."""
    quick = PlannerConfig(candidates=30, elites=5, iterations=2)
    together = planner(task, config=quick)(situation(task, [0.5] * 200))["action"]
    alone = torch.cat([planner(task, config=quick, seed=seed)(situation(task, [0.5]))["action"] for seed in range(200)])
    assert together.std() > 0
    error = (together.std() ** 2 / 200 + alone.std() ** 2 / 200).sqrt()
    assert (together.mean() - alone.mean()).abs() < 4 * error
    assert 0.7 < together.std() / alone.std() < 1.4


def test_rows_of_a_batch_do_not_mix(task):
    speeds = [0.9, -0.9, 0.3, -0.3, 0.0]
    action = planner(task)(situation(task, speeds))["action"][:, 0]
    torch.testing.assert_close(action, -torch.tensor(speeds) / 4, rtol=0, atol=0.02)


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_any_batch_shape_is_planned_for(task, batch):
    now = situation(task, [0.4] * 6)
    now = now[0] if batch == () else now.reshape(batch)
    assert planner(task)(now)["action"].shape == (*batch, 1)


# --- warm start --------------------------------------------------------------------------------------------------


def frozen(task, **settings):
    """A planner that leaves plans as they are: every candidate costs the same to nobody, so none is finite."""
    return planner(task, lambda state, action: state * math.nan, replace(CAREFUL, iterations=1, **settings))


def test_the_next_plan_starts_from_the_rest_of_the_last_one(task):
    cem = frozen(task)
    plan = torch.tensor([0.1, 0.2, 0.3, 0.4]).reshape(1, 4, 1)
    cem.memory = (plan, torch.tensor([7]), torch.tensor([3]))
    action = cem(situation(task, [0.0], **at(7, 4)))["action"]
    torch.testing.assert_close(action, torch.tensor([[0.2]]))
    torch.testing.assert_close(cem.memory[0][0, :, 0], torch.tensor([0.2, 0.3, 0.4, 0.4]))


@pytest.mark.parametrize(("episode", "step"), [(8, 4), (7, 3), (7, 5), (7, 0)])
def test_another_episode_or_step_starts_cold_from_trim(task, episode, step):
    cem = frozen(task)
    cem.memory = (torch.full((1, 4, 1), 0.5), torch.tensor([7]), torch.tensor([3]))
    assert float(cem(situation(task, [0.0], **at(episode, step)))["action"]) == 0.0


def test_rows_are_remembered_one_by_one(task):
    cem = frozen(task)
    cem.memory = (torch.full((3, 4, 1), 0.5), torch.tensor([1, 2, 3]), torch.tensor([3, 3, 3]))
    place = {"episode": torch.tensor([[1], [9], [3]]), "step": torch.tensor([[4], [4], [0]])}
    assert cem(situation(task, [0.0] * 3, **place))["action"][:, 0].tolist() == [0.5, 0.0, 0.0]


def test_another_number_of_rows_or_no_word_of_the_step_starts_cold(task):
    cem = frozen(task)
    for given in (situation(task, [0.0] * 2, **at(7, 4, 2)), situation(task, [0.0])):
        cem.memory = (torch.full((1, 4, 1), 0.5), torch.tensor([7]), torch.tensor([3]))
        assert (cem(given)["action"] == 0).all()


def test_the_trim_of_a_cold_start_is_that_of_the_robot():
    task = make_task(replace(make_system("quadrotor"), gravity=8.0), "hover")
    assert task.system.trim_action.thrust < -0.2
    cem = CEM(Known(lambda state, action: state * math.nan, outputs=12), task, PlannerConfig(iterations=1))
    env = make_env(task.system, task=task, batch_size=(2,), episodes=2)
    torch.testing.assert_close(cem(env.reset())["action"], torch.tensor([task.system.trim_action] * 2))


def test_a_warm_start_searches_more_narrowly(task):
    """One candidate more than the mean, one iteration: the step away from the mean is the standard deviation's."""
    config = PlannerConfig(candidates=200, elites=200, iterations=1, momentum=0.0, cold_std=0.4, warm_std=0.05)
    spreads = []
    for step in (0, 1):
        seen = []
        cem = planner(task, config=config)
        cem._candidates = lambda mean, std, cem=cem, seen=seen: seen.append(CEM._candidates(cem, mean, std)) or seen[-1]
        cem.memory = (torch.zeros(1, 4, 1), torch.tensor([0]), torch.tensor([0]))
        cem(situation(task, [0.0], **at(0, step)))
        spreads.append(float(seen[0].std()))
    assert spreads == pytest.approx([0.4, 0.05], rel=0.1)


# --- the distribution --------------------------------------------------------------------------------------------


def test_the_standard_deviation_never_falls_below_its_least(task):
    stds = []
    cem = planner(task, config=replace(CAREFUL, min_std=0.03, iterations=12))
    original = cem._candidates
    cem._candidates = lambda mean, std: stds.append(std) or original(mean, std)
    cem(situation(task, [0.5]))
    assert len(stds) == 12
    assert all((std >= 0.03).all() for std in stds)
    assert stds[-1].max() < 0.04
    assert (stds[0] == 0.5).all()


def test_momentum_keeps_its_share_of_the_old_mean_and_standard_deviation(task):
    state, reference = (situation(task, [0.8])[key] for key in ("state", "reference"))
    mean, std = torch.full((1, 4, 1), 0.3), torch.full((1,), 0.5)
    ends = []
    for momentum in (0.0, 0.25, 0.99):
        cem = planner(task, config=replace(CAREFUL, iterations=1, momentum=momentum))
        ends.append(cem.optimise(state, reference, mean, std)[0])
    torch.testing.assert_close(ends[1], 0.25 * mean + 0.75 * ends[0])
    torch.testing.assert_close(ends[2], 0.99 * mean + 0.01 * ends[0])


def test_one_iteration_gives_the_mean_of_the_best_candidates(task):
    cem = planner(task, config=replace(CAREFUL, iterations=1, momentum=0.0, elites=7))
    seen, original = [], cem._candidates
    cem._candidates = lambda mean, std: seen.append(original(mean, std)) or seen[-1]
    now = situation(task, [0.8, -0.2])
    cem(TensorDict({**now, **at(0, 0, 2)}, batch_size=(2,)))
    speed = now["state"][:, None, None, 1] + seen[0][..., 0].cumsum(-1)
    cost = (speed - now["reference"][:, None, :, 1]).square().sum(-1)
    for row in range(2):
        best = seen[0][row, cost[row].argsort()[:7]]
        torch.testing.assert_close(cem.memory[0][row], best.mean(0))


def test_the_cost_of_a_plan_is_that_of_the_task_along_the_flight():
    task, dynamics = make_task("quadrotor"), make_dynamics("quadrotor")
    cem = CEM(Known(dynamics, outputs=12), task, PlannerConfig())
    episodes = task.episodes(2, "train", 0)
    step = torch.zeros(2, dtype=torch.long)
    state = task.start(episodes, step)
    reference = task.reference(episodes, step, state)
    plans = torch.rand(2, 3, 10, 4, generator=torch.Generator().manual_seed(0)) - 0.5
    x, expected = state[:, None].expand(-1, 3, -1), 0
    for k in range(10):
        x = dynamics(x, plans[:, :, k])
        expected = expected + task.cost(x, plans[:, :, k], reference[:, None, k])
    torch.testing.assert_close(cem.cost(state, plans, reference), expected)


def test_a_plan_shorter_than_the_reference_uses_its_beginning():
    task = make_task("cartpole", horizon=6)
    cem = CEM(Known(push), task, replace(CAREFUL, horizon=3))
    now = situation(task, [0.6], **at(0, 0))
    assert float(cem(now)["action"]) == pytest.approx(-0.1, abs=0.02)
    assert cem.memory[0].shape[1] == 3
    assert CEM(Known(push), task, replace(CAREFUL, horizon=9)).planning_horizon == 6


def test_every_particle_of_every_member_counts_the_same(task):
    """Member 0 says that the action moves the cart, member 1 that it doesn't: what counts is the mean of both."""

    class Divided(Known):
        def sample(self, state, action, noise):
            self.shapes = state.shape, noise.shape
            moved = push(state, action)
            return torch.cat((moved[:1], state[1:]))

    task = make_task("cartpole", horizon=1)
    model = Divided(push, members=2)
    cem = CEM(model, task, replace(CAREFUL, particles=3, candidates=10, elites=2))
    state, reference = (situation(task, [0.5, 0.2])[key] for key in ("state", "reference"))
    plans = torch.tensor([-0.5, 0.0, 0.5]).reshape(1, 3, 1, 1).expand(2, -1, -1, -1)
    expected = 0.5 * 3 * ((state[:, None, 1] + plans[..., 0, 0]).square() + state[:, None, 1].square())
    torch.testing.assert_close(cem.cost(state, plans, reference), expected)
    assert model.shapes == ((2, 3 * 2 * 3, 4), (2, 3 * 2 * 3, 4))


def test_candidates_share_their_noise_and_particles_do_not(task):
    class Noisy(Known):
        def sample(self, state, action, noise):
            self.noise = noise
            return push(state, action) + noise

    model = Noisy(push, members=2)
    cem = CEM(model, task, replace(CAREFUL, particles=3))
    now = situation(task, [0.5, 0.2])
    cem.cost(now["state"], torch.zeros(2, 5, 4, 1), now["reference"])
    noise = model.noise.reshape(2, 3, 2, 5, 4)  # members, particles, rows, candidates
    assert torch.equal(noise, noise[:, :, :, :1].expand_as(noise))
    assert len(noise[:, :, :, 0].flatten().unique()) == 2 * 3 * 2 * 4


# --- what isn't finite -------------------------------------------------------------------------------------------


def test_a_model_that_gives_no_number_leaves_the_rest_of_the_plan_and_is_counted(task):
    cem = frozen(task)
    cem.memory = (torch.full((2, 4, 1), 0.5), torch.tensor([7, 7]), torch.tensor([3, 3]))
    action = cem(situation(task, [0.0] * 2, **at(7, 4, 2)))["action"]
    assert action[:, 0].tolist() == [0.5, 0.5]
    assert (cem.calls, cem.failures) == (2, 2)


def test_a_row_whose_state_is_not_finite_fails_alone(task):
    cem = planner(task)
    now = situation(task, [0.8, math.nan, -0.8])
    action = cem(now)["action"][:, 0]
    torch.testing.assert_close(action, torch.tensor([-0.2, 0.0, 0.2]), rtol=0, atol=0.02)
    assert (cem.calls, cem.failures) == (3, 1)


def test_candidates_without_a_finite_cost_are_never_among_the_best(task):
    """Beyond an action of 0.05 either way the model breaks down: what is left is enough, however little it is."""

    def step(state, action):
        return torch.where(action.abs() > 0.05, math.nan, push(state, action))

    cem = planner(task, step, replace(CAREFUL, candidates=1000, elites=500))
    now = situation(task, [0.8])
    cost = cem.cost(now["state"], torch.tensor([0.0, 0.1]).reshape(1, 2, 1, 1).expand(1, 2, 4, 1), now["reference"])
    assert cost.isfinite().tolist() == [[True, False]]
    assert cost[0, 1] == math.inf
    action = cem(now)["action"]
    assert action.isfinite().all()
    assert -0.06 < float(action) < -0.02
    assert cem.failures == 0


def test_a_model_that_always_works_has_no_failures(task):
    cem = planner(task)
    for step in range(3):
        cem(situation(task, [0.5] * 4, **at(0, step, 4)))
    assert (cem.calls, cem.failures) == (12, 0)


def test_rows_that_are_done_are_left_out_of_planning(task):
    cem = planner(task)
    done = torch.tensor([[False], [True], [False]])
    now = situation(task, [0.8, 0.8, -0.8], done=done)
    action = cem(now)["action"][:, 0]
    torch.testing.assert_close(action, torch.tensor([-0.2, 0.0, 0.2]), rtol=0, atol=0.02)
    assert cem.calls == 2
    assert sum(cem.dynamics.rows) == 2 * 200 * 8 * 4


# --- in the environment ------------------------------------------------------------------------------------------


def test_it_balances_a_pole_in_the_environment_better_than_doing_nothing():
    dynamics = make_dynamics("cartpole")
    task = replace(make_task("cartpole"), steps=40)
    env = make_env("cartpole", task=task, batch_size=(4,), episodes=4)
    cem = CEM(Known(dynamics), task, PlannerConfig(warm_std=0.05))
    flight = env.rollout(40, cem, break_when_any_done=False)
    assert flight["next", "state"][..., 2].abs().max() < 0.2
    assert flight["next", "state"][:, 20:, 1].abs().mean() < 0.1
    assert (cem.calls, cem.failures) == (160, 0)


def test_the_same_seed_plans_the_same_and_leaves_the_global_generator_alone(task):
    now = situation(task, [0.8, 0.3])
    before = torch.get_rng_state()
    actions = [planner(task, seed=seed)(now.clone())["action"] for seed in (0, 0, 1)]
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


@pytest.mark.parametrize(
    "changes",
    [
        *({name: 0} for name in ("horizon", "candidates", "elites", "iterations", "particles")),
        {"elites": 101},
        {"momentum": 1.0},
        {"momentum": -0.1},
        *({name: value} for name in ("cold_std", "warm_std", "min_std") for value in (0.0, math.nan)),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes):
    name, value = next(iter(changes.items()))
    with pytest.raises(InputError, match=f"PlannerConfig.{name} {value}: expected "):
        PlannerConfig(**changes)


def test_it_plans_from_what_was_measured_where_sensors_err(task):
    state = torch.tensor([[0.0, 0.5, 0.0, 0.0]])
    true, seen = situation(task, [0.1]), situation(task, [0.5])
    both = seen.clone().set("state", true["state"]).set("measured", state)
    assert torch.equal(planner(task)(both)["action"], planner(task)(seen)["action"])
