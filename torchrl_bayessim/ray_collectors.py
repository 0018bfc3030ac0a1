"""Collectors on Ray: simulations on other cores and machines, through TorchRL's `RayCollector`.

A worker that dies is begun anew by Ray and asked again, with the same answer.

For inference, a worker simulates whole batches, each under its own key, as one process does, and
sends their summaries: the pairs are those of one process, whichever worker simulates which batch.
For training, each steps its share of the environments. θ is drawn by an environment's number among
all of them, as in one process; actions and initial states have noise of their own.
"""

from __future__ import annotations

__all__ = ["RayCollectors"]

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.util import find_spec
from typing import Any, Self
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from .counts import check_count
from .diverged import UndisturbedPolicy
from .errors import SimulationError, message
from .kinds import check_function, check_kind
from .pairs import counted
from .ray_probe import difference, probed, probing
from .ray_waiting import Waiting
from .ray_worker import Block, Inference, RayWorker, described
from .scalars import check_number
from .summaries import SummaryStatistics
from .trajectories import concatenate, first_trajectories
from .transforms.domain_randomizer import DomainRandomizer

_CLUSTER = {"include_dashboard": False, "logging_level": "warning"}
_WORKER = {"num_cpus": 1, "max_restarts": 10, "max_task_retries": 10}
_MOST = 100_000_000  # frames of a training batch, which is held in memory


