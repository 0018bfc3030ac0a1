"""A system is described once, in a file or in Python, and every slip is named."""

from dataclasses import replace

import pytest
import torch

from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics

ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
      <body name="lower" pos="0 0 -.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shoulder"/></actuator>
</mujoco>
"""
DESCRIPTION = """
simulator: robot.xml
control_dt: 0.01
columns:
  time: t
  qpos: {elbow: q2, shoulder: q1}
  qvel: {elbow: v2}
  ctrl: {motor: tau}
parameters:
  body_mass[upper]: [0.5, 2]
  damping:
    entries: ["dof_damping[shoulder]", "dof_damping[elbow]"]
    bounds: [1e-3, 0.5]
    log: true
noise: {q1: 1e-3}
effects: all
"""
BOX = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="box"><freejoint name="free"/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def write(tmp_path):
    def write(description=DESCRIPTION, model=ARM):
        (tmp_path / "robot.xml").write_text(model)
        path = tmp_path / "system.yaml"
        path.write_text(description)
        return path

    return write


def test_a_file_gives_all_of_it(write):
    system = System.load(write())
    assert system.control_dt == pytest.approx(0.01)
    assert system.task.frame_skip == 5
    assert system.robot.channels == ("q1", "q2", "v2")
    assert system.channel_index == (0, 1, 3)
    assert system.robot.channel_joint == (0, 1, 1)
    assert system.robot.channel_kind == ("position", "position", "velocity")
    assert system.physics.names == system.prior.names == ("body_mass[upper]", "damping")
    assert system.prior.log.tolist() == [False, True]
    assert system.prior.units == ("kg", "N m s/rad")
    torch.testing.assert_close(system.prior.low, torch.tensor([0.5, 1e-3]))
    assert system.noise == {"q1": 0.001}
    assert system.effects is None


def test_effects_may_be_listed(write):
    path = write(DESCRIPTION.replace("effects: all", "effects: [coulomb_friction, payload]"))
    assert System.load(path).effects == ("coulomb_friction", "payload")


def test_a_free_joint_has_seven_columns_and_six_channels(write):
    description = """
simulator: robot.xml
control_dt: 0.002
columns:
  qpos: {free: [x, y, z, qw, qx, qy, qz]}
  qvel: {free: [vx, vy, vz, wx, wy, wz]}
