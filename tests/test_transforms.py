import io
from functools import partial

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    GymWrapper,
    ObservationNorm,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.sources import Empirical, Grid
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

NAMES = ("masspole", "length")
LOW, HIGH = torch.tensor([0.2, 0.3]), torch.tensor([1.0, 1.5])


class Uniform:
    names = NAMES

    def sample(self, shape, *, generator):
        return LOW + (HIGH - LOW) * torch.rand((*shape, 2), generator=generator)


class ShowPhysics(gymnasium.Wrapper):
    """Puts the simulator's own values, coupled ones too, where every step can be compared."""

    def __init__(self, env):
        super().__init__(env)
        inside = env.observation_space
        self.observation_space = gymnasium.spaces.Dict(
            state=inside, inside=gymnasium.spaces.Box(-10, 10, (4,), float)
        )

    def _show(self, state):
        env = self.unwrapped
        inside = [env.masspole, env.length, env.total_mass, env.polemass_length]
        return {"state": state, "inside": torch.tensor(inside).double().numpy()}

    def reset(self, **kwargs):
        state, info = super().reset(**kwargs)
        return self._show(state), info

    def step(self, action):
        state, *rest = super().step(action)
        return self._show(state), *rest


def cartpole():
    from torchrl.envs import GymWrapper

    return GymWrapper(ShowPhysics(gymnasium.make("CartPole-v1")))


def physical():
    return TransformedEnv(cartpole(), ApplyPhysics(AttributePhysics(*NAMES)))


def with_randomizer(randomizer, make=physical):
    return TransformedEnv(make(), randomizer, auto_unwrap=True)


def assert_simulator_holds_theta(td):
    mass, length = td["theta"].double().unbind(-1)
    expected = torch.stack([mass, length, mass + 1.0, mass * length], -1)
    torch.testing.assert_close(td["inside"], expected, rtol=1e-6, atol=0)


def assert_episodes_differ(td):
    """θ is constant within an episode and new after each."""
    theta, done = td["theta"], td["next", "done"].squeeze(-1)
    assert_simulator_holds_theta(td)
    assert_simulator_holds_theta(td["next"])
    assert (td["next", "theta"] == theta).all()
    changed = (theta[..., 1:, :] != theta[..., :-1, :]).any(-1)
    assert (changed == done[..., :-1]).all()
    assert changed.any()
    assert (theta >= LOW).all()
    assert (theta <= HIGH).all()


def wrapped(kind):
    if kind == "single":
        return TransformedEnv(
            cartpole(),
            Compose(ApplyPhysics(AttributePhysics(*NAMES)), DomainRandomizer(Uniform())),
        )
    if kind == "nested":
        inner = TransformedEnv(physical(), StepCounter(), auto_unwrap=False)
        return TransformedEnv(inner, DomainRandomizer(Uniform()), auto_unwrap=False)
    if kind == "unwrapped":
        inner = TransformedEnv(physical(), DomainRandomizer(Uniform()), auto_unwrap=True)
        return TransformedEnv(inner, StepCounter(), auto_unwrap=True)
    batched = {"serial": SerialEnv, "parallel": ParallelEnv}[kind]
    options = {"mp_start_method": "spawn"} if kind == "parallel" else {}
    return TransformedEnv(batched(2, physical, **options), DomainRandomizer(Uniform()))


@pytest.fixture(
    params=[
        *("single", "nested", "unwrapped", "serial"),
        pytest.param("parallel", marks=pytest.mark.slow),
    ]
)
def env(request):
    env = wrapped(request.param)
    yield env
    env.close(raise_if_closed=False)


def test_simulator_holds_theta_at_every_step_of_a_rollout(env):
    check_env_specs(env)
    assert_episodes_differ(env.rollout(80, break_when_any_done=False))


def test_simulator_holds_theta_in_a_collector(env):
    env.set_seed(0)  # a pole that stands for a hundred steps would have no second episode
    collector = Collector(env, None, frames_per_batch=100, total_frames=200)
    for batch in collector:
        assert_episodes_differ(batch)
    collector.shutdown()


def test_explicit_reset_with_a_running_tensordict_draws_anew(env):
    td = env.reset()
    again = env.reset(td.clone())
    assert (again["theta"] != td["theta"]).all()
    assert_simulator_holds_theta(again)


