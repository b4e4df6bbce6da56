"""Cases of the audit: drawn from all that a target may be, physical, the same for the same seed."""

import re

import numpy as np
import pytest

from adapt import audit_targets
from adapt.audit_targets import MOST_CHANGES, STRENGTHS, draw, draw_target, parameters
from envs.domains import NOISE, PICTURE, parse_target
from envs.errors import InputError
from envs.registry import SYSTEMS, make_system

pytestmark = pytest.mark.parametrize("system", SYSTEMS)


def drawn(system, count=300):
    return [draw(system, index, seed=0) for index in range(count)]


def test_every_name_that_a_target_knows_is_drawn_from(system):
    robot = make_system(system)
    with pytest.raises(InputError) as refusal:
        parse_target("nothing_like_it=1", robot)
    known = set(re.search("expected one of (.*)", str(refusal.value)).group(1).split(", "))
    assert set(parameters(robot)) == known - {"noise", *PICTURE}
    generator = np.random.default_rng(0)
    found = {item.partition("=")[0] for _ in range(600) for item in draw_target(robot, generator).split()}
    assert found == set(parameters(robot))


def test_a_case_depends_on_its_system_seed_and_index_alone(system):
    assert draw(system, 7, 3) == draw(system, 7, 3)
    others = {draw(name, index, seed).chance for name in SYSTEMS for index in (7, 8) for seed in (3, 4)}
    assert len(others) == 4 * len(SYSTEMS)


def test_about_a_tenth_of_the_cases_differ_in_nothing_and_half_of_the_others_in_several_things(system):
    counts = np.array([len([item for item in case.target.split() if "noise=" not in item]) for case in drawn(system)])
    assert 0.05 < (counts == 0).mean() < 0.15
    assert 0.35 < (counts == 1).mean() < 0.55
    assert counts.max() == MOST_CHANGES


def test_three_tenths_of_the_cases_are_noisy_and_three_tenths_are_spoilt_in_every_way_there_is(system):
    cases = drawn(system)
    assert 0.22 < np.mean(["noise=" in case.target for case in cases]) < 0.38
    assert 0.22 < np.mean([bool(case.spoilt) for case in cases]) < 0.38
    ways = set(audit_targets.SPOILS) - ({"swapped"} if len(make_system(system).Action._fields) == 1 else set())
    assert {case.spoilt for case in cases} == {"", *ways}


def test_transitions_are_log_uniform_between_10_and_2000(system):
    counts = np.array([case.transitions for case in drawn(system)])
    assert counts.min() >= 10 and counts.max() <= 2000
    assert 110 < np.median(counts) < 185, "the geometric mean of both ends is 141"


def test_the_noise_of_a_case_is_told_and_is_what_its_target_has(system):
    case = next(case for case in drawn(system) if "noise=" in case.target)
    deviations = parse_target(case.target, make_system(system)).deviations(make_system(system))
    assert deviations[0] == pytest.approx(case.row["noise"] * NOISE["position"])
    assert 0.3 <= case.row["noise"] <= 1.5


def test_strengths_reach_from_next_to_nothing_to_severe(system):
    robot, generator = make_system(system), np.random.default_rng(1)
    drags = np.array([float(audit_targets.strength(robot, "drag", generator)) for _ in range(300)])
    assert drags.max() <= STRENGTHS["drag"] and drags.max() > 0.8 and 0 < drags.min() < 0.015
    pushes = [audit_targets.strength(robot, "push", generator) for _ in range(300)]
    sizes = [np.linalg.norm([float(part) for part in push.split(",")]) for push in pushes]
    assert 0.02 < min(sizes) < 0.06 and 2.5 < max(sizes) <= STRENGTHS["push"] * 1.001
    factors = np.array([float(audit_targets.strength(robot, "mass", generator)[1:]) for _ in range(300)])
    assert 0.5 <= factors.min() < 0.6 and 1.7 < factors.max() <= 2 and 0.4 < (factors > 1).mean() < 0.6


def test_what_a_target_refuses_is_drawn_again(system, monkeypatch):
    drawn_first = iter(["x-1", "x1.5"])
    monkeypatch.setattr(audit_targets, "strength", lambda *_: next(drawn_first))
    monkeypatch.setattr(audit_targets, "parameters", lambda robot: ("mass",))
    monkeypatch.setattr(audit_targets, "UNCHANGED", 0.0)
    monkeypatch.setattr(audit_targets, "SINGLE", 1.0)
    assert draw_target(make_system(system), np.random.default_rng(0)) == "mass=x1.5"


def test_a_stale_record_comes_from_a_target_that_differs(system):
    stale = [case for case in drawn(system) if case.spoilt == "stale"]
    assert stale and all(case.other and 0.1 <= case.share <= 0.9 for case in stale)
    assert all(case.other in case.corruption for case in stale)


def test_actions_that_are_mislabelled_are_named(system):
    names = make_system(system).Action._fields
    for case in drawn(system):
        assert len(case.columns) == len(set(case.columns)) == {"swapped": 2, "flipped": 1}.get(case.spoilt, 0)
        assert all(names[column] in case.corruption for column in case.columns)
