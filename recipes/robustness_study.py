"""The policies of one seed: trained under each source of physics, kept, and scored alike."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import recipe
import torch
from fetch_tasks import MEASURED, GoalTask
from scoring import Score
from tasks import Task
from torch import Tensor
from training import Plan, first_solved, thinned, train
from video import record

from torchrl_bayessim import checkpoint
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.influence import check_influence
from torchrl_bayessim.randomness import seed_from
from torchrl_bayessim.real_trajectories import comparable
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.sources import Grid
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer

# Settings with others of which a file would hold another policy, posterior, or scores
TRAINED_BY = (
    *("task", "preset", "domains", "critic_sees_physics"),
    *("checkpoint", "matmul_precision", "short"),
)
INFERRED_BY = ("episodes", "simulations", "refinements", "truth")
SCORED_BY = ("points", "grid_episodes", "real_episodes", "truth")
# Looks at a policy in a training, of which the best is taken: dear where MuJoCo steps
LOOKS = {"goals": 10, "returns": 20}
CHOOSING = 256  # episodes: of 15 looks at 64 the best was a lucky one, 0.95 and then 0.86
# Score that counts as solved: a mean return (Gymnasium's own mark for CartPole) or a success
SOLVED = {"cartpole": 475.0, "fetch_push": 0.9, "fetch_slide": 0.6, "fetch_reach": 0.9}


def nominal(task: Task) -> Tensor:
    """Return the simulator's own parameters."""
    env = task.make(1, seed=0, randomizer=None)
    return env.reset()["theta"][0]


