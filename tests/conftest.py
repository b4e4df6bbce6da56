"""What every test starts from: one thread, fixed seeds, no window, no log lines of TorchRL."""

import os
import random
import signal

# Read while torch, TorchRL and matplotlib are imported; the commands that tests start inherit them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RL_LOGGING_LEVEL", "ERROR")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np
import pytest
import torch

# A shell makes what it starts in the background ignore Ctrl-C, and children inherit that; some tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# More threads make small batches slower and erratic on a busy machine, and sums depend on how many there are.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def every_test_starts_from_the_same_global_state():
    """Seed what libraries draw from (initial weights among it), and undo a changed default dtype.

    A test that needs random numbers of its own makes a `torch.Generator`; with these seeds its result depends neither
    on the tests that ran before nor on the worker that runs it.
    """
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    dtype = torch.get_default_dtype()
    yield
    torch.set_default_dtype(dtype)
