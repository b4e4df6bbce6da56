"""TrackingEnv: the TorchRL view of any dynamics and any task."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.dynamics import sensed


class TrackingEnv(EnvBase):
    """Stateless, batched environment; everything that changes travels in the TensorDict.

    | key           | shape     | meaning                                                  |
    |---------------|-----------|----------------------------------------------------------|
    | `state`       | (*B, n)   | physical state                                           |
    | `episode`     | (*B, 1)   | which of `episodes` is flown                             |
    | `step`        | (*B, 1)   | control periods since the start                          |
    | `observation` | (*B, o)   | what a policy sees of the state                          |
    | `window`      | (*B, H, w)| what a policy sees of the reference                      |
    | `reference`   | (*B, H, r)| where the next H states should be; planners read it      |
    | `action`      | (*B, m)   | in [-1, 1]                                               |
    | `reward`      | (*B, 1)   | minus the task's cost of the step, see `Task.rewarded`   |
    | `terminated`  | (*B, 1)   | diverged, or arrived                                     |
    | `diverged`    | (*B, 1)   | failed                                                   |
    | `measured`    | (*B, n)   | what sensors say of the state; only where they err       |

    `truncated` is set at the last step of the task, and where a robot strays beyond `threshold`. Dynamics, domain and
    episodes belong to the environment, so a partial reset can't lose them. Gradients flow through `rollout`.

    Where sensors err, `observation`, `window` and `reference` are made of `measured`: a reference may begin where the
    robot is, and would tell a planner. Noise is drawn once for each state, from the seed of the environment, so that
    what was seen is a record without gaps. Rewards and ends are those of the true state, by which the flight goes on.

    Args:
        dynamics: anything that maps (..., n), (..., m) to (..., n) and has `.system`. Where it has `begin`, every start
            is passed to it, and a flight begins at the state that it returns. Its `noise`, if it has
            any, says how far sensors err, see `envs.dynamics.sensed`.
        episodes: (N, ...) rows as `task.episodes` draws them. May be exchanged for as many others while it runs.
        anywhere: begin drawn episodes at random steps of their references instead of the first.
        threshold: distance from the reference (`task.distance`) beyond which an episode is cut off; None: no limit.
            May be changed while it runs.
    """

    batch_locked = False

    def __init__(
        self, dynamics, task, episodes, batch_size=(), device="cpu", seed=0, *, anywhere=False, threshold=None
    ):
        super().__init__(device=torch.device(device), batch_size=torch.Size(batch_size))
        self.dynamics, self.task = dynamics, task
        self.anywhere, self.threshold = anywhere, threshold
        self.noise = getattr(dynamics, "noise", ())
        self.episodes = episodes.to(self.device)
        self._supports_set_state = True
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self):
        batch = self.batch_size
        start = torch.zeros(1, dtype=torch.long, device=self.device)
        state = self.task.start(self.episodes[:1], start)
        reference = self.task.reference(self.episodes[:1], start, state)
        window = self.task.window(state, reference)
        observation = self.task.observe(state)
        table = {"device": self.device}
        count = {"dtype": torch.int64, **table}

        def real(example):
            return Unbounded(shape=(*batch, *example.shape[1:]), dtype=example.dtype, **table)

        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, **table)
        self.observation_spec = Composite(
            state=real(state),
            episode=Bounded(0, len(self.episodes) - 1, shape=(*batch, 1), **count),
            step=Bounded(0, self.task.steps, shape=(*batch, 1), **count),
            observation=real(observation),
            window=real(window),
            reference=real(reference),
            diverged=flag,
            shape=batch,
            **table,
        )
        if self.noise:
            self.observation_spec["measured"] = real(state)
        actions = len(self.dynamics.system.Action._fields)
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, actions), dtype=state.dtype, **table)
        self.reward_spec = Unbounded(shape=(*batch, 1), dtype=state.dtype, **table)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch, **table)

    def _reset(self, tensordict=None, *, set_state=False, **kwargs):
        """Starts the episodes that the TensorDict names if it has no state, else some at random.

        With `set_state` it goes on from the state, episode and step of the TensorDict, and from what was measured if
        that is there, too.
        """
        batch = self.batch_size if tensordict is None else tensordict.batch_size
        given = set() if tensordict is None else set(tensordict.keys())
        if set_state and "state" in given:
            place = (tensordict[key] for key in ("state", "episode", "step"))
            return self._described(*place, tensordict.get("measured", None))
        if "episode" in given and not given & {"_reset", "state"}:
            episode = tensordict["episode"]
        else:
            episode = torch.randint(len(self.episodes), (*batch, 1), generator=self.generator).to(self.device)
        step = torch.zeros_like(episode)
        state = self._started(episode, step)
        if self.anywhere:
            step, state = self._moved_on(episode, step, state)
        if hasattr(self.dynamics, "begin"):
            state = self.dynamics.begin(state)
        return self._described(state, episode, step)

    def _started(self, episode, step):
        """The states (*B, n) on the references at the steps (*B, 1)."""
        state = self.task.start(self.episodes[episode.reshape(-1)], step.reshape(-1))
        return state.reshape(*episode.shape[:-1], -1)

    def _moved_on(self, episode, step, state):
        """Random steps and the states there; an episode that would have arrived by then keeps its first."""
        drawn = torch.randint(self.task.steps, episode.shape, generator=self.generator).to(self.device)
        there = self._started(episode, drawn)
        rows, flat = self.episodes[episode.reshape(-1)], there.reshape(-1, there.shape[-1])
        over = self.task.arrived(rows, drawn.reshape(-1), flat).reshape(episode.shape)
        return torch.where(over, step, drawn), torch.where(over, state, there)

    def _step(self, tensordict):
        batch = tensordict.batch_size
        action, episode, step = tensordict["action"], tensordict["episode"], tensordict["step"]
        rows, before = self.episodes[episode.reshape(-1)], tensordict["state"]
        state = self.dynamics(before, action)
        flat = state.reshape(-1, state.shape[-1])
        goal = self.task.reference(rows, step.reshape(-1), before.reshape(flat.shape))[:, self.task.rewarded]
        cost = self.task.cost(flat, action.reshape(-1, action.shape[-1]), goal)
        following = self._described(state, episode, step + 1)
        arrived = self.task.arrived(rows, step.reshape(-1) + 1, flat).reshape(*batch, 1)
        following["terminated"] = following["diverged"] | arrived
        following["truncated"] = following["step"] >= self.task.steps
        if self.threshold is not None:
            near = self.task.distance(rows, step.reshape(-1) + 1, flat) <= self.threshold
            near = near & torch.isfinite(flat).all(-1)
            following["truncated"] = following["truncated"] | ~near.reshape(*batch, 1)
        following["done"] = following["terminated"] | following["truncated"]
        following["reward"] = -cost.reshape(*batch, 1)
        return following

    def _described(self, state, episode, step, measured=None):
        """A TensorDict of the state and all that follows from it; `measured` is drawn unless it is given."""
        batch = state.shape[:-1]
        rows, flat_step, flat = self.episodes[episode.reshape(-1)], step.reshape(-1), state.reshape(-1, state.shape[-1])
        if self.noise and measured is None:
            measured = sensed(self.dynamics.system, state, self.noise, self.generator)
        seen = measured.reshape(flat.shape) if self.noise else flat
        reference = self.task.reference(rows, flat_step, seen)
        window = self.task.window(seen, reference)
        described = {
            "state": state,
            "episode": episode,
            "step": step,
            "observation": self.task.observe(seen).reshape(*batch, -1),
            "window": window.reshape(*batch, *window.shape[1:]),
            "reference": reference.reshape(*batch, *reference.shape[1:]),
            "diverged": self.task.diverged(rows, flat_step, flat).reshape(*batch, 1),
        }
        if self.noise:
            described["measured"] = measured
        return TensorDict(described, batch_size=batch, device=self.device)

    def seed_noise(self, generator):
        """Let what is measured from now on follow from the present state of a generator, which stays as it is.

        So the same flights are flown with noise as without.
        """
        if self.noise:
            self.set_seed(int(torch.randint(2**31, (), generator=generator.clone_state())))

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(0 if seed is None else seed)


def measured(tensordict):
    """What sensors say of the state in a TensorDict of `TrackingEnv`: the state itself where they don't err."""
    return tensordict.get("measured", tensordict["state"])
