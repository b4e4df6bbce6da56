"""Pictures as observations: a TorchRL transform that adds what a camera sees."""

import numpy as np
import torch
from torchrl.data import Bounded, Composite
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

from envs.drawing import draw
from envs.env import TrackingEnv

# What an environment goes on from. Older pictures can't be drawn from the state, and a TransformedEnv hands on only
# what its `state_spec` names.
PLACE = ("state", "episode", "step", "pixels")


class Pixels(Transform):
    """Adds `pixels` (*B, 3 * frames, height, width), uint8: the last pictures of a camera, the newest first.

    Like the environment it keeps nothing: the older pictures are those of the TensorDict that a step begins with. A
    flight begins with its first picture in every place of the stack.

    Args:
        camera: `Camera`.
        seed: of the camera's noise.
    """

    def __init__(self, camera, seed=0):
        super().__init__(in_keys=["state"], out_keys=["pixels"])
        self.camera = camera
        self.set_noise(seed)

    def set_noise(self, seed):
        """Seed the camera's noise."""
        self._noise = np.random.default_rng(seed)

    def transform_observation_spec(self, observation_spec):
        shape = (*observation_spec.shape, *self.camera.shape)
        observation_spec["pixels"] = Bounded(0, 255, shape=shape, dtype=torch.uint8, device=observation_spec.device)
        return observation_spec

    def _reset(self, tensordict, tensordict_reset):
        picture = self.picture(tensordict_reset["state"])
        stack = torch.cat(self.camera.frames * [picture], -3)
        if tensordict is not None and {"pixels", "state"} <= set(tensordict.keys()):  # some flights go on
            onward = (tensordict["state"] == tensordict_reset["state"]).all(-1)
            stack = torch.where(onward[..., None, None, None], tensordict["pixels"], stack)
        return tensordict_reset.set("pixels", stack)

    def _step(self, tensordict, next_tensordict):
        picture = self.picture(next_tensordict["state"])
        return next_tensordict.set("pixels", torch.cat((picture, tensordict["pixels"][..., :-3, :, :]), -3))

    def picture(self, state):
        """The picture (*B, 3, height, width) of states (*B, 4)."""
        drawn = draw(self.camera, self.parent.dynamics.system, state.reshape(-1, state.shape[-1]), self._noise)
        return drawn.reshape(*state.shape[:-1], *drawn.shape[1:]).to(state.device)


def tracking_env(dynamics, task, episodes, batch_size=(), device="cpu", seed=0, **options):
    """The environment of a task (see `TrackingEnv`), with `pixels` where the task has a camera."""
    env = TrackingEnv(dynamics, task, episodes, batch_size, device, seed, **options)
    if task.camera is None:
        return env
    filmed = TransformedEnv(env, Pixels(task.camera, seed))
    keys = (*PLACE, "measured") if env.noise else PLACE
    spec = {key: filmed.observation_spec[key].clone() for key in keys}
    env.state_spec = Composite(spec, shape=env.batch_size, device=env.device)
    filmed.empty_cache()
    return filmed


def reseed(env, seed):
    """Seed what an environment of `tracking_env` draws, the noise of its camera included."""
    env.set_seed(seed)
    if isinstance(env, TransformedEnv):
        env.transform.set_noise(seed)
