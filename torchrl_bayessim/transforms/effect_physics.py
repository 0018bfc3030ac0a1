"""Strengths of effects as further parameters, so that one posterior drives both."""

from __future__ import annotations

__all__ = ["EffectPhysics"]

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import message
from ..physics.protocol import Physics
from .apply_effect import ApplyEffect


class EffectPhysics:
    """A physics adapter with more columns: strengths that `ApplyEffect` transforms hold.

    A column is named after effect and target, ``coulomb_friction[hinge]``; the target ``all``
    stands for all of an effect's targets at once. Other strengths stay as they are.

    Args:
        physics: The parameters that come first; ``None`` for none.
        *strengths: Transforms of the same environment, each with a target.

    Raises:
        ValueError: There is no strength, or one twice.

    Example:
        >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
        >>> from torchrl_bayessim.physics.mujoco import MujocoPhysics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> friction = ApplyEffect("coulomb_friction", 0.0)
        >>> physics = EffectPhysics(MujocoPhysics("body_mass[pole]"), (friction, "hinge"))
        >>> env = GymEnv("InvertedPendulum-v5")
        >>> env = TransformedEnv(env, Compose(ApplyPhysics(physics), friction))
        >>> physics.names
        ('body_mass[pole]', 'coulomb_friction[hinge]')
        >>> theta = torch.tensor([5.0, 0.1])
        >>> env.reset(env.full_state_spec.zero().set("theta", theta))["theta"]
        tensor([5.0000, 0.1000])
    """

    def __init__(self, physics: Physics | None, *strengths: tuple[ApplyEffect, str]) -> None:
        self._physics, self._strengths = physics, strengths
        first = () if physics is None else tuple(physics.names)
        self.names = first + tuple(f"{t.effect.name}[{target}]" for t, target in strengths)
        self._size = len(first)
        if not strengths or len(set(self.names)) != len(self.names):
            raise ValueError(message("strengths, each once", self.names))

    @property
    def units(self) -> tuple[str, ...]:
        """The parameters' units."""
        first = getattr(self._physics, "units", ("",) * self._size)
        return (*first, *(transform.effect.unit for transform, _ in self._strengths))

    def write(
        self, env: EnvBase, theta: Tensor, *, mask: Tensor, tensordict: TensorDictBase
    ) -> None:
        """Set the parameters, then the strengths, of the environments in ``mask``."""
        if self._physics is not None:
            first = theta[..., : self._size]
            self._physics.write(env, first, mask=mask, tensordict=tensordict)
        for i, (transform, target) in enumerate(self._strengths):
            values = _held(transform, env).clone()
            new = theta[..., self._size + i, None].to(values)
            for column in _columns(transform, target):
                old = values[..., column, None]
                # NaN is what `read` gave where targets differ, and leaves them as they are
                keep = new.isnan() | ~mask.unsqueeze(-1)
                values[..., column, None] = torch.where(keep, old, new)
            transform.strength = values

    def read(self, env: EnvBase, *, tensordict: TensorDictBase) -> Tensor:
        """Return the values in force, shape ``(*batch, D)``; NaN where targets of one differ."""
        columns = []
        for transform, target in self._strengths:
            values = _held(transform, env)[..., _columns(transform, target)]
            same = (values == values[..., :1]).all(-1)
            columns.append(torch.where(same, values[..., 0], torch.nan))
        strengths = torch.stack(columns, -1)
        if self._physics is None:
            return strengths
        first = self._physics.read(env, tensordict=tensordict).to(strengths)
        return torch.cat([first, strengths], -1)


def _held(transform: ApplyEffect, env: EnvBase) -> Tensor:
    """Return all strengths of an effect, shape ``(*batch, N)``."""
    transform.know(env)
    transform.strength = transform.strength
    return transform.strength.expand(*env.batch_size, len(transform.targets))


def _columns(transform: ApplyEffect, target: str) -> list[int]:
    targets = transform.targets
    if target == "all":
        return list(range(len(targets)))
    if target not in targets:
        expected = f"a target of {transform.effect.name}"
        raise KeyError(message(expected, target, available=(*targets, "all")))
    return [targets.index(target)]
