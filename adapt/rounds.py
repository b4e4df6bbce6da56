"""Fly for data: in one go, or in rounds of flying, fitting and tuning, each flown by the policy tuned on those before.

None of it is counted where policies are compared: those episodes are others.
"""

import math
from dataclasses import replace

import torch

from adapt import residual as residuals
from adapt.finetuning import finetune
from adapt.flying import collect, film_transitions, filmed
from adapt.prediction import prediction_error
from adapt.transitions import joined
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.pixels import tracking_env

KNOWN = 0.01  # [-] share of the model's error below which flight is known
FALLING = 0.9  # times the last part's share that the next one's must be at most for another flight to be worth it
APART = 1_000  # between the seeds of the training episodes of two rounds
HELD_OUT = 1000  # transitions flown for the report alone, to measure the prediction error


def fly_in_rounds(
    policy, target, task, samples, rounds, *, exploration, seed, kind, config, until_known, progress, keep
):
    """Fly, fit, tune, fly: the policy of the last round, all transitions, and all footage if it sees pictures.

    What was flown is kept before it is learned from, so that it outlives a fit that fails. Arguments as of
    `adapt.adapt`; the task is as it is seen in the target.
    """
    transitions = footage = residual = None
    device, source, last = _device(policy), Dynamics(policy.task.system), math.inf
    for number in range(rounds):
        share = samples * (number + 1) // rounds - samples * number // rounds
        try:
            part, film = fly(policy, target, task, share, exploration, seed + APART * number)
        except InputError:
            if transitions is None or not getattr(target, "lost", False):
                raise
            break  # a plant was given up: what it flew before is kept
        transitions = part if transitions is None else joined((transitions, part))
        footage = film if footage is None else footage.joined(film)
        if until_known and residual is not None:
            left = _surprise(residual, source, part)
            if left < KNOWN or left > FALLING * last:
                break
            last = left
        if number + 1 == rounds or getattr(target, "lost", False):  # a plant may be given up in any part
            break
        keep("transitions", transitions)
        residual, _ = residuals.fit_residual(transitions, source, kind, seed)
        briefly = replace(config, updates=max(1, config.updates // 3))
        policy, _ = finetune(policy, residual.to(device), briefly, seed, progress, footage)
    return policy, transitions, footage


def _surprise(residual, source, part):
    """The share [-] of the model's acceleration error that a residual leaves of flight that it has not seen."""
    missed = [prediction_error(dynamics, part)["acceleration"] for dynamics in (residual.cpu(), source)]
    return missed[0] / max(missed[1], 1e-12)


def fly(policy, target, task, samples, exploration, seed):
    """Transitions of training episodes that the pretraining did not see, and the footage if it sees pictures."""
    device = _device(policy)
    episodes = task.episodes(max(20, 2 * samples // task.steps), "train", 1_000_000 + seed).to(device)
    generator = torch.Generator().manual_seed(seed)
    if task.camera is None:
        env = tracking_env(target, task, episodes, device=device)
        return collect(policy.actor(seed), env, samples, exploration, generator), None
    footage = filmed(policy, target, task, episodes, samples, exploration, generator)
    return film_transitions(footage, task.system), footage


def held_out(policy, target, task, episodes, seed):
    """Transitions of validation episodes, no more than so many episodes have; None of a plant that was lost."""
    device = _device(policy)
    unseen = task.episodes(20, "validation", seed).to(device)
    try:
        env = tracking_env(target, task, unseen, device=device)
        return collect(policy.actor(seed), env, min(HELD_OUT, episodes * task.steps))
    except InputError:
        if getattr(target, "lost", False):
            return None
        raise


def check_flown(target, transitions):
    """Refuse what a plant flew before it was given up where that is too little to learn from."""
    if getattr(target, "lost", False) and len(transitions) < residuals.MINIMUM:
        flown, why = f"{len(transitions)} transitions", target.faults[-1]
        raise InputError(f"{target.name}: was given up after {flown} ({why}); at least {residuals.MINIMUM} are needed")


def _device(policy):
    return next(policy.network.parameters()).device
