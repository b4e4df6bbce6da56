"""What there is to run: every row of every table and every curve of every figure is an `Experiment`.

An experiment is a few of this package's own commands with their options, so each of its rows can be made by hand, too.
In options, `{self}` is the folder of the run, `{NAME}` that of the run of experiment NAME with the same seed, whose
result is needed first, and `{seed}` the seed.
"""

import re
from dataclasses import dataclass
from string import Formatter

DRAG = ("drag=0.3",)
SYSTEMS = ("cartpole", "quadrotor", "fixed_wing")
AIRCRAFT = ("quadrotor", "fixed_wing")
HORIZONS = (1, 3, 5, 8, 10, 12, 15)
MODES = ("concurrent", "autoregressive", "recurrent")
LONGEST = HORIZONS[-1]  # whose test paths all horizons fly
# Transitions in the target: the paper's budgets, and few.
BUDGETS = {"quadrotor": (30, 100, 300, 1000), "fixed_wing": (30, 100, 300, 1000, 2000, 5000)}
PPO_BUDGETS = {"quadrotor": (30, 100, 300, 1000, 5000), "fixed_wing": (30, 100, 300, 1000, 2000, 5000)}
# Other targets than the paper's drag. Those of the fixed wing are as strong as its thrust can make good: in a wind of
# 3 m/s or a quadratic drag of 0.1 per metre no controller follows its reference, not even MPC in the true equations.
ALL = ("push=0.3", "wind=2", "mass=x1.2", "thrust_loss=0.1", "quadratic_drag=0.05", "drag=0.2")
ALL_SLIGHTLY = ("push=0.3", "wind=1", "mass=x1.2", "thrust_loss=0.1", "quadratic_drag=0.01", "drag=0.1")
CHANGES = {
    "drag": {"quadrotor": DRAG, "fixed_wing": DRAG},
    "push": {"quadrotor": ("push=0.5",), "fixed_wing": ("push=0.5",)},
    "wind": {"quadrotor": ("wind=3",), "fixed_wing": ("wind=2",)},
    "mass": {"quadrotor": ("mass=x1.3",), "fixed_wing": ("mass=x1.3",)},
    "thrust": {"quadrotor": ("thrust_loss=0.15",), "fixed_wing": ("thrust_loss=0.15",)},
    "quadratic": {"quadrotor": ("quadratic_drag=0.1",), "fixed_wing": ("quadratic_drag=0.02",)},
    "all": {"quadrotor": ALL, "fixed_wing": ALL_SLIGHTLY},
}
FEWEST = (30, 100, 1000)  # transitions in drag beside `FEW`
FEW, NOISY = 300, 1000  # transitions in other targets, and where sensors err
KINDS_TRIED = ("parameters", "linear", "features", "network", "linear+network", "state")
SIMULATED = {"rotorpy": 5, "drone-models": 20, "jsbsim": 30, "mujoco": 20}  # test flights, fewer where flying is slow
MANY = 150_000
MOST_SEEDS = 10_000
# What 150 000 transitions of the fixed wing are best used with, found on validation episodes: it has to learn to hold
# its height again. With fewer transitions these settings do harm.
MANY_SETTINGS = {"quadrotor": {}, "fixed_wing": {"exploration": 0.3, "learning_rate": 1e-3, "curriculum": 0.3}}


@dataclass(frozen=True)
class Step:
    """One command: its module, its options, and what it writes (a folder or a file) in the folder of the run."""

    command: str
    options: dict
    out: str

    @property
    def needs(self):
        """Names of the experiments whose results the options name."""
        texts = [value for value in self.options.values() if isinstance(value, str)]
        named = {field for text in texts for _, field, _, _ in Formatter().parse(text) if field}
        return tuple(sorted(named - {"self", "seed"}))


@dataclass(frozen=True)
class Experiment:
    """Steps that lead to one row of results for each seed; the last writes the figures of the row."""

    name: str
    table: str  # table or figure that it is evidence for
    steps: tuple[Step, ...]
    curve: str | None = None  # CSV in the folder of the run with errors on the way
    seeds: int | None = None  # how many seeds make a difference; None: any number
    cluster: bool = False  # takes more than a machine with two cores affords

    @property
    def needs(self):
        """Names of the experiments whose results this one starts from."""
        return tuple(sorted({name for step in self.steps for name in step.needs}))

    @property
    def setting(self):
        """The options of its steps by name, the last step's winning: what it is about."""
        return {key: value for step in self.steps for key, value in step.options.items()}


def policy_of(name):
    """Where an experiment leaves the policy that it has trained."""
    return f"{{{name}}}/training/policy.safetensors"


