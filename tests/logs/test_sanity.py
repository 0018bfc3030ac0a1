"""The gate lets clean logs pass, of whatever robot, and names what is spoilt."""

import copy
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.finding import Finding
from torchrl_bayessim.logs.inverse_dynamics import dynamics
from torchrl_bayessim.logs.record import Record
from torchrl_bayessim.logs.sanity import check, refuse_spoilt, usable_logs
from torchrl_bayessim.logs.simulators import simulator_task
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay import Replay

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0"/>
      <body name="lower" pos="0 0 -.3">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m1" joint="shoulder" ctrlrange="-3 3"/>
    <motor name="m2" joint="elbow" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


FAST = """
<mujoco>
  <option timestep="0.002"/>
  <default><geom contype="0" type="capsule"/></default>
  <worldbody>
    <body>
      <joint name="j1" axis="0 1 0" damping="0.1" armature="0.01"/>
      <geom fromto="0 0 0 0 0 -.4" size=".03" mass="1.2"/>
      <body pos="0 0 -.4">
        <joint name="j2" axis="0 1 0" damping="0.06" armature="0.005"/>
        <geom fromto="0 0 0 0 0 -.35" size=".025" mass=".8"/>
        <body pos="0 0 -.35">
          <joint name="j3" axis="1 0 0" damping="0.03" armature="0.003"/>
          <geom fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="j1" ctrlrange="-8 8"/>
    <motor joint="j2" ctrlrange="-3 3"/>
    <motor joint="j3" ctrlrange="-.5 .5"/>
  </actuator>
</mujoco>
"""


def arm(xml):
    """A model at 100 Hz."""
    return Task(model=mujoco.MjModel.from_xml_string(xml), frame_skip=5)


SYSTEMS = {
    "hopper": (lambda: known_task("Hopper-v5"), "body_mass[torso]"),
    "arm": (
        lambda: Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=5),
        "body_mass[upper]",
    ),
    "cartpole": (lambda: simulator_task("dm_control:cartpole/swingup", None, None), "body_mass[1]"),
}

SWING = {"swing": (lambda: arm(FAST), "body_mass[1]")}
WITH_IMPACTS = {"half_cheetah": (lambda: known_task("HalfCheetah-v5"), "body_mass[torso]")}


