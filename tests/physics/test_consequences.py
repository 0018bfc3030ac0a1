"""What follows from an entry follows, in one model and in many; the rest is refused."""

import copy

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.consequences import DERIVED_FROM
from torchrl_bayessim.physics.model_fields import resolve
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.physics.mujoco_models import MujocoModels
from torchrl_bayessim.transforms import ApplyPhysics

TREE = """<mujoco><worldbody><body><freejoint/><inertial pos="{ipos}" mass="1"
  quat="{iquat}" diaginertia="1 1.1 1.2"/>
  <geom name="pad" type="box" size=".1 .1 .2" pos="{pos}" quat="{quat}" margin="{margin}"/>
  <geom type="capsule" size=".1 .3" pos="0 .4 0" euler="0 70 5" gap=".01"/>
  <geom type="ellipsoid" size=".3 .2 .3" pos="0 -.4 .1"/>
  </body></worldbody></mujoco>"""
NOMINAL = {"ipos": (0.1, 0.2, 0), "iquat": (1, 0, 0, 0), "margin": (0.02,)}
NOMINAL |= {"pos": (0.3, 0, 0), "quat": (1, 0, 0, 0)}
FIELDS = {"ipos": "body_ipos", "iquat": "body_iquat", "pos": "geom_pos", "quat": "geom_quat"}
FIELDS |= {"margin": "geom_margin"}


def compiled(**changes):
    numbers = {name: " ".join(map(str, value)) for name, value in (NOMINAL | changes).items()}
    return mujoco.MjModel.from_xml_string(TREE.format(**numbers))


def entries(name, value):
    """The places of a vector or number in the model, with their values."""
    row = 1 if name.startswith("i") else 0
    for column, number in enumerate(value):
        yield FIELDS[name], (row,) if name == "margin" else (row, column), number


def single(name, value):
    models, everyone = MujocoModels(compiled()), np.ones(1, dtype=bool)
    for field, indices, number in entries(name, value):
        models.write(field, indices, np.array([number]), everyone)
    models.refresh(everyone)
    return models.model


def batched(name, value):
    models = ModelBatch(compiled(), 3)
    for field, indices, number in entries(name, value):
        nominal = models.read(field, indices)
        models.write(field, indices, np.array([nominal[0], number, nominal[0]]))
    models.refresh(np.array([False, True, False]))
    return models.copy_of(1)


