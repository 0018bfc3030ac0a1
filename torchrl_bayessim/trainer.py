"""The posterior as a hook of TorchRL's ``Trainer``, for those who train with one.

Every ``interval`` batches, one batch is drawn from where the posterior is to be learned and not
from the posterior itself. It serves the trainer as any other does, and its first trajectories are
the pairs of the next posterior. In between, training draws from the posterior.

Summaries depend on the policy, and a trainer changes the policy after every batch. So all pairs of
a fit come from one batch, and the robot is asked when that batch has been collected, to run the
policy that collected it. The policy's weights are noted before that batch and compared after it;
pairs of another policy are refused.
"""

from __future__ import annotations

__all__ = ["PosteriorTrainerHook"]

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, MultiAsyncCollector
from torchrl.envs import EnvBase
from torchrl.trainers import Trainer, TrainerHookBase

from .counts import check_count
from .errors import PhysicsError, message
from .inference.fit import FitReport
from .inference.refinement import PosteriorRefinement
from .real_trajectories import check_columns, check_cut, check_real, comparable
from .remote_source import PolicyWithSource, push_source
from .robots import RealSystem
from .sources import Defensive, Source, check_prior_share
from .summaries import SummaryStatistics
from .trajectories import returns
from .transforms.domain_randomizer import DomainRandomizer


