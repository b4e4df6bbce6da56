"""Curves of least snap through waypoints, in closed form: polynomials of order 7 between knots.

Mellinger & Kumar (2011), "Minimum snap trajectory generation and control for quadrotors", ICRA: minimum snap.
Bry, Richter, Bachrach & Roy (2015), "Aggressive flight of fixed-wing and quadrotor aircraft in dense indoor
environments", IJRR 34(7): the closed form with the derivatives at the knots as unknowns.
"""

import torch
from torch import Tensor


def _monomials(times: Tensor) -> Tensor:
    """Value and first three derivatives of t^0 ... t^7 at `times` `(T,)`: `(T, 4, 8)`."""
    powers = torch.arange(8, dtype=times.dtype)
    rows = []
    for order in range(4):
        falling = torch.stack([powers - i for i in range(order)]).prod(0) if order else torch.ones_like(powers)
        rows.append(falling * times[:, None] ** (powers - order).clamp(min=0))
    return torch.stack(rows, 1)


def _hermite(dtype: torch.dtype) -> Tensor:
    """`(8, 8)`: from the four derivatives at t = 0 and the four at t = 1 to the coefficients of the polynomial."""
    return torch.linalg.inv(_monomials(torch.tensor([0.0, 1.0], dtype=dtype)).reshape(8, 8))


def _duration_scale(durations: Tensor) -> Tensor:
    """`(M, 8)`: real-time derivatives of orders 0-3 at both ends of a segment to those of a segment of length 1."""
    scale = durations[:, None] ** torch.arange(4, dtype=durations.dtype)
    return torch.cat((scale, scale), -1)


def snap_hessian(knot_times: Tensor) -> Tensor:
    """`(4K, 4K)`: the integral of snap^2 is d' H d, d = (p, v, a, j) at each of the K knots `(K,)` [s], one axis."""
    durations = knot_times.diff()
    powers = torch.arange(8, dtype=knot_times.dtype)
    falling = powers * (powers - 1) * (powers - 2) * (powers - 3)
    gram = falling[:, None] * falling / (powers[:, None] + powers - 7).clamp(min=1)
    hermite, scale = _hermite(knot_times.dtype), _duration_scale(durations)
    unit = hermite.T @ gram @ hermite
    hessian = knot_times.new_zeros(4 * len(knot_times), 4 * len(knot_times))
    for k, duration in enumerate(durations):
        hessian[4 * k : 4 * k + 8, 4 * k : 4 * k + 8] += unit * scale[k] * scale[k, :, None] / duration**7
    return hessian


def knot_map(knot_times: Tensor, *, rest: bool) -> Tensor:
    """`(4K, K)`: from the waypoints of one axis to (p, v, a, j) at each knot on the curve of least snap through them.

    `rest`: velocity, acceleration and jerk are zero at both ends (K >= 2); otherwise they are free (K >= 4).
    """
    count = len(knot_times)
    order = torch.arange(4 * count) % 4
    free = order > 0
    if rest:
        free[:4] = free[-4:] = False
    hessian = snap_hessian(knot_times)
    to_knots = knot_times.new_zeros(4 * count, count)
    to_knots[order == 0] = torch.eye(count, dtype=knot_times.dtype)
    # Cholesky is indifferent to the very different scales of v, a and j on short and long segments
    factor = torch.linalg.cholesky(hessian[free][:, free])
    to_knots[free] = -torch.cholesky_solve(hessian[free][:, order == 0], factor)
    return to_knots


def minimum_snap(knot_times: Tensor, times: Tensor, *, rest: bool) -> Tensor:
    """The curve of least snap through waypoints as one linear map, `(T, 4, K)`: `map @ waypoints` is `(T, 4, axes)`.

    Args:
        knot_times: increasing times of the waypoints `(K,)` [s], float64.
        times: where to sample position, velocity, acceleration and jerk `(T,)` [s], within the knots.
        rest: as in `knot_map`.
    """
    segment = (torch.searchsorted(knot_times, times, right=True) - 1).clamp(0, len(knot_times) - 2)
    duration = knot_times.diff()[segment]
    scaled = _monomials((times - knot_times[segment]) / duration) @ _hermite(knot_times.dtype)
    scaled = scaled * _duration_scale(duration)[:, None] / _duration_scale(duration)[:, :4, None]
    ends = knot_map(knot_times, rest=rest).reshape(len(knot_times), 4, -1)
    return scaled @ torch.cat((ends[segment], ends[segment + 1]), 1)