@pytest.mark.parametrize("model_with", [single, batched])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("pos", (2.0, -1.0, 0.5)),
        ("quat", (0.8, 0.0, 0.6, 0.0)),
        ("ipos", (-1.0, 0.3, 0.2)),
        ("iquat", (0.6, 0.48, 0.0, 0.64)),
        ("margin", (0.3,)),
    ],
)
def test_bounds_of_what_has_moved_are_those_that_the_compiler_makes(model_with, name, value):
    got, expected, nominal = model_with(name, value), compiled(**{name: value}), compiled()
    np.testing.assert_allclose(got.body_margin, expected.body_margin)
    np.testing.assert_allclose(got.geom_aabb, expected.geom_aabb)
    for geom in range(3):  # the compiler may arrange the tree in another way: leaf by leaf
        ours, theirs = (m.bvh_aabb[m.bvh_nodeid == geom] for m in (got, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    np.testing.assert_allclose(got.bvh_aabb[0], expected.bvh_aabb[0], atol=1e-12)
    changed = np.abs(got.bvh_aabb - nominal.bvh_aabb).max() + got.body_margin[1]
    assert changed > 0.03


def test_a_moved_geom_collides_in_its_own_environment_only():
    """Two balls on a stick, one of which is moved over the edge of the lower of two steps."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><geom type="box" size="1 1 .1"/>
        <geom type="box" size="1 1 .1" pos="9 0 0"/></body>
        <body pos="0 0 .25"><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/>
        <geom name="ball" size=".1" pos="4 0 0" mass="0"/></body></worldbody></mujoco>"""
    )
    balls = Stepper(model, 2, threads=1)
    balls.models.write("geom_pos", (3, 2), np.array([0.0, -0.1]))
    balls.models.write("geom_pos", (3, 0), np.array([4.0, 9.0]))
    balls.models.refresh()
    balls.begin()
    balls.rollout(np.zeros((2, 1, 0)), substeps=2000)
    heights = balls["qpos"][:, 0]
    assert heights[0] == pytest.approx(-0.05, abs=0.01)  # its own ball rests
    assert heights[1] == pytest.approx(0.05, abs=0.01)  # the moved one does, 0.1 m lower


@pytest.mark.parametrize("field", ["body_gravcomp", "actuator_damping", "actuator_armature"])
def test_what_mujoco_skips_while_it_is_zero_acts_in_a_batch(field):
    xml = """<mujoco><worldbody><body {}><joint name="x" type="slide" axis="0 0 1"/>
    <geom size=".1"/></body></worldbody>
    <actuator><motor joint="x" {}/></actuator></mujoco>"""
    attribute = field.split("_")[1] + '="{}"'
    texts = [attribute.format(value) if value else "" for value in (0.0, 0.5, 1.0)]
    pairs = [(text, "") if "gravcomp" in field else ("", text) for text in texts]
    own = [mujoco.MjModel.from_xml_string(xml.format(*pair)) for pair in pairs]
    bodies = Stepper(own[0], 3, threads=1)
    row = 1 if "gravcomp" in field else 0
    bodies.models.write(field, (row,), np.array([0.0, 0.5, 1.0]))
    bodies.models.refresh()
    bodies.begin()
    bodies.rollout(np.ones((3, 1, 1)), substeps=50)
    for i, model in enumerate(own):
        data = mujoco.MjData(model)
        data.ctrl[:] = 1.0
        mujoco.mj_step(model, data, nstep=50)
        np.testing.assert_array_equal(bodies["qpos"][i], data.qpos)
    assert len(np.unique(bodies["qpos"])) == 3


def test_a_loop_closes_where_the_moved_body_is():
    xml = """<mujoco><worldbody>
    <body name="a" pos="{} 0 1"><joint axis="0 1 0"/><geom size=".1" pos="0 0 -.5"/></body>
    <body name="b" pos="1 0 1"><joint axis="0 1 0"/><geom size=".1" pos="0 0 -.5"/></body>
    </worldbody><equality><connect body1="a" body2="b" anchor=".5 0 0"/></equality></mujoco>"""
    models = ModelBatch(mujoco.MjModel.from_xml_string(xml.format(0)), 2)
    models.write("body_pos", (1, 0), np.array([0.0, 0.2]))
    models.refresh()
    for i, place in enumerate((0, 0.2)):
        expected = mujoco.MjModel.from_xml_string(xml.format(place)).eq_data
        np.testing.assert_allclose(models.copy_of(i).eq_data, expected)


def test_cloth_of_another_mass_hangs_as_in_a_model_of_its_own():
    """The weight of an edge's constraint follows from the masses of its vertices."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep=".001"/><worldbody>
    <flexcomp name="cloth" type="grid" count="4 4 1" spacing=".1 .1 .1" dim="2" mass="1"
      radius=".01"><edge equality="true"/><pin id="0 3"/></flexcomp></worldbody></mujoco>""")
    cloths = Stepper(model, 2, threads=1)
    vertices = np.flatnonzero(model.body_mass)
    physics = MujocoPhysics(mass=tuple(f"body_mass[{i}]" for i in vertices))
    mass = model.body_mass.max()
    write(Batched(cloths.models), physics, [mass], [5 * mass])
    cloths.begin()
    cloths.rollout(np.zeros((2, 1, 0)), substeps=200)
    for i, factor in enumerate((1, 5)):
        own = copy.copy(model)
        own.body_mass *= factor
        own.body_inertia *= factor
        mujoco.mj_setConst(own, mujoco.MjData(own))
        data = mujoco.MjData(own)
        mujoco.mj_step(own, data, nstep=200)
        np.testing.assert_array_equal(cloths["qpos"][i], data.qpos)
    changed = cloths.models.read("flexedge_invweight0", (3,))
    assert changed[1] == pytest.approx(changed[0] / 5)
    assert (cloths["qpos"][0] != cloths["qpos"][1]).any()


