import warnings

import numpy as np
import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.randomness import generator, isolated
from torchrl_bayessim.sbi_source import SbiSource
from torchrl_bayessim.sources import draw
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})


@pytest.fixture(scope="module")
def posterior(tmp_path_factory):
    """Return a real one, of NPE, fitted to summaries that are the parameters and a little noise."""
    pytest.importorskip("sbi")
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(), isolated("sbi"):
        warnings.simplefilter("ignore")
        from sbi.inference import NPE
        from sbi.utils import BoxUniform

        patch.chdir(tmp_path_factory.mktemp("sbi"))
        theta = PRIOR.sample((300,), generator=generator(0))
        x = theta + 0.05 * torch.randn(theta.shape, generator=generator(1))
        trainer = NPE(
            BoxUniform(PRIOR.low, PRIOR.high), density_estimator="mdn", show_progress_bars=False
        )
        trainer.append_simulations(theta, x).train(learning_rate=5e-3, max_num_epochs=100)
        return trainer.build_posterior()


@pytest.mark.filterwarnings("ignore")
def test_an_sbi_posterior_randomises_a_simulator(posterior):
    randomizer = DomainRandomizer(PRIOR)
    physics = ApplyPhysics(AttributePhysics(*PRIOR.names))
    env = TransformedEnv(CartPoleEnv(64), Compose(physics, randomizer))
    randomizer.source = SbiSource(posterior, torch.tensor([0.7, 1.5]), names=PRIOR.names)
    held = env.reset()["theta"]
    assert PRIOR.contains(held).all()
    assert held.mean(0).tolist() == pytest.approx([0.7, 1.5], abs=0.25)
    assert held.std(0).min() > 0.005
    assert not torch.equal(env.reset()["theta"], held)


@pytest.mark.filterwarnings("ignore")
def test_the_same_key_gives_the_same_draws(posterior):
    source = SbiSource(posterior, torch.tensor([0.7, 1.5]), names=PRIOR.names)
    before = torch.random.get_rng_state()
    first, again, other = (draw(source, 5, key=(key,)) for key in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert source.log_prob(first).shape == (5,)


@pytest.mark.filterwarnings("ignore")
def test_other_names_than_parameters_are_refused(posterior):
    source = SbiSource(posterior, torch.tensor([0.7, 1.5]), names=["length"])
    with pytest.raises(ValueError, match=r"draws of the 1 parameters length, got \(3, 2\)"):
        draw(source, 3, key=(0,))


def test_what_cannot_be_sampled_is_refused():
    with pytest.raises(TypeError, match="an sbi posterior with `sample`, got 'object'"):
        SbiSource(object(), names=["a"])


class Constant:
    """Stands for a posterior that gives the same draw again and again, of any kind."""

    def __init__(self, row, kind=torch.tensor):
        self.row, self.kind = row, kind

    def sample(self, shape, x=None, show_progress_bars=True):
        return self.kind([self.row] * shape[0])

    def log_prob(self, value, x=None):
        return self.kind([0.5] * len(value))


def randomised(source):
    physics = ApplyPhysics(AttributePhysics(*PRIOR.names))
    return TransformedEnv(CartPoleEnv(4), Compose(physics, DomainRandomizer(source)))


def test_draws_of_numpy_are_taken():
    source = SbiSource(Constant([0.7, 1.5], np.array), names=PRIOR.names, prior=PRIOR)
    found = draw(source, 3, key=(0,))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.tensor([[0.7, 1.5]]).expand(3, 2))
    assert source.log_prob(found).tolist() == [0.5] * 3
    env = randomised(source)
    assert env.reset()["theta"].shape == (4, 2)


def test_draws_that_are_no_numbers_are_refused():
    source = SbiSource(Constant("a", list), names=["length"])
    with pytest.raises(TypeError, match="draws of the 1 parameters length, numbers"):
        source.sample(torch.Size([2]))


def test_draws_outside_the_prior_are_refused():
    source = SbiSource(Constant([-5.0, 1.5]), names=PRIOR.names, prior=PRIOR)
    expected = r"inside the support of BoxPrior.*3 of 3 outside, the first \{'length': -5.0"
    with pytest.raises(ValueError, match=expected):
        draw(source, 3, key=(0,))
    env = randomised(source)
    with pytest.raises(ValueError, match="outside, the first"):
        env.reset()
    unbounded = SbiSource(Constant([-5.0, 1.5]), names=PRIOR.names)
    assert draw(unbounded, 1, key=(0,)).tolist() == [[-5.0, 1.5]]


def test_a_prior_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"a prior over \('length',\), got \('length', 'mass"):
        SbiSource(Constant([1.0]), names=["length"], prior=PRIOR)
    with pytest.raises(TypeError, match="a prior with names and contains, got 'Uniform'"):
        SbiSource(Constant([1.0]), names=["a"], prior=torch.distributions.Uniform(0, 1))
