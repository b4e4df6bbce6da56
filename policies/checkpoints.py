"""Policy checkpoints: weights, network shape and the contract with its robot, in one safetensors file.

A safetensors file holds tensors and text; nothing in it is executed. The text says which robot, task and observation
the weights were trained for, and a checkpoint is refused where that differs from what it is asked to fly.
"""

import json
from dataclasses import asdict, dataclass, fields, replace
from importlib import resources
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from envs.errors import InputError
from envs.registry import make_system, make_task
from policies.files import whole
from policies.networks import NetworkConfig, PlanNetwork

FORMAT = "apg-adapt policy 1"


@dataclass(frozen=True)
class Policy:
    """A loaded policy: network, the task it was trained for, and how it came about."""

    network: PlanNetwork
    task: object
    info: dict


def save_policy(path, network, task, info):
    """Write a checkpoint; `info` is any JSON about how it came about (command, seed, validation error)."""
    metadata = {
        "format": FORMAT,
        "network": json.dumps(asdict(network.config)),
        "system": json.dumps({"name": task.system.name, **asdict(task.system)}),
        "task": json.dumps({"set": task.set, "steps": task.steps, "horizon": task.horizon}),
        "info": json.dumps(info),
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    with whole(path) as partial:
        partial.write_bytes(save(tensors, metadata))


def read_tensors(path, format, what):
    """Tensors and metadata of a safetensors file of ours.

    Raises:
        InputError: when the file is missing, holds something else, or is of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{what} {path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != format:
                raise InputError(f"{what} {path}: expected format {format!r}, found {metadata.get('format')!r}")
            return {name: file.get_tensor(name) for name in file.keys()}, metadata  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        reason = "not a safetensors file; files that may hold code (pickles) are never loaded"
        raise InputError(f"{what} {path}: {reason} ({error})") from None


def pretrained(name):
    """Path of a checkpoint that ships with the package, or None."""
    path = resources.files("policies") / "pretrained" / f"{name}.safetensors"
    return Path(str(path)) if path.is_file() else None


def load_policy(source, system=None):
    """Load a checkpoint from a path, or a shipped one by the name of its system.

    Args:
        system: the nominal robot that it is to fly; None accepts the one it was trained for.

    Raises:
        InputError: when there is no such checkpoint, or it was trained for another robot.
    """
    path = pretrained(source) or Path(source)
    tensors, metadata = read_tensors(path, FORMAT, "policy")
    try:
        trained_for = _system(json.loads(metadata["system"]))
        config = _network_config(json.loads(metadata["network"]))
        task = make_task(trained_for, **json.loads(metadata["task"]))
        network = PlanNetwork(config)
        network.load_state_dict(tensors)
        info = json.loads(metadata["info"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"policy {path}: damaged or made by another version ({' '.join(str(error).split())})"
        ) from None
    if system is not None:
        _check_system(path, trained_for, system)
    _check_contract(path, config, task)
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"policy {path}: holds weights that are not finite; train it again")
    return Policy(network.requires_grad_(True), task, info)


def _system(values):
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return replace(make_system(values.pop("name")), **values)


def _network_config(values):
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return NetworkConfig(**values)


def _check_system(path, trained_for, wanted):
    if trained_for.name != wanted.name:
        raise InputError(f"policy {path}: trained for {trained_for.name}, not for {wanted.name}")
    for field in fields(wanted):
        ours, theirs = getattr(wanted, field.name), getattr(trained_for, field.name)
        if ours != theirs:
            advice = "train one for this vehicle with python -m adapt.pretrain"
            raise InputError(f"policy {path}: trained for {field.name} = {theirs}, this robot has {ours}; {advice}")


def _check_contract(path, config, task):
    task = replace(task, set=task.sets[0])  # sizes are those of any set, and a file of waypoints may have gone
    episodes, step = task.episodes(1, "train", 0), torch.zeros(1, dtype=torch.long)
    state = task.start(episodes, step)
    window = task.window(state, task.reference(episodes, step, state))
    wanted = (task.observe(state).shape[-1], tuple(window.shape[-2:]), len(task.system.Action._fields), task.horizon)
    found = (config.observations, config.window, config.actions, config.horizon)
    if wanted != found:
        sizes = "observation, window, action and horizon"
        raise InputError(f"policy {path}: made for {sizes} of sizes {found}, the task has {wanted}; train it again")