REFUSED = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body name="ball"><joint name="x" type="slide"/><geom name="g" size=".1"/><site name="s"/></body>
  <body name="top" pos="0 0 1"><site name="t"/></body>
  <body name="free" pos="0 2 1"><freejoint name="f"/><geom size=".1" pos="1 0 0"/></body>
  <body name="hand" mocap="true"/></worldbody>
  <tendon><spatial name="rope"><site site="s"/><site site="t"/></spatial></tendon>
  <actuator><motor name="m" joint="x"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("target", "match"),
    [
        ("body_subtreemass[ball]", "nothing else determines"),
        ("geom_rbound[g]", "nothing else determines"),
        ("actuator_acc0[m]", "nothing else determines"),
        ("body_ipos[ball,0]", "mass matrix may change.*simple='false'"),
        ("jnt_axis[x,0]", "mass matrix may change, to set jnt_axis, got 'ball'"),
        ("tendon_armature[rope]", "not zero in the nominal model"),
        ("jnt_range[x,0]", r"jnt_range that acts.*Try: set jnt_limited"),
        ("jnt_margin[x]", "Try: set jnt_limited"),
        ("jnt_solref[x,0]", "Try: set jnt_limited"),
        ("jnt_solimp[x,0]", "Try: set jnt_limited"),
        ("jnt_pos[f,0]", "a joint that is not free"),
        ("body_pos[free,0]", "a body without a free joint.*Try: place it by its qpos"),
        ("body_quat[free,0]", "a body without a free joint"),
        ("body_pos[hand,0]", "a body that is not mocap.*Try: place it by mocap_pos"),
        ("tendon_margin[rope]", "Try: set tendon_limited"),
        ("tendon_solref_lim[rope,0]", "Try: set tendon_limited"),
        ("tendon_solimp_lim[rope,0]", "Try: set tendon_limited"),
        ("tendon_solref_fri[rope,0]", r"Try: set tendon_frictionloss\[0\] too"),
        ("dof_solref[x,0]", r"Try: set dof_frictionloss\[0\] too"),
        ("dof_solimp[x,2]", r"Try: set dof_frictionloss\[0\] too"),
        ("geom_fluid[g,0]", "Try: set opt.density or opt.viscosity too"),
        ("opt.wind[0]", "Try: set opt.density or opt.viscosity too"),
        ("actuator_delay[m]", "Try: set nsample"),
        ("actuator_cranklength[m]", "Try: set cranksite"),
        ("actuator_lengthrange[m,0]", "a muscle as actuator"),
        ("actuator_ctrlrange[m,1]", "Try: set actuator_ctrllimited"),
        ("actuator_forcerange[m,1]", "Try: set actuator_forcelimited"),
        ("actuator_biasprm[m,1]", "Try: set actuator_biastype"),
        ("actuator_dynprm[m,0]", "Try: set actuator_dyntype"),
        ("tendon_range[rope,1]", "Try: set tendon_limited"),
        ("opt.o_margin", "a model that overrides contacts"),
        ("geom_size[floor,0]", "size is free, got 'mjGEOM_PLANE'"),
    ],
)
def test_entries_that_cannot_be_set_or_to_no_effect_are_refused(target, match):
    model = mujoco.MjModel.from_xml_string(REFUSED)
    for env in (Single(model), Batched(model)):
        with pytest.raises(PhysicsError, match=match):
            write(env, MujocoPhysics(target), 0.5)


@pytest.mark.parametrize(
    ("idle", "along", "value"),
    [
        ("dof_solref[x,0]", "dof_frictionloss[x]", 0.3),
        ("geom_fluid[g,0]", "opt.density", 5.0),
        ("opt.wind[0]", "opt.viscosity", 0.5),
    ],
)
def test_what_acts_together_with_another_entry_is_set_together_with_it(idle, along, value):
    model = mujoco.MjModel.from_xml_string(REFUSED)
    for physics in (MujocoPhysics(idle, along), MujocoPhysics(along, idle)):
        for env in (Single(copy.copy(model)), Batched(model)):
            assert (write(env, physics, value, value) == value).all()
    models = ModelBatch(model, 2)  # and one after the other
    for target in (along, idle):
        place = resolve(model, target)
        models.write(place.field, place.indices[0], np.full(2, value))
    np.testing.assert_array_equal(models.read(place.field, place.indices[0]), value)


