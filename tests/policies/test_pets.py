"""PETS in rounds: every flight counts towards the budget, what was flown is what is learned, and runs go on exactly."""

import io
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from envs import SYSTEMS, InputError, make_dynamics, make_system, make_task
from policies import evaluate, pets
from policies.cem import PlannerConfig
from policies.ensemble import FitConfig

TINY = pets.Config(
    samples=60,
    rounds=3,
    members=2,
    width=8,
    layers=1,
    fit=FitConfig(steps=10),
    planner=PlannerConfig(horizon=2, candidates=4, elites=2, iterations=1),
)


class Counting:
    """Dynamics that count the control periods flown in them."""

    def __init__(self, dynamics):
        self.dynamics, self.system, self.calls = dynamics, dynamics.system, []

    def __call__(self, state, action):
        self.calls.append((state.clone(), action.clone()))
        return self.dynamics(state, action)


@pytest.fixture
def cartpole():
    task = replace(make_task("cartpole"), steps=20)
    return task, make_dynamics("cartpole"), [task.episodes(6, "train", 0)]


def trained(setting, config=TINY, seed=0, network=None, dynamics=None):
    task, source, banks = setting
    run = pets.begin(source, task, banks, config, seed, network)
    return run, list(pets.train(run, dynamics or source, task, banks, config))


def numbers(run):
    """Everything in a run as one tensor."""
    saved = run.state_dict()
    tensors = [*saved["network"].values(), *saved["flown"].values(), saved["generator"]]
    return torch.cat([tensor.flatten().double() for tensor in tensors])


