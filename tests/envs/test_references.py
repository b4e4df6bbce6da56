"""References are what they claim: smooth curves of least snap that the vehicle can fly at the speeds of their set."""

import math
from dataclasses import replace

import numpy
import pytest
import torch

from envs.errors import InputError
from envs.flatness import ACCELERATION, FLAT, JERK, POSITION, VELOCITY, FlightLimits, feasible, flatness
from envs.minimum_snap import minimum_snap, snap_hessian
from envs.references import RANDOM_SETS, SPLITS, random_polynomials, split_generator
from envs.shapes import NAMED, circle, hover, lemniscate, line
from envs.waypoints import read_waypoints

LIMITS = FlightLimits()
GRAVITY = LIMITS.gravity
FINE = {"steps": 5501, "dt": 0.002}  # 11 s, as by default
double = torch.float64


def _random(n, kind="paper", seed=0, split="train", **options):
    return random_polynomials(n, kind=kind, generator=split_generator(split, seed), **{"dtype": double, **options})


@pytest.fixture(scope="module", params=[*RANDOM_SETS, *NAMED, "file"])
def fine_curves(request, tmp_path_factory):
    """Every kind of reference, sampled finely, `(N, 5501, 12)`."""
    if request.param in RANDOM_SETS:
        return _random(3, request.param, **FINE)
    if request.param in NAMED:
        return NAMED[request.param](**FINE, dtype=double)
    path = tmp_path_factory.mktemp("waypoints") / "w.csv"
    path.write_text("t,x,y,z\n5,0,0,1\n6.5,2,0,1.5\n8.5,2,3,1\n13,-1,1,2\n")
    return read_waypoints(path, **FINE, dtype=double)


# --- curves -------------------------------------------------------------------------------------------------------


def test_velocity_acceleration_and_jerk_are_the_derivatives_of_position_and_never_jump(fine_curves):
    """Central differences; a jump of any of them at a knot would leave an error of its size."""
    for order, tolerance in ((1, 1e-4), (2, 1e-4), (3, 5e-3)):
        lower = fine_curves[..., 3 * (order - 1) : 3 * order]
        difference = (lower[:, 2:] - lower[:, :-2]) / (2 * FINE["dt"])
        torch.testing.assert_close(
            difference, fine_curves[:, 1:-1, 3 * order : 3 * order + 3], atol=tolerance, rtol=0, msg=FLAT[3 * order]
        )


def test_jerk_is_continuous_over_the_knots(fine_curves):
    steepest = fine_curves[..., JERK].diff(dim=1).abs().max() / FINE["dt"]  # [m/s^4]
    assert steepest < 60  # a jump of 0.12 m/s^3 between two points would be more


@pytest.mark.parametrize("name", NAMED)
def test_named_shapes_begin_at_the_origin_and_can_be_flown(name):
    curve = NAMED[name](dtype=double)
    assert curve.shape == (1, 111, 12)
    torch.testing.assert_close(curve[0, 0, POSITION], torch.zeros(3, dtype=double))
    assert feasible(curve, LIMITS).all()


def test_shapes_have_the_size_and_speed_that_they_were_asked_for():
    centre = torch.tensor([0.0, 1.5, 0.0], dtype=double)
    ring = circle(radius=1.5, speed=0.7, dtype=double)
    torch.testing.assert_close((ring[0, :, POSITION] - centre).norm(dim=-1), torch.full((111,), 1.5, dtype=double))
    torch.testing.assert_close(ring[0, :, VELOCITY].norm(dim=-1), torch.full((111,), 0.7, dtype=double))
    eight = lemniscate(radius=2.0, speed=1.5, steps=2000, dt=0.01, dtype=double)
    assert math.isclose(eight[..., 0].max(), 2.0, rel_tol=1e-4)
    assert math.isclose(eight[..., VELOCITY].norm(dim=-1).max(), 1.5, rel_tol=1e-4)
    straight = line(speed=3.0, direction=(0.0, 3.0, 4.0), steps=11, dtype=double)
    torch.testing.assert_close(straight[0, -1, POSITION], torch.tensor([0.0, 1.8, 2.4], dtype=double))


# --- minimum snap -------------------------------------------------------------------------------------------------


