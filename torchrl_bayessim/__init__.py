"""Posteriors over a simulator's physics, policies trained under them, round after round.

The public names; everything else is in the module of its concept, e.g.
``torchrl_bayessim.summaries``.
"""

from __future__ import annotations

__all__ = [
    "ApplyPhysics",
    "AttributePhysics",
    "BatchedMujocoEnv",
    "BoxPrior",
    "DomainRandomizer",
    "GaussianPrior",
    "MixtureDensityPosterior",
    "MujocoPhysics",
    "Physics",
    "PosteriorLoss",
    "PosteriorRefinement",
    "RecordedLogs",
    "Replay",
    "SimToRealLoop",
    "StatePhysics",
    "SummaryStatistics",
    "SurrogateRobot",
    "fit",
    "sequential",
    "simulate",
]

from importlib.metadata import version

from .envs.mujoco import BatchedMujocoEnv
from .inference.fit import fit
from .inference.losses import PosteriorLoss
from .inference.posterior import MixtureDensityPosterior
from .inference.priors import BoxPrior, GaussianPrior
from .inference.refinement import PosteriorRefinement
from .inference.sequential import sequential
from .loop import SimToRealLoop
from .physics.attributes import AttributePhysics
from .physics.mujoco import MujocoPhysics
from .physics.protocol import Physics
from .physics.state import StatePhysics
from .replay import Replay
from .robots import RecordedLogs, SurrogateRobot
from .simulate import simulate
from .summaries import SummaryStatistics
from .transforms import ApplyPhysics, DomainRandomizer

__version__ = version("torchrl_bayessim")
