"""Plants: what can be flown but not differentiated, such as a third-party simulator or hardware behind a bridge.

A plant is any object with the two methods of `Plant`. `Flights` makes it the dynamics of a `TrackingEnv`, so that it is
flown by the same code as a target of ours, and survives what simulators and hardware do: a number that isn't finite, an
exception in mid-flight, an array of another shape.
"""

import math
from importlib import import_module
from numbers import Real
from typing import Protocol

import numpy as np
import torch

from adapt.plant_table import SIMULATORS
from adapt.transitions import DT_TOLERANCE, LARGEST, QUATERNION, QUATERNION_TOLERANCE
from envs.errors import InputError
from policies import METHODS

PATIENCE = 3  # flights in a row that may end before their first step; then a plant is given up
FAULTS = 5  # that a report tells in words


class Plant(Protocol):
    """What a target must be able to do; vectors are numpy arrays in the order and units of the source system.

    A plant may also have `dt`, its control period [s], which must then be the system's, and `settable`. Where that is
    true, `step` is given the state to start from, as equations without a memory need it; else None, and the plant goes
    on from where it is, with all that a state doesn't tell, such as the speed of its motors.
    """

    def reset(self, state):
        """Begin a flight at `state` (n,), or as near to it as the plant can; returns the state (n,) it begins at."""

    def step(self, state, action):
        """Hold `action` (m,), in [-1, 1], for one control period; returns the next state (n,)."""


class Flights:
    """A plant as the dynamics of an environment: one flight at a time, and a flight that breaks ends.

    A broken flight is NaN from there on, which every task takes for a failure and `adapt.flying.collect` leaves out.

    Args:
        plant: see `Plant`.
        system: the source, whose names, order and control period the plant shares.
        name: in messages and reports.

    Raises:
        InputError: when the plant has another control period, lacks a method, or gives another shape from the start.
    """

    one_at_a_time = True

    def __init__(self, plant, system, name="plant"):
        self.plant, self.system, self.name = plant, system, name
        self.count, self.steps, self.faults = 0, 0, []
        self.empty, self._flying, self._step = 0, False, 0
        if missing := [method for method in ("reset", "step") if not callable(getattr(plant, method, None))]:
            raise InputError(f"{name}: {type(plant).__name__} has no method {missing[0]}; a plant has reset and step")
        period = getattr(plant, "dt", system.dt)
        if not isinstance(period, Real):
            raise InputError(f"{name}: control period is {period!r}, expected {system.dt:g}, a number of seconds")
        if not math.isclose(period, system.dt, rel_tol=DT_TOLERANCE):
            raise InputError(f"{name}: control period is {period:g} s, expected {system.dt:g} s as of {system.name}")

    @property
    def dt(self):
        """Control period [s]."""
        return self.system.dt

    @property
    def lost(self):
        """Whether the plant was given up: several flights in a row ended before their first step."""
        return self.empty >= PATIENCE

    def begin(self, state):
        """Begin a flight at a state (1, n); returns where it really begins, NaN if it doesn't."""
        self._flying, self._step = not self.lost, 0
        if self.lost:
            return torch.full_like(state, torch.nan)
        self.count, self.empty = self.count + 1, self.empty + 1
        return self._answer(state, self.plant.reset, _numbers(state))

    def __call__(self, state, action):
        """Next state (1, n) of a state (1, n) and an action (1, m)."""
        if not self._flying:
            return torch.full_like(state, torch.nan)
        self._step += 1
        if not torch.isfinite(action).all():
            return self._broken(state, "the policy's action is not finite")
        start = _numbers(state) if getattr(self.plant, "settable", False) else None
        following = self._answer(state, self.plant.step, start, _numbers(action))
        if self._flying:
            self.steps, self.empty = self.steps + 1, 0
        return following

    def report(self):
        """Flights, steps, broken flights, the first faults and the last, for `metrics.json`."""
        broken = {"flights": self.count, "steps": self.steps, "broken": len(self.faults), "given up": self.lost}
        return {"name": self.name, **broken, "faults": self.faults[:FAULTS] + self.faults[FAULTS:][-1:]}

    def _answer(self, state, method, *arguments):
        try:
            answer = method(*arguments)
        except Exception as error:  # whatever a simulator or a bridge raises ends this flight, not the work
            return self._broken(state, f"{type(error).__name__}: {error}")
        wrong = self._wrong(answer)
        if wrong:
            return self._broken(state, wrong)
        return self._same_sign(torch.as_tensor(np.array(answer, float)).to(state)[None], state)

    def _same_sign(self, state, before):
        """A state whose quaternion, if it has one, doesn't change its sign in mid-flight: q and -q are the same."""
        names = self.system.State._fields
        if set(QUATERNION) <= set(names):
            columns = [names.index(name) for name in QUATERNION]
            if (state[0, columns] @ before[0, columns]) < 0:
                state[0, columns] *= -1
        return state

    def _wrong(self, answer):
        """What is wrong with a state that the plant gave, or None."""
        try:
            values = np.asarray(answer, float)
        except (TypeError, ValueError):
            values = np.empty(0)
        names = self.system.State._fields
        if values.shape != (len(names),):
            found = f"{type(answer).__name__} of shape {np.shape(values)}" if values.size else type(answer).__name__
            method = "step" if self._step else "reset"
            wrong = f"{method} returned {found}, expected numbers of shape ({len(names)},): {', '.join(names)}"
            if not self.steps and self.count == 1:  # never right: a mistake to mend, not a flight that broke
                raise InputError(f"{self.name}: {wrong}")
            return wrong
        if not np.isfinite(values).all():
            return f"{names[int(np.argmin(np.isfinite(values)))]} is not finite"
        if np.abs(values).max() > LARGEST:
            return f"{names[int(np.abs(values).argmax())]} is {values[np.abs(values).argmax()]:.3g}"
        if set(QUATERNION) <= set(names):
            length = float(np.linalg.norm([values[names.index(name)] for name in QUATERNION]))
            if abs(length - 1) > QUATERNION_TOLERANCE:
                return f"quaternion {', '.join(QUATERNION)} has length {length:.4g}"
        return None

    def _broken(self, state, reason):
        self._flying = False
        self.faults.append(f"flight {self.count}, step {self._step}: {' '.join(reason.split())}")
        return torch.full_like(state, torch.nan)