def test_one_segment_from_rest_to_rest_is_the_known_polynomial_of_order_seven():
    times = torch.linspace(0, 2, 50, dtype=double)
    curve = minimum_snap(torch.tensor([0.0, 2.0], dtype=double), times, rest=True) @ torch.tensor([0.0, 1.0]).double()
    t = times / 2
    torch.testing.assert_close(curve[:, 0], 35 * t**4 - 84 * t**5 + 70 * t**6 - 20 * t**7)
    torch.testing.assert_close(curve[:, 1], 140 * t**3 * (1 - t) ** 3 / 2)


def test_a_cubic_has_no_snap_so_free_ends_reproduce_it():
    knots = torch.tensor([0.0, 1.0, 1.7, 4.0, 5.0], dtype=double)
    times = torch.linspace(0, 5, 60, dtype=double)
    curve = minimum_snap(knots, times, rest=False) @ (knots**3 - 2 * knots)
    cubic = torch.stack((times**3 - 2 * times, 3 * times**2 - 2, 6 * times, torch.full_like(times, 6.0)), -1)
    torch.testing.assert_close(curve, cubic, atol=1e-7, rtol=0)


@pytest.mark.parametrize("rest", [True, False])
def test_no_other_curve_through_the_same_waypoints_has_less_snap(rest):
    """Least snap means that snap is orthogonal to the snap of every change that the conditions leave free."""
    knots = torch.tensor([0.0, 0.8, 2.0, 3.5, 4.1], dtype=double)
    times = torch.linspace(0, 4.1, 40001, dtype=double)
    jerk = (minimum_snap(knots, times, rest=rest) @ torch.tensor([0.0, 1.0, -0.5, 2.0, 1.0], dtype=double))[:, 3]
    snap, between = jerk.diff() / times.diff(), (times[1:] + times[:-1]).numpy() / 2
    ends = [0.0, 4.1] * (4 if rest else 1)
    for extra in ([], [1.3], [1.3, 3.0]):
        change = numpy.poly1d([0.8, 2.0, 3.5, *ends, *extra], r=True)
        change_snap = torch.from_numpy(change.deriv(4)(between))
        assert abs(torch.nn.functional.cosine_similarity(snap, change_snap, dim=0)) < 1e-5


def test_the_snap_hessian_gives_the_integral_of_squared_snap():
    """t^5 on [1, 3] has snap 120 t, so the integral is 14400 * (27 - 1) / 3."""
    knots = torch.tensor([1.0, 1.5, 3.0], dtype=double)
    ends = torch.stack((knots**5, 5 * knots**4, 20 * knots**3, 60 * knots**2), -1).flatten()
    assert math.isclose(ends @ snap_hessian(knots) @ ends, 14400 * 26 / 3, rel_tol=1e-9)


# --- flatness -----------------------------------------------------------------------------------------------------


def _body_axes(quaternion):
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack(
        (
            torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
            torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
            torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
        ),
        -2,
    )


def test_hover_takes_the_thrust_of_gravity_level_attitude_and_no_rates():
    thrust, quaternion, rates = flatness(hover(dtype=double), GRAVITY)
    assert (thrust == GRAVITY).all()
    assert (quaternion == torch.tensor([1.0, 0, 0, 0])).all()
    assert (rates == 0).all()


def test_a_circle_is_flown_at_the_bank_angle_of_its_centripetal_acceleration():
    thrust, quaternion, _ = flatness(circle(radius=3.0, speed=2.5, dtype=double), GRAVITY)
    tilt = torch.acos(_body_axes(quaternion)[..., 2, 2])
    torch.testing.assert_close(tilt, torch.full_like(tilt, math.atan(2.5**2 / (3.0 * GRAVITY))))
    torch.testing.assert_close(thrust, GRAVITY / tilt.cos())


def test_thrust_points_along_the_body_axis_and_the_nose_stays_in_the_plane_of_heading_zero():
    curves = _random(20, "fast")
    thrust, quaternion, _ = flatness(curves, GRAVITY)
    axes = _body_axes(quaternion)
    force = curves[..., ACCELERATION] + torch.tensor([0.0, 0.0, GRAVITY], dtype=double)
    torch.testing.assert_close(axes[..., 2] * thrust[..., None], force)
    torch.testing.assert_close(quaternion.norm(dim=-1), torch.ones_like(thrust))
    assert axes[..., 1, 0].abs().max() < 1e-12  # x_b has no part along world y
    assert (axes[..., 0, 0] > 0).all()


