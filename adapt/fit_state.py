"""Fit a state residual: the network alone, on the one-step error of the whole state."""

import torch

from adapt.correction import normalise
from adapt.correction import train as train_network
from adapt.prediction import bound, prediction_error, same_sign


def fit_state(residual, data, train, held, settings, generator):
    """The network on the one-step error of the whole state."""
    network = residual.network
    if network is None:
        return {}, prediction_error(residual, held)
    parts = []
    for part in (train, held):
        with torch.no_grad():
            predicted = bound(residual, part)(part.state, part.action)
            error = same_sign(part.next_state, predicted, part) - predicted
        parts.append((bound(residual, part).inputs(part.state, part.action), error))
    (inputs, targets), (held_inputs, held_targets) = parts
    outputs = targets.square().mean(0).sqrt() > 1e-7
    if outputs.any():
        normalise(network, inputs, targets)
        train_network(network, inputs, targets, held_inputs, held_targets, outputs, settings, generator)
        network.size[~outputs] = 0.0
    names = tuple(name for name, on in zip(data.state_names, outputs.tolist(), strict=True) if on)
    return {"network": names}, prediction_error(residual, held)
