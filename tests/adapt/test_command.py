"""What all commands share: one line and a status for whatever goes wrong, and files that are whole or absent."""

import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path

import pytest
import torch

from adapt import command
from envs.errors import InputError

COMMANDS = ("pretrain", "evaluate", "fewshot")
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Options:
    """A command for tests."""

    count: int = 1
    """A number."""


def ending(main, capsys, monkeypatch, *arguments):
    """Status and lines on stderr of a command with this `main`."""
    monkeypatch.setattr(sys, "argv", ["try", *arguments])
    status = 0
    try:
        command.run("adapt.try", Options, main)
    except SystemExit as leaving:
        status = leaving.code
    return status, capsys.readouterr().err.splitlines()


def raising(error):
    def main(options):
        raise error

    return main


def test_a_command_that_works_ends_quietly_with_its_options(capsys, monkeypatch):
    seen = []
    assert ending(seen.append, capsys, monkeypatch, "--count", "3") == (0, [])
    assert seen == [Options(3)]


def test_bad_input_is_one_line_and_status_2(capsys, monkeypatch):
    assert ending(raising(InputError("a.csv: row 3:\n  wrong")), capsys, monkeypatch) == (
        2,
        ["try: a.csv: row 3: wrong"],
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--cuont", "3"), "--cuont"),
        (("--count", "many"), "many"),
        (("--count",), "--count"),
        (("stray",), "stray"),
    ],
)
def test_a_wrong_option_is_one_line_and_status_2(capsys, monkeypatch, arguments, words):
    status, lines = ending(raising(AssertionError("must not run")), capsys, monkeypatch, *arguments)
    assert status == 2
    assert len(lines) == 1
    assert words in lines[0]
    assert "--help" in lines[0]
    assert not set("╭│╰─") & set(lines[0])


def test_ctrl_c_is_one_line_and_status_130(capsys, monkeypatch):
    assert ending(raising(KeyboardInterrupt), capsys, monkeypatch) == (130, ["try: interrupted"])
    kept = KeyboardInterrupt("continue with --resume")
    assert ending(raising(kept), capsys, monkeypatch) == (130, ["try: interrupted; continue with --resume"])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EROFS])
def test_a_full_or_forbidden_disk_is_one_line_and_status_2(capsys, monkeypatch, number):
    error = OSError(number, os.strerror(number), "runs/a.json")
    status, lines = ending(raising(error), capsys, monkeypatch)
    assert status == 2
    assert lines == [f"try: runs/a.json: {os.strerror(number)}; nothing half-written is kept"]


@pytest.mark.parametrize("number", [errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EISDIR, errno.EIO])
def test_whatever_goes_wrong_with_a_named_file_is_one_line_and_status_2(capsys, monkeypatch, number):
    status, lines = ending(raising(OSError(number, os.strerror(number), "a.json")), capsys, monkeypatch)
    assert status == 2
    assert lines == [f"try: a.json: {os.strerror(number)}; nothing half-written is kept"]


@pytest.mark.parametrize("error", [OSError(errno.EIO, "broken"), ValueError("a bug"), ZeroDivisionError()])
def test_what_is_not_the_users_fault_keeps_its_traceback(capsys, monkeypatch, error):
    with pytest.raises(type(error)):
        ending(raising(error), capsys, monkeypatch)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_answers_in_under_a_second(name):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    answer = subprocess.run(
        [sys.executable, "-m", f"adapt.{name}", "--help"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert answer.returncode == 0
    assert answer.stderr == ""
    assert "--system" in answer.stdout
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime  # of a processor: others may be busy
    assert spent < 1


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_every_option(call, name):
    answer = call(name, "--help")
    assert answer.status == 0
    for option in fields(import_module(f"adapt.{name}").Options):
        assert re.search(rf"--{option.name.replace('_', '-')}[ ,]", answer.out)


def test_a_new_folder_is_made_with_those_above_it(tmp_path):
    folder = command.output_folder(tmp_path / "a" / "b", overwrite=False)
    assert folder.is_dir()
    assert list(folder.iterdir()) == []
    assert command.output_folder(folder, overwrite=False) == folder  # empty: nothing is lost


def test_a_used_folder_needs_overwrite(tmp_path):
    (tmp_path / "old").write_text("result")
    with pytest.raises(InputError, match="already holds results; name another folder or add --overwrite"):
        command.output_folder(tmp_path, overwrite=False)
    assert command.output_folder(tmp_path, overwrite=True) == tmp_path
    assert (tmp_path / "old").read_text() == "result"


def test_a_file_in_the_way_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="is a file, expected a folder"):
        command.output_folder(tmp_path / "file", overwrite=True)
    with pytest.raises(InputError, match="can't be written to"):
        command.output_folder(tmp_path / "file" / "below", overwrite=True)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_that_takes_no_files_is_refused(tmp_path):
    with pytest.raises(InputError, match="can't be written to"):
        command.output_folder("/proc/self/results", overwrite=False)


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.txt"
    with command.whole(path) as partial:
        partial.write_text("first")
        assert not path.exists()
    assert path.read_text() == "first"
    with pytest.raises(RuntimeError), command.whole(path) as partial:
        partial.write_text("sec")
        raise RuntimeError
    assert path.read_text() == "first"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_json_that_can_not_be_written_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    command.write_json(path, {"mean": 0.1})
    assert json.loads(path.read_text()) == {"mean": 0.1}
    with pytest.raises(TypeError):
        command.write_json(path, {"mean": object()})

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError):
        command.write_json(path, {"mean": 0.2})
    assert json.loads(path.read_text()) == {"mean": 0.1}
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_json_has_null_where_there_is_no_number(tmp_path):
    command.write_json(tmp_path / "a.json", {"few_shot": {"mean": float("nan")}, "table": [1.0, float("inf"), (2,)]})
    assert "NaN" not in (tmp_path / "a.json").read_text()
    content = json.loads((tmp_path / "a.json").read_text())
    assert content == {"few_shot": {"mean": None}, "table": [1.0, None, [2]]}


