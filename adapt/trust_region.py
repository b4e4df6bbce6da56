"""How far fine-tuning may carry a policy: no farther than validation approves, nor than its actions may change."""

import copy
from dataclasses import replace

import torch

from envs.dynamics import Sensed
from policies import METHODS
from policies.evaluate import evaluate, test_episodes

NOISY = 8  # times as many validation episodes where sensors err: errors scatter by it, and all fly side by side
FARTHEST = 1.0  # [-] root mean square change of the actions, which span -1 to 1
SHARES = (1.0, 0.5, 0.25)  # of the way that are tried, as a line search does


def sensed(dynamics, noise):
    """The dynamics as sensors with that noise tell of them; themselves where there is none."""
    return Sensed(dynamics, noise) if noise else dynamics


def episode_count(episodes, noise):
    """How many validation episodes to fly by sensors with that noise where exact ones take so many."""
    return NOISY * episodes if noise else episodes


class Best:
    """Keeps the weights that fly best over validation episodes, from those of the policy as given.

    Args:
        dynamics: to fly in, those that the policy is tuned in.
        updates: in all; it flies `times` on the way, the last time after the last update.
        noise: of the sensors that it flies by, see `adapt.sensor_noise`; takes `NOISY` times as many episodes.
    """

    def __init__(self, policy, dynamics, updates, times, episodes=16, noise=()):
        self.policy, self.every, self.last = policy, max(1, updates // times), updates
        self.dynamics = sensed(dynamics, noise)
        count = episode_count(episodes, noise)
        self.episodes = test_episodes(policy.task, count, "validation", seed=1)  # others than the gate's
        self.update, self.score = 0, None
        self(policy.network, 0)

    def __call__(self, network, update):
        """Fly the network after this update, if it is its turn."""
        if update % self.every and update != self.last:
            return
        actor = replace(self.policy, network=network).actor()
        episodes = self.episodes.to(next(network.parameters()).device)
        said = evaluate(actor, self.dynamics, self.policy.task, episodes).summary
        score = said["success"], -said["mean"] if said["success"] else 0.0
        if self.score is None or score > self.score:
            self.score, self.update, self.weights = score, update, copy.deepcopy(network.state_dict())


def same_weights(old, new):
    """Whether two policies of one form have the same weights."""
    weights = new.network.state_dict()
    return all(torch.equal(value, weights[name]) for name, value in old.network.state_dict().items())


def part_way(old, new, share):
    """The policy a `share` of the way from the weights of an old one to those of a new one."""
    if share == 1:
        return new
    network, before = copy.deepcopy(new.network), old.network.state_dict()
    mixed = {
        name: torch.lerp(before[name], value, share) if value.is_floating_point() else value
        for name, value in network.state_dict().items()
    }
    network.load_state_dict(mixed)
    return replace(new, network=network, info={**new.info, "share": share})


@torch.no_grad()
def distance(old, new, evaluation):
    """Root mean square difference of the actions of two policies in the states that were flown; None if they see more.

    Args:
        evaluation: `Evaluation` of the old policy's flights.
    """
    task = old.task
    if METHODS[old.method].pixels or getattr(old.network.config, "memory", 0):
        return None
    count, steps = evaluation.actions.shape[:2]
    states = evaluation.states[:, :-1].flatten(0, 1)
    flown = states.isfinite().all(-1)  # a lost robot may be anywhere
    rows = evaluation.episodes.repeat_interleave(steps, 0)[flown]
    step = torch.arange(steps, device=states.device).repeat(count)[flown]
    states = states[flown]
    window = task.window(states, task.reference(rows, step, states))
    actions = [policy.network(task.observe(states), window)[:, 0] for policy in (old, new)]
    return float((actions[0] - actions[1]).square().mean().sqrt())
