"""The table of experiments: every row can be made by commands that exist, from what comes before it."""

from importlib import import_module
from pathlib import Path

import pytest

from adapt.experiment_run import READERS, config_hash, place, resolved, step_hash
from adapt.experiment_table import EXPERIMENTS, Experiment, Step, needed, seeds_of
from adapt.experiments import said
from policies import METHODS


@pytest.fixture(params=EXPERIMENTS)
def experiment(request):
    return EXPERIMENTS[request.param]


def test_every_step_is_a_command_that_takes_its_options(experiment):
    for step in experiment.steps:
        options = import_module(step.command).Options(**resolved(step, Path("runs"), 3, experiment.name))
        assert getattr(options, "seed", 3) in (3, 0)
        assert "{" not in repr(options)


def test_the_last_step_of_every_experiment_writes_figures(experiment):
    assert experiment.steps[-1].command in READERS


def test_everything_that_trains_or_flies_for_data_is_given_the_seed(experiment):
    """Without it all seeds would be one. Evaluations keep seed 0: the same test episodes for all."""
    random = [step for step in experiment.steps if step.command != "adapt.evaluate"]
    assert all(step.options["seed"] == "{seed}" for step in random)
    assert all("seed" not in step.options for step in experiment.steps if step.command == "adapt.evaluate")
    if not random and not experiment.needs:
        assert experiment.seeds == 1


def test_what_is_needed_exists_and_comes_first(experiment):
    names = list(EXPERIMENTS)
    for name in experiment.needs:
        assert names.index(name) < names.index(experiment.name)
    assert set(experiment.needs) <= set(needed(experiment.name))


def test_what_is_needed_is_where_the_other_experiment_leaves_it(experiment):
    """A path into another run names something that one of that run's steps writes."""
    for step in experiment.steps:
        for name in step.needs:
            (text,) = (value for value in step.options.values() if isinstance(value, str) and f"{{{name}}}" in value)
            top = text.removeprefix(f"{{{name}}}/").split("/")[0]
            assert top in [other.out for other in EXPERIMENTS[name].steps]


def test_needs_of_needs_come_first():
    assert needed("drag-mpc-quadrotor-300") == ("apg-quadrotor", "drag-apg-quadrotor-300")
    assert needed("mpc-cartpole") == ()


@pytest.mark.parametrize("system", ["cartpole", "quadrotor", "fixed_wing"])
@pytest.mark.parametrize("method", ["mpc", "ppo", "pets", "apg"])
def test_the_first_table_has_every_method_on_every_system(system, method):
    one = EXPERIMENTS[f"{method}-{system}"]
    assert method in METHODS and one.table == "table1" and one.setting["system"] == system


def test_the_second_table_has_every_horizon_in_every_mode_with_equal_updates_on_equal_paths():
    rows = [one for one in EXPERIMENTS.values() if one.table == "table2"]
    assert len(rows) == 3 * 7
    assert len({(one.setting["mode"], one.setting["horizon"]) for one in rows}) == 21
    assert {(one.setting["updates"], one.setting["episodes_horizon"]) for one in rows} == {(800, 15)}


@pytest.mark.parametrize(("system", "published"), [("quadrotor", {1000}), ("fixed_wing", {2000, 5000})])
def test_the_published_budgets_and_few_transitions_are_among_those_of_the_fourth_table(system, published):
    for method in ("apg", "ppo", "pets", "mpc"):
        names = [name for name in EXPERIMENTS if name.startswith(f"drag-{method}-{system}-")]
        budgets = {int(name.rsplit("-", 1)[1]) for name in names if name[-1].isdigit()}
        assert {30, 100, 300} | published <= budgets


def test_a_step_is_said_as_the_command_that_does_it():
    options = {"system": "quadrotor", "target": ("drag=0.3", "mass=x1.2"), "oracle": True, "seed": "{seed}"}
    expected = "python -m adapt.fewshot --system quadrotor --target drag=0.3 --target mass=x1.2 --oracle --seed 3"
    told = said(Step("adapt.fewshot", options, "adaptation"), "mine", "runs", seed=3)
    assert told == f"{expected} --out runs/mine/seed-3/adaptation"


