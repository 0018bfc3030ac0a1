import gc
import sys
from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import GymEnv, SerialEnv, TransformedEnv

from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.remote_source import PolicyWithSource, push_source
from torchrl_bayessim.sources import Empirical, draw
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer


class Around:
    """Masses between ``low`` and ``low + 0.1``."""

    names = ("masspole",)

    def __init__(self, low):
        self.low = low

    def sample(self, shape, *, generator):
        return self.low + 0.1 * torch.rand((*shape, 1), generator=generator)


class Bang(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = torch.nn.Linear(4, 2)

    def forward(self, observation):
        return torch.nn.functional.one_hot(self.linear(observation).argmax(-1), 2)


def single():
    return TransformedEnv(GymEnv("CartPole-v1"), ApplyPhysics(AttributePhysics("masspole")))


def make():
    return TransformedEnv(SerialEnv(2, single), DomainRandomizer(Around(0.2)))


def carrying(draws=64):
    policy = TensorDictModule(Bang(), in_keys=["observation"], out_keys=["action"])
    return PolicyWithSource(policy, Around(0.2), draws=draws)


def collector(kind, policy, **more):
    ray = isinstance(kind, partial)
    options = {} if ray else {"auto_register_policy_transforms": False}
    envs = make if kind is Collector else [make, make]
    return kind(envs, policy, frames_per_batch=160, total_frames=3200, **options, **more)


def first_draws(workers):
    """Return θ of the first resets: the second worker's environments are numbers 2 and 3."""
    found = []
    for worker in range(workers):
        randomizer = DomainRandomizer(Around(0.2), first_environment=2 * worker)
        env = TransformedEnv(SerialEnv(2, single), randomizer)
        found.append(env.reset()["theta"].flatten())
    return torch.cat(found)


def pushed_within(collector, batches, *, first):
    """Push once batches with all first draws have come; return θ before and in the last batch.

    As many batches as that, and more of workers that a busy machine lets wait.
    """
    seen, pushed = [], None
    for i, batch in enumerate(collector):
        seen.append(batch["theta"].reshape(-1).unique())
        if pushed is None and i > 0 and torch.isin(first, torch.cat(seen)).all():
            push_source(collector, Around(1.2), key=(0, "round", 1))
            pushed = i + 1
        if pushed and i >= batches and not torch.isin(seen[-1], torch.cat(seen[:pushed])).any():
            break
    collector.shutdown()
    return torch.cat(seen[:pushed]).unique(), seen[-1]


def assert_push_arrives(kind, **more):
    policy, first = carrying(), first_draws(1 if kind is Collector else 2)
    made = collector(kind, policy, **more)
    before, after = pushed_within(made, batches=6, first=first)
    assert torch.isin(first, before).all()
    assert (before > 0.2).all()
    assert (before < 0.3).all()
    table = draw(Around(1.2), 64, key=(0, "round", 1, "pushed")).flatten()
    assert torch.isin(after, table).all()


@pytest.mark.parametrize(
    "kind",
    [Collector, MultiSyncCollector, pytest.param(MultiAsyncCollector, marks=pytest.mark.slow)],
)
def test_a_pushed_source_reaches_every_worker_and_workers_draw_differently(kind):
    assert_push_arrives(kind)


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")
def test_a_pushed_source_arrives_although_the_collector_rewraps_the_environment():
    assert_push_arrives(Collector, max_frames_per_traj=10)


@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_pushed_source_reaches_workers_of_ray():
    ray = pytest.importorskip("ray")
    from torchrl.collectors.distributed import RayCollector

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    assert_push_arrives(partial(RayCollector, sync=True))
    ray.shutdown()
    gc.collect()  # handles of its processes, which warn when they go


@pytest.mark.slow
def test_which_worker_runs_an_environment_does_not_matter():
    """Four environments in one process, or two in each of two: the same θ in the same episodes."""

    def first_episodes(kind, makers):
        policy = carrying()
        policy.draws.copy_(draw(Around(0.7), 64, key=(5,)))
        options = {"frames_per_batch": 8, "total_frames": 8, "reset_at_each_iter": True}
        made = kind(makers, policy, **options, auto_register_policy_transforms=False)
        theta = next(iter(made))["theta"][..., 0, :].reshape(-1)
        made.shutdown()
        return theta

    def four():
        return TransformedEnv(SerialEnv(4, single), DomainRandomizer(Around(0.2)))

    together = first_episodes(Collector, four)
    split = first_episodes(MultiSyncCollector, [make, make])
    assert torch.equal(together, split)
    assert len(together.unique()) == 4
    assert (together > 0.7).all()


def test_the_policy_acts_as_before_and_its_table_is_saved_with_it():
    policy = carrying()
    env = make()
    td = env.reset()
    assert torch.equal(policy(td.clone())["action"], policy.td_module(td.clone())["action"])
    assert policy.in_keys == ["observation"]
    assert policy.out_keys == ["action"]
    assert "draws" in policy.state_dict()


def test_the_later_of_a_push_and_an_assignment_holds():
    env = make()
    made = Collector(
        env,
        carrying(),
        frames_per_batch=4,
        total_frames=40,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    batches = iter(made)

    def low():
        return float(next(batches)["theta"].min())

    assert low() < 0.3
    push_source(made, Around(1.2), key=(0,))
    assert low() > 1.2
    env.transform.source = Around(0.2)
    assert low() < 0.3
    push_source(made, Around(1.2), key=(0,))  # the very same table
    assert low() > 1.2
    made.shutdown()


def test_push_needs_a_carrier_and_the_same_parameters():
    policy = TensorDictModule(Bang(), in_keys=["observation"], out_keys=["action"])
    without = collector(Collector, policy)
    with pytest.raises(TypeError, match=r"build the collector with PolicyWithSource\("):
        push_source(without, Around(1.2), key=(0,))
    push = partial(push_source, collector(Collector, carrying()), key=(0,))
    with pytest.raises(ValueError, match=r"a source over \('masspole',\), got \('length',\)"):
        push(Empirical([[1.0]], names=("length",)))
    with pytest.raises(ValueError, match=r"draws of shape \(64, 1\), got \(64, 2\)"):
        push(Empirical([[1.0, 2.0]]))
