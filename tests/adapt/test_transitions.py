import math
import pickle

import pandas as pd
import pytest
import torch
from tensordict.nn import TensorDictModule

from adapt.flying import collect
from adapt.transitions import LARGEST, Transitions, check
from envs import make_dynamics, make_env, make_system, make_task
from envs.errors import InputError
from policies.checkpoints import load_policy


class Trim(torch.nn.Module):
    """Gives the trim action whatever it sees."""

    def __init__(self, system):
        super().__init__()
        self.action = torch.tensor(system.trim_action)

    def forward(self, observation):
        return self.action.expand(*observation.shape[:-1], -1)


def trim_actor(name):
    return TensorDictModule(Trim(make_system(name)), in_keys=["observation"], out_keys=["action"])


def flown(name="quadrotor", target="", n=30, exploration=0.3, seed=0, **task):
    env = make_env(name, target, seed=seed, episodes=20, **task)
    return collect(trim_actor(name), env, n, exploration, torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def flights():
    return flown(n=250, exploration=0.003, task="hover")


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
@pytest.mark.parametrize("n", [1, 30, 250])
def test_exactly_as_many_transitions_are_flown_as_asked_for_and_the_target_explains_them(name, n):
    data = flown(name, "mass=x1.2", n)
    assert len(data) == n
    following = make_dynamics(name, "mass=x1.2")(data.state, data.action)
    torch.testing.assert_close(following, data.next_state)
    check(data, make_system(name))


def test_whole_trajectories_count_one_after_another(flights):
    assert flights.trajectory.bincount().tolist() == [100, 100, 50]
    same = flights.trajectory[1:] == flights.trajectory[:-1]
    assert torch.equal(flights.state[1:][same], flights.next_state[:-1][same])


def test_nothing_after_the_end_of_an_episode_is_used():
    """An unstabilised pole falls: each flight ends with the state that ended it."""
    data = flown("cartpole", n=300)
    angle = data.state[:, 2].abs()
    assert len(data.trajectory.unique()) > 1
    assert float(angle.max()) <= math.radians(24)
    last = torch.cat((data.trajectory[1:] != data.trajectory[:-1], torch.tensor([False])))
    failed = (data.next_state[last, 2].abs() > math.radians(24)) | (data.next_state[last, 0].abs() > 2.4)
    assert failed.all()


def test_exploration_changes_the_actions_and_stays_in_range():
    still, lively = flown(exploration=0.0), flown(exploration=2.0)
    trim = torch.tensor(make_system("quadrotor").trim_action)
    torch.testing.assert_close(still.action, trim.expand(30, -1))
    assert lively.action.std(0).min() > 0.5
    assert lively.action.abs().max() == 1


def test_the_same_seed_flies_the_same_and_another_one_differently():
    assert torch.equal(flown(seed=3).next_state, flown(seed=3).next_state)
    assert not torch.equal(flown(seed=3).next_state, flown(seed=4).next_state)


def test_a_split_never_shares_a_trajectory():
    many = flown(n=500)
    for fraction in (0.01, 0.3, 0.8, 0.99):
        first, second = many.split(fraction, torch.Generator().manual_seed(1))
        assert not set(first.trajectory.tolist()) & set(second.trajectory.tolist())
        assert len(first) + len(second) == len(many)
        assert len(first) and len(second)


def test_a_single_trajectory_is_cut_once_in_time():
    data = flown(n=30, exploration=0.003, task="hover")
    first, second = data.split(0.8, torch.Generator())
    assert torch.equal(first.state, data.state[:24])
    assert torch.equal(second.state, data.state[24:])


@pytest.mark.parametrize("suffix", [".csv", ".safetensors"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_file_gives_back_the_same_numbers(flights, tmp_path, suffix, dtype):
    parts = {name: getattr(flights, name).to(dtype) / 3 for name in ("action",)}
    parts |= {name: getattr(flights, name).to(dtype) for name in ("state", "next_state")}
    context = torch.rand(len(flights), 1, generator=torch.Generator().manual_seed(0), dtype=dtype)
    names = (flights.state_names, flights.action_names)
    written = Transitions(
        trajectory=flights.trajectory, dt=0.1, system="quadrotor", state_names=names[0], action_names=names[1],
        context=context, context_names=("voltage",), **parts,
    )  # fmt: skip
    written.save(tmp_path / f"data{suffix}")
    read = Transitions.load(tmp_path / f"data{suffix}", make_system("quadrotor"))
    for name in ("state", "action", "next_state", "trajectory", "context"):
        assert getattr(read, name).dtype == getattr(written, name).dtype
        assert torch.equal(getattr(read, name), getattr(written, name))
    for name in ("dt", "system", "state_names", "action_names", "context_names"):
        assert getattr(read, name) == getattr(written, name)
    assert [path.name for path in tmp_path.iterdir()] == [f"data{suffix}"]


def test_a_csv_says_what_it_holds_and_pandas_reads_it(flights, tmp_path):
    flights.save(tmp_path / "data.csv")
    table = pd.read_csv(tmp_path / "data.csv", comment="#")
    assert list(table.columns[:5]) == ["trajectory", "step", "px", "py", "pz"]
    assert {"action_thrust", "next_vx"} <= set(table.columns)
    assert table["step"].tolist()[98:102] == [98, 99, 0, 1]
    assert "system=quadrotor; dt=0.1 s" in (tmp_path / "data.csv").read_text().splitlines()[0]


def test_a_csv_made_by_hand_takes_system_and_period_from_what_is_expected(flights, tmp_path):
    flights.save(tmp_path / "data.csv")
    lines = (tmp_path / "data.csv").read_text().splitlines()[1:]
    (tmp_path / "hand.csv").write_text("\n".join(lines))
    read = Transitions.load(tmp_path / "hand.csv", make_system("quadrotor"))
    assert (read.system, read.dt) == ("quadrotor", 0.1)
    assert torch.equal(read.state, flights.state)
    with pytest.raises(InputError, match=r"hand\.csv: the first line names no system"):
        Transitions.load(tmp_path / "hand.csv")


def edit(change):
    """A change of the cells of a CSV as a change of its text; rows count from 0 at the header."""

    def edited(text):
        lines = [line.split(",") for line in text.splitlines()[1:]]
        change(lines)
        return "\n".join([text.splitlines()[0], *(",".join(line) for line in lines)])

    return edited


def put(row, column, value):
    def change(lines):
        lines[row][lines[0].index(column)] = value

    return edit(change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(0, "next_vx", "speed"), "no column next_vx; expected trajectory, px"),
        (put(0, "trajectory", "flight"), "no column trajectory"),
        (put(3, "vx", "fast"), "row 5: vx is 'fast', expected a finite number"),
        (put(3, "next_vx", "nan"), "row 5: next_vx is 'nan', expected a finite number"),
        (put(3, "action_thrust", ""), "row 5: action_thrust is '', expected a finite number"),
        (edit(lambda lines: lines[4].pop()), "row 6: next_r is '', expected a finite number"),
        (put(3, "qw", "0.5"), "transition 3: qw, qx, qy, qz of state have length"),
        (lambda text: text.replace("dt=0.1", "dt=0.05"), "control period is 0.05 s, expected 0.1 s"),
        (lambda text: text.replace("dt=0.1", "dt=short"), "dt is 'short s'"),
        (lambda text: text.replace("system=quadrotor", "system=fixed_wing"), "recorded on fixed_wing"),
        (lambda text: "\n".join(text.splitlines()[:7]), "5 transitions, at least 10 are needed"),
        (lambda text: "", "empty"),
        (lambda text: text.splitlines()[0], "empty"),
    ],
)
def test_a_wrong_csv_is_refused_in_one_line(flights, tmp_path, change, message):
    path = tmp_path / "data.csv"
    flights.save(path)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as caught:
        Transitions.load(path, make_system("quadrotor"), minimum=10)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_missing_binary_or_of_another_kind_is_refused(flights, tmp_path):
    with pytest.raises(InputError, match="can't read transitions"):
        Transitions.load(tmp_path / "none.csv")
    with pytest.raises(InputError, match="can't read transitions"):
        Transitions.load(tmp_path / "none.safetensors")
    with pytest.raises(InputError, match=r"unknown kind of file '\.pkl'; expected one of \.csv, \.safetensors"):
        flights.save(tmp_path / "data.pkl")
    for name in ("data.csv", "data.safetensors"):
        (tmp_path / name).write_bytes(pickle.dumps({"state": [1.0] * 100}) + b"\xff\xfe")
        with pytest.raises(InputError, match="not a"):
            Transitions.load(tmp_path / name)


def test_a_place_that_cannot_be_written_is_refused_and_nothing_half_written_stays(flights, tmp_path):
    with pytest.raises(InputError, match="can't write"):
        flights.save(tmp_path / "missing" / "data.csv")
    (tmp_path / "data.csv").mkdir()
    with pytest.raises(InputError, match="can't write"):
        flights.save(tmp_path / "data.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["data.csv"]


def test_shapes_that_do_not_fit_are_refused(flights):
    with pytest.raises(InputError, match="action is"):
        Transitions(
            flights.state, flights.action[:, :3], flights.next_state, flights.trajectory, 0.1, "quadrotor",
            flights.state_names, flights.action_names,
        )  # fmt: skip


@pytest.mark.parametrize(("n", "exploration"), [(0, 0.0), (5, -1.0), (5, math.nan)])
def test_nonsense_is_not_flown(n, exploration):
    with pytest.raises(InputError, match="collect"):
        flown(n=n, exploration=exploration)


def test_flight_beyond_all_bounds_is_not_recorded():
    """With half the inertia about x the rate control is unstable, and numbers grow until the quaternion is 0."""
    policy, target = load_policy("quadrotor"), make_dynamics("quadrotor", "inertia_x=x0.5379 inertia_y=x1.15")
    recorded = collect(policy.actor(), (target, policy.task, policy.task.episodes(20, "train", 0)), 100)
    assert recorded.next_state.abs().max() < LARGEST
    check(recorded, policy.task.system)


def test_joined_parts_keep_their_trajectories_apart():
    from adapt.transitions import joined

    states = torch.arange(5.0).unsqueeze(-1).expand(-1, 4)
    trajectory = torch.tensor([3, 3, 4, 4, 4])
    names = (make_system("cartpole").State._fields, make_system("cartpole").Action._fields)
    part = Transitions(states, states[:, :1], states + 1, trajectory, 0.05, "cartpole", *names)
    both = joined((part, part))
    assert both.trajectory.tolist() == [0, 0, 1, 1, 1, 2, 2, 3, 3, 3]
    assert torch.equal(both.next_state, torch.cat((part.next_state, part.next_state)))


def errors(name, true, seen):
    """What leads from true to measured states, in units of the preset of noise."""
    system = make_system(name)
    x, y = (system.State(*part.double().unbind(-1)) for part in (true, seen))
    deviations = torch.tensor(make_dynamics(system, "noise=1").noise, dtype=torch.float64)
    return torch.stack(system.difference(x, y), -1) / deviations


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_where_sensors_err_what_they_say_is_recorded_of_the_same_flights(name):
    """An actor that looks at nothing flies the same with noise as without, so that the true states are known."""
    exact, noisy = (flown(name, target, 500, 0.1) for target in ("drag=0.3", "drag=0.3 noise=1"))
    for key in ("action", "trajectory"):
        assert torch.equal(getattr(exact, key), getattr(noisy, key))
    for key in ("state", "next_state"):
        error = errors(name, getattr(exact, key), getattr(noisy, key))
        assert ((error.std(0) - 1).abs() < 5 / math.sqrt(2 * 500)).all()
        assert (error.mean(0).abs() < 5 / math.sqrt(500)).all()
    check(noisy, make_system(name))


@pytest.mark.parametrize("name", ["cartpole", "quadrotor", "fixed_wing"])
def test_where_sensors_err_each_recorded_state_is_the_one_that_the_step_before_ended_with(name):
    data = flown(name, "noise=1", 300)
    same = data.trajectory[1:] == data.trajectory[:-1]
    assert same.sum() > 200
    assert torch.equal(data.state[1:][same], data.next_state[:-1][same])


def test_what_a_policy_does_follows_from_the_states_that_are_recorded():
    task = make_task("quadrotor")
    columns = torch.randn(15, 4, generator=torch.Generator().manual_seed(2)) / 15

    def act(observation):
        return (observation @ columns).tanh()

    actor = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])
    data = collect(actor, make_env("quadrotor", "noise=1", episodes=5), 150)
    torch.testing.assert_close(data.action, act(task.observe(data.state)))


def test_flights_of_another_seed_and_later_flights_of_the_same_have_noise_of_their_own():
    first, other = (flown(target="noise=1", task="hover", exploration=0.0, seed=seed) for seed in (0, 1))
    exact = flown(task="hover", exploration=0.0)  # hovering, whatever the seed
    correlation = (errors("quadrotor", exact.state, first.state) * errors("quadrotor", exact.state, other.state)).mean()
    assert abs(float(correlation)) < 5 / math.sqrt(30 * 12)
    assert torch.equal(flown(target="noise=1", task="hover", exploration=0.0).state, first.state)
    env = make_env("quadrotor", "noise=1", "hover")  # one and the same, with a seed of its own
    again = [
        collect(trim_actor("quadrotor"), env, 30, generator=torch.Generator().manual_seed(seed)).state
        for seed in (0, 1, 0)
    ]
    assert torch.equal(again[0], again[2])
    assert not torch.equal(again[0], again[1])
    later = flown(target="noise=1", task="hover", n=200, exploration=0.0)
    assert not torch.equal(later.state[:100], later.state[100:])