# --- the budget --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("samples", "rounds"), [(60, 3), (61, 4), (7, 3), (1, 1), (2, 5), (1, 5)])
def test_the_budget_is_used_up_and_never_exceeded(cartpole, samples, rounds):
    config = replace(TINY, samples=samples, rounds=rounds)
    run, rows = trained(cartpole, config)
    assert len(rows) == config.updates == min(samples, rounds)
    shares = [row["samples"] for row in rows]
    assert shares == [samples * (i + 1) // config.updates for i in range(config.updates)]
    assert run.samples == samples == len(run.flown["state"])


def test_what_is_remembered_is_what_was_flown(cartpole):
    """Every remembered transition was taken in the environment and obeys its equations."""
    dynamics = cartpole[1]
    flown = Counting(dynamics)
    run, _ = trained(cartpole, dynamics=flown)
    taken = {tuple(row) for state, action in flown.calls for row in torch.cat((state, action), -1).tolist()}
    kept = torch.cat((run.flown["state"], run.flown["action"]), -1).tolist()
    assert {tuple(row) for row in kept} <= taken
    torch.testing.assert_close(dynamics(run.flown["state"], run.flown["action"]), run.flown["next_state"])
    assert run.flown["action"].abs().max() <= 1


def still(task):
    return TensorDictModule(
        lambda state: state.new_zeros(*state.shape[:-1], len(task.system.Action._fields)), ["state"], ["action"]
    )


def test_a_flight_ends_with_its_episode(cartpole):
    """Pushed one way only, the pole falls within the episode: what comes after isn't learned from, nor paid for."""
    task, dynamics, banks = cartpole
    push = TensorDictModule(lambda state: torch.ones(*state.shape[:-1], 1), ["state"], ["action"])
    (state, _, following), cost = pets.fly(push, dynamics, task, banks[0], 60, 0.0, torch.Generator().manual_seed(0))
    assert not task.diverged(None, None, state).any()
    assert task.diverged(None, None, following).sum() == 3
    assert len(state) == len(cost) < 60


def test_a_flight_lasts_as_long_as_its_episode_and_a_budget_is_spent_to_the_last_step(cartpole):
    task, dynamics, banks = cartpole
    task = replace(task, steps=10)
    for budget, expected in ((25, 25), (30, 30), (1, 1), (11, 11)):
        flown, cost = pets.fly(still(task), dynamics, task, banks[0], budget, 0.0, torch.Generator().manual_seed(0))
        assert len(cost) == len(flown[0]) == expected


def test_states_that_are_not_finite_end_a_flight_and_are_paid_for_but_not_learned(cartpole):
    task, dynamics, banks = cartpole
    steps = []

    def failing(state, action):
        steps.append(1)
        broken = dynamics(state, action)
        if len(steps) == 3:
            broken[0] = math.nan
        return broken

    failing.system = dynamics.system
    (state, action, following), cost = pets.fly(still(task), failing, task, banks[0], 40, 0.0, torch.Generator())
    assert len(cost) == 3 + 20
    assert len(state) == len(action) == len(following) == 2 + 20
    assert following.isfinite().all()


def test_a_robot_that_never_gives_a_number_is_told_in_one_line(cartpole):
    dynamics = cartpole[1]

    def broken(state, action):
        return state * math.nan

    broken.system = dynamics.system
    with pytest.raises(InputError, match="pets: no flight gave finite numbers"):
        trained(cartpole, dynamics=broken)


def test_noise_is_added_to_what_the_planner_wants(cartpole):
    task, dynamics, banks = cartpole
    (_, quiet, _), _ = pets.fly(still(task), dynamics, task, banks[0], 60, 0.0, torch.Generator().manual_seed(0))
    (_, noisy, _), _ = pets.fly(still(task), dynamics, task, banks[0], 60, 0.1, torch.Generator().manual_seed(0))
    assert (quiet == 0).all()
    assert float(noisy.std()) == pytest.approx(0.1, rel=0.3)


# --- rounds ------------------------------------------------------------------------------------------------------


def test_the_first_round_is_random_about_trim_with_the_spread_and_memory_that_were_asked_for():
    task = make_task(replace(make_system("quadrotor"), gravity=8.0))
    config = replace(TINY, first_std=0.2, memory=0.9)
    random = pets.random_actor(task, config, 0)
    seen = torch.stack([random(TensorDict(state=torch.zeros(500, 13)))["action"] for _ in range(60)])
    trim = torch.tensor(task.system.trim_action)
    torch.testing.assert_close(seen.mean((0, 1)), trim, rtol=0, atol=0.02)
    torch.testing.assert_close(seen.std((0, 1)), torch.full((4,), 0.2), rtol=0.1, atol=0)
    now, before = (seen[1:] - trim).flatten(), (seen[:-1] - trim).flatten()
    assert float((now * before).mean() / before.square().mean()) == pytest.approx(0.9, abs=0.02)


def test_the_first_round_of_a_new_ensemble_is_random_and_the_others_are_planned(cartpole, monkeypatch):
    planned, original = [], pets.actor
    monkeypatch.setattr(pets, "actor", lambda *args: planned.append(args) or original(*args))
    trained(cartpole)
    assert len(planned) == TINY.rounds - 1


def test_a_trained_ensemble_flies_in_its_first_round_and_keeps_its_normalisation(cartpole, monkeypatch):
    first, _ = trained(cartpole)
    before = {name: value.clone() for name, value in first.network.state_dict().items()}
    planned, original = [], pets.actor
    monkeypatch.setattr(pets, "actor", lambda *args: planned.append(args) or original(*args))
    target = Counting(make_dynamics("cartpole", "drag=0.5"))
    run, rows = trained(cartpole, replace(TINY, samples=30), seed=1, network=first.network, dynamics=target)
    assert len(planned) == TINY.rounds
    assert run.samples == rows[-1]["samples"] == 30
    after = run.network.state_dict()
    assert all(torch.equal(after[name], before[name]) for name in before if name.startswith(("input_", "output_")))
    assert not all(torch.equal(after[name], before[name]) for name in before)
    assert all(torch.equal(value, before[name]) for name, value in first.network.state_dict().items())
    torch.testing.assert_close(target.dynamics(run.flown["state"], run.flown["action"]), run.flown["next_state"])


def test_the_planner_of_a_trained_ensemble_goes_on_unless_another_is_asked_for(cartpole):
    first, _ = trained(cartpole)
    assert first.network.config.planner == TINY.planner
    kept = pets.begin(None, cartpole[0], cartpole[2], replace(TINY, planner=None), 0, first.network)
    assert kept.network.config.planner == TINY.planner
    other = pets.begin(None, cartpole[0], cartpole[2], replace(TINY, planner=PlannerConfig()), 0, first.network)
    assert other.network.config.planner == PlannerConfig()
    assert pets.actor(first.network, cartpole[0], candidates=7).num_candidates == 7


def test_every_speed_of_the_curriculum_is_flown_slowest_first(cartpole, monkeypatch):
    task, dynamics, _ = cartpole
    banks, flown, original = [torch.full((2, 4), 0.01 * i) for i in range(2)], [], pets.fly
    monkeypatch.setattr(pets, "fly", lambda *args: flown.append(float(args[3][0, 0])) or original(*args))
    run = pets.begin(dynamics, task, banks, TINY, 0)
    list(pets.train(run, dynamics, task, banks, TINY))
    assert flown == sorted(flown)
    assert set(flown) == {float(bank[0, 0]) for bank in banks}


def test_bootstrap_samples_are_those_of_drawing_with_replacement_and_some_rows_are_held_out(cartpole):
    task, dynamics, banks = cartpole
    run = pets.begin(dynamics, task, banks, replace(TINY, members=5), 0)
    pets._remember(run, (torch.zeros(4000, 4), torch.zeros(4000, 1), torch.zeros(4000, 4)), replace(TINY, held_out=0.2))
    counts = run.flown["counts"]
    held = (counts < 0).any(-1)
    assert (counts[held] == -1).all()
    assert float(held.float().mean()) == pytest.approx(0.2, abs=0.03)
    used = counts[~held].double()
    assert float(used.mean()) == pytest.approx(1, abs=0.03)
    assert float((used == 0).double().mean()) == pytest.approx(math.exp(-1), abs=0.03)
    correlation = torch.corrcoef(used.T) - torch.eye(5)
    assert correlation.abs().max() < 0.08


def test_the_metrics_are_plain_numbers(cartpole):
    _, rows = trained(cartpole)
    for row in rows:
        assert {"update", "samples", "cost", "nll", "failures", "skipped"} <= row.keys()
        assert all(type(value) in (int, float) and math.isfinite(value) for value in row.values())


# --- repeating and continuing ------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_and_leaves_the_global_generator_alone(cartpole):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    one, other, different = (trained(cartpole, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert one[1] == other[1]
    assert torch.equal(numbers(one[0]), numbers(other[0]))
    assert not torch.equal(numbers(one[0]), numbers(different[0]))


@pytest.mark.parametrize("stop", [0, 1, 2])
def test_a_run_that_is_saved_and_continued_gives_the_same_numbers(cartpole, stop):
    task, dynamics, banks = cartpole
    whole, rows = trained(cartpole)
    first = pets.begin(dynamics, task, banks, TINY, 0)
    training = pets.train(first, dynamics, task, banks, TINY)
    begun = [next(training) for _ in range(stop)]
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    second = pets.begin(dynamics, task, banks, TINY, 99)
    second.load_state_dict(torch.load(io.BytesIO(file.getvalue()), weights_only=True), banks, TINY, task)
    assert begun + list(pets.train(second, dynamics, task, banks, TINY)) == rows
    assert torch.equal(numbers(second), numbers(whole))
    assert second.samples == whole.samples


def test_a_saved_run_does_not_change_while_training_goes_on(cartpole):
    task, dynamics, banks = cartpole
    run = pets.begin(dynamics, task, banks, TINY, 0)
    training = pets.train(run, dynamics, task, banks, TINY)
    next(training)
    saved = run.state_dict()["flown"]["state"]
    rows = len(saved)
    next(training)
    assert len(saved) == rows


# --- flying ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_preset_is_small_enough_to_ship_and_fits_its_robot(name):
    task = make_task(name)
    run = pets.begin(make_dynamics(name), task, [task.episodes(2, "train", 0)], pets.PRESETS[name], 0)
    size = sum(value.numel() * 4 for value in run.network.state_dict().values())
    assert size < 1e6
    assert all(value.dtype == torch.float32 for value in run.network.state_dict().values())
    contract = pets.Network.contract(task)
    assert all(getattr(run.network.config, key) == value for key, value in contract.items())


def test_an_actor_knows_its_networks_parameters_and_flies_the_same_for_the_same_seed(cartpole):
    task, dynamics, banks = cartpole
    run, _ = trained(cartpole)
    actors = [pets.actor(run.network, task, seed) for seed in (0, 0, 1)]
    assert {id(p) for p in actors[0].parameters()} == {id(p) for p in run.network.parameters()}
    flights = [evaluate.evaluate(actor, dynamics, task, banks[0]).actions for actor in actors]
    assert torch.equal(flights[0], flights[1])
    assert not torch.equal(flights[0], flights[2])
    assert actors[0].calls > 0
    assert actors[0].failures == 0


@pytest.mark.slow
def test_a_few_hundred_transitions_are_enough_to_fly_a_fixed_wing_to_its_target():
    task, dynamics = make_task("fixed_wing"), make_dynamics("fixed_wing")
    banks = [task.episodes(100, "train", 0)]
    config = replace(pets.PRESETS["fixed_wing"], samples=1500, rounds=3)
    run, rows = trained((task, dynamics, banks), config)
    result = evaluate.evaluate(
        pets.actor(run.network, task), dynamics, task, evaluate.test_episodes(task, 10, "validation")
    )
    assert result.summary["success"] == 1
    assert result.summary["mean"] < 0.1
    assert rows[-1]["cost"] < 0.1 * rows[0]["cost"]


def test_a_few_hundred_transitions_are_enough_to_balance_a_pole():
    task, dynamics = replace(make_task("cartpole"), steps=60), make_dynamics("cartpole")
    banks = [task.episodes(100, "train", 0)]
    fast = PlannerConfig(candidates=40, elites=5, iterations=3, warm_std=0.1, min_std=0.005)
    config = pets.Config(samples=600, rounds=2, width=32, fit=FitConfig(steps=300), planner=fast)
    run, _ = trained((task, dynamics, banks), config)
    result = evaluate.evaluate(
        pets.actor(run.network, task), dynamics, task, evaluate.test_episodes(task, 5, "validation")
    )
    assert result.summary["success"] == 1
    assert result.summary["mean"] < 0.24


# --- settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": 0}, "--samples 0: expected at least 1"),
        ({"rounds": 0}, "pets.Config.rounds 0: expected at least 1"),
        *(({name: 0}, f"{name} 0: expected at least 1") for name in ("members", "width", "layers", "episodes")),
        *(({name: 0}, f"{name} 0: expected at least 1") for name in ("every", "validations")),
        ({"exploration": -0.1}, "exploration -0.1: expected 0 or more"),
        ({"first_std": math.nan}, "first_std nan: expected 0 or more"),
        ({"memory": 1.0}, "memory 1.0: expected at least 0 and less than 1"),
        ({"held_out": 1.0}, "held_out 1.0: expected at least 0 and less than 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        pets.Config(**changes)


def test_where_sensors_err_it_learns_from_what_they_say(cartpole):
    task, source, banks = cartpole
    dynamics = make_dynamics("cartpole", "noise=1")

    def fly(flown, seed):
        generator = torch.Generator().manual_seed(seed)
        return pets.fly(pets.random_actor(task, TINY, 0), flown, task, banks[0][:1], 40, 0.0, generator)[0]

    noisy, other, exact = fly(dynamics, 0), fly(dynamics, 1), fly(source, 0)
    assert not torch.equal(other[0], noisy[0])
    assert torch.equal(noisy[1], exact[1])  # the same flights
    error = (noisy[0] - exact[0]) / torch.tensor(dynamics.noise)
    assert ((error.std(0) - 1).abs() < 5 / math.sqrt(2 * len(error))).all()
    rows = torch.arange(0, 16, 2)  # two robots take turns until one has fallen
    assert torch.equal(noisy[2][rows], noisy[0][rows + 2])