def fly(system, method="apg", **options):
    """Evaluate a controller over the test episodes."""
    return Step("adapt.evaluate", {"system": system, "method": method, **options}, "evaluation.json")


def trained(name, table, system, method="apg", flown=None, **training):
    """Train a policy from scratch, then fly it."""
    learn = Step("adapt.pretrain", {"system": system, "method": method, **training, "seed": "{seed}"}, "training")
    steps = (learn, fly(system, method, policy=policy_of("self"), **(flown or {})))
    return Experiment(name, table, steps, "training/log.csv")


def continued(system, method, samples, **options):
    """Go on training a rival's policy in the target with a budget of transitions, then fly it there."""
    name = f"drag-{method}-{system}-{samples}"
    place = {"target": DRAG, "samples": samples, "policy": policy_of(f"{method}-{system}"), **options, "seed": "{seed}"}
    learn = Step("adapt.pretrain", {"system": system, "method": method, **place}, "training")
    flown = fly(system, method, policy=policy_of("self"), target=DRAG)
    cluster = method == "pets" and samples == MANY
    return Experiment(name, f"table4-{system}", (learn, flown), cluster=cluster)


def adapted(system, samples):
    """Adapt a policy of analytic policy gradients to the target with a budget of transitions."""
    options = {"system": system, "target": DRAG, "samples": samples, "policy": policy_of(f"apg-{system}")}
    options |= {"oracle": True, "watch": 20} if samples == 1000 else {}
    step = Step("adapt.fewshot", {**options, "seed": "{seed}"}, "adaptation")
    curve = "adaptation/tuning.csv" if samples == 1000 else None
    return Experiment(f"drag-apg-{system}-{samples}", f"table4-{system}", (step,), curve)


def planned(system, samples):
    """MPC in the model completed by the residual that APG was adapted with."""
    residual = f"{{drag-apg-{system}-{samples}}}/adaptation/residual.safetensors"
    step = fly(system, "mpc-residual", target=DRAG, residual=residual)
    return Experiment(f"drag-mpc-{system}-{samples}", f"table4-{system}", (step,))


def in_the_model():
    """Table I: every method on every system."""
    for system in SYSTEMS:
        yield Experiment(f"mpc-{system}", "table1", (fly(system, "mpc"),), seeds=1)
        for method in ("apg", "ppo", "pets"):
            yield trained(f"{method}-{system}", "table1", system, method)
    for method in ("apg", "ppo"):
        step = fly("quadrotor", method, policy=policy_of(f"{method}-quadrotor"), set="fast")
        yield Experiment(f"{method}-quadrotor-fast", "table1", (step,))
    yield trained("apg-quadrotor-paper", "table1", "quadrotor", preset="paper", every=2000)


def by_horizon():
    """Table II: horizon and the way in which actions follow one another, with equal updates, on the same paths."""
    flown = {"episodes_horizon": LONGEST, "gradient": True}
    for mode in MODES:
        for horizon in HORIZONS:
            settings = {"mode": mode, "horizon": horizon, "updates": 800, "every": 100}
            yield trained(f"horizon-{mode}-{horizon}", "table2", "quadrotor", flown=flown, **settings)


def by_curriculum():
    """The curriculum figure: with, without, and each of its two parts alone."""
    for name, change in {
        "both": {},
        "none": {"curriculum": 0.0},
        "threshold": {"ramps": "threshold"},
        "speed": {"ramps": "speed"},
    }.items():
        yield trained(f"curriculum-{name}", "curriculum", "quadrotor", updates=1000, every=50, **change)


def by_build():
    """The speed figure: the first updates with compiled dynamics, and without."""
    for system in AIRCRAFT:
        for build, change in {"compiled": {}, "eager": {"eager": True}}.items():
            yield trained(f"speed-{build}-{system}", "speed", system, updates=400, every=20, **change)


def from_pictures():
    """Table III, and the adaptation of a policy that sees pictures."""
    for method, samples in {"apg": 1000, "ppo": 150_000, "mpc": 1000}.items():
        step = Step("adapt.vision", {"method": method, "samples": samples, "seed": "{seed}"}, "vision")
        yield Experiment(f"pictures-{method}", "table3", (step,), None if method == "mpc" else "vision/log.csv")
    for name, target in {"push": "push=0.5", "background": "background=checks"}.items():
        options = {"system": "cartpole", "pixels": True, "policy": "{pictures-apg}/vision/policy.safetensors"}
        step = Step("adapt.fewshot", {**options, "target": (target,), "seed": "{seed}"}, "adaptation")
        yield Experiment(f"pictures-apg-{name}", "table3", (step,))


