"""The tasks of the recipes: simulator, prior, hidden truth, and PPO's settings.

Priors and true values of the classic-control tasks are those of the BayesSim paper's Table 1
(arXiv:1906.01728); where it gives no true value, Gymnasium's default is the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import Compose, EnvBase, GymEnv, RewardSum, StepCounter, TransformedEnv

from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import MountainCarContinuousEnv
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import message
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.physics.protocol import Physics
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import Summary, duration, linear_dynamics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer


@dataclass(frozen=True)
class Task:
    """One problem.

    Attributes:
        simulator: Number of environments and seed to a batched environment.
        prior: What is believed before any data.
        truth: The surrogate robot's parameters.
        physics: Where the parameters go.
        max_steps: Length of an episode.
        environments: Environments that train.
        horizon: Steps per batch and per summarised trajectory.
        updates: Learner updates per round under the posterior.
        shared_batches: Batches per round that serve inference and the learner.
        ppo: PPO's settings.
        summaries: Statistics of trajectories.
        simulator_name: Gymnasium's name of the simulator, which renders it; empty if none does.
    """

    simulator: Callable[[int, int], EnvBase]
    prior: BoxPrior
    truth: Mapping[str, float]
    physics: Callable[[], Physics]
    max_steps: int
    environments: int = 128
    horizon: int = 128
    updates: int = 6
    shared_batches: int = 3
    ppo: Mapping[str, Any] = field(default_factory=dict)
    summaries: Sequence[Summary] = (linear_dynamics, duration)
    simulator_name: str = ""

    def make(self, environments: int, *, seed: int, randomizer: DomainRandomizer | None) -> EnvBase:
        """Return the simulator with the physics, and with the randomizer if one is given."""
        transforms = [ApplyPhysics(self.physics())]
        if randomizer is not None:
            transforms.append(randomizer)
        return TransformedEnv(
            self.simulator(environments, seed),
            Compose(*transforms, StepCounter(self.max_steps), RewardSum()),
        )

    def rendered(self, size: int) -> EnvBase:
        """Return Gymnasium's own simulator with pictures, of about ``size`` pixels if it can."""
        del size
        return GymEnv(self.simulator_name, from_pixels=True, pixels_only=False)

    def scores(self, env: EnvBase, policy: Any) -> Tensor:
        """Return what a policy is worth in one episode of each environment: its return."""
        return evaluate(env, policy, max_steps=self.max_steps)


def true_parameters(task: Any, choice: str, *, seed: int) -> Tensor:
    """Return what the surrogate robot hides, in the prior's order.

    Args:
        task: Has a ``prior`` and its own ``truth``, by name.
        choice: ``nominal`` for the task's truth, ``random`` for a draw from the prior.
        seed: Of the draw.

    Raises:
        ValueError: The choice is another.
    """
    if choice == "random":
        return draw(task.prior, 1, key=(seed, "truth"))[0]
    if choice != "nominal":
        raise ValueError(message("a truth", choice, available=["nominal", "random"]))
    return torch.tensor([task.truth[name] for name in task.prior.names])


TASKS: dict[str, Task] = {
    "cartpole": Task(
        simulator=lambda n, seed: CartPoleEnv(n, seed=seed),
        prior=BoxPrior(
            {"length": (0.1, 2.0), "masspole": (0.1, 2.0)}, units={"length": "m", "masspole": "kg"}
        ),
        truth={"length": 0.5, "masspole": 0.1},
        physics=lambda: AttributePhysics("length", "masspole"),
        max_steps=500,
        simulator_name="CartPole-v1",
    ),
    "pendulum": Task(
        simulator=lambda n, seed: PendulumEnv(n, seed=seed),
        prior=BoxPrior({"dt": (0.01, 0.3)}, units={"dt": "s"}),
        truth={"dt": 0.05},
        physics=lambda: AttributePhysics("dt"),
        simulator_name="Pendulum-v1",
        max_steps=200,
        environments=64,
        horizon=100,
        updates=12,
        ppo={"minibatch_size": 640, "gamma": 0.98, "reward_scale": 0.1},
    ),
    "mountain_car": Task(
        simulator=lambda n, seed: MountainCarContinuousEnv(n, seed=seed),
        prior=BoxPrior({"power": (0.0005, 0.1)}, log=["power"]),
        truth={"power": 0.0015},
        physics=lambda: AttributePhysics("power"),
        simulator_name="MountainCarContinuous-v0",
        max_steps=999,
        environments=32,
        horizon=256,
        updates=6,
        shared_batches=2,
        ppo={"initial_std": 1.0, "reward_scale": 0.1},
    ),
    "acrobot": Task(
        simulator=lambda n, seed: AcrobotEnv(n, seed=seed),
        prior=BoxPrior(
            {
                "LINK_MASS_1": (0.5, 2.0),
                "LINK_MASS_2": (0.5, 2.0),
                "LINK_LENGTH_1": (0.1, 1.5),
                "LINK_LENGTH_2": (0.5, 1.5),
            },
            units={
                "LINK_MASS_1": "kg",
                "LINK_MASS_2": "kg",
                "LINK_LENGTH_1": "m",
                "LINK_LENGTH_2": "m",
            },
        ),
        truth=dict.fromkeys(("LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_LENGTH_2"), 1.0),
        physics=lambda: AttributePhysics(
            "LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_LENGTH_2"
        ),
        simulator_name="Acrobot-v1",
        max_steps=500,
        environments=64,
        ppo={"reward_scale": 0.1},
    ),
    "hopper": Task(
        simulator=lambda n, seed: BatchedMujocoEnv("Hopper-v5", n, seed=seed),
        prior=BoxPrior(
            {"torso_mass": (2.0, 6.0), "friction": (0.4, 2.0)}, units={"torso_mass": "kg"}
        ),
        truth={"torso_mass": 3.67, "friction": 1.2},
        physics=lambda: MujocoPhysics(
            torso_mass="body_mass[torso]",
            friction=("geom_friction[floor,0]", "geom_friction[foot_geom,0]"),
        ),
        max_steps=1000,
        simulator_name="Hopper-v5",
        environments=64,
        updates=24,
        shared_batches=2,
        ppo={"minibatch_size": 256, "learning_rate": 5e-4, "reward_scale": 0.1},
    ),
}
