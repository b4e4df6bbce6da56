"""Flight logs: simulated flights come back as they were flown, and impossible rows are found, one by one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from adapt import mappings
from adapt.control_periods import BLIND, MEMORY, held_command, window_means
from adapt.log_cleaning import REASONS, reject
from adapt.log_rows import convert, rotation_matrices
from adapt.logs import flight_transitions, read_flight
from adapt.mappings import MAPPINGS, find_mappings
from envs.dynamics import Dynamics
from envs.errors import InputError
from envs.vehicles import load_vehicle

VEHICLE = load_vehicle("crazyflie")
PROMPT = replace(VEHICLE, motors=replace(VEHICLE.motors, thrust_delay=0.0))
REAL = Path(__file__).parents[3] / "shared" / "data" / "nanobench"
needs_real_flights = pytest.mark.skipif(not REAL.is_dir(), reason="the NanoBench flights are not here")
COLUMNS = ["px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "p", "q", "r"]
FITTING = ["B2_circle_slow_rep1", "B2_circle_slow_rep2", "B3_figure8_medium_rep1", "B3_figure8_medium_rep2"]
UNSEEN = ["B7_oval_medium_rep1", "B9_trefoil_slow_rep1"]


def commands_for(thrust, vehicle=VEHICLE):
    """Motor commands (N,) that give a collective thrust per mass (N,): the thrust curve solved for the command."""
    c0, c1, c2 = vehicle.motors.thrust_curve
    force = thrust * vehicle.system.mass / 4
    return (-c1 + np.sqrt(c1 * c1 - 4 * c2 * (c0 - force))) / (2 * c2)


def simulated(actions, period=0.01, delay=0.0):
    """A log table of a flight with these actions (K, 4), each held for a control period, and its states (K + 1, 13)."""
    system = VEHICLE.system
    per_action = round(system.dt / period)
    fine = Dynamics(replace(system, dt=period), substeps=2)
    state = torch.tensor([0.0, 0, 1, 1, 0, 0, 0, 0.3, 0, 0, 0, 0, 0], dtype=torch.float64)
    states = [state]
    for action in torch.as_tensor(actions).repeat_interleave(per_action, 0):
        states.append(fine(states[-1], action))
    states = torch.stack(states).numpy()
    held = np.concatenate((np.repeat(actions, per_action, 0), actions[-1:]))
    thrust = (system.thrust_max + system.thrust_min) / 2 + (system.thrust_max - system.thrust_min) / 2 * held[:, 0]
    thrust = np.concatenate((thrust[round(delay / period) :], np.full(round(delay / period), thrust[-1])))
    table = pd.DataFrame(states, columns=COLUMNS)
    table.insert(0, "t", np.arange(len(states)) * period)
    for i in range(1, 5):
        table[f"motor{i}"] = commands_for(thrust)
    table["vbat"] = 3.7
    return table, states[::per_action]


def hovering(seconds=2.0):
    """A log table of a hover 1 m up."""
    time = np.arange(round(seconds / 0.01) + 1) * 0.01
    motors = {f"motor{i}": commands_for(np.full(len(time), VEHICLE.system.gravity)) for i in range(1, 5)}
    resting = dict.fromkeys(COLUMNS, 0.0) | {"pz": 1.0, "qw": 1.0}
    return pd.DataFrame({"t": time, **resting, **motors, "vbat": 3.7})


def written(tmp_path, table, name="flight.csv"):
    path = tmp_path / name
    table.to_csv(path, index=False)
    return path


def some_actions(n=12, seed=0):
    generator = np.random.default_rng(seed)
    return np.array(VEHICLE.system.trim_action) + generator.uniform(-0.25, 0.25, (n, 4))


def test_a_simulated_flight_comes_back_as_it_was_flown(tmp_path):
    actions = some_actions()
    table, states = simulated(actions, period=0.002)
    flight = read_flight(written(tmp_path, table), PROMPT)
    first = round(MEMORY / VEHICLE.system.dt)
    np.testing.assert_allclose(flight.state, states[first:-1], atol=1e-9)
    np.testing.assert_allclose(flight.next_state, states[first + 1 :], atol=1e-9)
    np.testing.assert_allclose(flight.action, actions[first:], atol=0.01)  # a step between two rows is read as a ramp


def test_the_model_predicts_the_transitions_of_its_own_flight(tmp_path):
    table, _ = simulated(some_actions(), period=0.002)
    flight = read_flight(written(tmp_path, table), PROMPT)
    model = Dynamics(VEHICLE.system, substeps=20)
    predicted = model(torch.tensor(flight.state), torch.tensor(flight.action)).numpy()
    assert np.abs(predicted - flight.next_state)[:, 7:10].max() < 0.01
    assert np.abs(predicted - flight.next_state)[:, :7].max() < 0.001
    still = np.abs(flight.next_state - flight.state)[:, 7:10].max()
    assert still > 0.1


def test_states_follow_each_other_within_a_run(tmp_path):
    flight = read_flight(written(tmp_path, simulated(some_actions())[0]), VEHICLE)
    np.testing.assert_array_equal(flight.state[1:], flight.next_state[:-1])
    np.testing.assert_allclose(np.linalg.norm(flight.state[:, 3:7], axis=1), 1, atol=1e-12)


def test_the_sign_of_a_logged_quaternion_does_not_matter(tmp_path):
    table, _ = simulated(some_actions(), period=0.004)
    plain = read_flight(written(tmp_path, table), VEHICLE)
    table.loc[table.index % 2 == 1, ["qw", "qx", "qy", "qz"]] *= -1
    np.testing.assert_allclose(read_flight(written(tmp_path, table), VEHICLE).state, plain.state, atol=1e-12)


def test_motor_commands_logged_ahead_of_their_thrust_are_moved_back(tmp_path):
    actions = some_actions()
    table, _ = simulated(actions, period=0.002, delay=0.05)
    first = round(MEMORY / VEHICLE.system.dt)
    late = read_flight(written(tmp_path, table), VEHICLE)
    np.testing.assert_allclose(late.action[:, 0], actions[first:, 0], atol=0.01)
    prompt = read_flight(written(tmp_path, table), PROMPT)
    assert np.abs(prompt.action[:-1, 0] - actions[first:-1, 0]).max() > 0.03


def test_logged_rate_commands_are_used_as_they_are(tmp_path):
    actions = some_actions()
    table, _ = simulated(actions, period=0.002)
    limits = [VEHICLE.system.rate_limit_x, VEHICLE.system.rate_limit_y, VEHICLE.system.rate_limit_z]
    held = np.concatenate((np.repeat(actions, 50, 0), actions[-1:]))[:, 1:] * limits
    table[["pd", "qd", "rd"]] = held
    (tmp_path / "own.toml").write_text(OWN + 'rate_commands = {columns = ["pd", "qd", "rd"], unit = "rad/s"}')
    table[["p", "q", "r"]] += 0.3  # a wrong gyroscope no longer matters to the action
    flight = read_flight(written(tmp_path, table), PROMPT, tmp_path / "own.toml")
    np.testing.assert_allclose(flight.action[:, 1:], actions[3:, 1:], atol=0.005)


def test_a_held_command_gives_the_mean_rate_of_a_first_order_loop():
    start, command, gain, dt = 0.7, -0.4, 12.0, 0.1
    time = np.linspace(0, dt, 20001)
    rates = command + (start - command) * np.exp(-gain * time)
    mean = np.trapezoid(rates, time) / dt
    assert held_command(mean, start, gain, dt) == pytest.approx(command, abs=1e-6)


def test_window_means_are_exact_for_lines_between_uneven_rows():
    time = np.array([0.0, 0.03, 0.05, 0.12, 0.2, 0.31])
    knots = np.array([0.01, 0.11, 0.21, 0.31])
    values = np.stack((2 * time + 1, np.full_like(time, 4.0)), 1)
    middles = (knots[1:] + knots[:-1]) / 2
    np.testing.assert_allclose(window_means(time, values, knots), np.stack((2 * middles + 1, 4 + 0 * middles), 1))


# ------------------------------------------------------------------------------------------------- impossible rows


def spoiled(table, row, change):
    table = table.copy()
    for column, value in change.items():
        table.loc[row, column] = value
    return table


PLANTED = {
    "not a number": {"vy": np.nan},
    "motor command out of range": {"motor3": 65536.0},
    "quaternion not of unit length": {"qw": 0.5},
    "body rate beyond the sensor": {"q": -300.0},
    "speed beyond the plausible": {"vx": 25.0},
    "voltage out of range": {"vbat": 2.0},
}


@pytest.mark.parametrize("reason", PLANTED)
def test_an_impossible_row_is_rejected_for_its_reason_and_no_other_row_is(reason):
    table = spoiled(hovering(), 77, PLANTED[reason])
    rows = convert(table, MAPPINGS["motors"], VEHICLE, "log")
    reasons = reject(rows, VEHICLE, 0.05)
    assert np.flatnonzero(reasons >= 0).tolist() == [77]
    assert REASONS[reasons[77]] == reason


@pytest.mark.parametrize("reason", PLANTED)
def test_no_transition_spans_a_rejected_row(tmp_path, reason):
    table = spoiled(hovering(), 77, PLANTED[reason])
    clean, dirty = (read_flight(written(tmp_path, t), VEHICLE) for t in (hovering(), table))
    assert dirty.report.rejected == {**dict.fromkeys(REASONS, 0), reason: 1}
    assert (clean.report.trajectories, dirty.report.trajectories) == (1, 2)
    assert dirty.report.transitions < clean.report.transitions
    np.testing.assert_allclose(dirty.state, clean.state[: len(dirty.state)], atol=1e-6)  # a hover: all states are equal
    np.testing.assert_allclose(dirty.action, clean.action[: len(dirty.action)], atol=1e-6)


def test_negative_motor_commands_and_infinite_numbers_are_rejected():
    table = spoiled(spoiled(hovering(), 40, {"motor1": -2.5e6}), 60, {"pz": np.inf})
    reasons = reject(convert(table, MAPPINGS["motors"], VEHICLE, "log"), VEHICLE, 0.05)
    assert {i: REASONS[reasons[i]] for i in np.flatnonzero(reasons >= 0)} == {
        40: "motor command out of range",
        60: "not a number",
    }


@pytest.mark.parametrize("thrust", [-0.1, 80.0])
def test_an_impossible_logged_thrust_is_rejected(thrust):
    table = hovering().assign(thrust=9.81)
    table.loc[50, "thrust"] = thrust
    reasons = reject(convert(table, MAPPINGS["thrust"], VEHICLE, "log"), VEHICLE, 0.05)
    assert {i: REASONS[reasons[i]] for i in np.flatnonzero(reasons >= 0)} == {50: "thrust out of range"}


def test_time_that_stands_still_or_jumps_breaks_the_run(tmp_path):
    still = hovering()
    still.loc[80, "t"] = still.loc[79, "t"]
    report = read_flight(written(tmp_path, still), VEHICLE).report
    assert {k: v for k, v in report.rejected.items() if v} == {"time stands still": 1}
    jumping = hovering()
    jumping.loc[80:, "t"] += 60.0
    report = read_flight(written(tmp_path, jumping), VEHICLE).report
    assert {k: v for k, v in report.rejected.items() if v} == {"time jumps": 1}
    assert report.trajectories == 2
    assert report.seconds < 2
    back = hovering()
    back.loc[80:, "t"] -= 0.5
    assert read_flight(written(tmp_path, back), VEHICLE).report.rejected["time stands still"] == 1


def test_a_text_cell_is_not_a_number(tmp_path):
    table = hovering().astype(object)
    table.loc[90, "motor2"] = "oops"
    report = read_flight(written(tmp_path, table), VEHICLE).report
    assert report.rejected["not a number"] == 1


def test_a_clean_log_loses_nothing(tmp_path):
    report = read_flight(written(tmp_path, hovering()), VEHICLE).report
    assert sum(report.rejected.values()) == 0
    assert report.ground == 0
    assert report.rows == 201
    assert report.unused == round(MEMORY / 0.01)
    assert report.transitions == 17
    assert report.seconds == pytest.approx(1.7)


def test_rows_on_the_ground_are_cut_before_and_after_the_flight(tmp_path):
    resting = hovering(1.0).iloc[:-1]
    resting = resting.assign(pz=0.02, **{f"motor{i}": 0.0 for i in range(1, 5)})
    climb = hovering(0.5).iloc[:-1].assign(vz=0.98 / 0.5)
    climb["pz"] = 0.02 + 0.98 / 0.5 * climb.t
    table = pd.concat((resting, climb, hovering(1.0).iloc[:-1], resting), ignore_index=True)
    table["t"] = np.arange(len(table)) * 0.01
    flight = read_flight(written(tmp_path, table), VEHICLE)
    grounded = (table.pz <= 0.32).sum()
    assert flight.report.ground == grounded > 200
    assert flight.state[:, 2].min() > 0.32
    assert sum(flight.report.rejected.values()) == 0


def test_actions_beyond_the_limits_are_counted_and_kept(tmp_path):
    strong = np.tile(VEHICLE.system.trim_action, (8, 1))
    strong[5, 1] = 1.4
    table, _ = simulated(strong, period=0.002)
    flight = read_flight(written(tmp_path, table), PROMPT)
    assert flight.report.beyond_limits == 1
    assert flight.action[2, 1] == pytest.approx(1.4, abs=0.01)


def test_the_report_is_a_table_of_what_happened(tmp_path):
    text = str(read_flight(written(tmp_path, spoiled(hovering(), 77, {"motor3": -1.0})), VEHICLE).report)
    assert "flight.csv (motors)" in text
    assert "rejected: motor command out of range" in text
    assert "speed" not in text
    assert len({len(line) for line in text.splitlines()[1:]}) == 1


# ------------------------------------------------------------------------------------------------- context


def test_the_context_is_the_force_that_the_model_lacks(tmp_path):
    table = hovering()
    for i in range(1, 5):
        table[f"motor{i}"] = commands_for(np.full(len(table), 12.0))
    flight = read_flight(written(tmp_path, table), VEHICLE)
    assert flight.context_names == ("voltage", "force_x", "force_y", "force_z")
    np.testing.assert_allclose(flight.context, np.tile([3.7, 0, 0, 9.81 - 12.0], (len(flight.state), 1)), atol=1e-6)


def test_the_context_knows_nothing_of_what_comes_after(tmp_path):
    table = simulated(some_actions(20))[0]
    later = table.t > 1.2 + 1e-9
    changed = table.copy()
    changed.loc[later, ["vx", "vz", "vbat"]] += [0.5, -0.5, 0.3]
    one, other = (read_flight(written(tmp_path, t), VEHICLE) for t in (table, changed))
    before = np.arange(len(one.state)) * 0.1 + MEMORY <= 1.2 + BLIND  # not even of the moment before the period
    np.testing.assert_array_equal(one.context[before], other.context[before])
    assert np.abs(one.context[~before] - other.context[~before]).max() > 0.1


def test_a_log_without_battery_has_no_voltage(tmp_path):
    flight = read_flight(written(tmp_path, hovering().drop(columns="vbat")), VEHICLE)
    assert flight.context_names == ("force_x", "force_y", "force_z")
    assert flight.report.mapping == "motors_only"


# ------------------------------------------------------------------------------------------------- mappings

OWN = """
time = {columns = ["t"], unit = "s"}
position = {columns = ["px", "py", "pz"], unit = "m"}
attitude = {columns = ["qw", "qx", "qy", "qz"]}
velocity = {columns = ["vx", "vy", "vz"], unit = "m/s"}
rates = {columns = ["p", "q", "r"], unit = "rad/s"}
motors = {columns = ["motor1", "motor2", "motor3", "motor4"]}
"""
FOREIGN = """
axes = "z-down"
time = {columns = ["stamp"], unit = "ms"}
position = {columns = ["n", "e", "d"], unit = "cm"}
attitude = {columns = ["x", "y", "z", "w"], order = "xyzw"}
velocity = {columns = ["forward", "right", "down"], unit = "m/s", frame = "body"}
rates = {columns = ["roll", "pitch", "yaw"], unit = "deg/s", frame = "world"}
thrust = {columns = ["force"], unit = "mN"}
voltage = {columns = ["cell"], unit = "mV"}
"""


def test_another_lab_s_units_frames_and_order_give_the_same_transitions(tmp_path):
    table, _ = simulated(some_actions(), period=0.005)
    flip = np.array([1, -1, -1])
    rotation = rotation_matrices(table[COLUMNS[3:7]].to_numpy())
    body_velocity = np.einsum("nji,nj->ni", rotation, table[COLUMNS[7:10]].to_numpy())
    world_rates = np.einsum("nij,nj->ni", rotation, table[COLUMNS[10:]].to_numpy())
    system = VEHICLE.system
    force = 4 * VEHICLE.motors.force(table.motor1) * 1e3
    foreign = pd.DataFrame({"stamp": table.t * 1e3, "force": force, "cell": 3700.0})
    foreign[["n", "e", "d"]] = table[COLUMNS[:3]].to_numpy() * flip * 100
    foreign[["w", "x", "y", "z"]] = table[COLUMNS[3:7]].to_numpy() * [1, 1, -1, -1]
    foreign[["forward", "right", "down"]] = body_velocity * flip
    foreign[["roll", "pitch", "yaw"]] = np.degrees(world_rates * flip)
    (tmp_path / "foreign.toml").write_text(FOREIGN)
    ours = read_flight(written(tmp_path, table), PROMPT)
    theirs = read_flight(written(tmp_path, foreign, "foreign.csv"), PROMPT, tmp_path / "foreign.toml")
    assert system.dt == 0.1
    for part in ("state", "action", "next_state", "context"):
        np.testing.assert_allclose(getattr(theirs, part), getattr(ours, part), atol=1e-6)


def test_rows_that_lack_a_required_value_are_rejected_and_an_optional_quantity_may_be_absent(tmp_path):
    own = "require = {mode = [2, 3]}" + OWN + 'voltage = {columns = ["volts"], unit = "V", optional = true}'
    (tmp_path / "own.toml").write_text(own)
    table = hovering().assign(mode=2)
    table.loc[100:, "mode"] = 3
    table.loc[150:159, "mode"] = 4
    flight = read_flight(written(tmp_path, table), VEHICLE, tmp_path / "own.toml")
    assert {k: v for k, v in flight.report.rejected.items() if v} == {"not valid by its own flags": 10}
    assert "voltage" not in flight.context_names
    with_volts = read_flight(written(tmp_path, table.assign(volts=3.7)), VEHICLE, tmp_path / "own.toml")
    assert with_volts.context_names[0] == "voltage"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "s"', 'unit = "m"', "mapping own.toml: time: unit 'm', expected 's'"),
        ('"vx", "vy", "vz"', '"vx", "vy"', r"velocity: columns \['vx', 'vy'\], expected 3 column names"),
        ("time =", "clock =", "unknown entry 'clock'"),
        ('time = {columns = ["t"], unit = "s"}', "", "mapping own.toml: lacks time"),
        ('motors = {columns = ["motor1", "motor2", "motor3", "motor4"]}', "", "lacks motors or thrust"),
        ("attitude = {", 'attitude = {order = "zyxw", ', "attitude: order is 'zyxw', expected 'wxyz' or 'xyzw'"),
        ("velocity = {", 'velocity = {frame = "moon", ', "velocity: frame is 'moon', expected 'world' or 'body'"),
        ("position = {", 'position = {frame = "body", ', "position: unknown key 'frame'"),
        ('time = {columns = ["t"], unit = "s"}', 'time = "t"', "time is 't', expected"),
        ("time =", 'axes = "up"\ntime =', "axes is 'up', expected 'z-up' or 'z-down'"),
        (
            "velocity = {",
            "velocity = {optional = true, ",
            "own.toml: velocity: optional applies to rate_commands and voltage",
        ),
        ("time =", "require = {ok = 1}\ntime =", "mapping own.toml: require is .*, expected"),
        ("time =", "require = {pz = [7]}\ntime =", "flight.csv: pz is 1 in all rows, mapping own.toml requires 7"),
        ("time =", "require = {ok = [1]}\ntime =", "mapping own.toml needs the columns ok, which are missing"),
        ('"motor4"', '"motor9"', "flight.csv: mapping own.toml needs the columns motor9, which are missing"),
    ],
)
def test_a_wrong_mapping_is_one_line(tmp_path, old, new, message):
    assert old in OWN
    (tmp_path / "own.toml").write_text(OWN.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_flight(written(tmp_path, hovering()), VEHICLE, tmp_path / "own.toml")
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------- bad files


def test_files_that_are_no_flight_log_say_so_in_one_line(tmp_path):
    empty, text, binary = tmp_path / "empty.csv", tmp_path / "text.csv", tmp_path / "binary.csv"
    empty.write_text("")
    text.write_text("a,b\n1,2\n3,4,5,6\n")
    binary.write_bytes(bytes(range(128, 256)) * 10)
    cases = {
        tmp_path / "none.csv": "none.csv: cannot be read",
        tmp_path: "cannot be read",
        empty: "empty.csv: not a CSV file",
        text: "text.csv: not a CSV file",
        binary: "binary.csv: not a CSV file",
        written(tmp_path, hovering().iloc[:1], "short.csv"): "1 rows, a flight log needs at least 2",
        written(
            tmp_path, hovering().drop(columns="pz"), "flat.csv"
        ): "flat.csv: no built-in mapping fits; .* needs the columns pz, which are missing",
        written(tmp_path, hovering().assign(q="west"), "words.csv"): "words.csv: column q holds no number",
        written(tmp_path, hovering().iloc[:20], "brief.csv"): "no whole control period of 0.1 s left of 20 rows",
        written(tmp_path, hovering().assign(motor1=1e6), "mad.csv"): "201 motor command out of range",
        written(tmp_path, hovering().iloc[::10], "slow.csv"): "rows are 0.1 s apart, expected at most 0.05 s",
    }
    for path, message in cases.items():
        with pytest.raises(InputError, match=message) as caught:
            read_flight(path, VEHICLE)
        assert "\n" not in str(caught.value)


def test_the_mapping_to_copy_names_the_columns_that_are_recognised_anyway():
    (to_copy,) = find_mappings(Path(mappings.__file__).parent / "mapping_data" / "csv.toml")
    for name, quantity in to_copy.quantities.items():
        if name in MAPPINGS["motors"].quantities:
            assert replace(quantity, optional=False) == MAPPINGS["motors"].quantities[name]
    assert {"rate_commands", "voltage"} == {name for name, one in to_copy.quantities.items() if one.optional}


def test_an_unknown_mapping_and_a_vehicle_without_motors_are_errors(tmp_path):
    with pytest.raises(InputError, match="--mapping apm: expected auto, one of nanobench"):
        read_flight(written(tmp_path, hovering()), VEHICLE, "apm")
    with pytest.raises(InputError, match=r"vehicle crazyflie has no \[motors\] table"):
        read_flight(written(tmp_path, hovering()), replace(VEHICLE, motors=None))


def test_a_log_is_not_read_as_flight_of_an_aircraft_without_rotors(tmp_path):
    with pytest.raises(InputError, match=r"flight\.csv: flight logs are of quadrotors, j3cub is a fixed_wing"):
        read_flight(written(tmp_path, hovering()), load_vehicle("j3cub"))


# ------------------------------------------------------------------------------------------------- several flights


def test_flights_are_joined_with_trajectories_of_their_own(tmp_path):
    logs = [
        read_flight(written(tmp_path, spoiled(hovering(), 77, {"vx": 99.0})), VEHICLE),
        read_flight(written(tmp_path, hovering()), VEHICLE),
    ]
    joined = flight_transitions(logs, dtype=torch.float64)
    assert joined.trajectory.unique().tolist() == [0, 1, 2]
    assert len(joined) == sum(log.report.transitions for log in logs)
    assert joined.state.dtype == torch.float64
    assert joined.dt == VEHICLE.system.dt
    assert joined.context_names == logs[0].context_names
    np.testing.assert_array_equal(joined.state[joined.trajectory == 2].numpy(), logs[1].state)


def test_flights_that_do_not_go_together_are_refused(tmp_path):
    first = read_flight(written(tmp_path, hovering()), VEHICLE)
    without = read_flight(written(tmp_path, hovering().drop(columns="vbat")), VEHICLE)
    heavier = read_flight(written(tmp_path, hovering()), replace(VEHICLE, system=replace(VEHICLE.system, mass=0.04)))
    with pytest.raises(InputError, match="has the context force_x"):
        flight_transitions([first, without])
    with pytest.raises(InputError, match="another vehicle"):
        flight_transitions([first, heavier])
    with pytest.raises(InputError, match="no flight log"):
        flight_transitions([])


# ------------------------------------------------------------------------------------------------- real flights


def missed_acceleration(log):
    """Acceleration error of the model [m/s^2], world (M, 3)."""
    predicted = Dynamics(VEHICLE.system)(torch.tensor(log.state), torch.tensor(log.action)).numpy()
    return (log.next_state - predicted)[:, 7:10] / VEHICLE.system.dt


@needs_real_flights
def test_motor_commands_that_no_motor_can_be_given_are_counted():
    report = read_flight(REAL / "B6_linear_ramp_rep4.csv", VEHICLE).report
    assert {reason: count for reason, count in report.rejected.items() if count} == {"motor command out of range": 910}
    assert report.rows == 3224
    assert report.transitions > 150


@needs_real_flights
def test_the_data_sheet_model_misses_real_flights_by_half_a_g():
    errors = [missed_acceleration(read_flight(REAL / f"{name}.csv", VEHICLE)) for name in FITTING + UNSEEN]
    error = np.concatenate(errors)
    assert 4.8 < np.sqrt((error**2).sum(1).mean()) < 5.8
    assert np.abs(error[:, 2]).mean() > 0.95 * np.linalg.norm(error, axis=1).mean()  # nearly all of it along the thrust


@needs_real_flights
@pytest.mark.parametrize("mapping", ["nanobench", "nanobench_mocap"])
def test_context_and_attitude_explain_unseen_flights_better_than_the_plain_inputs(mapping):
    def flights(names):
        return [read_flight(REAL / f"{name}.csv", VEHICLE, mapping) for name in names]

    def body(log, vectors):
        return np.einsum("nji,nj->ni", rotation_matrices(log.state[:, 3:7]), vectors)

    def features(log, full):
        velocity, up = body(log, log.state[:, 7:10]), rotation_matrices(log.state[:, 3:7])[:, 2]
        rates, voltage = log.state[:, 10:], log.context[:, :1]
        columns = (up, rates, log.action, log.context) if full else (rates, log.action[:, :1], voltage)
        return np.concatenate((np.ones((len(velocity), 1)), velocity, *columns), 1)

    def unseen_error(full):
        fitted, unseen = flights(FITTING), flights(UNSEEN)
        inputs = np.concatenate([features(log, full) for log in fitted])
        outputs = np.concatenate([body(log, missed_acceleration(log)) for log in fitted])
        weights = np.linalg.lstsq(inputs, outputs, rcond=None)[0]
        misses = [body(log, missed_acceleration(log)) - features(log, full) @ weights for log in unseen]
        return np.sqrt((np.concatenate(misses) ** 2).sum(1).mean())

    plain, full = unseen_error(False), unseen_error(True)
    assert plain < 0.4
    assert full < 0.75 * plain
