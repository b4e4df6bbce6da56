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
from envs.errors import InputError

CURVE = ("update", "samples", "seconds", "error", "success")
FILES = ("config.json", "metrics.json")  # of a command that writes a folder
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
    root = Path(root).resolve()  # a policy's path is part of what a training run is
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
                row = {"experiment": name, "seed": seed, **_row(experiment, root, seed, done), "config": config}
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
    """The row of a finished run, or None; a row that can't be read counts as none."""
    row = _record(place(root, name, seed) / "row.json")
    return row if {"experiment", "seed", "error", "config"} <= row.keys() else None


def _record(path):
    """What a JSON file holds; nothing where it is missing or damaged, as then its step is done again."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


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
    from adapt.finetuning import usual_finetuning
    from envs import make_task
    from envs.camera import Camera
    from policies import METHODS, pixel_mpc
    from policies.evaluate import TEST_EPISODES

    given = import_module(step.command).Options(**step.options)
    yield repr(sorted((k, v) for k, v in asdict(given).items() if v is not None and v is not False and v != ()))
    system = _robot(given)
    yield repr(system)
    yield repr((_asked(make_task(system)), TEST_EPISODES.get(system.name)))
    method = step.options.get("method", "apg") + ("-pixels" if step.options.get("pixels") else "")
    if step.command == "adapt.pretrain":
        yield repr(pretrain.configuration(given, system))
    elif step.command == "adapt.fewshot":
        yield repr(usual_finetuning(method, system))
    elif step.command == "adapt.vision":
        yield repr(Camera())
        yield repr((METHODS[f"{method}-pixels"].module if method != "mpc" else pixel_mpc).Config())


def _robot(options):
    """The system of a command's options; a simulator brings its own."""
    from adapt.setting import with_plant

    if getattr(options, "plant", None):
        options = with_plant(options)
    return command.pick_robot(getattr(options, "system", "cartpole"), getattr(options, "vehicle", None))[0]


def _asked(task):
    """What a task asks: its fields, and the plain values of its class, such as weights and thresholds."""
    values = {key: value for one in reversed(type(task).__mro__) for key, value in vars(one).items()}
    plain = {key: value for key, value in values.items() if isinstance(value, int | float | str | tuple | dict)}
    return task, sorted((key, value) for key, value in plain.items() if not key.startswith("_"))


def resolved(step, root, seed, name="self"):
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
    record = _record(path)
    same = record.get("config") == config
    if same and record.get("done"):
        return record
    spent = record.get("seconds", 0.0) if same else 0.0
    record = {"command": step.command, "options": step.options, "config": config, "done": False, "seconds": spent}
    command.write_json(path, record)
    begun = time.perf_counter()
    try:
        _call(step, resolved(step, root, seed, name), folder / step.out, goes_on=same)
        record["done"] = True
    finally:
        record["seconds"] = round(spent + time.perf_counter() - begun, 1)
        command.write_json(path, record)
    return record


def _call(step, options, out, goes_on):
    """Run a command; one that can go on does, and where it refuses to, because files are damaged, it begins again."""
    module = import_module(step.command)
    can = "resume" in {item.name for item in fields(module.Options)} and (out / "training.pt").is_file()
    if goes_on and can:
        try:
            return module.main(module.Options(**options, out=str(out), resume=True))
        except InputError:
            traceback.print_exc()
    return module.main(module.Options(**options, out=str(out), overwrite=True))


def _row(experiment, root, seed, done):
    """The figures of a run, from what its last step has written."""
    folder, last, setting = place(root, experiment.name, seed), experiment.steps[-1], experiment.setting
    files = [folder / last.out] if last.out.endswith(".json") else [folder / last.out / n for n in FILES]
    found = {key: value for path in files if path.is_file() for key, value in json.loads(path.read_text()).items()}
    row = READERS[last.command](found) | _spent(experiment, root, seed)
    row |= {"set": found.get("set", ""), "target": " ".join(setting.get("target", ()))}
    row |= {key: setting.get(key, "") for key in ("horizon", "mode")}
    row |= {"system": setting.get("system", found.get("system", "")), "metric": found["metric"], "unit": found["unit"]}
    seconds = [record["seconds"] for record in done]
    row |= {"wall_s": "" if None in seconds else round(sum(seconds), 1), "threads": found["threads"]}
    row |= {key: found[key] for key in VERSIONS}
    return row | {"commit": " ".join(_commits(experiment, folder, found))}


def _spent(experiment, root, seed):
    """Samples and seconds of the whole training that a flown policy comes from, not only until it was kept."""
    if experiment.steps[-1].command != "adapt.evaluate":
        return {}
    for name in (experiment.name, *experiment.needs):
        log = place(root, name, seed) / "training" / "log.csv"
        if EXPERIMENTS[name].steps[0].command == "adapt.pretrain" and log.is_file():
            last = list(csv.DictReader(log.read_text().splitlines()))[-1]
            return {"samples": int(last["samples"]), "seconds": round(float(last["seconds"]), 1)}
    return {}


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
    row |= {key: found[key]["mean"] for key in ("source", "zero_shot", "oracle") if key in found}
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
