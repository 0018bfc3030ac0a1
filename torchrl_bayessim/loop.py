"""The loop: real data, posterior, policy trained under it, new real data.

Each round (BayesSim, arXiv:1906.01728, fig. 1, made iterative):

1. the robot runs the current policy;
2. the collector simulates with the *same* policy, parameters drawn where the last posterior is;
   its batches give pairs for the posterior **and** are kept for the learner;
3. the posterior is refined, conditioned on all the real data so far;
4. the randomizer draws from it, and the learner improves the policy from the batches of step 2
   and from new ones.

How step 2 makes simulations that compare with the real data is told in :mod:`.evidence`.
"""

from __future__ import annotations

__all__ = ["Learner", "Round", "SimToRealLoop"]

import copy
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from . import checkpoint
from .counts import check_count
from .diverged import finite_rows
from .errors import message
from .evidence import Evidence, EvidenceSimulator
from .inference.fit import FitReport
from .inference.physics_posterior import PhysicsPosterior
from .inference.refinement import PosteriorRefinement
from .kinds import check_function, check_kind
from .overlapped import Overlapped
from .ray_collectors import RayCollectors
from .real_trajectories import (
    check_columns,
    check_cut,
    check_real,
    comparable,
    simulated_columns,
)
from .robots import RealSystem, RecordedLogs
from .simulate import check_parts
from .sources import Defensive, check_prior_share
from .summaries import SummaryStatistics
from .trajectories import concatenate, next_key
from .transforms.domain_randomizer import DomainRandomizer


class Learner(Protocol):
    """What the loop asks of an agent: a policy, and a way to improve it from batches.

    If it has ``settings``, a dictionary of plain values, a checkpoint of others is refused. If it
    has ``begin``, ``work`` and ``finish`` they are used in the place of ``update``, to learn while
    the next batch is collected: see :mod:`.overlapped`.
    """

    policy: TensorDictModuleBase

    def update(
        self, batch: TensorDictBase, *, key: tuple[int | str, ...], progress: float
    ) -> dict[str, float]:
        """Improve the policy from a batch ``[N, T]``; ``progress`` in [0, 1] is the share done."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that ``update`` depends on."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state."""
        ...


@dataclass(frozen=True)
class Round:
    """One turn of the loop.

    Attributes:
        index: From 0.
        posterior: Given all the real trajectories of this and earlier rounds.
        real: This round's real trajectories, ``[n, T]``.
        fit: What the fit of the posterior did.
        simulations: Pairs that the fit used.
        frames: Environment frames that the learner has seen since the start.
        curve: One entry per update: ``frames``, ``return`` of the episodes that ended in the
            batch (NaN if none did), what the learner reports, and ``dropped`` rows that diverged.
        seconds: Wall time of the round.
    """

    index: int
    posterior: PhysicsPosterior
    real: TensorDictBase
    fit: FitReport
    simulations: int
    frames: int
    curve: list[dict[str, float]]
    seconds: float


