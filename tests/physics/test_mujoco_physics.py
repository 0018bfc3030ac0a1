from types import SimpleNamespace

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import DMControlEnv, GymEnv, TransformedEnv
from torchrl.envs.custom.mujoco import HopperEnv

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.model_fields import resolve
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

gymnasium.register_envs(gymnasium_robotics)

ARM = """
<mujoco>
  <statistic extent="7"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" friction="0.5"/>
    <body name="upper">
      <inertial pos=".1 0 0" mass="{mass}" diaginertia="{i1} {i2} {i3}"/>
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="{armature}"/>
      <geom name="pad" type="box" size="{size} .1 .1" mass="0"/>
      <body name="lower" pos="{length} 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2"/>
        <geom type="capsule" size=".05 {half}" friction="0.7"/>
        <geom type="sphere" size=".05" friction="0.7"/>
      </body>
    </body>
    <body name="ball" pos="1 1 1"><freejoint name="free"/><geom size=".1"/></body>
  </worldbody>
  <actuator>
    <position name="servo" joint="elbow" kp="20" gear="{gear}"/>
    <motor name="motor" joint="shoulder"/>
  </actuator>
</mujoco>
"""
NOMINAL = {
    "mass": 2.0, "i1": 0.1, "i2": 0.2, "i3": 0.25, "armature": 0.01, "size": 0.2,
    "length": 0.5, "half": 0.2, "gear": 1.0,
}  # fmt: skip


def arm(**changed):
    model = mujoco.MjModel.from_xml_string(ARM.format(**(NOMINAL | changed)))
    return SimpleNamespace(model=model, data=mujoco.MjData(model))


def write(env, physics, *theta):
    theta = torch.tensor(theta, dtype=torch.float64)
    physics.write(env, theta, mask=torch.tensor(True), tensordict=TensorDict())
    return physics.read(env, tensordict=TensorDict())


def floats(model):
    fields = {name: getattr(model, name) for name in dir(model) if name[0] != "_"}
    return {
        name: value
        for name, value in fields.items()
        if isinstance(value, np.ndarray) and value.dtype == np.float64
    } | {"meaninertia": np.array(model.stat.meaninertia), "extent": np.array(model.stat.extent)}