"""
    system = System.load(write(description, BOX))
    rotations = tuple(f"free rotation {axis}" for axis in "xyz")
    velocities = ("vx", "vy", "vz", "wx", "wy", "wz")
    assert system.robot.channels == ("x", "y", "z", *rotations, *velocities)
    assert system.channel_index == tuple(range(12))
    assert set(system.robot.channel_joint) == {-1}
    assert set(system.robot.channel_kind) == {"other"}
    assert system.columns.time is None
    assert system.physics is None
    assert system.prior is None


@pytest.mark.parametrize(
    ("simulator", "joints", "control_dt"),
    [
        ("gymnasium:InvertedPendulum-v5", ("slider", "hinge"), 0.04),
        ("dm_control:cartpole/swingup", ("slider", "hinge_1"), 0.01),
    ],
)
def test_named_tasks_bring_their_own_control_step(write, simulator, joints, control_dt):
    system = System.load(write(f"simulator: {simulator}"))
    assert system.robot.joints == joints
    assert system.robot.channels[0] == "slider position"
    assert system.control_dt == pytest.approx(control_dt)
    twice = System.load(write(f"simulator: {simulator}\ncontrol_dt: {2 * system.control_dt}"))
    assert twice.task.frame_skip == 2 * system.task.frame_skip


def test_python_alone_will_do():
    task = known_task("Hopper-v5")
    prior = BoxPrior({"body_mass[torso]": (2.0, 6.0)})
    system = System(task=task, physics=MujocoPhysics("body_mass[torso]"), prior=prior)
    assert len(system.robot.channels) == 12
    columns = Columns("t", {"rootx": ("x",)}, ctrl=system.columns.ctrl)
    assert System(task=task, columns=columns).channel_index == (0,)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (("control_dt: 0.01", "control_dt: 0.011"), "multiple of the model's time step 0.002 s"),
        (("control_dt: 0.01", "control_dt: nan"), "multiple of the model's time step"),
        (("control_dt: 0.01", "control_dt: fast"), "a number under 'control_dt'"),
        (("control_dt: 0.01", ""), "control_dt beside an MJCF file"),
        (("simulator: robot.xml", ""), "text under 'simulator'"),
        (("robot.xml", "robt.xml"), r"robot.xml \(did you mean this\?\)"),
        (("robot.xml", "../robot.xml"), "inside the folder"),
        (("robot.xml", "pybullet:Arm"), "an MJCF file, gymnasium:NAME or dm_control"),
        (("robot.xml", "gymnasium:Hoper-v5"), r"Hopper-v5 \(did you mean this\?\)"),
        (("robot.xml", "dm_control:cartpole/swing"), r"cartpole/swingup \(did you mean this\?\)"),
        (("noise:", "nose:"), r"noise \(did you mean this\?\)"),
        (("elbow: q2", "elbo: q2"), r"elbow \(did you mean this\?\)"),
        (("{motor: tau}", "{moto: tau}"), r"motor \(did you mean this\?\)"),
        (("{motor: tau}", "{}"), "a column for every actuator"),
        (("elbow: q2", "elbow: [q2, q3]"), r"1 column\(s\) for joint 'elbow'"),
        (("{elbow: q2, shoulder: q1}", "{}"), "at least one joint's position"),
        (("elbow: q2", "elbow: q1"), "each column once, got 'q1'"),
        (("{q1: 1e-3}", "{q3: 1e-3}"), "a channel in noise, got 'q3'"),
        (("{q1: 1e-3}", "{q1: -1}"), "standard deviation of q1"),
        (("[0.5, 2]", "[2, 0.5]"), "low < high"),
        (("[0.5, 2]", "[0.5]"), "2 numbers under"),
        (("log: true", "log: maybe"), "true or false"),
        (("{q1: 1e-3}", "[q1]"), "a mapping"),
        (("{q1: 1e-3}", "{q1: 1, q1: 2}"), "the key 'q1' twice"),
        (("{q1: 1e-3}", "{q1: 1"), "plain YAML"),
    ],
)
def test_slips_are_named(write, change, match):
    with pytest.raises(ValueError, match=match):
        System.load(write(DESCRIPTION.replace(*change)))


def test_a_parameter_must_be_in_the_model(write):
    with pytest.raises(PhysicsError, match=r"upper \(did you mean this\?\)"):
        System.load(write(DESCRIPTION.replace("body_mass[upper]", "body_mass[uper]")))


@pytest.mark.parametrize(
    "hostile",
    [
        "!!python/object/apply:os.system ['echo broken > broken']",
        "a: &a [x, x]\nb: [*a, *a]",
        "[" * 3000,
        "- just\n- a list",
        "simulator: !!binary aGVsbG8=\n\x00",
    ],
)
def test_hostile_yaml_ends_in_one_message(write, tmp_path, monkeypatch, hostile):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="expected"):
        System.load(write(hostile))
    assert not (tmp_path / "broken").exists()


def test_a_description_must_be_a_file_in_utf_8(tmp_path):
    with pytest.raises(ValueError, match="a file to read"):
        System.load(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes("simulator: ü".encode("latin-1"))
    with pytest.raises(ValueError, match="YAML in UTF-8"):
        System.load(tmp_path / "latin.yaml")


@pytest.mark.parametrize(
    "reference",
    [
        '<include file="../outside.xml"/>',
        '<asset><mesh file="/etc/hostname"/></asset>',
        '<compiler meshdir=".."/><asset><mesh file="outside.stl"/></asset>',
        '<include file="inner.xml"/>',
    ],
)
def test_models_stay_in_their_folder(write, tmp_path, reference):
    (tmp_path / "inner.xml").write_text('<mujoco><include file="../../x.xml"/></mujoco>')
    path = write(model=ARM.replace("<worldbody>", f"{reference}<worldbody>", 1))
    with pytest.raises(ValueError, match="inside the folder"):
        System.load(path)


def test_includes_inside_the_folder_are_fine(write, tmp_path):
    (tmp_path / "options.xml").write_text('<mujoco><option gravity="0 0 -1.6"/></mujoco>')
    path = write(model=ARM.replace("<worldbody>", '<include file="options.xml"/><worldbody>'))
    assert System.load(path).task.model.opt.gravity[2] == -1.6


@pytest.mark.parametrize(
    ("model", "match"),
    [
        ("<mujoco><unclosed></mujoco>", "XML in"),
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "compiles"),
    ],
)
def test_a_broken_model_is_named(write, model, match):
    with pytest.raises(ValueError, match=match):
        System.load(write(model=model))


def test_a_system_must_fit_together():
    task = known_task("Hopper-v5")
    with pytest.raises(ValueError, match="a prior over the physics"):
        System(task=task, physics=MujocoPhysics("body_mass[torso]"))


def test_logs_of_a_task_that_converts_its_actions_hold_these():
    system = System(task=known_task("FetchReach-v4"))
    assert list(system.columns.ctrl) == ["action0", "action1", "action2", "action3"]
    assert system.robot.actuators == tuple(system.columns.ctrl)
    columns = replace(system.columns, ctrl={"hand": "u"})
    with pytest.raises(ValueError, match=r"an actuator in columns\.ctrl, got 'hand'.*action0"):
        System(task=known_task("FetchReach-v4"), columns=columns)
