"""Commands called in this process, and policies trained for a few seconds."""

import sys
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import pytest

from adapt import command, training, training_log
from envs import make_dynamics, make_task
from policies import apg
from policies.checkpoints import Policy, save_policy

ROUGH = {
    "cartpole": apg.APGConfig(updates=120, batch=32, width=32, learning_rate=2e-2, curriculum=0.3, episodes=50),
    "quadrotor": apg.APGConfig(updates=100, batch=64, width=32, learning_rate=2e-2, curriculum=0.3, episodes=50),
}


@pytest.fixture
def few_validations(monkeypatch):
    """Few short validations, and no TensorBoard files where it happens to be installed."""
    whole = training.validate
    monkeypatch.setattr(
        training, "validate", lambda actor, dynamics, task, n: whole(actor, dynamics, replace(task, steps=20), n=3)
    )
    monkeypatch.setattr(training_log, "_tensorboard", lambda folder: None)


@dataclass(frozen=True)
class Answer:
    """How a command ended."""

    status: int
    out: str
    errors: list[str]  # lines of stderr that are no progress bar


def without_bars(text):
    """The lines of stderr beside progress bars; a bar is drawn over itself with carriage returns."""
    lines = [line.rsplit("\r", 1)[-1] for line in text.split("\n")]
    return [line for line in lines if line.strip() and "update/s" not in line and "s/update" not in line]


@pytest.fixture
def call(monkeypatch, capsys):
    """Runs `python -m adapt.NAME ARGS` in this process."""

    def run(name, *arguments):
        module = import_module(f"adapt.{name}")
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        capsys.readouterr()
        status = 0
        try:
            command.run(f"adapt.{name}", module.Options, module.main)
        except SystemExit as leaving:
            status = leaving.code or 0
        out, err = capsys.readouterr()
        return Answer(status, out, without_bars(err))

    return run


@pytest.fixture
def refused(call):
    """Runs a command that must end in one line and status 2; returns the line."""

    def run(name, *arguments):
        answer = call(name, *arguments)
        assert answer.status == 2, answer
        assert len(answer.errors) == 1, answer.errors
        assert answer.errors[0].startswith(f"{name}: ")
        return answer.errors[0]

    return run


@pytest.fixture
def contents():
    """What a folder holds: {path: bytes}."""

    def read(folder):
        return {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}

    return read


@pytest.fixture(scope="session")
def stderr_lines():
    return without_bars


def rough(name):
    task, dynamics, config = make_task(name), make_dynamics(name), ROUGH[name]
    banks = apg.training_banks(task, config, 0)
    run = apg.begin(dynamics, task, banks, config, 0)
    for _ in apg.train(run, dynamics, task, banks, config):
        pass
    return Policy(run.network, task, {"seed": 0})


@pytest.fixture(scope="session")
def rough_cartpole():
    """A cart-pole policy that balances, not well; episodes are a third as long as usual."""
    policy = rough("cartpole")
    return replace(policy, task=replace(policy.task, steps=80))


@pytest.fixture(scope="session")
def rough_quadrotor():
    """A quadrotor policy that stays with its reference, not closely."""
    return rough("quadrotor")


@pytest.fixture(scope="session")
def cartpole_file(rough_cartpole, tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "cartpole.safetensors"
    save_policy(path, rough_cartpole.network, rough_cartpole.task, rough_cartpole.info)
    return path


@pytest.fixture(scope="session")
def quadrotor_file(rough_quadrotor, tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "quadrotor.safetensors"
    save_policy(path, rough_quadrotor.network, rough_quadrotor.task, rough_quadrotor.info)
    return path