class SimToRealLoop:
    """Rounds of inference and learning; iterate over it, and stop when you like.

    A round counts as done when the next one is asked for, so that a run which is killed while its
    caller works with a round yields it again. So does a second ``for`` after a ``break``: the round
    in which the first was left comes again, as it was; nothing is computed twice.

    Args:
        env: Simulated environments, batch size ``[N]``, with ``randomizer`` among their
            transforms. With recorded logs it needs a ``StepCounter``.
        learner: Such as :class:`.agents.ppo.PPO`; its policy collects and is improved.
        robot: The real side.
        refinement: The posterior, and how it is refined.
        statistics: Summaries of trajectories.
        randomizer: The transform of ``env`` that draws the parameters.
        horizon: Steps per row of a batch, and of the trajectories that are summarised.
        episodes: Real episodes per round.
        updates: Learner updates per round from batches drawn under the new posterior.
        shared_batches: How many of the batches simulated for inference also feed the learner.
        prior_share: Probability of a prior draw while training, so that an overconfident posterior
            cannot starve it.
        rounds: Rounds planned.
        seed: Same seed, same rounds.
        checkpoint_file: Written after every step of the loop; :meth:`resume` goes on from it.
        checkpoint_every: Updates between two checkpoints. Episodes begin anew after each.
        collectors: On Ray, to simulate there with as many environments as ``env`` has, which then
            only tells what is simulated. The caller shuts them down.
        progress: Whether to show progress bars; those of fits as ``fit_options`` say, if they do.

    Raises:
        TypeError: For a count that is no whole number, or a part that is of another kind.
        ValueError: For a count that is too small, a ``prior_share`` that is no probability, or
            statistics of what the simulator or the logs do not have; in a round, for a robot whose
            answer lacks what they read or has other sizes than the simulator's, and for episodes
            that are cut earlier on one side than on the other.

    Example::

        loop = SimToRealLoop(env, ppo, robot, refinement=PosteriorRefinement(prior),
                             statistics=statistics, randomizer=randomizer, rounds=3)
        for turn in loop:
            print(turn.index, turn.posterior.mean, turn.posterior.stddev)
    """

    def __init__(
        self,
        env: EnvBase,
        learner: Learner,
        robot: RealSystem,
        *,
        refinement: PosteriorRefinement,
        statistics: SummaryStatistics,
        randomizer: DomainRandomizer,
        horizon: int = 128,
        episodes: int = 8,
        updates: int = 16,
        shared_batches: int = 4,
        prior_share: float = 0.1,
        rounds: int = 3,
        seed: int = 0,
        checkpoint_file: str | Path | None = None,
        checkpoint_every: int = 8,
        collectors: RayCollectors | None = None,
        progress: bool = True,
    ) -> None:
        check_parts(env, statistics, randomizer)
        check_kind("a PosteriorRefinement", refinement, PosteriorRefinement)
        for role, owner, method in ("learner", learner, "update"), ("robot", robot, "rollouts"):
            check_function(f"a {role} with {method}()", getattr(owner, method, None))
        hint = "recorded = False for a robot that answers anew, RecordedLogs(logs) otherwise"
        check_kind("a robot with recorded=", getattr(robot, "recorded", None), bool, hint=hint)
        policy = getattr(learner, "policy", None)
        check_kind("a learner with a policy, a TensorDictModule", policy, TensorDictModuleBase)
        self.settings: dict[str, Any] = {
            "horizon": horizon,
            "episodes": episodes,
            "rounds": rounds,
            "checkpoint_every": checkpoint_every,
            "environments": max(1, env.batch_size.numel()),
        }
        for name, value in self.settings.items():
            check_count(name, value)
        for name, value in {"updates": updates, "shared_batches": shared_batches}.items():
            check_count(name, value, least=0)
        check_prior_share(prior_share)
        self.settings |= {
            "updates": updates,
            "shared_batches": shared_batches,
            "prior_share": prior_share,
            "seed": seed,
            "statistics": repr(statistics),
        }
        if collectors is not None:  # whose noise depends on their number
            self.settings["workers"] = collectors.workers
        for part, owner in {"refinement": refinement, "learner": learner, "robot": robot}.items():
            settings: dict[str, Any] = getattr(owner, "settings", {})
            self.settings |= {f"{part}.{name}": value for name, value in settings.items()}
        self.learner, self.robot = learner, robot
        self._overlapped = Overlapped(learner)
        self.refinement, self.statistics, self.randomizer = refinement, statistics, randomizer
        self.horizon, self.episodes, self.rounds = horizon, episodes, rounds
        self.updates, self.shared_batches = updates, shared_batches
        self.prior_share, self.seed, self.progress = prior_share, seed, progress
        self.checkpoint_file = None if checkpoint_file is None else Path(checkpoint_file)
        self.checkpoint_every = checkpoint_every
        self._state: dict[str, Any] = {"round": 0, "frames": 0, "evidence": []} | _FRESH
        self._simulator = EvidenceSimulator(
            env,
            learner.policy,
            statistics,
            randomizer,
            horizon=horizon,
            keep=max(1, shared_batches),  # one is looked at
            collectors=collectors,
            progress=progress,
        )
        self._columns = simulated_columns(env, statistics, replayed=robot.recorded)
        if isinstance(robot, RecordedLogs):
            self._check(robot.trajectories)

    @property
    def planned_frames(self) -> int:
        """Environment frames that the learner will have seen after all rounds."""
        rows = self.settings["environments"]
        shared = 0
        if not self.robot.recorded:
            simulated = -(-self.refinement.simulations * self.episodes // rows)
            shared = min(self.shared_batches, simulated)
        return self.rounds * (shared + self.updates) * rows * self.horizon

    def __iter__(self) -> Iterator[Round]:
        """Yield the rounds that are left."""
        try:
            while self._state["round"] < self.rounds:
                yield self._turn()
                # only now: a run that is killed while the caller works yields the round again
                self._state |= {"round": self._state["round"] + 1} | _FRESH
                self._keep()
        finally:
            self._simulator.close()

    # One round, in steps after each of which the state is kept.

    def _turn(self) -> Round:
        if self._state["real"] is None:
            self._step(self._measure)
        if self._state["fit"] is None:
            self._step(self._infer)
        state: dict[str, Any] = self._state
        posterior = self.refinement.posterior
        assert posterior is not None  # _infer has refined it
        self.randomizer.source = Defensive(posterior, self.refinement.prior, self.prior_share)
        while state["update"] < self.updates:
            self._step(self._train)
        return Round(
            index=state["round"],
            posterior=posterior,
            real=_unflatten(state["real"]),
            fit=FitReport(**state["fit"]),
            simulations=state["fit"]["pairs"],
            frames=state["frames"],
            curve=list(state["curve"]),
            seconds=state["seconds"],
        )

    def _step(self, work: Callable[[], None]) -> None:
        start = time.monotonic()
        work()
        self._state["seconds"] += time.monotonic() - start
        self._keep()

    def _measure(self) -> None:
        """Ask the robot; a step of its own, because a robot's time is worth keeping."""
        state, policy = self._state, self.learner.policy
        key = (self.seed, "round", state["round"])
        real = self.robot.rollouts(policy, episodes=self.episodes, key=key)
        self._check(real)
        if not self.robot.recorded:
            real = comparable(real, horizon=self.horizon)
        evidence: list[Evidence] = [] if self.robot.recorded else state["evidence"]
        new: Evidence = {
            "policy": dict(copy.deepcopy(policy).state_dict()),
            "episodes": len(real),
            "summary": self.statistics.together(real).cpu(),  # where a checkpoint has it
        }
        kept = real.select(*self.statistics.in_keys, "mask", ("next", "reward"), strict=False)
        state |= {"evidence": [*evidence, new], "real": _flatten(kept)}

    def _check(self, real: TensorDictBase) -> None:
        """Refuse what the statistics cannot read, or what has other sizes than in the simulator."""
        read = self.statistics.in_keys
        check_real(real, read[:3] if self.robot.recorded else read)
        check_columns(real, self._columns)

    def _infer(self) -> None:
        state, key = self._state, (self.seed, "round", self._state["round"])
        evidence = state["evidence"]
        shared: list[TensorDictBase] = []

        def simulate(theta: Tensor) -> Tensor:
            real = _unflatten(state["real"])
            if self.robot.recorded:
                summary, batches = self._simulator.replay(real, theta, key=(*key, "evidence", 0))
            else:
                summary, batches = self._simulator.policies(evidence, theta, key=(*key, "evidence"))
                shared.extend(batches[: self.shared_batches])
            check_cut(batches[0], real)
            return summary

        observed = torch.cat([entry["summary"] for entry in evidence], -1)
        report = self.refinement.refine(simulate, observed, key=key, progress=self.progress)
        state["fit"] = dataclasses.asdict(report)
        if shared:  # collected with this very policy: the learner's first update of the round
            self._update(concatenate(shared))
            self._overlapped.finish()

    def _train(self) -> None:
        state = self._state
        first = state["update"]
        last = min(first + self.checkpoint_every, self.updates)
        key = (self.seed, "round", state["round"], "train", first)
        self._simulator.begin(key)
        label = f"round {state['round'] + 1} of {self.rounds}: train"
        for update in tqdm(range(first, last), desc=label, disable=not self.progress, leave=False):
            meanwhile = self._overlapped.meanwhile
            self._update(self._simulator.batch((*key, update), meanwhile=meanwhile))
        self._overlapped.finish()
        state["update"] = last

    def _update(self, batch: TensorDictBase) -> None:
        state = self._state
        planned = self.rounds * (self.updates + 1)
        done = state["round"] * (self.updates + 1) + len(state["curve"])
        key = (self.seed, "round", state["round"], "update", len(state["curve"]))
        seen = [*self.learner.policy.in_keys, "reward"]
        usable, dropped = finite_rows(batch, [*seen, *map(next_key, seen)])
        entry = {"frames": float(state["frames"] + batch.numel()), "return": ended_return(usable)}
        self._overlapped.update(usable, into=entry, key=key, progress=done / planned)
        state["frames"] += batch.numel()
        if dropped:
            entry["dropped"] = float(dropped)
        state["curve"] = [*state["curve"], entry]

    # Keeping work.

    def state_dict(self) -> dict[str, Any]:
        """Return everything the rest of the run depends on: tensors and plain values."""
        return {
            "loop": dict(self._state),
            "learner": self.learner.state_dict(),
            "refinement": self.refinement.state_dict(),
            "randomizer": self.randomizer.get_extra_state(),
            "settings": self.settings,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a state, to the numbers of the unbroken run.

        Raises:
            TypeError: It is no mapping.
            ValueError: If the state was made with other settings, or is not a loop's.
        """
        check_kind("the state of a loop", state, Mapping)
        state = dict(state)
        missing = [name for name in _STATE if name not in state]
        if missing:
            expected = "the state of a loop, with an entry"
            raise ValueError(message(expected, f"none {missing[0]!r}", available=state))
        for name, value in self.settings.items():
            if state["settings"].get(name) != value:
                raise ValueError(
                    message(
                        f"a checkpoint made with {name}={value!r}",
                        state["settings"].get(name),
                        hint="the settings of the run that wrote it, or a new run",
                    )
                )
        self._state, self._overlapped = dict(state["loop"]), Overlapped(self.learner)
        self.learner.load_state_dict(state["learner"])
        self.refinement.load_state_dict(state["refinement"])
        self.randomizer.set_extra_state(dict(state["randomizer"]))

    def resume(self) -> bool:
        """Load ``checkpoint_file`` if it exists; return whether it did."""
        if self.checkpoint_file is None or not self.checkpoint_file.exists():
            return False
        self.load_state_dict(checkpoint.load(self.checkpoint_file))
        return True

    def _keep(self) -> None:
        if self.checkpoint_file is not None:
            checkpoint.save(self.checkpoint_file, self.state_dict())


_STATE = "loop", "learner", "refinement", "randomizer", "settings"  # what a checkpoint holds
_FRESH: dict[str, Any] = {"real": None, "fit": None, "update": 0, "curve": [], "seconds": 0.0}


def ended_return(batch: TensorDictBase) -> float:
    """Return the mean return of the episodes that ended in a batch with ``RewardSum``'s entry."""
    total = batch.get(("next", "episode_reward"), None)
    if total is None:
        return float("nan")
    ended = total[batch.get(("next", "done"))]
    return ended.mean().item() if ended.numel() else float("nan")


def _flatten(trajectories: TensorDictBase) -> dict[str, Tensor]:
    flat = trajectories.flatten_keys(".")
    return {str(name): value.contiguous() for name, value in flat.items()}


def _unflatten(entries: Mapping[str, Tensor]) -> TensorDictBase:
    return TensorDict(dict(entries), batch_size=entries["mask"].shape).unflatten_keys(".")