class RayCollectors:
    """W workers on Ray that simulate for inference, and collect for a learner.

    Without a running cluster one is begun on this machine; ``RAY_ADDRESS``, or ``ray.init`` before,
    chooses another. The package, and what ``make`` needs, must be installed on its machines.

    Args:
        make: Number of environments to an environment of that batch size, with `ApplyPhysics` and
            a `DomainRandomizer` among its transforms: the one of this process, too.
        policy: The learner's; its weights are sent before every batch.
        environments: Number N of environments; every worker holds N for inference, and N / W for
            training.
        steps: Steps T of a training batch ``[N, T]``.
        workers: Their number W.
        cluster: Options of ``ray.init``, for a cluster that is begun here.
        worker: Options of ``ray.remote``, such as ``{"num_cpus": 1}``: what a worker needs. After
            ``max_restarts`` deaths of a worker, or ``max_task_retries`` in one question, it fails.
        timeout: Seconds after which a worker that has not answered a question (a share of the
            pairs, or a training batch) counts as dead: it is ended, begun anew and asked again.
            ``None``: never. The first start of the workers must not take longer either; a later
            one is not counted, up to twice the time of the first.

    Raises:
        ImportError: Ray is not installed.
        TypeError: A number is no whole number, ``make`` no function, the policy none or options
            no mapping.
        ValueError: A number is not positive, W does not divide N, N T is beyond 10⁸, Ray does not
            know an option, the cluster has too few processors, or an environment has no randomizer.
        SimulationError: A worker cannot begin, or not within ``timeout``; in a call: one died or
            was ended too often, or Ray's own process on this machine died. What a worker raises is
            raised here.

    Example::

        with RayCollectors(make, ppo.policy, environments=128, steps=128, workers=4) as collectors:
            pairs = simulate(env, policy, statistics, randomizer, collectors=collectors, ...)
            loop = SimToRealLoop(env, ppo, robot, collectors=collectors, ...)
    """

    _ended = False

    def __init__(
        self,
        make: Callable[[int], EnvBase],
        policy: TensorDictModuleBase,
        *,
        environments: int,
        steps: int,
        workers: int = 2,
        cluster: dict[str, Any] | None = None,
        worker: dict[str, Any] | None = None,
        timeout: float | None = 3600.0,
    ) -> None:
        if find_spec("ray") is None:
            hint = 'pip install "torchrl_bayessim[ray]"'
            raise ImportError(message("the package ray", "none", hint=hint))
        for name, value in {"environments": environments, "steps": steps}.items():
            check_count(name, value)
        check_count("workers", workers)
        check_function("make, a function of the number of environments", make)
        check_kind("a policy, a TensorDictModule", policy, TensorDictModuleBase)
        if environments % workers:
            expected = f"a number of workers that divides the {environments} environments"
            raise ValueError(message(expected, workers))
        if environments * steps > _MOST:
            expected = f"batches of at most {_MOST} frames, environments times steps"
            raise ValueError(message(expected, environments * steps))
        for name, options in {"cluster": cluster, "worker": worker}.items():
            if options is not None:
                check_kind(f"{name}= to be a mapping of Ray's options", options, Mapping)
        needs = _WORKER | dict(worker or {})
        for name in _WORKER:
            check_number(
                f"worker[{name!r}]", needs[name], least=-1.0 if name != "num_cpus" else 0.0
            )
        if timeout is not None:
            check_number("timeout", timeout, above=0.0)
        self.environments, self.steps, self.workers = environments, steps, workers
        self._alike: WeakKeyDictionary[EnvBase, int] = WeakKeyDictionary()
        self._block: tuple[Any, DomainRandomizer] | None = None
        self._there: dict[str, str] | None = None  # what the workers' environments are
        self._own = not self._ray.is_initialized()
        if self._own:
            self._init(cluster or {})
        with ExitStack() as undo:
            undo.callback(self._end_cluster)
            self._check_processors(needs["num_cpus"])
            self._waiting = Waiting(self._ray, timeout)
            self._collector = self._begun(make, policy, needs)
            undo.pop_all()

    def _init(self, cluster: Mapping[str, Any]) -> None:
        try:
            self._ray.init(**{**_CLUSTER, **cluster})
        except (TypeError, ValueError, RuntimeError) as error:
            got = f"{sorted(cluster)}: {str(error).splitlines()[0]}"
            raise ValueError(message("cluster= to be options of ray.init", got)) from error

    def _begun(self, make: Callable[[int], EnvBase], policy: Any, needs: dict[str, Any]) -> Any:
        """Return TorchRL's collector of the workers."""
        from torchrl.collectors.distributed import RayCollector

        waiting = self._waiting

        class Begun(RayCollector):
            """TorchRL's, which waits without end for workers to begin, after those that do."""

            def add_collectors(self, *given: Any, **named: Any) -> None:
                super().add_collectors(*given, **named)
                waiting.begun(self.remote_collectors)

        options = {
            "whole": partial(make, self.environments),
            "auto_register_policy_transforms": False,
        }
        with self._errors():
            return Begun(
                [partial(make, self.environments // self.workers)] * self.workers,
                UndisturbedPolicy(policy),
                collector_class=RayWorker,  # pyright: ignore[reportArgumentType]
                collector_kwargs=[dict(options) for _ in range(self.workers)],
                frames_per_batch=self.environments * self.steps,
                sync=True,
                remote_configs=needs,
                weight_sync_schemes={},  # a worker begun anew needs them with the question
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()

    def shutdown(self) -> None:
        """End the workers, and the cluster if it was begun here."""
        self._ended = True
        self._collector.shutdown()
        self._end_cluster()

    def _end_cluster(self) -> None:
        if self._own:
            self._ray.shutdown()

    def summaries_in_turn(
        self,
        policy: TensorDictModuleBase | None,
        statistics: SummaryStatistics,
        theta: Tensor,
        *,
        steps: int,
        trajectories: int = 1,
        key: tuple[int | str, ...],
        prepare: Callable[[TensorDictBase], TensorDictBase] = first_trajectories,
        keep: int = 0,
    ) -> Iterator[tuple[Tensor, list[TensorDictBase]]]:
        """Yield the summaries of simulations at ``theta``, in order, ``(n, L)``, and kept batches.

        They are those of :func:`.simulate.collect_summaries` in one process.

        Raises:
            TypeError: A count is no whole number, or θ no tensor.
            ValueError: A count is too small, or there is no θ.

        Args:
            policy: That made the real data; ``None`` for uniformly random actions.
            statistics: Summaries.
            theta: Parameters to simulate, shape ``(N, D)``.
            steps: Steps of a trajectory.
            trajectories: Number of trajectories per pair.
            key: What the simulations are for.
            prepare: Gives a batch its ``"mask"``.
            keep: Number of batches to send back too.
        """
        for name, value in {"steps": steps, "trajectories": trajectories}.items():
            check_count(name, value)
        check_count("batches to keep", keep, least=0)
        check_kind("parameters theta, a tensor (N, D)", theta, Tensor)
        if theta.ndim != 2 or not len(theta):
            expected = "parameters theta of shape (N, D), at least one row"
            raise ValueError(message(expected, tuple(theta.shape)))
        asked = Inference(policy, statistics, trajectories, steps, key, prepare)
        question = self._waiting.put(asked)
        batches = trajectories // math.gcd(self.environments, trajectories)  # end with a pair
        pairs = batches * self.environments // trajectories
        shares = range(0, len(theta), pairs)
        for turn in range(0, len(shares), self.workers):
            asking = [
                (question, theta[start : start + pairs].clone(), batches * number, keep)
                for number, start in enumerate(shares[turn : turn + self.workers], turn)
            ]
            idle = [(None, theta[:0], 0, 0)] * (self.workers - len(asking))
            yield from self._ask("summarise", asking + idle)[: len(asking)]

    def summaries(
        self,
        policy: TensorDictModuleBase | None,
        statistics: SummaryStatistics,
        theta: Tensor,
        *,
        progress: bool = True,
        **asked: Any,
    ) -> tuple[Tensor, list[TensorDictBase]]:
        """Return all of :meth:`summaries_in_turn` together, ``(N, L)``, and all kept batches."""
        turns = self.summaries_in_turn(policy, statistics, theta, **asked)
        found, batches = [], []
        for summaries, kept in counted(turns, len(theta), progress=progress):
            found.append(summaries)
            batches += kept
        return torch.cat(found), batches

    def check(
        self, env: EnvBase, *, steps: int | None = None, trajectory: int | None = None
    ) -> None:
        """Refuse an environment that does not simulate what those on Ray do, to the last bit.

        Size, physics and entries are compared by name, then a batch of random actions that is
        simulated on either side, once for each environment.

        Args:
            env: Of this process.
            steps: Of its training batches; default T.
            trajectory: Steps of the batch that is compared; default T.

        Raises:
            TypeError: It is no environment.
            ValueError: Pairs and batches would not be those of this environment.
        """
        check_kind("a TorchRL environment", env, EnvBase)
        got = (max(1, env.batch_size.numel()), steps or self.steps)
        if got != (self.environments, self.steps):
            expected = f"{self.environments} environments of {self.steps} steps, as on Ray"
            raise ValueError(message(expected, f"{got[0]} of {got[1]}"))
        here, there = described(env), self._there or {}
        if not there:
            there = self._there = self._ask("described", [()] * self.workers)[0]
        for name in sorted(here.keys() | there.keys()):
            asked, made = here.get(name, "nothing"), there.get(name, "nothing")
            if asked != made:
                expected = f"an environment as make() gives on Ray, with {name}: {made}"
                raise ValueError(message(expected, asked, hint="one make() for both"))
        self._compare(env, max(trajectory or 0, self.steps))

    def _compare(self, env: EnvBase, steps: int) -> None:
        """Compare a batch that is simulated here with the same of a worker."""
        if self._alike.get(env, 0) >= steps:
            return
        question, theta = probing(env, steps)
        nothing = (None, theta[:0], 0, 0)
        asked = [(question, theta, 0, 1), *[nothing] * (self.workers - 1)]
        (_, (there,)), *_ = self._ask("summarise", asked)
        if other := difference(probed(env, question, theta), there):
            expected = "an environment that simulates what make() does on Ray, bit for bit"
            hint = "one make() for both, with the same transforms and physics"
            raise ValueError(message(expected, other, hint=hint))
        self._alike[env] = steps

    def begin(self, randomizer: DomainRandomizer, *, key: tuple[int | str, ...]) -> None:
        """Begin new episodes, with θ from the randomizer's source, for the batches that follow.

        The randomizer counts the episodes, as it does for environments of this process.

        Raises:
            TypeError: It is no randomizer.
        """
        check_kind("a DomainRandomizer", randomizer, DomainRandomizer)
        state = randomizer.get_extra_state()
        episodes = torch.zeros(self.environments, dtype=torch.int64)
        known = state["episodes"][: self.environments]
        episodes[: len(known)] = known
        block = Block(randomizer.source, state["seed"], episodes, key)
        self._block, self._weights = (self._waiting.put(block), randomizer), []

    def batch(self, policy: TensorDictModuleBase) -> TensorDictBase:
        """Return the next batch ``[N, T]``, collected with the policy as it is now.

        Raises:
            RuntimeError: Nothing has begun.
            TypeError: The policy is none.
        """
        check_kind("a policy, a TensorDictModule", policy, TensorDictModuleBase)
        if self._block is None:
            raise RuntimeError(message("begin() before the first batch", "none"))
        block, randomizer = self._block
        self._weights.append(self._waiting.put(dict(policy.state_dict())))
        answers = self._ask("collect", [(block, list(self._weights))] * self.workers)
        episodes = torch.cat([counted for _, counted in answers])
        randomizer.set_extra_state({**randomizer.get_extra_state(), "episodes": episodes})
        return concatenate([batch for batch, _ in answers])

    @property
    def _ray(self) -> Any:
        import ray  # pyright: ignore[reportMissingImports]

        return ray

    def _check_processors(self, each: float) -> None:
        """Refuse a cluster on which workers would wait for ever."""
        there = self._ray.cluster_resources().get("CPU", 0)
        if each * self.workers > there:
            expected = f"a cluster with {each * self.workers:g} processors for the workers"
            hint = "fewer workers, or RAY_ADDRESS of a larger cluster"
            raise ValueError(message(expected, f"{there:g}", hint=hint))

    def _ask(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return every worker's answer; Ray begins those anew that die, and asks them again."""
        if self._ended:
            got = "collectors that were shut down"
            raise RuntimeError(message("collectors with workers", got, hint="begin new ones"))
        with self._errors():
            workers = self._collector.remote_collectors
            answers = [
                worker.cascade_execute.remote(method, *given)
                for worker, given in zip(workers, arguments, strict=True)
            ]
            return self._waiting.answers(dict(zip(answers, workers, strict=True)))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Raise what a worker raises, and say of one that has ended why."""
        errors = self._ray.exceptions
        try:
            yield
        except errors.RayTaskError as error:
            raise error.cause from error
        except errors.UnserializableException as error:
            lines = str(error).strip().splitlines()
            hint = "an exception that copy.copy can copy; the whole story is above"
            raise SimulationError(
                message("workers without errors", lines[-1], hint=hint)
            ) from error
        except errors.RayActorError as error:
            lines, ended = str(error).strip().splitlines(), self._waiting.ended
            slow = f" ({ended} were ended: no answer within timeout={self._waiting.timeout})"
            raise SimulationError(
                message(
                    "workers that begin and live",
                    f"{lines[0]} {lines[-1]}" + slow * bool(ended),
                    hint="is what make() needs installed there, and memory enough? Does a "
                    "simulator crash?",
                )
            ) from error
