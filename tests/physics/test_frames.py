import gymnasium
import mujoco
import numpy as np
import pytest

from torchrl_bayessim.envs.model_batch import ModelBatch
from torchrl_bayessim.physics.mujoco_models import MujocoModels

FOOT = 4


def hopper():
    return gymnasium.make("Hopper-v5").unwrapped.model


def places(model):
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xipos[FOOT].copy(), data.geom_xpos[FOOT].copy()


def single(shift):
    models = MujocoModels(hopper())
    old = models.read("body_ipos", (FOOT, 0))
    models.write("body_ipos", (FOOT, 0), old + shift, np.ones(1, dtype=bool))
    models.refresh(np.ones(1, dtype=bool))
    return models.model


def batched(shift):
    models = ModelBatch(hopper(), 2)
    old = models.read("body_ipos", (FOOT, 0))
    models.write("body_ipos", (FOOT, 0), old + np.array([0.0, shift]))
    models.refresh()
    return models.copy_of(1)


@pytest.mark.parametrize("model_with", [single, batched])
def test_a_geom_stays_where_it_is_when_the_centre_of_mass_moves(model_with):
    """The frame of the foot's geom is that of the foot's inertia, and would follow it."""
    assert hopper().geom_sameframe[FOOT] == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA
    (mass, geom), (moved, same) = places(hopper()), places(model_with(0.05))
    np.testing.assert_allclose(np.linalg.norm(moved - mass), 0.05, atol=1e-12)
    np.testing.assert_allclose(same, geom, atol=1e-12)
