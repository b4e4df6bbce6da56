"""Fine-tuning: go on training a policy in other dynamics, such as the model with a fitted residual."""

import time
from dataclasses import replace

from adapt.trust_region import Best
from envs.errors import InputError
from policies import METHODS
from policies.checkpoints import Policy
from policies.compiled_dynamics import fastest
from policies.evaluate import evaluate, test_episodes


def finetuning(policy):
    """The settings that a policy is fine-tuned with unless others are asked for."""
    return usual_finetuning(policy.method, policy.task.system)


def usual_finetuning(method, system):
    """The same for what a method, by name, has trained for a system."""
    module = METHODS[method].module
    return module.finetuning(module.PRESETS.get(system.name, module.Config()), system)


def finetune(policy, dynamics, config=None, seed=0, progress=None, footage=None, judge=None, validations=0, noise=()):
    """Continue the training of a policy in other dynamics; the given policy stays as it is.

    Args:
        dynamics: anything that is differentiable, such as a fitted residual. On the CPU they are compiled where they
            can be, see `policies.compiled_dynamics`.
        config: of the policy's method; None is `finetuning(policy)`.
        progress: wraps the iterable of updates and takes its length as `total`, as `tqdm` does.
        footage: for a policy that sees pictures: `Footage` of the target, from whose pictures it learns.
        judge: called with the network and the number of each update; returns what is added to its metrics.
        validations: how often the network flies validation episodes in the dynamics on the way. What flies best is
            returned, be it the policy as given; without any, what was trained last.
        noise: of the sensors that it flies these episodes by, see `adapt.sensor_noise`; training is without.

    Returns:
        the new `Policy` and the metrics of each update, with the `seconds` spent until then without judging.
    """
    method, config = METHODS[policy.method].module, config or finetuning(policy)
    device = next(policy.network.parameters()).device
    if device.type == "cpu":
        dynamics, _ = fastest(dynamics)
    bank = policy.task.episodes(config.episodes, "train", seed).to(device)
    filmed = {} if footage is None else {"footage": footage}
    run = method.begin(dynamics, policy.task, [bank], config, seed, policy.network, **filmed)
    best = Best(policy, dynamics, config.updates, validations, noise=noise) if validations else None
    updates = _judged(method.train(run, dynamics, policy.task, [bank], config), run, judge, best)
    history = list(progress(updates, total=config.updates) if progress else updates)
    if run.skipped == config.updates:
        raise InputError("fine-tuning: no update had a finite gradient; the residual may be of the wrong scale")
    if best:
        run.network.load_state_dict(best.weights)
    info = {**policy.info, "finetuned_updates": best.update if best else run.update, "finetune_seed": seed}
    return Policy(run.network, policy.task, info, policy.method), history


def _judged(updates, run, judge, best):
    """The metrics of each update with the time spent on training, the best noted, and what a judge says."""
    seconds, begun = 0.0, time.perf_counter()
    for metrics in updates:
        if best:
            best(run.network, metrics["update"])
        seconds += time.perf_counter() - begun
        said = judge(run.network, metrics["update"]) if judge else {}
        yield {**metrics, "seconds": seconds, **said}
        begun = time.perf_counter()


class Judge:
    """Flies a network over validation episodes every so many updates, and after the last; counts its `seconds`."""

    def __init__(self, policy, dynamics, task, every, last, episodes=50):
        self.policy, self.dynamics, self.task, self.every, self.last = policy, dynamics, task, every, last
        self.episodes, self.seconds = test_episodes(task, episodes, "validation"), 0.0

    def __call__(self, network, update):
        """`error` and `success`, or nothing after the updates between."""
        if update % self.every and update != self.last:
            return {}
        begun = time.perf_counter()
        device = next(network.parameters()).device
        actor = replace(self.policy, network=network).actor()
        summary = evaluate(actor, self.dynamics, self.task, self.episodes.to(device)).summary
        self.seconds += time.perf_counter() - begun
        return {"error": summary["mean"], "success": summary["success"]}