def test_a_batched_simulator_holds_theta_at_every_step_and_resets_only_rows():
    base = CartPoleEnv(5)
    writer = ApplyPhysics(AttributePhysics(*NAMES))
    env = TransformedEnv(base, Compose(writer, DomainRandomizer(Uniform()), StepCounter(30)))
    check_env_specs(env)
    td, changes = env.reset(), 0
    for _ in range(80):
        held = torch.stack([base.parameters[name] for name in NAMES], -1)
        torch.testing.assert_close(td["theta"], held.float(), rtol=0, atol=0)
        stepped, after = env.step_and_maybe_reset(env.rand_action(td))
        assert torch.equal(stepped["next", "theta"], td["theta"])
        changed = (after["theta"] != td["theta"]).any(-1, keepdim=True)
        assert torch.equal(changed, stepped["next", "done"])
        changes += changed.sum()
        td = after
    assert changes > 5
    assert len(td["theta"].unique(dim=0)) == 5


@pytest.mark.parametrize("kind", ["serial", "parallel"])
def test_partial_reset_changes_only_the_environments_that_reset(kind):
    env = wrapped(kind)
    td = env.rollout(3)[:, -1]["next"].exclude("reward")
    before = td["theta"].clone()
    td["_reset"] = torch.tensor([[False], [True]])
    after = env.reset(td)
    env.close()
    assert (after["theta"][0] == before[0]).all()
    assert (after["theta"][1] != before[1]).all()
    assert_simulator_holds_theta(after)
    assert torch.equal(
        after["theta"][1], DomainRandomizer(Uniform())._shared["draws"](*at(1, 1))[0]
    )


def at(environment, episode):
    return torch.tensor([environment]), torch.tensor([episode])


def test_same_environment_and_episode_same_theta_however_split():
    def thetas(env):
        with_resets = env.rollout(60, break_when_any_done=False)
        env.close()
        return [
            [tuple(t.tolist()) for t in theta.unique_consecutive(dim=0)]
            for theta in with_resets["theta"].reshape(-1, 60, 2)
        ]

    def single(i):
        randomizer = DomainRandomizer(Uniform(), first_environment=i)
        return with_randomizer(randomizer)

    together = thetas(TransformedEnv(SerialEnv(3, physical), DomainRandomizer(Uniform())))
    for i, whole in enumerate(together):
        alone = thetas(single(i))[0]
        n = min(len(whole), len(alone))
        assert n > 1
        assert whole[:n] == alone[:n]
    assert len({tuple(whole[0]) for whole in together}) == 3


def test_seed_changes_draws_and_global_generators_do_not():
    def first(seed, global_seed):
        torch.manual_seed(global_seed)
        env = with_randomizer(DomainRandomizer(Uniform(), seed=seed))
        return env.reset()["theta"]

    assert torch.equal(first(0, 1), first(0, 2))
    assert (first(0, 1) != first(1, 1)).all()


def test_writes_are_absolute_and_a_reset_without_theta_restores_nominal():
    env = physical()
    theta = torch.tensor([0.7, 1.1])
    for _ in range(3):
        td = env.reset(TensorDict(theta=theta))
        assert torch.equal(td["theta"], theta)
        assert_simulator_holds_theta(td)
    td = env.reset()
    torch.testing.assert_close(td["theta"], torch.tensor([0.1, 0.5]))
    assert env.unwrapped.masspole == 0.1  # exactly, not rounded to float32
    # wrapped again after a write, nominal is still what the simulator came with
    env.reset(TensorDict(theta=theta))
    again = TransformedEnv(env.base_env, ApplyPhysics(AttributePhysics(*NAMES)))
    torch.testing.assert_close(again.reset()["theta"], torch.tensor([0.1, 0.5]))


def test_another_adapter_on_the_same_simulator_finds_the_nominal_values():
    env = physical()
    env.reset(TensorDict(theta=torch.tensor([0.7, 1.1])))
    again = TransformedEnv(env.base_env, ApplyPhysics(AttributePhysics("length", "gravity")))
    torch.testing.assert_close(again.reset()["theta"], torch.tensor([0.5, 9.8]))
    assert again.unwrapped.masspole == 0.1


@pytest.mark.parametrize("appended", [True, False])
def test_a_second_randomizer_is_refused_and_not_ignored(appended):
    env, pinned = with_randomizer(DomainRandomizer(Uniform())), DomainRandomizer(Uniform())
    pinned.pin([0.4, 0.9])
    with pytest.raises(PhysicsError, match=r"one DomainRandomizer of 'theta', got 'two'.*pin it"):
        env.append_transform(pinned) if appended else TransformedEnv(env, pinned, auto_unwrap=True)