def test_integrating_the_rigid_body_with_the_thrust_and_rates_of_flatness_flies_the_curve():
    """Attitude by small rotations at the rate in the middle of each step, position by the trapezium rule."""
    dt = 0.01
    curves = _random(4, "fast", steps=1101, dt=dt)
    thrust, quaternion, rates = flatness(curves, GRAVITY)
    middle = (rates[:, 1:] + rates[:, :-1]) / 2
    zeros = torch.zeros_like(middle[..., 0])
    p, q, r = middle.unbind(-1)
    skew = torch.stack((zeros, -r, q, r, zeros, -p, -q, p, zeros), -1).unflatten(-1, (3, 3))
    attitude, turns = _body_axes(quaternion[:, 0]), torch.linalg.matrix_exp(skew * dt)
    down = torch.tensor([0.0, 0.0, -GRAVITY], dtype=double)
    acceleration = attitude[..., 2] * thrust[:, :1] + down
    position, velocity = curves[:, 0, POSITION], curves[:, 0, VELOCITY]
    for k in range(turns.shape[1]):
        attitude = attitude @ turns[:, k]
        before, acceleration = acceleration, attitude[..., 2] * thrust[:, k + 1, None] + down
        position = position + dt * velocity + dt**2 * (2 * before + acceleration) / 6
        velocity = velocity + dt * (before + acceleration) / 2
    torch.testing.assert_close(attitude, _body_axes(quaternion[:, -1]), atol=5e-5, rtol=0)
    torch.testing.assert_close(velocity, curves[:, -1, VELOCITY], atol=5e-4, rtol=0)
    torch.testing.assert_close(position, curves[:, -1, POSITION], atol=5e-3, rtol=0)


# --- feasibility --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("curve", "narrow"),
    [
        (circle(2.0, 2.0), {"thrust_max": 10.0}),
        (line(), {"thrust_min": 9.8}),
        (circle(2.0, 2.0), {"rate_x": 0.15}),
        (circle(2.0, 2.0), {"rate_y": 0.15}),
        (circle(2.0, 2.0), {"rate_z": 0.01}),
    ],
)
def test_a_curve_that_needs_more_than_one_limit_allows_is_not_feasible(curve, narrow):
    assert feasible(curve, LIMITS).all()
    assert not feasible(curve, replace(LIMITS, **narrow)).any()


def test_the_margin_shrinks_rates_and_the_thrust_range_about_its_middle():
    curve = circle(2.0, 2.0, steps=1001, dt=0.01, dtype=double)
    thrust, _, rates = flatness(curve, GRAVITY)
    for margin in (0.5, 0.9):
        needed = float(rates[..., 0].abs().max()) / margin
        assert feasible(curve, replace(LIMITS, rate_x=needed * 1.001), margin)
        assert not feasible(curve, replace(LIMITS, rate_x=needed * 0.999), margin)
        top = float(thrust.max())  # middle 8: 8 + margin * half = top
        half = (top - 8) / margin
        assert feasible(curve, replace(LIMITS, thrust_min=8 - half * 1.001, thrust_max=8 + half * 1.001), margin)
        assert not feasible(curve, replace(LIMITS, thrust_min=8 - half * 0.999, thrust_max=8 + half * 0.999), margin)


def test_free_fall_is_not_feasible():
    curve = hover(dtype=double)
    curve[:, 50, 8] = -GRAVITY
    assert not feasible(curve, LIMITS).any()


@pytest.mark.parametrize("kind", RANDOM_SETS)
def test_random_curves_stay_within_nine_tenths_of_the_limits_and_come_near_them(kind):
    curves = _random(1000, kind)
    thrust, _, rates = flatness(curves, GRAVITY)
    assert (rates.abs() <= 0.45).all()
    assert (rates[..., :2].abs().amax((0, 1)) > 0.43).all()
    assert ((thrust - 9.81).abs() <= 0.9 * 7.5).all()
    assert feasible(curves, LIMITS).all()


