"""What the residual is worth on real Crazyflie flights; skipped where the flight data are not at hand.

`NANOBENCH=folder pytest tests/adapt/test_real_flights.py -s` prints the figures; the folder holds the data set's CSVs.
"""

import os
from pathlib import Path

import pytest
import torch

from adapt.logs import flight_transitions, read_flight
from adapt.prediction import acceleration_error, prediction_report
from adapt.residual import fit_residual
from envs.dynamics import Dynamics
from envs.vehicles import load_vehicle

DATA = Path(os.environ.get("NANOBENCH") or Path(__file__).resolve().parents[3] / "shared" / "data" / "nanobench")
FIT = ("B2_circle_slow_rep1", "B2_circle_slow_rep2", "B3_figure8_medium_rep1", "B3_figure8_medium_rep2")
VALIDATE = ("B7_oval_medium_rep1", "B9_trefoil_slow_rep1")
PENALTIES = [10.0**k for k in range(-6, 3)]

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the nanobench flights are not at hand")


@pytest.fixture(scope="module")
def flights():
    """The vehicle, and the transitions of the flights to fit and to validate."""
    vehicle = load_vehicle("crazyflie")
    parts = [flight_transitions([read_flight(DATA / f"{n}.csv", vehicle) for n in names]) for names in (FIT, VALIDATE)]
    return vehicle, *parts


@pytest.fixture(scope="module")
def residual(flights):
    vehicle, fit, _ = flights
    return fit_residual(fit, Dynamics(vehicle.system))[0]


def ridge_inputs(transitions):
    """1, body velocity, thrust, body rates, battery voltage (N, 9), and the body axes (N, 3, 3)."""
    state = transitions.state.double()
    w, x, y, z = state[:, 3:7].unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    rotation = torch.stack(rows, 1)  # body to world
    velocity = torch.einsum("nij,ni->nj", rotation, state[:, 7:10])
    voltage = transitions.context[:, transitions.context_names.index("voltage")].double()
    parts = (torch.ones(len(state), 1), velocity, transitions.action[:, :1], state[:, 10:], voltage[:, None])
    return torch.cat([part.double() for part in parts], -1), rotation


def lacking(transitions, system):
    """Acceleration that the model lacks over each control period (N, 3), world axes."""
    predicted = Dynamics(system)(transitions.state.double(), transitions.action.double())
    return (transitions.next_state.double() - predicted)[:, 7:10] / system.dt


def ridge_error(system, fit, unseen):
    """RMS acceleration error of a ridge regression in body axes whose penalty is chosen by leaving out each flight."""

    def solve(rows, penalty):
        centre, scale = inputs[rows].mean(0), inputs[rows].std(0)
        centre[0], scale[0] = 0.0, 1.0
        z = (inputs[rows] - centre) / scale
        pull = penalty * len(z) * torch.eye(z.shape[1], dtype=z.dtype)
        pull[0, 0] = 0.0
        weights = torch.linalg.solve(z.T @ z + pull, z.T @ wanted[rows])
        return lambda given: (given - centre) / scale @ weights

    inputs, rotation = ridge_inputs(fit)
    wanted = torch.einsum("nij,ni->nj", rotation, lacking(fit, system))
    folds = [fit.trajectory == flight for flight in fit.trajectory.unique()]

    def left_out(penalty):
        return sum(float((solve(~fold, penalty)(inputs[fold]) - wanted[fold]).square().sum()) for fold in folds)

    chosen = solve(torch.ones(len(inputs), dtype=torch.bool), min(PENALTIES, key=left_out))
    given, unseen_rotation = ridge_inputs(unseen)
    missed = torch.einsum("nij,nj->ni", unseen_rotation, chosen(given)) - lacking(unseen, system)
    return float(missed.square().sum(-1).mean().sqrt())


def test_the_residual_removes_nine_tenths_of_the_acceleration_error_on_unseen_flights(flights, residual):
    vehicle, _, unseen = flights
    before, after = acceleration_error(Dynamics(vehicle.system), unseen), acceleration_error(residual, unseen)
    print(f"\nvalidation flights: {before:.3f} -> {after:.3f} m/s^2, after/before {after / before:.3f}")
    assert 4 < before < 7
    assert after / before <= 0.06


def test_the_residual_predicts_unseen_flights_better_than_ridge_regression(flights, residual):
    vehicle, fit, unseen = flights
    ours, ridge = acceleration_error(residual, unseen), ridge_error(vehicle.system, fit, unseen)
    print(f"\nvalidation flights: ours {ours:.3f}, ridge {ridge:.3f} m/s^2, ours/ridge {ours / ridge:.3f}")
    assert ridge < 0.4  # a rival that is worth beating
    assert ours / ridge <= 0.85


def test_the_residual_predicts_a_second_ahead_in_open_loop(flights, residual):
    vehicle, _, unseen = flights
    before, after = prediction_report(Dynamics(vehicle.system), unseen), prediction_report(residual, unseen)
    print("\n" + "\n".join(f"{name}: {before[name]:.3f} -> {after[name]:.3f}" for name in before))
    assert after["position_1s"] < 0.1 * before["position_1s"]
    assert after["velocity_1s"] < 0.15 * before["velocity_1s"]
