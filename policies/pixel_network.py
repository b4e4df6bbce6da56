"""The image policy: from the last pictures of a camera to the next actions in [-1, 1]; it sees no state."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import nn

from envs.errors import InputError


@dataclass(frozen=True)
class PixelConfig:
    """Shape of an image network; `picture` is channels, height and width of the stack of pictures."""

    picture: tuple[int, int, int]
    actions: int
    horizon: int  # number of actions planned at once
    filters: tuple[int, ...] = (16, 24, 32, 32)
    features: int = 64


class PixelEncoder(nn.Module):
    """Features (..., w) of pictures (..., 3 * frames, height, width), uint8.

    Four convolutions of kernel 3 with ReLU, as in Wiedemann, Wuest et al. (2023). What they read is the newest picture
    and the differences of each to the one before it. That is the same information, but velocity shows in the
    differences, which are faint: each is scaled to unit size.
    """

    def __init__(self, picture, filters, features):
        super().__init__()
        self.picture = tuple(picture)
        self.register_buffer("mean", torch.zeros(picture[0], 1, 1))
        self.register_buffer("scale", torch.full((picture[0], 1, 1), 255.0))
        sizes = (picture[0], *filters)
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(sizes))
        height, width = picture[1:]
        for _ in filters:
            height, width = -(-height // 2), -(-width // 2)
        self.layer = nn.Linear(filters[-1] * height * width, features)

    def forward(self, pixels):
        if pixels.dtype != torch.uint8 or tuple(pixels.shape[-3:]) != self.picture:
            found = f"{tuple(pixels.shape[-3:])} of {str(pixels.dtype).removeprefix('torch.')}"
            raise InputError(f"pixels: {found}, expected {self.picture} of uint8 (channels, height, width)")
        hidden = self.changes(pixels.flatten(0, -4).float())
        for convolution in self.convolutions:
            hidden = torch.relu(convolution(hidden))
        return torch.relu(self.layer(hidden.flatten(1))).unflatten(0, pixels.shape[:-3])

    def changes(self, levels):
        """What the convolutions read (N, C, H, W) of grey levels (N, C, H, W)."""
        return (changes(levels) - self.mean) / self.scale

    @torch.no_grad()
    def normalise(self, pixels):
        """Take mean and scale of each channel from pictures (N, C, H, W)."""
        seen = changes(pixels.float()).transpose(0, 1).flatten(1)
        self.mean.copy_(seen.mean(1)[:, None, None])
        self.scale.copy_(seen.std(1).clamp(min=1.0)[:, None, None])

    @torch.no_grad()
    def expose(self, pixels):
        """Get used to pictures (N, 3, H, W) of another brightness, as an eye does.

        The mean level tells it: unlike spreads and differences it doesn't depend on how the robot moves.
        """
        gain = pixels[:, :3].float().mean() / self.mean[:3].mean().clamp(min=1.0)
        self.mean.mul_(gain)
        self.scale.mul_(gain)


def changes(levels):
    """The newest picture and the differences of each to the one before it: (N, 3 * frames, H, W)."""
    return torch.cat((levels[:, :3], levels[:, :-3] - levels[:, 3:]), 1)


class PixelNetwork(nn.Module):
    """The concurrent policy from pictures: all actions of the horizon at once."""

    Config: ClassVar[type] = PixelConfig

    def __init__(self, config: PixelConfig):
        super().__init__()
        self.config = config
        self.encoder = PixelEncoder(config.picture, config.filters, config.features)
        self.head = nn.Sequential(
            nn.Linear(config.features, config.features),
            nn.ReLU(),
            nn.Linear(config.features, config.horizon * config.actions),
        )

    def forward(self, pixels):
        """Plan (..., T, m) in [-1, 1] for pictures (..., C, H, W), uint8."""
        return torch.tanh(self.head(self.encoder(pixels))).unflatten(-1, (self.config.horizon, self.config.actions))

    @staticmethod
    def contract(task):
        """The fields of a `PixelConfig` that a task prescribes.

        Raises:
            InputError: when the task has no camera.
        """
        if task.camera is None:
            name = task.system.name
            raise InputError(f"{name}: the task has no camera, a policy from pictures needs one (cartpole can have it)")
        return {
            "picture": task.camera.shape,
            "actions": len(task.system.Action._fields),
            "horizon": task.horizon,
        }
