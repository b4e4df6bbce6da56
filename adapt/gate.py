"""The gate: a fine-tuned policy is taken only where it is better than the old one, as far as the data can tell.

Both policies fly the same validation episodes in the fitted model and in models that the data allow just as well: fits
to resampled flight (`adapt.bootstrap`), and other kinds of residual that predict almost as well. The gain in a model is
the logarithm of the ratio of the mean errors; how sure it is follows from the episodes and from how far the models
differ. Where they leave open that the new policy is worse, or where it fails more often in any of them, policies part
of the way to it are tried, and else the old one stays.
"""

import math
from dataclasses import dataclass, replace

import torch

from adapt.trust_region import FARTHEST, SHARES, distance, episode_count, part_way, sensed
from policies.compiled_dynamics import fastest
from policies.evaluate import evaluate, test_episodes

EPISODES = 32  # validation episodes flown in each model
APART = 1_000_000  # between the seeds of its episodes and of those that weights are chosen by
SHARED = 0.5  # of the episodes that both policies must fly for their errors to be compared
SAVED = 0.25  # of the episodes that only the new policy flies, which is a gain whatever the errors
CONFIDENCE = 0.95  # that the new policy is better
WORSE = 0.05  # [-] by which it may be worse in a single model


@dataclass(frozen=True)
class Flown:
    """What both policies did in a model: errors of each episode (E,) and whether it succeeded."""

    model: str
    old: torch.Tensor
    new: torch.Tensor
    old_succeeded: torch.Tensor
    new_succeeded: torch.Tensor

    @property
    def both(self):
        """Episodes that both fly to the end."""
        return self.old_succeeded & self.new_succeeded

    @property
    def gain(self):
        """log(mean error of the old / of the new policy) over the episodes that both fly.

        Infinite where the new policy flies many more; nan where too few are flown by both to tell.
        """
        count = len(self.old)
        if self.new_succeeded.sum() - self.old_succeeded.sum() >= SAVED * count:
            return math.inf
        if self.both.sum() < SHARED * count:
            return math.nan
        return float((self.old[self.both].mean() / self.new[self.both].mean()).log())

    @property
    def doubt(self):
        """Standard error of the gain, by the paired differences over the episodes; infinite of less than two."""
        if int(self.both.sum()) < 2:
            return math.inf
        old, new = self.old[self.both], self.new[self.both]
        return float((old / old.mean() - new / new.mean()).std()) / len(old) ** 0.5


@dataclass(frozen=True)
class Verdict:
    """Whether the new policy is taken, and why."""

    accepted: bool
    reason: str
    confidence: float  # that it is better
    gain: float  # mean over the models of log(old error / new error)
    models: dict[str, dict[str, float]]  # of each model: mean errors and success of the old and the new policy
    share: float = 1.0  # of the way from the old to the new weights that was gone
    distance: float | None = None  # [-] root mean square change of the actions, which span -1 to 1


NOTHING_FOUND = "fine-tuning found nothing that flies better in the fitted model"
BY_SENSORS = ", by sensors that err as much as the recorded states jump"


def nothing_found(noise):
    """The `Verdict` where fine-tuning, validated by sensors with such noise, left the policy as it was."""
    return Verdict(False, NOTHING_FOUND + (BY_SENSORS if noise else ""), 0.0, 0.0, {}, distance=0.0)


