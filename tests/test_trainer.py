import copy

import pytest
import torch
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import Compose, StepCounter, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers import DefaultOptimizationStepper, Trainer
from torchrl.trainers.algorithms.ppo import PPOTrainer

from torchrl_bayessim import checkpoint
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.remote_source import PolicyWithSource
from torchrl_bayessim.robots import RecordedLogs, SurrogateRobot
from torchrl_bayessim.sources import Defensive
from torchrl_bayessim.summaries import SummaryStatistics, moments
from torchrl_bayessim.trainer import PosteriorTrainerHook
from torchrl_bayessim.trajectories import pad
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

PRIOR = BoxPrior({"length": (0.2, 1.5)})
STATISTICS = SummaryStatistics(moments)
WIDTH, STEPS = 16, 8
FRAMES = WIDTH * STEPS


def small(prior, size):
    return MixtureDensityPosterior(prior, size, components=1)


def physics():
    return ApplyPhysics(AttributePhysics("length"))


def make_env(width=WIDTH):
    return TransformedEnv(CartPoleEnv(width), Compose(physics(), DomainRandomizer(PRIOR)))


class Watched(SurrogateRobot):
    """A robot that remembers what it was asked to run."""

    def __init__(self, horizon=STEPS):
        env = TransformedEnv(CartPoleEnv(2), physics())
        super().__init__(env, [0.6], max_steps=horizon)
        self.weights = []

    def rollouts(self, policy, **options):
        self.weights.append(copy.deepcopy(policy.state_dict()))
        return super().rollouts(policy, **options)


def make_hook(randomizer, robot=None, **options):
    fit = {"epochs": 2, "progress": False}
    refinement = PosteriorRefinement(PRIOR, networks=1, make_posterior=small, fit_options=fit)
    return PosteriorTrainerHook(
        robot or Watched(),
        refinement=refinement,
        statistics=STATISTICS,
        randomizer=randomizer,
        interval=3,
        **options,
    )


def make_trainer(agent, collector, batches, kind=Trainer):
    loss = ClipPPOLoss(agent.policy, agent.critic)
    stepper = {"optimization_stepper": DefaultOptimizationStepper()} if kind is Trainer else {}
    trainer = kind(
        collector=collector,
        total_frames=batches * FRAMES,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-2),
        progress_bar=False,
        log_interval=1,
        **stepper,
    )
    if kind is Trainer:
        advantage = GAE(gamma=0.99, lmbda=0.95, value_network=agent.critic)
        trainer.register_op("batch_process", advantage)
    return trainer


def direct(batches=8, *, kind=Trainer, **options):
    """Return a trainer, its agent and its randomizer."""
    env = make_env()
    agent = PPO(env, hidden=(4,))
    options = {"reset_at_each_iter": True, "auto_register_policy_transforms": False} | options
    collector = Collector(
        env, agent.policy, frames_per_batch=FRAMES, total_frames=batches * FRAMES, **options
    )
    return make_trainer(agent, collector, batches, kind), agent, env.transform[1]


def watch(trainer, hook):
    """Return a list that will hold each batch and the policy's weights when it arrives."""
    seen = []

    def note(batch):
        weights = copy.deepcopy(trainer.collector.policy.state_dict())
        seen.append((batch.reshape(-1, batch.shape[-1]).clone(), weights))
        return batch

    trainer.register_op("batch_process", note)
    hook.register(trainer)
    return seen


