"""Checkpoints: what is saved comes back bit for bit, and whatever does not belong is refused in one line."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from envs import SYSTEMS, make_system, make_task
from envs.errors import InputError
from policies.checkpoints import FORMAT, load_policy, pretrained, save_policy
from policies.networks import network_for

INFO = {"seed": 3, "validation": 0.1, "method": "apg"}


@pytest.fixture(params=SYSTEMS)
def task(request):
    return make_task(request.param)


@pytest.fixture
def quadrotor():
    return make_task("quadrotor")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A quadrotor policy, as bytes."""
    path, task = tmp_path_factory.mktemp("policy") / "policy.safetensors", make_task("quadrotor")
    save_policy(path, small_network(task), task, INFO)
    return path.read_bytes()


@pytest.fixture
def saved(tmp_path, whole):
    """A quadrotor policy in a file."""
    path = tmp_path / "policy.safetensors"
    path.write_bytes(whole)
    return path


def small_network(task):
    return network_for(task, features=8, widths=(8, 8))


def parts(path):
    """Tensors and metadata of a checkpoint."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118


def refusal(path, system=None):
    """The one line with which a checkpoint is refused."""
    with pytest.raises(InputError) as refused:
        load_policy(path, system)
    message = str(refused.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_a_policy_comes_back_bit_for_bit_with_its_task_and_history(tmp_path, task):
    network = small_network(task)
    network.normalise(torch.randn(50, network.config.observations), torch.randn(50, *network.config.window))
    path = tmp_path / "policy.safetensors"
    save_policy(path, network, replace(task, steps=77), INFO)
    policy = load_policy(path, task.system)
    for name, value in network.state_dict().items():
        assert torch.equal(policy.network.state_dict()[name], value), name
    assert policy.network.config == network.config
    assert policy.task == replace(task, steps=77)
    assert policy.info == INFO
    assert [file.name for file in tmp_path.iterdir()] == ["policy.safetensors"]


def test_a_vehicle_of_ones_own_comes_back_with_its_parameters(tmp_path):
    system = replace(make_system("quadrotor"), mass=0.034, thrust_max=18.123456789, controller_mass=0.03)
    task = make_task(system, "fast", horizon=7)
    path = tmp_path / "policy.safetensors"
    save_policy(path, small_network(task), task, {})
    assert load_policy(path).task == task
    assert load_policy(path, system).task.system == system


def test_a_loaded_policy_can_be_trained_on(saved):
    assert all(parameter.requires_grad for parameter in load_policy(saved).network.parameters())


def test_a_policy_for_another_robot_is_refused(saved):
    assert "trained for quadrotor, not for cartpole" in refusal(saved, make_system("cartpole"))


def test_a_policy_for_other_parameters_is_refused_by_name_and_value(saved):
    message = refusal(saved, replace(make_system("quadrotor"), mass=0.034))
    assert "trained for mass = 0.723, this robot has 0.034" in message
    assert "adapt.pretrain" in message


def test_a_pickle_is_refused_and_its_code_does_not_run(tmp_path):
    trace = tmp_path / "ran"

    class Code:
        def __reduce__(self):
            return Path.touch, (trace,)

    path = tmp_path / "policy.safetensors"
    torch.save({"weights": torch.zeros(3), "code": Code()}, path)
    assert "pickles) are never loaded" in refusal(path)
    assert not trace.exists()


@pytest.mark.parametrize("content", [b"", b"no checkpoint\n", b"\x00" * 100, b"\xff" * 4096])
def test_a_file_that_is_no_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    assert "not a safetensors file" in refusal(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.9, 0.999])
def test_a_truncated_checkpoint_is_refused(saved, whole, share):
    saved.write_bytes(whole[: int(share * len(whole))])
    assert "not a safetensors file" in refusal(saved)


def test_a_missing_checkpoint_and_a_folder_are_refused(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.safetensors")
    assert "no such file" in refusal(tmp_path)


DAMAGES = [(key, value) for key in ("network", "system", "task", "info") for value in (None, "", "{")]
WRONG = [(key, value) for key in ("network", "system", "task") for value in ("[1]", '{"name": "submarine"}')]


@pytest.mark.parametrize(("key", "value"), DAMAGES + WRONG)
def test_missing_or_damaged_metadata_is_refused(saved, key, value):
    tensors, metadata = parts(saved)
    if value is None:
        del metadata[key]
    else:
        metadata[key] = value
    save_file(tensors, saved, metadata)
    assert "damaged or made by another version" in refusal(saved)


@pytest.mark.parametrize("metadata", [None, {}, {"format": "apg-adapt residual 1"}, {"format": "apg-adapt policy 99"}])
def test_a_safetensors_file_of_another_format_is_refused(saved, metadata):
    save_file(parts(saved)[0], saved, metadata)
    assert f"expected format {FORMAT!r}" in refusal(saved)


def test_weights_that_do_not_fit_their_description_are_refused(saved):
    tensors, metadata = parts(saved)
    for change in ({"head.bias": torch.zeros(3)}, {"more": torch.zeros(1)}):
        save_file({**tensors, **change}, saved, metadata)
        assert "damaged" in refusal(saved)
    tensors.pop("head.bias")
    save_file(tensors, saved, metadata)
    assert "damaged" in refusal(saved)


def test_weights_that_are_not_finite_are_refused(saved):
    tensors, metadata = parts(saved)
    tensors["head.bias"][0] = torch.nan
    save_file(tensors, saved, metadata)
    assert "not finite" in refusal(saved)


def test_an_unknown_encoder_is_refused(saved):
    tensors, metadata = parts(saved)
    metadata["network"] = json.dumps({**json.loads(metadata["network"]), "encoder": "lstm"})
    save_file(tensors, saved, metadata)
    assert "encoder 'lstm'" in refusal(saved)


@pytest.mark.parametrize("change", [{"observations": 9}, {"window": (10, 9)}, {"actions": 2, "horizon": 20}])
def test_a_policy_with_another_contract_than_its_task_is_refused(tmp_path, quadrotor, change):
    network = small_network(quadrotor)
    other = type(network)(replace(network.config, **change))
    path = tmp_path / "policy.safetensors"
    save_policy(path, other, quadrotor, {})
    assert next(iter(change)) in refusal(path)


def test_a_policy_with_another_horizon_than_its_task_is_refused(tmp_path, quadrotor):
    network = small_network(quadrotor)
    path = tmp_path / "policy.safetensors"
    save_policy(path, type(network)(replace(network.config, horizon=9)), quadrotor, {})
    assert "horizon" in refusal(path)


@pytest.mark.parametrize("fails", ["write", "rename"])
def test_a_write_that_fails_leaves_the_old_checkpoint_and_nothing_else(saved, quadrotor, monkeypatch, fails):
    before = saved.read_bytes()

    def half(path, content):
        with path.open("wb") as file:
            file.write(content[:100])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def refuse(*args):
        raise OSError(errno.EACCES, "Permission denied")

    if fails == "write":
        monkeypatch.setattr(Path, "write_bytes", half)
    else:
        monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OSError):
        save_policy(saved, small_network(quadrotor), quadrotor, {"seed": 99})
    assert saved.read_bytes() == before
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_a_new_checkpoint_takes_the_place_of_an_old_one(saved, quadrotor):
    save_policy(saved, small_network(quadrotor), quadrotor, {"seed": 99})
    assert load_policy(saved).info == {"seed": 99}


def test_others_may_read_a_checkpoint(saved, quadrotor):
    other = saved.with_name("plain")
    other.touch()
    saved.unlink()
    save_policy(saved, small_network(quadrotor), quadrotor, INFO)
    assert saved.stat().st_mode == other.stat().st_mode


@pytest.mark.parametrize("name", [name for name in SYSTEMS if pretrained(name)])
def test_shipped_policies_load_by_the_name_of_their_robot(name):
    policy = load_policy(name, make_system(name))
    assert policy.task.system == make_system(name)


def test_nothing_ships_under_a_name_that_is_none():
    assert pretrained("submarine") is None


def test_a_checkpoint_loads_when_the_waypoints_it_was_flown_on_have_gone(tmp_path):
    waypoints = tmp_path / "path.csv"
    waypoints.write_text("t,x,y,z\n0,0,0,0\n10,3,2,1\n")
    save_policy(
        tmp_path / "p.safetensors", network_for(make_task("quadrotor")), make_task("quadrotor", str(waypoints)), {}
    )
    waypoints.unlink()
    assert load_policy(tmp_path / "p.safetensors").task.set == str(waypoints)
