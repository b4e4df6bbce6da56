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

from envs.camera import Camera
from envs.errors import InputError
from envs.registry import make_system, make_task
from policies import METHODS
from policies.files import whole

FORMAT = "apg-adapt policy 1"


@dataclass(frozen=True)
class Policy:
    """A loaded policy: network, the task it was trained for, how it came about, and the method it belongs to."""

    network: torch.nn.Module
    task: object
    info: dict
    method: str = "apg"

    def actor(self, seed=0):
        """The policy as a TensorDict module that writes `action`; a seed matters where it draws samples to plan."""
        return METHODS[self.method].module.actor(self.network, self.task, seed)


def save_policy(path, network, task, info, method="apg"):
    """Write a checkpoint; `info` is any JSON about how it came about (command, seed, validation error)."""
    said = {"set": task.set, "steps": task.steps, "horizon": task.horizon}
    metadata = {
        "format": FORMAT,
        "method": method,
        "network": json.dumps(asdict(network.config)),
        "system": json.dumps({"name": task.system.name, **asdict(task.system)}),
        "task": json.dumps({**said, **({"camera": asdict(task.camera)} if task.camera else {})}),
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


def pretrained(name, method="apg"):
    """Path of a checkpoint of a robot that ships with the package, or None."""
    name = name if method == "apg" else f"{name}-{method}"
    path = resources.files("policies") / "pretrained" / f"{name}.safetensors"
    return Path(str(path)) if path.is_file() else None


def load_policy(source, system=None, method="apg"):
    """Load a checkpoint from a path, or a shipped one by the name of its system.

    Args:
        system: the nominal robot that it is to fly; None accepts the one it was trained for.
        method: the method that it must be of; None accepts any.

    Raises:
        InputError: when there is no such checkpoint, or it was trained for another robot or by another method.
    """
    path = pretrained(source, method or "apg") or Path(source)
    tensors, metadata = read_tensors(path, FORMAT, "policy")
    found = metadata.get("method", "apg")  # earlier versions knew no other
    if found != method and (method or found not in METHODS):
        raise InputError(f"policy {path}: was made by the method {found!r}, expected {method or ', '.join(METHODS)!r}")
    try:
        network_class = METHODS[found].module.Network
        trained_for = _system(json.loads(metadata["system"]))
        config = network_class.Config(**_hashable(json.loads(metadata["network"])))
        task = _task(trained_for, json.loads(metadata["task"]))
        network = network_class(config)
        network.load_state_dict(tensors)
        info = json.loads(metadata["info"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"policy {path}: damaged or made by another version ({' '.join(str(error).split())})"
        ) from None
    if system is not None:
        _check_system(path, trained_for, system)
    _check_contract(path, config, network_class.contract(task))
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"policy {path}: holds weights that are not finite; train it again")
    return Policy(network.requires_grad_(True), task, info, found)


def _system(values):
    values = _hashable(values)
    return replace(make_system(values.pop("name")), **values)


def _task(system, values):
    if "camera" in values:
        values["camera"] = Camera(**_hashable(values["camera"]))
    return make_task(system, **values)


def _hashable(values):
    """What JSON made of the fields of a frozen dataclass: its tuples are lists there."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _check_system(path, trained_for, wanted):
    if trained_for.name != wanted.name:
        raise InputError(f"policy {path}: trained for {trained_for.name}, not for {wanted.name}")
    for field in fields(wanted):
        ours, theirs = getattr(wanted, field.name), getattr(trained_for, field.name)
        if ours != theirs:
            advice = "train one for this vehicle with python -m adapt.pretrain"
            raise InputError(f"policy {path}: trained for {field.name} = {theirs}, this robot has {ours}; {advice}")


def _check_contract(path, config, contract):
    for name, wanted in contract.items():
        found = getattr(config, name)
        if found != wanted:
            raise InputError(f"policy {path}: made for {name} = {found}, the task has {wanted}; train it again")
