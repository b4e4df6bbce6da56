"""Plants: flown like a target of ours, whatever they do; what was flown before they break is kept."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from adapt.adaptation import adapt
from adapt.flying import collect
from adapt.plants import PATIENCE, Flights, make_plant
from envs import make_dynamics
from envs.env import TrackingEnv
from envs.errors import InputError
from policies import apg
from policies.evaluate import evaluate

QUICK = replace(apg.FINETUNE, updates=10, batch=32, episodes=50)


class Equations:
    """Our own equations as a plant; `breaks` is a function of (flight, step) that may raise or return a state."""

    def __init__(self, dynamics, settable=False, breaks=lambda flight, step: None):
        self.dynamics, self.settable, self.breaks = dynamics, settable, breaks
        self.flight, self.given = 0, []

    def reset(self, state):
        self.flight, self.count, self.now = self.flight + 1, 0, np.array(state)
        broken = self.breaks(self.flight, 0)
        return self.now if broken is None else broken

    def step(self, state, action):
        self.count += 1
        self.given.append(state)
        broken = self.breaks(self.flight, self.count)
        before = self.now if state is None else state
        following = self.dynamics(*(torch.tensor(part, dtype=torch.float32) for part in (before, action)))
        self.now = following.double().numpy()
        return self.now if broken is None else broken


@pytest.fixture(scope="module")
def target():
    return make_dynamics("cartpole", "drag=1")


@pytest.fixture
def policy(rough_cartpole):
    return replace(rough_cartpole, task=replace(rough_cartpole.task, steps=30))


def flown(policy, dynamics, n=100, exploration=0.1):
    env = TrackingEnv(dynamics, policy.task, policy.task.episodes(6, "train", 5))
    return collect(policy.actor(), env, n, exploration, torch.Generator().manual_seed(3))


def as_plant(policy, target, **options):
    return Flights(Equations(target, **options), policy.task.system)


@pytest.mark.parametrize("settable", [False, True])
@pytest.mark.parametrize("exploration", [0.0, 0.3])
def test_our_equations_as_a_plant_give_the_transitions_of_the_target_itself(policy, target, settable, exploration):
    """Batches of another size are rounded differently, in the last of seven digits."""
    ours = flown(policy, target, exploration=exploration)
    theirs = flown(policy, as_plant(policy, target, settable=settable), exploration=exploration)
    assert torch.equal(ours.trajectory, theirs.trajectory)
    for name in ("state", "action", "next_state"):
        torch.testing.assert_close(getattr(theirs, name), getattr(ours, name), atol=1e-5, rtol=1e-4)
    assert torch.equal(theirs.state[1:30], theirs.next_state[:29])


def test_our_equations_as_a_plant_give_the_evaluation_of_the_target_itself(policy, target):
    episodes = policy.task.episodes(7, "test", 0)
    ours = evaluate(policy.actor(), target, policy.task, episodes)
    plant = as_plant(policy, target)
    theirs = evaluate(policy.actor(), plant, policy.task, episodes)
    torch.testing.assert_close(theirs.states, ours.states, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(theirs.actions, ours.actions, atol=1e-5, rtol=1e-4)
    assert theirs.table.error.to_numpy() == pytest.approx(ours.table.error.to_numpy(), rel=1e-4)
    assert theirs.table.success.equals(ours.table.success)
    assert plant.report() == {
        **{"name": "plant", "flights": 7, "steps": 7 * 30, "broken": 0, "given up": False, "faults": []}
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["quadrotor", "fixed_wing"])
def test_aircraft_end_their_flights_alike(name):
    from policies.checkpoints import load_policy

    policy = load_policy(name)
    dynamics = make_dynamics(name, "drag=0.3")
    ours = evaluate(policy.actor(), dynamics, policy.task, policy.task.episodes(2, "test", 0))
    theirs = evaluate(policy.actor(), as_plant(policy, dynamics), policy.task, policy.task.episodes(2, "test", 0))
    assert theirs.states.shape == ours.states.shape
    assert theirs.table.error.to_numpy() == pytest.approx(ours.table.error.to_numpy(), rel=1e-2)


def test_only_a_settable_plant_is_told_where_it_is(policy, target):
    for settable in (False, True):
        plant = as_plant(policy, target, settable=settable)
        flown(policy, plant, 10)
        assert [state is not None for state in plant.plant.given] == [settable] * 10


def test_a_flight_begins_where_the_plant_says_it_does(policy, target):
    class Elsewhere(Equations):
        def reset(self, state):
            self.now = np.array([0.5, 0.0, 0.01, 0.0])
            return self.now

    plant = Flights(Elsewhere(target), policy.task.system)
    result = evaluate(policy.actor(), plant, policy.task, policy.task.episodes(3, "test", 0))
    assert result.states[:, 0].tolist() == [pytest.approx([0.5, 0.0, 0.01, 0.0])] * 3


def raised(error):
    raise error


FAULTS = {
    "nan": (lambda: [0.0, np.nan, 0.0, 0.0], "v is not finite"),
    "death": (lambda: raised(ConnectionError("link\nlost")), "ConnectionError: link lost"),
    "beyond all bounds": (lambda: [0.0, 1e30, 0.0, 0.0], "v is 1e\\+30"),
    "shape": (
        lambda: [0.0, 0.0],
        r"step returned list of shape \(2,\), expected numbers of shape \(4,\): x, v, theta, omega",
    ),
    "nothing": (lambda: "no fix", "step returned str, expected numbers"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_flight_that_breaks_ends_and_what_was_flown_is_kept(policy, target, fault):
    answer, words = FAULTS[fault]
    plant = as_plant(policy, target, breaks=lambda flight, step: answer() if (flight, step) == (2, 11) else None)
    transitions = flown(policy, plant, 100)
    assert len(transitions) == 100
    assert transitions.trajectory.bincount().tolist() == [30, 10, 30, 30]
    assert transitions.next_state.isfinite().all()
    report = plant.report()
    assert (report["flights"], report["broken"], report["given up"]) == (4, 1, False)
    assert len(report["faults"]) == 1
    assert report["faults"][0].startswith("flight 2, step 11: ")
    assert re.search(words, report["faults"][0])


def test_a_broken_flight_counts_as_failed_and_the_others_as_they_are(policy, target):
    episodes = policy.task.episodes(3, "test", 0)
    plant = as_plant(
        policy, target, breaks=lambda flight, step: raised(OSError()) if (flight, step) == (2, 5) else None
    )
    result = evaluate(policy.actor(), plant, policy.task, episodes)
    whole = evaluate(policy.actor(), target, policy.task, episodes)
    assert result.table.success.tolist() == [True, False, True]
    assert result.table.error[[0, 2]].to_numpy() == pytest.approx(whole.table.error[[0, 2]].to_numpy(), rel=1e-4)


def test_a_plant_that_dies_for_good_is_given_up_and_what_it_flew_is_adapted_to(policy, target):
    """Three flights are flown, then nothing ever again."""
    dead = as_plant(policy, target, breaks=lambda flight, step: raised(OSError("gone")) if flight > 3 else None)
    kept = []
    result = adapt(
        policy, plant=dead, samples=200, episodes=4, config=QUICK, keep=lambda name, value: kept.append(name)
    )
    assert len(result.transitions) == 90
    assert kept == ["transitions", "residual", "policy"]
    assert result.flights["given up"]
    assert result.flights["flights"] == 3 + PATIENCE, "a dead plant is not asked again and again"
    assert not result.evaluations["few_shot"].table.success.any()
    assert result.prediction == {"model": result.fit.before, "model + residual": result.fit.after}


def test_rounds_end_with_a_plant_that_dies_between_them(policy, target):
    dead = as_plant(policy, target, breaks=lambda flight, step: raised(OSError("gone")) if flight > 2 else None)
    result = adapt(policy, plant=dead, samples=120, rounds=2, episodes=4, config=QUICK)
    assert len(result.transitions) == 60


@pytest.mark.parametrize("more", [{"rounds": 3}, {"until_known": True}], ids=str)
def test_what_was_flown_before_a_refit_outlives_the_death_of_the_plant_and_the_fit(policy, target, more, monkeypatch):
    kept, plant = [], as_plant(policy, target)

    def failing(transitions, *rest, **options):
        raise InputError("no fit")

    monkeypatch.setattr("adapt.residual.fit_residual", failing)
    with pytest.raises(InputError, match="no fit"):
        adapt(policy, plant=plant, samples=90, config=QUICK, keep=lambda *result: kept.append(result), **more)
    ((name, transitions),) = kept
    assert (name, len(transitions)) == ("transitions", 30 if "rounds" in more else 10)


@pytest.mark.parametrize("more", [{}, {"rounds": 3}, {"until_known": True}], ids=str)
def test_too_few_transitions_of_a_plant_that_dies_are_kept_and_the_reason_is_told(policy, target, more):
    def dies(flight, step):
        return raised(OSError("gone")) if flight > 1 or step == 5 else None

    kept = []
    with pytest.raises(
        InputError,
        match=r"plant: was given up after 4 transitions \(flight \d, step 0: OSError: gone\); at least 10 are",
    ):
        plant = as_plant(policy, target, breaks=dies)
        adapt(policy, plant=plant, samples=90, config=QUICK, keep=lambda *result: kept.append(result), **more)
    assert [(name, len(transitions)) for name, transitions in kept] == [("transitions", 4)]


@pytest.mark.parametrize("more", [{"rounds": 3}, {"until_known": True}], ids=str)
@pytest.mark.parametrize("fault", FAULTS)
def test_rounds_survive_a_flight_that_breaks(policy, target, fault, more):
    answer, words = FAULTS[fault]
    plant = as_plant(policy, target, breaks=lambda flight, step: answer() if (flight, step) == (2, 4) else None)
    result = adapt(policy, plant=plant, samples=60, episodes=2, config=QUICK, **more)
    assert len(result.transitions) >= 20
    assert result.transitions.next_state.isfinite().all()
    assert (result.flights["broken"], result.flights["given up"]) == (1, False)
    assert re.search(words, result.flights["faults"][0])


def test_a_plant_that_dies_is_not_said_to_have_nothing_more_to_tell(policy, target):
    def tires(flight, step):
        return raised(OSError("glitch" if flight == 1 else "battery empty")) if flight > 4 or step == 9 else None

    plant = as_plant(policy, target, breaks=tires)
    result = adapt(policy, plant=plant, samples=200, episodes=2, config=QUICK, until_known=True)
    assert result.flights["given up"]
    assert [warning for warning in result.fit.warnings if "more would tell no more" in warning] == []
    assert "glitch" in result.flights["faults"][0] and "battery empty" in result.flights["faults"][-1]


def test_a_plant_that_never_flies_is_refused_with_the_reason(policy, target):
    dead = as_plant(policy, target, breaks=lambda flight, step: raised(OSError("no power")))
    with pytest.raises(
        InputError, match=r"plant: no flight got past its first step \(flight 1, step 0: OSError: no po"
    ):
        adapt(policy, plant=dead, samples=100, config=QUICK)


def test_a_shape_that_was_never_right_is_refused_at_once(policy, target):
    for when, method in enumerate(("reset", "step")):
        wrong = as_plant(policy, target, breaks=lambda flight, step, when=when: np.zeros(5) if step == when else None)
        with pytest.raises(InputError, match=rf"plant: {method} returned ndarray of shape \(5,\), expected numbers"):
            flown(policy, wrong)


def test_a_quaternion_that_is_none_breaks_the_flight(rough_quadrotor):
    dynamics = make_dynamics("quadrotor")
    plant = as_plant(rough_quadrotor, dynamics, breaks=lambda flight, step: np.full(13, 0.1) if step == 3 else None)
    assert len(flown(rough_quadrotor, plant, 5)) == 5
    assert "quaternion qw, qx, qy, qz has length 0.2" in plant.report()["faults"][0]


def test_the_quaternion_of_a_plant_never_jumps_to_its_other_sign(rough_quadrotor):
    class Flipped(Equations):
        """Gives every other attitude with the opposite sign."""

        def step(self, state, action):
            following = super().step(state, action).copy()
            following[3:7] *= (-1) ** self.count
            return following

    dynamics = make_dynamics("quadrotor")
    ours = flown(rough_quadrotor, dynamics, 10)
    theirs = flown(rough_quadrotor, Flights(Flipped(dynamics), rough_quadrotor.task.system), 10)
    torch.testing.assert_close(theirs.next_state, ours.next_state, atol=1e-5, rtol=1e-4)


def test_a_policy_that_has_gone_wrong_never_reaches_the_plant(policy, target):
    plant = as_plant(policy, target)

    def lost(now):
        return now.set("action", torch.full((*now.batch_size, 1), torch.nan))

    env = TrackingEnv(plant, policy.task, policy.task.episodes(2, "train", 0))
    with pytest.raises(InputError, match="the policy's action is not finite"):
        collect(lost, env, 10)
    assert plant.plant.given == []


def test_another_control_period_and_a_missing_method_are_refused(policy, target):
    plant = Equations(target)
    plant.dt = 0.02
    with pytest.raises(InputError, match=r"control period is 0\.02 s, expected 0\.05 s as of cartpole"):
        adapt(policy, plant=plant, config=QUICK)
    plant.dt = "fast"
    with pytest.raises(InputError, match=r"plant: control period is 'fast', expected 0\.05, a number of seconds"):
        adapt(policy, plant=plant, config=QUICK)
    with pytest.raises(InputError, match="object has no method reset; a plant has reset and step"):
        adapt(policy, plant=object(), config=QUICK)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"target": "same"}, "a target or a plant, not both"), ({"oracle": True}, "--oracle: needs equations")],
)
def test_what_makes_no_sense_with_a_plant_is_refused(policy, target, options, words):
    options = {name: target if value == "same" else value for name, value in options.items()}
    with pytest.raises(InputError, match=words):
        adapt(policy, plant=Equations(target), **options)


@pytest.mark.slow
def test_adaptation_to_a_plant_is_adaptation_to_its_equations(rough_cartpole, target):
    config = replace(QUICK, updates=30, batch=64, episodes=100)
    few = {"samples": 160, "rounds": 2, "config": config, "episodes": 10}
    ours = adapt(rough_cartpole, target, **few)
    theirs = adapt(rough_cartpole, plant=Equations(target), **few)
    for name in ("source", "zero_shot", "few_shot"):
        mine, other = (result.evaluations[name].summary for result in (ours, theirs))
        assert other["mean"] == pytest.approx(mine["mean"], rel=0.05)
        assert other["n"] == mine["n"] == 10
    assert theirs.evaluations["few_shot"].summary["mean"] < 0.7 * theirs.evaluations["zero_shot"].summary["mean"]
    assert ours.flights is None
    assert theirs.flights["broken"] == 0


@pytest.fixture
def bridge(tmp_path, monkeypatch):
    """A module of one's own with factories, on the path."""
    (tmp_path / "my_bridge.py").write_text(
        "from envs.dynamics import Dynamics\nimport torch\n"
        "class Bridge:\n"
        "    def __init__(self, system): self.dynamics = Dynamics(system)\n"
        "    def reset(self, state): self.now = torch.tensor(state); return state\n"
        "    def step(self, state, action):\n"
        "        self.now = self.dynamics(self.now, torch.tensor(action)); return self.now.numpy()\n"
        "def pushed(system):\n"
        "    from envs import make_dynamics\n"
        "    plant = Bridge(system)\n"
        "    plant.dynamics = make_dynamics(system, 'push=1')\n"
        "    return plant\n"
        "def cut(system): raise OSError('no cable')\n"
        "class Dying(Bridge):\n"
        "    left = 45\n"
        "    def step(self, state, action):\n"
        "        self.left -= 1\n"
        "        if self.left < 0: raise OSError('link lost')\n"
        "        return super().step(state, action)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


def test_the_command_flies_a_plant_of_ones_own(bridge, call, cartpole_file, tmp_path):
    out = tmp_path / "run"
    more = ("--system", "cartpole", "--policy", cartpole_file, "--samples", 30, "--updates", 2, "--episodes", 3)
    answer = call("fewshot", "--plant", "my_bridge:Bridge", *more, "--out", out)
    assert answer.status == 0, answer
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["target"] == metrics["plant"]["name"] == "my_bridge:Bridge"
    assert metrics["few_shot"]["n"] == 3
    assert metrics["plant"]["broken"] == 0
    assert {"flight.png", "transitions.csv", "policy.safetensors"} <= {path.name for path in out.iterdir()}


def test_evaluation_in_a_plant_of_our_equations_is_that_in_the_model(bridge, call, cartpole_file, tmp_path):
    cart, found = ("--system", "cartpole", "--policy", cartpole_file, "--episodes", 3), {}
    for name, more in {"model": (), "plant": ("--plant", "my_bridge:Bridge")}.items():
        assert call("evaluate", *cart, *more, "--out", tmp_path / name).status == 0
        found[name] = json.loads((tmp_path / name).read_text())
    assert found["plant"]["mean"] == pytest.approx(found["model"]["mean"], rel=1e-4)
    assert found["plant"]["plant"]["flights"] == 3


def test_a_planner_plans_in_what_it_learned_of_a_plant(bridge, call, tmp_path):
    """The plant is pushed, which its model doesn't know; a residual of its transitions tells the planner."""
    errors = {}
    for name, more in {"mpc": (), "mpc-residual": ("--samples", 60)}.items():
        flown = ("--system", "cartpole", "--plant", "my_bridge:pushed", "--method", name, "--episodes", 1, *more)
        assert call("evaluate", *flown, "--out", tmp_path / name).status == 0
        errors[name] = json.loads((tmp_path / name).read_text())["mean"]
    assert errors["mpc-residual"] < 0.5 * errors["mpc"]


def test_evaluation_tells_of_flights_that_broke_off(bridge, call, cartpole_file):
    cart = ("--system", "cartpole", "--policy", cartpole_file, "--episodes", 2)
    answer = call("evaluate", *cart, "--plant", "my_bridge:Dying")
    assert answer.status == 0
    assert "flights of the plant broke off (flight 1, step 46: OSError: link lost)" in answer.out


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--target", "drag=1"), "--target"),
        (("--gradient",), "--gradient"),
        (("--method", "mpc-target"), "--method mpc-target"),
        (("--method", "apg-pixels"), "--method apg-pixels"),
    ],
)
def test_what_evaluation_in_a_plant_has_no_use_for_is_refused(refused, options, named):
    said = refused("evaluate", "--system", "cartpole", "--plant", "my_bridge:Bridge", *options)
    assert f"--plant and {named}: a plant " in said