@pytest.mark.parametrize(
    ("target", "value", "compiled"),
    [
        ("body_mass[upper]", 3.0, {"mass": 3.0, "i1": 0.15, "i2": 0.3, "i3": 0.375}),
        ("dof_armature[shoulder]", 0.3, {"armature": 0.3}),
        ("geom_size[pad,0]", 0.9, {"size": 0.9}),
        ("body_pos[lower,0]", 0.8, {"length": 0.8}),
        ("actuator_gear[servo,0]", 3.0, {"gear": 3.0}),
    ],
)
def test_the_model_is_the_one_that_the_compiler_makes_of_the_changed_xml(target, value, compiled):
    env, physics = arm(), MujocoPhysics(target)
    for other in (value / 2, value):  # absolute, not compounding
        assert write(env, physics, other) == other
    expected = floats(arm(**compiled).model)
    for name, array in floats(env.model).items():
        if name in {"dof_length", "bvh_aabb"}:  # scales the threshold of sleep; see below
            continue
        np.testing.assert_allclose(array, expected[name], rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("target", ["geom_size[pad,0]", "geom_size[link,1]", "geom_size[tip,0]"])
def test_collision_bounds_are_those_that_the_compiler_makes(target):
    boxes = """<mujoco><worldbody><body><freejoint/><inertial pos=".1 .2 0" mass="1"
      quat="1 .3 0 .2" diaginertia="1 1.1 1.2"/>
      <geom name="pad" type="box" size="{} .1 .2" pos=".3 0 0" euler="30 10 0"/>
      <geom name="link" type="capsule" size=".1 {}" pos="0 .4 0" euler="0 70 5"/>
      <geom name="tip" type="ellipsoid" size="{} .2 .3" pos="0 -.4 .1"/>
      </body></worldbody></mujoco>"""
    nominal = mujoco.MjModel.from_xml_string(boxes.format(0.1, 0.1, 0.1))
    sizes = [0.12 if name in target else 0.1 for name in ("pad", "link", "tip")]
    expected = mujoco.MjModel.from_xml_string(boxes.format(*sizes))
    env = SimpleNamespace(model=nominal, data=mujoco.MjData(nominal))
    write(env, MujocoPhysics(target), 0.12)
    np.testing.assert_allclose(nominal.geom_rbound, expected.geom_rbound)
    np.testing.assert_allclose(nominal.geom_aabb, expected.geom_aabb)
    np.testing.assert_allclose(nominal.bvh_aabb[0], expected.bvh_aabb[0])
    for geom in range(3):  # the compiler may arrange the tree in another way: leaf by leaf
        ours, theirs = (m.bvh_aabb[m.bvh_nodeid == geom] for m in (nominal, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_a_grown_geom_collides():
    """A sphere beside a wall of two boxes: found only if the trees of boxes grew too."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option gravity="0 0 0"/><worldbody>
        <geom type="box" size=".1 1 1" pos="-.5 1 0"/>
        <geom type="box" size=".1 1 1" pos="-.5 -1 0"/>
        <body><freejoint/><geom name="ball" size=".1"/></body></worldbody></mujoco>"""
    )
    env = SimpleNamespace(model=model, data=mujoco.MjData(model))
    contacts = []
    for size in (0.1, 0.45, 0.1):
        write(env, MujocoPhysics("geom_size[ball,0]"), size)
        mujoco.mj_forward(model, env.data)
        contacts.append(env.data.ncon)
    assert contacts == [0, 2, 0]


def test_writes_leave_the_simulation_state_alone():
    env = arm()
    env.data.qpos[:2] = 0.3, -0.2
    write(env, MujocoPhysics("body_mass[upper]"), 3.0)
    assert env.data.qpos[:2].tolist() == [0.3, -0.2]


@pytest.mark.parametrize(
    ("target", "indices"),
    [
        ("body_mass[upper]", ((1,),)),
        ("body_mass[1]", ((1,),)),
        ("geom_friction[floor,0]", ((0, 0),)),
        ("geom_friction[ body:lower , 1 ]", ((2, 1), (3, 1))),
        ("geom_friction[*,2]", tuple((i, 2) for i in range(5))),
        ("dof_damping[elbow]", ((1,),)),
        ("dof_armature[free]", tuple((i,) for i in range(2, 8))),
        ("jnt_stiffness[shoulder]", ((0,),)),
        ("actuator_gainprm[servo,0]", ((0, 0),)),
        ("actuator_forcerange[motor,1]", ((1, 1),)),
        ("opt.gravity[2]", ((2,),)),
        ("opt.timestep", ((),)),
    ],
)
def test_targets_resolve_by_name_number_body_and_star(target, indices):
    entries = resolve(arm().model, target)
    assert entries.indices == indices
    assert entries.field == target.split("[")[0]


@pytest.mark.parametrize(
    ("target", "match"),
    [
        ("body_mas[upper]", r"'body_mas'.*body_mass \(did you mean"),
        ("nosuch[upper]", "a field of floating-point numbers"),
        ("geom_type[floor]", "a field of floating-point numbers"),
        ("opt.iterations", r"'opt\.iterations'.*opt\."),
        ("stat.extent", "a field of floating-point numbers"),
        ("qpos0[0]", "a field of floating-point numbers"),
        ("body_mass[uper]", r"of a body, got 'uper'\. Available: upper \(did you mean"),
        ("dof_damping[shoulde]", r"of a joint, got 'shoulde'\. Available: shoulder"),
        ("geom_friction[body:lowr,0]", r"of a body, got 'lowr'.*lower"),
        ("body_mass[17]", "a number below 4, of a body, got '17'"),
        ("geom_friction[floor]", r"a column, 0 to 2.*Try: geom_friction\[floor,0\]"),
        ("geom_friction[floor,3]", "a column of geom_friction, 0 to 2, got '3'"),
        ("geom_friction[floor,x]", "a column of geom_friction, 0 to 2, got 'x'"),
        ("opt.gravity[3]", r"a column of opt\.gravity, 0 to 2, got '3'"),
        ("opt.gravity", r"a column of opt\.gravity, 0 to 2"),
        ("opt.timestep[0]", "alone, a single number"),
        ("body_mass", r"body_mass\[selector\].*\[\*\] for all"),
        ("body_mass[]", r"field\[selector,column\]"),
        ("geom_friction[body:world2,0]", "of a body"),
        ("site_pos[*,0]", r"at least one site selected by, got '\*'"),
    ],
)
def test_what_cannot_be_resolved_is_a_clear_error(target, match):
    with pytest.raises(PhysicsError, match=match):
        resolve(arm().model, target)


def test_a_body_without_geoms_selects_nothing():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='empty'/><geom size='1'/></worldbody></mujoco>"
    )
    with pytest.raises(PhysicsError, match="at least one geom selected by, got 'body:empty'"):
        resolve(model, "geom_friction[body:empty,0]")
    env = SimpleNamespace(model=model, data=mujoco.MjData(model))
    with pytest.raises(PhysicsError, match="a body that has a nominal mass"):
        write(env, MujocoPhysics("body_mass[empty]"), 1.0)


def test_an_alias_sets_all_its_targets_and_a_minus_the_negative():
    env = arm()
    physics = MujocoPhysics(kp=("actuator_gainprm[servo,0]", "-actuator_biasprm[servo,1]"))
    assert physics.names == ("kp",)
    assert physics.read(env, tensordict=TensorDict()) == 20
    assert write(env, physics, 35.0) == 35
    assert env.model.actuator_gainprm[0, 0] == 35
    assert env.model.actuator_biasprm[0, 1] == -35


def test_entries_that_differ_read_as_nan_and_nan_restores_each():
    env = arm()
    physics = MujocoPhysics(friction=("geom_friction[floor,0]", "geom_friction[body:lower,0]"))
    assert physics.read(env, tensordict=TensorDict()).isnan().all()
    assert write(env, physics, 0.3) == 0.3
    assert write(env, physics, float("nan")).isnan().all()
    assert env.model.geom_friction[[0, 2, 3], 0].tolist() == [0.5, 0.7, 0.7]


def test_inertia_may_be_a_parameter_beside_mass():
    env = arm()
    physics = MujocoPhysics("body_inertia[upper,0]", "body_mass[upper]")
    assert write(env, physics, 0.5, 4.0).tolist() == [0.5, 4.0]
    assert env.model.body_inertia[1].tolist() == [0.5, 0.4, 0.5]


def test_a_plane_has_no_size_to_set():
    with pytest.raises(PhysicsError, match=r"size is free, got 'mjGEOM_PLANE'.*mjGEOM_BOX"):
        write(arm(), MujocoPhysics("geom_size[floor,0]"), 0.3)


@pytest.mark.parametrize(("targets", "aliases"), [((), {}), (("a", "a"), {}), ((), {"a": ()})])
def test_parameters_must_be_given_once(targets, aliases):
    with pytest.raises(ValueError, match="parameters, each once and with a target"):
        MujocoPhysics(*targets, **aliases)


@pytest.mark.parametrize(("targets", "aliases"), [((1,), {}), ((), {"a": None}), ((), {"a": [2]})])
def test_targets_are_names(targets, aliases):
    with pytest.raises(TypeError, match=r"the name of an entry of a model, got"):
        MujocoPhysics(*targets, **aliases)


def test_an_environment_without_a_model_is_refused():
    with pytest.raises(PhysicsError, match="an environment with an MjModel, got 'PendulumEnv'"):
        TransformedEnv(GymEnv("Pendulum-v1"), ApplyPhysics(MujocoPhysics("body_mass[pole]")))


def test_units_are_known_for_what_has_one_unit():
    physics = MujocoPhysics("body_mass[a]", "geom_friction[b,0]", kp="-actuator_biasprm[c,1]")
    assert physics.units == ("kg", "", "")


FETCH = {"friction": ("geom_friction[body:table0,0]", "geom_friction[object0,0]")}
REAL = {
    "gymnasium": (
        lambda: GymEnv("Hopper-v5"),
        MujocoPhysics("body_mass[torso]", "dof_damping[leg_joint]", "opt.gravity[2]"),
    ),
    "fetch": (lambda: GymEnv("FetchPush-v4"), MujocoPhysics("body_mass[object0]", **FETCH)),
    "dm_control": (
        lambda: DMControlEnv("cartpole", "swingup"),
        MujocoPhysics("body_mass[pole_1]", "dof_damping[slider]", "actuator_gear[slide,0]"),
    ),
    "torchrl": (
        lambda: HopperEnv(backend="mujoco"),
        MujocoPhysics("body_mass[torso]", "opt.timestep"),
    ),
    "batched": (
        lambda: BatchedMujocoEnv("Hopper-v5", 3),
        MujocoPhysics("body_mass[torso]", "dof_damping[leg_joint]", "geom_friction[floor,0]"),
    ),
}


class AroundNominal:
    def __init__(self, nominal):
        self.nominal = nominal

    def sample(self, shape, *, generator):
        factors = 0.7 + 0.6 * torch.rand((*shape, len(self.nominal)), generator=generator)
        return self.nominal * factors


@pytest.mark.parametrize("name", REAL)
def test_real_simulators_hold_theta_at_every_step(name):
    make, physics = REAL[name]
    env = TransformedEnv(make(), ApplyPhysics(physics))
    base = env.base_env
    nominal = env.reset()["theta"].reshape(-1, len(physics.names))[0]
    env.append_transform(DomainRandomizer(AroundNominal(nominal)))
    td, seen = env.reset(), []
    for step in range(8):
        _, td = env.step_and_maybe_reset(env.rand_action(td))
        held = physics.read(base, tensordict=td).float()
        torch.testing.assert_close(td["theta"], held, rtol=1e-6, atol=0)
        if step == 4:
            td = env.reset(td)
        seen.append(td["theta"].clone())
    assert (seen[0] != seen[-1]).all()
    assert ((seen[0] / nominal - 1).abs() > 1e-4).all()


def test_batched_environments_differ_and_partial_resets_write_only_theirs():
    make, physics = REAL["batched"]
    env = TransformedEnv(make(), ApplyPhysics(physics))
    theta = torch.tensor([[1.0], [2.0], [3.0]]) * torch.tensor([1.0, 0.5, 0.3])
    env.reset(TensorDict(theta=theta, batch_size=3))
    reset = torch.tensor([[False], [True], [False]])
    td = TensorDict({"theta": theta + 1, "_reset": reset}, batch_size=3)
    env.reset(td)
    held = physics.read(env.base_env, tensordict=td).float()
    torch.testing.assert_close(held, torch.where(reset, theta + 1, theta))
    inertia = env.base_env.models.read("body_inertia", (1, 0))
    nominal = env.base_env.models.model
    expected = nominal.body_inertia[1, 0] * held[:, 0].numpy() / nominal.body_mass[1]
    np.testing.assert_allclose(inertia, expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["FetchPush-v4", "FetchSlide-v4"])
def test_friction_of_both_geoms_is_the_friction_of_their_contact(name):
    """MuJoCo takes the maximum: setting one geom alone would leave the other's value."""
    env = TransformedEnv(GymEnv(name), ApplyPhysics(MujocoPhysics(**FETCH)))
    fetch = env.unwrapped
    table = fetch.model.body("table0").id
    for friction in (0.25, 0.6, 0.05):
        env.reset(TensorDict(theta=torch.tensor([friction])))
        env.rand_step(env.reset(TensorDict(theta=torch.tensor([friction]))))
        bodies = fetch.model.geom_bodyid[fetch.data.contact.geom]
        between = (bodies == table).any(1) & (bodies == fetch.model.body("object0").id).any(1)
        assert between.any()
        np.testing.assert_allclose(fetch.data.contact.friction[between, 0], friction, rtol=1e-6)


@pytest.mark.parametrize(
    ("target", "moved"),
    [
        ("body_ipos[torso,0]", "xipos"),
        ("geom_pos[torso_geom,0]", "geom_xpos"),
    ],
)
def test_a_frame_that_coincides_with_its_body_s_can_be_moved(target, moved):
    """MuJoCo ignores the place of such a frame until it is told that it moved."""
    env = TransformedEnv(GymEnv("Hopper-v5"), ApplyPhysics(MujocoPhysics(target)))
    model, data = env.unwrapped.model, env.unwrapped.data
    assert model.body("torso").sameframe or model.geom("torso_geom").sameframe
    mujoco.mj_forward(model, data)
    before = getattr(data, moved).copy()
    env.reset(env.full_state_spec.zero().set("theta", torch.tensor([0.1])))
    data.qpos[:] = model.qpos0
    mujoco.mj_forward(model, data)
    shift = np.abs(getattr(data, moved) - before).max()
    assert shift > 0.05


def test_moving_a_centre_of_mass_does_the_same_in_one_environment_and_in_a_batch():
    physics, theta = MujocoPhysics("body_ipos[torso,0]"), torch.tensor([[0.1], [0.1]])
    batch = TransformedEnv(BatchedMujocoEnv("Hopper-v5", 2), ApplyPhysics(physics))
    batch.reset(batch.full_state_spec.zero().set("theta", theta))
    single = TransformedEnv(GymEnv("Hopper-v5"), ApplyPhysics(physics))
    single.reset(single.full_state_spec.zero().set("theta", theta[0]))
    copy, own = batch.base_env.models.copy_of(0), single.unwrapped.model
    for name in ("body_ipos", "body_invweight0", "dof_M0"):
        np.testing.assert_allclose(getattr(copy, name), getattr(own, name), rtol=1e-12)
    ends = []
    for model in (copy, own):
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=20)
        ends.append(data.qpos)
    # short cuts for a frame that is only shifted change the order of operations
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-10)


def test_a_centre_of_mass_that_mujoco_fixes_at_the_origin_cannot_be_moved():
    with pytest.raises(PhysicsError, match="a body whose mass matrix may change, to set body_ipos"):
        write(arm(), MujocoPhysics("body_ipos[ball,0]"), 0.1)