def made_by(policy, weights, batch):
    """Return whether the batch's actions have the probabilities that these weights give them."""
    policy = copy.deepcopy(policy)
    policy.load_state_dict(weights)
    actor = policy.td_module if isinstance(policy, PolicyWithSource) else policy
    with torch.no_grad():
        log_prob = actor.get_dist(batch.clone()).log_prob(batch["action"])
    return torch.allclose(log_prob, batch["action_log_prob"], atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*experimental/prototype:UserWarning")
@pytest.mark.filterwarnings("ignore:The 'optimizer' hook stage:FutureWarning")
@pytest.mark.parametrize("kind", [Trainer, PPOTrainer])
def test_every_third_batch_brings_pairs_of_its_own_policy(kind, monkeypatch):
    trainer, agent, randomizer = direct(kind=kind)
    hook, learned = make_hook(randomizer), []
    learn = hook.refinement.learn

    def watched(theta, summary, observed, *, key):
        local = hook.refinement.proposal()
        learned.append((local, theta, summary, observed))
        return learn(theta, summary, observed, key=key)

    monkeypatch.setattr(hook.refinement, "learn", watched)
    seen = watch(trainer, hook)
    trainer.train()
    assert len(seen) == 8
    assert len(learned) == len(hook.robot.weights) == 3
    for turn, (local, theta, summary, observed) in enumerate(learned):
        batch, _ = seen[3 * turn]
        assert torch.equal(theta, batch["theta"][:, 0])
        assert torch.equal(summary, STATISTICS(batch)["summary"])
        assert observed.shape == (1, summary.shape[-1])
        assert local.contains(theta).all()
        # the robot ran the policy that made the batch, and training changed it in between
        assert made_by(agent.policy, hook.robot.weights[turn], batch)
    assert not made_by(agent.policy, hook.robot.weights[0], seen[3][0])
    assert learned[0][0] is PRIOR


def test_between_refinements_training_draws_from_the_posterior():
    trainer, _, randomizer = direct(batches=5)
    hook, sources = make_hook(randomizer), []
    hook.register(trainer)
    trainer.register_op("batch_process", lambda batch: sources.append(randomizer.source) or batch)
    trainer.train()
    # the source in force after each batch: what the next one is drawn from
    assert [isinstance(source, Defensive) for source in sources] == [True] * 5
    assert sources[0].source is sources[1].source is not sources[3].source
    assert sources[3].source is hook.refinement.posterior


def test_the_moments_of_the_posterior_are_logged_once_per_refinement():
    trainer, _, randomizer = direct(batches=7)
    make_hook(randomizer).register(trainer)
    trainer.train()
    for name in ("loss", "dropped", "length", "length_sd"):
        assert len(trainer._log_dict[f"posterior/{name}"]) == 3
    assert 0.2 < trainer._log_dict["posterior/length"][-1] < 1.5
    assert trainer._log_dict["real/return"] == [STEPS] * 3  # nobody falls in eight steps


def test_a_robot_need_not_know_rewards():
    trainer, _, randomizer = direct(batches=2)
    robot = Answering(lambda real: real.exclude(("next", "reward")))
    make_hook(randomizer, robot).register(trainer)
    trainer.train()
    assert "real/return" not in trainer._log_dict
    assert len(trainer._log_dict["posterior/length"]) == 1


def test_a_loaded_hook_goes_on_where_it_stopped(tmp_path):
    trainer, _, randomizer = direct(batches=4)
    hook = make_hook(randomizer)
    hook.register(trainer)
    trainer.train()
    checkpoint.save(tmp_path / "hook.pt", trainer._modules["posterior"].state_dict())
    other, _, randomizer = direct()
    resumed = make_hook(randomizer)
    resumed.register(other)
    assert randomizer.source is PRIOR
    resumed.load_state_dict(checkpoint.load(tmp_path / "hook.pt"))
    theta = PRIOR.sample((5,))
    old, new = hook.refinement.posterior, resumed.refinement.posterior
    assert torch.equal(old.log_prob(theta), new.log_prob(theta))
    assert isinstance(randomizer.source, Defensive)
    assert resumed.state_dict()["batches"] == 4


def test_environments_in_other_processes_get_the_source_with_the_weights():
    """The pairs of the second refinement lie in its box, so it arrived in both workers."""
    env = make_env()
    agent = PPO(env, hidden=(4,))
    policy = PolicyWithSource(agent.policy, PRIOR, draws=256)
    collector = MultiSyncCollector(
        [lambda: make_env(WIDTH // 2)] * 2,
        policy,
        frames_per_batch=FRAMES,
        total_frames=4 * FRAMES,
        reset_at_each_iter=True,
        cat_results="stack",
        auto_register_policy_transforms=False,
    )
    trainer = make_trainer(agent, collector, 4)
    hook = make_hook(None)
    seen = watch(trainer, hook)
    trainer.train()
    assert hook.report.pairs == WIDTH
    for batch, weights in seen:  # the table in force holds all that the workers drew
        assert torch.isin(batch["theta"], weights["draws"]).all()
    both = torch.isin(seen[0][1]["draws"], seen[1][1]["draws"])
    assert both.double().mean() < 0.05  # single-precision numbers may coincide
    assert len(hook.robot.weights) == 2
    for asked, (batch, _) in zip(hook.robot.weights, seen[::3], strict=True):
        assert made_by(policy, asked, batch)
    assert not made_by(policy, hook.robot.weights[0], seen[3][0])


def test_a_policy_that_changes_during_collection_is_noticed():
    trainer, agent, randomizer = direct()
    hook = make_hook(randomizer)
    hook.register(trainer)

    def meddle():
        with torch.no_grad():
            next(iter(agent.policy.parameters())).add_(1.0)

    trainer.register_op("post_steps", meddle)
    with pytest.raises(RuntimeError, match=r"policy to stay.*Try: register this hook last"):
        trainer.train()


def test_trainers_that_could_mix_policies_or_episodes_are_refused():
    trainer, _, randomizer = direct(reset_at_each_iter=False)
    with pytest.raises(ValueError, match=r"begin with a reset.*Try: reset_at_each_iter=True"):
        make_hook(randomizer).register(trainer)
    env = make_env()
    agent = PPO(env, hidden=(4,))
    options = {"frames_per_batch": FRAMES, "total_frames": FRAMES, "reset_at_each_iter": True}
    collector = MultiAsyncCollector([make_env], agent.policy, **options)
    try:
        with pytest.raises(ValueError, match=r"one policy makes.*MultiAsyncCollector"):
            make_hook(None).register(make_trainer(agent, collector, 1))
    finally:
        collector.shutdown()


def test_a_randomizer_that_the_collector_does_not_step_is_refused():
    trainer, agent, _ = direct()
    other = make_env().transform[1]
    with pytest.raises(ValueError, match=r"the Collector does not step.*randomizer=None"):
        make_hook(other).register(trainer)
    # environments in another process hold copies of the randomizer here, which nothing reaches
    options = {"frames_per_batch": FRAMES, "total_frames": FRAMES, "reset_at_each_iter": True}
    env = make_env()
    collector = MultiSyncCollector([env], agent.policy, **options)
    try:
        with pytest.raises(ValueError, match="the MultiSyncCollector does not step"):
            make_hook(env.transform[1]).register(make_trainer(agent, collector, 1))
    finally:
        collector.shutdown()


@pytest.mark.parametrize("meddle", ["pin", "assign"])
def test_pairs_that_were_not_drawn_from_the_proposal_are_refused(meddle):
    trainer, _, randomizer = direct()
    make_hook(randomizer).register(trainer)
    if meddle == "pin":
        randomizer.pin([0.5])
    else:
        randomizer.source = BoxPrior({"length": (0.2, 1.0)})
    with pytest.raises(PhysicsError, match="drawn from where the posterior is to be learned"):
        trainer.train()


def test_a_worker_that_cannot_be_told_is_refused():
    trainer, _, _ = direct()
    with pytest.raises(TypeError, match="whose policy is a PolicyWithSource"):
        make_hook(None).register(trainer)


def test_robots_and_intervals_that_do_not_fit_are_refused():
    _, _, randomizer = direct()
    with pytest.raises(ValueError, match="at least 2 batches per interval, got 1"):
        PosteriorTrainerHook(
            Watched(), refinement=PosteriorRefinement(PRIOR), statistics=STATISTICS, interval=1
        )
    robot = SurrogateRobot(TransformedEnv(CartPoleEnv(2), physics()), [0.6], max_steps=STEPS)
    real = robot.rollouts(None, episodes=2, key=(0,)).exclude("mask")
    with pytest.raises(ValueError, match=r"runs the policy, got 'recorded logs'"):
        make_hook(randomizer, RecordedLogs(pad(list(real))))
    trainer, _, randomizer = direct()
    make_hook(randomizer, Watched(STEPS - 2)).register(trainer)
    with pytest.raises(ValueError, match=f"last the {STEPS} steps of simulated ones"):
        trainer.train()


class Answering(Watched):
    """A robot whose answer is changed."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def rollouts(self, policy, **options):
        return self.change(super().rollouts(policy, **options))


ANSWERS = {
    "nothing": (lambda real: None, TypeError, "in a TensorDict, got 'NoneType'"),
    "three dimensions": (lambda real: real[None], ValueError, r"\[n, T\] of .* got \(1, 1, 8\)"),
    "no action": (lambda real: real.exclude("action"), ValueError, "an entry, got 'action'"),
    "no done": (lambda real: real.exclude(("next", "done")), ValueError, r"got .*'next', 'done'"),
    "more columns": (
        lambda real: real.set("action", torch.cat([real["action"]] * 2, -1)),
        ValueError,
        "2 columns of 'action', as the simulator has, got '4 from the robot'",
    ),
}


@pytest.mark.parametrize("answer", ANSWERS)
def test_what_a_robot_may_answer(answer):
    change, error, text = ANSWERS[answer]
    trainer, _, randomizer = direct()
    make_hook(randomizer, Answering(change)).register(trainer)
    with pytest.raises(error, match=text):
        trainer.train()


def test_a_trainer_whose_episodes_a_time_limit_cuts_before_the_real_ones_end():
    trainer, _, randomizer = direct()
    trainer.collector.env.append_transform(StepCounter(5))
    make_hook(randomizer).register(trainer)
    text = rf"may last the {STEPS} steps of real ones, got '{WIDTH} of {WIDTH} cut, after 5 steps"
    with pytest.raises(ValueError, match=text):
        trainer.train()
