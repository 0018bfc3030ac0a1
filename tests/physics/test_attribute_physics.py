import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.conformance import PhysicsTests
from torchrl_bayessim.physics.protocol import Physics
from torchrl_bayessim.transforms import ApplyPhysics

CASES = [
    ("CartPole-v1", ("masspole", "masscart", "length", "gravity", "force_mag", "tau")),
    ("Pendulum-v1", ("dt", "m", "l", "g", "max_torque")),
    ("MountainCarContinuous-v0", ("power",)),
    ("MountainCar-v0", ("force", "gravity")),
    (
        "Acrobot-v1",
        ("LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_COM_POS_2", "LINK_MOI"),
    ),
]


def make(name, *parameters, **options):
    return TransformedEnv(GymEnv(name), ApplyPhysics(AttributePhysics(*parameters, **options)))


def states(env, theta, steps=20):
    """Return the simulator's own states under fixed actions from a fixed start."""
    env.reset(TensorDict(theta=theta))
    env.unwrapped.reset(seed=3)
    space = env.unwrapped.action_space
    space.seed(0)
    return np.array([env.unwrapped.step(space.sample())[0] for _ in range(steps)])


@pytest.mark.parametrize(("name", "parameters"), CASES)
def test_each_parameter_is_held_and_changes_the_rollout(name, parameters):
    env = make(name, *parameters)
    nominal = env.reset()["theta"]
    before = states(env, nominal)
    for i, parameter in enumerate(parameters):
        theta = nominal.clone()
        theta[i] *= 0.7
        assert not np.array_equal(states(env, theta), before), parameter
        assert getattr(env.unwrapped, parameter) == float(theta[i])
    assert np.array_equal(states(env, nominal), before)


def test_cartpole_recomputes_what_gymnasium_caches():
    env = make("CartPole-v1", "masspole", "masscart", "length")
    env.reset(TensorDict(theta=torch.tensor([0.5, 2.0, 0.25])))
    assert env.unwrapped.total_mass == 2.5
    assert env.unwrapped.polemass_length == 0.125
    # masspole 1.6: with a stale total_mass the angular denominator l (4/3 - m cos²/M) would be
    # negative upright, and the pole would right itself
    env.reset(TensorDict(theta=torch.tensor([1.6, 1.0, 0.5])))
    env.unwrapped.state = np.array([0.0, 0.0, 0.05, 0.0])
    fallen = np.array([env.unwrapped.step(1)[0] for _ in range(2)])
    assert fallen[1, 3] < fallen[0, 3] < 0  # pushed right, the pole turns left


def test_acrobot_second_length_enters_only_with_rods():
    for coupled in (False, True):
        env = make("Acrobot-v1", "LINK_LENGTH_2", coupled=coupled)
        same = np.array_equal(states(env, torch.tensor([1.0])), states(env, torch.tensor([1.4])))
        assert same != coupled


def test_acrobot_rods_follow_their_formula_and_agree_with_gymnasium_where_both_apply():
    env = make("Acrobot-v1", "LINK_LENGTH_1", "LINK_LENGTH_2", coupled=True)
    env.reset(TensorDict(theta=torch.tensor([2.0, 1.0])))
    acrobot = env.unwrapped
    assert acrobot.LINK_COM_POS_1 == 1.0
    # equal rods: gymnasium's one moment of inertia is right for both, and so are its equations
    env.reset(TensorDict(theta=torch.tensor([1.0, 1.0])))
    acrobot.LINK_MOI = 1 / 12
    for variant in ("book", "nips"):
        acrobot.book_or_nips = variant
        for state in np.random.default_rng(0).normal(size=(20, 5)):
            ours, theirs = acrobot._dsdt(state), type(acrobot)._dsdt(acrobot, state)
            np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def test_acrobot_rods_conserve_energy():
    env = make("Acrobot-v1", "LINK_LENGTH_1", "LINK_LENGTH_2", "LINK_MASS_2", coupled=True)
    env.reset(TensorDict(theta=torch.tensor([1.3, 0.8, 0.6])))
    acrobot = env.unwrapped
    l1, l2, m1, m2 = 1.3, 0.8, 1.0, 0.6

    def energy(s):
        q1, q12, v1, v12 = s[0], s[0] + s[1], s[2], s[2] + s[3]
        tip = l1**2 * v1**2 + (l2 / 2 * v12) ** 2 + l1 * l2 * np.cos(s[1]) * v1 * v12
        kinetic = m1 * (l1 * v1) ** 2 / 6 + m2 * tip / 2 + m2 * l2**2 * v12**2 / 24
        height = -m1 * l1 / 2 * np.cos(q1) - m2 * (l1 * np.cos(q1) + l2 / 2 * np.cos(q12))
        return kinetic + 9.8 * height

    start = np.array([1.0, 0.4, 0.3, -0.2])
    path = solve_ivp(lambda _, s: acrobot._dsdt([*s, 0.0])[:4], (0, 5), start, rtol=1e-9)
    assert np.ptp(path.y[2]) > 1
    energies = [energy(s) for s in path.y.T]
    np.testing.assert_allclose(energies, energies[0], atol=1e-5)


