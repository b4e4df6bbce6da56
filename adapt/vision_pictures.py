"""What a policy that sees pictures sees: its input, what of it moves the action, how it learned, and a film."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict

from adapt.plot_style import COLOURS, DPI, GREY, STYLE
from adapt.video import FONT, write_frames
from envs.drawing import draw
from policies.files import whole
from policies.pixel_network import PixelEncoder

ZOOM = 5  # [-] film against input
BAR = 60  # [pixel] of the film for text


def typical(result):
    """The episode with the median error of those that stayed up, or of all."""
    errors, good = result.table.error.to_numpy(float), result.table.success.to_numpy(bool)
    rows = np.flatnonzero(good) if good.any() else np.arange(len(errors))
    return int(rows[np.argsort(errors[rows], kind="stable")[len(rows) // 2]])


def stacks(task, dynamics, states):
    """What the policy saw (T, C, H, W) in the states (T, n) of a flight."""
    pictures = draw(task.camera, dynamics.system, states)
    steps = torch.arange(len(pictures))
    return torch.cat([pictures[(steps - k).clamp(min=0)] for k in range(task.camera.frames)], 1)


def _image(picture):
    """(3, H, W) as matplotlib wants it."""
    return picture.permute(1, 2, 0).numpy()


def _save(figure, path):
    with whole(path) as partial:
        figure.savefig(partial, format="png", dpi=DPI)


def draw_frames(task, seen, path):
    """The newest picture at a few moments of a flight."""
    moments = [step for step in (0, 5, 10, 20, 40, 80) if step < len(seen)]
    with matplotlib.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(7, 0.35 + 1.28 * -(-len(moments) // 2)), layout="constrained")
        axes = figure.subplots(-(-len(moments) // 2), 2, squeeze=False).ravel()
        for one, step in zip(axes, moments, strict=False):
            one.imshow(_image(seen[step, :3]), interpolation="nearest")
            one.set_title(f"{step * task.system.dt:.2f} s", loc="left", color=GREY, fontsize=12, pad=3)
        for one in axes:
            one.set_axis_off()
        height, width = seen.shape[-2:]
        figure.suptitle(f"what the policy sees: {width} × {height} pixels", fontsize=13)
        _save(figure, path)


def saliency(actor, seen):
    """How strongly each pixel of a stack (C, H, W) moves the action: |gradient| (frames, H, W), all colours."""
    encoder, read = next(part for part in actor.modules() if isinstance(part, PixelEncoder)), []
    hook = encoder.convolutions[0].register_forward_pre_hook(lambda _, inputs: read.append(inputs[0].requires_grad_()))
    with hook:
        action = actor(TensorDict({"pixels": seen.unsqueeze(0)}, batch_size=1))["action"]
    (upstream,) = torch.autograd.grad(action.sum(), read)
    levels = seen.unsqueeze(0).float().requires_grad_()  # the encoder reads differences of pictures: back to these
    (gradient,) = torch.autograd.grad(encoder.changes(levels), levels, upstream)
    return gradient[0].abs().unflatten(0, (-1, 3)).sum(1)


def draw_saliency(actor, seen, path, step=20):
    """The stack of pictures, and which of its pixels move the action."""
    step = min(step, len(seen) - 1)
    stack = seen[step].unflatten(0, (-1, 3))
    strength = saliency(actor, seen[step]).numpy()
    strength = strength / max(strength.max(), 1e-12)
    with matplotlib.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(7, 0.5 + 1.28 * len(stack)), layout="constrained")
        for row, axes in enumerate(figure.subplots(len(stack), 2, squeeze=False)):
            axes[0].imshow(_image(stack[row]), interpolation="nearest")
            shown = axes[1].imshow(strength[row], cmap="magma", vmin=0, vmax=1, interpolation="nearest")
            axes[0].set_title("now" if row == 0 else f"{row} before", loc="left", fontsize=12, color=GREY, pad=3)
            for one in axes:
                one.set_axis_off()
        bar = figure.colorbar(shown, ax=figure.axes[1::2], shrink=0.6, aspect=30, location="right")
        bar.set_label("|d action / d pixel|, relative")
        _save(figure, path)


def draw_learning(log, task, path):
    """Error on validation flights over the updates, and how many samples they took in all."""
    with Path(log).open() as file:
        rows = list(csv.DictReader(file))
    samples = np.array([float(row["samples"]) for row in rows])
    updates = np.array([float(row["update"]) for row in rows])
    error, success = (np.array([float(row[key]) for row in rows]) for key in ("error", "success"))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 4.8), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1))
        top.plot(updates, error, "o-", color=COLOURS["few_shot"])
        top.set_yscale("log")
        top.yaxis.set_minor_formatter("{x:g}")
        top.yaxis.set_major_formatter("{x:g}")
        top.set_ylabel(f"{task.metric}\n[{task.unit}]")
        top.set_title(f"validation flights that stayed up, {int(samples[-1])} samples in all", loc="left")
        bottom.plot(updates, 100 * success, "o-", color=COLOURS["oracle"])
        bottom.set_ylabel("full flights\n[%]")
        bottom.set_ylim(-5, 105)
        bottom.set_xlabel("update")
        figure.align_ylabels()
        _save(figure, path)


def film(task, dynamics, result, row, seen, path):
    """A flight in large, with the policy's actual input in the corner, in real time."""
    states, actions = result.states[row], result.actions[row]
    camera = task.camera
    large = replace(
        camera, height=camera.height * ZOOM, width=camera.width * ZOOM, scale=camera.scale * ZOOM, noise=0.0
    )
    ended = (task.diverged(None, None, states).float().cumsum(0) <= 1).nonzero()[-1]

    def frames():
        for step in range(int(ended) + 1):
            scene = draw(large, dynamics.system, states[step : step + 1])[0].permute(1, 2, 0).numpy()[..., ::-1]
            canvas = np.full((BAR + scene.shape[0], scene.shape[1], 3), 255, np.uint8)
            canvas[BAR:] = scene
            inset = cv2.cvtColor(_image(seen[step, :3]), cv2.COLOR_RGB2BGR)
            canvas[BAR + 8 : BAR + 8 + camera.height, -camera.width - 8 : -8] = inset
            corner = (canvas.shape[1] - camera.width - 9, BAR + 7), (canvas.shape[1] - 8, BAR + 8 + camera.height)
            cv2.rectangle(canvas, *corner, (90, 90, 90), 1)
            force = float(actions[min(step, len(actions) - 1), 0]) * dynamics.system.force_limit
            speed = f"speed {100 * float(states[step, 1]):+5.1f} cm/s"
            _say(canvas, f"{step * task.system.dt:5.2f} s   {speed}   force {force:+5.1f} N", 26, 0.6)
            _say(canvas, "corner: the newest picture that the policy sees, as large as it is", 50, 0.45)
            yield canvas

    write_frames(path, frames, round(1 / task.system.dt))


def _say(canvas, text, row, size):
    cv2.putText(canvas, text, (16, row), FONT, size, (70, 70, 70), 1, cv2.LINE_AA)
