"""Whether parameters do anything: the same actions from the same states, at both ends of the prior.

A friction that another geom's overrules, or a length that nothing reads, is written, is read back
as written, and changes nothing. Its posterior is the prior however many data there are.
"""

from __future__ import annotations

__all__ = ["check_influence", "without_influence"]

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from .errors import PhysicsError, message
from .inference.priors import BoxPrior
from .physics.unused import Rollout, unused
from .randomness import isolated
from .transforms.domain_randomizer import DomainRandomizer


def check_influence(
    env: EnvBase, randomizer: DomainRandomizer, prior: BoxPrior, *, steps: int, seed: int = 0
) -> None:
    """Refuse parameters of which the simulator's observations do not depend in a single bit.

    Args:
        env: As for :func:`without_influence`, as are the others.
        randomizer: The transform of ``env`` that draws the parameters.
        prior: Their ranges.
        steps: Steps to compare.
        seed: Of states and actions.

    Raises:
        PhysicsError: A parameter has no influence.
    """
    for name in without_influence(env, randomizer, prior, steps=steps, seed=seed)[:1]:
        column = prior.names.index(name)
        raise PhysicsError(
            message(
                f"{name!r} to change what is observed between {prior.low[column]:.3g} and "
                f"{prior.high[column]:.3g}",
                f"{steps} steps without any difference",
                hint="does something else overrule it? MuJoCo takes the larger friction of "
                "two geoms, so set both under one name",
            )
        )


@torch.no_grad()
def without_influence(
    env: EnvBase, randomizer: DomainRandomizer, prior: BoxPrior, *, steps: int, seed: int = 0
) -> tuple[str, ...]:
    """Return the parameters of which the observations do not depend in a single bit.

    Each parameter is set to its lowest and its highest value in turn, the others to the middle of
    their range; uniformly random actions are the same both times. For a simulator without a
    randomizer see :func:`.physics.conformance.unused_parameters`.

    Args:
        env: Simulated environments that reset to the same states after the same seed.
        randomizer: The transform of ``env`` that draws the parameters.
        prior: Their ranges.
        steps: Steps to compare; enough of them that every parameter should tell.
        seed: Of states and actions.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> names = ("LINK_MASS_2", "LINK_LENGTH_2")  # Gymnasium's never uses the latter
        >>> prior = BoxPrior(dict.fromkeys(names, (0.5, 1.5)))
        >>> randomizer, physics = DomainRandomizer(prior), ApplyPhysics(AttributePhysics(*names))
        >>> env = TransformedEnv(AcrobotEnv(2, max_steps=50), Compose(physics, randomizer))
        >>> without_influence(env, randomizer, prior, steps=20)
        ('LINK_LENGTH_2',)
    """
    keys = [key for key in env.observation_spec.keys() if key != randomizer.key]  # noqa: SIM118
    pinned = randomizer.pinned

    def rollout(theta: Tensor) -> Rollout:
        randomizer.pin(theta)
        with isolated(seed, "influence"):
            env.set_seed(seed)
            seen = env.rollout(steps, break_when_any_done=False).get("next")
        return {str(key): seen.get(key) for key in keys}

    try:
        middle = (prior.low + prior.high) / 2
        return unused(prior.names, (prior.low, prior.high), [middle], rollout)
    finally:
        randomizer.unpin()
        if pinned is not None:
            randomizer.pin(pinned)
