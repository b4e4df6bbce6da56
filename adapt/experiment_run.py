"""One run: an experiment with one seed, carried out and read into a row. Resumable, alone in its folder.

What a run has finished is recorded beside its outputs, `row.json` last; a run that was cut off, however, goes on
behind the last finished step, and training behind its last validation.
"""

import contextlib
import csv
import hashlib
import json
import math
import os
import time
import traceback
from dataclasses import asdict, fields
from functools import lru_cache
from importlib import import_module
from pathlib import Path

from adapt import command
from adapt.experiment_table import EXPERIMENTS

CURVE = ("update", "samples", "seconds", "error", "success")
VERSIONS = ("python", "torch", "torchrl", "tensordict", "casadi")


def run(name, seed, root):
    """Carry out what is missing of an experiment with one seed; returns its row, as `row.json` of its folder holds it.

    The runs that it needs must be finished. Whatever is printed goes to `log.txt`. Two processes that are given the
    same run do it once: the second waits for the first.

    Args:
        root: folder of all runs; this one is in `NAME/seed-SEED`.

    Raises:
        RuntimeError: a step failed; says which, and where the log is.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    experiment, folder = EXPERIMENTS[name], place(root, name, seed)
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder / "lock"):
        config = config_hash(name)
        row = finished(root, name, seed)
        if row is not None and row["config"] == config:
            return row
        with (folder / "log.txt").open("a") as log, _printed_to(log):
            try:
                done = [_carry_out(number, root, name, seed) for number in range(len(experiment.steps))]
                row = {"experiment": name, "seed": seed, **_row(experiment, folder, done), "config": config}
            except Exception as error:
                traceback.print_exc()
                told = " ".join(str(error).split()) or type(error).__name__
                raise RuntimeError(f"{name} seed {seed}: {told} (log: {folder / 'log.txt'})") from None
        command.write_json(folder / "row.json", row)
        return row


def place(root, name, seed):
    """The folder of a run."""
    return Path(root) / name / f"seed-{seed}"


def finished(root, name, seed):
    """The row of a finished run, or None."""
    path = place(root, name, seed) / "row.json"
    return json.loads(path.read_text()) if path.is_file() else None


def curve(root, name, seed):
    """The errors on the way of a finished run: a list of dicts with the columns `CURVE`, empty where it has none."""
    experiment = EXPERIMENTS[name]
    path = experiment.curve and place(root, name, seed) / experiment.curve
    if not path or not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("error")]
    return [{"experiment": name, "seed": seed, **{key: row.get(key, "") for key in CURVE}} for row in rows]


def config_hash(name):
    """A short hash of all that defines an experiment: options, tuned settings, the robot, and the same of its needs."""
    return step_hash(name, len(EXPERIMENTS[name].steps) - 1)


@lru_cache
def step_hash(name, number):
    """The same of one step of an experiment and of those before it."""
    experiment = EXPERIMENTS[name]
    said = [[step.command, step.out, *_settings(step)] for step in experiment.steps[: number + 1]]
    said.append([config_hash(other) for other in experiment.needs])
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:12]


def _settings(step):
    """What a step does, as text: its options, the robot, and the tuned settings that it falls back on.

    Options that are off don't count, so that a new one of a command changes no hash.
    """
    from adapt import pretrain
    from envs import make_system
    from policies import METHODS, pixel_mpc

    given = import_module(step.command).Options(**step.options)
    yield repr(sorted((k, v) for k, v in asdict(given).items() if v is not None and v is not False and v != ()))
    system = make_system(step.options.get("system", "cartpole"))
    yield repr(system)
    method = step.options.get("method", "apg") + ("-pixels" if step.options.get("pixels") else "")
    if step.command == "adapt.pretrain":
        yield repr(pretrain.configuration(given, system))
    elif step.command == "adapt.fewshot":
        module = METHODS[method].module
        yield repr(module.finetuning(module.PRESETS.get(system.name, module.Config())))
    elif step.command == "adapt.vision":
        yield repr((METHODS[f"{method}-pixels"].module if method != "mpc" else pixel_mpc).Config())


def _resolved(step, root, seed, name="self"):
    """The options of a step with folders and seed filled in."""
    folders = {other: str(place(root, other, seed)) for other in step.needs}
    folders |= {"self": str(place(root, name, seed)), "seed": seed}
    filled = {}
    for key, value in step.options.items():
        filled[key] = value.format(**folders) if isinstance(value, str) else value
    return filled | ({"seed": seed} if step.options.get("seed") == "{seed}" else {})


def _carry_out(number, root, name, seed):
    """Run a step unless it is recorded as done with the same settings, those of all before it among them."""
    step, folder = EXPERIMENTS[name].steps[number], place(root, name, seed)
    path, config = folder / f"{step.out}.step.json", step_hash(name, number)
    record = json.loads(path.read_text()) if path.is_file() else {}
    same = record.get("config") == config
    if same and record.get("done"):
        return record
    module = import_module(step.command)
    record = {"command": step.command, "options": step.options, "config": config, "done": False}
    command.write_json(path, record)
    known = {field.name for field in fields(module.Options)}
    out = {"out": str(folder / step.out)}
    goes_on = same and "resume" in known and (folder / step.out / "training.pt").is_file()
    out |= {"resume": True} if goes_on else {"overwrite": True}
    begun = time.perf_counter()
    module.main(module.Options(**_resolved(step, root, seed, name), **out))
    record |= {"done": True, "seconds": round(time.perf_counter() - begun, 1)}
    command.write_json(path, record)
    return record


def _row(experiment, folder, done):
    """The figures of a run, from what its last step has written."""
    last = experiment.steps[-1]
    found = json.loads((folder / last.out).read_text()) if last.out.endswith(".json") else {}
    if not found:
        found = {}
        for name in ("config.json", "metrics.json"):
            path = folder / last.out / name
            found |= json.loads(path.read_text()) if path.is_file() else {}
    row = READERS[last.command](found) | _spent(experiment, folder)
    setting = experiment.setting
    row |= {"set": found.get("set", ""), "target": " ".join(setting.get("target", ()))}
    row |= {key: setting.get(key, "") for key in ("horizon", "mode")}
    row |= {key: found[key] for key in ("system", "metric", "unit") if key in found}
    row["system"] = setting.get("system", row.get("system", "cartpole"))
    row |= {"wall_s": round(sum(record["seconds"] for record in done), 1), "threads": found["threads"]}
    row |= {key: found[key] for key in VERSIONS}
    return row | {"commit": " ".join(_commits(experiment, folder, found))}


def _spent(experiment, folder):
    """Samples and seconds of a whole training, not only until the policy that was kept."""
    log = folder / "training" / "log.csv"
    if experiment.steps[0].command != "adapt.pretrain" or not log.is_file():
        return {}
    last = list(csv.DictReader(log.read_text().splitlines()))[-1]
    return {"samples": int(last["samples"]), "seconds": round(float(last["seconds"]), 1)}


def _commits(experiment, folder, found):
    """The commits that the steps were done at, in their order, each once."""
    commits = []
    for step in experiment.steps[:-1]:
        commits.append(json.loads((folder / step.out / "config.json").read_text())["commit"])
    return list(dict.fromkeys([*commits, found["commit"]]))


def _figures(summary):
    """error, std, success and n of one evaluation; null in a file is not a number: none succeeded."""
    values = {"error": "mean", "std": "std", "success": "success", "n": "n"}
    return {key: math.nan if summary[name] is None else summary[name] for key, name in values.items()}


def _evaluation(found):
    info = found["policy_info"]
    row = {"method": found["method"], "samples": info.get("samples", ""), "seconds": info.get("seconds", "")}
    optional = ("median_ms", "p99_ms", "gradient_norm", "gradient_variance")
    return {**row, **_figures(found), **{key: found[key] for key in optional if key in found}}


def _adaptation(found):
    row = {"method": found["method"], "samples": found["samples"], **_figures(found["few_shot"])}
    row |= {key: found[key]["mean"] for key in ("zero_shot", "oracle") if key in found}
    row |= {"model_acceleration": found["prediction"]["model"]["acceleration"]}
    row |= {"learned_acceleration": found["prediction"]["model + residual"]["acceleration"]}
    spent = sum(found["seconds"][stage] for stage in ("collect", "fit", "finetune"))
    return row | {"seconds": round(spent, 1)}


def _vision(found):
    row = {"method": found["method"], "samples": found["samples"], **_figures(found)}
    row |= {key: found[key] for key in ("median_ms", "p99_ms")}
    return row | {"seconds": found["training"].get("seconds", "")}


READERS = {"adapt.evaluate": _evaluation, "adapt.fewshot": _adaptation, "adapt.vision": _vision}


@contextlib.contextmanager
def _alone(path):
    """Wait until no other process is in the block with this file; the system lets go of it if the process dies."""
    from filelock import FileLock

    with FileLock(path):
        yield


@contextlib.contextmanager
def _printed_to(log):
    with contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        yield
