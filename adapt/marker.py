"""A residual that sees pictures: `python -m adapt.marker --samples 1000`.

One of two poles is mounted, and the colour of its tip tells which. Their masses differ, so a residual that sees state
and action alone can only learn something in between; one whose context is what is seen in the pictures learns both, and
a policy can be tuned for either. Nothing is told what the marker looks like or where it is.
"""

import math
from dataclasses import asdict, dataclass, replace

from adapt import command, marker_report
from envs.errors import InputError

OUTPUTS = ("config.json", "metrics.json", "marker.png")
FLIGHTS = 40  # that the samples are shared out to: many short ones, so that no part of them lacks either pole
HEAVIEST = 100.0  # [kg] pole that the model is still meant for
UNSEEN = 1000  # transitions that the one-step error is measured on
TIPS = {"light": (220, 40, 40), "heavy": (40, 60, 220)}  # red and blue
RESIDUALS = ("context_free", "conditioned", "true_mass")


@dataclass(frozen=True)
class Options:
    """Tell two poles apart by what a camera sees, and adapt to both from one set of transitions.

    Compares a residual without context, one that sees pictures and one that is told the mass.
    Writes metrics.json, config.json and marker.png.
    """

    samples: int = 1000
    """Transitions to fly, half of them with each pole."""
    light: float = 0.2
    """Mass of the pole with a red tip [kg]."""
    heavy: float = 3.0
    """Mass of the pole with a blue tip [kg]."""
    policy: str | None = None
    """Checkpoint of a cartpole policy to fly and to fine-tune (default: the one that ships)."""
    exploration: float = 0.2
    """Standard deviation of noise on the actions flown for data, which span -1 to 1."""
    updates: int | None = None
    """Gradient steps of each fine-tuning (default: 200)."""
    seed: int = 0
    """Seed of everything that is drawn."""
    out: str | None = None
    """Folder for the results (default: runs/marker-nSAMPLES-seedN)."""
    overwrite: bool = False
    """Replace what the folder holds."""
    threads: int = 1
    """Threads of torch; small batches run fastest on one."""


def main(options):
    """Check the options, fly, fit, fine-tune, print, write."""
    _check(options)
    command.check_seed(options.seed)
    command.set_threads(options.threads)
    system, _ = command.pick_robot("cartpole", None)
    policy = command.pick_policy(options.policy, system, None)
    out = options.out or f"runs/marker-n{options.samples}-seed{options.seed}"
    folder = command.output_folder(out, options.overwrite, OUTPUTS)
    settings = {"options": asdict(options), **command.environment(options.seed, options.threads)}
    command.write_json(folder / "config.json", settings)
    metrics, frames = experiment(options, policy)
    command.write_json(folder / "metrics.json", metrics)
    print(marker_report.table(metrics))
    marker_report.save(metrics, frames, folder / "marker.png")
    print(f"results in {folder}/: {', '.join(OUTPUTS)}")


def _check(options):
    if options.samples < FLIGHTS:
        raise InputError(f"--samples {options.samples}: expected at least {FLIGHTS}, one for each flight")
    if not 0 < options.light < options.heavy <= HEAVIEST:
        said = f"--light {options.light:g} --heavy {options.heavy:g}"
        raise InputError(f"{said}: expected masses above 0 and up to {HEAVIEST:g} kg, the light one first")
    if not 0 <= options.exploration <= 1:
        raise InputError(f"--exploration {options.exploration:g}: expected between 0 and 1")
    if options.updates is not None and options.updates < 1:
        raise InputError(f"--updates {options.updates}: expected at least 1")


@dataclass(frozen=True)
class Mounted:
    """A target: the robot with one of the poles, and the camera that sees its marker."""

    mass: float  # [kg]
    dynamics: object
    camera: object


@dataclass(frozen=True)
class Recording:
    """Transitions with both poles, a picture of each state, and which pole was mounted."""

    transitions: object  # N `Transitions`
    pictures: object  # (N, 3, height, width) uint8
    pole: object  # (N,) place in TIPS


def mounted(task, mass, colour):
    """The target with a pole of a mass [kg] whose tip has a colour."""
    from envs.camera import Camera
    from envs.domains import parse_target
    from envs.registry import make_dynamics

    domain = parse_target(f"pole_mass={mass!r} tip_colour={','.join(map(str, colour))}", task.system)
    return Mounted(mass, make_dynamics(task.system, domain), domain.seen(replace(task, camera=Camera())).camera)


