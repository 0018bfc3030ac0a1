import copy
import functools
import math
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import (
    Compose,
    GymEnv,
    GymWrapper,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from torchrl_bayessim import checkpoint
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.loop import SimToRealLoop
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.robots import RecordedLogs, SurrogateRobot
from torchrl_bayessim.simulate import make_collector
from torchrl_bayessim.sources import Defensive
from torchrl_bayessim.summaries import SummaryStatistics, duration, moments
from torchrl_bayessim.trajectories import first_trajectories, pad
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

TRUTH = 0.5931
PRIOR = BoxPrior({"length": (0.2, 1.5)})
QUICK = {"epochs": 3, "progress": False}


def physics():
    return ApplyPhysics(AttributePhysics("length"))


def small(prior, size):
    return MixtureDensityPosterior(prior, size, components=1)


def make_env(width=6, *, prior=PRIOR, limit=50):
    randomizer = DomainRandomizer(prior)
    simulator = CartPoleEnv(width)
    transforms = Compose(physics(), randomizer, StepCounter(limit), RewardSum())
    return TransformedEnv(simulator, transforms), randomizer


def make_robot(episodes=2, horizon=10):
    env = TransformedEnv(CartPoleEnv(episodes), physics())
    return SurrogateRobot(env, [TRUTH], max_steps=horizon)


def make_loop(env=None, randomizer=None, *, learner=None, robot=None, **options):
    """Return a loop so small that a round takes a tenth of a second."""
    if env is None:
        env, randomizer = make_env()
    prior = randomizer.source
    options = {
        "horizon": 10,
        "episodes": 2,
        "updates": 3,
        "shared_batches": 1,
        "rounds": 2,
    } | options
    fit = {"make_posterior": small, "networks": 1}
    fit["fit_options"] = options.pop("fit_options", QUICK)
    epochs = options.pop("epochs", 1)
    return SimToRealLoop(
        env,
        learner or PPO(env, hidden=(4,), minibatch_size=30, epochs=epochs),
        robot or make_robot(options["episodes"], options["horizon"]),
        refinement=PosteriorRefinement(prior, simulations=options.pop("simulations", 24), **fit),
        statistics=options.pop("statistics", SummaryStatistics(moments, duration)),
        randomizer=randomizer,
        checkpoint_every=2,
        progress=False,
        **options,
    )


def numbers(turn):
    """Return everything that a round says, but its wall time."""
    mixture = turn.posterior.mixture
    return {
        "index": turn.index,
        "posterior": [mixture.logits, mixture.loc, mixture.scale_tril],
        "real": dict(turn.real.flatten_keys(".").items()),
        "fit": (turn.fit.pairs, turn.fit.dropped, turn.fit.train, turn.fit.validation),
        "frames": turn.frames,
        "curve": turn.curve,
    }


def assert_same(one, other):
    """Exactly: every tensor bit by bit, NaN equal to NaN."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, torch.Tensor):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)
    else:
        assert one == other or (math.isnan(one) and math.isnan(other))


class Recorder(PPO):
    """A learner that remembers its batches, and its weights before each."""

    def __init__(self, env):
        super().__init__(env, hidden=(4,), minibatch_size=30, epochs=1)
        self.batches, self.weights, self.progress = [], [], []

    def update(self, batch, *, key, progress=0.0):
        self.batches.append(batch.clone())
        self.weights.append(copy.deepcopy(self.policy.state_dict()))
        self.progress.append(progress)
        return super().update(batch, key=key, progress=progress)


# One policy per summary, and the same batches for posterior and learner.


def test_real_data_and_true_parameters_are_in_no_training_set(monkeypatch):
    pairs, observed = [], []
    learn = PosteriorRefinement.learn

    def watched(self, theta, summary, real, **options):
        pairs.append((theta, summary))
        observed.append(torch.atleast_2d(real))
        return learn(self, theta, summary, real, **options)

    monkeypatch.setattr(PosteriorRefinement, "learn", watched)
    loop = make_loop(rounds=2)
    rounds = list(loop)
    assert len(pairs) == 2
    for turn, (theta, summary), real in zip(rounds, pairs, observed, strict=True):
        each = loop.statistics(turn.real)["summary"]
        size = each.shape[-1]  # a later round's summaries are one for each policy so far
        blocks = summary.reshape(-1, size)
        for row in torch.cat([real.reshape(-1, size), each]):
            assert not (blocks == row).all(-1).any()
        assert not (theta == TRUTH).any()


def test_every_real_summary_is_kept_with_the_policy_that_made_it():
    env, randomizer = make_env()
    learner, robot = Recorder(env), make_robot()
    asked = []

    class Watched(SurrogateRobot):
        def rollouts(self, policy, **options):
            asked.append(copy.deepcopy(policy.state_dict()))
            return robot.rollouts(policy, **options)

    watched = Watched(TransformedEnv(CartPoleEnv(2), physics()), [TRUTH], max_steps=10)
    loop = make_loop(env, randomizer, learner=learner, robot=watched, rounds=3)
    turns = list(loop)
    evidence = loop.state_dict()["loop"]["evidence"]
    assert len(asked) == len(evidence) == 3
    for turn, weights, entry in zip(turns, asked, evidence, strict=True):
        assert_same(dict(weights), entry["policy"])
        assert torch.equal(entry["summary"], loop.statistics.together(turn.real))
        # the first update of the round starts from the policy that the robot ran
        assert_same(dict(weights), dict(learner.weights[4 * turn.index]))
    changed = [k for k, v in asked[0].items() if not torch.equal(v, asked[1][k])]
    assert changed


def test_each_round_simulates_under_every_policy_that_made_real_data(monkeypatch):
    """The policies of the collectors that made pairs, against those of the evidence."""
    used = []

    def watching(env, policy, *, steps):
        used.append(dict(copy.deepcopy(policy).state_dict()))
        return make_collector(env, policy, steps=steps)

    monkeypatch.setattr("torchrl_bayessim.evidence.make_collector", watching)
    loop = make_loop(rounds=3, updates=1)
    sizes = [turn.fit.pairs for turn in loop]
    policies = [entry["policy"] for entry in loop.state_dict()["loop"]["evidence"]]
    assert sizes == [24] * 3
    # round 0: the learner's own; round 1: policy 0 again; round 2: policies 0 and 1 again
    assert len(used) == 1 + 1 + 2
    for weights, round_ in zip(used, [0, 0, 0, 1], strict=True):
        assert_same(weights, policies[round_])


def test_a_later_summary_is_another_one_because_the_policy_is():
    """Mixing them up would not raise, so it must not be possible to overlook."""
    loop = make_loop(updates=4)
    list(loop)
    first, second = loop.state_dict()["loop"]["evidence"]
    theta = torch.linspace(0.3, 1.2, 8).unsqueeze(-1)
    under_first = loop._simulator.earlier(first, theta, key=(0,))
    under_second = loop._simulator.earlier(second, theta, key=(0,))
    assert torch.equal(under_first, loop._simulator.earlier(first, theta, key=(0,)))
    assert not torch.allclose(under_first, under_second, rtol=0.05)


def test_the_batches_that_made_the_pairs_improve_the_policy_too(monkeypatch):
    env, randomizer = make_env()
    learner = Recorder(env)
    loop = make_loop(env, randomizer, learner=learner, shared_batches=2, rounds=1)
    pairs = []
    learn = loop.refinement.learn
    monkeypatch.setattr(loop.refinement, "learn", lambda *a, **k: pairs.append(a) or learn(*a, **k))
    (turn,) = loop
    ((theta, summary, observed),) = pairs
    shared = learner.batches[0]
    assert shared.batch_size == (12, 10)  # two batches of six environments: six pairs
    assert torch.equal(shared["theta"][::2, 0], theta[:6])
    assert torch.equal(shared["theta"][1::2, 0], theta[:6])
    rows = loop.statistics(shared)  # a fresh mask: first episodes of each row
    assert rows.batch_size == (12,)
    groups = first_trajectories(shared).unflatten(0, (6, 2))
    torch.testing.assert_close(loop.statistics.together(groups), summary[:6])
    # real data are not among the pairs, and the true parameters neither
    assert not (theta == TRUTH).any()
    assert not torch.isclose(summary, observed).all(-1).any()
    assert len(learner.batches) == 1 + 3
    assert turn.frames == sum(batch.numel() for batch in learner.batches) == 12 * 10 + 3 * 60
    assert [point["frames"] for point in turn.curve] == [120, 180, 240, 300]


def test_training_draws_from_the_posterior_mixed_with_the_prior():
    env, randomizer = make_env(width=200)
    learner = Recorder(env)
    loop = make_loop(env, randomizer, learner=learner, rounds=1, updates=1, prior_share=0.25)
    assert randomizer.source is PRIOR
    (turn,) = loop
    source = randomizer.source
    assert isinstance(source, Defensive)
    assert source.source is turn.posterior
    assert source.prior is PRIOR
    assert source.prior_share == 0.25
    starts = learner.batches[-1][:, 0]
    assert (starts["step_count"] == 0).all()
    assert (source.log_prob(starts["theta"]) > -math.inf).all()


def test_progress_of_learning_runs_from_zero_towards_one():
    env, randomizer = make_env()
    learner = Recorder(env)
    list(make_loop(env, randomizer, learner=learner))
    assert learner.progress == [k / 8 for k in range(8)]


# Shapes and simulators.


def gym():
    return TransformedEnv(GymEnv("CartPole-v1"), physics())


def simulators(kind):
    randomizer = DomainRandomizer(PRIOR)
    after = Compose(randomizer, StepCounter(50), RewardSum())
    if kind == "single":
        return TransformedEnv(gym(), after, auto_unwrap=False), randomizer
    return TransformedEnv(SerialEnv(2, gym), after), randomizer


@pytest.mark.parametrize("kind", ["single", "serial"])
@pytest.mark.parametrize("episodes", [1, 3])
def test_gymnasium_environments_alone_and_in_a_row(kind, episodes):
    env, randomizer = simulators(kind)
    loop = make_loop(env, randomizer, episodes=episodes, simulations=6, updates=1)
    for turn in loop:
        assert turn.real.batch_size == (episodes, 10)
        assert turn.simulations == 6
        assert turn.posterior.mean.shape == (1,)


def test_hopper_with_two_parameters():
    prior = BoxPrior({"torso": (2.0, 6.0), "damping": (0.5, 2.0)})
    bodies = {"torso": "body_mass[torso]", "damping": "dof_damping[thigh_joint]"}

    def hopper(width, *more):
        env = BatchedMujocoEnv("Hopper-v5", width)
        return TransformedEnv(env, Compose(ApplyPhysics(MujocoPhysics(**bodies)), *more))

    randomizer = DomainRandomizer(prior)
    env = hopper(4, randomizer, StepCounter(50), RewardSum())
    robot = SurrogateRobot(hopper(2), [3.7, 1.0], max_steps=10)
    (turn,) = make_loop(env, randomizer, robot=robot, rounds=1, simulations=12)
    assert turn.posterior.names == ("torso", "damping")
    assert prior.contains(turn.posterior.sample((100,))).all()


@pytest.mark.parametrize(
    "options",
    [
        {"episodes": 1},
        {"updates": 0},
        {"shared_batches": 0},
        {"horizon": 2},
        {"prior_share": 0.0},
        {"simulations": 4},
    ],
    ids=str,
)
def test_the_smallest_settings_work(options):
    (turn,) = make_loop(rounds=1, **options)
    assert turn.posterior.stddev.isfinite().all()


def test_one_environment_works():
    env, randomizer = make_env(1)
    (turn,) = make_loop(env, randomizer, rounds=1, simulations=5)
    assert turn.frames == 10 + 3 * 10


def test_an_unbounded_prior_works():
    env, randomizer = make_env(prior=GaussianPrior({"length": (0.8, 0.1)}))
    turns = list(make_loop(env, randomizer))
    assert turns[-1].posterior.prior is turns[0].posterior.prior


@pytest.mark.parametrize("name", ["horizon", "episodes", "rounds"])
def test_settings_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} to be positive, got 0"):
        make_loop(robot=make_robot(), **{name: 0})


@pytest.mark.parametrize("name", ["updates", "shared_batches"])
def test_other_settings_must_not_be_negative(name):
    with pytest.raises(ValueError, match=f"{name} not to be negative, got -1"):
        make_loop(**{name: -1})


@pytest.mark.parametrize(
    ("name", "value"), [("rounds", 1.5), ("episodes", "8"), ("updates", float("nan"))]
)
def test_counts_are_whole_numbers(name, value):
    with pytest.raises(TypeError, match=f"a whole number of {name}, got '?{value}"):
        make_loop(robot=make_robot(), **{name: value})


def test_a_quiet_loop_has_quiet_fits_unless_they_are_asked_to_talk(capsys):
    shown = []
    for options in ({}, {"progress": True}):
        list(make_loop(rounds=1, updates=1, fit_options={"epochs": 1} | options))
        shown.append("epoch" in capsys.readouterr().err)
    assert shown == [False, True]


@pytest.mark.slow
def test_more_than_ten_rounds():
    loop = make_loop(rounds=12, updates=1, horizon=4, simulations=12)
    turns = list(loop)
    assert [turn.index for turn in turns] == list(range(12))
    evidence = loop.state_dict()["loop"]["evidence"]
    for turn, entry in zip(turns, evidence, strict=True):  # in their own order, 10 after 9
        assert torch.equal(entry["summary"], loop.statistics.together(turn.real))
    assert len({turn.posterior.mean.item() for turn in turns}) == 12


@pytest.mark.slow
def test_more_than_ten_rounds_go_on_where_they_were_left(tmp_path):
    options = {"rounds": 13, "updates": 1, "horizon": 4, "simulations": 12}
    whole = [numbers(turn) for turn in make_loop(**options)]
    file = tmp_path / "loop.pt"
    for turn in make_loop(**options, checkpoint_file=file):
        if turn.index == 11:
            break
    resumed = make_loop(**options, checkpoint_file=file)
    assert resumed.resume()
    assert_same([numbers(turn) for turn in resumed], whole[11:])


# Real data: what a robot may bring.


class Bringing:
    """A robot that brings what it is told to."""

    recorded = False

    def __init__(self, change):
        self.robot, self.change = make_robot(), change
        self.settings = self.robot.settings

    def rollouts(self, policy, **options):
        return self.change(self.robot.rollouts(policy, **options))


@pytest.mark.parametrize("entry", ["observation", "action"])
def test_measurements_of_another_size_are_refused_before_simulating(entry):
    robot = Bringing(lambda real: real.set(entry, torch.cat([real[entry]] * 2, -1)))
    with pytest.raises(ValueError, match=rf"columns of '{entry}', as the simulator has.*the robot"):
        list(make_loop(robot=robot))


def dropping(*keys):
    return lambda real: real.exclude(*keys)


def masked(change):
    return lambda real: real.set("mask", change(real["mask"]))


ANSWERS = {
    "nothing": (lambda real: None, TypeError, "in a TensorDict, got 'NoneType'"),
    "a dictionary": (lambda real: real.to_dict(), TypeError, "in a TensorDict, got 'dict'"),
    "one dimension": (lambda real: real[0], ValueError, r"trajectories \[n, T\] .* got \(10,\)"),
    "three dimensions": (lambda real: real[None], ValueError, r"\[n, T\] .* got \(1, 2, 10\)"),
    "no episode": (lambda real: real[:0], ValueError, r"\[n, T\] .* got \(0, 10\)"),
    "no mask": (
        dropping("mask"),
        ValueError,
        r"with an entry, got 'mask'.*first_trajectories",
    ),
    "no observation": (dropping("observation"), ValueError, "with an entry, got 'observation'"),
    "no action": (dropping("action"), ValueError, "with an entry, got 'action'"),
    "no next": (
        dropping(("next", "observation")),
        ValueError,
        r"""with an entry, got "\('next', 'observation'\)".""",
    ),
    "no done": (dropping(("next", "done")), ValueError, r"""got "\('next', 'done'\)".*Available"""),
    "float mask": (masked(torch.Tensor.float), TypeError, "booleans in 'mask', got 'torch.float32"),
    "wide mask": (
        masked(lambda mask: mask.unsqueeze(-1)),
        ValueError,
        r"a 'mask' of shape \(2, 10\), got \(2, 10, 1\)",
    ),
    "empty mask": (
        masked(torch.zeros_like),
        ValueError,
        "at least one step each, got 'none that counts in trajectory 0'",
    ),
    "indices": (
        lambda real: real.set("action", real["action"].argmax(-1)),
        ValueError,
        r"one-hot actions or torques.*got 'indices of shape \(2, 10\)'.*categorical_action_enc",
    ),
    "matrices": (
        lambda real: real.set("observation", real["observation"].unsqueeze(-1)),
        ValueError,
        r"4 columns of 'observation', as the simulator has, got 'shape \(4, 1\) from the robot'",
    ),
    "a wide end": (
        lambda real: real.set(("next", "done"), real["next", "done"].expand(-1, -1, 2)),
        ValueError,
        r"one boolean per step in \('next', 'done'\), got 'torch.bool of shape \(2, 10, 2\)'",
    ),
}


@pytest.mark.parametrize("answer", ANSWERS)
def test_what_a_robot_may_answer(answer):
    change, error, text = ANSWERS[answer]
    loop = make_loop(robot=Bringing(change))
    with pytest.raises(error, match=text):
        list(loop)
    assert loop.state_dict()["loop"]["evidence"] == []


def test_a_robot_need_not_know_rewards():
    (turn,) = make_loop(robot=Bringing(dropping(("next", "reward"))), rounds=1, updates=1)
    assert turn.posterior.stddev.isfinite().all()


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("shared", [0, 1])
def test_simulations_that_a_time_limit_cuts_before_the_real_episodes_end(recorded, shared):
    env, randomizer = make_env(limit=6)
    robot = RecordedLogs(logs()) if recorded else None
    loop = make_loop(env, randomizer, robot=robot, shared_batches=shared)
    text = r"may last the 10 steps of real ones, got '\d of 6 cut, after 6 steps.*StepCounter"
    with pytest.raises(ValueError, match=text):
        list(loop)


def test_a_robot_that_did_fewer_episodes_is_compared_with_as_many():
    robot = Bringing(lambda real: real[:1])
    (turn,) = make_loop(robot=robot, rounds=1, shared_batches=9)
    assert turn.real.batch_size == (1, 10)
    assert turn.frames == 24 * 10 + 3 * 60  # one episode per pair was simulated


def test_longer_real_episodes_are_cut_where_simulated_ones_are():
    loop = make_loop(robot=make_robot(2, 30), rounds=1)
    (turn,) = loop
    assert turn.real.batch_size == (2, 10)


def test_real_episodes_that_were_cut_earlier_are_refused():
    with pytest.raises(ValueError, match=r"last the 10 steps of simulated ones, got 'one cut aft"):
        list(make_loop(robot=make_robot(2, 6)))


def test_real_values_that_are_not_finite_are_refused_before_simulating():
    def broken(real):
        real["next", "observation"][1, 3, 2] = torch.nan
        return real

    env, randomizer = make_env()
    learner = Recorder(env)
    loop = make_loop(env, randomizer, learner=learner, robot=Bringing(broken))
    with pytest.raises(ValueError, match=r"finite values of .*'observation'.*tory 1 at step 3"):
        list(loop)
    assert learner.batches == []


# Recorded logs.


def logs(lengths=(10, 4, 7)):
    env = TransformedEnv(CartPoleEnv(len(lengths)), physics())
    real = SurrogateRobot(env, [TRUTH], max_steps=max(lengths)).rollouts(
        None, episodes=len(lengths), key=(0,)
    )
    return pad([row[:n].exclude("mask") for row, n in zip(real, lengths, strict=True)])


def test_logs_are_simulated_by_replaying_their_actions_as_long_as_they_last(monkeypatch):
    recorded, seen = logs(), []
    loop = make_loop(robot=RecordedLogs(recorded), rounds=2, updates=1)
    together = loop.statistics.together
    monkeypatch.setattr(
        loop.statistics, "together", lambda rows: seen.append(rows) or together(rows)
    )
    turns = list(loop)
    assert len(loop.state_dict()["loop"]["evidence"]) == 1  # the same logs are not counted twice
    assert turns[1].real.batch_size == (3, 10)
    simulated = [rows for rows in seen if rows.ndim == 3]
    assert sum(len(rows) for rows in simulated) == 2 * 24
    for rows in simulated:
        mask = rows["mask"]
        ended = rows["next", "done"].squeeze(-1)
        for i in range(3):
            length = int(recorded["mask"][i].sum())
            assert not mask[:, i, length:].any()
            assert (mask[:, i].sum(-1) == length).logical_or((mask & ended)[:, i].any(-1)).all()
        played = rows["action"][mask]
        assert torch.equal(played, recorded["action"].expand(len(rows), -1, -1, -1)[mask])


def test_logs_and_simulator_may_name_the_measurements_in_their_own_way():
    env, randomizer = make_env()
    env.append_transform(RenameTransform(["observation"], ["joints"], create_copy=True))
    recorded = logs().rename_key_("observation", "joints")
    recorded["next"].rename_key_("observation", "joints")
    (turn,) = make_loop(
        env,
        randomizer,
        robot=RecordedLogs(recorded, measured=["joints"]),
        statistics=SummaryStatistics(moments, duration, observation_key="joints"),
        rounds=1,
        updates=1,
    )
    (same,) = make_loop(robot=RecordedLogs(logs()), rounds=1, updates=1)
    assert torch.equal(turn.posterior.mixture.loc, same.posterior.mixture.loc)


def test_logs_whose_names_the_simulator_or_the_statistics_lack_are_refused_at_once():
    recorded = RecordedLogs(logs().rename_key_("action", "cmd"), action_key="cmd")
    with pytest.raises(ValueError, match=r"with an entry, got 'action'\. Available: .*cmd.*renam"):
        make_loop(robot=recorded)
    read = SummaryStatistics(moments, action_key="cmd")
    with pytest.raises(ValueError, match=r"an action that .* has, got 'cmd'\. Available: action\."):
        make_loop(robot=recorded, statistics=read)
    read = SummaryStatistics(moments, observation_key="joints")
    with pytest.raises(ValueError, match=r"an observation that .*, got 'joints'\. Available: obs"):
        make_loop(robot=make_robot(), statistics=read)


def test_environments_must_be_a_multiple_of_the_logs():
    env, randomizer = make_env(7)
    loop = make_loop(env, randomizer, robot=RecordedLogs(logs()))
    with pytest.raises(ValueError, match=r"multiples of the 3 logs.*got 7. Try: 9 environments"):
        list(loop)


def test_logs_whose_replay_nobody_counts_the_steps_of():
    randomizer = DomainRandomizer(PRIOR)
    env = TransformedEnv(CartPoleEnv(6), Compose(physics(), randomizer))
    with pytest.raises(ValueError, match=r"'step_count'.*got 'no such entry'. Try: a StepCounter"):
        list(make_loop(env, randomizer, robot=RecordedLogs(logs())))


# Randomness.


def test_same_seed_same_rounds_and_another_seed_others():
    one, same, other = ([numbers(t) for t in make_loop(seed=seed)] for seed in (0, 0, 1))
    assert_same(one, same)
    assert one[0]["curve"][0]["loss_critic"] != other[0]["curve"][0]["loss_critic"]
    assert not torch.equal(one[0]["posterior"][1], other[0]["posterior"][1])


def generators():
    _, keys, *rest = np.random.get_state()  # noqa: NPY002
    return torch.random.get_rng_state().tolist(), keys.tolist(), rest, random.getstate()


def test_the_global_generators_stay_as_they_were_and_do_not_matter():
    loop, before = make_loop(), generators()
    one = []
    for turn in loop:
        assert generators() == before
        one.append(numbers(turn))
    torch.manual_seed(77)
    random.seed(77)
    assert_same(one, [numbers(turn) for turn in make_loop()])


# Divergence.


def test_simulations_that_diverge_are_counted_and_the_loop_goes_on():
    loop = make_loop(rounds=1, shared_batches=0)
    together = loop.statistics.together

    def sometimes(rows):
        bad = rows["observation"][..., 0, 0, :1] > 0.02  # by chance of the initial state
        return torch.where(bad, torch.nan, together(rows)) if rows.ndim == 3 else together(rows)

    loop.statistics.together = sometimes
    with pytest.warns(UserWarning, match="of 24 pairs are not finite: left out"):
        (turn,) = loop
    assert 0 < turn.fit.dropped < 24
    assert turn.simulations == 24 - turn.fit.dropped


def test_if_all_simulations_diverge_the_robots_work_is_kept(tmp_path):
    file = tmp_path / "state.pt"
    loop = make_loop(checkpoint_file=file)
    together = loop.statistics.together
    loop.statistics.together = lambda rows: together(rows) * (1 if rows.ndim == 2 else torch.nan)
    with pytest.raises(SimulationError, match="24 diverged simulations of 24"):
        list(loop)
    again = make_loop(
        checkpoint_file=file, robot=Bringing(lambda real: pytest.fail("asked the robot again"))
    )
    assert again.resume()
    next(iter(again))


class Diverging(gymnasium.Wrapper):
    """CartPole whose observations become NaN while ``broken`` is set."""

    broken = False

    def step(self, action):
        observation, *rest = super().step(action)
        return observation * (np.nan if Diverging.broken else 1), *rest


def test_nan_from_a_simulator_is_named_and_loses_nothing(tmp_path, monkeypatch):
    file, asked = tmp_path / "state.pt", []
    randomizer = DomainRandomizer(PRIOR)
    simulator = GymWrapper(Diverging(gymnasium.make("CartPole-v1")))
    env = TransformedEnv(simulator, Compose(physics(), randomizer, StepCounter(50), RewardSum()))
    robot = Bringing(lambda real: asked.append(real) or real)
    loop = make_loop(env, randomizer, robot=robot, simulations=6, updates=1, checkpoint_file=file)
    turns = iter(loop)
    first = next(turns)
    monkeypatch.setattr(Diverging, "broken", True)
    with pytest.raises(SimulationError, match="6 diverged simulations of 6"):
        next(turns)
    assert len(asked) == 2
    monkeypatch.setattr(Diverging, "broken", False)
    (second,) = loop  # goes on in the second round, without asking the robot again
    assert len(asked) == 2
    assert second.index == 1
    assert second.frames > first.frames
    assert len(loop.state_dict()["loop"]["evidence"]) == 2


class Brittle(CartPoleEnv):
    """CartPole that diverges, for good, where the pole is short."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        short = self.parameters["length"] < 0.5
        out["observation"] = torch.where(short[:, None], torch.nan, out["observation"])
        return out


def test_simulations_that_give_nan_are_left_out_of_pairs_and_training(tmp_path):
    randomizer = DomainRandomizer(PRIOR)
    transforms = Compose(physics(), randomizer, StepCounter(50), RewardSum())
    env = TransformedEnv(Brittle(24), transforms)
    learner = Recorder(env)
    loop = make_loop(env, randomizer, learner=learner, rounds=1, simulations=48)
    with pytest.warns() as said:
        (turn,) = loop
    texts = [str(warning.message) for warning in said]
    assert any("of 48 pairs are not finite: left out" in text for text in texts)
    assert any("of 24 rows of a training batch hold NaN" in text for text in texts)
    assert 0 < turn.fit.dropped < 48
    assert turn.fit.pairs == 48 - turn.fit.dropped
    dropped = [entry.get("dropped", 0) for entry in turn.curve]
    assert [len(batch) for batch in learner.batches] == [24 - count for count in dropped]
    assert sum(dropped) > 0
    for batch in learner.batches:
        assert batch["next", "observation"].isfinite().all()
        assert (batch["theta"] > 0.5).all()
    assert turn.frames == 24 * 10 * len(turn.curve)


# Keeping work.


@functools.cache
def unbroken():
    """Return the rounds of an unbroken run, and its learner at the end."""
    loop = make_loop()
    return [numbers(turn) for turn in loop], loop.learner


class BrokenError(RuntimeError):
    pass


def break_after(loop, steps):
    """Let the loop break before its step number ``steps``, in the middle of the step's work."""
    count = 0
    step = loop._step

    def counting(work):
        nonlocal count
        count += 1
        if count <= steps:
            return step(work)
        work()  # all of it happens, and is lost
        raise BrokenError

    loop._step = counting
    return loop


STEPS = 2 * (1 + 1 + 2)  # two rounds of: measure, infer, train two updates, train one


@pytest.mark.parametrize("steps", range(STEPS + 1))
def test_broken_off_at_any_step_it_resumes_to_the_same_numbers(steps, tmp_path):
    file = tmp_path / "state.pt"
    turns, learner = unbroken()
    found = []
    broken = break_after(make_loop(checkpoint_file=file), steps)
    try:
        for turn in broken:
            found += [numbers(turn)]
    except BrokenError:
        assert steps < STEPS
    resumed = make_loop(checkpoint_file=file)
    assert resumed.resume() is (steps > 0)
    found += [numbers(turn) for turn in resumed]
    assert_same(found, turns)
    assert_same(resumed.learner.state_dict(), learner.state_dict())


@pytest.mark.parametrize("kind", ["single", "serial"])
def test_gymnasium_environments_resume_to_the_same_numbers(kind, tmp_path):
    file = tmp_path / "state.pt"

    def gymnasium(**options):
        return make_loop(*simulators(kind), simulations=4, updates=3, rounds=1, **options)

    (expected,) = gymnasium()
    with pytest.raises(BrokenError):
        list(break_after(gymnasium(checkpoint_file=file), 3))  # in its second training step
    resumed = gymnasium(checkpoint_file=file)
    assert resumed.resume()
    (turn,) = resumed
    assert_same(numbers(turn), numbers(expected))


@pytest.mark.parametrize("where", ["robot", "update"])
def test_an_error_of_robot_or_learner_loses_nothing(where, tmp_path):
    file = tmp_path / "state.pt"
    calls = 0

    def third(*_):
        nonlocal calls
        calls += 1
        if calls == (2 if where == "robot" else 6):
            raise BrokenError

    env, randomizer = make_env()

    class Failing(Recorder):
        def update(self, *args, **options):
            third()
            return super().update(*args, **options)

    learner = Failing(env) if where == "update" else None
    robot = Bringing(lambda real: third() or real) if where == "robot" else None
    loop = make_loop(env, randomizer, learner=learner, robot=robot, checkpoint_file=file)
    with pytest.raises(BrokenError):
        list(loop)
    resumed = make_loop(checkpoint_file=file)
    assert resumed.resume()
    assert_same([numbers(turn) for turn in resumed], unbroken()[0][1:])


def test_a_round_is_told_again_if_the_caller_was_killed_over_it(tmp_path):
    file = tmp_path / "state.pt"
    told = numbers(next(iter(make_loop(checkpoint_file=file))))
    resumed = make_loop(checkpoint_file=file)
    assert resumed.resume()
    assert_same([numbers(turn) for turn in resumed], [told, unbroken()[0][1]])


def test_a_finished_run_has_no_rounds_left(tmp_path):
    file = tmp_path / "state.pt"
    list(make_loop(checkpoint_file=file))
    resumed = make_loop(checkpoint_file=file)
    assert resumed.resume()
    assert list(resumed) == []
    assert resumed.refinement.posterior is not None


def test_without_a_file_there_is_nothing_to_resume(tmp_path):
    assert not make_loop().resume()
    assert not make_loop(checkpoint_file=tmp_path / "state.pt").resume()


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ({"horizon": 11}, "made with horizon=11, got 10"),
        ({"episodes": 3}, "made with episodes=3, got 2"),
        ({"seed": 5}, "made with seed=5, got 0"),
        ({"simulations": 30}, "made with refinement.simulations=30, got 24"),
        ({"prior_share": 0.5}, r"made with prior_share=0.5, got 0.1"),
        (
            {"statistics": SummaryStatistics(moments)},
            r"made with statistics=.SummaryStatistics\(moments, angles.*got .*duration",
        ),
        ({"epochs": 2}, r"made with learner.epochs=2, got 1"),
        ({"env": make_env(7)}, "made with environments=7, got 6"),
        (
            {"env": make_env(prior=BoxPrior({"length": (0.2, 1.6)}))},
            r"made with refinement.prior=.*'high': \[1.6.*\], .*got .*'high': \[1.5\]",
        ),
        (
            {"env": make_env(prior=BoxPrior({"length": (0.2, 1.5002)}))},
            r"made with refinement.prior=.*'high': \[1.5002.*\], .*got .*'high': \[1.5\]",
        ),
        (
            {
                "robot": SurrogateRobot(
                    TransformedEnv(CartPoleEnv(2), physics()), [0.7], max_steps=10
                )
            },
            "made with robot.parameters=",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_a_checkpoint_of_other_settings_is_refused(option, text, tmp_path):
    file = tmp_path / "state.pt"
    next(iter(make_loop(checkpoint_file=file)))
    option = dict(option)
    env = option.pop("env", (None, None))
    other = make_loop(*env, checkpoint_file=file, **option)
    with pytest.raises(ValueError, match=f"{text}.*Try: the settings of the run that wrote it"):
        other.resume()


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    checkpoint.save(tmp_path / "state.pt", {"loop": {}, "policy": {}})
    with pytest.raises(ValueError, match=r"state of a loop, with an entry, got \"none 'learner'\""):
        make_loop(checkpoint_file=tmp_path / "state.pt").resume()


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_a_share_of_prior_draws_is_a_probability(share):
    with pytest.raises(ValueError, match=f"prior_share to be a probability, 0 to 1, got {share}"):
        make_loop(prior_share=share)


RUN = """
import sys, warnings
warnings.simplefilter("ignore")
import torch
torch.set_num_threads(1)
sys.path.insert(0, {folder!r})
from test_loop import make_loop, numbers
loop = make_loop(checkpoint_file=sys.argv[1], rounds=50)
list(loop)
"""


def test_killed_at_any_moment_it_resumes_to_the_same_numbers(tmp_path):
    file = tmp_path / "state.pt"
    code = RUN.format(folder=str(Path(__file__).parent))
    process = subprocess.Popen([sys.executable, "-c", code, str(file)])
    deadline = time.monotonic() + 120
    while not file.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.5)  # in the first rounds, at whatever it does then
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    resumed, expected = (make_loop(rounds=50, checkpoint_file=f) for f in (file, None))
    assert resumed.resume()
    done = checkpoint.load(file)["loop"]["round"]
    assert done < 40
    told = dict(zip(range(done + 2), expected, strict=False))
    for _, turn in zip(range(2), resumed, strict=False):
        if turn.index in told:
            assert_same(numbers(turn), numbers(told[turn.index]))
    assert done in told
    loop_state = resumed.state_dict()["loop"]
    assert len(loop_state["evidence"]) == done + 2


def test_a_robot_says_whether_its_answers_are_recorded():
    class Own:
        def rollouts(self, policy, *, episodes, key):
            raise AssertionError

    with pytest.raises(TypeError, match=r"a robot with recorded=.*Try: recorded = False"):
        make_loop(robot=Own())
