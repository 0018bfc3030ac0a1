"""The batched replay of a diagnosis and the drop-in transform give the same trajectories."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from torchrl_bayessim.diagnosis.objective import units_of
from torchrl_bayessim.diagnosis.prediction import Predictor
from torchrl_bayessim.diagnosis.segments import cut
from torchrl_bayessim.effects.action import ActionDelay, ActionGain, ActionLag, DeadBand
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.effects.effect import ActionEffect, SensorEffect
from torchrl_bayessim.effects.friction import LoadDependentFriction
from torchrl_bayessim.effects.sensors import SensorDelay
from torchrl_bayessim.effects.transmission import TorqueSpeedLimit
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms.apply_effect import ApplyEffect

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".05"/>
    <inertial pos="0 0 -.2" mass="1" diaginertia=".02 .02 .01"/>
    <body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".05"/>
      <inertial pos="0 0 -.15" mass=".5" diaginertia=".01 .01 .005"/></body></body>
</worldbody><actuator>
  <motor name="m1" joint="shoulder" ctrlrange="-5 5"/>
  <motor name="m2" joint="elbow" ctrlrange="-2 2"/>
</actuator></mujoco>
"""
STEPS = 45
STRONG = {"torque_speed_limit", "saturation"}  # act on strong commands only


def arm():
    return Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=5)


def actions(task, count=STEPS):
    spans = torch.from_numpy(task.model.actuator_ctrlrange[:, 1]).float()
    times = torch.arange(count)[:, None] * task.dt
    return spans * torch.sin(torch.tensor([9.0, 24.0, 16.0])[: len(spans)] * times + 0.3)


def recorded(task, *applied, start=None):
    """Return what an environment does, as a log of measured positions and velocities."""
    env = BatchedMujocoEnv(task, 1, threads=1, dtype=torch.float64)
    base = env
    for one in applied:
        env = TransformedEnv(env, ApplyEffect(*one), auto_unwrap=True)
    td = env.reset()
    model = task.model
    qpos = torch.from_numpy(model.qpos0.copy()) if start is None else start
    base.place({"qpos": qpos[None], "qvel": torch.zeros(1, model.nv)})
    rows = [(base.stepper["qpos"].copy(), base.stepper["qvel"].copy())]
    commanded = actions(task)
    for action in commanded:
        td = env.step(td.set("action", action[None]))["next"]
        td = td.exclude("reward")
        rows.append((base.stepper["qpos"].copy(), base.stepper["qvel"].copy()))
    last = torch.cat([commanded, commanded[-1:]]).double()
    return Log(
        name="env",
        time=torch.arange(STEPS + 1).double() * task.dt,
        qpos=torch.from_numpy(np.concatenate([q for q, _ in rows])),
        qvel=torch.from_numpy(np.concatenate([v for _, v in rows])),
        ctrl=last,
        velocity_gain=torch.zeros(model.nv).double(),
        measured=torch.ones(2 * model.nv, dtype=torch.bool),
    )


def deterministic(robot):
    units = units_of([effect(name) for name in CATALOGUE], robot)
    units = [u for u in units if not u.effect.random and not isinstance(u.effect, SensorEffect)]
    idle = "com_shift[upper y]", "com_shift[lower y]"  # along the axis of all joints
    bristles = units_of([effect("coulomb_friction", presliding=0.01)], robot)
    named = {str(u): u for u in units if u.where != "all" and str(u) not in idle}
    return named | {f"{u}, presliding": u for u in bristles if u.where != "all"}


ARM_UNITS = deterministic(System(task=arm()).robot)


def worst(task, log, unit=None, strength=0.0):
    system = System(task=task)
    predictor = Predictor(system, threads=1)
    predictor.exactly()
    strengths = {}
    if unit is not None:
        strengths[unit.effect] = strength * np.array([unit.direction])
    residual = predictor.residuals(cut([log], STEPS, history=2), np.zeros((1, 0)), strengths)
    return np.abs(residual).max()


@pytest.mark.parametrize("name", ARM_UNITS)
def test_replay_does_what_the_transform_does(name):
    unit = ARM_UNITS[name]
    strength = (0.9 if unit.name in STRONG else 0.3) * unit.high
    log = recorded(arm(), (unit.effect, {unit.where: strength}))
    # actions are single precision in the environment
    assert worst(arm(), log, unit, strength) < 1e-5
    assert worst(arm(), log) > 1e-4


