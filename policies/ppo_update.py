"""One update of PPO: fly with the present policy, judge what was flown, improve critic and policy on it.

The parts are TorchRL's: `Collector`, `GAE`, `ClipPPOLoss`, `ReplayBuffer`.
"""

import math
from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, step_mdp
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from envs.env import TrackingEnv
from envs.pixels import PLACE, reseed, tracking_env

CRITIC_BATCH = 256  # transitions of a minibatch of the critic alone
WORST = 100.0  # [-] cost of a step, in units of the mean, that counts at most and where it is not finite


def environment(dynamics, task, episodes, size):
    """Episodes side by side that start anywhere on their reference, and again where they stray from it."""
    options = {"anywhere": True, "threshold": task.thresholds[1]}
    return tracking_env(dynamics, task, episodes, (size,), episodes.device, **options)


def place_keys(task):
    """What the environment of a task goes on from. Older pictures of a stack can't be drawn from the state."""
    return tuple(key for key in PLACE if key != "pixels" or task.camera is not None)


@dataclass
class Parts:
    """TorchRL's parts, joined to a network."""

    env: EnvBase
    collector: Collector
    advantage: GAE
    loss: ClipPPOLoss
    memory: ReplayBuffer

    @property
    def tracking(self):
        """The environment that has task, episodes and limits; a camera is a transform around it."""
        return self.env if isinstance(self.env, TrackingEnv) else self.env.base_env


