import gymnasium
import gymnasium_robotics
import pytest
import torch
from torchrl.envs import DMControlEnv, GymEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.conformance import PhysicsTests, unused_parameters
from torchrl_bayessim.physics.mujoco import MujocoPhysics

gymnasium.register_envs(gymnasium_robotics)


class TestCartPole(PhysicsTests):
    physics = AttributePhysics("masspole", "length", "force_mag")
    low, high = (0.1, 0.3, 5.0), (2.0, 2.0, 15.0)

    def make_env(self):
        return GymEnv("CartPole-v1")


class TestBatchedCartPole(PhysicsTests):
    physics = AttributePhysics("masspole", "length", "force_mag")
    low, high = (0.1, 0.3, 5.0), (2.0, 2.0, 15.0)

    def make_env(self):
        return CartPoleEnv(3)


class TestAcrobot(PhysicsTests):
    physics = AttributePhysics("LINK_MASS_1", "LINK_LENGTH_1", "LINK_LENGTH_2")
    low, high = (0.5, 0.5, 0.5), (2.0, 1.5, 1.5)
    unused = ("LINK_LENGTH_2",)

    def make_env(self):
        return GymEnv("Acrobot-v1")


class TestAcrobotOfRods(TestAcrobot):
    physics = AttributePhysics("LINK_MASS_1", "LINK_LENGTH_1", "LINK_LENGTH_2", coupled=True)
    unused = ()


class TestHopper(PhysicsTests):
    physics = MujocoPhysics(
        "body_mass[torso]",
        "dof_damping[leg_joint]",
        "geom_size[foot_geom,0]",
        "actuator_gear[0,0]",
        friction=("geom_friction[floor,0]", "geom_friction[foot_geom,0]"),
    )
    low, high = (2.0, 0.5, 0.04, 100.0, 0.3), (6.0, 2.0, 0.08, 300.0, 1.0)

    def make_env(self):
        return GymEnv("Hopper-v5")


class TestBatchedHopper(TestHopper):
    def make_env(self):
        return BatchedMujocoEnv("Hopper-v5", 2)


class TestCartPoleOfDMControl(PhysicsTests):
    physics = MujocoPhysics("body_mass[pole_1]", "dof_damping[slider]", "opt.gravity[2]")
    low, high = (0.05, 0.0, -12.0), (0.5, 0.1, -8.0)

    def make_env(self):
        return DMControlEnv("cartpole", "swingup")


@pytest.mark.parametrize("geom", ["floor", "foot_geom"])
def test_a_friction_hidden_by_the_maximum_is_found(geom):
    other = "foot_geom" if geom == "floor" else "floor"
    physics = MujocoPhysics("body_mass[torso]", f"geom_friction[{geom},0]")
    hidden = (2.0, 0.1), (6.0, {"floor": 2.0, "foot_geom": 1.0}[geom])
    with pytest.warns(UserWarning, match=rf"^geom_friction\[{geom},0\]: .* same from the lower"):
        unused = unused_parameters(lambda: GymEnv("Hopper-v5"), physics, *hidden)
    assert unused == (f"geom_friction[{geom},0]",)
    both = MujocoPhysics(friction=(f"geom_friction[{geom},0]", f"geom_friction[{other},0]"))
    assert unused_parameters(lambda: GymEnv("Hopper-v5"), both, (0.1,), (1.0,)) == ()


def test_actions_may_come_from_a_policy():
    """A car that is never driven shows neither its power nor its goal."""
    physics = AttributePhysics("goal_position", "power")
    policy = lambda td: td.set("action", torch.zeros(1))
    with pytest.warns(UserWarning, match="^goal_position, power: 100 steps"):
        unused_parameters(
            lambda: GymEnv("MountainCarContinuous-v0"),
            physics,
            (0.45, 0.001),
            (0.5, 0.002),
            policy=policy,
        )


def test_an_environment_that_does_not_repeat_itself_is_refused():
    class Noisy(gymnasium.ObservationWrapper):
        count = 0

        def observation(self, observation):
            Noisy.count += 1
            return observation + Noisy.count

    from torchrl.envs import GymWrapper

    with pytest.raises(SimulationError, match="the same rollout from the same seed"):
        unused_parameters(
            lambda: GymWrapper(Noisy(gymnasium.make("Pendulum-v1"))),
            AttributePhysics("m"),
            (0.5,),
            (2.0,),
        )


class DoublingPhysics(AttributePhysics):
    """Multiplies in place, the classical mistake."""

    def write(self, env, theta, **_):
        env.unwrapped.m *= float(theta[0])


class ForgettingPhysics(AttributePhysics):
    def write(self, env, theta, **_):
        pass


@pytest.mark.parametrize("wrong", [DoublingPhysics("m"), ForgettingPhysics("m")])
def test_wrong_adapters_are_caught(wrong):
    class Tests(PhysicsTests):
        physics, low, high = wrong, (0.5,), (2.0,)

        def make_env(self):
            return GymEnv("Pendulum-v1")

    with pytest.raises(AssertionError, match="is not"):
        Tests().test_what_is_written_is_held_after_reset_and_through_the_episode()
    if isinstance(wrong, DoublingPhysics):
        with pytest.raises(AssertionError, match="writing other values"):
            Tests().test_writes_are_absolute()
        with pytest.raises(AssertionError, match="restoring nominal values"):
            Tests().test_nominal_values_can_be_restored()


@pytest.mark.parametrize("low", [(0.1,), (0.1, 0.1, 0.1)])
def test_every_parameter_needs_its_bounds(low):
    physics = AttributePhysics("length", "masspole")
    with pytest.raises(ValueError, match=rf"low and high for each of .*{len(low)} and 2 bounds"):
        unused_parameters(lambda: CartPoleEnv(2), physics, low, (1.0, 1.0))