class PosteriorTrainerHook(TrainerHookBase):
    """Refines a posterior from a trainer's batches, and lets its environments draw from it.

    One batch of N environments gives N pairs, so N should be in the hundreds. The posterior is
    conditioned on the latest real episodes; earlier ones, which other policies made, count only
    through the box in which the next pairs are drawn. Logs cannot be used: a trainer does not
    replay them.

    Args:
        robot: The real side; asked for ``episodes`` after every ``interval`` batches.
        refinement: The posterior, and how it is refined.
        statistics: Summaries of trajectories.
        randomizer: The transform of the collector's environment that draws the parameters; ``None``
            if the collector's policy is a :class:`.remote_source.PolicyWithSource`, as
            environments in other processes need.
        interval: Batches from one refinement to the next; the first is one.
        episodes: Real episodes per refinement, independent given the parameters.
        prior_share: Probability of a prior draw while training.
        seed: Same seed, same real episodes and fits.

    Raises:
        TypeError: A count is no whole number.
        ValueError: An interval below 2, or no episodes; at registration, a trainer whose batches do
            not begin with a reset or may be made by several policies, or a randomizer that its
            collector does not step; in training, a robot that answers with other entries or sizes
            than the simulator has, or whose episodes are cut elsewhere.
        PhysicsError: The batch of the pairs was not drawn from where the posterior is learned.
        RuntimeError: The policy was changed while the batch of the pairs was collected.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import Compose, StepCounter, TransformedEnv
        >>> from torchrl.objectives import ClipPPOLoss
        >>> from torchrl.objectives.value import GAE
        >>> from torchrl.trainers import DefaultOptimizationStepper, Trainer
        >>> from torchrl_bayessim.agents.ppo import PPO
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.robots import SurrogateRobot
        >>> from torchrl_bayessim.summaries import cross_correlation
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> prior = BoxPrior({"length": (0.1, 2.0)})
        >>> randomizer, physics = DomainRandomizer(prior), AttributePhysics("length")
        >>> env = TransformedEnv(CartPoleEnv(64), Compose(ApplyPhysics(physics), randomizer))
        >>> robot = TransformedEnv(CartPoleEnv(1), ApplyPhysics(physics))
        >>> agent = PPO(env)                                  # or any actor and critic
        >>> loss = ClipPPOLoss(agent.policy, agent.critic)
        >>> collector = Collector(env, agent.policy, frames_per_batch=64 * 20, total_frames=3840,
        ...                       reset_at_each_iter=True, auto_register_policy_transforms=False)
        >>> trainer = Trainer(
        ...     collector=collector, total_frames=3840, frame_skip=1, optim_steps_per_batch=4,
        ...     loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        ...     optimization_stepper=DefaultOptimizationStepper(), progress_bar=False)
        >>> advantage = GAE(gamma=0.99, lmbda=0.95, value_network=agent.critic)
        >>> trainer.register_op("batch_process", advantage)
        >>> hook = PosteriorTrainerHook(
        ...     SurrogateRobot(robot, [0.7], max_steps=20),
        ...     refinement=PosteriorRefinement(prior, fit_options={"epochs": 5, "progress": False}),
        ...     statistics=SummaryStatistics(cross_correlation), randomizer=randomizer, interval=2)
        >>> hook.register(trainer)
        >>> trainer.train()
        >>> hook.refinement.posterior.names, hook.report.pairs
        (('length',), 64)
    """

    def __init__(
        self,
        robot: RealSystem,
        *,
        refinement: PosteriorRefinement,
        statistics: SummaryStatistics,
        randomizer: DomainRandomizer | None = None,
        interval: int = 8,
        episodes: int = 1,
        prior_share: float = 0.1,
        seed: int = 0,
    ) -> None:
        check_count("batches per interval", interval, least=2)
        check_count("episodes", episodes)
        check_prior_share(prior_share)
        if robot.recorded:
            raise ValueError(
                message("a robot that runs the policy", "recorded logs", hint="SimToRealLoop")
            )
        self.robot, self.refinement, self.statistics = robot, refinement, statistics
        self.randomizer, self.interval, self.episodes = randomizer, interval, episodes
        self.prior_share, self.seed = prior_share, seed
        self.report: FitReport | None = None
        self._batches = 0  # processed so far
        self._earned: dict[str, float] = {}
        self._collector: BaseCollector | None = None
        self._noted: dict[str, Tensor] = {}
        self._source: Source | None = None

    def register(self, trainer: Trainer, name: str = "posterior") -> None:
        """Add the hook to ``trainer``, after the hooks that push weights to its collector."""
        collector: Any = trainer.collector
        several = trainer.async_collection or isinstance(collector, MultiAsyncCollector)
        if several or trainer.learner_backend != "local":
            raise ValueError(
                message(
                    "a trainer each of whose batches one policy makes",
                    f"asynchronous collection by {type(collector).__name__}",
                    hint="Collector or MultiSyncCollector, and a local learner",
                )
            )
        if not getattr(collector, "reset_at_each_iter", False):
            raise ValueError(
                message(
                    "batches that begin with a reset",
                    f"a {type(collector).__name__} that goes on with running episodes",
                    hint="reset_at_each_iter=True",
                )
            )
        if self.randomizer is not None and not self.randomizer.drives(_environment(collector)):
            raise ValueError(
                message(
                    "a randomizer among the transforms of the collector's environment",
                    f"one that the {type(collector).__name__} does not step",
                    hint="for environments in other processes randomizer=None, and "
                    "PolicyWithSource(policy, prior) as the collector's policy",
                )
            )
        self._collector = collector
        trainer.register_op("batch_process", self.process)
        trainer.register_op("pre_steps_log", self.log)
        trainer.register_op("post_steps", self.after)
        trainer.register_module(name, self)
        self._draw_next()

    def process(self, batch: TensorDictBase) -> TensorDictBase:
        """Refine the posterior if the batch was collected for that; return the batch."""
        due = self._batches % self.interval == 0
        if due:
            self._refine(batch.reshape(-1, batch.shape[-1]))
        self._batches += 1
        if due:
            self._draw_next()
        return batch

    def after(self) -> None:
        """Let the next batch bring pairs if it is to."""
        if self._batches % self.interval == 0:
            self._draw_next()

    def log(self, batch: TensorDictBase) -> dict[str, float] | None:
        """Return the posterior's moments, its fit and the robot's mean return, if it knows one."""
        del batch
        posterior, report = self.refinement.posterior, self.report
        if posterior is None or report is None or self._batches % self.interval != 1:
            return None
        scalars = {"posterior/loss": report.best, "posterior/dropped": float(report.dropped)}
        scalars |= self._earned
        moments = zip(posterior.names, posterior.mean, posterior.stddev, strict=True)
        for name, mean, spread in moments:
            scalars |= {f"posterior/{name}": mean.item(), f"posterior/{name}_sd": spread.item()}
        return scalars

    def _refine(self, batch: TensorDictBase) -> None:
        policy = self._policy()
        weights = policy.state_dict()
        if any(not torch.equal(value, weights[name]) for name, value in self._noted.items()):
            raise RuntimeError(
                message(
                    "the policy to stay while the batch of the pairs was collected",
                    "other weights after it than before",
                    hint="register this hook last",
                )
            )
        key = (self.seed, "batch", self._batches)
        real = self.robot.rollouts(policy, episodes=self.episodes, key=key)
        read = self.statistics.in_keys
        check_real(real, read)
        real = comparable(real, horizon=batch.shape[-1])
        pairs = self.statistics(batch)
        check_columns(real, {key: batch.get(key).shape[-1] for key in read[:3]})
        check_cut(batch, real)
        known = real.get(("next", "reward"), None) is not None
        self._earned = {"real/return": returns(real).mean().item()} if known else {}
        self._check_drawn(pairs.get("theta", None))
        observed = self.statistics(real).get("summary")
        self.report = self.refinement.learn(
            pairs.get("theta"), pairs.get("summary"), observed, key=key
        )

    def _check_drawn(self, theta: Tensor | None) -> None:
        """Refuse pairs that were not drawn from the proposal."""
        if self.randomizer is not None:
            drawn = self.randomizer.source is self._source and self.randomizer.pinned is None
        else:
            carrier = PolicyWithSource.inside(self._policy())
            assert carrier is not None  # it was pushed to
            table = {tuple(row) for row in carrier.draws.tolist()}
            drawn = theta is not None and all(tuple(row) in table for row in theta.tolist())
        if theta is None or not drawn:
            raise PhysicsError(
                message(
                    "a batch of parameters drawn from where the posterior is to be learned",
                    "no parameters" if theta is None else f"others, {theta[0].tolist()} first",
                    hint="a DomainRandomizer in every environment, not pinned, and its source left "
                    "to this hook",
                )
            )

    def _draw_next(self) -> None:
        """Choose where the next batch is drawn from, and note whose it will be."""
        posterior = self.refinement.posterior
        if self._batches % self.interval == 0:
            self._draw_from(self.refinement.proposal())
            self._noted = {k: v.clone() for k, v in self._policy().state_dict().items()}
        elif posterior is not None:
            self._draw_from(Defensive(posterior, self.refinement.prior, self.prior_share))

    def _draw_from(self, source: Source) -> None:
        self._source = source
        if self.randomizer is not None:
            self.randomizer.source = source
        elif self._collector is not None:
            push_source(self._collector, source, key=(self.seed, "source", self._batches))

    def _policy(self) -> Any:
        assert self._collector is not None  # registered
        return self._collector.policy

    def state_dict(self) -> dict[str, Any]:
        """Return the posterior and how many batches there have been."""
        return {"batches": self._batches, "refinement": self.refinement.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from such a state; the environments draw from its posterior at once."""
        self._batches = state_dict["batches"]
        self.refinement.load_state_dict(state_dict["refinement"])
        if self._collector is not None:
            self._draw_next()


def _environment(collector: Any) -> EnvBase | None:
    """Return the environment that a collector steps in this process, None if it has none here."""
    env = getattr(collector, "env", None)
    return env if isinstance(env, EnvBase) else None
