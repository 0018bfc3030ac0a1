"""Where the simulator or the data say little, what explains them is not to be named."""

import re
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_diagnose import ARM, BOUNDS, SOME, logs, system

from torchrl_bayessim.diagnosis.credit import unit_credit
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.divergence import diverges_throughout
from torchrl_bayessim.diagnosis.doubts import alike, doubts, numerical, slow
from torchrl_bayessim.diagnosis.objective import Point, units_of
from torchrl_bayessim.diagnosis.refit import Fit
from torchrl_bayessim.diagnosis.report import Finding
from torchrl_bayessim.diagnosis.shrinkage import Shrinkage
from torchrl_bayessim.diagnosis.verdict import _Weighed
from torchrl_bayessim.effects.catalogue import effect as catalogued
from torchrl_bayessim.effects.disturbance import Cogging
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

TWO = """<mujoco><worldbody>
  <body><joint name="a" axis="0 1 0"/><geom size=".1" mass="1"/>
    <body pos="0 0 -.3"><joint name="b" axis="0 1 0"/><geom size=".1" mass="1"/></body></body>
</worldbody></mujoco>"""


def friction(x, v):
    return -0.15 * np.tanh(v / 0.01)


def test_an_unstable_simulator_names_nothing():
    unstable = ARM.replace('damping=".05"', 'damping=".05" stiffness="-100"')
    task = Task(model=mujoco.MjModel.from_xml_string(unstable), frame_skip=5)
    wrong = System(task=task, physics=MujocoPhysics(*BOUNDS), prior=BoxPrior(BOUNDS))
    report = diagnose(wrong, None, logs(push=friction), effects=SOME)
    assert report.verdict == "not_testable"
    assert "the simulator diverges" in report.summary
    assert any("every whole test run" in alarm for alarm in report.alarms)
    assert not report.effects
    assert not [c for c in report.candidates if c.status == "named"]


def test_commands_that_never_change_name_nothing_without_reserve():
    still = [replace(log, ctrl=0 * log.ctrl) for log in logs(act=lambda u, k: 0.0, push=friction)]
    report = diagnose(system(), None, still, effects=SOME)
    assert report.verdict != "named"
    if report.effects:
        assert any("no command ever changes" in alarm for alarm in report.alarms)


@pytest.mark.parametrize("at_the_end", [True, False])
def test_a_cause_that_may_be_nothing_at_the_end_of_its_range_is_none(monkeypatch, at_the_end):
    where = "torchrl_bayessim.diagnosis"
    if at_the_end:
        monkeypatch.setattr(f"{where}.doubts._EDGE", 0.01)
    monkeypatch.setattr(
        f"{where}.found.strength_errors",
        lambda fit, *_: dict.fromkeys(fit.units, 1.0),  # N m, of 0.15
    )
    report = diagnose(system(), None, logs(push=friction), effects=["coulomb_friction"])
    if at_the_end:
        assert report.verdict == "unknown"
        assert not report.effects
        assert "what could explain it on some runs does not hold up" in report.summary
    else:
        assert report.verdict == "named_partial"
        assert any("may be nothing: its interval" in alarm for alarm in report.alarms)


@pytest.mark.parametrize(
    ("low", "verdict"), [(0.8, "named"), (0.5, "named_partial"), (-0.35, "named_partial")]
)
def test_a_share_that_may_be_nothing_is_named_with_reserve(low, verdict):
    measured = Shrinkage(9.0, 3.0, 1.0, 1.0, (low, 1.0), (1.0, 4.0), (0.0, 0.1))
    weighed = _Weighed(
        measured,
        significant=True,
        certain=True,
        visible=True,
        validated=0.9,
        unsaid=False,
        elsewhere=False,
        helps=False,
        together=False,
        several=False,
        remains=False,
    )
    assert weighed.named(ambiguous=False) == verdict


@pytest.mark.parametrize(
    ("raw", "refit", "throughout"),
    [(np.inf, np.inf, True), (np.inf, 0.1, False), (0.2, 0.1, False)],
)
def test_a_simulator_diverges_if_no_parameters_hold_it(raw, refit, throughout):
    rollouts = {"raw": {"q": raw}, "refit": {"q": refit}, "with_effects": {"q": 0.1}}
    assert diverges_throughout(rollouts) is throughout


def found(strength, error=0.1, name="action_gain", where="motor"):
    ends = strength - error, strength + error
    return Finding(name=name, where=where, strength=strength, unit="fraction", ci95=ends,
                   p_value=1e-9, share_of_gap=0.9, strengths={where: strength})  # fmt: skip


def recorded(changing=True, actuators=1):
    ctrl = np.zeros((3, 4, actuators))
    ctrl[0] = float(changing)
    return SimpleNamespace(sets={"train": SimpleNamespace(segments=SimpleNamespace(ctrl=ctrl))})


@pytest.mark.parametrize(
    ("effect", "doubt"),
    [
        (found(0.5), "action gain at motor was fitted to 0.5 fraction, the end"),
        (found(-0.5), r"the end of what is looked for, \[-0.5, 0.5\]"),
        (found(0.2, error=0.3), "may be nothing: its interval"),
    ],
)
def test_strengths_that_say_little_are_doubted(effect, doubt):
    units = units_of([catalogued("action_gain")], system().robot)
    (text,) = doubts([effect], units, recorded())
    assert re.search(doubt, text)