def test_clones_count_their_own_episodes():
    randomizer = DomainRandomizer(Uniform())
    env, other = with_randomizer(randomizer), with_randomizer(randomizer.clone())
    first = env.reset()["theta"]
    env.reset()
    assert torch.equal(other.reset()["theta"], first)


def test_a_new_source_takes_effect_at_the_next_reset_also_through_clones():
    randomizer = DomainRandomizer(Uniform())
    env = with_randomizer(randomizer)
    env = TransformedEnv(env, StepCounter(), auto_unwrap=True)
    running = env.reset()
    randomizer.source = Empirical([[0.5, 0.6]], names=NAMES)
    stepped = env.rand_step(running)
    assert torch.equal(stepped["next", "theta"], running["theta"])
    assert torch.equal(env.reset()["theta"], torch.tensor([0.5, 0.6]))


def test_pin_holds_and_unpin_goes_on_where_it_stopped():
    def thetas(pin):
        randomizer = DomainRandomizer(Uniform())
        env = TransformedEnv(SerialEnv(2, physical), randomizer)
        first = env.reset()["theta"]
        if pin:
            randomizer.pin([0.4, 0.9])
            for _ in range(2):
                assert torch.equal(env.reset()["theta"], torch.tensor([[0.4, 0.9]] * 2))
            randomizer.unpin()
        return first, env.reset()["theta"]

    for with_pin, without in zip(thetas(pin=True), thetas(pin=False), strict=True):
        assert torch.equal(with_pin, without)


def test_grid_gives_each_environment_its_point():
    points = torch.tensor([[0.3, 0.4], [0.5, 0.6]])
    env = TransformedEnv(SerialEnv(3, physical), DomainRandomizer(Grid(points, names=NAMES)))
    for _ in range(2):
        assert torch.equal(env.reset()["theta"], points[[0, 1, 0]])


def test_pool_restricts_to_n_draws():
    env = TransformedEnv(SerialEnv(8, physical), DomainRandomizer(Uniform(), pool=3))
    theta = torch.cat([env.reset()["theta"] for _ in range(5)])
    assert len(theta.unique(dim=0)) == 3


def test_a_grid_is_followed_whatever_the_pool():
    """As inference assigns one, to simulate what it drew."""
    randomizer = DomainRandomizer(Uniform(), pool=3)
    env = TransformedEnv(SerialEnv(2, physical), randomizer)
    pool = torch.cat([env.reset()["theta"] for _ in range(9)]).unique(dim=0)
    points = torch.tensor([[0.3, 0.4], [0.5, 0.6]])
    randomizer.source = Grid(points, names=NAMES)
    assert torch.equal(env.reset()["theta"], points)
    randomizer.source = Uniform()
    again = env.reset()["theta"]
    assert all((pool == theta).all(-1).any() for theta in again)
    with pytest.raises(ValueError, match="a source that samples, to draw a pool from, got 'a Grid"):
        DomainRandomizer(Grid(points), pool=3)


class Flow(nn.Module):
    """A learned source, whose parameters are no parameters of the randomizer."""

    names = NAMES

    def __init__(self, shift):
        super().__init__()
        self.shift = nn.Parameter(torch.tensor(shift))

    def sample(self, shape, *, generator):
        return (Uniform().sample(shape, generator=generator) + self.shift).detach()


def test_a_source_may_be_a_module():
    env = TransformedEnv(SerialEnv(2, physical), DomainRandomizer(Flow(2.0)))
    assert (env.reset()["theta"] > 2.0).all()
    env.transform.source = Flow(4.0)
    assert isinstance(env.transform.source, Flow)
    assert (env.reset()["theta"] > 4.0).all()
    assert not list(env.transform.parameters())
    env.transform.source = Uniform()
    assert (env.reset()["theta"] < 2.0).all()


def test_an_amortised_posterior_is_to_be_conditioned_first():
    prior = BoxPrior(dict.fromkeys(NAMES, (0.1, 2.0)))
    randomizer = DomainRandomizer(prior)
    with pytest.raises(TypeError, match=r"got 'MixtureDensityPosterior'. Try: posterior.condition"):
        randomizer.source = MixtureDensityPosterior(prior, 3)
    assert randomizer.source is prior


@pytest.mark.parametrize("make", [SerialEnv, ParallelEnv])
def test_theta_is_the_simulator_s_whatever_others_make_of_it(make):
    """A transform that normalises it in place, as for a critic, must not compound."""
    halved = ObservationNorm(0.0, 0.5, in_keys=["theta"])
    env = TransformedEnv(make(2, physical), Compose(DomainRandomizer(Uniform()), halved))
    steps = env.rollout(6, break_when_any_done=False)
    env.close()
    theta = 2 * torch.cat([steps["theta"], steps["next", "theta"]])
    inside = torch.cat([steps["inside"], steps["next", "inside"]])
    torch.testing.assert_close(theta.double(), inside[..., :2], rtol=1e-6, atol=0)


