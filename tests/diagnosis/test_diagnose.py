"""Small robots whose cause is known; the generator steps MuJoCo itself."""

import json
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.report import Report
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="link"><joint name="hinge" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass=".6"/></body>
</worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-4 4"/></actuator></mujoco>
"""
BOUNDS = {"body_mass[link]": (0.4, 0.9), "dof_damping[hinge]": (0.0, 0.2)}
FINER = 4


def system(xml=ARM):
    model = mujoco.MjModel.from_xml_string(xml)
    task = Task(model=model, frame_skip=5)
    return System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))


def commands(rng, steps):
    t = 0.01 * np.arange(steps)
    waves = [rng.normal() * np.sin(2 * np.pi * rng.uniform(0.2, 2.5) * t) for _ in range(4)]
    return np.clip(np.sum(waves, axis=0), -4, 4)


def run(rng, steps, *, act=lambda u, k: u[k], push=lambda q, v: 0.0, xml=ARM):
    """Return what a robot with another mass and damping does, measured with noise."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.body_mass[1] *= 1.1
    model.body_inertia[1] *= 1.1
    model.dof_damping[0] = 0.08
    model.opt.timestep /= FINER
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data.qpos[0] = rng.normal(scale=0.5)
    u, rows = commands(rng, steps), []
    for k in range(steps):
        rows.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = act(u, k)
        for _ in range(5 * FINER):
            data.qfrc_applied[0] = push(data.qpos[0], data.qvel[0])
            mujoco.mj_step(model, data)
    state = np.array(rows) + rng.normal(size=(steps, 2)) * [0.002, 0.02]
    return state, u


def as_log(name, state, u):
    """Return a log of positions and velocities of the arm's hinge, ``(T, 2)``."""
    return Log(
        name=name,
        time=0.01 * torch.arange(len(u)).double(),
        qpos=torch.from_numpy(state[:, :1].copy()),
        qvel=torch.from_numpy(state[:, 1:].copy()),
        ctrl=torch.from_numpy(u[:, None].copy()),
        velocity_gain=torch.zeros(1).double(),
        measured=torch.ones(2, dtype=torch.bool),
    )


def logs(count=6, steps=200, seed=0, **cause):
    rng = np.random.default_rng(seed)
    return [as_log(f"run{i}", *run(rng, steps, **cause)) for i in range(count)]


SOME = (
    "action_delay", "action_lag", "action_bias", "action_gain", "dead_band", "coulomb_friction",
    "quadratic_drag", "parallel_spring", "payload", "sensor_bias", "sensor_delay",
)  # fmt: skip


def test_a_clean_simulator_has_no_gap():
    report = diagnose(system(), None, logs(), effects=SOME)
    assert report.verdict == "none"
    assert not report.effects
    assert "No gap above noise" in str(report)
    found = {p.name: p.with_effects for p in report.parameters}
    assert found["body_mass[link]"] == pytest.approx(0.66, rel=0.02)
    assert found["dof_damping[hinge]"] == pytest.approx(0.08, rel=0.1)
    noise = report.audit["noise"]
    assert noise["hinge position"] == pytest.approx(0.002, rel=0.2)
    assert noise["hinge velocity"] == pytest.approx(0.02, rel=0.2)
    friction = next(c for c in report.candidates if c.name == "coulomb_friction")
    assert friction.status == "ruled_out"
    assert friction.minimal_detectable_strength < 0.05


def test_dry_friction_is_named_and_measured():
    data = logs(push=lambda q, v: -0.15 * np.tanh(v / 0.01))
    report = diagnose(system(), None, data, effects=SOME)
    assert report.verdict in {"named", "named_partial"}
    assert report.effects[0].name == "coulomb_friction"
    assert report.effects[0].where == "hinge"
    assert report.effects[0].strength == pytest.approx(0.15, rel=0.1)
    assert report.gap.explained_fraction > 0.9
    errors = report.gap.rollout_rmse
    assert errors["with_effects"]["hinge position"] < errors["refit"]["hinge position"] / 3
    assert [effect.name for effect in report.effects] == ["coulomb_friction"]
    assert report.where["channel"]["body"] == 1.0


def test_a_gap_that_nothing_explains_is_not_called_none():
    data = logs(push=lambda q, v: -0.05 * np.tanh(v / 0.01))  # hardly seen in the validation run
    report = diagnose(system(), None, data, effects=["quadratic_drag", "parallel_spring"])
    assert report.verdict == "unknown"
    assert not report.effects
    assert "It is real, but none of the 2 effects" in str(report)


@pytest.mark.slow
def test_a_smaller_cause_is_named_beside_a_larger_one():
    """A hundredth of what the spring explains, and 25 times the noise."""
    data = logs(push=lambda q, v: -0.2 * np.tanh(v / 0.01) - 1.5 * q)
    effects = "parallel_spring", "coulomb_friction", "constant_force", "action_bias"
    report = diagnose(system(), None, data, effects=effects)
    found = {effect.name: effect.strength for effect in report.effects}
    assert found["parallel_spring"] == pytest.approx(1.5, rel=0.1)
    assert found["coulomb_friction"] == pytest.approx(0.2, rel=0.2)