@cache
def simulated(name, *, count=6, steps=300, noise=(1e-3, 1e-2), seed=0):
    """Simulate logs under random smooth actions and a mass that is not the nominal one."""
    make, mass = (SYSTEMS | SWING | WITH_IMPACTS)[name]
    task = make()
    model = task.model
    rng = np.random.default_rng(seed)
    low, high = model.actuator_ctrlrange.T
    knots = rng.uniform(low, high, size=(count, steps // 10 + 1, model.nu))
    ctrl = 0.8 * knots.repeat(10, axis=1)[:, :steps]
    start = {
        "qpos": torch.from_numpy(np.tile(model.qpos0, (count, 1))),
        "qvel": torch.from_numpy(0.1 * rng.normal(size=(count, model.nv))),
        "action": torch.from_numpy(ctrl),
    }
    theta = 1.3 * torch.tensor([[float(model.body_mass[1])]])
    out = Replay(task, start, physics=MujocoPhysics(mass), threads=1)(theta)
    qpos = torch.cat([start["qpos"][:, None], out["qpos"][0]], 1)[:, :steps].numpy()
    qvel = torch.cat([start["qvel"][:, None], out["qvel"][0]], 1)[:, :steps].numpy()
    records = [
        Record(
            name=f"{i}.csv",
            time=task.dt * np.arange(steps),
            qpos=qpos[i] + noise[0] * rng.normal(size=qpos[i].shape),
            qvel=qvel[i] + noise[1] * rng.normal(size=qvel[i].shape),
            ctrl=ctrl[i],
        )
        for i in range(count)
    ]
    return System(task=task), records


def kinds(findings, severity="error"):
    return {finding.kind for finding in findings if finding.severity == severity}


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("noise", [(0.0, 0.0), (1e-3, 1e-2), (1e-2, 2e-1)])
def test_clean_logs_pass(name, noise):
    system, records = simulated(name, noise=noise)
    findings = check(records, system)
    assert not kinds(findings), findings[0]
    assert kinds(findings, "warning") <= {"range"}
    assert [len(log) for log in usable_logs(records, system, findings)] == [300] * 6


@pytest.mark.parametrize("name", SYSTEMS)
def test_clean_logs_without_velocities_pass(name):
    system, records = simulated(name)
    system = System(task=system.task, columns=replace(system.columns, qvel={}))
    records = [replace(record, qvel=np.full_like(record.qvel, np.nan)) for record in records]
    findings = check(records, system)
    assert not kinds(findings), findings[0]


@pytest.mark.parametrize("noise", [(0.0, 0.0), (1e-3, 1e-2)])
def test_impacts_within_a_control_step_are_left_out_and_not_refused(noise):
    system, records = simulated("half_cheetah", noise=noise)
    findings = check(records, system)
    assert kinds(findings) <= {"position_jump", "velocity_spike"}
    refuse_spoilt(findings)
    assert sum(len(log) for log in usable_logs(records, system, findings)) > 1500


def test_what_many_units_would_mend_is_no_matter_of_units():
    """Rotors that the model lacks, in closed loop, slowly in some logs and fast in others."""
    found = set()
    for seed, noise in [*((seed, 0.0) for seed in range(6)), (6, 1e-3)]:
        records = followed(armature=0.1, seed=seed, noise=noise)
        findings = check(records, System(task=arm(ARM)))
        found |= {finding.kind for finding in findings}
    assert not found & {"motion_scale", "motion_sign", "action_scale", "action_sign"}


def followed(*, armature, seed, noise=0.0):
    """An arm that follows waves of six speeds."""
    model, rng, records = arm(ARM).model, np.random.default_rng(seed), []
    model.dof_armature[:] = armature
    time = 0.01 * np.arange(300)
    for speed in range(1, 7):
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = 0.7 * rng.uniform(-1, 1, model.nq)
        for t in time:
            data.ctrl[:] = 8.0 * (0.8 * np.sin(speed * t) - data.qpos) - 0.5 * data.qvel
            qpos = data.qpos + noise * rng.normal(size=2)
            rows.append((qpos, data.qvel + 10 * noise * rng.normal(size=2), data.ctrl.copy()))
            mujoco.mj_step(model, data, 5)
        qpos, qvel, ctrl = (np.array(column) for column in zip(*rows, strict=True))
        records.append(Record(name=f"{speed}.csv", time=time, qpos=qpos, qvel=qvel, ctrl=ctrl))
    return records


def test_quantised_logs_pass():
    system, records = simulated("arm")
    rounded = [
        replace(r, qpos=np.round(r.qpos / 2e-3) * 2e-3, qvel=np.round(r.qvel / 0.05) * 0.05)
        for r in records
    ]
    findings = check(rounded, system)
    assert not kinds(findings), findings[0]


def repeat(record):
    """Show a tenth of the samples twice."""
    rows = np.arange(300)
    rows[1:] -= np.random.default_rng(0).random(299) < 0.1
    return replace(record, qpos=record.qpos[rows], qvel=record.qvel[rows])


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize(
    "effect",
    [
        repeat,
        lambda r: replace(r, ctrl=np.roll(r.ctrl, 3, axis=0)),
        lambda r: replace(r, ctrl=2 * r.ctrl),
        lambda r: replace(r, qpos=r.qpos + 0.1, qvel=1.2 * r.qvel),
        lambda r: replace(r, qvel=r.qvel[np.maximum(np.arange(300) - 2, 0)]),
    ],
)
def test_what_a_diagnosis_is_for_is_no_error(name, effect):
    system, records = simulated(name)
    findings = check([effect(record) for record in records], system)
    assert not kinds(findings), findings[0]


def spoilt(change, *, only=None, name="arm"):
    """Return findings after ``change(record)`` of all records, or of number ``only``."""
    system, records = simulated(name)
    records = [change(r) if only in (None, i) else r for i, r in enumerate(records)]
    return check(records, system), records, system


def times(record, factor_q=1.0, factor_v=1.0, factor_u=1.0):
    return replace(
        record,
        qpos=factor_q * record.qpos,
        qvel=factor_v * record.qvel,
        ctrl=factor_u * record.ctrl,
    )


DEGREES = 180 / np.pi


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda r: times(r, factor_q=DEGREES), "velocity_scale"),
        (lambda r: times(r, factor_v=DEGREES), "velocity_scale"),
        (lambda r: times(r, factor_v=100.0), "velocity_scale"),
        (lambda r: times(r, factor_q=1e7), "velocity_scale"),
        (lambda r: times(r, factor_v=-1), "velocity_sign"),
        (lambda r: times(r, factor_u=-1), "action_sign"),
        (lambda r: replace(r, time=1e3 * r.time), "time_unit"),
        (lambda r: replace(r, time=1e3 * r.time / 12), "time_unit"),  # of a logger that is faster
    ],
)
def test_units_and_signs(change, kind):
    findings, records, system = spoilt(change)
    assert kind in kinds(findings)
    with pytest.raises(ValueError, match="logs that can be used"):
        usable_logs(records, system, findings)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(
    ("factors", "kind", "said"),
    [
        ((DEGREES, 1.0), "motion_scale", "in degrees?"),
        ((0.5 / np.pi, 1.0), "motion_scale", "in turns?"),
        ((200 / np.pi, 1.0), "motion_scale", "in gradians?"),
        ((1e3, 1.0), "motion_scale", "in thousandths?"),
        ((2048 / np.pi, 1.0), "motion_scale", "too large by a factor of about"),  # an encoder's
        ((0.02, 1.0), "motion_scale", "too small by a factor of about"),
        ((-1.0, 1.0), "motion_sign", "of opposite sign"),
        ((1.0, 1e-3), "action_scale", "in thousands?"),
        ((1.0, 1e3), "action_scale", "in thousandths?"),  # which the model would clip
        ((1.0, 50.0), "action_scale", "m1 and m2 too large by a factor of about"),
        ((1.0, 0.0), "no_actions", "were actions recorded?"),
    ],
)
def test_one_log_in_other_units_is_named(velocities, factors, kind, said):
    system, records = simulated("arm")
    if not velocities:
        system = System(task=system.task, columns=replace(system.columns, qvel={}))
    motion, actions = factors
    changed = times(records[2], factor_q=motion, factor_v=motion, factor_u=actions)
    records = [*records[:2], changed, *records[3:]]
    if not velocities:
        records = [replace(r, qvel=np.full_like(r.qvel, np.nan)) for r in records]
    findings = check(records, system)
    (found,) = [f for f in findings if f.severity == "error"]
    assert (found.file, found.kind) == ("2.csv", kind)
    assert said in found.message