def test_theta_is_not_taken_from_an_old_tensordict():
    env = with_randomizer(DomainRandomizer(Uniform()))
    old, now = env.reset(), env.reset()
    assert not torch.equal(old["theta"], now["theta"])
    after = env.step(old.set("action", env.action_spec.rand()))["next"]
    assert torch.equal(after["theta"], now["theta"])
    assert_simulator_holds_theta(after)


def test_two_that_write_one_entry_are_refused():
    two = [ApplyPhysics(AttributePhysics(name)) for name in NAMES]
    with pytest.raises(PhysicsError, match=r"one ApplyPhysics that writes 'theta', got 'two'"):
        TransformedEnv(cartpole(), Compose(*two))
    with pytest.raises(PhysicsError, match="one Physics of all parameters, or another key="):
        TransformedEnv(TransformedEnv(cartpole(), two[0]), two[1], auto_unwrap=False)
    other = ApplyPhysics(AttributePhysics("length"), key="other")
    env = TransformedEnv(cartpole(), Compose(ApplyPhysics(AttributePhysics("masspole")), other))
    assert env.reset()["theta"] != env.reset()["other"]


def test_state_dict_resumes_the_sequence_of_draws():
    def make(seed=0):
        return TransformedEnv(SerialEnv(2, physical), DomainRandomizer(Uniform(), seed=seed))

    env, resumed = make(seed=5), make()
    env.reset()
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(env.reset()["theta"], resumed.reset()["theta"])


@pytest.mark.parametrize("order", ["reversed", "missing"])
def test_wrong_order_or_missing_writer_is_an_error_at_construction(order):
    transforms = [DomainRandomizer(Uniform())]
    if order == "reversed":
        transforms.append(ApplyPhysics(AttributePhysics(*NAMES)))
    with pytest.raises(PhysicsError, match=r"an ApplyPhysics .* before .* Try: Compose\("):
        TransformedEnv(cartpole(), Compose(*transforms))
    with pytest.raises(PhysicsError, match="ApplyPhysics inside the function"):
        TransformedEnv(SerialEnv(2, cartpole), DomainRandomizer(Uniform()))


def test_apply_physics_around_a_batch_is_an_error_at_construction():
    with pytest.raises(TypeError, match="put it inside the function that makes each"):
        TransformedEnv(SerialEnv(2, cartpole), ApplyPhysics(AttributePhysics(*NAMES)))


def test_vector_environments_of_gymnasium_are_refused():
    makers = [lambda: gymnasium.make("CartPole-v1")] * 2
    mode = gymnasium.vector.AutoresetMode.DISABLED
    env = GymWrapper(gymnasium.vector.SyncVectorEnv(makers, autoreset_mode=mode))
    with pytest.raises(PhysicsError, match=r"got 'SyncVectorEnv'\. Try: SerialEnv or ParallelEnv"):
        TransformedEnv(env, ApplyPhysics(AttributePhysics("length")))
    env.close()


def test_other_names_than_the_writer_are_an_error():
    swapped = NAMES[::-1]
    with pytest.raises(PhysicsError, match=r"source over \('masspole', 'length'\)"):
        with_randomizer(DomainRandomizer(Empirical([[1.0, 1.0]], names=swapped)))
    with pytest.raises(PhysicsError, match="2 parameters, as ApplyPhysics has"):
        with_randomizer(DomainRandomizer(Empirical([[1.0]], names=("length",))))
    for batched in (SerialEnv, ParallelEnv):
        env = batched(2, physical)
        env = TransformedEnv(env, DomainRandomizer(Empirical([[1.0, 1.0]], names=swapped)))
        with pytest.raises(PhysicsError, match="name the parameters alike, in the same order"):
            env.reset()
        env.close(raise_if_closed=False)
    nested = SerialEnv(2, lambda: SerialEnv(2, physical))
    env = TransformedEnv(nested, DomainRandomizer(Empirical([[1.0, 1.0]], names=swapped)))
    with pytest.raises(PhysicsError, match="name the parameters alike, in the same order"):
        env.reset()
    randomizer = DomainRandomizer(Uniform())
    with pytest.raises(ValueError, match="expected a source over"):
        randomizer.source = Empirical([[1.0, 1.0]], names=swapped)


