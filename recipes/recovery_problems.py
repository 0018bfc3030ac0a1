"""The seven problems of the BayesSim paper's Table 1 (arXiv:1906.01728), Hopper in two simulators.

Priors are the paper's. It gives no true values: Gymnasium's defaults where they lie inside the
prior, and values inside it for friction. It does not say which policy collected the data either
(its code loads agents trained elsewhere): here uniformly random actions, except where these see
little; there short scripted policies balance the pole or push the object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from bullet_hoppers import BulletHoppers
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import Compose, EnvBase, StepCounter, TransformedEnv

from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import MountainCarContinuousEnv
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.physics.protocol import Physics
from torchrl_bayessim.physics.pybullet import PyBulletPhysics
from torchrl_bayessim.summaries import (
    Summary,
    cross_correlation,
    duration,
    linear_dynamics,
    waypoints,
)
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer


@dataclass(frozen=True)
class Problem:
    """One problem.

    Attributes:
        simulator: Number of environments and seed to a batched environment.
        prior: The paper's.
        truth: The surrogate robot's parameters.
        physics: Where the parameters go.
        paper: Log-densities at the truth in the paper's Table 1, best of its four columns.
        policy: That collects; random actions if omitted.
        steps: Length of a trajectory, 200 at most.
        episodes: Trajectories per system that our own defaults summarise together.
        environments: Simulated at once.
        summaries: Statistics of our own defaults.
        paper_summaries: Statistics of the paper.
        unidentifiable: Parameters that do not enter the dynamics.
        costly: Whether a thousand trajectories take a minute, not seconds: in paper_mode methods
            that simulate for one observation are asked with the first seed only, and other truths
            are a third as many.
        needs: Package that the simulator needs beyond the main dependencies.
    """

    simulator: Callable[[int, int], EnvBase]
    prior: BoxPrior
    truth: Mapping[str, float]
    physics: Callable[[], Physics]
    paper: Mapping[str, float]
    policy: Callable[[], TensorDictModule] | None = None
    steps: int = 200
    episodes: int = 10
    environments: int = 1000
    summaries: tuple[Summary, ...] = (linear_dynamics,)
    paper_summaries: tuple[Summary, ...] = (cross_correlation,)
    unidentifiable: tuple[str, ...] = ()
    costly: bool = False
    needs: str = ""

    def make(self, randomizer: DomainRandomizer, *, environments: int, seed: int) -> EnvBase:
        """Return the simulator under the randomizer."""
        return TransformedEnv(
            self.simulator(environments, seed),
            Compose(ApplyPhysics(self.physics()), randomizer, StepCounter(self.steps)),
        )


def of(summary: Summary, *columns: int) -> Summary:
    """Return the summary of some columns of the state."""
    chosen = list(columns)

    def restricted(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
        return summary(state[..., chosen], action, next_state[..., chosen], mask)

    return restricted


def balance() -> TensorDictModule:
    """Push the cart under the pole, most of the time."""

    def act(observation: Tensor) -> Tensor:
        gain = observation.new_tensor([0.1, 0.2, 1.0, 0.4])
        tilt = observation @ gain + 0.1 * torch.randn(observation.shape[:-1])
        return one_hot((tilt > 0).long(), 2)

    return TensorDictModule(act, in_keys=["observation"], out_keys=["action"])


def swing() -> TensorDictModule:
    """Swing the acrobot at a rising frequency, damped at the elbow."""

    def act(observation: Tensor, step: Tensor) -> Tensor:
        t = step[..., 0].float()
        damping = torch.tanh(2 * (observation[..., 1] - 0.3 * observation[..., 5]))
        torque = damping + torch.sin(0.187 * t + 0.003 * t.square())
        return one_hot((torque > 0.33).long() + (torque > -0.33).long(), 3)

    return TensorDictModule(act, in_keys=["observation", "step_count"], out_keys=["action"])


def sway() -> TensorDictModule:
    """Move the hopper's joints slowly to and fro, one after the other."""

    def act(step: Tensor) -> Tensor:
        return torch.sin(0.15 * step.float() + torch.arange(3.0))

    return TensorDictModule(act, in_keys=["step_count"], out_keys=["action"])


def stiffen() -> TensorDictModule:
    """Hold the joints of PyBullet's hopper at zero, so that it falls as a stick and slides."""

    def act(observation: Tensor) -> Tensor:
        position, velocity = observation[..., 8:14:2], observation[..., 9:14:2]
        return (-5 * position - velocity).clamp(-1, 1)

    return TensorDictModule(act, in_keys=["observation"], out_keys=["action"])


def strike() -> TensorDictModule:
    """Drive the gripper at the object; draw back while it slides; strike again."""

    def act(observation: Tensor) -> Tensor:
        towards = observation[..., 6:8]
        towards = towards / (towards.norm(dim=-1, keepdim=True) + 1e-6)
        speed = (observation[..., 14:16] + observation[..., 20:22]).norm(dim=-1, keepdim=True)
        action = torch.zeros(*observation.shape[:-1], 4)
        action[..., :2] = torch.where(speed > 0.002, -towards, towards)
        action[..., :2] += 0.1 * torch.randn(towards.shape)
        return action.clamp(-1, 1)

    return TensorDictModule(act, in_keys=["observation"], out_keys=["action"])


