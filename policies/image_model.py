"""A model of how pictures change, learned from pictures and actions alone: principal components, and their dynamics.

Shapes below: N pictures, k entries of a latent, F pictures that a prediction reads, m actions.
"""

from itertools import pairwise

import torch
from torch import nn

from envs.drawing import draw
from envs.errors import InputError


class ImageModel(nn.Module):
    """How pictures change. A picture (3, height, width) is known by its latent (k,), F pictures by (F, k).

    Distances between latents are those between pictures as far as the principal components show them, in units of the
    spread of the pictures learned from.

    Args:
        pictures: (N, 3, height, width) uint8, from which the principal components are taken.
    """

    members = 1  # as an ensemble has

    def __init__(self, task, config, pictures):
        super().__init__()
        self.system, self.camera, self.rest = task.system, task.camera, config.rest
        self.history = min(config.history, task.camera.frames)
        flat = pictures.flatten(1).float()
        self.register_buffer("mean", flat.mean(0))
        components = min(config.latent, *flat.shape)
        self.register_buffer("basis", torch.pca_lowrank(flat - self.mean, components, center=False, niter=4)[2])
        self.register_buffer("spread", torch.ones(()))
        self.spread.copy_(self.encode(pictures).square().sum(-1).mean().sqrt().clamp(min=1.0))
        self.register_buffer("goals", self.encode(goal_pictures(task, config)))
        for name in ("place", "motion", "action", "change"):
            self.register_buffer(f"{name}_scale", torch.ones(()))
        self.change = None

    def encode(self, pictures):
        """Latents (..., k) of pictures (..., 3, height, width)."""
        return (pictures.flatten(-3).float() - self.mean) @ self.basis / self.spread

    def decode(self, latents):
        """Pictures (..., 3, height, width) in grey levels, as floats, of latents (..., k)."""
        flat = self.mean + self.spread * latents @ self.basis.T
        return flat.unflatten(-1, (3, self.camera.height, self.camera.width))

    def seen(self, pixels):
        """Latents (..., F, k) of stacks of pictures (..., 3 * frames, height, width), the newest first.

        Raises:
            InputError: pictures of another type or shape than those learned from.
        """
        if pixels.dtype != torch.uint8 or tuple(pixels.shape[-3:]) != self.camera.shape:
            found = f"{tuple(pixels.shape[-3:])} of {str(pixels.dtype).removeprefix('torch.')}"
            raise InputError(f"pixels: {found}, expected {self.camera.shape} of uint8 (channels, height, width)")
        return self.encode(pixels.unflatten(-3, (-1, 3))[..., : self.history, :, :, :])

    def forward(self, latents, action):
        """Latents (..., F, k) one step after `latents` (..., F, k) and an action (..., m)."""
        new = latents[..., 0, :] + self.change_scale * self.change(self.inputs(latents, action))
        return torch.cat((new.unsqueeze(-2), latents[..., :-1, :]), -2)

    def inputs(self, latents, action):
        """What a change is predicted from: newest picture, differences of each to the one before, action; unit size."""
        motion = (latents[..., :-1, :] - latents[..., 1:, :]).flatten(-2)
        parts = (latents[..., 0, :] / self.place_scale, motion / self.motion_scale, action / self.action_scale)
        return torch.cat(parts, -1)

    @torch.no_grad()
    def normalise(self, latents, action, change):
        """Take the scales from latents (N, F, k), actions (N, m) and changes (N, k) of the newest latent."""
        self.place_scale.copy_(latents[:, 0].std())
        self.motion_scale.copy_((latents[:, 0] - latents[:, 1]).std() if self.history > 1 else torch.ones(()))
        self.action_scale.copy_(action.std())
        self.change_scale.copy_(change.std())

    def cost(self, latents):
        """Image cost (...) of latents (..., F, k): distance to the nearest goal, and to the picture before, squared."""
        new = latents[..., 0, :]
        away = (self.goals.square().sum(-1) - 2 * new @ self.goals.T).amin(-1) + new.square().sum(-1)
        moved = (new - latents[..., 1, :]).square().sum(-1) if self.history > 1 else 0.0
        return away.clamp(min=0.0) + self.rest * moved


class Nearest(nn.Module):
    """The change (..., k) of the recorded transition whose inputs (i,) are nearest."""

    def __init__(self, inputs, changes):
        super().__init__()
        self.register_buffer("recorded", inputs)
        self.register_buffer("changes", changes)

    def forward(self, inputs):
        flat = inputs.flatten(0, -2)
        return self.changes[torch.cdist(flat, self.recorded).argmin(-1)].unflatten(0, inputs.shape[:-1])


def goal_pictures(task, config):
    """The robot at rest, as the task's path prescribes, at many places (G, 3, height, width)."""
    rest = task.path(task.episodes(1, "train", 0))[:, -1]
    places = task.camera.offset_x + torch.linspace(-config.reach, config.reach, config.goals).unsqueeze(-1)
    return draw(task.camera, task.system, torch.where(rest.isnan(), places, rest))


def learn(model, config, latents, action, following, windows, generator, progress=None):
    """Give a model its `change`: recorded transitions, or a network trained over several of its own steps."""
    known = following >= 0
    changes = latents[following[known], 0] - latents[known, 0]
    model.normalise(latents[known], action[known], changes)
    inputs = model.inputs(latents[known], action[known])
    if config.model == "nearest":
        model.change = Nearest(inputs, changes / model.change_scale)
        return
    sizes = (inputs.shape[1], config.width, config.width, latents.shape[-1])
    layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    model.change = nn.Sequential(layers[0], nn.SiLU(), layers[1], nn.SiLU(), layers[2])
    optimizer = torch.optim.AdamW(model.change.parameters(), config.learning_rate, weight_decay=config.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates)
    updates = range(config.updates)
    for _ in progress(updates) if progress else updates:
        rows = windows[torch.randint(len(windows), (config.batch,), generator=generator)]
        loss, now = 0.0, latents[rows[:, 0]]
        for row in rows.unbind(1):
            now = model(now, action[row])
            loss = loss + ((now[:, 0] - latents[following[row], 0]) / model.change_scale).square().mean()
        optimizer.zero_grad()
        (loss / config.unroll).backward()
        nn.utils.clip_grad_norm_(model.change.parameters(), 1.0)
        optimizer.step()
        schedule.step()
