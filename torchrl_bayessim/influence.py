"""Whether parameters do anything: the same actions from the same states, at both ends of the prior.

A friction that another geom's overrules, or a length that nothing reads, is written, is read back
as written, and changes nothing. Its posterior is the prior however many data there are.
"""

from __future__ import annotations

__all__ = ["check_influence"]

import torch
from torchrl.envs import EnvBase

from .errors import PhysicsError, message
from .inference.priors import BoxPrior
from .randomness import isolated
from .transforms.domain_randomizer import DomainRandomizer


@torch.no_grad()
def check_influence(
    env: EnvBase, randomizer: DomainRandomizer, prior: BoxPrior, *, steps: int, seed: int = 0
) -> None:
    """Refuse parameters of which the simulator's observations do not depend in a single bit.

    Each parameter is set to its lowest and its highest value in turn, the others to the middle of
    their range; uniformly random actions are the same both times.

    Args:
        env: Simulated environments that reset to the same states after the same seed.
        randomizer: The transform of ``env`` that draws the parameters.
        prior: Their ranges.
        steps: Steps to compare; enough of them that every parameter should tell.
        seed: Of states and actions.

    Raises:
        PhysicsError: A parameter has no influence.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> from torchrl_bayessim.transforms import ApplyPhysics
        >>> prior = BoxPrior({"length": (0.1, 2.0)})
        >>> randomizer = DomainRandomizer(prior)
        >>> physics = ApplyPhysics(AttributePhysics("length"))
        >>> env = TransformedEnv(CartPoleEnv(4), Compose(physics, randomizer))
        >>> check_influence(env, randomizer, prior, steps=10)
    """
    pinned = randomizer.pinned
    middle = (prior.low + prior.high) / 2
    keys = [key for key in env.observation_spec.keys() if key != randomizer.key]  # noqa: SIM118
    try:
        for column, name in enumerate(prior.names):
            seen = []
            for end in (prior.low, prior.high):
                theta = middle.clone()
                theta[column] = end[column]
                randomizer.pin(theta)
                with isolated(seed, "influence"):
                    env.set_seed(seed)
                    seen.append(env.rollout(steps, break_when_any_done=False).get("next"))
            if all(torch.equal(seen[0].get(key), seen[1].get(key)) for key in keys):
                raise PhysicsError(
                    message(
                        f"{name!r} to change what is observed between {prior.low[column]:.3g} and "
                        f"{prior.high[column]:.3g}",
                        f"{steps} steps without any difference",
                        hint="does something else overrule it? MuJoCo takes the larger friction of "
                        "two geoms, so set both under one name",
                    )
                )
    finally:
        randomizer.unpin()
        if pinned is not None:
            randomizer.pin(pinned)