def _numbers(row):
    """The numbers of a tensor (1, n) as an array (n,)."""
    (values,) = row.detach().cpu().double().numpy()
    return values


def flights_of(plant, policy, target=None, oracle=False):
    """The dynamics by which `adapt.adaptation.adapt` flies a policy in a plant; `Flights` are passed through.

    Raises:
        InputError: what makes no sense with a plant, and what `Flights` refuses.
    """
    if target is not None:
        raise InputError("adapt: give a target or a plant, not both")
    if oracle:
        raise InputError("--oracle: needs equations to differentiate, and a plant has none; leave it out")
    if METHODS[policy.method].pixels:
        raise InputError("adapt: a policy that sees pictures can't be flown in a plant, which gives states")
    return plant if isinstance(plant, Flights) else Flights(plant, policy.task.system)


def make_flights(name, system):
    """`Flights` of a plant by name, see `make_plant`."""
    return Flights(make_plant(name, system), system, name)


def make_plant(name, system):
    """A plant for a system by name: one of `SIMULATORS`, or "module:factory" of one's own, called with the system.

    Raises:
        InputError: an unknown name, a simulator that isn't installed or is of another robot, a factory that fails.
    """
    if name in SIMULATORS:
        simulator = SIMULATORS[name]
        if system.name != simulator.system:
            raise InputError(f"--plant {name}: is a {simulator.system}, the robot is a {system.name}")
        return _simulator(name, simulator, system)
    module, colon, factory = name.partition(":")
    if not (module and colon and factory):
        raise InputError(f"--plant {name}: expected one of {', '.join(SIMULATORS)}, or MODULE:FACTORY of your own")
    try:
        make = getattr(import_module(module), factory)
    except (ImportError, AttributeError) as error:
        where = "; the working folder and PYTHONPATH are searched"
        raise InputError(f"--plant {name}: can't be imported ({error}){where}") from None
    try:
        return make(system)
    except Exception as error:
        raise InputError(
            f"--plant {name}: {factory}(system), which makes the plant, failed ({type(error).__name__}: {error})"
        ) from error


def _simulator(name, simulator, system):
    try:
        module = import_module(f"adapt.simulators.{simulator.module}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != simulator.package:
            raise
        advice = "pip install 'apg-adapt[simulators]'"
        raise InputError(f"--plant {name}: {simulator.package} is not installed; {advice}") from None
    return module.make(system)
