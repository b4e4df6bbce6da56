"""A policy that remembers, for TorchRL: its memory travels in the TensorDict like everything else that changes."""

import torch
from tensordict.nn import TensorDictModuleBase


class RecurrentActor(TensorDictModuleBase):
    """The first action of a network with a memory.

    | key                  | shape           | meaning                                                                 |
    |----------------------|-----------------|-------------------------------------------------------------------------|
    | `observation`        | (*B, o)         | read                                                                    |
    | `window`             | (*B, H, w)      | read                                                                    |
    | `step`               | (*B, 1)         | read: where it is 0 a flight begins, and nothing is remembered          |
    | `is_init`            | (*B, 1)         | read where TorchRL's `InitTracker` writes it: a flight begins here, too |
    | `hidden`             | (*B, 2, memory) | read: what was remembered, zeros if missing; written: what is now       |
    | `action`             | (*B, m)         | written                                                                 |
    | `("next", "hidden")` | (*B, 2, memory) | written: the same as `hidden`                                           |

    What is remembered is written in both places because TorchRL's loops differ: `step_mdp` takes it from `next`, but
    the rollouts and collectors of an environment take from there only what the environment itself knows, and the rest
    as it stands. Either way it arrives at the next step without a transform.

    A flight that begins at a later step of its reference (`TrackingEnv(anywhere=True)`) is only known by `is_init`.
    """

    in_keys = ("observation", "window", "step")
    out_keys = ("action", "hidden", ("next", "hidden"))

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, tensordict):
        seen = tensordict["observation"], tensordict["window"]
        hidden = self._kept(tensordict, seen[0])
        plan, remembered = self.network.recall(*seen, hidden)
        tensordict.set("action", plan[..., 0, :])
        tensordict.set("hidden", remembered)
        return tensordict.set(("next", "hidden"), remembered)

    def _kept(self, tensordict, like):
        """What is remembered of a flight: nothing where it begins."""
        shape = (*tensordict.batch_size, 2, self.network.config.memory)
        empty = like.new_zeros(shape)
        hidden = tensordict.get("hidden", None)
        if hidden is None:
            return empty
        begins = tensordict["step"] == 0
        started = tensordict.get("is_init", None)
        if started is not None:
            begins = begins | started
        return torch.where(begins.unsqueeze(-1), empty, hidden)