def record(policy, targets, samples, split, seed, exploration, flights=FLIGHTS):
    """Fly a policy that sees the state in each target, in turn, and take a picture of every state."""
    import torch

    from adapt.flying import collect
    from envs.drawing import draw

    generator = torch.Generator().manual_seed(seed)
    task = replace(policy.task, steps=math.ceil(samples / flights))
    episodes = task.episodes(flights, split, seed)
    shares = [samples // len(targets) + (i < samples % len(targets)) for i in range(len(targets))]
    parts = [
        collect(policy.actor(), (target.dynamics, task, episodes), share, exploration, generator)
        for target, share in zip(targets, shares, strict=True)
    ]
    pictures = [draw(target.camera, task.system, part.state) for target, part in zip(targets, parts, strict=True)]
    return _in_turn(parts, pictures)


def _in_turn(parts, pictures):
    """One flight of each part after the other, so that neighbouring flights hold both poles."""
    import torch

    count = len(parts)
    pole = torch.cat([torch.full((len(part),), i) for i, part in enumerate(parts)])
    trajectory = torch.cat([count * part.trajectory + i for i, part in enumerate(parts)])
    order = trajectory.argsort(stable=True)
    names = ("state", "action", "next_state")
    joined = {name: torch.cat([getattr(part, name) for part in parts])[order] for name in names}
    transitions = replace(parts[0], **joined, trajectory=trajectory[order])
    return Recording(transitions, torch.cat(pictures)[order], pole[order])


def contexts(recording, masses):
    """The transitions as each of the `RESIDUALS` gets them."""
    import torch

    from adapt.picture_features import with_pictures

    told = torch.tensor(masses)[recording.pole].unsqueeze(-1)
    return {
        "context_free": recording.transitions,
        "conditioned": with_pictures(recording.transitions, recording.pictures),
        "true_mass": replace(recording.transitions, context=told, context_names=("pole_mass",)),
    }


def experiment(options, policy):
    """Record, fit the residuals, measure them, fine-tune in them; the metrics and a picture (3, h, w) of each pole."""
    from adapt.clock import Clock
    from adapt.residual import fit_residual
    from envs.dynamics import Dynamics

    clock, task, seed = Clock(lambda name: print(f"{name} ...", flush=True)), policy.task, options.seed
    masses = (options.light, options.heavy)
    targets = [mounted(task, mass, colour) for mass, colour in zip(masses, TIPS.values(), strict=True)]
    clock.next("collect")
    # As in adapt.rounds: training episodes that the pretraining did not see.
    flown = record(policy, targets, options.samples, "train", 1_000_000 + seed, options.exploration)
    unseen = record(policy, targets, UNSEEN, "validation", seed, options.exploration)
    clock.next("fit")
    source, data, held_out = Dynamics(task.system), contexts(flown, masses), contexts(unseen, masses)
    fits = {name: fit_residual(data[name], source, "linear+network", seed) for name in RESIDUALS}
    dynamics = {"model": source, **{name: residual for name, (residual, _) in fits.items()}}
    seen = _seen(data["conditioned"].context, flown.pole)
    clock.next("finetune")
    flights = closed_loop(options, policy, targets, dynamics, [part.mean(0) for part in seen])
    metrics = {
        "samples": len(flown.transitions),
        "seed": seed,
        "pole_mass": dict(zip(TIPS, masses, strict=True)),
        "picture": _picture_figures(seen),
        **one_step(dynamics, held_out, unseen.pole),
        "metric": task.metric,
        "unit": task.unit,
        "flights": flights,
        "residuals": {name: {"inputs": fit.inputs, "network": fit.network} for name, (_, fit) in fits.items()},
        "warnings": [f"{name}: {text}" for name, (_, fit) in fits.items() for text in fit.warnings],
        "seconds": clock.stop(),
        "threads": options.threads,
    }
    return metrics, [unseen.pictures[unseen.pole == i][0] for i in range(len(targets))]


def _seen(context, pole):
    return [context[pole == i] for i in range(len(TIPS))]


def _picture_figures(seen):
    """Mean of each hue's strength with each pole, and its spread over the states."""
    from adapt.picture_features import HUES

    def by_hue(values):
        return dict(zip(HUES, values.tolist(), strict=True))

    return {
        name: {"mean": by_hue(part.mean(0)), "spread": by_hue(part.std(0))}
        for name, part in zip(TIPS, seen, strict=True)
    }


def one_step(dynamics, held_out, pole):
    """One-step errors on unseen transitions of both poles and of each, and what the pictures are worth.

    `ratios` divide the errors of the conditioned residual by those of the context-free one; `ratio` is the largest.
    """
    from adapt.prediction import prediction_error

    data = {"model": held_out["context_free"], **held_out}
    prediction = {name: prediction_error(dynamics[name], data[name]) for name in dynamics}
    by_pole = {
        text: {name: prediction_error(dynamics[name], data[name].select(pole == i)) for name in dynamics}
        for i, text in enumerate(TIPS)
    }
    ratios = {row: error / prediction["context_free"][row] for row, error in prediction["conditioned"].items()}
    figures = {"n": len(pole), "prediction": prediction, "prediction_by_pole": by_pole}
    return {**figures, "ratios": ratios, "ratio": max(ratios.values())}


def closed_loop(options, policy, targets, dynamics, seen):
    """Test flights with each pole of the policy as it is, tuned without context, and tuned for what is seen."""
    from adapt.finetuning import finetune, finetuning
    from policies.evaluate import evaluate, test_episodes

    tests = test_episodes(policy.task)
    usual = finetuning(policy)
    config = replace(usual, updates=options.updates or usual.updates)

    def tuned(model, text):
        return finetune(policy, model, config, options.seed, _progress(text))[0]

    middle = tuned(dynamics["context_free"], "context-free")
    flights = {}
    for name, target, values in zip(TIPS, targets, seen, strict=True):
        own = tuned(dynamics["conditioned"].with_context(values), f"seen: {name}")
        tried = {"zero_shot": policy, "context_free": middle, "conditioned": own}
        flights[name] = {
            text: evaluate(each.actor(), target.dynamics, policy.task, tests).summary for text, each in tried.items()
        }
    return flights


def _progress(text):
    from functools import partial

    from tqdm import tqdm

    return partial(tqdm, desc=text, unit="update")


if __name__ == "__main__":
    command.run("adapt.marker", Options, main)
