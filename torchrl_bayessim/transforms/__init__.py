"""Domain randomisation in two transforms: one draws parameters, one writes them; and effects.

`ApplyPhysics` sits beside the simulator, in the function that makes each environment, and holds
the simulator to the θ that the reset brings. `DomainRandomizer` sits in the collector's process,
outside the batched environment, and draws::

    def make():
        return TransformedEnv(GymEnv("CartPole-v1"), ApplyPhysics(AttributePhysics("length")))

    randomizer = DomainRandomizer(prior)
    env = TransformedEnv(ParallelEnv(8, make), randomizer)
    randomizer.source = posterior          # from the next resets on

`ApplyEffect` sits beside the simulator too, after `ApplyPhysics`, and adds what the simulator
leaves out: friction, a delay, a gap.

θ is an entry of the tensordict, ``"theta"`` unless another ``key`` is given: float32, shape
``(*batch, D)``, in the parameters' own units, in the order of ``names``; it is in the observation
and in the state specs, so that a critic may read it and a reset may bring it.
"""

__all__ = ["ApplyEffect", "ApplyPhysics", "DomainRandomizer", "EffectPhysics"]

from .apply_effect import ApplyEffect
from .apply_physics import ApplyPhysics
from .domain_randomizer import DomainRandomizer
from .effect_physics import EffectPhysics
