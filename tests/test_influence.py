import pytest
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.influence import check_influence
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

BOTH = ("geom_friction[body:table0,0]", "geom_friction[object0,0]")


def check(env, physics, prior):
    randomizer = DomainRandomizer(prior)
    env = TransformedEnv(env, Compose(ApplyPhysics(physics), randomizer))
    check_influence(env, randomizer, prior, steps=20)
    return env, randomizer


@pytest.mark.parametrize("task", ["FetchPush-v4", "FetchSlide-v4"])
def test_friction_of_table_and_object_is_felt(task):
    prior = BoxPrior({"friction": (0.1, 1.0)})
    env, _ = check(BatchedMujocoEnv(task, 2, threads=1), MujocoPhysics(friction=BOTH), prior)
    assert len(env.reset()["theta"].unique()) == 2  # it draws again


def test_what_the_user_pinned_stays_pinned():
    prior = BoxPrior({"LINK_MASS_1": (0.5, 1.5)})
    randomizer = DomainRandomizer(prior)
    physics = ApplyPhysics(AttributePhysics("LINK_MASS_1"))
    env = TransformedEnv(AcrobotEnv(2, max_steps=100), Compose(physics, randomizer))
    randomizer.pin([0.75])
    check_influence(env, randomizer, prior, steps=20)
    assert (env.reset()["theta"] == 0.75).all()


def test_friction_that_the_table_overrules_is_refused():
    prior = BoxPrior({"friction": (0.1, 1.0)})
    with pytest.raises(PhysicsError, match=r"'friction' to change what is observed.*set both"):
        check(
            BatchedMujocoEnv("FetchPush-v4", 2, threads=1), MujocoPhysics(friction=BOTH[1]), prior
        )


def test_the_one_of_two_parameters_that_nothing_reads_is_named():
    names = ("LINK_MASS_1", "LINK_LENGTH_2")  # Gymnasium's acrobot never uses the latter
    prior = BoxPrior(dict.fromkeys(names, (0.5, 1.5)))
    with pytest.raises(PhysicsError, match="expected 'LINK_LENGTH_2' to change"):
        check(AcrobotEnv(2, max_steps=100), AttributePhysics(*names), prior)
    prior = BoxPrior({"LINK_MASS_1": (0.5, 1.5)})
    check(AcrobotEnv(2, max_steps=100), AttributePhysics("LINK_MASS_1"), prior)