def test_a_further_cause_has_rivals_of_its_own():
    # 0.4 against one direction and a push of 0.1 would be the same: which is told is a coin's throw
    data = logs(seed=2, push=lambda q, v: 0.3 - 0.2 * np.tanh(v / 0.01))
    effects = (
        "coulomb_friction", "constant_force", "action_bias", "sensor_bias", "parallel_spring",
        "load_dependent_friction", "directional_friction",
    )  # fmt: skip
    report = diagnose(system(), None, data, effects=effects)
    first, second = report.effects
    assert (first.name, second.name) == ("action_bias", "coulomb_friction")
    assert "constant_force" in first.rivals
    assert report.confusion_set == (first.name, *first.rivals)
    assert "directional_friction" in second.rivals
    rivals = ", ".join(second.rivals).replace("_", " ")
    assert f"place of coulomb friction it may be: {rivals}." in str(report)
    assert "coulomb friction at hinge" in str(report)
    assert ", together explain " in str(report)
    assert report.gap.explained_fraction > 0.95


def test_nothing_is_ruled_out_while_something_is_missing():
    data = logs(push=lambda q, v: -0.4 * np.sin(3 * q) * np.sign(v))
    effects = "quadratic_drag", "parallel_spring", "action_bias"
    report = diagnose(system(), None, data, effects=effects)
    assert report.gap.with_effects > 1.5
    assert "ruled_out" not in {c.status for c in report.candidates}
    others = [c for c in report.candidates if c.status != "named"]
    assert {c.minimal_detectable_strength for c in others} == {None}


def test_where_there_is_no_gap_nothing_explains_it():
    report = diagnose(system(), None, logs(), effects=SOME)
    assert {c.explained_fraction for c in report.candidates} == {0.0}
    assert re.search(r"Ruled out: [a-z ]+ above [\d.e-]+ (N m|rad/s|rad|s|fraction) ", str(report))


def test_late_commands_stand_before_late_sensors_which_no_log_tells_apart():
    late = logs(act=lambda u, k: u[max(k - 2, 0)])
    for names in (["action_delay", "sensor_delay"], ["sensor_delay", "action_delay"]):
        report = diagnose(system(), None, late, effects=names)
        assert report.verdict == "named"
        assert [effect.name for effect in report.effects] == ["action_delay"]
        assert report.confusion_set == ("action_delay", "sensor_delay")
        seats = report.where["channel"]  # the first of the two counts twice
        assert seats["actuation"] == pytest.approx(2 / 3)
        assert seats["sensing"] == pytest.approx(1 / 3)
        assert not report.next_experiment


@pytest.mark.parametrize("at", [0, 3])  # of the test runs, of the training runs
def test_a_run_that_departs_alone_is_said_to(at):
    pushed, held = logs(push=lambda q, v: -0.3 * np.tanh(v / 0.01)), logs()
    report = diagnose(
        system(), None, [*held[:at], pushed[at], *held[at + 1 :]], effects=["parallel_spring"]
    )
    assert report.verdict == "unknown"
    assert f"It is real, but only in run{at}: did something happen there?" in str(report)
    assert any(alarm.startswith(f"run{at} is ") for alarm in report.alarms)


def test_a_limit_that_was_never_reached_is_asked_for_with_larger_commands(monkeypatch):
    strong = commands
    monkeypatch.setitem(globals(), "commands", lambda *args: np.clip(0.6 * strong(*args), -2, 2))
    report = diagnose(system(), None, logs(), effects=["saturation", "coulomb_friction"])
    assert report.verdict == "none"
    proposal = report.next_experiment[0]
    assert proposal["separates"] == ["saturation", "nothing"]
    assert "150 % of the recorded commands" in proposal["excitation"]
    assert proposal["expected_odds"] > 100
    assert 0 < proposal["seconds"] <= 30


def test_the_frequency_of_a_disturbance_is_found():
    clock = iter(np.tile(0.0005 * np.arange(200 * 5 * FINER), 6))

    def push(q, v):
        return 0.3 * np.sin(2 * np.pi * 1.7 * next(clock) + 0.5)

    report = diagnose(system(), None, logs(push=push), effects=(*SOME, "periodic_disturbance"))
    assert report.effects[0].name == "periodic_disturbance"
    assert report.effects[0].strength == pytest.approx(0.3, rel=0.15)
    effect = next(iter(report.strengths))
    assert effect.frequency == pytest.approx(1.7, abs=0.1)
    assert f"N m, {effect.frequency:.3g} Hz)" in report.summary
    told = json.loads(report.as_json())
    assert told["effects"][0]["form"] == effect.form
    (named,) = (c for c in told["candidates"] if c["status"] == "named")
    assert named["form"] == told["effects"][0]["form"]
    assert {k: v for k, v in told["candidates"][-1].items() if k == "form"} == {"form": {}}


