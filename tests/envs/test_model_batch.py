import mujoco
import numpy as np
import pytest

from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.assignments import assignments
from torchrl_bayessim.physics.model_fields import resolve
from torchrl_bayessim.physics.mujoco_models import MujocoModels

ARM = """
<mujoco>
  <option timestep="0.01" density="1"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="rod" type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/>
      <body name="hand" pos=".4 0 0">
        <joint name="wrist" type="hinge" axis="0 1 0"/>
        <geom name="palm" type="box" size=".05 .05 .02" mass=".3"/>
      </body>
    </body>
    <body name="ball" pos="0 1 .3"><freejoint/><geom size=".1" mass=".2"/></body>
  </worldbody>
  <actuator><motor joint="shoulder"/></actuator>
</mujoco>
"""


def model():
    return mujoco.MjModel.from_xml_string(ARM)


def trajectory(changed):
    data = mujoco.MjData(changed)
    mujoco.mj_step(changed, data, nstep=100)
    return data.qpos


def batched(field, indices, values, *, refresh=True, command=0.0, substeps=100):
    arms = Stepper(model(), len(values), threads=1)
    arms.models.write(field, indices, np.asarray(values))
    if refresh:
        arms.models.refresh()
    arms.begin()
    arms.rollout(np.full((len(values), 1, 1), command), substeps=substeps)
    return arms["qpos"]


@pytest.mark.parametrize(
    ("field", "indices", "values"),
    [
        ("body_mass", (2,), [0.1, 2.0]),
        ("geom_friction", (0, 0), [0.1, 2.0]),
        ("dof_damping", (0,), [0.0, 0.7]),
        ("opt.gravity", (2,), [-9.0, -1.0]),
        ("opt.timestep", (), [0.002, 0.004]),
        ("opt.density", (), [0.0, 50.0]),
        ("opt.viscosity", (), [0.5, 1.0]),
        ("body_ipos", (2, 0), [0.05, 0.1]),
    ],
)
def test_an_entry_acts_as_in_a_model_of_its_own(field, indices, values):
    got = batched(field, indices, values)
    for i, value in enumerate(values):
        own = model()
        if field.startswith("opt.") and not indices:
            setattr(own.opt, field[4:], value)
        else:
            array = getattr(own.opt if "opt" in field else own, field.removeprefix("opt."))
            array[indices] = value
        own.body_sameframe[:] = 0
        mujoco.mj_setConst(own, mujoco.MjData(own))
        # turning a short cut off changes the order of operations, not the mathematics
        tolerance = 1e-12 if field == "body_ipos" else 0
        np.testing.assert_allclose(got[i], trajectory(own), rtol=0, atol=tolerance)
    assert np.abs(got[0] - got[1]).max() > 1e-6


def test_refresh_derives_what_mujoco_derives():
    models = ModelBatch(model(), 2)
    for body in (1, 2):
        models.write("body_mass", (body,), np.array([1.5, 0.5]))
    models.refresh()
    for i, mass in enumerate((1.5, 0.5)):
        own = model()
        own.body_mass[1:3] = mass
        mujoco.mj_setConst(own, mujoco.MjData(own))
        copy = models.copy_of(i)
        for field in dir(own):
            value = getattr(own, field)
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                np.testing.assert_array_equal(getattr(copy, field), value, err_msg=field)
        assert copy.stat.meaninertia == own.stat.meaninertia


def test_only_the_masked_rows_are_written_and_refreshed():
    models = ModelBatch(model(), 3)
    models.write("body_mass", (1,), np.array([2.0, 3.0, 4.0]))
    models.refresh(np.array([False, True, False]))
    assert models.read("body_subtreemass", (1,)).tolist() == [1.3, 3.3, 1.3]
    models.write("body_mass", (1,), np.zeros(3), np.array([True, False, False]))
    assert models.read("body_mass", (1,)).tolist() == [0.0, 3.0, 4.0]


def test_the_nominal_model_is_never_changed():
    nominal = model()
    models = ModelBatch(nominal, 2)
    models.write("body_mass", (1,), np.array([5.0, 6.0]))
    models.refresh()
    assert nominal.body_mass[1] == 1.0
    assert nominal.body_subtreemass[0] == pytest.approx(1.5)


def test_reading_an_entry_that_nobody_wrote_gives_the_nominal_value():
    assert ModelBatch(model(), 2).read("opt.timestep", ()).tolist() == [0.01, 0.01]


@pytest.mark.parametrize(
    ("field", "indices", "match"),
    [
        ("body_masses", (1,), r"body_mass \(did you mean this\?\)"),
        ("body_mass", (9,), r"the index of a floating-point number in body_mass of shape \(4,\)"),
        ("body_mass", (), "the index of"),
        ("geom_priority", (0,), "the index of"),
        ("body_ipos", (3, 0), "a body whose mass matrix may change, to set body_ipos"),
    ],
)
def test_an_entry_that_does_not_exist_is_refused(field, indices, match):
    with pytest.raises(PhysicsError, match=match):
        ModelBatch(model(), 2).write(field, indices, np.zeros(2))