def fast_arm(**options):
    """Return an arm whose damping stops a joint within a control step."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_damping[:] = 3.0
    return Task(model=model, frame_skip=5, **options)


WITHIN = {
    "lag": (ActionLag(held=False, second=0.3), 0.03),
    "delay": (ActionDelay(inside=True), 0.013),
}


def replayed(task, log, effects):
    """Return the largest error of segments cut from the middle of a log, and without effects."""
    predictor = Predictor(System(task=task), threads=1)
    predictor.exactly()
    segments = cut([log], 10, history=20, burn_in=len(log))
    assert segments.start.min() > 0
    robot, strengths = predictor.system.robot, {}
    for one, strength in effects:
        law = one.on(robot)
        strengths[law] = np.full((1, len(law.targets(robot))), strength)
    found = [
        predictor.residuals(segments, np.zeros((1, 0)), some)
        for some in (strengths, dict(reversed(strengths.items())), {})
    ]
    np.testing.assert_array_equal(found[0], found[1])  # in whatever order they are given
    return np.abs(found[0]).max(), np.abs(found[2]).max()


@pytest.mark.parametrize(
    "others",
    [
        (),
        ((ActionGain(), 0.4),),
        ((DeadBand(), 0.3),),
        ((ActionDelay(), 0.02),),
        ((TorqueSpeedLimit(), 0.5),),
        ((LoadDependentFriction(), 0.2),),
        ((LoadDependentFriction(external=True), 0.2),),
    ],
    ids=str,
)
@pytest.mark.parametrize("late", WITHIN)
def test_what_is_late_within_a_step_starts_a_segment_with_what_reached_it(late, others):
    """In the middle of a run, beside effects that change commands before it, or after."""
    task = fast_arm()
    robot = System(task=task).robot
    assert robot.fast
    effects = [WITHIN[late], *others]
    commands = [e for e in effects if isinstance(e[0].on(robot), ActionEffect)]
    forces = [e for e in effects if e not in commands]
    # of several around an environment the last is the first that an action meets
    log = recorded(task, *forces, *commands)
    with_them, without = replayed(task, log, effects)
    assert with_them < 2e-3
    assert without > 0.02


@pytest.mark.parametrize("late", WITHIN)
def test_what_is_late_within_a_step_is_the_command_that_a_task_makes(late):
    task = fast_arm(command=lambda action: 0.5 * action)
    with_it, without = replayed(task, recorded(task, WITHIN[late]), [WITHIN[late]])
    assert with_it < 2e-3
    assert without > 0.02


def test_sensors_that_are_all_late_are_commands_that_are_late_within_the_step():
    task, lag = fast_arm(), WITHIN["lag"]
    log = recorded(task, WITHIN["delay"], lag)
    whole, without = replayed(task, log, [lag, (SensorDelay(), 0.013)])
    # of the rows before a segment the filter is given the mean of what is late
    assert whole < 5e-3
    assert without > 0.1


def test_what_one_candidate_has_the_next_has_not():
    predictor = Predictor(System(task=arm()), threads=1)
    segments, nothing = cut([recorded(arm())], 20, history=2), np.zeros((1, 0))
    before = predictor.residuals(segments, nothing)
    for unit in ARM_UNITS.values():
        predictor.residuals(segments, nothing, {unit.effect: 0.3 * np.array([unit.direction])})
        np.testing.assert_array_equal(predictor.residuals(segments, nothing), before)


@pytest.mark.parametrize("name", ["coulomb_friction", "action_delay", "quadratic_drag"])
def test_replay_does_what_the_transform_does_on_hopper(name):
    task = known_task("Hopper-v5")
    unit = deterministic(System(task=task).robot)[
        f"{name}[{'actuator1' if 'action' in name else 'leg_joint'}]"
    ]
    start = torch.tensor([0.0, 1.25, 0.0, -0.1, -0.1, 0.1], dtype=torch.float64)
    log = recorded(task, (unit.effect, {unit.where: 0.1 * unit.high}), start=start)
    assert worst(task, log, unit, 0.1 * unit.high) < 1e-4


@pytest.mark.parametrize("name", ["Hopper-v5", "HalfCheetah-v5"])
def test_looking_for_islands_of_one_tree_changes_no_bit(name):
    """As `Predictor` does not."""
    model = known_task(name).model
    without = copy.copy(model)
    without.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    ends = []
    for one in (model, without):
        data = mujoco.MjData(one)
        rng = np.random.default_rng(0)
        for _ in range(300):
            data.ctrl[:] = rng.uniform(-1, 1, one.nu)
            mujoco.mj_step(one, data, 4)
        ends.append(np.r_[data.qpos, data.qvel])
    assert data.ncon > 0
    np.testing.assert_array_equal(*ends)


def test_contacts_of_named_pairs_alone_are_seen():
    falling = """<mujoco><worldbody>
      <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="0"/>
      <body pos="0 0 .12"><joint name="rail" type="slide" axis="0 0 1"/>
        <geom name="foot" size=".1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
      <actuator><motor joint="rail" ctrlrange="-1 1"/></actuator>
      <contact><pair geom1="floor" geom2="foot"/></contact></mujoco>"""
    task = Task(model=mujoco.MjModel.from_xml_string(falling), frame_skip=5)
    log = recorded(task)
    assert log.qpos[-1, 0] > -0.1  # held by the floor, whose top it reaches at -0.02
    assert worst(task, log) < 1e-12


def test_nothing_is_left_of_its_own_simulation():
    assert worst(arm(), recorded(arm())) < 1e-5


def test_candidates_do_not_touch_each_other():
    task, log = arm(), recorded(arm())
    prior = BoxPrior({"body_mass[lower]": (0.3, 0.8)})
    system = System(task=task, prior=prior, physics=MujocoPhysics("body_mass[lower]"))
    predictor = Predictor(system, threads=1)
    segments = cut([log], 5)
    friction, delay = effect("coulomb_friction"), effect("action_delay")
    payload, drag = effect("payload"), effect("quadratic_drag")
    theta = np.array([[0.5], [0.4], [0.5], [0.6], [0.5], [0.5]])
    strengths = {
        friction: np.array([[0, 0], [0.1, 0], [0, 0], [0, 0], [0, 0.1], [0, 0]]),
        delay: np.array([[0, 0], [0, 0], [0.01, 0.01], [0, 0], [0, 0], [0, 0]]),
        payload: np.array([[0, 0], [0, 0], [0, 0], [0.1, 0], [0, 0], [0, 0]]),
        drag: np.array([[0, 0], [0, 0], [0.1, 0], [0, 0], [0, 0.1], [0, 0]]),
    }
    together = predictor.residuals(segments, theta, strengths)
    for p in range(len(theta)):
        alone = {e: s[p : p + 1] for e, s in strengths.items()}
        one = predictor.residuals(segments, theta[p : p + 1], alone)
        np.testing.assert_allclose(together[p], one[0], atol=1e-12)
    np.testing.assert_allclose(together[0], together[-1], atol=1e-12)


def test_candidates_leave_nothing_behind_where_no_parameter_is_uncertain():
    predictor, segments = Predictor(System(task=arm()), threads=1), cut([recorded(arm())], 10)
    before = predictor.residuals(segments, np.zeros((2, 0)))
    predictor.residuals(segments, np.zeros((2, 0)), {effect("payload"): np.full((2, 2), 0.2)})
    np.testing.assert_array_equal(predictor.residuals(segments, np.zeros((2, 0))), before)


@pytest.mark.parametrize(
    ("name", "strength", "see"),
    [
        ("sensor_bias", 0.1, lambda x, t: x + 0.1),
        ("sensor_gain", 0.2, lambda x, t: 1.2 * x),
        ("sensor_drift", 0.3, lambda x, t: x + 0.3 * t),
    ],
)
def test_sensors_are_seen_through(name, strength, see):
    task, true = arm(), recorded(arm())
    qpos = true.qpos.clone()
    qpos[:, 0] = see(qpos[:, 0], true.time)
    fields = {n: getattr(true, n) for n in ("time", "qvel", "ctrl", "velocity_gain", "measured")}
    log = Log(name="seen", qpos=qpos, **fields)
    seen = effect(name)
    system = System(task=task)
    predictor = Predictor(system, threads=1)
    strengths = {seen: strength * np.eye(1, len(system.robot.channels))}
    residual = predictor.residuals(cut([log], 10, history=5), np.zeros((1, 0)), strengths)
    assert np.abs(residual).max() < 1e-5
    assert np.abs(predictor.residuals(cut([log], 10), np.zeros((1, 0)))).max() > 1e-2


def late(true, columns, steps):
    """Return a log whose readings arrive so many steps late."""
    states = torch.cat([true.qpos, true.qvel], 1)
    shifted = torch.cat([states[:1].expand(steps, -1), states[:-steps]])
    states = torch.where(torch.tensor(columns), shifted, states)
    fields = {n: getattr(true, n) for n in ("time", "ctrl", "velocity_gain", "measured")}
    half = true.qpos.shape[1]
    return Log(name="late", qpos=states[:, :half], qvel=states[:, half:], **fields)


@pytest.mark.parametrize("columns", [(True, True, True, True), (False, True, False, True)])
def test_late_readings_are_seen_through(columns):
    system = System(task=arm())
    log, predictor = late(recorded(arm()), columns, 2), Predictor(system, threads=1)
    strengths = {effect("sensor_delay"): 2 * arm().dt * np.array([columns], dtype=float)}
    segments = cut([log], 10, history=5)
    segments = segments.take(np.arange(1, len(segments) - 1))  # of motion in mid-course
    residual = predictor.residuals(segments, np.zeros((1, 0)), strengths)
    assert np.abs(residual).max() < 1e-4
    assert np.abs(predictor.residuals(segments, np.zeros((1, 0)))).max() > 1e-2


def test_a_record_late_as_a_whole_is_one_of_late_commands():
    predictor, segments = Predictor(System(task=arm()), threads=1), cut([recorded(arm())], 5)
    both = {
        effect("sensor_delay"): np.full((1, 4), 0.013),
        effect("action_delay"): np.array([[0.0, 0.002]]),
    }
    one = {effect("action_delay"): np.array([[0.013, 0.015]])}
    residuals = [predictor.residuals(segments, np.zeros((1, 0)), s) for s in (both, one)]
    np.testing.assert_array_equal(*residuals)


def test_a_diverging_candidate_is_nan_and_the_rest_unharmed():
    system = System(task=arm())
    predictor = Predictor(system, threads=1)
    pushed = effect("constant_force")
    strengths = {pushed: np.array([[0.0, 0.0], [1e12, 0.0]])}
    residual = predictor.residuals(cut([recorded(arm())], 10), np.zeros((2, 0)), strengths)
    assert np.isfinite(residual[0]).all()
    assert np.isnan(residual[1]).any()
