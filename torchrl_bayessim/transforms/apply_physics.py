"""The transform beside the simulator, which writes the parameters that a reset brings."""

from __future__ import annotations

__all__ = ["ApplyPhysics"]

from functools import partial

import torch
from gymnasium.vector import VectorEnv
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform

from ..errors import PhysicsError, message
from ..kinds import check_key
from ..physics.protocol import Physics
from ..physics.state import StatePhysics
from .resets import resets, simulator, transforms_of


class ApplyPhysics(Transform):
    """Writes the θ that a reset brings, and checks that the simulator holds it afterwards.

    θ is an observation like others, float32 of shape ``(*batch, D)``: column i is ``names[i]`` in
    ``units[i]``, which the representation of the environment shows.

    A reset without θ restores the nominal values: those in force when the environment was first
    wrapped. The entry ``key`` of every reset is what the simulator itself says, read back after
    its own reset, and is carried through the episode.

    Args:
        physics: What to write and how.
        key: The entry that holds θ.

    Raises:
        PhysicsError: The simulator does not have a parameter, or does not hold what was written; it
            is one of gymnasium's vector environments; or another ApplyPhysics writes ``key``.
        TypeError: It is put around a ``SerialEnv`` or ``ParallelEnv`` and not inside; or
            ``physics`` is no `Physics`, or ``key`` no key.
        ValueError: θ is not finite or has another length than ``physics.names``.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), ApplyPhysics(AttributePhysics("m", "l")))
        >>> env.reset()["theta"]
        tensor([1., 1.])
        >>> list(zip(env.transform.names, env.transform.units))
        [('m', 'kg'), ('l', 'm')]
    """

    def __init__(self, physics: Physics, *, key: NestedKey = "theta") -> None:
        super().__init__()
        if not isinstance(physics, Physics):
            hint = "AttributePhysics(name, ...) or MujocoPhysics(name, ...)"
            expected = "physics with names, write and read"
            raise TypeError(message(expected, type(physics).__name__, hint=hint))
        check_key("key", key)
        self.physics, self.key = physics, key
        self._written: Tensor | None = None
        self._held: Tensor | None = None  # float32, of the running episodes

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, in the order of the columns of θ."""
        return tuple(self.physics.names)

    @property
    def units(self) -> tuple[str, ...]:
        """The units of the columns of θ, ``""`` where they are not known."""
        return tuple(getattr(self.physics, "units", ("",) * len(self.names)))

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to the simulator, and note its nominal values."""
        super().set_container(container)
        if self.parent is None:  # in a Compose that has no environment yet
            return
        env = simulator(self.parent)
        if isinstance(env, SerialEnv | ParallelEnv):
            raise TypeError(
                message(
                    "ApplyPhysics beside each simulator",
                    f"ApplyPhysics around a {type(env).__name__}",
                    hint="put it inside the function that makes each environment",
                )
            )
        if isinstance(env.__dict__.get("_env"), VectorEnv):
            expected = "a simulator per environment, or one that is batched natively"
            hint = "SerialEnv or ParallelEnv of environments with num_envs=1, or BatchedMujocoEnv"
            raise PhysicsError(message(expected, type(env.__dict__["_env"]).__name__, hint=hint))
        others = (a for a in transforms_of(self.parent, ApplyPhysics) if a is not self)
        if any(a.key == self.key and a.physics is not self.physics for a in others):
            expected = f"one ApplyPhysics that writes {self.key!r}"
            hint = "one Physics of all parameters, or another key= here and in a randomizer"
            raise PhysicsError(message(expected, "two", hint=hint))
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
        env = simulator(self.parent)
        if tensordict is None:
            tensordict = TensorDict(batch_size=env.batch_size, device=env.device)
        shape = (*tensordict.batch_size, len(self.names))
        nominal = self._nominal(env)
        assert nominal is not None  # noted when the transform was attached
        theta = tensordict.get(self.key, nominal.expand(shape)).to("cpu", torch.float64)
        mask = resets(self.parent, tensordict)
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
        env = simulator(self.parent)
        held = self.physics.read(env, tensordict=tensordict_reset).to("cpu", torch.float64)
        assert self._written is not None  # TransformedEnv calls _reset_env_preprocess first
        mask = resets(self.parent, tensordict)[..., None]
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
        self._held = held.to(tensordict_reset.device or "cpu", torch.float32)
        return tensordict_reset.set(self.key, self._held.clone())

    def inv(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Pass the input on as it is; copied only where TorchRL takes an entry out of it."""
        # once per step and simulator: the dispatch and copy of `Transform.inv` would cost more
        # than all else that this transform does
        return tensordict.copy() if "_step" in tensordict.keys() else tensordict  # noqa: SIM118

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # never what the tensordict says: another transform may have normalised it in place
        if self._held is None or isinstance(self.physics, StatePhysics):
            theta = self.physics.read(simulator(self.parent), tensordict=tensordict)
            theta = theta.to(next_tensordict.device or "cpu", torch.float32)
        else:
            theta = self._held.clone()
        return next_tensordict.set(self.key, theta)

    def __repr__(self) -> str:
        rows = zip(self.names, self.units, strict=True)
        named = ", ".join(f"{name} [{unit}]" if unit else name for name, unit in rows)
        return f"ApplyPhysics({type(self.physics).__name__}({named}), key={self.key!r})"
