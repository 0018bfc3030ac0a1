"""Posteriors over a simulator's physics, policies trained under them, round after round.

The public names; everything else is in the module of its concept, e.g.
``torchrl_bayessim.summaries``.
"""

from __future__ import annotations

__all__ = [
    "ApplyEffect",
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
    "Report",
    "SimToRealLoop",
    "StatePhysics",
    "SummaryStatistics",
    "SurrogateRobot",
    "System",
    "checked_logs",
    "diagnose",
    "fit",
    "read_logs",
    "sequential",
    "simulate",
]

from importlib.metadata import version

from .diagnosis.diagnose import diagnose
from .diagnosis.report import Report
from .envs.mujoco import BatchedMujocoEnv
from .inference.fit import fit
from .inference.losses import PosteriorLoss
from .inference.posterior import MixtureDensityPosterior
from .inference.priors import BoxPrior, GaussianPrior
from .inference.refinement import PosteriorRefinement
from .inference.sequential import sequential
from .logs.checked import checked_logs
from .logs.read import read_logs
from .logs.system import System
from .loop import SimToRealLoop
from .physics.attributes import AttributePhysics
from .physics.mujoco import MujocoPhysics
from .physics.protocol import Physics
from .physics.state import StatePhysics
from .replay import Replay
from .robots import RecordedLogs, SurrogateRobot
from .simulate import simulate
from .summaries import SummaryStatistics
from .transforms import ApplyEffect, ApplyPhysics, DomainRandomizer

__version__ = version("torchrl_bayessim")
