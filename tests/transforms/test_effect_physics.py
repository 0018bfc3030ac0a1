import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, GymEnv, TransformedEnv, check_env_specs

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.conformance import PhysicsTests
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import ApplyEffect, ApplyPhysics, DomainRandomizer, EffectPhysics

torch.set_num_threads(1)
NAME = "InvertedPendulum-v5"
PRIOR = BoxPrior(
    {
        "body_mass[pole]": (3.0, 6.0),
        "coulomb_friction[hinge]": (0.0, 0.4),
        "constant_force[all]": (-1.0, 1.0),
        "action_gain[slide]": (-0.3, 0.3),
    }
)


def parts():
    effects = [ApplyEffect(n, 0.0) for n in ("coulomb_friction", "constant_force", "action_gain")]
    friction, force, gain = effects
    physics = EffectPhysics(
        MujocoPhysics("body_mass[pole]"), (friction, "hinge"), (force, "all"), (gain, "slide")
    )
    return physics, effects


def test_a_distribution_over_parameters_and_strengths_drives_both():
    physics, effects = parts()
    assert physics.names == PRIOR.names
    assert physics.units == ("kg", "N m", "N m", "fraction")
    chain = Compose(ApplyPhysics(physics), *effects, DomainRandomizer(PRIOR))
    env = TransformedEnv(BatchedMujocoEnv(NAME, 3, threads=1), chain)
    check_env_specs(env)
    for _ in range(2):
        theta = env.reset()["theta"]
        assert len(theta.unique(dim=0)) == 3
        models = env.base_env.models
        torch.testing.assert_close(
            torch.from_numpy(models.read("body_mass", (2,))).float(), theta[:, 0]
        )
        torch.testing.assert_close(
            torch.from_numpy(models.read("dof_frictionloss", (1,))).float(), theta[:, 1]
        )
        torch.testing.assert_close(effects[1].strength.float(), theta[:, 2:3].expand(-1, 2))
        torch.testing.assert_close(effects[2].strength.float(), theta[:, 3:])
        assert (models.read("dof_frictionloss", (0,)) == 0).all()


def test_a_partial_reset_changes_the_strengths_of_those_environments_alone():
    physics, effects = parts()
    chain = Compose(ApplyPhysics(physics), *effects, DomainRandomizer(PRIOR))
    env = TransformedEnv(BatchedMujocoEnv(NAME, 2, threads=1), chain)
    first = env.reset()
    mask = TensorDict({"_reset": torch.tensor([[False], [True]])}, [2])
    again = env.reset(first.clone().update(mask))["theta"]
    assert torch.equal(again[0], first["theta"][0])
    assert not torch.equal(again[1], first["theta"][1])
    torch.testing.assert_close(effects[2].strength[:, 0].float(), again[:, 3])


def test_a_reset_without_parameters_restores_the_strengths_given_first():
    friction = ApplyEffect("coulomb_friction", {"hinge": 0.2})
    physics = EffectPhysics(None, (friction, "hinge"))
    env = TransformedEnv(GymEnv(NAME), Compose(ApplyPhysics(physics), friction))
    state = env.full_state_spec.zero()
    assert env.reset(state.set("theta", torch.tensor([0.3])))["theta"].item() == pytest.approx(0.3)
    assert env.base_env._env.unwrapped.model.dof_frictionloss[1] == pytest.approx(0.3)
    assert env.reset()["theta"].item() == pytest.approx(0.2)
    assert env.base_env._env.unwrapped.model.dof_frictionloss[1] == pytest.approx(0.2)


def test_errors_say_what_is_wrong():
    friction = ApplyEffect("coulomb_friction", 0.0)
    with pytest.raises(ValueError, match="strengths, each once"):
        EffectPhysics(None)
    with pytest.raises(ValueError, match="strengths, each once"):
        EffectPhysics(None, (friction, "hinge"), (friction, "hinge"))
    chain = Compose(ApplyPhysics(EffectPhysics(None, (friction, "knee"))), friction)
    with pytest.raises(KeyError, match="a target of coulomb_friction"):
        TransformedEnv(GymEnv(NAME), chain)


def test_targets_that_differ_stay_so_until_one_strength_is_written():
    force = ApplyEffect("constant_force", {"hinge": 0.5})
    chain = Compose(ApplyPhysics(EffectPhysics(None, (force, "all"))), force)
    env = TransformedEnv(GymEnv(NAME), chain)
    assert env.reset()["theta"].isnan().all()
    assert force.strength.tolist() == [0.0, 0.5]
    env.reset(env.full_state_spec.zero().set("theta", torch.tensor([0.25])))
    assert force.strength.tolist() == [0.25, 0.25]


class OwnPhysics:
    """An `EffectPhysics` belongs to the environment of its transforms: this finds it there."""

    names = ("body_mass[pole]", "coulomb_friction[hinge]", "action_delay[slide]")

    def write(self, env, theta, *, mask, tensordict):
        own = env.__dict__["own_physics"]
        own.write(env.base_env, theta, mask=mask, tensordict=tensordict)

    def read(self, env, *, tensordict):
        return env.__dict__["own_physics"].read(env.base_env, tensordict=tensordict)


class TestConformance(PhysicsTests):
    physics = OwnPhysics()
    low, high = (3.0, 0.0, 0.0), (6.0, 0.4, 0.1)

    def make_simulator(self):
        return GymEnv(NAME)

    def make_env(self):
        friction, delay = ApplyEffect("coulomb_friction", 0.0), ApplyEffect("action_delay", 0.0)
        env = TransformedEnv(self.make_simulator(), Compose(friction, delay))
        strengths = (friction, "hinge"), (delay, "slide")
        own = EffectPhysics(MujocoPhysics("body_mass[pole]"), *strengths)
        assert own.names == OwnPhysics.names
        env.__dict__["own_physics"] = own
        return env


class TestConformanceInABatch(TestConformance):
    def make_simulator(self):
        return BatchedMujocoEnv(NAME, 2, threads=1)