def test_unknown_attribute_lists_near_names_when_wrapped():
    with pytest.raises(PhysicsError, match=r"'mass_pole'\. Available: masspole \(did you mean"):
        make("CartPole-v1", "mass_pole")
    with pytest.raises(PhysicsError, match="a numeric attribute of CartPoleEnv"):
        make("CartPole-v1", "kinematics_integrator")


@pytest.mark.parametrize("names", [(), ("m", "m")])
def test_names_must_be_given_once(names):
    with pytest.raises(ValueError, match="attribute names, each once"):
        AttributePhysics(*names)


def test_is_physics_and_knows_units():
    physics = AttributePhysics("l", "foo")
    assert isinstance(physics, Physics)
    assert physics.units == ("m", "")


class BlockEnv(EnvBase):
    """A block on rails, written by a user: velocity' = (force - drag velocity) / mass."""

    def __init__(self):
        super().__init__()
        self.mass, self.drag, self.on_rails = 1.0, 0.5, True
        self.observation_spec = Composite(velocity=Unbounded(1))
        self.action_spec, self.reward_spec = Unbounded(1), Unbounded(1)

    def _reset(self, tensordict, **_):
        return TensorDict(velocity=torch.zeros(1))

    def _step(self, tensordict):
        v = tensordict["velocity"]
        v = v + 0.1 * (tensordict["action"] - self.drag * v) / self.mass
        return TensorDict(velocity=v, reward=v, done=torch.zeros(1, dtype=torch.bool))

    def _set_seed(self, seed):
        pass


class TestBlock(PhysicsTests):
    physics = AttributePhysics("mass", "drag")
    low, high = (0.5, 0.1), (2.0, 1.0)

    def make_env(self):
        return BlockEnv()


def test_a_flag_is_not_a_parameter():
    with pytest.raises(PhysicsError, match=r"attribute of BlockEnv, got 'on_rails'\. .*drag, mass"):
        TransformedEnv(BlockEnv(), ApplyPhysics(AttributePhysics("on_rails")))


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("CartPole-v1", "masspole", -0.1),
        ("Pendulum-v1", "dt", 0.0),
        ("Acrobot-v1", "LINK_MOI", -1.0),
    ],
)
def test_masses_lengths_and_times_are_positive(name, parameter, value):
    env = make(name, parameter)
    nominal = env.reset()["theta"]
    with pytest.raises(PhysicsError, match=f"{parameter} to be positive, got {value}"):
        env.reset(TensorDict(theta=torch.tensor([value])))
    env.reset(TensorDict(theta=nominal))
    assert getattr(env.unwrapped, parameter) == pytest.approx(nominal.item())


def test_only_the_environments_that_are_written_are_checked():
    env = TransformedEnv(CartPoleEnv(2), ApplyPhysics(AttributePhysics("length")))
    theta = torch.tensor([[-1.0], [0.5]])
    with pytest.raises(PhysicsError, match="length to be positive, got -1"):
        env.reset(TensorDict(theta=theta, batch_size=[2]))
    reset = torch.tensor([[False], [True]])
    env.reset()
    env.reset(TensorDict(theta=theta, _reset=reset, batch_size=[2]))
    assert env.base_env.parameters["length"].tolist() == [0.5, 0.5]
