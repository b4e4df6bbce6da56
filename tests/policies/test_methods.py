"""The table of methods: what each promises, it has, and a policy of any of them flies and is kept apart from others."""

import dataclasses

import pytest
import torch

from envs import SYSTEMS, InputError, make_dynamics, make_env, make_system, make_task
from envs.camera import Camera
from policies import METHODS, pick_method
from policies.checkpoints import load_policy, save_policy

TRAINED = sorted(name for name, method in METHODS.items() if method.trained)
PLANNERS = sorted(name for name, method in METHODS.items() if not method.trained)
TINY = {"batch": 4, "width": 8, "episodes": 8, "updates": 2, "samples": 40, "rounds": 2, "members": 2, "layers": 1}


def tiny(method):
    """The smallest settings that train at all."""
    config = method.Config()
    names = {item.name for item in dataclasses.fields(config)}
    return dataclasses.replace(config, **{name: value for name, value in TINY.items() if name in names})


def begun(name, task, seed=0):
    method = METHODS[name].module
    banks = [task.episodes(8, "train", seed)]
    return method.begin(make_dynamics(task.system), task, banks, tiny(method), seed), banks


def seen_by(name, system):
    """The task of a system for policies of a method, None where they see pictures and it can't be drawn."""
    task = make_task(system)
    if not METHODS[name].pixels:
        return task
    return dataclasses.replace(task, camera=Camera(height=16, width=32, scale=6.0)) if task.system.drawn else None


@pytest.fixture(params=TRAINED)
def trained(request):
    return request.param


def test_a_method_of_another_name_is_refused_and_the_known_ones_are_named():
    with pytest.raises(
        InputError, match="magic: expected one of apg, apg-pixels, ppo, ppo-pixels, pets, mpc, mpc-residual, mpc-target"
    ):
        pick_method("magic")
    with pytest.raises(InputError, match=r"--method mpc: expected one of apg, apg-pixels, ppo, ppo-pixels, pets$"):
        pick_method("mpc", trained=True)


def test_a_trained_method_has_tuned_settings_for_every_robot(trained):
    method = METHODS[trained].module
    assert {name for name in SYSTEMS if seen_by(trained, name)} <= set(method.PRESETS)
    for config in method.PRESETS.values():
        assert isinstance(config, method.Config)
        assert config.updates >= 1
        assert all(isinstance(method.finetuning(config, make_system(name)), method.Config) for name in SYSTEMS)


@pytest.mark.parametrize("system", sorted(SYSTEMS))
def test_a_trained_policy_is_saved_loaded_and_flies_the_same(trained, system, tmp_path):
    task = seen_by(trained, system)
    if task is None:
        pytest.skip("can't be drawn")
    run, _ = begun(trained, task)
    path = tmp_path / "policy.safetensors"
    save_policy(path, run.network, task, {"seed": 0}, trained)
    policy = load_policy(path, task.system, trained)
    assert policy.method == trained
    env = make_env(system, task=task, batch_size=(2,), episodes=4)
    start = env.reset()
    one, other = (METHODS[trained].module.actor(network, task, 0) for network in (run.network, policy.network))
    with torch.no_grad():
        flown = [env.rollout(3, actor, tensordict=start.clone(), auto_reset=False)["action"] for actor in (one, other)]
    assert flown[0].shape == (2, 3, len(task.system.Action._fields))
    assert flown[0].abs().max() <= 1
    assert torch.equal(*flown)


def test_a_run_counts_its_updates_and_transitions_and_fine_tunes_a_copy(trained):
    task = dataclasses.replace(seen_by(trained, "cartpole"), steps=20)
    method = METHODS[trained].module
    run, banks = begun(trained, task)
    rows = list(method.train(run, make_dynamics("cartpole"), task, banks, tiny(method)))
    assert [row["update"] for row in rows] == list(range(1, tiny(method).updates + 1))
    assert [row["samples"] for row in rows] == sorted(row["samples"] for row in rows)
    assert rows[-1]["samples"] == run.samples > 0
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    again = method.begin(make_dynamics("cartpole"), task, banks, tiny(method), 1, run.network)
    list(method.train(again, make_dynamics("cartpole"), task, banks, tiny(method)))
    assert all(torch.equal(value, before[name]) for name, value in run.network.state_dict().items())
    assert not all(torch.equal(value, before[name]) for name, value in again.network.state_dict().items())


def test_a_checkpoint_of_another_method_is_refused_by_both_names(trained, tmp_path):
    task = seen_by(trained, "cartpole")
    path = tmp_path / "policy.safetensors"
    save_policy(path, begun(trained, task)[0].network, task, {}, trained)
    assert load_policy(path, method=None).method == trained
    for other in set(TRAINED) - {trained}:
        with pytest.raises(InputError, match=f"was made by the method '{trained}', expected '{other}'"):
            load_policy(path, method=other)


def test_a_checkpoint_of_another_robot_of_the_same_method_is_refused(trained, tmp_path):
    task = seen_by(trained, "cartpole")
    path = tmp_path / "policy.safetensors"
    save_policy(path, begun(trained, task)[0].network, task, {}, trained)
    with pytest.raises(InputError, match="trained for cartpole, not for quadrotor"):
        load_policy(path, make_task("quadrotor").system, trained)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_says_which_model_it_plans_in_and_flies_from_its_table_entry(name):
    method = METHODS[name]
    assert method.model in ("source", "residual", "target")
    env = make_env("cartpole", batch_size=(2,), episodes=4)
    planner = method.module.actor(make_dynamics("cartpole"), make_task("cartpole"))
    flight = env.rollout(3, planner)
    assert flight["action"].shape == (2, 3, 1)
    assert planner.calls == 6
    assert planner.failures == 0
