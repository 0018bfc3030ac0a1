"""The diagnosis from its command line, as users run it: a one-joint arm, good and bad input."""

import json

import numpy as np
import pytest
from one_joint_arm import ARM, FRICTION, SYSTEM, describe, diagnose, motion, save


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of a diagnosis of an arm with dry friction, and what it printed."""
    folder = tmp_path_factory.mktemp("rubbing")
    describe(folder)
    for run in range(4):
        save(folder / f"logs/run{run}.csv", motion(run, friction=FRICTION))
    return folder, diagnose(folder)


def test_the_cause_is_named_in_the_line_before_the_result(finished):
    _, printed = finished
    *_, sentence, last = printed.splitlines()
    name, _, text = last.partition(" ")
    result = json.loads(text)
    assert name == "RESULT"
    assert sentence == result["summary"]
    assert "coulomb friction at hinge" in sentence


def test_the_result_has_what_others_read(finished):
    folder, _ = finished
    result = json.loads((folder / "report/result.json").read_text())
    report = json.loads((folder / "report/report.json").read_text())
    assert {k: v for k, v in result.items() if k != "provenance"} == report
    assert report["schema"] == 1
    assert report["verdict"] in {"named", "named_partial"}
    assert report["effects"][0]["name"] == "coulomb_friction"
    assert report["effects"][0]["strength"] == pytest.approx(FRICTION, rel=0.1)
    assert report["confusion_set"][0] == "coulomb_friction"
    assert report["gap"]["with_effects"] < report["gap"]["refit"]
    assert report["gap"]["horizon_steps"] == 20
    assert {c["name"] for c in report["candidates"]} == {
        *("coulomb_friction", "action_bias", "action_gain")
    }
    used = [*report["audit"]["train"], *report["audit"]["validation"], *report["audit"]["test"]]
    assert sorted(used) == [f"run{run}.csv" for run in range(4)]
    assert {"commit", "versions", "seed", "command", "machine", "seconds"} <= result[
        "provenance"
    ].keys()


def test_the_page_tells_the_same(finished):
    folder, printed = finished
    page = (folder / "report/report.html").read_text()
    assert printed.splitlines()[-2] in page
    assert page.count("<section>") == 9


def test_the_same_seed_gives_the_same_report(finished):
    folder, _ = finished
    diagnose(folder, "out=again")
    first, second = (
        json.loads((folder / name / "report.json").read_text()) for name in ("report", "again")
    )
    for report in (first, second):
        del report["audit"]["seconds"]
    assert first == second


def test_logs_can_be_left_out(finished):
    folder, _ = finished
    diagnose(folder, "out=fewer", "leave_out=run3")
    report = json.loads((folder / "fewer/report.json").read_text())
    used = [*report["audit"]["train"], *report["audit"]["validation"], *report["audit"]["test"]]
    assert sorted(used) == [f"run{run}.csv" for run in range(3)]


def test_what_the_gate_finds_is_printed_and_in_the_report(finished, tmp_path):
    describe(tmp_path)
    for run in range(4):
        rows = motion(run)
        if run == 2:
            rows[40][1] = float("nan")
        save(tmp_path / f"logs/run{run}.csv", rows)
    printed = diagnose(tmp_path, "spoilt=leave_out")
    finding = "warning: run2.csv rows 40 to 40: 1 row(s) with values that are missing"
    assert finding in printed
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert any(alarm.startswith(finding) for alarm in report["alarms"])
    assert report["verdict"] == "none"


def test_malformed_logs_end_in_one_message_that_names_all_of_it(refused, tmp_path):
    for run in range(4):
        rows = np.array(motion(run))
        if run == 1:
            rows[40, 1] = np.nan
        if run in {0, 2}:
            rows[:, 0] *= 1e3
        save(tmp_path / f"logs/run{run}.csv", rows.tolist())
    line = refused()
    assert (
        "run1.csv rows 40 to 40: 1 row(s) with values that are missing or beyond 1e8 (missing)"
        in line
    )
    assert "run0.csv rows 0 to 159: rows are 10 s apart" in line
    assert "(time_unit; so run2.csv)" in line
    assert "spoilt=leave_out" in line


def test_a_push_is_no_fault_of_the_logs(tmp_path):
    describe(tmp_path)
    for run in range(4):
        rows = motion(run, push=9.0 if run == 1 else 0.0)
        save(tmp_path / f"logs/run{run}.csv", rows)
    assert "hinge is pushed by more than" in diagnose(tmp_path)


def test_a_single_trajectory_gives_an_alarm_and_no_confident_verdict(tmp_path):
    describe(tmp_path)
    save(tmp_path / "logs/run.csv", motion(0, rows=400, friction=FRICTION))
    diagnose(tmp_path)
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert report["verdict"] != "named"
    assert any("single trajectory" in alarm for alarm in report["alarms"])


def test_an_arm_at_rest_says_nothing(tmp_path):
    describe(tmp_path)
    still = np.random.default_rng(0).standard_normal((4, 160, 2)) * (0.001, 0.02)
    for run, values in enumerate(still):
        rows = [[0.01 * k, q, qd, 0.0] for k, (q, qd) in enumerate(values)]
        save(tmp_path / f"logs/run{run}.csv", rows)
    assert "the action motor never changes" in diagnose(tmp_path)
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert report["verdict"] == "not_testable"


@pytest.fixture
def refused(tmp_path, capsys):
    """Return what runs the recipe and returns the one line that it ends with."""
    describe(tmp_path)
    save(tmp_path / "logs/run0.csv", motion(0))

    def refuse(*arguments):
        with pytest.raises(SystemExit, match="2"):
            diagnose(tmp_path, *arguments)
        (line,) = capsys.readouterr().err.splitlines()
        assert not (tmp_path / "report/result.json").is_file()
        return line

    return refuse


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("system=''", "expected system=PATH, got 'none'"),
        ("data=''", "expected data=PATH, got 'none'"),
        ("system=nowhere.yaml", "expected a file to read"),
        ("data=nowhere", "expected a folder or file of logs, got 'nowhere'"),
        ("effects=coulomb", "expected an effect of the catalogue, got 'coulomb'"),
        ("horizon=-1", "expected a horizon of 1 or more, or 0 to choose one, got -1"),
        ("horizon=200", "160 control steps in succession can be used, 201 are needed"),
        ("leave_out=run7", "a part of a log's name to leave out, got 'run7'. Available: run0.csv"),
        ("spoilt=keep", "spoilt, got 'keep'. Available: refuse, leave_out"),
        ("leave_out=run", "expected logs beside those left out, got 'none'"),
        ("sytem=robot.yaml", "system (did you mean this?)"),
    ],
)
def test_bad_settings_are_explained(argument, said, refused):
    assert said in refused(argument)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("qpos: {hinge: q}", "qpos: {hinges: q}"), "a joint in columns.qpos, got 'hinges'"),
        (("motor: tau", "motor: torque"), "'torque'"),
        (("motor: tau", "engine: tau"), "an actuator in columns.ctrl, got 'engine'"),
        (("body_mass[link]", "body_mass[arm]"), "a body, got 'arm'. Available: world, link"),
        (("[0.3, 0.8]", "[0.8, 0.3]"), "low"),
        (("noise: {q: 0.001", "noise: {p: 0.001"), "a channel in noise, got 'p'"),
        (("control_dt: 0.01", "control_dt: 0.003"), "0.003"),
        (("simulator: robot.xml", "simulator: robots.xml"), "robots.xml"),
    ],
)
def test_a_wrong_description_is_explained(change, said, refused, tmp_path):
    old, new = change
    assert old in SYSTEM
    describe(tmp_path, system=SYSTEM.replace(old, new))
    assert said in refused()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], "a header and rows in run0.csv"),
        ([["0", "zero", "0", "0"]], "a number in row 0, column 'q' of run0.csv, got 'zero'"),
        ([["0", "0", "0"]], "4 cells in row 0 of run0.csv"),
        ([[0.01 * k, "nan", 0, 0] for k in range(160)], "expected logs that can be used"),
        ([[0.0, 0, 0, 0]] * 160, "expected logs that can be used"),
        (motion(0, rows=9), "9 control steps in succession can be used"),
    ],
)
def test_a_malformed_log_is_explained(rows, said, refused, tmp_path):
    save(tmp_path / "logs/run0.csv", rows)
    assert said in refused()


@pytest.mark.parametrize("name", ["report.html", "report.json", "result.json", "settings.json"])
def test_what_cannot_be_written_is_said_and_nothing_is_half_written(name, refused, tmp_path):
    (tmp_path / "report" / name).mkdir(parents=True)
    assert f"expected a file to write, got '{tmp_path}/report/{name}" in refused()
    left = {path.name for path in (tmp_path / "report").iterdir()}
    whole = {"report.html", "report.json"} if name.startswith(("result", "settings")) else set()
    assert left == {name} | whole


def test_an_empty_folder_is_explained(refused, tmp_path):
    (tmp_path / "logs/run0.csv").unlink()
    assert "expected a folder with CSV or Parquet files" in refused()


def test_a_simulator_that_diverges_is_never_believed(tmp_path):
    spring = '<joint name="hinge" axis="0 1 0" stiffness="1e9"/>'
    arm = ARM.replace('<joint name="hinge" axis="0 1 0" damping="0.02"/>', spring)
    describe(tmp_path, arm=arm.replace('timestep="0.005"', 'timestep="0.005" integrator="RK4"'))
    for run in range(4):
        save(tmp_path / f"logs/run{run}.csv", motion(run))
    diagnose(tmp_path)
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert report["verdict"] in {"unknown", "not_testable"}