@pytest.mark.parametrize(("factor", "kind"), [(DEGREES, "motion_scale"), (-1.0, "motion_sign")])
def test_half_of_the_logs_may_be_odd(factor, kind):
    system, records = simulated("arm")
    for i in 1, 3, 5:
        records = [*records]
        records[i] = times(records[i], factor_q=factor, factor_v=factor)
    found = [f for f in check(records, system) if f.severity == "error"]
    assert {(f.file, f.kind) for f in found} == {(f"{i}.csv", kind) for i in (1, 3, 5)}


@pytest.mark.parametrize(
    ("factor", "kind"), [(-1.0, "motion_sign"), (1e3, "action_scale")]
)  # another sign of the actions looks as one of the motion
def test_units_may_change_within_a_log(factor, kind):
    system, records = simulated("arm", steps=600)
    changing = np.where(np.arange(600) < 350, 1.0, factor)[:, None]
    changed = replace(records[2], ctrl=changing * records[2].ctrl)
    findings = check([*records[:2], changed, *records[3:]], system)
    (found,) = [f for f in findings if f.severity == "error"]
    assert (found.file, found.kind, found.rows[1]) == ("2.csv", kind, 599)
    assert found.rows[0] == pytest.approx(350, abs=10)
    assert len(usable_logs([changed], system, findings)[0]) == found.rows[0]


