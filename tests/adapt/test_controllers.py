"""`--method` of `adapt.evaluate`: each is to be had by its name, and options that it has no use for are refused."""

import json

import pytest

from adapt import adaptation
from adapt.residual_kinds import make_residual
from envs import make_dynamics
from envs.errors import InputError
from policies import METHODS, apg
from policies.checkpoints import save_policy


@pytest.fixture
def short(monkeypatch):
    """Flights short enough for a planner, and few calls to time."""
    from policies import evaluate

    whole = evaluate.action_time
    monkeypatch.setattr(evaluate, "action_time", lambda actor, dynamics, task: whole(actor, dynamics, task, calls=3))
    monkeypatch.setattr(evaluate, "WARM_UP", 1)


@pytest.fixture
def ppo_file(tmp_path):
    from envs import make_task
    from policies.actor_critic import actor_critic_for

    path = tmp_path / "ppo.safetensors"
    task = make_task("cartpole")
    save_policy(path, actor_critic_for(task, 8), task, {"seed": 0}, "ppo")
    return path


def result(call, out, *options):
    answer = call("evaluate", "--system", "cartpole", "--episodes", 2, "--out", out, *options)
    assert answer.status == 0, answer.errors
    return answer, json.loads(out.read_text())


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if not method.trained])
def test_a_planner_needs_no_checkpoint_and_reports_its_failures(call, short, tmp_path, method):
    few = ("--samples", 50) if method == "mpc-residual" else ()
    answer, found = result(call, tmp_path / "a.json", "--method", method, "--target", "drag=1", *few)
    assert found["method"] == method
    assert found["success"] == 1
    assert found["mean"] < 0.05
    assert found["failures"] == 0
    assert found["calls"] == 2 * 250
    assert found["policy_info"]["model"] == METHODS[method].model
    assert "failed plans: 0 of 500" in answer.out


def test_a_residual_given_is_the_one_that_is_planned_in(call, short, tmp_path):
    dynamics = make_dynamics("cartpole")
    path = tmp_path / "residual.safetensors"
    make_residual(dynamics).save(path)  # nothing is fitted: it plans as the nominal model does
    common = ("--target", "push=1", "--episodes", 1)
    _, nominal = result(call, tmp_path / "a.json", "--method", "mpc", *common)
    _, given = result(call, tmp_path / "b.json", "--method", "mpc-residual", "--residual", path, *common)
    assert given["mean"] == pytest.approx(nominal["mean"], rel=1e-3)
    _, fitted = result(call, tmp_path / "c.json", "--method", "mpc-residual", "--samples", 200, *common)
    _, true = result(call, tmp_path / "d.json", "--method", "mpc-target", *common)
    assert fitted["mean"] == pytest.approx(true["mean"], rel=0.2)
    assert fitted["mean"] < 0.5 * nominal["mean"]
    assert fitted["policy_info"]["fit"]["after"]


def test_learning_for_a_planner_is_the_learning_of_few_shot_adaptation(rough_cartpole):
    target = make_dynamics("cartpole", "push=1")
    transitions, residual, _ = adaptation.learn(rough_cartpole, target, 40, "acceleration", seed=2)
    config = apg.APGConfig(updates=1, batch=2, episodes=2)
    whole = adaptation.adapt(rough_cartpole, target, samples=40, kind="acceleration", seed=2, config=config)
    assert transitions.state.equal(whole.transitions.state)
    assert residual.weights.equal(whole.residual.weights)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--method", "magic"), "--method magic: expected one of apg, apg-pixels, ppo, ppo-pixels, pets, mpc"),
        (("--method", "mpc", "--policy", "a.safetensors"), "--policy: --method mpc has no use for it, only apg"),
        (("--method", "apg", "--solver", "rti"), "--solver: --method apg has no use for it, only mpc, mpc-residual"),
        (("--method", "apg", "--horizon", "5"), "--horizon: --method apg has no use for it"),
        (("--method", "ppo", "--compile"), "--compile: --method ppo has no use for it"),
        (("--method", "mpc", "--samples", "100"), "--samples: --method mpc has no use for it, only mpc-residual"),
        (("--method", "mpc", "--residual", "a"), "--residual: --method mpc has no use for it, only mpc-residual"),
        (("--method", "mpc-residual", "--samples", "0"), "--samples 0: expected at least 1"),
        (("--method", "mpc-residual", "--samples", "5", "--residual", "a"), "--samples: the residual is given"),
        (("--method", "mpc-residual", "--residual", "none.safetensors"), "none.safetensors: can't read a residual"),
        (("--method", "mpc", "--solver", "magic"), "magic"),
        (("--method", "mpc", "--horizon", "0"), "horizon is 0, expected at least 1"),
        (("--method", "mpc", "--device", "cuda"), "--device cuda: --method mpc solves on the cpu"),
    ],
)
def test_what_a_method_has_no_use_for_is_refused(refused, options, words):
    assert words in refused("evaluate", "--system", "cartpole", *options)


def test_a_checkpoint_of_another_method_is_refused(call, refused, cartpole_file, ppo_file, short, tmp_path):
    assert "was made by the method 'apg'" in refused(
        "evaluate", "--system", "cartpole", "--method", "ppo", "--policy", cartpole_file
    )
    assert "was made by the method 'ppo', expected 'apg'" in refused(
        "evaluate", "--system", "cartpole", "--policy", ppo_file
    )
    assert "was made by the method 'ppo', expected 'apg'" in refused(
        "fewshot", "--system", "cartpole", "--policy", ppo_file, "--out", tmp_path / "run"
    )
    _, found = result(call, tmp_path / "a.json", "--method", "ppo", "--policy", ppo_file)
    assert found["method"] == "ppo"
    assert "failures" not in found


def test_where_no_policy_ships_for_the_data_the_way_out_is_named(monkeypatch):
    from adapt import command, controllers
    from adapt.evaluate import Options

    monkeypatch.setattr("policies.checkpoints.pretrained", lambda name, method: None)
    system, vehicle = command.pick_robot("cartpole", None)
    with pytest.raises(InputError, match=r"no policy ships .* --residual"):
        controllers.obtain(Options(system="cartpole", method="mpc-residual"), system, vehicle, make_dynamics(system))
