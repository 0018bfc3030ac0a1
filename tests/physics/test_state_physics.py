import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, PendulumEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.conformance import PhysicsTests
from torchrl_bayessim.physics.state import StatePhysics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer


class Uniform:
    def sample(self, shape, *, generator):
        return 0.5 + torch.rand((*shape, 2), generator=generator)


def randomized():
    return TransformedEnv(
        PendulumEnv(),
        Compose(ApplyPhysics(StatePhysics("m", "l")), DomainRandomizer(Uniform()), StepCounter(4)),
    )


def test_specs():
    check_env_specs(randomized())


def test_every_pendulum_of_a_batch_holds_its_theta_through_automatic_resets():
    env = randomized()
    td = env.reset(TensorDict(batch_size=5), set_state=False)
    path = env.rollout(
        20, tensordict=td, auto_reset=False, break_when_any_done=False, set_truncated=False
    )
    theta = path["theta"]
    for i, name in enumerate(("m", "l")):
        assert torch.equal(path["params", name], theta[..., i])
        assert torch.equal(path["next", "params", name], theta[..., i])
    assert (path["params", "g"] == 10).all()
    done = path["next", "done"].squeeze(-1)[:, :-1]
    assert done.any()
    assert ((theta[:, 1:] != theta[:, :-1]).any(-1) == done).all()


def test_explicit_reset_draws_anew_and_a_reset_without_theta_is_nominal():
    env = randomized()
    td = env.reset(TensorDict(batch_size=3), set_state=False)
    again = env.reset(td.clone(), set_state=False)
    assert (again["theta"] != td["theta"]).all()
    assert torch.equal(again["params", "m"], again["theta"][:, 0])
    env = TransformedEnv(PendulumEnv(), ApplyPhysics(StatePhysics("m", "l")))
    env.reset(TensorDict(theta=torch.tensor([0.3, 0.4])), set_state=False)
    assert env.reset()["theta"].tolist() == [1.0, 1.0]


def test_unknown_entry_and_names_twice():
    with pytest.raises(PhysicsError, match=r"'params' after a reset of PendulumEnv, got 'mass'"):
        TransformedEnv(PendulumEnv(), ApplyPhysics(StatePhysics("mass")))
    with pytest.raises(PhysicsError, match="an entry of 'physics'"):
        TransformedEnv(PendulumEnv(), ApplyPhysics(StatePhysics("m", group="physics")))
    with pytest.raises(ValueError, match="names, each once"):
        StatePhysics("m", "m")


class TestStatePhysics(PhysicsTests):
    physics = StatePhysics("m", "l", "g", "dt")
    low, high = (0.5, 0.5, 5.0, 0.02), (2.0, 2.0, 15.0, 0.1)

    def make_env(self):
        return PendulumEnv(seed=0)
