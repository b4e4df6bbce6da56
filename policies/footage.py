"""Footage: flights that were filmed, as pictures with the states they were taken in."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torchrl.envs.utils import step_mdp

from envs.env import measured

# Share of a task's last threshold beyond which a filmed robot begins again. States far from the goal cost a hundred
# times more and would be all that a policy learns from: with 1 the validation error was 0.065 m/s, with 0.5 it is
# 0.041, and 0.25 learns late (two seeds each).
STRAY = 0.5


@dataclass
class Footage:
    """N filmed steps. A stack of pictures isn't kept: only which of the N pictures it consists of."""

    frames: Tensor  # (N, 3, height, width) uint8, the newest picture of each step
    stacks: Tensor  # (N, frames) int64, rows of `frames`, the newest first
    state: Tensor  # (N, n)
    action: Tensor  # (N, m)
    next_state: Tensor  # (N, n)
    flight: Tensor  # (N,) int64, which flight a step belongs to

    @classmethod
    def empty(cls, task, device="cpu"):
        """Footage of no steps."""
        system, camera = task.system, task.camera
        table = {"device": device}
        states, actions = len(system.State._fields), len(system.Action._fields)
        return cls(
            torch.zeros(0, 3, camera.height, camera.width, dtype=torch.uint8, **table),
            torch.zeros(0, camera.frames, dtype=torch.int64, **table),
            torch.zeros(0, states, **table),
            torch.zeros(0, actions, **table),
            torch.zeros(0, states, **table),
            torch.zeros(0, dtype=torch.int64, **table),
        )

    def __len__(self):
        return len(self.state)

    def pixels(self, rows):
        """What the camera showed (B, 3 * frames, height, width) at some rows (B,)."""
        return self.frames[self.stacks[rows]].flatten(1, 2)

    def first(self, n):
        """The first `n` steps; no stack of theirs holds a later picture."""
        return Footage(**{name: part[:n] for name, part in self.tensors().items()})

    def joined(self, other):
        """This footage with another behind it."""
        ahead = {"stacks": len(self), "flight": int(self.flight.max()) + 1 if len(self) else 0}
        parts = {name: part + ahead[name] if name in ahead else part for name, part in other.tensors().items()}
        return Footage(**{name: torch.cat((getattr(self, name), part)) for name, part in parts.items()})

    def tensors(self):
        """Everything by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def add(self, now, action, following):
        """Append a step of robots side by side (B,): what they saw, did, and where that led.

        The robots must stand in the same order as in the step before, and begin with fresh flights.
        """
        size, begun = len(action), len(self)
        rows = torch.arange(begun, begun + size, device=action.device)
        onward = now["step"].squeeze(-1) > 0
        before = rows[onward] - size
        stacks = rows.unsqueeze(-1).repeat(1, self.stacks.shape[1])
        stacks[onward, 1:] = self.stacks[before, :-1]
        flight = (int(self.flight.max()) if begun else -1) + (~onward).long().cumsum(0)
        flight[onward] = self.flight[before]
        parts = {
            "frames": now["pixels"][:, :3],
            "stacks": stacks,
            "state": measured(now),
            "action": action,
            "next_state": measured(following["next"]),
            "flight": flight,
        }
        for name, part in parts.items():
            setattr(self, name, torch.cat((getattr(self, name), part)))


@torch.no_grad()
def film(footage, env, actor, now, steps, exploration, generator):
    """Fly robots on from `now` and append what was filmed to `footage`; returns where they are then.

    Args:
        actor: TensorDict module that reads `pixels` and writes `action`; None acts at random alone.
        exploration: standard deviation of Gaussian noise on the actions, which stay in [-1, 1].
    """
    for _ in range(steps):
        action = actor(now)["action"] if actor else torch.zeros(env.action_spec.shape, device=env.device)
        noise = exploration * torch.randn(action.shape, generator=generator).to(action)
        now["action"] = (action + noise).clamp(-1, 1)
        following = env.step(now)
        footage.add(now, now["action"], following)
        now = env.maybe_reset(step_mdp(following))
    return now
