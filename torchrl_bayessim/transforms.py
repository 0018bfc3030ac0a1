"""Domain randomisation in two transforms: one draws parameters, one writes them.

`ApplyPhysics` sits beside the simulator, in the function that makes each environment, and holds
the simulator to the θ that the reset brings. `DomainRandomizer` sits in the collector's process,
outside the batched environment, and draws::

    def make():
        return TransformedEnv(GymEnv("CartPole-v1"), ApplyPhysics(AttributePhysics("length")))

    randomizer = DomainRandomizer(prior)
    env = TransformedEnv(ParallelEnv(8, make), randomizer)
    randomizer.source = posterior          # from the next resets on

θ is an entry of the tensordict, ``"theta"`` unless another ``key`` is given: float32, shape
``(*batch, D)``, in the parameters' own units, in the order of ``names``; it is in the observation
and in the state specs, so that a critic may read it and a reset may bring it.
"""

from __future__ import annotations

__all__ = ["ApplyPhysics", "DomainRandomizer"]

from functools import partial
from typing import Any, Self
from weakref import ref

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv

from .episode_draws import EpisodeDraws
from .errors import PhysicsError, message
from .physics.protocol import Physics
from .remote_source import PolicyWithSource
from .sources import Empirical, Grid, Source, names_of


class ApplyPhysics(Transform):
    """Writes the θ that a reset brings, and checks that the simulator holds it afterwards.

    A reset without θ restores the nominal values: those in force when the environment was first
    wrapped. The entry ``key`` of every reset is what the simulator itself says, read back after
    its own reset, and is carried through the episode.

    Args:
        physics: What to write and how.
        key: The entry that holds θ.

    Raises:
        PhysicsError: The simulator does not have a parameter, or does not hold what was written.
        TypeError: It is put around a ``SerialEnv`` or ``ParallelEnv`` and not inside.
        ValueError: θ is not finite or has another length than ``physics.names``.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ApplyPhysics(AttributePhysics("m", "l")))
        >>> env.reset()["theta"]
        tensor([1., 1.])
    """

    def __init__(self, physics: Physics, *, key: NestedKey = "theta") -> None:
        super().__init__()
        self.physics, self.key = physics, key
        self._written: Tensor | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, in the order of the columns of θ."""
        return tuple(self.physics.names)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to the simulator, and note its nominal values."""
        super().set_container(container)
        if self.parent is None:  # in a Compose that has no environment yet
            return
        env = _simulator(self.parent)
        if isinstance(env, SerialEnv | ParallelEnv):
            raise TypeError(
                message(
                    "ApplyPhysics beside each simulator",
                    f"ApplyPhysics around a {type(env).__name__}",
                    hint="put it inside the function that makes each environment",
                )
            )
        # Noted on the environment, where it outlasts transforms and their clones, and where a
        # batched environment finds `physics_names` on its workers' environments.
        if self._nominal(env) is None:
            noted = env.__dict__.setdefault("_nominal_physics", [])
            empty = TensorDict(batch_size=env.batch_size, device=env.device)
            everywhere = torch.ones(env.batch_size, dtype=torch.bool)
            for physics, nominal in noted:  # what other adapters wrote is not nominal
                physics.write(env, nominal, mask=everywhere, tensordict=empty)
            nominal = self.physics.read(env, tensordict=empty).to("cpu", torch.float64)
            noted.append((self.physics, nominal.clone()))
        known = env.__dict__["physics_names"]() if "physics_names" in env.__dict__ else {}
        env.__dict__["physics_names"] = partial(dict, known | {self.key: self.names})

    def _nominal(self, env: EnvBase) -> Tensor | None:
        noted = env.__dict__.get("_nominal_physics", [])
        return next((nominal for physics, nominal in noted if physics is self.physics), None)

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        """Add θ, so that a reset can bring it."""
        return self._with_theta(state_spec)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add θ, so that it is collected."""
        return self._with_theta(observation_spec)

    def _with_theta(self, spec: TensorSpec) -> TensorSpec:
        assert isinstance(spec, Composite)  # what TorchRL hands to transforms
        shape = torch.Size((*spec.shape, len(self.names)))
        spec[self.key] = Unbounded(shape, dtype=torch.float32, device=spec.device)
        return spec

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        env = _simulator(self.parent)
        if tensordict is None:
            tensordict = TensorDict(batch_size=env.batch_size, device=env.device)
        shape = (*tensordict.batch_size, len(self.names))
        nominal = self._nominal(env)
        assert nominal is not None  # noted when the transform was attached
        theta = tensordict.get(self.key, nominal.expand(shape)).to("cpu", torch.float64)
        mask = _resets(self.parent, tensordict)
        if theta.shape != shape:
            raise ValueError(message(f"θ of shape {shape}: {self.names}", tuple(theta.shape)))
        # A nominal NaN stands for entries that differ; carried through a reset, it restores them.
        bad = mask[..., None] & ~theta.isfinite() & nominal.isfinite()
        if bad.any():
            raise ValueError(message(f"finite θ: {self.names}", theta[bad.any(-1)][0].tolist()))
        self.physics.write(env, theta, mask=mask, tensordict=tensordict)
        self._written = theta
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        env = _simulator(self.parent)
        held = self.physics.read(env, tensordict=tensordict_reset).to("cpu", torch.float64)
        assert self._written is not None  # TransformedEnv calls _reset_env_preprocess first
        mask = _resets(self.parent, tensordict)[..., None]
        wrong = mask & ~torch.isclose(held, self._written, rtol=1e-6, atol=1e-12, equal_nan=True)
        if wrong.any():
            *row, column = wrong.nonzero()[0].tolist()
            raise PhysicsError(
                message(
                    f"{self.names[column]} = {float(self._written[*row, column]):.9g} after the "
                    "reset, as written",
                    float(held[*row, column]),
                    hint="does the environment's own reset overwrite it, or its setter clip it?",
                )
            )
        theta = held.to(tensordict_reset.device or "cpu", torch.float32)
        return tensordict_reset.set(self.key, theta)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        theta = tensordict.get(self.key, None)
        if theta is None:
            env = _simulator(self.parent)
            theta = self.physics.read(env, tensordict=tensordict)
            theta = theta.to(next_tensordict.device or "cpu", torch.float32)
        return next_tensordict.set(self.key, theta)

    def __repr__(self) -> str:
        units = getattr(self.physics, "units", ("",) * len(self.names))
        named = ", ".join(f"{n} [{u}]" if u else n for n, u in zip(self.names, units, strict=True))
        return f"ApplyPhysics({type(self.physics).__name__}({named}), key={self.key!r})"


class DomainRandomizer(Transform):
    """Draws θ at every reset, for the environments that reset and for no others.

    What episode ``e`` of environment ``i`` draws depends on ``(seed, i, e)`` alone: not on the
    process that runs it nor on when it finishes. Clones share the source and the pin, so that both
    reach an environment that TorchRL has unwrapped; give another environment its own randomizer.

    Args:
        source: Where to draw from: a prior, a posterior, a `Grid`, anything that samples.
        key: The entry that holds θ; the one of `ApplyPhysics`.
        names: The parameters' names; the source's own if it has some.
        seed: Another seed, other draws.
        first_environment: The global number of the first environment here. By default the
            collector's worker number times the number of environments, or 0.
        pool: Restrict to this many draws, made once (the BayesSim paper's 100 domains).

    Raises:
        PhysicsError: No `ApplyPhysics` before it writes ``key``, or for other parameters.

    Example:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
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
        self.key, self.first_environment, self.pool = key, first_environment, pool
        # Shared with clones, of which TorchRL makes one when it unwraps nested environments.
        self._shared: dict[str, Any] = {"names": names, "seed": seed, "pinned": None}
        self.source = source
        self._episodes = torch.zeros(0, dtype=torch.int64)  # begun so far, per environment
        self._theta = torch.zeros(0, 0)  # of the running episodes
        self._checked = False
        self._pushed: Tensor | None = None
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
        draws = EpisodeDraws(source, seed=self._shared["seed"], pool=self.pool)
        self._shared |= {"source": source, "draws": draws, "names": known or names}

    @property
    def names(self) -> tuple[str, ...] | None:
        """The parameters' names, in the order of the columns of θ, if known."""
        return self._shared["names"]

    def pin(self, theta: Any) -> None:
        """Give every environment this θ, of shape ``(D,)`` or ``(*batch, D)``, until `unpin`.

        Episodes meanwhile do not count: after `unpin`, draws go on where they stopped.
        """
        self._shared["pinned"] = torch.as_tensor(theta, dtype=torch.float32)

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
        if self.names is not None and len(self.names) != spec.shape[-1]:
            raise PhysicsError(
                message(f"{spec.shape[-1]} parameters, as ApplyPhysics has", self.names)
            )
        self._check_names()

    def _check_names(self) -> None:
        """Compare names with those beside the simulators, once the simulators exist."""
        env = _simulator(self.parent)
        if self._checked or (isinstance(env, SerialEnv | ParallelEnv) and env.is_closed):
            return
        found = getattr(env, "physics_names", dict)()
        for known in found if isinstance(found, list) else [found]:
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
            self._theta = torch.zeros(batch.numel(), shape[-1])
        if len(self._episodes) < batch.numel():
            more = torch.zeros(batch.numel() - len(self._episodes), dtype=torch.int64)
            self._episodes = torch.cat([self._episodes, more])
        rows = _resets(self.parent, tensordict).flatten().nonzero().flatten()
        if len(rows):
            # Never "keep what the tensordict has": a running tensordict holds the last episode's.
            self._theta[rows] = self._draw(rows, shape)
        return tensordict.set(
            self.key, self._theta.reshape(shape).to(parent.device or "cpu", copy=True)
        )

    def _draw(self, rows: Tensor, shape: tuple[int, ...]) -> Tensor:
        pinned = self._shared["pinned"]
        if pinned is not None:
            if pinned.shape not in (shape, shape[-1:]):
                raise ValueError(
                    message(f"pinned θ of shape {shape[-1:]} or {shape}", pinned.shape)
                )
            return pinned.expand(shape).reshape(-1, shape[-1])[rows]
        self._receive()
        first = self.first_environment
        if first is None:
            collector = self.collector
            worker = None if collector is None else collector.worker_idx
            first = (worker or 0) * len(self._theta)
        theta = self._shared["draws"](first + rows, self._episodes[rows])
        if theta.shape[-1] != shape[-1]:
            raise ValueError(message(f"a source of {shape[-1]} parameters", theta.shape[-1]))
        return theta

    def _receive(self) -> None:
        """Take over a table that `push_source` has sent since the last reset."""
        carrier = PolicyWithSource.inside(getattr(self.collector, "policy", None))
        if carrier is None:
            return
        draws = carrier.draws.detach().cpu()
        unchanged = self._pushed is not None and torch.equal(draws, self._pushed)
        if draws.isfinite().all() and not unchanged:
            self._pushed = draws.clone()
            self.source = Empirical(self._pushed, names=carrier.names)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_names()
        mask = _resets(self.parent, tensordict)
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
        if self._shared["pinned"] is None:
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
        source = type(self.source).__name__
        return f"DomainRandomizer({source}, names={self.names}, key={self.key!r})"


def _simulator(env: EnvBase | None) -> Any:
    """Return the environment under all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _resets(env: EnvBase | None, tensordict: TensorDictBase) -> Tensor:
    """Return which environments a reset concerns, boolean, of the tensordict's batch size."""
    batch, keys = tensordict.batch_size, [] if env is None else env.reset_keys
    masks = [tensordict.get(key, None) for key in keys]
    masks = [mask.reshape(*batch, -1).any(-1) for mask in masks if mask is not None]
    if not masks:
        return torch.ones(batch, dtype=torch.bool)
    return torch.stack(masks).any(0).cpu()
