"""Adapt a policy from few transitions: `python -m adapt.fewshot --samples 1000`.

Flies the policy in a target domain (or reads recorded flights), learns what the model lacks, fine-tunes the policy in
the corrected model, and shows with numbers and pictures what that was worth.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command, report
from adapt.setting import (
    default_folder,
    pick_setting,
    recorded_only,
    starting_policy,
    target_text,
    transitions_of,
    with_plant,
)
from envs.errors import InputError

RESULTS = ("config.json", "metrics.json", "policy.safetensors", "residual.safetensors", "transitions.csv", "tuning.csv")
PICTURES = ("flight.png", "error.png", "residual.png", "training.png", "flight.mp4", "flight.gif")
Repeatable = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


@dataclass(frozen=True)
class Options:
    """Adapt a policy to a target from few transitions and show what it was worth.

    Writes metrics.json, config.json, policy.safetensors, residual.safetensors, transitions.csv, tuning.csv (each
    update of the fine-tuning) and pictures.
    """

    samples: int = 1000
    """Transitions to fly in the target."""
    system: str | None = None
    """Robot: cartpole, quadrotor or fixed_wing (default: what --vehicle or --plant is, else quadrotor)."""
    target: Repeatable = ()
    """What is different in the target, such as drag=0.3 or mass=x1.2, or noise=1 for sensors that err: 1 mm, 0.02 m/s,
    0.5 deg, 0.05 rad/s, times 1; may be repeated (default: drag=0.3)."""
    plant: str | None = None
    """Fly a simulator or hardware instead of a target: rotorpy, drone-models, jsbsim, mujoco, or MODULE:FACTORY of your
    own, called with the robot as modelled; it answers to reset and step."""
    policy: str | None = None
    """Checkpoint to start from (default: the one that ships for the robot)."""
    pixels: bool = False
    """Adapt a policy that sees pictures. The residual learns from states all the same, as of motion capture."""
    set: str | None = None
    """Family of episodes (quadrotor: paper, fast, circle, lemniscate, line, hover, or a CSV of waypoints)."""
    residual: str = "auto"
    """Kind of residual: parameters (refit those of the model and add drag and push; finds them in noisy states, too),
    linear, features (random Fourier), network, linear+network, state as in the paper, or auto, which takes the one
    that predicts held-out flight best, the simplest of equals."""
    ungated: bool = False
    """Take the new policy even where the data leave open whether it is better than the old one."""
    exploration: float = 0.1
    """Standard deviation of noise on the actions flown for data, which span -1 to 1."""
    rounds: int | None = None
    """Parts that transitions are flown in, each by the policy tuned on those before (default: 1; 5 with --pixels)."""
    collect: bool = False
    """Fly, fit, tune and fly again, a tenth of --samples at a time (or as --rounds says), until the validation error
    stops falling: that of flight predicted before it was learned from."""
    updates: int | None = None
    """Gradient steps of the fine-tuning (default: 500; a third as many after each round but the last)."""
    episodes: int | None = None
    """Test episodes of each evaluation (default: 50; 30 for the fixed wing)."""
    oracle: bool = False
    """Also fine-tune in the true target, as a bound."""
    watch: int | None = None
    """Updates between flights over validation episodes in the target during the fine-tuning, for tuning.csv (default:
    none; a real robot offers no such flights, and nothing is chosen by them)."""
    seed: int = 0
    """Seed of everything that is drawn."""
    transitions: str | None = None
    """Learn from recorded transitions (CSV or safetensors, as this command writes them) instead of flying."""
    vehicle: str | None = None
    """Parameters of your own robot: a shipped name, crazyflie (a quadrotor) or j3cub (a fixed wing), or a TOML file."""
    log: Repeatable = ()
    """Learn from a flight log of a quadrotor (CSV, PX4 .ulg, ROS bag); may be repeated, the oldest flight first."""
    validate: Repeatable = ()
    """Flight logs to report the prediction error on; may be repeated."""
    mapping: str = "auto"
    """Column mapping of the logs: a shipped name, a TOML file, or auto."""
    out: str | None = None
    """Folder for the results (default: runs/fewshot-SYSTEM-TARGET-nSAMPLES-seedN)."""
    overwrite: bool = False
    """Replace what the folder holds."""
    video: bool = False
    """Also write an MP4 of the flight before and after."""
    gif: bool = False
    """Also write the same as a GIF, for a web page."""
    device: str = "cpu"
    """Where to compute: cpu, cuda."""
    threads: int = 1
    """Threads of torch; small batches run fastest on one."""


def main(options):
    """Check the options, adapt, print, write."""
    options = with_plant(options)
    _check(options)
    command.check_seed(options.seed)
    command.set_threads(options.threads)
    device = command.pick_device(options.device)
    setting = pick_setting(options)
    policy = starting_policy(options, setting)
    recorded, validation = transitions_of(options, setting)
    outputs = (*RESULTS, *PICTURES)
    folder = command.output_folder(options.out or default_folder(options), options.overwrite, outputs)
    try:
        adaptation = _adapt(options, setting, policy, recorded, folder, device)
        _write_tuning(adaptation.history, folder / "tuning.csv")
        metrics = _metrics(options, policy, adaptation, validation)
        command.write_json(folder / "metrics.json", metrics)
        print(report.table(metrics))
        _pictures(options, adaptation, folder)
    except KeyboardInterrupt:
        said = f"what was finished is in {folder}; --overwrite begins again" if any(folder.iterdir()) else ""
        raise KeyboardInterrupt(said) from None
    files = "metrics.json, policy.safetensors, residual.safetensors, transitions.csv, tuning.csv, pictures"
    print(f"results in {folder}/: {files}")


def _write_tuning(history, path):
    import pandas as pd

    from policies.files import whole

    with whole(path) as partial:
        pd.DataFrame(history).to_csv(partial, index=False)


def _check(options):
    for name in ("watch", "updates", "episodes"):
        if (number := getattr(options, name)) is not None and number < 1:
            raise InputError(f"--{name} {number}: expected at least 1")
    if not 0 <= options.exploration <= 1:
        raise InputError(f"--exploration {options.exploration:g}: expected between 0 and 1")
    if options.oracle and options.transitions and not options.target:
        raise InputError("--oracle: needs --target, in which it can fly; recorded transitions are not enough")
    if options.log and options.transitions:
        raise InputError("--log and --transitions: give one of the two")
    if options.log and not options.vehicle:
        raise InputError("--log: needs --vehicle, which says what the motor commands mean")
    if options.mapping != Options.mapping and not options.log:
        raise InputError("--mapping: says what a log's columns are; give the log with --log, or leave it out")
    if (options.log or options.transitions) and options.rounds is not None:
        raise InputError("--rounds: parts of a flight for data; leave it out with --log and --transitions")
    if options.watch and recorded_only(options):
        raise InputError("--watch: flies in the target, which a record is not; leave it out, or name it with --target")
    if options.validate and not options.log:
        raise InputError("--validate: needs --log to learn from")
    learned = {Path(path).resolve() for path in options.log}
    if len(learned) < len(options.log):
        raise InputError("--log: names a file twice; give each flight once")
    if both := [path for path in options.validate if Path(path).resolve() in learned]:
        raise InputError(f"--validate {both[0]}: is learned from with --log; give flights that are not")
    if options.pixels and (options.log or options.transitions):
        raise InputError("--pixels: learns from pictures, which logs and transitions don't hold; leave them out")
    if options.collect and (options.log or options.transitions):
        raise InputError("--collect: flies for its data; leave out --log and --transitions")
    if options.plant and (options.target or options.oracle or options.log or options.pixels):
        raise InputError("--plant: is the target, without equations; leave out --target, --oracle, --log, --pixels")
    if options.log and (options.target or options.oracle):
        raise InputError("--log: a recorded flight is the target; leave out --target and --oracle")
    from adapt.residual import AUTO, KINDS, MINIMUM

    if options.residual not in (AUTO, *KINDS):
        raise InputError(f"--residual {options.residual}: expected one of {', '.join((AUTO, *KINDS))}")
    if options.rounds is not None and not 1 <= options.rounds <= max(1, options.samples // MINIMUM):
        least = f"at least {MINIMUM} transitions in each"
        raise InputError(f"--rounds {options.rounds}: expected at least 1, and {least}")
    if options.samples < MINIMUM:
        raise InputError(f"--samples {options.samples}: a residual needs at least {MINIMUM} transitions")


def _adapt(options, setting, policy, recorded, folder, device):
    from functools import partial

    from tqdm import tqdm

    from adapt.adaptation import adapt
    from adapt.finetuning import finetuning
    from policies.checkpoints import save_policy

    settings = {"options": asdict(options), **command.environment(options.seed, options.threads)}
    command.write_json(folder / "config.json", settings)

    def keep(name, result):
        if name == "transitions":
            result.save(folder / "transitions.csv")
        elif name == "residual":
            result.save(folder / "residual.safetensors")
        else:
            save_policy(folder / "policy.safetensors", result.network, result.task, result.info, result.method)

    updates = _updates(options, policy)
    policy.network.to(device)
    try:
        return adapt(
            policy,
            setting.target,
            plant=setting.plant,
            samples=options.samples,
            transitions=recorded,
            kind=options.residual,
            exploration=options.exploration,
            rounds=options.rounds,
            until_known=options.collect,
            seed=options.seed,
            config=replace(finetuning(policy), updates=updates),
            seen=setting.domain and setting.domain.seen(policy.task),
            gate=not options.ungated,
            oracle=options.oracle,
            episodes=options.episodes,
            watch=options.watch,
            progress=partial(tqdm, desc="fine-tuning", unit="update"),
            stage=lambda name: print(f"{name} ...", flush=True),
            keep=keep,
        )
    except InputError as error:
        if recorded is not None or not (folder / "transitions.csv").exists():  # nothing was flown that would be lost
            for name in RESULTS:
                (folder / name).unlink(missing_ok=True)
        sources = ", ".join((*options.log, *filter(None, [options.transitions])))
        if sources and str(error).startswith("transitions:"):
            raise InputError(str(error).replace("transitions", sources, 1)) from None
        raise


def _updates(options, policy):
    from adapt.finetuning import finetuning

    return options.updates or finetuning(policy).updates


def _metrics(options, policy, adaptation, validation):
    task, fit = policy.task, adaptation.fit
    metrics = {
        "system": options.vehicle or task.system.name,
        "set": task.set,
        "target": target_text(options),
        "method": policy.method,
        "metric": task.metric,
        "unit": task.unit,
        "samples": len(adaptation.transitions),
        "updates": _updates(options, policy),
        "seed": options.seed,
        **{name: evaluation.summary for name, evaluation in adaptation.evaluations.items()},
        "prediction": adaptation.prediction,
        "residual": _found(fit, task.system),
        "seconds": adaptation.seconds,
        "threads": options.threads,
    }
    if adaptation.verdict:
        metrics["gate"] = asdict(adaptation.verdict)
    if adaptation.flights:
        metrics["plant"] = adaptation.flights
    if recorded_only(options):
        metrics["evaluated_in"] = "model + residual"
    if validation is not None:
        from adapt.prediction import prediction_report
        from envs.dynamics import Dynamics

        learned = adaptation.residual.to("cpu")
        both = {"model": Dynamics(task.system), "model + residual": learned}
        metrics["validation"] = {name: prediction_report(dynamics, validation) for name, dynamics in both.items()}
        if validation.context is not None:  # what the policy was tuned in
            held = prediction_report(learned, validation, adaptation.transitions.context.mean(0))
            metrics["validation"]["with context held"] = held
        metrics["validation"]["n"] = len(validation)
    return metrics


def _found(fit, system):
    """What was learned, for people."""
    from adapt.parameter_residual import nominal

    said = {"kind": fit.kind, "inputs": fit.inputs, "network": fit.network, "warnings": fit.warnings}
    values = {
        name: {"value": value, "standard_error": error, "model": nominal(system, name)}
        for name, (value, error) in fit.parameters.items()
    }
    if fit.tried:
        said["tried"] = {one.kind: one.score if one.squares is not None else one.why for one in fit.tried}
    return said | ({"parameters": values, "alike": fit.alike} if fit.kind == "parameters" else {})


def _pictures(options, adaptation, folder):
    from adapt.plots import draw_all

    draw_all(adaptation, folder)
    if options.video or options.gif:
        from adapt.video import write_video
    if options.video:
        write_video(adaptation, folder / "flight.mp4")
    if options.gif:
        write_video(adaptation, folder / "flight.gif", fps=12.5)


if __name__ == "__main__":
    command.run("adapt.fewshot", Options, main)