FLAG = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="hinge"/></actuator>
</mujoco>
"""


def flags(count=4, rows=300):
    """Return logs of an arm that gravity turns one way, held about the level it points along."""
    model, time, records = arm(FLAG).model, 0.01 * np.arange(rows), []
    for i in range(count):
        data, found = mujoco.MjData(model), []
        for t in time:
            waves = np.sin((2.0 + i) * t) + 0.5 * np.sin((5.0 + i) * t + i)
            data.ctrl[:] = -1.5 - 3.0 * data.qpos + waves
            found.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
            mujoco.mj_step(model, data, 5)
        qpos, qvel, ctrl = (np.array(column) for column in zip(*found, strict=True))
        records.append(Record(name=f"{i}.csv", time=time, qpos=qpos, qvel=qvel, ctrl=ctrl))
    return System(task=arm(FLAG)), records


def test_signs_of_motion_and_actions_differ_where_gravity_turns_one_way():
    system, records = flags()
    assert not kinds(check(records, system))
    findings = check([*records[:2], times(records[2], factor_u=-1), records[3]], system)
    (found,) = [f for f in findings if f.severity == "error"]
    assert (found.file, found.kind) == ("2.csv", "action_sign")
    assert found.message.startswith("m of opposite sign? Only so does hinge move")


def test_an_action_holds_until_the_next_row():
    system, (record, *_) = flags()
    log = usable_logs([record], system, [])[0]
    needed, actuated, _, speed = dynamics(system.task.model, record, log, 5).terms(0)
    left = needed - actuated + 0.2 * speed
    assert left.std() < 0.01 * actuated.std()


def test_a_slide_in_millimetres_lies_beyond_its_limits():
    def millimetres(record):
        return times(record, factor_q=np.array([1e3, 1.0]), factor_v=np.array([1e3, 1.0]))

    findings, *_ = spoilt(millimetres, only=2, name="cartpole")
    (found,) = [f for f in findings if f.severity == "error"]
    assert (found.file, found.kind) == ("2.csv", "motion_scale")
    assert "slider position and slider velocity in thousandths" in found.message


@pytest.mark.parametrize("name", ["arm", "cartpole"])
def test_a_log_far_from_the_others_is_named(name):
    findings, *_ = spoilt(lambda r: replace(r, qpos=r.qpos + 1e6), only=2, name=name)
    found = [f for f in findings if f.kind == "offset"]
    assert found
    assert {(f.file, f.severity) for f in found} == {("2.csv", "error")}
    assert "is 1e+06 from where it is in other logs" in found[0].message


def swinging(seed, *, rows=250):
    """Return a log of a light pole that strikes the ends of its range, at every few steps."""
    task = known_task("InvertedPendulum-v5")
    model, rng = copy.copy(task.model), np.random.default_rng(seed)
    model.body_mass[:] *= 0.6
    waves = [(rng.normal(), rng.uniform(0.2, 2.5)) for _ in range(4)]
    times = task.dt * np.arange(rows)
    ctrl = 3 * np.clip(sum(a * np.sin(2 * np.pi * f * times) for a, f in waves), -1, 1)
    data, states = mujoco.MjData(model), []
    for u in ctrl:
        states.append(np.r_[data.qpos, data.qvel])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, task.frame_skip)
    noise = rng.normal(size=(rows, 4)) * [1e-3, 1e-3, 0.01, 0.01]
    qpos, qvel = np.split(np.array(states) + noise, 2, 1)
    name = f"{seed}.csv"
    return Record(name=name, time=times, qpos=qpos, qvel=qvel, ctrl=ctrl[:, None])


def test_velocities_that_jump_at_a_limit_are_the_positions_own():
    system = System(task=known_task("InvertedPendulum-v5"))
    for seed in range(20):
        findings = check([swinging(seed)], system)
        assert "velocity_mismatch" not in kinds(findings, "error"), seed


def test_two_logs_tell_which_of_them_is_odd():
    system, records = simulated("arm")
    findings = check([times(records[0], factor_q=-1, factor_v=-1), records[1]], system)
    assert {f.file for f in findings if f.severity == "error"} == {"0.csv"}


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda r: times(r, factor_u=1e-3), "action_scale"),
        (lambda r: times(r, factor_u=10), "action_range"),
        (lambda r: times(r, factor_v=1.4), "velocity_scale"),
        (lambda r: replace(r, qvel=np.roll(r.qvel, 4, axis=0)), "velocity_lag"),
        (lambda r: replace(r, ctrl=np.ones_like(r.ctrl)), "constant_action"),
        (lambda r: replace(r, qpos=np.round(r.qpos, 1)), "resolution"),
    ],
)
def test_what_to_know(change, kind):
    findings, *_ = spoilt(change)
    assert kind in kinds(findings, "warning")


def test_actions_that_no_controller_sends_are_refused():
    findings, *_ = spoilt(lambda r: times(r, factor_u=1e3))
    assert "action_range" in kinds(findings, "error")


def test_what_is_short_for_another_reason_is_told_last():
    findings = [
        Finding(kind=kind, file="a", rows=(0, 9), message=kind, severity="error")
        for kind in ("short", "time", "degrees")
    ]
    with pytest.raises(ValueError, match=r"degrees .*\| .*time .*\| .*short"):
        refuse_spoilt(findings)


def edited(record, rows, **columns):
    """Set rows of the first coordinate."""
    copies = {name: getattr(record, name).copy() for name in columns}
    for name, value in columns.items():
        part = copies[name][rows] if copies[name].ndim == 1 else copies[name][rows, 0]
        new = value(part) if callable(value) else value
        if copies[name].ndim == 1:
            copies[name][rows] = new
        else:
            copies[name][rows, 0] = new
    return replace(record, **copies)


@pytest.mark.parametrize(
    ("change", "kind", "rows"),
    [
        (lambda r: edited(r, slice(100, 101), qpos=lambda q: q + 0.5), "position_jump", (100, 100)),
        (lambda r: edited(r, slice(50, 51), qvel=lambda v: v + 8.0), "velocity_spike", (50, 50)),
        (lambda r: edited(r, slice(120, 180), qpos=lambda q: q[0]), "frozen", (125, 170)),
        (lambda r: edited(r, slice(0, 300), qpos=0.3), "frozen", (0, 299)),
        (lambda r: edited(r, slice(80, 81), time=lambda t: t - 0.305), "backward_time", (80, 80)),
        (lambda r: edited(r, slice(80, 81), time=lambda t: t - 0.01), "repeated_time", (80, 80)),
        (lambda r: edited(r, slice(80, 81), time=np.nan), "not_finite_time", (80, 80)),
    ],
)
def test_rows_are_named_and_left_out(change, kind, rows):
    findings, records, system = spoilt(change, only=2)
    (found,) = [f for f in findings if f.kind == kind and f.severity == "error"]
    assert found.file == "2.csv"
    assert found.rows[0] <= rows[0]
    assert found.rows[1] >= rows[1]
    logs = usable_logs(records, system, findings)
    left = sum(len(log) for log in logs if log.name.startswith("2.csv"))
    assert left <= 300 - (rows[1] - rows[0] + 1)
    assert sum(len(log) for log in logs) >= 5 * 300


@pytest.mark.parametrize(
    ("change", "kind", "rows"),
    [
        (lambda r: edited(r, slice(7, 9), ctrl=np.nan), "missing", (7, 8)),
        (lambda r: replace(r, time=r.time + 0.2 * (r.time > 1)), "gap", (100, 101)),
    ],
)
def test_rows_that_can_be_known_to_be_missing(change, kind, rows):
    findings, *_ = spoilt(change, only=1)
    (found,) = [f for f in findings if f.kind == kind]
    assert (found.file, found.rows, found.severity) == ("1.csv", rows, "warning")


def test_jumps_of_a_turn_are_undone():
    system, records = simulated("arm")
    wrapped = [replace(r, qpos=(r.qpos - 0.05) % (2 * np.pi) + 0.05) for r in records]
    findings = check(wrapped, system)
    assert not kinds(findings), findings[0]
    assert "wrap" in kinds(findings, "warning")
    for log, record in zip(usable_logs(wrapped, system, findings), records, strict=True):
        shift = log.qpos.numpy() - record.qpos
        np.testing.assert_allclose(shift, np.tile(shift[0], (300, 1)), atol=1e-9)


def test_repeated_samples_and_jitter():
    rng = np.random.default_rng(0)
    findings, *_ = spoilt(repeat)
    assert "repeated_samples" in kinds(findings, "warning")
    findings, *_ = spoilt(lambda r: replace(r, time=r.time + 0.004 * rng.random(300)))
    assert "jitter" in kinds(findings, "warning")


def test_a_push_is_found_and_friction_is_not_a_push():
    task = SYSTEMS["arm"][0]()
    task.model.dof_frictionloss[:] = 0.2
    system, records = simulated("arm")
    findings = check(records, system)
    assert "push" not in kinds(findings)
    with_friction = System(task=task)
    assert "push" not in kinds(check(records, with_friction))
    pushed = _pushed_arm(rows=range(150, 160), force=8.0)
    found = [f for f in check([pushed, *records], system) if f.kind == "push"]
    assert found
    assert {f.file for f in found} == {"pushed.csv"}
    assert all(140 <= f.rows[0] <= f.rows[1] <= 170 for f in found)


def _pushed_arm(*, rows, force):
    model = SYSTEMS["arm"][0]().model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    columns = {"time": [], "qpos": [], "qvel": [], "ctrl": []}
    for t in range(300):
        data.ctrl[:] = rng.uniform(-0.8, 0.8, 2) if t % 10 == 0 else data.ctrl
        data.qfrc_applied[0] = force if t in rows else 0.0
        for name, column in columns.items():
            column.append(np.copy(getattr(data, name)))
        mujoco.mj_step(model, data, 5)
    arrays = {name: np.array(column) for name, column in columns.items()}
    return Record(name="pushed.csv", **arrays)


def servo(sign=1.0, scale=1.0, rate=2.0, gains='kp="40" kv="4"'):
    """A joint that follows its commands, logged in another sign or unit."""
    xml = ARM.replace('<motor name="m1"', f'<position {gains} name="m1"')
    task = arm(xml)
    time = 0.01 * np.arange(400)
    command = np.stack([0.5 * np.sin(rate * time), 0 * time], 1)
    model, data = task.model, mujoco.MjData(task.model)
    rows = []
    for ctrl in command:
        data.ctrl[:] = ctrl
        rows.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_step(model, data, 5)
    qpos, qvel = (np.array(column) for column in zip(*rows, strict=True))
    logged = command * np.array([sign * scale, 1.0])
    return System(task=task), [Record(name="s.csv", time=time, qpos=qpos, qvel=qvel, ctrl=logged)]


def test_a_servo_beyond_its_resonance_moves_against_its_commands():
    system, (record,) = servo(rate=80.0, gains='kp="20" kv="1"')
    findings = check([record], system)
    assert np.corrcoef(record.qpos[:, 0], record.ctrl[:, 0])[0, 1] < -0.9
    assert "action_sign" in kinds(findings, "warning")
    refuse_spoilt(findings)


def test_servos_follow_their_commands():
    assert not kinds(check(*reversed(servo())))
    assert kinds(check(*reversed(servo(sign=-1)))) == {"action_sign"}
    assert kinds(check(*reversed(servo(scale=DEGREES)))) == {"action_scale"}
    system, (record,) = servo()
    turned = replace(record, qpos=DEGREES * record.qpos, qvel=DEGREES * record.qvel)
    (finding,) = check([turned], system)[:1]
    assert (finding.kind, finding.severity) == ("motion_scale", "error")
    assert finding.message == "shoulder moves 51.8 times as far as its commands: in degrees?"


def test_copies_short_logs_and_single_trajectories():
    system, records = simulated("arm", count=2)
    findings = check([*records, replace(records[0], name="copy.csv")], system)
    assert [(f.kind, f.file) for f in findings if f.severity == "error"] == [
        ("copy", "copy.csv"),
        ("short", "copy.csv"),
    ]
    findings = check(records[:1], system, horizon=300)
    assert kinds(findings) == {"short"}
    assert kinds(findings, "warning") == {"single_trajectory"}


def test_degrees_beyond_a_range():
    system, records = simulated("hopper")
    turned = [times(r, factor_q=DEGREES, factor_v=DEGREES) for r in records]
    assert "degrees" in kinds(check(turned, system))


def test_a_finding_says_where():
    finding = Finding(kind="gap", file="a.csv", rows=(3, 4), message="a gap of 1 s")
    assert str(finding) == "warning: a.csv rows 3 to 4: a gap of 1 s (gap)"
    assert finding.parts == ((3, 4),)


def test_partly_measured_robots_are_checked_as_far_as_they_go():
    system, records = simulated("arm")
    columns = Columns("t", {"elbow": ("q",)}, {}, system.columns.ctrl)
    system = System(task=system.task, columns=columns)
    records = [
        replace(r, qpos=r.qpos * [np.nan, 1], qvel=np.full_like(r.qvel, np.nan)) for r in records
    ]
    findings = check(records, system)
    assert not kinds(findings)
    (log, *_) = usable_logs(records, system, findings)
    assert log.measured.tolist() == [False, True, False, False]
    assert float(log.qpos[:, 0].abs().max()) == 0.0


def first_rows(record, count):
    return replace(
        record, **{n: getattr(record, n)[:count] for n in ("time", "qpos", "qvel", "ctrl")}
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda r: times(r, factor_q=np.nan),
        lambda r: times(r, factor_v=np.nan),
        lambda r: times(r, factor_u=np.nan),
        lambda r: times(r, factor_q=1e200),
        lambda r: replace(r, time=np.nan * r.time),
        lambda r: replace(r, time=0 * r.time),
        lambda r: replace(r, time=r.time[::-1].copy()),
        lambda r: first_rows(r, 1),
        lambda r: first_rows(r, 4),
    ],
)
def test_logs_that_say_nothing_are_not_used(change):
    findings, records, system = spoilt(change)
    assert "short" in kinds(findings)
    with pytest.raises(ValueError, match=r"logs that can be used, got 'error: 0\.csv"):
        usable_logs(records, system, findings)


def test_nothing_at_all_and_nothing_that_moves():
    system, records = simulated("arm")
    with pytest.raises(ValueError, match="at least one log"):
        check([], system)
    at_rest = [times(r, factor_q=0.0, factor_v=0.0) for r in records]
    assert "constant_channel" in kinds(check(at_rest, system), "warning")


def test_a_clock_that_goes_back_and_on_again_is_an_error_and_tells_no_speeds():
    record = swinging(0)
    record = replace(record, time=np.where(np.arange(len(record.time)) % 2, 0.1, 0.0))
    found = check([record], System(task=known_task("InvertedPendulum-v5")))
    assert "repeated_time" in kinds(found, "error")
    assert not {"velocity_scale", "velocity_mismatch"} & kinds(found, "error")