@pytest.mark.parametrize("more", [(), ("--rounds", 3), ("--collect",)], ids=str)
def test_the_command_ends_well_and_draws_what_there_is_where_a_plant_dies(bridge, call, cartpole_file, tmp_path, more):
    out = tmp_path / "run"
    small = ("--system", "cartpole", "--policy", cartpole_file, "--samples", 60, "--updates", 2, "--episodes", 2)
    answer = call("fewshot", "--plant", "my_bridge:Dying", *small, *more, "--out", out)
    assert answer.status == 0, answer
    assert answer.errors == []
    assert "flights of the plant broke off (flight" in answer.out
    assert re.search(r"OSError: link lost\); then it was given up \(flight .*: OSError: link lost\)", answer.out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["plant"]["given up"]
    assert 10 <= metrics["samples"] <= 45
    assert {"flight.png", "error.png", "transitions.csv", "policy.safetensors"} <= {path.name for path in out.iterdir()}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ("--plant", "gazebo"),
            "--plant gazebo: expected one of rotorpy, drone-models, jsbsim, mujoco, or MODULE:FACT",
        ),
        (("--plant", "no_such:thing"), "can't be imported (No module named 'no_such')"),
        (("--plant", "my_bridge:Other"), "can't be imported (module 'my_bridge' has no attribute 'Other')"),
        (
            ("--plant", "my_bridge:cut"),
            "cut: cut(system), which makes the plant, failed (OSError: no cable)",
        ),
        (("--plant", "rotorpy", "--system", "cartpole"), "--plant rotorpy: is a quadrotor, the robot is a cartpole"),
        (("--plant", "jsbsim", "--system", "cartpole"), "--plant jsbsim: is a fixed_wing, the robot is a cartpole"),
        (("--plant", "my_bridge:Bridge", "--oracle"), "--plant: is the target, without equations"),
        (("--plant", "my_bridge:Bridge", "--episodes", 0), "--episodes 0: expected at least 1"),
    ],
)
def test_a_plant_that_cant_be_flown_is_told_in_one_line(bridge, refused, tmp_path, options, words):
    assert words in refused("fewshot", *options, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["rotorpy", "drone-models", "jsbsim", "mujoco"])
def test_a_simulator_that_is_not_installed_is_told_with_the_extra_to_install(name, monkeypatch):
    from adapt.plant_table import SIMULATORS
    from envs import make_system

    simulator = SIMULATORS[name]
    for module in [m for m in sys.modules if m.partition(".")[0] == simulator.package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.delitem(sys.modules, f"adapt.simulators.{simulator.module}", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Without(simulator.package), *sys.meta_path])
    with pytest.raises(InputError, match=f"{simulator.package} is not installed; pip install 'apg-adapt.simulators.'"):
        make_plant(name, make_system(simulator.system))


class Without:
    """Finds no package of a name."""

    def __init__(self, package):
        self.package = package

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