class Single:
    def __init__(self, model):
        self.model = model


class Batched:
    def __init__(self, model):
        self._models = model if isinstance(model, ModelBatch) else ModelBatch(model, 2)
        self.batch_size = (2,)

    @property
    def models(self):
        return self._models


def write(env, physics, *values):
    batch = getattr(env, "batch_size", ())
    theta = torch.tensor(values, dtype=torch.float64).expand(*batch, -1)
    mask = torch.ones(batch or 1, dtype=torch.bool)
    physics.write(env, theta, mask=mask, tensordict=TensorDict())
    return physics.read(env, tensordict=TensorDict())


@pytest.mark.parametrize(
    ("target", "value", "kind"),
    [
        ("body_mass[ball]", -1.0, "finite and not negative"),
        ("body_mass[ball]", np.inf, "finite and not negative"),
        ("body_inertia[ball,1]", -1e-9, "finite and not negative"),
        ("geom_size[g,0]", -0.1, "finite and not negative"),
        ("geom_friction[g,0]", -1.0, "finite and not negative"),
        ("dof_frictionloss[x]", -1.0, "finite and not negative"),
        ("opt.timestep", 0.0, "finite and positive"),
        ("opt.gravity[2]", -np.inf, "finite"),
    ],
)
def test_values_that_no_body_has_are_refused_and_nothing_is_written(target, value, kind):
    model = mujoco.MjModel.from_xml_string(REFUSED)
    physics = MujocoPhysics("dof_damping[x]", target)
    for env in (Single(model), Batched(model)):
        before = physics.read(env, tensordict=TensorDict())
        with pytest.raises(PhysicsError, match=rf"{target.split('[')[0]}.* to be {kind}, got"):
            write(env, physics, 3.0, value)
        torch.testing.assert_close(physics.read(env, tensordict=TensorDict()), before)


def test_values_that_no_body_has_are_refused_where_they_are_written_directly():
    models = ModelBatch(mujoco.MjModel.from_xml_string(REFUSED), 3)
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(PhysicsError, match=rf"body_mass\[1\] to be finite.*got {bad}"):
            models.write("body_mass", (1,), np.array([1.0, bad, 1.0]))
    one = np.array([True, False, True])
    models.write("body_mass", (1,), np.array([1.0, -1.0, 2.0]), one)  # the bad one is not written
    assert models.read("body_mass", (1,))[[0, 2]].tolist() == [1.0, 2.0]


def test_a_quaternion_must_be_of_unit_length():
    models = ModelBatch(compiled(), 2)
    models.write("geom_quat", (0, 1), np.array([0.0, 0.5]))
    with pytest.raises(PhysicsError, match=r"geom_quat\[0\] of length 1, got 1.118"):
        models.refresh()


def test_a_negative_mass_reaches_no_simulator(tmp_path, monkeypatch):
    """MuJoCo would print, and write MUJOCO_LOG.TXT."""
    monkeypatch.chdir(tmp_path)
    physics = ApplyPhysics(MujocoPhysics("body_mass[torso]"))
    for env in (GymEnv("Hopper-v5"), BatchedMujocoEnv("Hopper-v5", 2)):
        transformed = TransformedEnv(env, physics.clone())
        theta = torch.full((*env.batch_size, 1), -2.0)
        with pytest.raises(PhysicsError, match=r"body_mass\[1\] to be finite and not negative"):
            transformed.reset(TensorDict(theta=theta, batch_size=env.batch_size))
    assert not list(tmp_path.iterdir())


def test_every_field_with_consequences_exists():
    model = compiled()
    assert all(hasattr(model, field) for field in DERIVED_FROM)