def test_a_slower_vehicle_gets_curves_that_it_can_fly():
    slow = replace(LIMITS, rate_x=0.3, rate_y=0.3)
    curves = _random(50, limits=slow)
    assert feasible(curves, slow).all()
    assert not feasible(_random(50), slow).all()


def test_limits_that_no_curve_meets_are_refused_in_one_line():
    with pytest.raises(InputError, match=r"only 0 of 20480 .* raise the thrust or rate limits") as error:
        _random(5, limits=replace(LIMITS, thrust_max=9.0), dtype=torch.float32)
    assert "\n" not in str(error.value)


# --- random sets --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", RANDOM_SETS)
def test_each_curve_of_a_set_has_the_mean_and_peak_speed_of_the_set(kind):
    speed_set = RANDOM_SETS[kind]
    speeds = _random(200, kind, steps=1101, dt=0.01)[:, :1001, VELOCITY].norm(dim=-1)
    mean, peak = speeds.mean(-1), speeds.amax(-1)
    assert speed_set.mean[0] * 0.995 < mean.min() and mean.max() < speed_set.mean[1] * 1.005
    assert speed_set.peak[0] * 0.995 < peak.min() and peak.max() < speed_set.peak[1] * 1.005
    assert mean.std() > 0.15


def test_the_sets_have_the_speeds_of_the_paper():
    assert (RANDOM_SETS["paper"].mean, RANDOM_SETS["paper"].peak) == ((1.0, 2.0), (3.0, 5.0))
    fast = _random(1000, "fast")[:, :101, VELOCITY].norm(dim=-1)
    assert abs(fast.mean() - 3.0) < 0.05


@pytest.mark.parametrize("kind", RANDOM_SETS)
def test_random_curves_vary_in_heading_height_and_curvature(kind):
    curves = _random(1000, kind)
    assert (curves[:, 0, POSITION] == 0).all()
    start = curves[:, 0, VELOCITY]
    assert (start.norm(dim=-1) > 0.1).float().mean() > 0.98
    octants = ((start > 0) * torch.tensor([1, 2, 4])).sum(-1)
    assert (torch.bincount(octants, minlength=8) > 80).all()
    assert (curves[..., ACCELERATION].std(dim=(0, 1)) > 0.3).all()
    heights = curves[..., 2].amax(1) - curves[..., 2].amin(1)
    assert heights.min() < 2 < 4 < heights.max()


def test_the_same_stream_gives_the_same_curves_and_the_first_of_a_longer_call():
    assert torch.equal(_random(20), _random(20))
    assert torch.equal(_random(20), _random(3000, dtype=double)[:20])
    generator = split_generator("train", 0)
    first, second = (random_polynomials(20, generator=generator, dtype=double) for _ in range(2))
    assert not torch.isclose(first[:, -1], second[:, -1]).all(-1).any()


def test_train_validation_and_test_curves_are_different_for_any_two_seeds():
    seeds = {(split, seed): split_generator(split, seed).initial_seed() for split in SPLITS for seed in range(200)}
    assert len({seed & 0xFFFFFFFF for seed in seeds.values()}) == 600  # 32 bits are all that the CPU generator uses
    assert all(seed % 4 == SPLITS.index(split) for (split, _), seed in seeds.items())
    ends = torch.cat([_random(20, split=split, seed=seed)[:, -1, POSITION] for split in SPLITS for seed in (0, 1)])
    assert torch.cdist(ends, ends).add(torch.eye(len(ends))).min() > 1e-3


def test_the_streams_of_the_splits_stay_what_they_are():
    """Published numbers depend on the test curves: a change of these is a change of the benchmark."""
    seeds = [split_generator(split, 0).initial_seed() for split in SPLITS]
    assert seeds == [8493733112532773764, 8493733112532773765, 8493733112532773766]


def test_a_slower_flight_takes_the_same_path():
    full, half = _random(10, steps=221, dt=0.05), _random(10, steps=111, speed=0.5)
    for order, columns in enumerate((POSITION, VELOCITY, ACCELERATION, JERK)):
        torch.testing.assert_close(half[..., columns], full[:, :111, columns] * 0.5**order)