def in_drag():
    """Table IV: zero-, few- and many-shot adaptation to drag."""
    for system in AIRCRAFT:
        table = f"table4-{system}"
        yield Experiment(f"drag-mpc-{system}-zero", table, (fly(system, "mpc", target=DRAG),), seeds=1)
        yield Experiment(f"drag-mpc-{system}-target", table, (fly(system, "mpc-target", target=DRAG),), seeds=1)
        for method in ("apg", "ppo", "pets"):
            step = fly(system, method, policy=policy_of(f"{method}-{system}"), target=DRAG)
            yield Experiment(f"drag-{method}-{system}-zero", table, (step,))
        for samples in BUDGETS[system]:
            yield adapted(system, samples)
            yield planned(system, samples)
        for samples in (*PPO_BUDGETS[system], MANY):
            yield continued(system, "ppo", samples, **(MANY_SETTINGS[system] if samples == MANY else {}))
        for samples in (*BUDGETS[system], MANY):
            yield continued(system, "pets", samples)
        yield _in_residual(system)


def _in_residual(system):
    """PPO in the model with the residual, where transitions cost nothing."""
    options = {"policy": policy_of(f"ppo-{system}"), "samples": MANY, **MANY_SETTINGS[system], "seed": "{seed}"}
    options |= {"residual": f"{{drag-apg-{system}-1000}}/adaptation/residual.safetensors"}
    learn = Step("adapt.pretrain", {"system": system, "method": "ppo", **options}, "training")
    flown = fly(system, "ppo", policy=policy_of("self"), target=DRAG)
    return Experiment(f"drag-ppo-{system}-residual", f"table4-{system}", (learn, flown))


def in_other_targets():
    """Other targets, exact and through sensors that err, and in each every kind of residual that could be chosen."""
    for system in AIRCRAFT:
        for samples in FEWEST:
            yield in_target(f"target-drag-{system}-{samples}", "targets", system, DRAG, samples, oracle=True)
        for change, targets in CHANGES.items():
            target = targets[system]
            yield in_target(f"target-{change}-{system}-{FEW}", "targets", system, target, FEW, oracle=True)
            noisy = (*target, "noise=1")
            yield in_target(f"target-{change}-noisy-{system}-{NOISY}", "targets", system, noisy, NOISY, oracle=True)
            for kind in KINDS_TRIED:
                named = {"residual": kind, "ungated": True}
                yield in_target(f"kinds-{change}-{system}-{kind}", "kinds", system, target, FEW, **named)


def in_target(name, table, system, target, samples, **options):
    """Adapt the policy that ships to a target."""
    options = {"system": system, "target": target, "samples": samples, **options, "seed": "{seed}"}
    return Experiment(name, table, (Step("adapt.fewshot", options, "adaptation"),))


def in_simulators():
    """Third-party simulators; each has to be installed."""
    for plant, flights in SIMULATED.items():
        options = {"plant": plant, "samples": FEW, "episodes": flights, "seed": "{seed}"}
        yield Experiment(f"simulator-{plant}", "simulators", (Step("adapt.fewshot", options, "adaptation"),))


def to_check():
    """Two quick runs, evidence of nothing: to see that a machine, or a cluster, carries out runs and what they need."""
    yield trained("check-train", "check", "cartpole", updates=200, every=50)
    options = {
        "system": "cartpole",
        "target": ("push=1",),
        "samples": 50,
        "updates": 20,
        "policy": policy_of("check-train"),
    }
    yield Experiment("check-adapt", "check", (Step("adapt.fewshot", {**options, "seed": "{seed}"}, "adaptation"),))


EXPERIMENTS = {
    experiment.name: experiment
    for part in (
        to_check,
        in_the_model,
        by_horizon,
        by_curriculum,
        by_build,
        from_pictures,
        in_drag,
        in_other_targets,
        in_simulators,
    )
    for experiment in part()
}
TABLES = tuple(dict.fromkeys(experiment.table for experiment in EXPERIMENTS.values()))


def needed(name):
    """Names of all experiments that have to be run before this one, those that come first first."""
    found = []
    for one in EXPERIMENTS[name].needs:
        found += [other for other in (*needed(one), one) if other not in found]
    return tuple(found)


def seeds_of(text):
    """Seeds of "3", "0..4" or "0,2,5..7".

    Raises:
        ValueError: what isn't of that form.
    """
    seeds = []
    for part in text.split(","):
        if not (match := re.fullmatch(r"(\d+)(?:\.\.(\d+))?", part.strip())):
            raise ValueError(part)
        first, last = int(match[1]), int(match[2] or match[1])
        if not first <= last < MOST_SEEDS:
            raise ValueError(part)
        seeds += range(first, last + 1)
    return tuple(dict.fromkeys(seeds))
