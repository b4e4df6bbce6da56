"""The audit as a command: a row for each case, nothing done twice, nothing lost."""

import math

import pytest

from adapt import audit
from adapt.audit import COLUMNS, PICTURE, TABLE, add, read
from adapt.audit_targets import draw


def row(system="quadrotor", index=0, seed=0, **changes):
    """A row as a case makes it."""
    made = dict.fromkeys(COLUMNS, 1.0) | draw(system, index, seed).row
    text = {"kind": "linear", "parameters": "", "unit": "m", "reason": "better", "commit": "abc"}
    made |= {"episodes": 20, "accepted": True, "refused_data": "", "crash": "", "python": "3.11.0", **text}
    made |= dict.fromkeys(("oracle_error", "oracle_success"))
    return made | changes


@pytest.fixture
def carried_out(monkeypatch):
    """Cases that were carried out, as (system, index), in place of processes; `changes` go into their rows."""

    class Engine(list):
        changes = {}  # noqa: RUF012

        def __call__(self, system, index, root):
            self.append((system, index))
            found = self.changes.get((system, index), {})
            return row(system, index, **({"oracle_error": 1.0, "oracle_success": 1.0} if self.oracle else {}), **found)

        def stop(self):
            pass

    engine = Engine()

    def begin(seed, episodes, oracle):
        engine.oracle = oracle
        return engine

    monkeypatch.setattr(audit, "Processes", begin)
    return engine


def test_every_system_gets_its_targets_and_each_case_a_row(call, carried_out, tmp_path):
    answer = call("audit", "--targets", 3, "--jobs", 1, "--out", tmp_path)
    assert answer.status == 0
    wanted = {(system, index) for system in ("cartpole", "quadrotor", "fixed_wing") for index in range(3)}
    assert set(carried_out) == wanted and len(carried_out) == 9
    table = read(tmp_path)
    assert set(zip(table.system, table["index"].astype(int), strict=True)) == wanted
    assert (tmp_path / PICTURE).is_file()
    assert "worse, with the gate" in answer.out


def test_cases_that_are_there_are_left_out_and_more_targets_are_added(call, carried_out, tmp_path):
    arguments = ("--system", "cartpole", "--jobs", 1, "--out", tmp_path)
    call("audit", "--targets", 2, *arguments)
    call("audit", "--targets", 4, *arguments)
    assert carried_out == [("cartpole", index) for index in range(4)]


def test_a_case_that_crashed_is_tried_again(call, carried_out, tmp_path):
    carried_out.changes = {("cartpole", 1): {"crash": "ValueError: broken"}}
    arguments = ("--targets", 2, "--system", "cartpole", "--jobs", 1, "--out", tmp_path)
    answer = call("audit", *arguments)
    assert answer.status == 0 and "ValueError: broken" in answer.out
    carried_out.changes = {}
    call("audit", *arguments)
    assert carried_out == [("cartpole", 0), ("cartpole", 1), ("cartpole", 1)]
    assert read(tmp_path).crash.tolist() == ["", ""]


def test_cases_without_an_oracle_are_done_again_where_one_is_asked_for(call, carried_out, tmp_path):
    arguments = ("--targets", 1, "--system", "cartpole", "--jobs", 1, "--out", tmp_path)
    for options, times in (((), 1), (("--oracle",), 2), (("--oracle",), 2), ((), 2)):
        assert call("audit", *arguments, *options).status == 0
        assert len(carried_out) == times


def test_an_interrupted_audit_keeps_what_is_done_and_goes_on(call, carried_out, tmp_path):
    arguments = ("--targets", 3, "--system", "cartpole", "--jobs", 1, "--out", tmp_path)
    whole = audit.add

    def add_and_interrupt(folder, row):
        whole(folder, row)
        if row["index"] == 1:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(audit, "add", add_and_interrupt)
        answer = call("audit", *arguments)
    assert answer.status == 130
    assert str(tmp_path / TABLE) in answer.errors[-1]
    assert "1" in read(tmp_path)["index"].tolist()
    assert call("audit", *arguments).status == 0
    assert read(tmp_path)["index"].tolist() == ["0", "1", "2"]


def test_the_summary_alone_flies_nothing(call, carried_out, tmp_path):
    add(tmp_path, row())
    before = (tmp_path / TABLE).read_bytes()
    answer = call("audit", "--summary", "--out", tmp_path)
    assert answer.status == 0 and not carried_out
    assert (tmp_path / TABLE).read_bytes() == before and (tmp_path / PICTURE).is_file()


def test_a_row_survives_being_written_and_takes_the_place_of_an_older_one(tmp_path):
    reason = 'worse, in "the fit"\nand more'
    add(tmp_path, row(index=10, ratio=math.inf, reason=reason))
    add(tmp_path, row(index=9))
    add(tmp_path, row(index=9, ratio=0.25))
    table = read(tmp_path)
    assert table["index"].tolist() == ["9", "10"], "in the order of numbers"
    assert table.ratio.tolist() == ["0.25", "inf"] and table.reason[1] == reason
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_rows_of_another_seed_stay(call, carried_out, tmp_path):
    add(tmp_path, row(system="cartpole", seed=5))
    call("audit", "--targets", 1, "--system", "cartpole", "--jobs", 1, "--out", tmp_path)
    assert read(tmp_path).seed.tolist() == ["0", "5"]


def test_cases_of_another_seed_are_not_reported_on(call, tmp_path):
    for seed in (4, 5, 5):
        add(tmp_path, row(system="cartpole", seed=seed, index=seed))
    add(tmp_path, row(system="quadrotor", seed=4))
    answer = call("audit", "--summary", "--seed", 5, "--out", tmp_path)
    assert "cartpole" in answer.out and "quadrotor" not in answer.out


@pytest.mark.parametrize("option", ["targets", "episodes", "jobs"])
def test_numbers_below_1_are_refused(refused, option, tmp_path):
    assert f"--{option} 0: expected at least 1" in refused("audit", f"--{option}", 0, "--out", tmp_path)


def test_an_unknown_system_is_refused(refused, tmp_path):
    assert "--system bicycle: expected one of" in refused("audit", "--system", "bicycle", "--out", tmp_path)


def test_cases_of_other_test_episodes_are_not_mixed(refused, tmp_path):
    add(tmp_path, row(episodes=5))
    assert "has cases of --episodes 5; name another folder" in refused("audit", "--targets", 1, "--out", tmp_path)


def test_a_summary_of_nothing_and_a_table_of_something_else_are_refused(refused, tmp_path):
    assert "there are no cases of --seed 0; leave out" in refused("audit", "--summary", "--out", tmp_path)
    add(tmp_path, row(seed=5))
    assert "of --seed 1, only of 5;" in refused("audit", "--summary", "--seed", 1, "--out", tmp_path)
    (tmp_path / TABLE).write_text("system,error\nquadrotor,1\n")
    assert "has no column index" in refused("audit", "--summary", "--out", tmp_path)


@pytest.mark.slow
def test_a_case_is_carried_out_in_a_process_and_one_that_dies_is_a_crash(tmp_path, monkeypatch):
    engine = audit.Processes(0, 2, False)
    found = engine("cartpole", 4, tmp_path)
    assert found["crash"] == "" and found["ratio"] <= 1.05 and found["target"] == draw("cartpole", 4, 0).target
    monkeypatch.setattr(audit, "_child", math.hypot)  # can't take a pipe, so the process ends with status 1
    died = engine("cartpole", 5, tmp_path)
    assert died["crash"] == "the process of the case ended with status 1"
    assert died["target"] == draw("cartpole", 5, 0).target
