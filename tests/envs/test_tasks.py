"""What the three jobs ask: starts, references, costs, ends and scores against closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from envs import SYSTEMS, InputError, make_system, make_task
from envs.cartpole import CartPole
from envs.fixed_wing import CRUISE, FixedWing
from envs.quadrotor import Quadrotor

EVERY_SET = [(name, entry) for name, (_, task) in SYSTEMS.items() for entry in task.sets]


@pytest.fixture(scope="module", params=EVERY_SET, ids="-".join)
def task(request):
    system, name = request.param
    return make_task(system, name)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def steps(*values):
    return torch.tensor(values)


# --- every task ---------------------------------------------------------------------------------------------------


def test_episodes_are_fixed_by_split_and_seed_and_differ_between_splits(task):
    drawn = task.episodes(4, "train", 0)
    assert torch.equal(drawn, task.episodes(4, "train", 0))
    assert len(drawn) == 4
    if (drawn[0] == drawn[1]).all():
        return  # a named curve has no chance in it
    others = [task.episodes(4, split, 0) for split in ("validation", "test")] + [task.episodes(4, "train", 1)]
    assert not any(torch.equal(drawn, other) for other in others)
    assert not torch.equal(others[0], others[1])


def test_episodes_do_not_touch_the_global_generator(task):
    before = torch.get_rng_state()
    task.episodes(2, "train", 0)
    assert torch.equal(torch.get_rng_state(), before)


def test_shapes_are_those_of_the_contract(task):
    episodes, step = task.episodes(5, "train", 0), torch.arange(5)
    state = task.start(episodes, step)
    reference = task.reference(episodes, step, state)
    n = len(task.system.State._fields)
    assert state.shape == (5, n)
    assert reference.shape == (5, task.horizon, len(task.reference_names))
    assert task.observe(state).dim() == 2
    window = task.window(state, reference)
    assert window.dim() == 3 and window.shape[0] == 5
    assert task.distance(episodes, step, state).shape == (5,)
    for flag in (task.diverged(episodes, step, state), task.arrived(episodes, step, state)):
        assert flag.shape == (5,) and flag.dtype == torch.bool
    score, success = task.score(episodes, state.unsqueeze(1).expand(5, task.steps + 1, n))
    assert score.shape == success.shape == (5,) and success.dtype == torch.bool


def test_a_start_lies_on_the_reference_at_any_step(task):
    episodes = task.episodes(5, "train", 0).double()
    for step in (0, 7):
        at = torch.full((5,), step)
        state = task.start(episodes, at)
        assert not task.diverged(episodes, at, state).any()
        assert not task.arrived(episodes, at, state).any()
        if task.system.name != "cartpole":  # its reference begins at any state
            assert task.distance(episodes, at, state).max() < 1e-6


def test_the_horizon_is_the_length_of_the_reference(task):
    longer = replace(task, horizon=13)
    episodes, step = longer.episodes(2, "train", 0), steps(0, 3)
    assert longer.reference(episodes, step, longer.start(episodes, step)).shape[1] == 13


def test_a_state_that_is_not_a_number_has_diverged(task):
    episodes = task.episodes(2, "train", 0)
    state = task.start(episodes, steps(0, 0)) * math.nan
    assert task.diverged(episodes, steps(0, 0), state).all()
    flown = state.unsqueeze(1).expand(2, task.steps + 1, -1)
    assert not task.score(episodes, flown)[1].any()


def test_the_cost_is_zero_on_the_reference_at_trim(task):
    goal = random(3, len(task.reference_names))
    state = torch.zeros(3, len(task.system.State._fields), dtype=torch.float64)
    for column, name in enumerate(task.reference_names):
        state[:, task.system.State._fields.index(name)] = goal[:, column]
    trim = torch.tensor(task.system.trim_action, dtype=torch.float64).expand(3, -1)
    assert task.cost(state, trim, goal).abs().max() < 1e-20


def test_an_option_that_makes_no_sense_is_refused(nominal):
    with pytest.raises(InputError, match="horizon is 0, expected at least 1"):
        make_task(nominal, horizon=0)
    with pytest.raises(InputError, match=f"task of {nominal.name}: no option hurry"):
        make_task(nominal, hurry=1)


# --- CartPole -----------------------------------------------------------------------------------------------------


def test_a_cartpole_starts_inside_its_box_and_fills_it():
    start = make_task("cartpole").episodes(2000, "train", 0)
    box = torch.tensor([0.15, 0.15, 0.05, 0.15])
    assert (start.abs() <= box).all()
    assert (start.abs().amax(0) > 0.98 * box).all()
    assert (start.mean(0).abs() < 0.05 * box).all()


def test_the_reference_of_a_cartpole_leads_straight_to_rest():
    state, task = random(4, 4), make_task("cartpole")
    reference = task.reference(state, steps(0, 1, 2, 3), state)
    assert reference[:, -1].abs().max() == 0
    torch.testing.assert_close(reference[:, 0], 0.9 * state)
    torch.testing.assert_close(reference[:, 4], 0.5 * state)


def test_the_cost_of_a_cartpole_is_that_of_the_paper():
    state, goal, action = random(6, 4, seed=1), random(6, 4, seed=2), random(6, 1, seed=3)
    _, v, theta, omega = (state - goal).unbind(-1)
    torch.testing.assert_close(make_task("cartpole").cost(state, action, goal), 10 * theta**2 + 3 * v**2 + omega**2)


@pytest.mark.parametrize(
    ("x", "theta", "failed"), [(2.39, 0, False), (-2.41, 0, True), (0, 0.41, False), (0, -0.42, True), (2.5, 0.5, True)]
)
def test_a_cartpole_fails_at_24_degrees_and_at_the_ends_of_the_rail(x, theta, failed):
    task, state = make_task("cartpole"), torch.tensor([[x, 0.0, theta, 0.0]])
    assert task.diverged(state, steps(0), state).item() is failed
    flown = torch.zeros(1, task.steps + 1, 4)
    flown[:, 100] = state
    assert task.score(state, flown)[1].item() is not failed


def test_the_score_of_a_cartpole_is_its_mean_speed_after_the_start():
    task = make_task("cartpole")
    flown = torch.zeros(2, task.steps + 1, 4)
    flown[:, 1::2, 1], flown[:, 2::2, 1] = 0.1, -0.3
    flown[:, 0, 1] = 100.0
    torch.testing.assert_close(task.score(flown[:, 0], flown)[0], torch.full((2,), 0.2))


def test_the_distance_of_a_cartpole_is_its_angle():
    state = random(5, 4)
    torch.testing.assert_close(make_task("cartpole").distance(state, None, state), state[:, 2].abs())


def test_cartpole_and_its_policy_see_the_raw_state_and_no_reference():
    task, state = make_task("cartpole"), random(3, 4)
    assert torch.equal(task.observe(state), state)
    assert task.window(state, task.reference(state, steps(0, 0, 0), state)).shape == (3, 10, 0)


# --- quadrotor ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tracking():
    task = make_task("quadrotor")
    return task, task.episodes(4, "train", 0).double()


def test_the_cost_of_a_quadrotor_is_that_of_the_paper_with_actions_from_0_to_1(tracking):
    """10 |dp|^2 + |dv|^2 + 0.1 |w|^2 + 5 (T - 1/2)^2 + 0.1 |w_des - 1/2|^2."""
    task, _ = tracking
    state, goal, action = random(6, 13, seed=1), random(6, 6, seed=2), random(6, 4, seed=3)
    unit = (action + 1) / 2
    expected = 10 * (state[:, :3] - goal[:, :3]).square().sum(-1) + (state[:, 7:10] - goal[:, 3:]).square().sum(-1)
    expected += 0.1 * state[:, 10:].square().sum(-1)
    expected += 5 * (unit[:, 0] - 0.5) ** 2 + 0.1 * (unit[:, 1:] - 0.5).square().sum(-1)
    torch.testing.assert_close(task.cost(state, action, goal), expected)


def test_the_cost_of_a_vehicle_of_ones_own_is_about_its_own_hover():
    heavy = make_task(replace(Quadrotor(), thrust_min=0.0, thrust_max=14.0))
    zero, thrust = torch.zeros(1, 13).double(), 9.81 / 7 - 1
    action = torch.tensor([[thrust, 0, 0, 0]], dtype=torch.float64)
    assert heavy.cost(zero, action, zero[:, :6]).item() == pytest.approx(0, abs=1e-20)


def test_a_quadrotor_starts_with_what_its_reference_prescribes(tracking):
    task, episodes = tracking
    step = steps(0, 5, 50, 100)
    state, points = task.start(episodes, step), episodes[torch.arange(4), step]
    torch.testing.assert_close(state[:, :3], points[:, :3])
    torch.testing.assert_close(state[:, 7:10], points[:, 3:6])
    torch.testing.assert_close(state[:, 3:7].norm(dim=-1), torch.ones(4).double())
    thrust = points[:, 6:9] + torch.tensor([0, 0, 9.81], dtype=torch.float64)
    up = torch.stack([2 * (state[:, 4] * state[:, 6] + state[:, 3] * state[:, 5]),
                      2 * (state[:, 5] * state[:, 6] - state[:, 3] * state[:, 4]),
                      1 - 2 * (state[:, 4] ** 2 + state[:, 5] ** 2)], -1)  # fmt: skip
    torch.testing.assert_close(up, thrust / thrust.norm(dim=-1, keepdim=True))


def test_the_reference_of_a_quadrotor_is_what_comes_next(tracking):
    task, episodes = tracking
    reference = task.reference(episodes, steps(0, 5, 50, 100), None)
    for row, step in enumerate((0, 5, 50, 100)):
        assert torch.equal(reference[row], episodes[row, step + 1 : step + 11, :6])
    last = episodes.shape[1] - 1
    assert torch.equal(task.reference(episodes, steps(last, last, last, last), None)[:, 0], episodes[:, -1, :6])


def test_a_quadrotor_sees_where_its_reference_leaves_the_path_that_it_would_keep(tracking):
    task, episodes = tracking
    step = steps(0, 5, 50, 90)
    state = task.start(episodes, step) + 0.1
    window = task.window(state, reference := task.reference(episodes, step, state))
    place, velocity = state[:, :3], state[:, 7:10]
    for k in range(10):
        kept = place + (k + 1) * 0.1 * velocity
        torch.testing.assert_close(window[:, k, :3], reference[:, k, :3] - kept)
        torch.testing.assert_close(window[:, k, 3:], reference[:, k, 3:] - velocity)


def test_a_quadrotor_sees_velocities_attitude_and_rates_but_not_its_place(tracking):
    task, episodes = tracking
    state = task.start(episodes, steps(0, 5, 50, 90))
    moved = state.clone()
    moved[:, :3] += 5
    assert torch.equal(task.observe(moved), task.observe(state))
    level = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0, 1, 2, 3, 4, 5, 6]])
    expected = [1, 2, 3, 1, 2, 3, 1, 0, 0, 0, 1, 0, 4, 5, 6]
    assert task.observe(level)[0].tolist() == expected
    half = math.sqrt(0.5)  # nose to world y: body x is world y, body y is minus world x
    turned = torch.tensor([[0.0, 0, 0, half, 0, 0, half, 1, 2, 3, 0, 0, 0]])
    expected = [1, 2, 3, 2, -1, 3, 0, 1, 0, -1, 0, 0, 0, 0, 0]
    assert task.observe(turned)[0].tolist() == pytest.approx(expected, abs=1e-6)


def test_a_quadrotor_five_metres_off_has_failed(tracking):
    task, episodes = tracking
    step = steps(0, 5, 50, 90)
    state = task.start(episodes, step)
    state[:, 1] += torch.tensor([0.0, 4.9, 5.1, -5.1])
    torch.testing.assert_close(task.distance(episodes, step, state), torch.tensor([0, 4.9, 5.1, 5.1]).double())
    assert task.diverged(episodes, step, state).tolist() == [False, False, True, True]


def test_the_score_of_a_quadrotor_is_its_mean_distance_after_the_start(tracking):
    task, episodes = tracking
    flown = torch.zeros(4, task.steps + 1, 13).double()
    flown[..., :3] = episodes[:, : task.steps + 1, :3] + torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64)
    flown[:, 0] = 1000  # every method starts on the reference
    flown[2, 40, 0] += 6
    error, success = task.score(episodes, flown)
    torch.testing.assert_close(error[:2], torch.full((2,), 0.5).double())
    assert success.tolist() == [True, True, False, True]


def test_an_unknown_set_of_references_is_refused():
    with pytest.raises(InputError, match=r"--set spiral: expected one of paper, fast, .* or a CSV file"):
        make_task("quadrotor", "spiral")


# --- fixed wing ---------------------------------------------------------------------------------------------------


def test_targets_of_the_fixed_wing_lie_in_their_square():
    targets = make_task("fixed_wing").episodes(2000, "train", 0)
    assert (targets[:, 0] == 50).all()
    assert (targets[:, 1:].abs() <= 5).all() and (targets[:, 1:].abs().amax(0) > 4.9).all()
    assert (targets[:, 1:].mean(0).abs() < 0.3).all()


def test_a_fixed_wing_starts_at_cruise_along_x_from_the_origin():
    task = make_task("fixed_wing")
    targets = task.episodes(2, "train", 0).double()
    expected = torch.tensor([0.0, 0, 0, 1, 0, 0, 0, 11.5, 0, 0, 0, 0, 0], dtype=torch.float64)
    assert torch.equal(task.start(targets, steps(0, 0)), expected.expand(2, 13))
    later = task.start(targets, steps(20, 40))[:, :3]
    torch.testing.assert_close(later.norm(dim=-1), torch.tensor([11.5, 23.0]).double())


def test_the_cost_of_a_fixed_wing_is_that_of_the_paper_with_actions_from_0_to_1():
    """10 |dp|^2 + 0.1 |surfaces - 1/2|^2; thrust is free."""
    state, goal, action = random(6, 13, seed=1), random(6, 3, seed=2), random(6, 4, seed=3)
    expected = 10 * (state[:, :3] - goal).square().sum(-1) + 0.1 * ((action[:, 1:] + 1) / 2 - 0.5).square().sum(-1)
    torch.testing.assert_close(make_task("fixed_wing").cost(state, action, goal), expected)


def test_the_reference_of_a_fixed_wing_is_the_line_to_the_target_at_cruise():
    task, target = make_task("fixed_wing"), torch.tensor([[50.0, 4.0, -3.0]], dtype=torch.float64)
    state = random(1, 13)
    reference = task.reference(target, steps(0), state)[0]
    direction = (target - state[:, :3])[0] / (target - state[:, :3]).norm()
    for k in range(10):
        torch.testing.assert_close(reference[k], state[0, :3] + (k + 1) * 0.05 * 11.5 * direction)


def test_close_to_the_target_and_behind_it_the_reference_still_leads_forward():
    task, target = make_task("fixed_wing"), torch.tensor([[50.0, 0.0, 0.0]], dtype=torch.float64)
    for x in (49.9, 50.0, 60.0):
        state = torch.zeros(1, 13).double()
        state[:, :2] = torch.tensor([x, task.nearest])
        step = task.reference(target, steps(0), state)[0, 0] - state[0, :3]
        expected = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64) / math.sqrt(2) * CRUISE * 0.05
        torch.testing.assert_close(step, expected)


def test_a_fixed_wing_sees_the_last_reference_point_relative_to_itself():
    task, targets = make_task("fixed_wing"), make_task("fixed_wing").episodes(3, "train", 0).double()
    state = random(3, 13)
    reference = task.reference(targets, steps(0, 0, 0), state)
    window = task.window(state, reference)
    torch.testing.assert_close(window, (reference[:, -1] - state[:, :3]).unsqueeze(1))


def test_a_fixed_wing_does_not_see_its_place():
    task, state = make_task("fixed_wing"), random(3, 13)
    moved = state.clone()
    moved[:, :3] += 5
    assert torch.equal(task.observe(moved), task.observe(state))
    level = torch.tensor([[9.0, 9, 9, 1, 0, 0, 0, 11, 2, 3, 4, 5, 6]])
    assert task.observe(level)[0].tolist() == [1, 0, 0, 0, 1, 0, 11, 2, 3, 4, 5, 6]


def straight(*through, n=121):
    """States (1, n, 13) along straight legs between points, the same number of steps each."""
    points = torch.tensor(through, dtype=torch.float64)
    share = torch.linspace(0, len(points) - 1, n, dtype=torch.float64)
    leg = share.floor().long().clamp(max=len(points) - 2)
    states = torch.zeros(1, n, 13, dtype=torch.float64)
    states[0, :, :3] = points[leg] + (share - leg).unsqueeze(-1) * (points[leg + 1] - points[leg])
    return states


TARGET = torch.tensor([[50.0, 0.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("n", [121, 118, 7])
def test_the_score_of_a_fixed_wing_is_its_miss_where_it_crosses_the_plane(n):
    """A straight flight through (50, 0.3, -0.4), whether a step ends on the plane or not."""
    flown = straight((0.0, 0.0, 0.0), (70.0, 0.42, -0.56), n=n)
    error, success = make_task("fixed_wing").score(TARGET, flown)
    assert error.item() == pytest.approx(0.5)
    assert success.item()


def test_only_the_first_crossing_counts():
    flown = straight((0.0, 0, 0), (60.0, 1.2, 0), (40.0, 9, 0), (70.0, 9, 0))
    error, success = make_task("fixed_wing").score(TARGET, flown)
    assert error.item() == pytest.approx(1.0)
    assert success.item()


def test_a_plane_never_crossed_is_a_failure():
    assert not make_task("fixed_wing").score(TARGET, straight((0.0, 0, 0), (49.9, 0, 0)))[1].item()


def test_to_leave_the_line_is_a_failure_before_the_target_and_none_behind_it():
    task = make_task("fixed_wing")
    away = straight((0.0, 0, 0), (25.0, 21.0, 0), (40.0, 0, 0), (60.0, 0, 0))
    behind = straight((0.0, 0, 0), (60.0, 0, 0), (80.0, 0, 0), (90.0, 30.0, 0))
    assert not task.score(TARGET, away)[1].item()
    assert task.score(TARGET, behind)[1].item()


def test_the_distance_of_a_fixed_wing_is_that_to_the_line():
    task, state = make_task("fixed_wing"), torch.zeros(3, 13).double()
    state[:, 0], state[:, 1], state[:, 2] = 30.0, torch.tensor([3.0, 12.0, 16.0]), torch.tensor([4.0, 16.0, 12.1])
    targets = TARGET.expand(3, 3)
    assert task.distance(targets, None, state)[:2].tolist() == pytest.approx([5, 20])
    assert task.diverged(targets, None, state).tolist() == [False, False, True]
    skew = torch.tensor([[30.0, 40.0, 0.0]], dtype=torch.float64)
    on_line = torch.zeros(1, 13).double()
    on_line[0, :3] = torch.tensor([15.0 - 4, 20.0 + 3, 0])
    assert task.distance(skew, None, on_line).item() == pytest.approx(5)


def test_a_fixed_wing_arrives_at_the_plane_of_its_target():
    state = torch.zeros(3, 13)
    state[:, 0] = torch.tensor([49.9, 50.0, 50.1])
    assert make_task("fixed_wing").arrived(TARGET.expand(3, 3), None, state).tolist() == [False, True, True]


def test_a_task_flies_the_system_it_is_given():
    for system in (replace(CartPole(), pole_mass=0.2), replace(Quadrotor(), mass=1.0), replace(FixedWing(), mass=2.0)):
        assert make_task(system).system == system
        assert make_task(system.name).system == make_system(system.name)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_an_unknown_set_is_refused_and_the_known_ones_are_named(name):
    with pytest.raises(InputError, match="--set bogus: expected one of ") as refused:
        make_task(name, "bogus")
    assert all(known in str(refused.value) for known in make_task(name).sets)
