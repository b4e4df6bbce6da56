"""Model predictive control: plan over the horizon at every step, apply the first action.

The model is `dynamics.casadi()` of any dynamics, the cost that of the task: the same that APG trains on.
"""

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase

from envs.env import measured
from envs.errors import InputError
from policies.mpc_solvers import LARGEST, Buffered, make_solver


def actor(dynamics, task, solver="fatrop", compile=False, seed=0):
    """The planner of the table of methods; nothing in it is random, so that the seed changes nothing."""
    return MPC(dynamics, task, solver, compile)


class MPC(TensorDictModuleBase):
    """A TensorDict policy that solves one optimal control problem for each row of the batch.

    It reads `state` (*B, n), or in its place `measured`, and `reference` (*B, H, r), and `step`, `episode` and `done`
    (*B, 1) where they are there; it writes `action` (*B, m). A solve starts from the row's last plan, shifted by one,
    if the row's step is the one after and its episode the same; without `step`, always, until `reset()` or another
    batch size.

    A solve that fails, as one from a state that isn't finite, counts in `failures`: the row goes on with the shifted
    plan, or with the trim action if there is none, and its next solve starts afresh. `calls` counts the solves. A row
    that is done takes the trim action without one.

    Args:
        dynamics: the model, anything with `casadi()`.
        task: a `Task` with the quadratic cost; its horizon is that of the plan.
        solver: "fatrop", "rti" (one Gauss-Newton iteration a call, fastest) or "ipopt".
        compile: generate C and compile it, once; where that fails, a warning, and `compiled` is False.

    Raises:
        InputError: unknown solver, one that casadi was built without, a task with a cost of its own, or dynamics
            without `casadi()`.
    """

    def __init__(self, dynamics, task, solver="fatrop", compile=False):
        super().__init__()
        self.in_keys, self.out_keys = ["state", "reference"], ["action"]
        self.horizon = task.horizon
        self.calls = self.failures = 0
        self._solver = make_solver(dynamics, task, solver, compile)
        self._model = Buffered(dynamics.casadi(), ("next_state",))
        self._trim = np.array(task.system.trim_action, dtype=np.float64)
        self.reset()

    @property
    def compiled(self):
        """Whether generated C runs."""
        return self._solver.compiled

    def reset(self):
        """Forget all plans: the next solves start cold."""
        self._memory = []

    def forward(self, tensordict):
        state, reference = measured(tensordict), tensordict["reference"]
        if reference.shape[-2] != self.horizon:
            raise InputError(f"MPC: reference of {reference.shape[-2]} points, expected the horizon {self.horizon}")
        states = _rows(state, 1)
        if len(self._memory) != len(states):
            self._memory = [_Row() for _ in states]
        rows = zip(self._memory, states, _rows(reference, 2), _times(tensordict), _done(tensordict), strict=True)
        actions = np.empty((len(states), len(self._trim)))
        for i, (memory, x, ahead, time, done) in enumerate(rows):
            actions[i] = self._trim if done else self._act(memory, x, ahead, time)
        tensordict["action"] = torch.from_numpy(actions).to(state).reshape(*state.shape[:-1], len(self._trim))
        return tensordict

    def plan(self, row=0):
        """The last plan of a row of the batch: actions (H, m) and the states (H, n) that they lead to."""
        plan = self._memory[row].plan.reshape(self.horizon, -1)
        return plan[:, : len(self._trim)], plan[:, len(self._trim) :]

    def _act(self, memory, state, reference, time):
        """The action (m,) of one row."""
        self.calls += 1
        memory.advance(time)
        shifted = None if memory.plan is None else self._shifted(memory.plan)
        plan = self._solved(state, reference, shifted if memory.trusted else None)
        memory.trusted = plan is not None
        if plan is None:
            self.failures += 1
            plan = shifted if shifted is not None else self._waiting(state)
        memory.plan = plan
        return plan[: len(self._trim)].clip(-1, 1)

    def _solved(self, state, reference, shifted):
        """The solver's plan, or None."""
        parameters = np.concatenate((state, reference))
        if not _ordinary(parameters):
            return None
        return self._solver.solve(
            self._drifting(state) if shifted is None else shifted, parameters, shifted is not None
        )

    def _shifted(self, plan):
        """The plan one step later: its last action goes on."""
        last = plan.reshape(self.horizon, -1)[-1]
        action, state = last[: len(self._trim)], last[len(self._trim) :]
        return np.concatenate((plan[len(last) :], action, self._following(state, action)))

    def _drifting(self, state):
        """What the trim action leads to, as a plan."""
        rows = []
        for _ in range(self.horizon):
            state = self._following(state, self._trim)
            rows += [self._trim, state]
        return np.concatenate(rows)

    def _waiting(self, state):
        """The trim action at a state that stays, as a plan; at zero where the state isn't ordinary."""
        place = state if _ordinary(state) else np.zeros_like(state)
        return np.tile(np.concatenate((self._trim, place)), self.horizon)

    def _following(self, state, action):
        """The next state; the same where the model flies apart, because a guess should be of ordinary size."""
        self._model.inputs["state"][:] = state
        self._model.inputs["action"][:] = action
        self._model.run()
        following = self._model.outputs["next_state"]
        return following.copy() if _ordinary(following) else state


class _Row:
    """What is remembered of one row of the batch."""

    def __init__(self):
        self.plan = None  # (H (m + n),)
        self.trusted = False  # whether the plan is a solution, from which the next solve may start
        self.time = None  # step and perhaps episode of the plan

    def advance(self, time):
        """Go on to the next time; a plan that doesn't lead there is forgotten."""
        expected = None if self.time is None else [self.time[0] + 1, *self.time[1:]]
        if time != expected:
            self.plan, self.trusted = None, False
        self.time = time


def _ordinary(array):
    """Whether all numbers are finite and no larger than a robot's."""
    return np.abs(array).max() < LARGEST


def _rows(tensor, dimensions):
    """A tensor (*B, ...) with some dimensions behind the batch as an array (N, -1) of doubles."""
    batch = tensor.shape[: tensor.ndim - dimensions].numel()
    return tensor.detach().to("cpu", torch.float64).reshape(batch, tensor.shape[-dimensions:].numel()).numpy()


def _times(tensordict):
    """Step and, if there is one, episode of every row; None for each where there is no step."""
    count, given = tensordict["state"].shape[:-1].numel(), set(tensordict.keys())
    if "step" not in given:
        return [None] * count
    columns = [tensordict[key].reshape(count).tolist() for key in ("step", "episode") if key in given]
    return [list(row) for row in zip(*columns, strict=True)]


def _done(tensordict):
    """Which rows have ended."""
    done = tensordict.get("done", None)
    return [False] * tensordict["state"].shape[:-1].numel() if done is None else done.reshape(-1).tolist()