def joined(network, dynamics, task, episodes, config):
    """The parts for a network. They train its own parameters, not copies."""
    env = environment(dynamics, task, episodes, config.side_by_side)
    policy = ProbabilisticActor(
        TensorDictModule(network.policy, list(network.in_keys), ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    critic = ValueOperator(network.critic, in_keys=list(network.critic_keys))
    frames = {"frames_per_batch": config.collected, "total_frames": config.collected * config.updates}
    collector = Collector(env, policy, **frames, track_traj_ids=False, auto_register_policy_transforms=False)
    settings = {"clip_epsilon": config.clip, "entropy_bonus": False, "loss_critic_type": "l2", "critic_coeff": 1.0}
    memory = ReplayBuffer(
        storage=LazyTensorStorage(config.collected, device=env.device),
        sampler=SamplerWithoutReplacement(),
        batch_size=math.ceil(config.collected / config.minibatches),
    )
    return Parts(
        env,
        collector,
        GAE(gamma=config.discount, lmbda=config.trace, value_network=critic, deactivate_vmap=True),
        ClipPPOLoss(policy, critic, **settings),
        memory,
    )


def fly(run, parts, seed):
    """The next transitions (B, T) of all robots. The collector is told where they are, so that a run can be resumed.

    Where sensors err, the critic learns from what they say, as the policy does.
    """
    reseed(parts.env, seed)
    parts.collector.reset(tensordict=run.place, set_state=True)
    flown = parts.collector.rollout()
    run.place = parts.env.maybe_reset(step_mdp(flown[:, -1])).select(*place_keys(parts.tracking.task)).clone()
    if parts.tracking.noise:
        flown = flown.copy()  # the collector writes into its own again
        flown["state"], flown["next", "state"] = flown["measured"], flown["next", "measured"]
    return flown


def judge(flown, network, parts, config):
    """Write rewards, advantages and value targets of the present policy into `flown`; returns metrics.

    Whatever ends a flight, its last state is valued as if it went on for ever at what it costs there: the value behind
    an end is that of the state before it. Rewards are never positive, so an end that is worth 0 would be sought, by
    straying or by arriving as fast as possible. The value of the state behind the end would do as well as the critic
    knows it; but no flight goes on from there, so it is never learned, and where the critic sees the way to the target
    it was far off (fixed wing, validation after 1.5 million transitions: 0.7 m, as terminal 0.2 m, as here 0.06 m).
    """
    following, done = flown["next"], flown["next", "done"]
    cost = -following["reward"]
    mean = _set_unit(network.unit, cost)
    scaled = (cost / network.unit).nan_to_num(nan=WORST).clamp(max=WORST)
    following["reward"] = -(1 - config.discount) * scaled  # values are of order one
    for key in network.critic_keys:
        here, there = flown[key], following[key]
        following[key] = torch.where(done.reshape(*done.shape[:2], *[1] * (here.ndim - 2)), here, there)
    strayed = following["truncated"] & (following["step"] < parts.tracking.task.steps)
    following["terminated"] = torch.zeros_like(done)
    _value(flown, parts)
    return {"cost": float(mean), "reward": -float(mean), "resets": float(strayed.float().mean())}


def _value(flown, parts):
    """Write value targets, and advantages of mean 0 and deviation 1, into `flown`."""
    with torch.no_grad():
        parts.advantage(flown)
    advantage = flown["advantage"]
    flown["advantage"] = (advantage - advantage.mean()) / advantage.std(correction=0).clamp(min=1e-6)


def _set_unit(unit, cost):
    """Let the unit follow the mean cost of a step, no step of which counts for more than the worst; returns that."""
    cost = cost[torch.isfinite(cost)]
    if not len(cost):
        return unit
    fresh = not unit > 0
    mean = cost.clamp(max=WORST * (cost.median() if fresh else unit)).mean()
    unit.copy_((mean if fresh else 0.95 * unit + 0.05 * mean).clamp(min=1e-6))
    return mean


def study(flown, run, parts, config, fall):
    """Passes in which the critic alone learns from `flown`, which is judged anew after each.

    A critic that reads the state costs little next to a policy that reads pictures, and the better it knows what
    follows a state, the less of that is left in the advantages as noise.
    """
    network, critic = run.network, run.optimizer.param_groups[1]
    critic["lr"] = config.learning_rate * fall
    for _ in range(config.critic_epochs):
        rows = flown.select(*network.critic_keys, "value_target").reshape(-1)
        for some in torch.randperm(len(rows)).to(rows.device).split(CRITIC_BATCH):
            part = rows[some]
            value = network.critic(*(part[key] for key in network.critic_keys))
            run.optimizer.zero_grad(set_to_none=True)
            (value - part["value_target"]).square().mean().backward()
            if torch.isfinite(torch.nn.utils.clip_grad_norm_(critic["params"], config.norm)):
                run.optimizer.step()
            else:
                run.skipped += 1
        _value(flown, parts)


def improve(flown, run, parts, config, fall):
    """Epochs of the clipped objective and of the value's regression on `flown`; returns metrics."""
    network, (policy, critic) = run.network, run.optimizer.param_groups
    policy["lr"], critic["lr"] = run.rate, config.learning_rate * fall
    target = config.target_kl * fall
    kept = {*network.in_keys, *network.critic_keys, "action", "action_log_prob", "advantage", "value_target"}
    parts.memory.empty()
    parts.memory.extend(flown.select(*kept).reshape(-1))
    for _ in range(config.epochs):
        losses = [loss for minibatch in parts.memory if (loss := _descend(minibatch, run, parts.loss, config.norm))]
        divergence = sum(kl for kl, _ in losses) / max(1, len(losses))
        if divergence > 2 * target:
            break
    if divergence > 2 * target:
        run.rate = max(run.rate / 1.5, 0.01 * config.learning_rate)
    elif divergence < 0.5 * target:
        run.rate = min(run.rate * 1.5, 10 * config.learning_rate)
    value_loss = sum(value for _, value in losses) / max(1, len(losses))
    scale = float(network.policy.log_scale.detach().exp().mean())
    return {"kl": divergence, "value_loss": value_loss, "exploration": scale}


def _descend(minibatch, run, loss, limit):
    """One step of the optimiser; returns (divergence, value loss), or None where the gradient is not finite."""
    parts = loss(minibatch)
    run.optimizer.zero_grad(set_to_none=True)
    (parts["loss_objective"] + parts["loss_critic"]).backward()
    norms = [torch.nn.utils.clip_grad_norm_(group["params"], limit) for group in run.optimizer.param_groups]
    if not all(torch.isfinite(norm) for norm in norms):
        run.skipped += 1
        return None
    run.optimizer.step()
    return float(parts["kl_approx"]), float(parts["loss_critic"].detach())