def test_single_and_double_precision_and_the_default_type():
    generator = split_generator("test", 3)
    assert random_polynomials(2, generator=generator).dtype == torch.get_default_dtype()
    assert circle().dtype == torch.get_default_dtype()
    assert _random(2, dtype=torch.float32).dtype == torch.float32


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _random(1, "slow"), "'slow'.*paper, fast"),
        (lambda: _random(0), "n is 0"),
        (lambda: _random(1, speed=1.5), "speed is 1.5"),
        (lambda: _random(1, speed=0.0), "speed is 0"),
        (lambda: circle(steps=0), "at least 1 step"),
        (lambda: hover(dt=-0.1), "positive dt"),
        (lambda: circle(radius=0.0), "radius is 0"),
        (lambda: lemniscate(radius=-1.0), "radius is -1"),
        (lambda: line(direction=(0.0, 0.0, 0.0)), "direction is 0"),
        (lambda: split_generator("dev", 0), "'dev'.*train, validation, test"),
    ],
)
def test_arguments_out_of_range_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


# --- waypoints from a file ----------------------------------------------------------------------------------------


def test_a_waypoint_file_is_flown_through_its_points_at_their_times_and_held_at_the_end(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text("\ufefft,z, y,x,name\n5,1,0,0,a\n6.5,1.5,0,2,b\n\n8.5,1,3,2,c\n13,2,1,-1,d\n", encoding="utf-8")
    curve = read_waypoints(path, steps=111, dt=0.1, dtype=double)
    assert curve.shape == (1, 111, 12)
    points = torch.tensor([[0, 0, 1], [2, 0, 1.5], [2, 3, 1], [-1, 1, 2]], dtype=double)
    torch.testing.assert_close(curve[0, [0, 15, 35, 80], POSITION], points)
    assert curve[0, 0, 3:].abs().max() < 1e-9  # at rest at the start
    assert (curve[0, 80:, POSITION] == points[-1]).all() and (curve[0, 80:, 3:] == 0).all()
    assert curve[0, 79, JERK].norm() < 1.0 < curve[0, 40, VELOCITY].norm()


def test_hundreds_of_waypoints_are_solved_without_loss_of_digits(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text("t,x,y,z\n" + "".join(f"{k / 20},{math.sin(k / 20)},0,1\n" for k in range(300)))
    curve = read_waypoints(path, steps=100, dt=0.1, dtype=double)
    times = 0.1 * torch.arange(100, dtype=double)
    inner = slice(20, 90)  # the sine isn't at rest at the ends
    torch.testing.assert_close(curve[0, inner, 6], -times[inner].sin(), atol=1e-5, rtol=0)


HEADER = "t,x,y,z\n0,0,0,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column t, x, y, z"),
        ("t,x,z\n0,0,0\n1,1,1\n", "no column y"),
        (HEADER, "1 waypoints, expected 2 to"),
        (HEADER + "1,a,0,1\n", "row 3: x is 'a'"),
        (HEADER + "1,0,nan,1\n", "row 3: y is 'nan'"),
        (HEADER + "1,0,0,inf\n", "row 3: z is 'inf'"),
        (HEADER + "1,0,0\n", "row 3: z is ''"),
        (HEADER + "1,0,0,1\n1,0,0,1\n", "row 4: t is 1 after 1"),
        (HEADER + "1,0,0,1\n0.5,0,0,1\n", "row 4: t is 0.5 after 1"),
        (HEADER + "1e-9,0,0,1\n1,0,0,1\n", "run from 1e-09 to 1 s"),
        (HEADER + "".join(f"{k + 1},0,0,1\n" for k in range(1000)), "1001 waypoints"),
    ],
)
def test_a_bad_waypoint_file_is_refused_in_one_line_that_names_file_and_row(tmp_path, text, message):
    path = tmp_path / "w.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_waypoints(path, steps=10, dt=0.1)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_missing_file_a_folder_and_a_binary_file_are_refused(tmp_path):
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"t,x,y,z\n\xff\xfe\x00\x81")
    for path, message in ((tmp_path / "none.csv", "No such file"), (tmp_path, "can't read"), (binary, "not a CSV")):
        with pytest.raises(InputError, match=message):
            read_waypoints(path, steps=10, dt=0.1)