def test_a_strength_within_its_range_is_not_doubted_and_neither_is_nothing():
    units = units_of([catalogued("action_gain"), catalogued("coulomb_friction")], system().robot)
    assert doubts([found(0.2)], units, recorded()) == []
    assert doubts([found(0.05, 0.01, "coulomb_friction", "hinge")], units, recorded()) == []
    assert doubts([], units, recorded(changing=False)) == []
    assert doubts([found(0.2)], units, recorded(actuators=0)) == []
    assert "no command ever changes" in doubts([found(0.2)], units, recorded(changing=False))[0]


def test_places_of_one_effect_share_its_credit_by_what_each_changes():
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(TWO), frame_skip=5))
    units = [u for u in units_of([catalogued("coulomb_friction")], robot) if u.where != "all"]
    jacobian = np.zeros((10, 2))
    jacobian[:5, 0], jacobian[5:, 1] = 1.0, 2.0
    strengths = {units[0]: units[0].high, units[1]: units[1].high}
    fit = Fit(Point(np.zeros(0), strengths), tuple(units), np.zeros((5, 2)), jacobian)
    selection = SimpleNamespace(best=SimpleNamespace(fit=fit))
    credit = unit_credit(selection, {"coulomb_friction": 0.5})
    assert [credit[unit] for unit in units] == pytest.approx([0.1, 0.4])


@pytest.mark.parametrize(
    ("found", "damping", "options", "artefact"),
    [
        # 2 ms times 2.4 N m s/rad, the servo's and the joint's
        (("armature", 0.0045), 2.0, 'integrator="RK4"', True),
        (("armature", 0.006), 2.0, 'integrator="RK4"', False),
        (("armature", 0.0005), 0.0, 'integrator="RK4"', True),
        (("armature", 0.004), 0.0, 'integrator="RK4"', False),
        (("coulomb_friction", 0.0045), 2.0, 'integrator="RK4"', False),
        # which takes the joint's implicitly, and has that inertia already
        (("armature", 0.0035), 2.0, 'integrator="Euler"', True),
        (("armature", 0.0045), 2.0, 'integrator="Euler"', False),
        (("armature", 0.0005), 0.0, 'integrator="Euler"', False),
        (("armature", 0.0045), 2.0, 'integrator="Euler"><flag eulerdamp="disable"', True),
        (("armature", 0.0005), 2.0, 'integrator="implicit"', False),
        (("armature", 0.0005), 2.0, 'integrator="implicitfast"', False),
    ],
)
def test_an_armature_that_an_integrator_adds_is_no_cause(found, damping, options, artefact):
    name, strength = found
    end = "</option>" if "<flag" in options else ""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.002" {options}/>
      {end}<worldbody>
      <body><joint name="a" damping="0.4"/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><position joint="a" kp="40" kv="{damping}"/></actuator></mujoco>""")
    robot = robot_of(Task(model=model, frame_skip=5))
    found = Finding(
        name=name,
        where="a",
        strength=strength,
        unit="kg m²",
        ci95=(0.9 * strength, 1.1 * strength),
        p_value=0.0,
        share_of_gap=1.0,
        strengths={"a": strength},
    )
    alarms = numerical([found], robot)
    assert any("no more than another integrator adds" in alarm for alarm in alarms) == artefact


def test_where_actions_move_no_joint_that_is_known_no_armature_is_an_integrators():
    robot = robot_of(known_task("FetchPush-v4"))
    joint = robot.joints[0]
    found = Finding(
        name="armature", where=joint, strength=1e3, unit="kg m²", ci95=(900.0, 1100.0),
        p_value=0.0, share_of_gap=1.0, strengths={joint: 1e3},
    )  # fmt: skip
    assert numerical([found], robot) == []


@pytest.mark.parametrize(
    ("names", "doubted"),
    [
        (("payload", "armature"), True),
        (("payload", "constant_force"), False),
        (("coulomb_friction", "viscous_friction"), False),  # the usual model
        (("payload",), False),
    ],
)
def test_two_causes_that_act_alike_at_one_joint_are_doubted(names, doubted):
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=5))
    units = [u for u in units_of([catalogued(n) for n in names], robot) if u.where != "all"]
    assert bool(alike(units, robot)) == doubted
    if doubted:
        assert "payload and armature at hinge act alike: they may stand" in alike(units, robot)[0]


@pytest.mark.parametrize(
    ("number", "joint", "doubted"),
    [(2.0, "hinge", True), (2.3, "hinge", False), (2.0, "slide", False)],
)
def test_cogging_that_is_as_slow_as_what_a_mass_does_is_doubted(number, joint, doubted):
    xml = ARM.replace('name="hinge"', f'name="hinge" type="{joint}"')
    robot = robot_of(Task(model=mujoco.MjModel.from_xml_string(xml), frame_skip=5))
    units = [u for u in units_of([Cogging(number=number)], robot) if u.where != "all"]
    assert bool(slow(units, robot)) == doubted


def test_a_tilt_along_a_joints_axis_has_no_sign():
    """Of which only the cosine matters: all that gravity is weaker."""
    weaker = ARM.replace("<option", '<option gravity="0 0 -9.4"')
    report = diagnose(system(), None, logs(xml=weaker), effects=["gravity_tilt"])
    assert report.verdict == "named_partial"
    (found,) = report.effects
    assert abs(found.strength) == pytest.approx(np.arccos(9.4 / 9.81), rel=0.05)
    said = f"gravity tilt at x is {abs(found.strength):.3g} or {-abs(found.strength):.3g} rad"
    assert any(said in alarm and "not tell its sign" in alarm for alarm in report.alarms)