class Gate:
    """Flies policies against an old one in models {name: dynamics}; what the old one does is flown once.

    Args:
        task: as it is seen in the target, whose validation episodes are flown.
        episodes: flown in each model, more by noisy sensors (`episode_count`).
        noise: of the sensors that both fly by, see `adapt.sensor_noise`.
    """

    def __init__(self, old, models, task=None, seed=0, episodes=EPISODES, noise=()):
        self.old, self.task, self.seed = old, task or old.task, seed
        device = next(old.network.parameters()).device
        compiled = device.type == "cpu"
        quick = {name: fastest(dynamics)[0] if compiled else dynamics for name, dynamics in models.items()}
        self.models = {name: sensed(dynamics, noise) for name, dynamics in quick.items()}
        count = episode_count(episodes, noise)
        self.episodes = test_episodes(self.task, count, "validation", APART + seed).to(device)
        self.before = {name: self._fly(old, name) for name in models}

    def _fly(self, policy, name):
        return evaluate(policy.actor(self.seed), self.models[name], self.task, self.episodes)

    def judge(self, new, confidence=CONFIDENCE):
        """The `Verdict` on a new policy."""
        flown = []
        for name, before in self.before.items():
            tables = before.table, self._fly(new, name).table
            errors, succeeded = (
                [torch.tensor(table[column].to_numpy()) for table in tables] for column in ("error", "success")
            )
            flown.append(Flown(name, *errors, *succeeded))
        return decide(flown, confidence)

    def choose(self, new):
        """The new policy, or one part of the way to it, or the old one: (policy, `Verdict`)."""
        first = next(iter(self.before.values()))
        verdicts = []
        for share in SHARES:
            tried = part_way(self.old, new, share)
            changed = distance(self.old, tried, first)
            if changed is not None and not changed <= FARTHEST:  # nan, too
                reason = f"the new policy's actions differ by {changed:.2f}, at most {FARTHEST:g} is allowed"
                verdicts.append(Verdict(False, reason, 0.0, math.nan, {}, share, changed))
                continue
            verdict = replace(self.judge(tried), share=share, distance=changed)
            verdicts.append(verdict)
            if verdict.accepted:
                return tried, verdict
        return self.old, verdicts[0]


def decide(flown, confidence=CONFIDENCE):
    """The `Verdict` on what was flown."""
    gains = torch.tensor([one.gain for one in flown], dtype=torch.float64)
    models = {one.model: _figures(one) for one in flown}
    sure = _sureness(flown)
    mean = float(gains.mean())
    if failing := [one.model for one in flown if one.new_succeeded.sum() < one.old_succeeded.sum()]:
        reason = f"the new policy fails more often in {_listed(failing)}"
        return Verdict(False, reason, sure, mean, models)
    if untold := [one.model for one in flown if math.isnan(one.gain)]:
        reason = f"too few flights succeed in {_listed(untold)} to tell which policy is better"
        return Verdict(False, reason, 0.0, math.nan, models)
    if worse := [one.model for one, gain in zip(flown, gains.tolist(), strict=True) if gain < -math.log1p(WORSE)]:
        reason = f"the new policy is worse in {_listed(worse)}"
        return Verdict(False, reason, sure, mean, models)
    if not sure >= confidence:
        reason = f"the new policy is better with a confidence of {sure:.2f}, {confidence:.2f} is asked for"
        return Verdict(False, reason, sure, mean, models)
    return Verdict(True, f"better in {len(flown)} models, confidence {sure:.3f}", sure, mean, models)


def _sureness(flown):
    """Probability that the mean gain is positive, if gains are normal over episodes and over models.

    Models in which the new policy flies many more episodes leave no doubt, and say nothing about the others.
    """
    compared = [one for one in flown if math.isfinite(one.gain)]
    if not compared:
        return float(all(one.gain > 0 for one in flown))
    gains = torch.tensor([one.gain for one in compared], dtype=torch.float64)
    between = float(gains.std()) if len(gains) > 1 else 0.0
    doubt = math.hypot(between, max(one.doubt for one in compared))
    return 0.5 * (1 + math.erf(float(gains.mean()) / max(doubt, 1e-12) / math.sqrt(2)))


def _figures(one):
    """Mean errors over the episodes that succeed, and how many do."""
    means = {name: getattr(one, name)[getattr(one, f"{name}_succeeded")].mean() for name in ("old", "new")}
    return {name: float(value) for name, value in means.items()} | {
        f"{name}_success": float(getattr(one, f"{name}_succeeded").double().mean()) for name in ("old", "new")
    }


def _listed(names):
    return ", ".join(names)