@pytest.mark.parametrize("threads", [0, -1])
def test_less_than_one_thread_is_refused(threads):
    with pytest.raises(InputError, match=f"--threads {threads}: expected at least 1"):
        command.set_threads(threads)


@pytest.mark.parametrize("device", ["nonsense", "cuda:99", "meta", "", "cpu:x"])
def test_a_device_that_is_not_there_is_refused(device):
    with pytest.raises(InputError, match=f"--device {device}: not available here") as refused:
        command.pick_device(device)
    assert "\n" not in str(refused.value)


def test_the_processor_is_a_device():
    assert command.pick_device("cpu") == torch.device("cpu")


def test_a_vehicle_is_its_system_and_must_be_of_the_named_kind():
    system, vehicle = command.pick_robot("quadrotor", "crazyflie")
    assert vehicle.name == "crazyflie"
    assert system == vehicle.system
    assert command.pick_robot("cartpole", None)[1] is None
    with pytest.raises(InputError, match="--vehicle crazyflie: is a quadrotor, --system says cartpole"):
        command.pick_robot("cartpole", "crazyflie")


@pytest.mark.parametrize(
    ("options", "system"),
    [
        ({}, "quadrotor"),
        ({"vehicle": "crazyflie"}, "quadrotor"),
        ({"vehicle": "j3cub"}, "fixed_wing"),
        ({"system": "cartpole"}, "cartpole"),
        ({"system": "quadrotor", "vehicle": "j3cub"}, "quadrotor"),  # that is refused, see `pick_robot`
    ],
)
@pytest.mark.parametrize("name", ["fewshot", "pretrain", "evaluate"])
def test_a_system_that_is_left_open_is_that_of_the_vehicle(name, options, system):
    made = import_module(f"adapt.{name}").Options(**options)
    assert command.with_robot(made) == replace(made, system=system)


@pytest.mark.parametrize("name", ["fewshot", "pretrain", "evaluate", "vision"])
def test_the_help_says_what_erring_sensors_are_and_what_robot_a_vehicle_is(call, name):
    answer = call(name, "--help")
    said = " ".join(answer.out.replace("│", " ").split())
    assert answer.status == 0
    for words in ("noise=1", "err", "1 mm", "0.02 m/s", "0.5 deg", "0.05 rad/s"):
        assert words in said
    if name != "vision":
        assert "j3cub (a fixed wing)" in said


def test_where_no_policy_ships_the_command_that_makes_one_is_named(monkeypatch):
    monkeypatch.setattr("policies.checkpoints.pretrained", lambda name, method: None)
    with pytest.raises(InputError, match=r"none ships for crazyflie; .*adapt\.pretrain and the same --vehicle"):
        command.pick_policy(None, *command.pick_robot("quadrotor", "crazyflie"))
    with pytest.raises(InputError, match=r"none ships for cartpole; .*adapt\.pretrain and the same --system"):
        command.pick_policy(None, *command.pick_robot("cartpole", None))


def test_the_first_ctrl_c_waits_and_the_second_does_not():
    before = signal.getsignal(signal.SIGINT)
    with command.interrupts_noted() as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_results_say_what_they_were_made_with():
    made_with = command.environment(3, 2)
    assert made_with["seed"] == 3
    assert made_with["threads"] == 2
    assert made_with["torch"] == torch.__version__
    assert {"python", "torchrl", "tensordict", "casadi", "commit"} <= made_with.keys()


def test_a_reader_that_leaves_early_is_no_error_of_ours():
    program = "from adapt import command; command._parse = lambda *_: None; "
    program += "command.run('adapt.x', None, lambda options: print('a' * 200000))"
    line = f'set -o pipefail; {sys.executable} -c "{program}" | head -c 10'
    answer = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert answer.returncode == 141
    assert answer.stdout == 10 * "a"
    assert answer.stderr == ""


def test_without_git_a_result_has_no_commit(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert command.environment(0, 1)["commit"] == ""
