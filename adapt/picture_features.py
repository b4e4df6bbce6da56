"""Numbers that say what is seen in pictures, as the context of a residual.

Wiedemann, Wuest et al. (2023), sect. IV-D: the residual "can be conditioned on any kind of information, for example
images". A picture has thousands of pixels and a few hundred transitions can't say which of them matter, so a residual
gets a few numbers instead: how strongly each hue shows up anywhere in the picture. As they look for the purest pixels
wherever these are, they don't change as the robot moves, and they need no background and no place to look at.
"""

from dataclasses import replace

import torch

from envs.errors import InputError

HUES = ("red", "yellow", "green", "cyan", "blue", "magenta")  # the primaries, and the secondaries between them
PUREST = 3  # pixels that tell the strength of a hue: fewer are noisier, more don't fit on a small marker
DARK = 1.0  # [grey levels] mean of a picture below which nothing can be told from it
CHUNK = 256  # pictures at once, so that the memory doesn't grow with their number


def hue_strengths(pictures):
    """How strongly each of `HUES` shows up in pictures: (N, 6), float32.

    Without its grey part a colour is a share of one primary and a share of one secondary: (200, 110, 30) is
    90 red + 80 yellow + 30 grey. A strength is the mean of a hue's largest shares in the picture, in units of the
    picture's mean level, so that the exposure of the camera doesn't matter.

    Args:
        pictures: (N, 3, height, width), uint8; red, green, blue.

    Raises:
        InputError: pictures of another shape or type.
    """
    shape = tuple(pictures.shape)
    if pictures.dtype != torch.uint8 or len(shape) != 4 or shape[1] != 3 or shape[2] * shape[3] < PUREST:
        found = f"{shape} of {str(pictures.dtype).removeprefix('torch.')}"
        raise InputError(f"pictures: found {found}, expected (N, 3, height, width) of uint8: red, green, blue")
    if not len(pictures):
        return torch.zeros(0, len(HUES))
    return torch.cat([_strengths(part.float()) for part in pictures.split(CHUNK)])


def _strengths(pictures):
    shares = _shares(pictures).flatten(2)
    exposure = pictures.flatten(1).mean(-1, keepdim=True).clamp(min=DARK)
    return shares.topk(PUREST, -1).values.mean(-1) / exposure


def _shares(pictures):
    """Shares (N, 6, height, width) of the hues in each pixel, in grey levels."""
    red, green, blue = pictures.unbind(1)
    grey = pictures.amin(1)

    def primary(own, second, third):
        return (own - torch.maximum(second, third)).clamp(min=0)

    def secondary(one, other):
        return torch.minimum(one, other) - grey

    hues = (
        primary(red, green, blue),
        secondary(red, green),
        primary(green, blue, red),
        secondary(green, blue),
        primary(blue, red, green),
        secondary(blue, red),
    )
    return torch.stack(hues, 1)


def with_pictures(transitions, pictures):
    """The transitions with what is seen in the picture (N, 3, height, width) of each as their context.

    Raises:
        InputError: pictures that don't fit the transitions, or are none.
    """
    if len(pictures) != len(transitions):
        raise InputError(f"pictures: {len(pictures)} for {len(transitions)} transitions, expected one for each")
    return replace(transitions, context=hue_strengths(pictures), context_names=HUES)