def test_placeholders_become_folders_of_the_same_seed():
    step = Step("adapt.evaluate", {"policy": "{apg-quadrotor}/training/policy.safetensors", "seed": "{seed}"}, "x.json")
    filled = resolved(step, Path("runs"), 4, "mine")
    assert filled == {"policy": "runs/apg-quadrotor/seed-4/training/policy.safetensors", "seed": 4}
    assert place("runs", "mine", 4) == Path("runs/mine/seed-4")


def test_the_hash_changes_with_an_option_and_with_what_is_needed(monkeypatch):
    name = "drag-apg-quadrotor-30"
    before = config_hash(name), config_hash("mpc-cartpole")
    training = EXPERIMENTS["apg-quadrotor"].steps
    longer = Step(training[0].command, {**training[0].options, "updates": 5000}, training[0].out)
    changed = Experiment("apg-quadrotor", "table1", (longer, training[1]))
    monkeypatch.setitem(EXPERIMENTS, "apg-quadrotor", changed)
    step_hash.cache_clear()
    assert config_hash(name) != before[0]
    assert config_hash("mpc-cartpole") == before[1]
    step_hash.cache_clear()


def test_the_hash_changes_with_the_default_of_an_option_but_not_with_a_new_one(monkeypatch):
    from dataclasses import field, make_dataclass

    from adapt import fewshot

    name, options = "drag-apg-quadrotor-30", fewshot.Options
    before = config_hash(name)
    for fields, changes in (
        ([("brand_new", bool, field(default=False))], False),
        ([("exploration", float, 0.2)], True),
    ):
        monkeypatch.setattr(fewshot, "Options", make_dataclass("Options", fields, bases=(options,), frozen=True))
        step_hash.cache_clear()
        assert (config_hash(name) != before) == changes
    step_hash.cache_clear()


def test_the_hash_changes_with_the_task_and_with_the_settings_of_the_fine_tuning(monkeypatch):
    from dataclasses import replace

    from envs.quadrotor import Tracking
    from policies import apg, evaluate

    name = "drag-apg-quadrotor-30"
    changes = [(Tracking, "thresholds", (0.5, 5.0)), (apg, "FINETUNE", replace(apg.FINETUNE, updates=7))]
    before = config_hash(name)
    for where, what, value in changes:
        with monkeypatch.context() as patch:
            patch.setattr(where, what, value)
            step_hash.cache_clear()
            assert config_hash(name) != before, what
    with monkeypatch.context() as patch:
        patch.setitem(evaluate.TEST_EPISODES, "quadrotor", 3)
        step_hash.cache_clear()
        assert config_hash(name) != before
    step_hash.cache_clear()


def test_the_hash_of_a_simulator_is_of_the_robot_that_it_is(monkeypatch):
    from dataclasses import replace

    from policies import apg

    names = ("simulator-rotorpy", "simulator-jsbsim", "simulator-mujoco")
    before = [config_hash(name) for name in names]
    monkeypatch.setitem(apg.FINETUNES, "cartpole", replace(apg.FINETUNES["cartpole"], updates=7))
    step_hash.cache_clear()
    changed = [config_hash(name) != old for name, old in zip(names, before, strict=True)]
    step_hash.cache_clear()
    assert changed == [False, False, True]


def test_the_hash_changes_with_the_tuned_settings(monkeypatch):
    from dataclasses import replace

    from policies import apg

    before = config_hash("apg-quadrotor")
    monkeypatch.setitem(apg.PRESETS, "quadrotor", replace(apg.PRESETS["quadrotor"], updates=1))
    step_hash.cache_clear()
    assert config_hash("apg-quadrotor") != before
    step_hash.cache_clear()


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", (3,)), ("0..4", (0, 1, 2, 3, 4)), ("0,2, 5..6", (0, 2, 5, 6)), ("1,1", (1,))]
)
def test_seeds_are_numbers_and_ranges(text, seeds):
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "1..", "-1", "1.5", "1...3", "5..2", "0..999999999999"])
def test_other_seeds_are_refused(text):
    with pytest.raises(ValueError, match=r".*"):
        seeds_of(text)