@pytest.mark.parametrize("batched", [SerialEnv, pytest.param(ParallelEnv, marks=pytest.mark.slow)])
def test_batches_of_batches_are_randomized(batched):
    env = batched(2, partial(SerialEnv, 3, physical))
    env = TransformedEnv(env, DomainRandomizer(Uniform(), seed=0))
    steps = env.rollout(3)
    assert steps["theta"][..., 0, :].shape == (2, 3, 2)
    assert len(steps["theta"][..., 0, :].flatten(0, 1).unique(dim=0)) == 6
    assert_simulator_holds_theta(steps)
    env.close()


def test_bad_theta_is_refused():
    env = physical()
    with pytest.raises(ValueError, match=r"finite θ: .* got \[0.5, nan\]"):
        env.reset(TensorDict(theta=torch.tensor([0.5, torch.nan])))
    with pytest.raises(ValueError, match=r"θ of shape \(2,\)"):
        env.reset(TensorDict(theta=torch.tensor([0.5])))
    randomizer = DomainRandomizer(Uniform())
    env = with_randomizer(randomizer)
    for wrong in ([1.0, 2.0, 3.0], [1.0, torch.nan], 1.0):
        with pytest.raises(ValueError, match=r"finite numbers to pin, one for each .*'length'"):
            randomizer.pin(wrong)
    randomizer.pin([[1.0, 2.0]] * 3)
    with pytest.raises(ValueError, match="pinned θ of shape"):
        env.reset()
    randomizer = DomainRandomizer(Empirical([[1.0]]))
    env = with_randomizer(randomizer)
    with pytest.raises(ValueError, match="a source of 2 parameters"):
        env.reset()
    with pytest.raises(TypeError, match=r"numbers to pin, .* got {'length': 0\.5}"):
        randomizer.pin({"length": 0.5})


@pytest.mark.parametrize("physics", ["length", Uniform, None])
def test_what_is_no_physics_is_refused(physics):
    with pytest.raises(TypeError, match=r"physics with names, write and read.* Try: Attribute"):
        ApplyPhysics(physics)


class ForgetfulPhysics(AttributePhysics):
    def write(self, env, theta, **_):
        env.unwrapped.masspole = float(theta[0].clamp(max=0.5))


def test_a_simulator_that_does_not_hold_what_was_written_is_an_error():
    env = TransformedEnv(cartpole(), ApplyPhysics(ForgetfulPhysics("masspole")))
    assert env.reset(TensorDict(theta=torch.tensor([0.3])))["theta"] == pytest.approx(0.3)
    with pytest.raises(PhysicsError, match=r"masspole = 0\.899.* after the reset.*got 0\.5"):
        env.reset(TensorDict(theta=torch.tensor([0.9])))


def test_repr_names_parameters_and_units():
    env = with_randomizer(DomainRandomizer(Uniform()))
    assert "masspole [kg], length [m]" in repr(env.transform[0])
    assert "Uniform, names=('masspole', 'length'), units=None" in repr(env.transform[1])
    assert env.transform[0].units == ("kg", "m")
    prior = BoxPrior({"masspole": (0.2, 1.0), "length": (0.3, 1.5)}, units={"length": "m"})
    env.transform[1].source = prior
    assert env.transform[1].units == ("", "m")
    assert "BoxPrior, names=('masspole', 'length'), units=('', 'm')" in repr(env.transform[1])


def test_real_rollouts_of_one_parameter_differ():
    randomizer = DomainRandomizer(Uniform())
    env = TransformedEnv(SerialEnv(3, physical), randomizer)
    randomizer.pin([0.5, 0.5])
    starts = torch.cat([env.reset()["observation"] for _ in range(2)])
    assert len(starts.unique(dim=0)) == 6


def test_no_draw_is_needed_where_no_environment_resets():
    env = TransformedEnv(SerialEnv(2, physical), DomainRandomizer(Uniform()))
    td = env.reset()
    td["_reset"] = torch.zeros(2, 1, dtype=torch.bool)
    assert torch.equal(env.reset(td)["theta"], td["theta"])


def test_a_source_that_cannot_be_sampled_is_refused_at_once():
    with pytest.raises(TypeError, match=r"a source with sample\(shape\), got 'NoneType'"):
        DomainRandomizer(None)
    randomizer = DomainRandomizer(Uniform())
    with pytest.raises(TypeError, match=r"a source with sample.*Try: a prior, a posterior"):
        randomizer.source = None
    assert isinstance(randomizer.source, Uniform)  # the old one stays
