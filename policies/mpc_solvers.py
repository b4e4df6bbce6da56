"""The optimal control problem of model predictive control, and three ways to solve it.

    minimise  sum_k cost(x[k+1], u[k], reference[k])   subject to   x[k+1] = F(x[k], u[k]),  -1 <= u[k] <= 1

by multiple shooting (Bock and Plitt 1984): the states are variables and the dynamics are constraints. A plan is an
array (H, m + n) of rows (u[k], x[k+1]), or these in one row. The measured state x[0] is a parameter, not a variable
that is fixed: so the first stage has no state at all, which fatrop and hpipm both accept and which saves constraints.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from envs.errors import InputError
from envs.system import Task, cost_tables
from policies.generated_code import CompilerError, shared_library

QUADRATIC_PROGRAMS = ("hpipm", "qrqp")  # what a real-time iteration is solved with: the first that casadi has
NLP_FUNCTIONS = ("nlp_f", "nlp_g", "nlp_grad", "nlp_grad_f", "nlp_jac_g", "nlp_hess_l")
GAP = 1e-3  # largest gap x[k+1] - F(x[k], u[k]) after the one step of a real-time iteration; more needs another step
RESIDUAL = 1e-4  # largest violation of the optimality conditions of a quadratic program that counts as solved
LARGEST = 1e6  # numbers beyond it are a robot that has flown apart, and fatrop never returns from an overflow
STEPS = 3  # real-time iterations after which a problem is left to an interior-point method

OPTIONS = {
    # Warm-started plans are nearly optimal: a small first barrier, and no digits that one control period can't feel.
    "fatrop": {"print_level": 0, "max_iter": 200, "mu_init": 1e-6, "tolerance": 1e-5},
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500, "tol": 1e-10},
}


@dataclass(frozen=True)
class Problem:
    """The nonlinear program in CasADi symbols.

    `variables` are the rows of a plan, `parameters` the state (n) and the reference (H r), row by row.
    """

    states: int
    actions: int
    horizon: int
    variables: Any
    parameters: Any
    cost: Any
    gaps: Any
    curvature: Any  # constant Hessian of the cost, a diagonal matrix

    @property
    def limits(self):
        """Upper bound of the variables: 1 for actions, none for states; the lower bound is its negative."""
        upper = np.full((self.horizon, self.actions + self.states), np.inf)
        upper[:, : self.actions] = 1
        return upper.reshape(-1)


def make_problem(dynamics, task, unrolled=True):
    """The problem of a task, whose cost must be the quadratic one of `Task`.

    Args:
        unrolled: in scalars (SX), which CasADi evaluates fastest; else, and where the dynamics contain matrices (MX),
            in calls of the dynamics, which make short code.

    Raises:
        InputError: a cost of the task's own, or dynamics without `casadi()`.
    """
    import casadi

    if type(task).cost is not Task.cost:
        raise InputError(f"MPC: {type(task).__name__} has a cost of its own; expected the quadratic one of Task")
    if not hasattr(dynamics, "casadi"):
        raise InputError(f"MPC: {type(dynamics).__name__} has no casadi(); expected dynamics with equations in CasADi")
    step, horizon = dynamics.casadi(), task.horizon
    kind = casadi.SX if unrolled and step.is_a("SXFunction") else casadi.MX
    tables = cost_tables(task, torch.float64, torch.device("cpu"))
    spread, state_weights, trim, action_weights = (casadi.DM(table.tolist()) for table in tables)
    states, actions = step.size1_in(0), step.size1_in(1)
    start, reference = kind.sym("state", states), kind.sym("reference", spread.size1(), horizon)
    rows, cost, gaps, before = [], 0, [], start
    for k in range(horizon):
        action, state = kind.sym(f"u{k}", actions), kind.sym(f"x{k + 1}", states)
        gaps.append(state - step(before, action))
        cost += casadi.dot(state_weights, (state - spread.T @ reference[:, k]) ** 2)
        cost += casadi.dot(action_weights, (action - trim) ** 2)
        rows += [action, state]
        before = state
    return Problem(
        states,
        actions,
        horizon,
        casadi.vertcat(*rows),
        casadi.vertcat(start, casadi.vec(reference)),
        cost,
        casadi.vertcat(*gaps),
        2 * casadi.diag(casadi.repmat(casadi.vertcat(action_weights, state_weights), horizon, 1)),
    )


class Buffered:
    """A CasADi function on fixed numpy arrays, which saves a tenth of a millisecond a call.

    `inputs` and `outputs` are {name: array}; write into the former, `run()`, read the latter.
    """

    def __init__(self, function, outputs):
        names, results = function.name_in(), function.name_out()
        self._buffer, self._run = function.buffer()
        self.inputs = {name: np.zeros(function.numel_in(name)) for name in names}
        self.outputs = {name: np.zeros(function.numel_out(name)) for name in outputs}
        for name, array in self.inputs.items():
            self._buffer.set_arg(names.index(name), memoryview(array))
        for name, array in self.outputs.items():
            self._buffer.set_res(results.index(name), memoryview(array))

    def run(self):
        """Fill the outputs.

        Raises:
            RuntimeError: the function failed.
        """
        try:
            self._run()
        except (SystemError, RuntimeError) as error:  # as which CasADi tells of Ctrl-C
            if isinstance(error.__cause__, KeyboardInterrupt) or str(error) == "KeyboardInterrupt":
                raise KeyboardInterrupt from None
            raise


class NonlinearSolver:
    """Solves to convergence by an interior-point method of `casadi.nlpsol`."""

    def __init__(self, problem, plugin, compile=False):
        import casadi

        options = {"print_time": False, "show_eval_warnings": False, "error_on_fail": True, plugin: OPTIONS[plugin]}
        if plugin == "fatrop":
            equality = [True] * problem.gaps.numel()
            options |= {"structure_detection": "auto", "equality": equality}
        nlp = {"x": problem.variables, "p": problem.parameters, "f": problem.cost, "g": problem.gaps}
        solver = casadi.nlpsol("plan", plugin, nlp, options)
        self.compiled = False
        if compile:
            functions = [solver.oracle(), *(solver.get_function(name) for name in NLP_FUNCTIONS)]
            built = _from_library(functions, lambda library: casadi.nlpsol("plan", plugin, library, options))
            solver, self.compiled = built or solver, built is not None
        self._gaps = Buffered(solver.get_function("nlp_g"), ("g",))
        self._solver = Buffered(solver, ("x",))
        self._solver.inputs["ubx"][:] = problem.limits
        self._solver.inputs["lbx"][:] = -problem.limits

    def solve(self, guess, parameters, warm):
        """A plan (H (m + n),) from a guess of it and the parameters, or None where none was found."""
        self._gaps.inputs["x"][:] = guess
        self._gaps.inputs["p"][:] = parameters
        self._gaps.run()
        if not np.abs(self._gaps.outputs["g"]).max() < LARGEST:
            return None
        self._solver.inputs["x0"][:] = guess
        self._solver.inputs["p"][:] = parameters
        try:
            self._solver.run()
        except RuntimeError:  # quicker than to read the statistics
            return None
        plan = self._solver.outputs["x"]
        return plan.copy() if np.isfinite(plan).all() else None


class RealTimeIteration:
    """One quadratic program a call (Diehl et al. 2005): Gauss-Newton, and the cost is already quadratic.

    The status of the quadratic program isn't trusted: a step counts if it satisfies the optimality conditions. One that
    leaves a gap in the dynamics is repeated. What doesn't come right so, and every cold start, is solved by an
    interior-point method, because full Newton steps from far away may diverge: `far`, a solver of the same problem.
    """

    def __init__(self, problem, far, compile=False):
        import casadi

        plan, parameters = problem.variables, problem.parameters
        jacobian = casadi.jacobian(problem.gaps, plan)
        outputs = [problem.gaps, jacobian, casadi.gradient(problem.cost, plan)]
        linearised = casadi.Function("linearised", [plan, parameters], outputs)
        gaps = casadi.Function("gaps", [plan, parameters], [problem.gaps])
        functions, self.compiled = (linearised, gaps), False
        if compile:
            names = [function.name() for function in functions]
            built = _from_library(functions, lambda library: [casadi.external(name, library) for name in names])
            functions, self.compiled = built or functions, built is not None
        self._far = far
        self._step = Buffered(_newton_step(problem, *functions), ("following", "gap", "residual"))

    def solve(self, guess, parameters, warm):
        """A plan (H (m + n),) from a guess of it and the parameters, or None where none was found.

        Only a `warm` guess, which is a plan of one step before, is near enough for a real-time iteration.
        """
        inputs, outputs = self._step.inputs, self._step.outputs
        inputs["parameters"][:] = parameters
        inputs["plan"][:] = guess
        for _ in range(STEPS if warm else 0):
            self._step.run()
            if not outputs["residual"][0] < RESIDUAL:
                break
            if outputs["gap"][0] < GAP:
                return outputs["following"].copy()
            inputs["plan"][:] = outputs["following"]
        return self._far.solve(guess, parameters, warm)


def _newton_step(problem, linearised, gaps):
    """The function of a real-time iteration.

    From a plan and parameters: the following plan, its largest gap in the dynamics, and the largest violation of the
    quadratic program's optimality conditions (stationarity, constraints, bounds).
    """
    import casadi

    plan = casadi.MX.sym("plan", problem.variables.numel())
    parameters = casadi.MX.sym("parameters", problem.parameters.numel())
    gap, jacobian, gradient = linearised(plan, parameters)
    curvature, limits = problem.curvature, casadi.DM(problem.limits)
    name = next(name for name in QUADRATIC_PROGRAMS if casadi.has_conic(name))
    quadratic_program = casadi.conic(
        "step", name, {"h": curvature.sparsity(), "a": jacobian.sparsity()}, _conic_options(name, problem)
    )
    found = quadratic_program(
        h=curvature, a=jacobian, g=gradient, lba=-gap, uba=-gap, lbx=-limits - plan, ubx=limits - plan
    )
    change = found["x"]
    following = plan + change
    stationary = gradient + curvature @ change + jacobian.T @ found["lam_a"] + found["lam_x"]
    closed = gap + jacobian @ change
    outside = casadi.fmax(casadi.fabs(following) - limits, 0)
    left = gaps(following, parameters)
    residual = casadi.norm_inf(casadi.vertcat(stationary, closed, outside))
    return casadi.Function(
        "step",
        [plan, parameters],
        [following, casadi.norm_inf(left), residual],
        ["plan", "parameters"],
        ["following", "gap", "residual"],
    )


def _conic_options(name, problem):
    common = {"print_time": False, "error_on_fail": False}
    if name == "qrqp":
        return common | {"print_iter": False, "print_header": False, "print_info": False}
    stages, n, m = problem.horizon, problem.states, problem.actions
    return common | {"N": stages, "nx": [0] + [n] * stages, "nu": [m] * stages + [0], "ng": [0] * (stages + 1)}


def _from_library(functions, load):
    """What `load` makes of the compiled functions; None with a warning where they can't be compiled."""
    import casadi

    generator = casadi.CodeGenerator("functions")
    for function in functions:
        generator.add(function)
    try:
        return load(str(shared_library(generator.dump())))
    except (CompilerError, RuntimeError) as error:
        warnings.warn(f"MPC runs uncompiled: {str(error).splitlines()[0]}", stacklevel=5)
        return None


def available():
    """Names of the solvers that this build of casadi has."""
    import casadi

    found = [name for name in OPTIONS if casadi.has_nlpsol(name)]
    return found + ["rti"] * (bool(found) and any(casadi.has_conic(name) for name in QUADRATIC_PROGRAMS))


def make_solver(dynamics, task, name, compile=False):
    """A solver by name: "fatrop", "rti" or "ipopt".

    Raises:
        InputError: an unknown name, or one that isn't in this build of casadi.
    """
    if name not in (*OPTIONS, "rti"):
        raise InputError(f"--solver {name}: expected one of fatrop, rti, ipopt")
    if name not in available():
        raise InputError(f"--solver {name}: not in this build of casadi; it has {', '.join(available()) or 'none'}")
    problem = make_problem(dynamics, task, unrolled=not compile)
    if name != "rti":
        return NonlinearSolver(problem, name, compile)
    far = next(name for name in OPTIONS if name in available())
    rolled = make_problem(dynamics, task, unrolled=False)  # quicker to make, and this solver rarely runs
    far = NonlinearSolver(rolled, far, compile)
    return RealTimeIteration(problem, far, far.compiled)
