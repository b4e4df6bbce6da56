"""One case of the audit: fly, spoil the record, adapt with the gate, fly old and new policy in the truth; one row."""

import math
import os
import traceback
from dataclasses import replace

import torch

from adapt.adaptation import adapt
from adapt.audit_targets import draw
from adapt.command import environment
from adapt.flying import collect
from adapt.transitions import joined
from envs.errors import InputError
from envs.registry import make_dynamics
from policies.checkpoints import load_policy
from policies.evaluate import evaluate, test_episodes

WORSE, BETTER = 1.05, 0.95  # new over old error beyond which a policy got worse or better
FEWER = 0.02  # share of flights that may fail more, or fewer, before a policy counts as worse, or better, for it
EXPLORATION = 0.1  # standard deviation of noise on the actions flown for data, as `adapt` has it
SPENT = ("seconds", "cpu_seconds")
STAGES = ("fit", "finetune", "gate")
TOLD = {"few_shot": "gated", "zero_shot": "zero_shot", "source": "source", "oracle": "oracle"}


def case(system, index, seed, episodes=20, oracle=False):
    """The row of a case; whatever goes wrong is told in its columns `refused_data` and `crash`.

    Args:
        system: by name; its shipped policy is adapted.
        episodes: test episodes that each policy is flown on.
        oracle: also fine-tune in the true target.
    """
    drawn, begun = draw(system, index, seed), _spent()
    row = drawn.row | {"episodes": episodes, "refused_data": "", "crash": ""}
    try:
        row |= _adapted(drawn, episodes, oracle)
    except Exception:
        row["crash"] = " | ".join(line.strip() for line in traceback.format_exc().splitlines())
    spent = {name: round(now - before, 2) for name, now, before in zip(SPENT, _spent(), begun, strict=True)}
    here = environment(seed, torch.get_num_threads())
    return row | spent | here


def _spent():
    """Seconds on the clock, and of this process and those it waited for (compilers) on processors."""
    times = os.times()
    return times.elapsed, sum(times[:4])


def _adapted(drawn, episodes, oracle):
    policy, target = load_policy(drawn.system), make_dynamics(drawn.system, drawn.target)
    try:
        record = {"transitions": spoilt(policy, drawn)} if drawn.spoilt else {"samples": drawn.transitions}
        settings = {"seed": drawn.chance, "exploration": EXPLORATION, "episodes": episodes, "oracle": oracle}
        found = adapt(policy, target, **record, **settings)
    except InputError as error:
        return _kept(policy, target, episodes) | {"refused_data": str(error)}
    return _figures(found) | ({} if not (wrong := not_finite(found)) else {"crash": wrong})


def _kept(policy, target, episodes):
    """The figures of a policy that stays as it is."""
    tests = test_episodes(policy.task, episodes)
    old = evaluate(policy.actor(), target, policy.task, tests)
    row = {"ratio": 1.0, "ratio_ungated": 1.0, "accepted": False}
    return row | {key: value for name in ("zero_shot", "gated", "ungated") for key, value in _score(name, old).items()}


def _figures(found):
    """Columns of an `Adaptation`."""
    flown, verdict = found.evaluations, found.verdict
    ungated = flown.get("refused", flown["few_shot"])
    fitted = " ".join(f"{name}={value:.4g}" for name, (value, _) in found.fit.parameters.items())
    row = {"kind": found.fit.kind, "parameters": fitted, "unit": ungated.unit} | _score("ungated", ungated)
    for name, column in TOLD.items():
        row |= _score(column, flown[name]) if name in flown else {}
    row["ratio"] = ratio(flown["zero_shot"].table, flown["few_shot"].table)
    row["ratio_ungated"] = ratio(flown["zero_shot"].table, ungated.table)
    row |= {key: getattr(verdict, key) for key in ("accepted", "confidence", "reason", "gain", "share", "distance")}
    row |= {f"seconds_{stage}": round(found.seconds[stage], 2) for stage in STAGES}
    return row


def _score(name, evaluation):
    summary = evaluation.summary
    return {f"{name}_error": summary["mean"], f"{name}_success": summary["success"]}


def ratio(old, new):
    """New over old error, of tables with `error` and `success` of the same episodes; infinite where more fail.

    The mean errors are those of the episodes that both fly. Where they share none, it is 1, or 0 if only the new one
    flies any.
    """
    if old.success.mean() - new.success.mean() > FEWER:
        return math.inf
    both = old.success & new.success
    if not both.any():
        return 0.0 if new.success.mean() > old.success.mean() else 1.0
    return float(new.error[both].mean() / max(old.error[both].mean(), 1e-12))


def not_finite(found):
    """Which part of an `Adaptation` holds a number that isn't finite, in words; empty where none does."""
    parts = {"policy": found.policy.network.state_dict().values(), "residual": found.residual.state_dict().values()}
    for name, tensors in parts.items():
        if not all(tensor.isfinite().all() for tensor in tensors):
            return f"the {name} holds a number that isn't finite"
    for name, evaluation in found.evaluations.items():
        if not evaluation.table.error[evaluation.table.success].map(math.isfinite).all():
            return f"a flight of {name} succeeded with an error that isn't finite"
    return ""


# --- spoilt records ---------------------------------------------------------------------------------------------------


def spoilt(policy, drawn):
    """Transitions of a case as they reach the adaptation."""
    generator = torch.Generator().manual_seed(drawn.chance)
    old = min(drawn.transitions - 1, max(1, round(drawn.share * drawn.transitions))) if drawn.spoilt == "stale" else 0
    flown = _flown(policy, drawn.system, drawn.target, drawn.transitions - old, drawn.chance, generator)
    if old:
        return joined((_flown(policy, drawn.system, drawn.other, old, drawn.chance + 1, generator), flown))
    return {
        "shuffled": lambda: flown.select(torch.randperm(len(flown), generator=generator)),
        "swapped": lambda: replace(flown, action=swapped(flown.action, drawn.columns)),
        "flipped": lambda: replace(flown, action=flipped(flown.action, drawn.columns)),
        "late": lambda: replace(flown, action=late(flown.action, flown.trajectory)),
        "duplicated": lambda: flown.select(duplicated(len(flown), drawn.share, generator)),
    }[drawn.spoilt]()


def _flown(policy, system, target, n, seed, generator):
    """Transitions of training episodes that the pretraining did not see, as `adapt` flies them."""
    task = policy.task
    episodes = task.episodes(max(20, 2 * n // task.steps), "train", 1_000_000 + seed)
    return collect(policy.actor(seed), (make_dynamics(system, target), task, episodes), n, EXPLORATION, generator)


def swapped(action, columns):
    """Actions (N, m) with two columns in each other's place."""
    order = list(range(action.shape[1]))
    order[columns[0]], order[columns[1]] = order[columns[1]], order[columns[0]]
    return action[:, order]


def flipped(action, columns):
    """Actions (N, m) with the sign of these columns turned."""
    turned = action.clone()
    turned[:, list(columns)] *= -1
    return turned


def late(action, trajectory):
    """Actions (N, m) that are each recorded a control period too late; the first of a trajectory (N,) stays."""
    before = torch.arange(len(action)).roll(1)
    first = torch.ones(len(action), dtype=torch.bool)
    first[1:] = trajectory[1:] != trajectory[:-1]
    return torch.where(first[:, None], action, action[before])


def duplicated(count, share, generator):
    """Indices of `count` rows, of which a share stands there twice."""
    twice = torch.rand(count, generator=generator) < share
    return torch.arange(count).repeat_interleave(1 + twice.long())