@pytest.mark.slow
def test_what_a_larger_cause_hides_is_given_its_frequency_beside_it():
    data = logs(5, push=lambda q, v: 0.06 * np.sin(9 * q + 1.0) - 1.5 * q)
    effects = "parallel_spring", "cogging", "coulomb_friction", "constant_force"
    report = diagnose(system(), None, data, effects=effects)
    spring, cogging = report.effects
    assert spring.strength == pytest.approx(1.5, rel=0.02)
    assert cogging.strength == pytest.approx(0.06, rel=0.2)
    assert cogging.form["number"] == pytest.approx(9.0, rel=0.02)
    assert [c.name for c in report.candidates if c.status == "named"] == [spring.name, cogging.name]


def test_a_late_command_is_named_with_what_it_cannot_be_told_from():
    report = diagnose(system(), None, logs(act=lambda u, k: u[max(0, k - 2)]), effects=SOME)
    assert {"action_delay", "sensor_delay"} & set(report.confusion_set)
    assert report.effects[0].strength == pytest.approx(0.02, rel=0.1)


def test_a_cause_that_is_not_in_the_catalogue_is_not_named_without_reserve():
    data = logs(push=lambda q, v: -1.5 * max(q - 0.6, 0.0))
    report = diagnose(system(), None, data, effects=SOME)
    assert report.verdict in {"unknown", "named_partial", "ambiguous"}


def test_same_seed_same_report():
    data = logs(count=3)
    first, second = (diagnose(system(), None, data, effects=SOME[:4]) for _ in range(2))
    assert first.gap == second.gap
    assert first.candidates == second.candidates


def test_a_single_trajectory_is_never_a_confident_verdict():
    data = logs(count=1, steps=400, push=lambda q, v: -0.15 * np.sign(v))
    report = diagnose(system(), None, data, effects=SOME)
    assert report.verdict != "named"
    assert any("1 trajectories" in alarm for alarm in report.alarms)


def test_the_report_is_json(tmp_path):
    report = diagnose(system(), None, logs(count=3), effects=SOME[:3])
    assert isinstance(report, Report)
    report.to_json(tmp_path / "report.json")
    text = (tmp_path / "report.json").read_text(encoding="utf-8")
    assert '"schema": 1' in text
    assert "NaN" not in text


def test_no_logs_are_refused():
    with pytest.raises(ValueError, match="expected logs"):
        diagnose(system(), None, [])


def test_logs_shorter_than_a_segment_are_refused():
    with pytest.raises(ValueError, match="more than 50 rows"):
        diagnose(system(), None, logs(count=3, steps=4), horizon=50, effects=SOME[:2])


def test_unknown_effects_are_refused():
    with pytest.raises(KeyError, match="coulomb_friction"):
        diagnose(system(), None, logs(count=3, steps=40), effects=["coulomb_fricton"])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda log: replace(log, qpos=log.qpos * torch.nan), "NaN or infinity in qpos of run0"),
        (lambda log: replace(log, ctrl=log.ctrl / 0.0), "NaN or infinity in ctrl of run0"),
        (lambda log: replace(log, time=log.time.flip(0)), "whose time increases, got 'run0"),
        (
            lambda log: replace(log, time=2 * log.time),
            r"rows 0\.01 s apart, .* got '0\.02 to 0\.02",
        ),
        (lambda log: replace(log, time=log.time[:5]), r"qpos of shape \(5, 1\), got '\(30, 1\)"),
        (lambda log: replace(log, qpos=log.qpos.repeat(1, 3)), r"qpos of shape \(30, 1\), got"),
        (lambda log: replace(log, qvel=log.qvel[:9]), r"qvel of shape \(30, 1\), got '\(9, 1\) in"),
        (
            lambda log: replace(log, ctrl=log.ctrl[:, :0]),
            r"ctrl of shape \(30, 1\), got '\(30, 0\)",
        ),
        (lambda log: replace(log, measured=log.measured[:1]), r"measured of shape \(2,\), got"),
        (
            lambda log: replace(log, qpos=log.qpos.numpy()),
            "a tensor as qpos of run0, got 'ndarray'",
        ),
        (lambda log: replace(log, time=None), "a tensor as time of run0, got 'NoneType'"),
        (lambda log: replace(log, ctrl=log.ctrl.int()), "ctrl of run0 in floating-point numbers"),
    ],
)
def test_logs_made_by_hand_are_of_this_robot_finite_and_in_order(spoil, said):
    with pytest.raises((ValueError, TypeError), match=said):
        diagnose(system(), None, [spoil(log) for log in logs(count=2, steps=30)])


def test_logs_in_which_all_is_zero_say_nothing():
    still = [
        replace(log, qpos=0 * log.qpos, qvel=0 * log.qvel, ctrl=0 * log.ctrl)
        for log in logs(count=4, steps=40)
    ]
    assert diagnose(system(), None, still, effects=["action_bias"]).verdict == "not_testable"