class Study:
    """The policies of one seed, each trained once and kept."""

    def __init__(self, task: Task, truth: Tensor, settings: Any, out: Path, *, seed: int) -> None:
        self.task, self.truth, self.settings, self.seed = task, truth, settings, seed
        self.out = out
        self.steps = min(128, task.max_steps)  # of a trajectory that inference sees
        self.randomizer = DomainRandomizer(task.prior, seed=seed, pool=settings.domains or None)
        self._begun = self.randomizer.get_extra_state()
        self.env = task.make(task.environments, seed=seed, randomizer=self.randomizer)
        check_influence(self.env, self.randomizer, task.prior, steps=task.horizon)
        learner = self._learner()
        self.algorithm = getattr(learner, "name", "PPO")
        self.batches = settings.batches or getattr(task, "budget", 0)
        frames = self.batches * task.environments * task.horizon
        self._training = {"algorithm": self.algorithm, "frames": frames, "seed": seed}
        self._training["learner"] = recipe.plain(getattr(learner, "settings", {}))

    @property
    def inference_frames(self) -> int:
        """Frames that are simulated for the posterior, beside those of training."""
        settings = self.settings
        return settings.refinements * settings.simulations * settings.episodes * self.steps

    def scored(self, source: str) -> dict[str, Any]:
        """Return the scores of the policy trained under ``source``, from its file if it has one."""
        file = self.out / f"{source}.json"
        found = recipe.kept(file, lambda: self._made(source))
        self._check_made_by(found.get("made_by"), file, *self._scoring(source))
        self._check_scores(found, file)
        replayed = self.out / f"{source}.pt"  # a hundred megabytes
        replayed.unlink(missing_ok=True)
        return found

    def _check_scores(self, found: dict[str, Any], file: Path) -> None:
        """Refuse a damaged file, in which something is missing or of another kind."""
        grids, curve = found.get("grids"), found.get("curve")
        numbers = [found.get(name) for name in ("at_real", "under_prior", "real_episodes")]
        whole = {"posterior", "solved"} <= found.keys() and isinstance(curve, list) and curve
        whole = whole and all(isinstance(number, int | float) for number in numbers)
        whole = whole and isinstance(grids, dict) and {*self.task.prior.names} == grids.keys()
        if not whole:
            hint = "delete the file, and the policy is trained again"
            raise ValueError(
                message("the scores of a policy", f"{file}: {sorted(found)}", hint=hint)
            )

    def _made(self, source: str) -> dict[str, Any]:
        """Return the scores, and of what they were made: folders are put together and resumed."""
        start = time.monotonic()
        found = self._scored(source)
        seconds = time.monotonic() - start
        provenance = recipe.provenance(self.settings, seconds=seconds)
        made_by = self._made_by(*self._scoring(source))
        return found | {"made_by": made_by, "provenance": provenance}

    def _scoring(self, source: str) -> tuple[str, ...]:
        return SCORED_BY + (INFERRED_BY if source == "posterior" else ())

    def _made_by(self, *names: str) -> dict[str, Any]:
        """Return what else would make another file: how a policy is trained, and these settings."""
        named = {name: getattr(self.settings, name) for name in (*TRAINED_BY, *names)}
        return named | self._training

    def _check_made_by(self, found: Any, file: Path, *names: str) -> None:
        """Refuse what another run has made; what older files do not say is let pass."""
        found = found or {}
        for name, asked in self._made_by(*names).items():
            if found.get(name, asked) != asked:
                expected, got = f"{file} of a run with {name}={asked}", found[name]
                hint = "another out=, or the settings of the run that wrote it"
                raise ValueError(message(expected, got, hint=hint))

    def _scored(self, source: str) -> dict[str, Any]:
        learner = self._learner()
        trained = self._trained(source, learner)
        learner.policy.load_state_dict(trained.best)
        checkpoint.save(self.out / f"{source}_policy.pt", trained.best)
        found = self._scores(learner.policy) | {"posterior": self._posterior_moments(source)}
        shown = thinned(trained.curve, 40)
        if self.settings.video and self.seed == self.settings.seed:
            film = self.out / f"{source}.gif"
            made = record(self.task, learner.policy, self.truth, film)
            found["video"] = made and f"{self.out.name}/{film.name}"
        found["solved"] = first_solved(shown, SOLVED[self.settings.task])
        names = ("frames", "return", "score", "seconds", "cpu_seconds")
        found["curve"] = [{name: p[name] for name in names if name in p} for p in shown]
        return found

    def _learner(self) -> Any:
        if isinstance(self.task, GoalTask):
            return self.task.learner(self.env, seed=self.seed)
        return PPO(self.env, seed=self.seed, **self.task.ppo)

    def _trained(self, source: str, learner: Any) -> Any:
        self.randomizer.source = self._source(source)
        self.randomizer.set_extra_state(self._begun)  # the same first episode for all sources
        goals = isinstance(self.task, GoalTask)
        looks = LOOKS["goals" if goals else "returns"]
        chosen = self.settings.checkpoint == "best"
        plan = Plan(
            2 if self.settings.short else self.batches,
            self.task.horizon,
            file=self.out / f"{source}.pt",
            keep_every=50 if goals else 200,
            score_every=math.ceil(self.batches / looks) or 1,
        )
        return train(
            learner,
            self.env,
            self.randomizer,
            plan,
            key=(self.seed, "robustness"),  # the same for all sources: common random numbers
            score=self._select() if chosen else None,
            label=f"seed {self.seed}, {source}",
            progress=self.settings.progress,
        )

    def _source(self, source: str) -> Any:
        if source == "prior":
            return self.task.prior
        if source == "posterior":
            return self._posterior()
        return Grid((self.truth if source == "oracle" else nominal(self.task))[None])

    def _posterior(self) -> Any:
        """Infer the posterior from what the prior's policy does at the robot."""
        refinement = self._refinement()
        file = self.out / "posterior_state.pt"
        if file.exists():
            state = checkpoint.load(file)
            self._check_made_by(state.get("made_by"), file, *INFERRED_BY)
            refinement.load_state_dict(state)
            return refinement.posterior
        task, settings = self.task, self.settings
        policy = self._collecting()
        statistics = SummaryStatistics(*task.summaries)
        measured = MEASURED if isinstance(task, GoalTask) else ("observation",)
        env = task.make(settings.episodes, seed=self.seed, randomizer=None)
        robot = SurrogateRobot(env, self.truth, max_steps=self.steps, measured=measured)
        real = robot.rollouts(policy, episodes=settings.episodes, key=(self.seed, "real"))
        observed = statistics.together(comparable(real, horizon=self.steps))
        randomizer = DomainRandomizer(task.prior, seed=self.seed)
        rows = min(64, settings.simulations * settings.episodes)
        env = task.make(rows, seed=self.seed, randomizer=randomizer)
        for turn in range(settings.refinements):
            randomizer.source = refinement.proposal()
            pairs = simulate(
                env,
                policy,
                statistics,
                randomizer,
                pairs=settings.simulations,
                max_steps=self.steps,
                trajectories=settings.episodes,
                seed=seed_from(self.seed, turn) % 2**31 if turn else self.seed,
                progress=settings.progress,
            )
            key = ("robustness", turn) if turn else ("robustness",)
            refinement.learn(pairs["theta"], pairs["summary"], observed, key=key)
        made_by = {"made_by": self._made_by(*INFERRED_BY)}
        checkpoint.save(file, refinement.state_dict() | made_by)
        return refinement.posterior

    def _collecting(self) -> Any:
        """Return the prior's policy, which collects at the robot."""
        policy, file = self._learner().policy, self.out / "prior_policy.pt"
        try:
            policy.load_state_dict(checkpoint.load(file))
        except (FileNotFoundError, RuntimeError) as error:  # torch's, of networks of other sizes
            expected, hint = "the prior's policy, which collects", "delete prior.json beside it"
            got = f"{file}: {type(error).__name__}"
            raise ValueError(message(expected, got, hint=f"{hint} to train it again")) from error
        return policy

    def _refinement(self) -> PosteriorRefinement:
        epochs = 40 if self.settings.short else 300
        options = {"progress": self.settings.progress, "epochs": epochs}
        return PosteriorRefinement(self.task.prior, seed=self.seed, fit_options=options)

    def _posterior_moments(self, source: str) -> dict[str, Any] | None:
        if source != "posterior":
            return None
        posterior = self._posterior()
        gain = posterior.log_prob(self.truth) - self.task.prior.log_prob(self.truth)
        return {
            "mean": posterior.mean.tolist(),
            "sd": posterior.stddev.tolist(),
            "nats_over_prior": gain.item(),
        }

    def _select(self) -> Any:
        """Return the score by which a checkpoint is chosen: other episodes, own physics."""
        score = Score(self.task, self.randomizer.source, episodes=CHOOSING, seed=7)
        return lambda policy: score(policy).mean().item()

    def _scores(self, policy: Any) -> dict[str, Any]:
        settings, truth = self.settings, self.truth
        episodes = settings.grid_episodes
        grids = {}
        for column, name in enumerate(self.task.prior.names):
            low, high = self.task.prior.low[column], self.task.prior.high[column]
            values = torch.linspace(low.item(), high.item(), settings.points)
            theta = truth.repeat(settings.points, 1)
            theta[:, column] = values
            score = Score(self.task, Grid(theta), episodes=settings.points * episodes, seed=11)
            found = score(policy)
            means = found.reshape(episodes, settings.points).mean(0)
            grids[name] = {"grid": values.tolist(), "score": means.tolist()}
        count = settings.real_episodes
        at_real = Score(self.task, Grid(truth[None]), episodes=count, seed=13)(policy)
        under_prior = Score(self.task, self.task.prior, episodes=count, seed=17)(policy)
        return {
            "grids": grids,
            "at_real": at_real.mean().item(),
            "under_prior": under_prior.mean().item(),
            "real_episodes": len(at_real),
        }