def test_a_wrong_number_of_values_or_rows_is_refused():
    models = ModelBatch(model(), 2)
    with pytest.raises(ValueError, match=r"one value per environment, shape \(2,\), got \(3,\)"):
        models.write("body_mass", (1,), np.zeros(3))
    for rows in (np.array([True]), np.array([0, 1])):
        with pytest.raises(ValueError, match=r"a boolean mask of shape \(2,\)"):
            models.write("body_mass", (1,), np.zeros(2), rows)
        with pytest.raises(ValueError, match=r"a boolean mask of shape \(2,\)"):
            models.refresh(rows)


def test_repeated_physics_step_as_the_ones_they_repeat():
    arms = Stepper(model(), 2, threads=1)
    arms.models.write("body_mass", (2,), np.array([0.1, 2.0]))
    arms.models.refresh()
    many = Stepper(model(), 4, threads=1)
    many.use(arms.models.repeated(2))
    for stepper in (arms, many):
        stepper.begin()
        stepper.rollout(np.zeros((stepper.num_envs, 1, 1)), substeps=20)
    np.testing.assert_array_equal(many["qpos"], np.repeat(arms["qpos"], 2, axis=0))
    assert (arms["qpos"][0] != arms["qpos"][1]).any()


def test_other_physics_leave_nothing_of_the_former_behind():
    """A thread's model, which the former physics have written to, is nominal elsewhere."""
    arms = Stepper(model(), 2, threads=1)
    arms.models.write("dof_damping", (0,), np.array([5.0, 6.0]))
    arms.begin()
    arms.rollout(np.ones((2, 1, 1)), substeps=1)
    fresh = ModelBatch(model(), 2)
    fresh.write("body_mass", (2,), np.array([0.1, 2.0]))
    arms.use(fresh)
    arms.state[:] = arms.initial
    arms.begin()
    arms.rollout(np.ones((2, 1, 1)), substeps=50)
    alone = batched("body_mass", (2,), [0.1, 2.0], refresh=False, command=1.0, substeps=50)
    np.testing.assert_array_equal(arms["qpos"], alone)


def test_restored_models_are_nominal():
    arms = Stepper(model(), 2, threads=1)
    arms.models.write("body_mass", (2,), np.array([0.1, 2.0]))
    arms.models.refresh()
    arms.models.restore()
    assert (arms.models.read("body_mass", (2,)) == model().body_mass[2]).all()
    assert (arms.models.read("dof_invweight0", (0,)) == model().dof_invweight0[0]).all()


def test_physics_for_another_number_of_environments_are_refused():
    with pytest.raises(ValueError, match="the physics of 3 environments, got 2"):
        Stepper(model(), 3).use(ModelBatch(model(), 2))


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_refresh_what_one_thread_does(threads):
    masses = np.linspace(0.5, 2.0, 100)
    one, several = ModelBatch(model(), 100), ModelBatch(model(), 100, threads=threads)
    for models in (one, several):
        for rows in (None, masses > 1.0):  # the second time with other columns
            models.write("body_mass", (2,), masses, rows)
            models.refresh(rows)
            models.write("dof_armature", (1,), 0.1 * masses)
        models.refresh(np.zeros(100, dtype=bool))  # nobody
        models.refresh()
    np.testing.assert_array_equal(several.table, one.table)
    assert len(np.unique(several.read("body_subtreemass", (1,)))) == 100


def test_parameters_are_assigned_to_the_rows_of_a_mask():
    models = ModelBatch(model(), 3)
    entries = assignments(MujocoModels(model(), models), [[resolve(model(), "body_mass[1]")]])
    rows = np.array([True, False, True])
    models.assign(entries, np.array([[4.0], [5.0], [np.nan]]), rows)
    mass, inertia = model().body_mass[1], model().body_inertia[1, 0]
    assert models.read("body_mass", (1,)).tolist() == [4.0, mass, mass]
    assert models.read("body_inertia", (1, 0)).tolist() == [inertia * (4 / mass), inertia, inertia]
    models.assign(entries, np.full((3, 1), mass), rows)  # nominal again, to the last bit
    assert (models.read("body_inertia", (1, 0)) == inertia).all()
    with pytest.raises(ValueError, match=r"a mask of 3 environments, got '\(2, 1\) and \(3,\)'"):
        models.assign(entries, np.zeros((2, 1)), rows)


def test_repeated_physics_keep_their_columns():
    models = ModelBatch(model(), 2)
    models.write("body_mass", (1,), np.array([1.0, 2.0]))
    models.refresh()
    again = models.repeated(3)
    again.refresh()
    np.testing.assert_array_equal(again.table, np.repeat(models.table, 3, axis=0))
