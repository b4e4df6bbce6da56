"""Dynamics as compiled C: the equations and their derivative, from the CasADi side of the same robot.

In training with analytic policy gradients nearly all time goes into the thousand small tensor operations of a step and
of the way back through it. CasADi knows the step as one expression, differentiates it in reverse, and writes C that a
compiler turns into a few microseconds a batch. Values and gradients are the same, in double precision inside.
"""

import ctypes

import torch
from torch.autograd.function import once_differentiable

from policies.generated_code import CompilerError, shared_library

FORWARD, BACKWARD = "forward", "backward"
LOOP = """
void {name}_batch(long long int count, {parameters}) {{
  long long int iw[{iw}]; double w[{w}]; const double *arg[{arg}]; double *res[{res}];
  for (long long int i = 0; i < count; ++i) {{
    {places}
    {name}(arg, res, iw, w, 0);
  }}
}}
"""


def fastest(dynamics):
    """The dynamics compiled, or as they are where that isn't possible, and why: (dynamics, reason)."""
    if getattr(dynamics, "detach", False) or not hasattr(dynamics, "casadi"):
        return dynamics, "their gradient can't be had from CasADi"
    try:
        return CompiledDynamics(dynamics), ""
    except CompilerError as error:
        return dynamics, str(error)


class CompiledDynamics:
    """`dynamics(state, action) -> next_state` on the CPU, differentiable once in both.

    Args:
        dynamics: have `system`, `dt` and `casadi()`; later changes of them don't count.

    Raises:
        CompilerError: no compiler, one that fails, or a library that can't be loaded.
    """

    def __init__(self, dynamics):
        self.dynamics, self.system, self.dt = dynamics, dynamics.system, dynamics.dt
        self._forward, self._backward = compile_batches(_functions(dynamics.casadi()))

    @property
    def noise(self):
        """How far sensors err, as in the dynamics that were compiled."""
        return getattr(self.dynamics, "noise", ())

    def __call__(self, state, action):
        """Next state (..., n) of state (..., n) and action (..., m) in [-1, 1]."""
        batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
        return _Step.apply(state.expand(*batch, -1), action.expand(*batch, -1), self)

    def step(self, state, action):
        """The next states of contiguous doubles (..., n), (..., m), without a gradient."""
        following = torch.empty_like(state)
        self._forward(state.shape[:-1].numel(), state.data_ptr(), action.data_ptr(), following.data_ptr())
        return following

    def back(self, state, action, slope):
        """What a slope (..., n) by the next states is by the states and the actions."""
        by_state, by_action = torch.empty_like(state), torch.empty_like(action)
        pointers = (part.data_ptr() for part in (state, action, slope, by_state, by_action))
        self._backward(state.shape[:-1].numel(), *pointers)
        return by_state, by_action


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx, state, action, compiled):
        ctx.compiled, ctx.kind = compiled, state.dtype
        state, action = doubles(state), doubles(action)
        ctx.save_for_backward(state, action)
        return compiled.step(state, action).to(ctx.kind)

    @staticmethod
    @once_differentiable
    def backward(ctx, slope):
        parts = ctx.compiled.back(*ctx.saved_tensors, doubles(slope))
        return *(part.to(ctx.kind) for part in parts), None


def doubles(tensor):
    """The numbers of a tensor as compiled functions read them."""
    return tensor.detach().to("cpu", torch.float64).contiguous()


def compile_batches(functions, shared=0):
    """CasADi functions for whole batches: each is called with the number of rows, then the addresses of its arrays.

    The arrays are contiguous doubles, one for each input and output, with a row for each call.

    Args:
        shared: how many inputs, the last ones, are a single row that all calls share.

    Raises:
        CompilerError: no compiler, one that fails, or a library that can't be loaded.
    """
    import casadi

    generator = casadi.CodeGenerator("step")
    for function in functions:
        generator.add(function)
    path = shared_library(generator.dump() + "".join(_loop(function, shared) for function in functions))
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:  # a folder that programs may not be run from, or a damaged file
        raise CompilerError(f"{path}: can't be loaded ({error})") from None
    loaded = [getattr(library, f"{function.name()}_batch") for function in functions]
    for function, batch in zip(functions, loaded, strict=True):
        pointers = [ctypes.c_void_p] * (function.n_in() + function.n_out())
        batch.argtypes, batch.restype = [ctypes.c_longlong, *pointers], None
    return loaded


def _functions(step):
    """A CasADi step (state, action) -> next_state and its derivative in reverse."""
    import casadi

    kind = casadi.SX if step.is_a("SXFunction") else casadi.MX
    state, action, slope = (kind.sym(name, size) for name, size in zip("xul", _sizes(step), strict=True))
    following = step(state, action)
    back = casadi.vertsplit(
        casadi.jtimes(following, casadi.vertcat(state, action), slope, True),
        [0, state.numel(), state.numel() + action.numel()],
    )
    return (
        casadi.Function(FORWARD, [state, action], [following], {"cse": True}),
        casadi.Function(BACKWARD, [state, action, slope], back, {"cse": True}),
    )


def _sizes(step):
    return step.numel_in(0), step.numel_in(1), step.numel_out(0)


def _loop(function, shared):
    """C that calls a generated function for every row of its arrays."""
    inputs = [function.numel_in(i) for i in range(function.n_in())]
    outputs = [function.numel_out(i) for i in range(function.n_out())]
    named = [f"const double *a{i}" for i in range(len(inputs))] + [f"double *r{i}" for i in range(len(outputs))]
    rows = [*inputs[: len(inputs) - shared], *[0] * shared]
    places = [f"arg[{i}] = a{i} + i * {size};" for i, size in enumerate(rows)]
    places += [f"res[{i}] = r{i} + i * {size};" for i, size in enumerate(outputs)]
    return LOOP.format(
        name=function.name(),
        parameters=", ".join(named),
        places=" ".join(places),
        iw=function.sz_iw() + 1,
        w=function.sz_w() + 1,
        arg=function.sz_arg() + 1,
        res=function.sz_res() + 1,
    )