def sliding(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """How Fetch's object slides when nothing touches it, L = 8.

    Quantiles of the speed it loses per step, its way, its top speed, the steps it slides freely.
    The observation holds the gripper's position in columns 0 to 2, the object's in 3 to 5.
    """
    del action
    way = next_state[..., 3:6] - state[..., 3:6]
    speed = torch.where(mask, way[..., :2].norm(dim=-1), 0.0)
    lost = speed[..., :-1] - speed[..., 1:]
    apart = (next_state[..., 3:6] - next_state[..., :3]).norm(dim=-1)[..., :-1] > 0.06
    level = way[..., 1:, 2].abs() < 1e-3
    slower = mask[..., 1:] & apart & level & (lost > 2e-4)
    # a step in which it comes to rest loses less, and one in which it is still pushed anything
    whole = speed[..., 1:] > 0.5 * lost
    loose = slower & whole
    strict = loose & torch.nn.functional.pad(slower[..., :-1], (1, 0))
    free = torch.where(strict.any(-1, keepdim=True), strict, loose)
    quantiles = torch.where(free, lost, torch.nan).nanquantile(
        lost.new_tensor([0.1, 0.3, 0.5, 0.7, 0.9]), dim=-1
    )
    parts = [*quantiles.nan_to_num(0.0), speed.sum(-1), speed.amax(-1), free.sum(-1).float()]
    return torch.stack(parts, -1)


def classic(kind: type, **bounds: tuple[float, float]) -> dict[str, Any]:
    """Return the entries that classic-control problems share."""
    return {
        "simulator": lambda n, seed: kind(n, seed=seed),
        "physics": lambda: AttributePhysics(*bounds),
        "prior": BoxPrior(bounds),
    }


def hopper(environments: int, seed: int) -> EnvBase:
    """Return MuJoCo's Hopper that may fall and goes on."""
    task = replace(known_task("Hopper-v5"), termination=None)
    return BatchedMujocoEnv(task, environments, seed=seed)


def fetch(task: str, paper: float) -> Problem:
    """Return a Fetch problem: the friction of table and object, one value for both."""
    surfaces = ("geom_friction[body:table0,0]", "geom_friction[object0,0]")
    return Problem(
        simulator=lambda n, seed: BatchedMujocoEnv(task, n, seed=seed),
        prior=BoxPrior({"friction": (0.1, 1.0)}),
        truth={"friction": 0.57546},  # the one value in the paper's code
        physics=lambda: MujocoPhysics(friction=surfaces),
        paper={"friction": paper},
        policy=strike,
        steps=60,
        episodes=1,
        environments=250,
        costly=True,
        summaries=(sliding,),
        paper_summaries=(of(cross_correlation, 0, 1, 3, 4, 5, 14, 15),),
    )


PROBLEMS: dict[str, Problem] = {
    "cartpole": Problem(
        **classic(CartPoleEnv, length=(0.1, 2.0), masspole=(0.1, 2.0)),
        truth={"length": 0.5, "masspole": 0.1},
        paper={"length": -0.211, "masspole": 0.973},
        policy=balance,
        summaries=(linear_dynamics, duration),
    ),
    "pendulum": Problem(
        **classic(PendulumEnv, dt=(0.01, 0.3)),
        truth={"dt": 0.05},
        paper={"dt": 3.199},
    ),
    "mountain_car": Problem(
        **classic(MountainCarContinuousEnv, power=(0.0005, 0.1)),
        truth={"power": 0.0015},
        paper={"power": 3.901},
    ),
    "acrobot": Problem(
        **classic(
            AcrobotEnv,
            LINK_MASS_1=(0.5, 2.0),
            LINK_MASS_2=(0.5, 2.0),
            LINK_LENGTH_1=(0.1, 1.5),
            LINK_LENGTH_2=(0.5, 1.5),
        ),
        truth=dict.fromkeys(("LINK_MASS_1", "LINK_MASS_2", "LINK_LENGTH_1", "LINK_LENGTH_2"), 1.0),
        paper={
            "LINK_MASS_1": 2.046,
            "LINK_MASS_2": 2.237,
            "LINK_LENGTH_1": 2.421,
            "LINK_LENGTH_2": -0.148,
        },
        policy=swing,
        unidentifiable=("LINK_LENGTH_2",),
    ),
    "hopper": Problem(
        simulator=hopper,
        prior=BoxPrior({"friction": (0.3, 0.5)}),
        truth={"friction": 0.4},
        physics=lambda: MujocoPhysics(
            friction=("geom_friction[floor,0]", "geom_friction[foot_geom,0]")
        ),
        paper={"friction": 3.391},  # of its Hopper in PyBullet
        policy=sway,
        steps=100,
        episodes=1,
        environments=250,
        summaries=(cross_correlation, waypoints(5)),
    ),
    "hopper_pybullet": Problem(
        simulator=lambda n, seed: BulletHoppers(n, seed=seed),
        prior=BoxPrior({"friction": (0.3, 0.5)}),
        truth={"friction": 0.4},
        physics=lambda: PyBulletPhysics(friction="lateralFriction[floor]"),
        paper={"friction": 3.391},
        policy=stiffen,
        steps=100,
        episodes=1,
        environments=50,
        costly=True,
        needs="pybullet_envs_gymnasium",
        summaries=(waypoints(10),),
    ),
    "fetch_push": fetch("FetchPush-v4", 2.423),
    "fetch_slide": fetch("FetchSlide-v4", 2.391),
}
