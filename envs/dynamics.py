"""One control period of a robot, x[t+1] = F(x[t], u[t]), in torch and in CasADi from one set of equations.

The action and the residual push are held constant over the period.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from envs.errors import InputError
from envs.system import System


class Backend(NamedTuple):
    """How to take a state vector apart into scalars and how to put it together."""

    unpack: Callable
    pack: Callable


TORCH = Backend(lambda vector: vector.unbind(-1), lambda scalars: torch.stack(scalars, -1))


def casadi_backend():
    """The same for CasADi column vectors."""
    import casadi

    return Backend(casadi.vertsplit, lambda scalars: casadi.vertcat(*scalars))


def euler(rates, x, h):
    """Explicit Euler, first order."""
    return x + h * rates(x)


def rk4(rates, x, h):
    """The classical Runge-Kutta method, fourth order."""
    k1 = rates(x)
    k2 = rates(x + h / 2 * k1)
    k3 = rates(x + h / 2 * k2)
    k4 = rates(x + h * k3)
    return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)


INTEGRATORS = {"euler": euler, "rk4": rk4}


@dataclass(frozen=True)
class Dynamics:
    """A robot over one control period: `dynamics(state, action) -> next_state`.

    `disturbances` are functions (system, x, u) -> {state name: extra rate}. A `Dynamics` without any is the source.
    `noise` says how far sensors err, see `sensed`: a step is exact, and whoever flies the robot measures its states.
    """

    system: System
    disturbances: tuple[Callable, ...] = ()
    integrator: str = "rk4"
    substeps: int = 1  # [-] integrator steps in a control period
    noise: tuple[float, ...] = ()  # standard deviations of a measured state, an entry for each of `system.quantities`

    def __post_init__(self):
        if self.integrator not in INTEGRATORS:
            raise InputError(f"integrator {self.integrator!r}: expected one of {', '.join(INTEGRATORS)}")
        if self.substeps < 1:
            raise InputError(f"substeps is {self.substeps}, expected at least 1")
        if self.noise and len(self.noise) != len(self.system.quantities):
            expected = f"expected {len(self.system.quantities)}, one for each of its `quantities`"
            raise InputError(f"{self.system.name}: noise has {len(self.noise)} entries, {expected}")

    @property
    def dt(self):
        """Control period [s]."""
        return self.system.dt

    def __call__(self, state, action):
        """Next state (..., n) of state (..., n) and action (..., m) in [-1, 1]."""
        return self.advance(state, action)

    def advance(self, state, action, push: Mapping[str, Any] | None = None, backend: Backend = TORCH):
        """The same with `push`, extra rates by state name that stay constant over the period."""
        if backend is TORCH and state.shape[:-1] != action.shape[:-1]:
            batch = torch.broadcast_shapes(state.shape[:-1], action.shape[:-1])
            state, action = state.expand(*batch, -1), action.expand(*batch, -1)
        u = self.system.Action(*backend.unpack(action))

        def rates(vector):
            x = self.system.State(*backend.unpack(vector))
            change = self.system.derivative(x, u)
            extra = [disturbance(self.system, x, u) for disturbance in self.disturbances]
            for rates_by_name in (*extra, push or {}):
                change = change._replace(**{k: getattr(change, k) + v for k, v in rates_by_name.items()})
            return backend.pack(change)

        for _ in range(self.substeps):
            state = INTEGRATORS[self.integrator](rates, state, self.dt / self.substeps)
        return self._projected(state, backend)

    def _projected(self, state, backend):
        x = self.system.State(*backend.unpack(state))
        on_manifold = self.system.project(x)
        return state if on_manifold is x else backend.pack(on_manifold)

    def casadi(self):
        """The same step as a `casadi.Function` (state, action) -> next_state."""
        import casadi

        state = casadi.SX.sym("state", len(self.system.State._fields))
        action = casadi.SX.sym("action", len(self.system.Action._fields))
        following = self.advance(state, action, backend=casadi_backend())
        return casadi.Function("dynamics", [state, action], [following], ["state", "action"], ["next_state"])


class Sensed:
    """Dynamics as they are, flown by what sensors say that err.

    Args:
        noise: standard deviations, see `sensed`.
    """

    def __init__(self, dynamics, noise):
        self.dynamics, self.noise = dynamics, noise

    def __call__(self, state, action):
        return self.dynamics(state, action)

    def __getattr__(self, name):
        if name == "dynamics":  # a copy asks for it before it has any
            raise AttributeError(name)
        return getattr(self.dynamics, name)


def sensed(system, state, deviations, generator):
    """What sensors say of states (..., n): moved by white noise in their tangent space, so a quaternion stays one.

    Args:
        deviations: standard deviations (d,) in the order of `System.difference`.
        generator: draws the noise, on the CPU.
    """
    drawn = torch.randn(*state.shape[:-1], len(deviations), generator=generator).to(state)
    error = drawn * drawn.new_tensor(deviations)
    return TORCH.pack(tuple(system.displaced(system.State(*TORCH.unpack(state)), TORCH.unpack(error))))
