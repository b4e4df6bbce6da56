"""How steep and how noisy the analytic policy gradient is, by horizon and mode: why long horizons may fail."""

import torch

from policies.apg import Flight
from policies.modes import look_ahead


def gradient_statistics(network, dynamics, task, episodes, seed=0, batches=20, size=64, periods=10):
    """Norm and variance of the gradient of the cost over the weights of a network; the network isn't changed.

    Each batch consists of flights of its own: they begin at random places of the reference with nothing remembered,
    the network flies them for some control periods, and then the gradient of the mean cost of the next T is taken as
    in training, through the dynamics in the network's own mode. With J the mean cost over all batches, g_b the
    gradient of batch b and g their mean, in numbers without unit:

    - `norm`: |g| / J, the steepness of the logarithm of the cost. A cost that sums more steps is no steeper for that.
    - `variance`: size * sum_b |g_b - g|^2 / (batches - 1) / |g|^2, the variance of the gradient of a single sample,
      relative to the mean gradient; a mean over N samples has the N-th part. Below about batches * size it can be told
      from that of a gradient that vanishes in the mean.

    Args:
        network: the policy; its mode is the one that is measured.
        dynamics: what is flown and what the gradient flows through.
        task: with the horizon T.
        episodes: (N, ...) to fly on.
        batches: at least 2. A batch whose gradient isn't finite makes both numbers infinite or not a number.
        size: flights in each batch.
        periods: control periods flown before.
    """
    generator = torch.Generator().manual_seed(seed)
    gradients, costs = [], []
    for _ in range(batches):
        flight = Flight(task, dynamics, episodes, size, generator, network.config.memory)
        for _ in range(periods):
            with torch.no_grad():
                ahead = next_action(network, task, flight)
            flight.advance(ahead[0], task.thresholds[1], 0.0, ahead[1])
        cost = look_ahead(network, dynamics, task, flight).cost.mean()
        parts = torch.autograd.grad(cost, list(network.parameters()))
        gradients.append(torch.cat([part.flatten() for part in parts]))
        costs.append(cost.detach())
    gradients, mean = torch.stack(gradients), torch.stack(gradients).mean(0)
    spread = size * (gradients - mean).square().sum() / (batches - 1)
    return {
        "norm": float(mean.norm() / torch.stack(costs).mean()),
        "variance": float(spread / mean.square().sum()),
    }


def next_action(network, task, flight):
    """The action (B, m) of each flight now and what is remembered after it."""
    state, reference = flight.look()
    plan, hidden = network.recall(task.observe(state), task.window(state, reference), flight.hidden)
    return plan[:, 0], hidden
