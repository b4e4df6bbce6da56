"""One robot that flies on and on: references follow one another without a break in the clock.

A reference is as long as the flight where the task can draw such a one (a random path, a shape), at most a minute.
Where the robot arrives, the next one begins from the robot's own state. Where a reference ends, or the robot is lost,
it is put on the beginning of the next.
"""

from dataclasses import replace

import pandas as pd
import torch
from tensordict import TensorDict

from adapt.prediction import GROUPS
from envs.dynamics import sensed

LONGEST = 60.0  # [s] of a reference
APART = 1000  # between the seeds of two references: flights of neighbouring seeds have none in common


class ContinuousFlight:
    """A robot in the target of a `Schedule`, one control period after another.

    Two flights of the same seed have the same references in the same order, the same exploration at the same times, and
    the same draws of their sensors' errors in the same order, whoever flies them. When a reference begins is up to the
    flight: a robot that arrives sooner, or is lost, is sooner on the next.

    Args:
        task: of the policy; its references are drawn from the test split.
        schedule: what the robot is flown in, when.
        periods: how long the flight will be.
        exploration: standard deviation of Gaussian noise on the actions, which stay in [-1, 1].
    """

    def __init__(self, task, schedule, periods, exploration=0.0, seed=0):
        longest = round(LONGEST / task.system.dt)
        self.task, self.schedule = replace(task, steps=min(periods, longest)), schedule
        self.exploration, self.seed, self.periods = exploration, seed, periods
        # The seed of the exploration is below 0, where none of a user's is: its draws aren't those of the sensors.
        self.noise, self.sensors = (torch.Generator().manual_seed(number) for number in (-1 - seed, seed))
        names = task.system.State._fields
        self.places = [i for i, name in enumerate(names) if name in GROUPS["position"]]
        self.period, self.leg, self.losses, self.legs, self._rows = 0, -1, 0, [], []
        self._next_leg(None)

    @property
    def time(self):
        """Simulated seconds since the start."""
        return self.period * self.task.system.dt

    @property
    def over(self):
        """Whether the flight has its length."""
        return self.period >= self.periods

    def _next_leg(self, state):
        """Begin the next reference, from a state (1, n) or on the reference."""
        self.leg, self.memory = self.leg + 1, {}
        self.episode = self.task.episodes(1, "test", self.seed + APART * self.leg)
        self.step = torch.zeros(1, dtype=torch.long)
        if state is None:
            self.state = self.task.start(self.episode, self.step)
        else:  # nothing depends on where on earth the robot is, so its place becomes the origin
            self.state = state.clone()
            self.state[:, self.places] = 0.0
        self.measured = self._measured()
        self._begun, self._states = len(self._rows), [self.state]

    def _measured(self):
        noise = self.schedule.at(self.time).noise
        return sensed(self.task.system, self.state, noise, self.sensors) if noise else self.state

    @torch.no_grad()
    def advance(self, actor):
        """One control period: what was measured, as (state, action, next state, leg); None where the robot was lost.

        Args:
            actor: TensorDict policy that reads `observation` and `window` and writes `action`.
        """
        answer = actor(self._seen())
        self.memory = dict(answer.get("next", {}))  # what a recurrent policy remembers
        noise = self.exploration * torch.randn(answer["action"].shape, generator=self.noise)
        action = (answer["action"] + noise).clamp(-1, 1)
        self._rows.append({"time": self.time, "leg": self.leg, **self._named(self.state[0], action[0])})
        before, leg = self.measured, self.leg
        self.state = self.schedule.at(self.time)(self.state, action)
        self.step, self.period = self.step + 1, self.period + 1
        self._states.append(self.state)
        self.measured = self._measured()
        row = (before[0], action[0], self.measured[0], leg)
        return row if self._go_on() else None

    def _seen(self):
        task = self.task
        reference = task.reference(self.episode, self.step, self.measured)
        seen = {"observation": task.observe(self.measured), "window": task.window(self.measured, reference)}
        place = {"state": self.measured, "reference": reference, "step": self.step.unsqueeze(-1)}
        return TensorDict({**seen, **place, **self.memory}, batch_size=(1,))

    def _named(self, state, action):
        system = self.task.system
        names = (*system.State._fields, *(f"action_{name}" for name in system.Action._fields))
        return dict(zip(names, (*state.tolist(), *action.tolist()), strict=True))

    def _go_on(self):
        """Begin the next leg where this one is over; whether the robot is still flying."""
        place = self.episode, self.step, self.state
        lost = bool(self.task.diverged(*place)) or not bool(self.state.isfinite().all())
        arrived = not lost and bool(self.task.arrived(*place))
        if lost or arrived or int(self.step) >= self.task.steps:
            self.losses += lost
            self._finish_leg(lost)
            if not self.over:
                self._next_leg(self.state if arrived else None)
        return not lost

    def _finish_leg(self, lost=False):
        """Fill in the errors of a leg, which tasks tell of whole flights only."""
        states = torch.stack(self._states, 1)
        task = replace(self.task, steps=states.shape[1] - 1)
        for row, error in zip(self._rows[self._begun :], task.trace(self.episode, states)[0].tolist(), strict=False):
            row["error"] = error
        score, succeeded = task.score(self.episode, states)
        begins = self._rows[self._begun]["time"]
        self.legs.append({"begins": begins, "error": float(score), "success": bool(succeeded), "lost": lost})
        self._states = self._states[-1:]

    def table(self):
        """What was flown, a row for each control period: time [s], leg, state and action then, error then."""
        if len(self._states) > 1:
            self._finish_leg()
        return pd.DataFrame(self._rows)
