import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, GymEnv, TransformedEnv

pytest.importorskip("pybullet_envs_gymnasium")
pytest.importorskip("pybullet")

from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.conformance import PhysicsTests
from torchrl_bayessim.physics.pybullet import PyBulletPhysics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

FRICTION = PyBulletPhysics("lateralFriction[floor]", "lateralFriction[foot]")


def hopper():
    return GymEnv("HopperBulletEnv-v0")


class TestBulletHopper(PhysicsTests):
    physics = FRICTION
    low, high = (0.3, 0.3), (0.5, 1.0)

    def make_env(self):
        return hopper()


def test_hopper_holds_theta_at_every_step():
    class Uniform:
        def sample(self, shape, *, generator):
            return 0.3 + 0.2 * torch.rand((*shape, 2), generator=generator)

    env = TransformedEnv(hopper(), Compose(ApplyPhysics(FRICTION), DomainRandomizer(Uniform())))
    td, seen = env.reset(), set()
    for _ in range(60):
        _, td = env.step_and_maybe_reset(env.rand_action(td))
        held = FRICTION.read(env.base_env, tensordict=td).float()
        torch.testing.assert_close(td["theta"], held)
        seen.add(tuple(held.tolist()))
    assert len(seen) > 1
    env.close()


def test_alias_and_nominal():
    both = PyBulletPhysics(friction=("lateralFriction[floor]", "lateralFriction[foot]"))
    env = TransformedEnv(hopper(), ApplyPhysics(both))
    assert env.reset()["theta"].item() == pytest.approx(0.8)
    assert env.reset(TensorDict(theta=torch.tensor([0.4])))["theta"].item() == pytest.approx(0.4)
    assert env.reset()["theta"].item() == pytest.approx(0.8)
    apart = PyBulletPhysics(friction=("lateralFriction[floor]", "lateralFriction[link0_2]"))
    env = TransformedEnv(hopper(), ApplyPhysics(apart))
    assert env.reset()["theta"].isnan().all()
    assert env.reset(TensorDict(theta=torch.tensor([0.4])))["theta"].item() == pytest.approx(0.4)
    assert env.reset()["theta"].isnan().all()
    floor = PyBulletPhysics("lateralFriction[floor]").read(env.base_env, tensordict=TensorDict())
    assert floor.item() == pytest.approx(0.8)


def test_what_does_not_exist_is_a_clear_error():
    with pytest.raises(PhysicsError, match=r"'friction\[foot\]'\. Available: .*lateralFriction"):
        PyBulletPhysics("friction[foot]")
    with pytest.raises(PhysicsError, match=r"'foott'\. Available: foot \(did you mean this"):
        TransformedEnv(hopper(), ApplyPhysics(PyBulletPhysics("restitution[foott]")))
    with pytest.raises(ValueError, match="parameters, each once and with a target"):
        PyBulletPhysics()
