"""The transform in the collector's process, which draws parameters at every reset."""

from __future__ import annotations

__all__ = ["DomainRandomizer", "randomizers"]

from collections.abc import Iterator
from typing import Any, Self
from weakref import ref

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform

from ..counts import check_count
from ..episode_draws import EpisodeDraws
from ..errors import PhysicsError, message
from ..kinds import check_key, check_keys, real_numbers
from ..remote_source import PolicyWithSource
from ..sources import Empirical, Grid, Source, names_of
from .resets import resets, simulator, transforms_of
from .workers import first_of_worker, in_worker, note_seeds


class DomainRandomizer(Transform):
    """Draws θ at every reset, for the environments that reset and for no others.

    What episode ``e`` of environment ``i`` draws depends on ``(seed, key, i, e)`` alone: not on the
    process that runs it nor on when it finishes. Clones share the source and the pin, so that both
    reach an environment that TorchRL has unwrapped; give another environment its own randomizer.

    It belongs around a ``SerialEnv`` or ``ParallelEnv``, where an assigned source reaches all
    environments. Inside one, each worker has a randomizer of its own, which the worker's seed tells
    from the others: call ``set_seed`` of the batched environment before its first reset.

    Args:
        source: Where to draw from: a prior, a posterior, a `Grid`, anything that samples.
        key: The entry that holds θ; the one of `ApplyPhysics`.
        names: The parameters' names; the source's own if it has some.
        seed: Another seed, other draws.
        first_environment: The global number of the first environment here. By default the
            collector's worker number times the number of environments, or 0; give it where the
            workers of a collector have different numbers of environments.
        pool: Restrict to this many draws, made once (the BayesSim paper's 100 domains). A `Grid`
            that is assigned later, as inference does, is followed as it is.

    Raises:
        PhysicsError: No `ApplyPhysics` before it writes ``key``, or for other parameters; another
            randomizer of ``key``; at a reset, workers of a batched environment that nothing tells
            apart.
        TypeError: The source, now or when assigned, cannot be sampled; a count is no whole number,
            a name no string.
        ValueError: ``pool`` is not positive, or is given with a `Grid`; the source is over other
            parameters.

    Example:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> half_to_two = torch.distributions.Uniform(torch.full((2,), 0.5), torch.full((2,), 2.0))
        >>> randomizer = DomainRandomizer(half_to_two, names=("m", "l"))
        >>> physics = ApplyPhysics(AttributePhysics("m", "l"))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(physics, randomizer))
        >>> bool((env.reset()["theta"] != env.reset()["theta"]).all())
        True
        >>> randomizer.pin([1.0, 1.5])
        >>> env.reset()["theta"]
        tensor([1.0000, 1.5000])
    """

    def __init__(
        self,
        source: Source | Grid,
        *,
        key: NestedKey = "theta",
        names: tuple[str, ...] | None = None,
        seed: int = 0,
        first_environment: int | None = None,
        pool: int | None = None,
    ) -> None:
        super().__init__()
        check_key("key", key)
        if names is not None:
            check_keys("names", names)
            names = tuple(names)
        if first_environment is not None:
            check_count("first_environment", first_environment, least=0)
        if pool is not None and isinstance(source, Grid):
            raise ValueError(message("a source that samples, to draw a pool from", "a Grid"))
        self.key, self.first_environment, self.pool = key, first_environment, pool
        # Shared with clones, of which TorchRL makes one when it unwraps nested environments.
        self._shared: dict[str, Any] = {"names": names, "seed": seed, "pinned": None}
        self.source = source
        self._episodes = torch.zeros(0, dtype=torch.int64)  # begun so far, per environment
        self._theta = torch.zeros(0, 0)  # of the running episodes
        self._checked = False
        self._pushed: tuple[int, Tensor] | None = None
        self._clone_of: ref[BaseCollector] | None = None

    @property
    def source(self) -> Source | Grid:
        """Where θ comes from; an assignment takes effect from the next resets on."""
        return self._shared["source"]

    @source.setter
    def source(self, source: Source | Grid) -> None:
        names, known = names_of(source), self._shared["names"]
        if None not in (names, known) and names != known:
            raise ValueError(message(f"a source over {known}", names))
        pool = None if isinstance(source, Grid) else self.pool  # which is for what samples
        draws = EpisodeDraws(source, seed=self._shared["seed"], pool=pool, entry=self.key)
        self._shared |= {"source": source, "draws": draws, "names": known or names}

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; a source that is a module (a flow) is a source, and no part of this."""
        if name == "source":
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    @property
    def names(self) -> tuple[str, ...] | None:
        """The parameters' names, in the order of the columns of θ, if known."""
        return self._shared["names"]

    @property
    def units(self) -> tuple[str, ...] | None:
        """Their units, as the source says; None if it does not."""
        return getattr(self.source, "units", None)

    def pin(self, theta: Any) -> None:
        """Give every environment this θ, of shape ``(D,)`` or ``(*batch, D)``, until `unpin`.

        Episodes meanwhile do not count: after `unpin`, draws go on where they stopped.

        Raises:
            TypeError: θ is not a tensor nor numbers.
            ValueError: θ is not finite, or of another length; at a reset, of another batch.
        """
        expected = "numbers to pin, one for each parameter"
        theta = real_numbers(expected, theta, torch.float32).cpu()
        columns = theta.shape[-1:] if self.names is None else (len(self.names),)
        if (
            not theta.ndim
            or theta.shape[-1:] != columns
            or not len(theta)
            or not theta.isfinite().all()
        ):
            expected = f"{expected} of {self.names}" if self.names else expected
            raise ValueError(message(f"finite {expected}", theta.tolist()))
        self._shared["pinned"] = theta

    @property
    def pinned(self) -> Tensor | None:
        """The θ of `pin`, None if draws are on."""
        return self._shared["pinned"]

    def unpin(self) -> None:
        """Draw again from the next resets on."""
        self._shared["pinned"] = None

    def clone(self) -> Self:
        """Return a copy with episodes of its own, and the same source and pin."""
        copy = super().clone()
        copy._episodes, copy._theta = self._episodes.clone(), self._theta.clone()
        if self.collector is not None:
            copy._clone_of = ref(self.collector)
        return copy

    def drives(self, env: EnvBase | None) -> bool:
        """Return whether this randomizer, or a clone, is among the transforms of ``env``."""
        return any(other._shared is self._shared for other in randomizers(env))

    @property
    def collector(self) -> BaseCollector | None:
        """The collector that steps the environment, if there is one.

        Under ``max_frames_per_traj``, collectors register themselves with the environment and then
        replace it by one with clones of its transforms: those remember where they come from.
        """
        try:
            container = self.container
        except ValueError:  # in a Compose that has no environment yet
            container = None
        known = None if container is None else container.collector
        return self._clone_of() if known is None and self._clone_of is not None else known

    def set_container(self, container: Transform | EnvBase) -> None:
        """Check that an `ApplyPhysics` comes before."""
        super().set_container(container)
        if self.parent is None:  # in a Compose that has no environment yet
            return
        spec = self.parent.full_state_spec.get(self.key, None)
        if spec is None:
            raise PhysicsError(
                message(
                    f"an ApplyPhysics that writes {self.key!r} before the DomainRandomizer",
                    "none",
                    hint="Compose(ApplyPhysics(physics), DomainRandomizer(source)) in that order, "
                    "or ApplyPhysics inside the function that makes each environment",
                )
            )
        self._check_alone()
        if self.names is not None and len(self.names) != spec.shape[-1]:
            raise PhysicsError(
                message(f"{spec.shape[-1]} parameters, as ApplyPhysics has", self.names)
            )
        note_seeds(simulator(self.parent))
        self._check_names()

    def _check_alone(self) -> None:
        """Refuse a second randomizer of the same entry, of which one would be ignored."""
        others = (r for r in randomizers(self.parent) if r._shared is not self._shared)
        if any(other.key == self.key for other in others):
            expected = f"one DomainRandomizer of {self.key!r}"
            hint = "assign to the source of the one that is there, or pin it"
            raise PhysicsError(message(expected, "two", hint=hint))

    def _check_names(self) -> None:
        """Compare names with those beside the simulators, once the simulators exist."""
        env = simulator(self.parent)
        if self._checked or (isinstance(env, SerialEnv | ParallelEnv) and env.is_closed):
            return
        found = getattr(env, "physics_names", dict)()
        for known in _each(found):
            if self.names is not None and known.get(self.key, self.names) != self.names:
                raise PhysicsError(
                    message(
                        f"a source over {known[self.key]}, as ApplyPhysics has",
                        self.names,
                        hint="name the parameters alike, in the same order, in both",
                    )
                )
        self._checked = True

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        parent: Any = self.parent
        if tensordict is None:
            tensordict = TensorDict(batch_size=parent.batch_size, device=parent.device)
        batch = tensordict.batch_size
        shape = (*batch, parent.full_state_spec[self.key].shape[-1])
        if len(self._theta) != batch.numel():
            self._theta = torch.zeros(batch.numel(), shape[-1], dtype=torch.float32)
        if len(self._episodes) < batch.numel():
            more = torch.zeros(batch.numel() - len(self._episodes), dtype=torch.int64)
            self._episodes = torch.cat([self._episodes, more])
        rows = resets(self.parent, tensordict).flatten().nonzero().flatten()
        if len(rows):
            # Never "keep what the tensordict has": a running tensordict holds the last episode's.
            self._theta[rows] = self._draw(rows, shape)
        return tensordict.set(
            self.key, self._theta.reshape(shape).to(parent.device or "cpu", copy=True)
        )

    def _draw(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        pinned = self.pinned
        if pinned is not None:
            if pinned.shape not in (shape, shape[-1:]):
                raise ValueError(
                    message(f"pinned θ of shape {shape[-1:]} or {shape}", pinned.shape)
                )
            return pinned.expand(shape).reshape(-1, shape[-1])[rows]
        self._receive()
        theta = self._shared["draws"](self._first() + rows, self._episodes[rows])
        if theta.shape[-1] != shape[-1]:
            raise ValueError(message(f"a source of {shape[-1]} parameters", theta.shape[-1]))
        return theta

    def _first(self) -> int:
        """Return the global number of the first environment here."""
        if self.first_environment is not None:
            return self.first_environment
        collector = self.collector
        if collector is not None or not in_worker():
            worker = None if collector is None else collector.worker_idx
            return (worker or 0) * len(self._theta)
        return first_of_worker(simulator(self.parent), numbered=isinstance(self.source, Grid))

    def _receive(self) -> None:
        """Take over a table that `push_source` has sent since the last reset."""
        carrier = PolicyWithSource.inside(getattr(self.collector, "policy", None))
        if carrier is None:
            return
        # the count tells a table that is pushed again; the table, one that was still on its way
        count, draws = int(carrier.pushes), carrier.draws.detach().cpu()
        known = self._pushed
        unchanged = known is not None and known[0] == count and torch.equal(draws, known[1])
        if draws.isfinite().all() and not unchanged:
            self._pushed = (count, draws.clone())
            self.source = Empirical(draws.clone(), names=carrier.names)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_names()
        mask = resets(self.parent, tensordict)
        drawn, held = tensordict[self.key][mask], tensordict_reset[self.key][mask]
        if not torch.allclose(drawn, held, rtol=1e-6, atol=1e-12):
            raise PhysicsError(
                message(
                    f"the simulators to hold what was drawn, {drawn.tolist()}",
                    held.tolist(),
                    hint=f"is {self.key!r} written by a transform between the randomizer and "
                    "ApplyPhysics?",
                )
            )
        if self.pinned is None:
            self._episodes[: mask.numel()] += mask.flatten().cpu()
        return tensordict_reset

    def get_extra_state(self) -> dict[str, Any]:
        """Return the seed and how many episodes each environment has begun."""
        return {"seed": self._shared["seed"], "episodes": self._episodes.clone()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on where a checkpoint stopped; the source is not part of it."""
        self._shared["seed"], self._episodes = state["seed"], state["episodes"].clone()
        self.source = self.source

    def __repr__(self) -> str:
        options = f"names={self.names}, units={self.units}, key={self.key!r}"
        return f"DomainRandomizer({type(self.source).__name__}, {options})"


def randomizers(env: EnvBase | None) -> Iterator[DomainRandomizer]:
    """Yield the randomizers among the transforms of an environment, and of those that it wraps."""
    yield from transforms_of(env, DomainRandomizer)


def _each(found: Any) -> Iterator[dict[Any, Any]]:
    """Yield what each simulator answered; batches of batches answer in lists of lists."""
    if not isinstance(found, list):
        yield found
        return
    for one in found:
        yield from _each(one)
