"""The small network of a residual, trained by gradient, or in closed form where its first layer stays random."""

import math

import torch
from torch import nn

PENALTIES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)  # [-] of hidden units and outputs scaled to about one


class Correction(nn.Module):
    """A network with one hidden layer; its last layer starts at zero, so that its output does and it can learn.

    (Were all layers zero, no gradient would reach any of them.) Tensors are buffers: a residual that a policy is tuned
    in must not collect gradients. They are kept in float64 and used in the dtype of what comes in.

    Args:
        activation: "tanh", or "cos" for random Fourier features (Rahimi and Recht 2007) of a Gaussian kernel whose
            width is the square root of the number of inputs, in normalised units.
    """

    def __init__(self, inputs, outputs, hidden, generator=None, activation="tanh"):
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.activation = activation
        phase = math.tau * torch.rand(hidden, generator=generator) if activation == "cos" else None
        tensors = {
            "mean": torch.zeros(inputs),
            "scale": torch.ones(inputs),
            "first": torch.randn(hidden, inputs, generator=generator) / math.sqrt(inputs),
            "first_bias": torch.randn(hidden, generator=generator) / 2 if phase is None else phase,
            "last": torch.zeros(outputs, hidden),
            "last_bias": torch.zeros(outputs),
            "size": torch.ones(outputs),
        }
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor.to(torch.float64))

    def forward(self, inputs):
        """Outputs (..., k) of inputs (..., p), both in physical units."""
        mean, scale, first, first_bias, last, last_bias, size = (t.to(inputs.dtype) for t in self.buffers())
        hidden = getattr(torch, self.activation)((inputs - mean) / scale @ first.T + first_bias)
        return size * (hidden @ last.T + last_bias)

    def casadi(self, inputs):
        """The same for a CasADi column, in whole matrices."""
        import casadi

        mean, scale, first, first_bias, last, last_bias, size = (casadi.DM(t.tolist()) for t in self.buffers())
        return size * (
            last @ getattr(casadi, self.activation)(first @ ((inputs - mean) / scale) + first_bias) + last_bias
        )


def normalise(network, inputs, targets):
    """Inputs to zero mean and unit spread, where they vary; outputs in units of the targets."""
    spread = inputs.std(0)
    network.mean.copy_(inputs.mean(0))
    network.scale.copy_(torch.where(spread > 1e-3, spread, 1.0))
    network.size.copy_(targets.square().mean(0).sqrt().clamp(min=1e-12))


def train(network, inputs, targets, held_inputs, held_targets, outputs, settings, generator):
    """Adam with early stopping, in float32 and normalised units; `outputs` (k) are those that count. In place."""
    names = ("first", "first_bias", "last", "last_bias")
    weights = [getattr(network, name).float().requires_grad_() for name in names]
    x, held_x = (((z - network.mean) / network.scale).float() for z in (inputs, held_inputs))
    y, held_y = ((t / network.size)[:, outputs].float() for t in (targets, held_targets))

    def loss(x, y):
        hidden = torch.tanh(x @ weights[0].T + weights[1])
        return (hidden @ weights[2][outputs].T + weights[3][outputs] - y).square().mean()

    optimizer = torch.optim.AdamW(weights, lr=settings.rate, weight_decay=settings.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps)
    best, since = (float(held_y.square().mean()), [w.detach().clone() for w in weights]), 0
    for step in range(settings.steps):
        rows = slice(None)
        if len(x) > settings.batch:
            rows = torch.randint(len(x), (settings.batch,), generator=generator)
        optimizer.zero_grad()
        loss(x[rows], y[rows]).backward()
        optimizer.step()
        schedule.step()
        since += 1
        if step % 10 == 9:
            with torch.no_grad():
                held = float(loss(held_x, held_y))
            if held < best[0]:
                best, since = (held, [w.detach().clone() for w in weights]), 0
        if since > settings.patience:
            break
    for name, weight in zip(names, best[1], strict=True):
        getattr(network, name).copy_(weight)


def solve(network, inputs, targets, held_inputs, held_targets, outputs):
    """The last layer by ridge regression, each output with the penalty that predicts `held` best. In place.

    Args:
        outputs: (k) those that count; the others stay zero.
    """
    hidden, held_hidden = (_hidden(network, part) for part in (inputs, held_inputs))
    wanted, held_wanted = targets / network.size, held_targets / network.size
    mean, goal = hidden.mean(0), wanted.mean(0)
    values, directions = torch.linalg.eigh((hidden - mean).T @ (hidden - mean) / len(hidden))
    moment = directions.T @ (hidden - mean).T @ (wanted - goal) / len(hidden)
    best = torch.full((targets.shape[1],), torch.inf, dtype=torch.float64)
    for penalty in PENALTIES:
        weights = (directions @ (moment / (values.clamp(min=0) + penalty)[:, None])).T
        bias = goal - weights @ mean
        error = (held_hidden @ weights.T + bias - held_wanted).square().mean(0)
        better = outputs & (error < best)
        network.last[better], network.last_bias[better] = weights[better], bias[better]
        best = torch.where(better, error, best)


def _hidden(network, inputs):
    seen = (inputs - network.mean) / network.scale
    return getattr(torch, network.activation)(seen @ network.first.T + network.first_bias)
