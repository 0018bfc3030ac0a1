"""Arguments that work."""

import tempfile
from pathlib import Path

import mujoco
import torch
from one_joint_arm import ARM, describe
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

import torchrl_bayessim as package
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.summaries import moments
from torchrl_bayessim.trajectories import first_trajectories

PRIOR = package.BoxPrior({"length": (0.2, 1.5)})
QUICK = {"epochs": 1, "progress": False}
PENDULUM = "InvertedPendulum-v5"
FOLDER = tempfile.TemporaryDirectory()  # until the end of the process
describe(Path(FOLDER.name))


def cartpole(*more):
    physics = package.ApplyPhysics(package.AttributePhysics("length"))
    return TransformedEnv(CartPoleEnv(2), Compose(physics, *more))


def randomized():
    randomizer = package.DomainRandomizer(PRIOR)
    return {"env": cartpole(randomizer), "randomizer": randomizer}


def statistics():
    return package.SummaryStatistics(moments)


def pairs():
    theta = PRIOR.sample((12,), generator=torch.Generator().manual_seed(0))
    return TensorDict({"theta": theta, "summary": theta.clone()}, [12])


def posterior():
    return package.MixtureDensityPosterior(PRIOR, 1, components=1)


def refinement(**options):
    options = {"simulations": 8, "networks": 1, "fit_options": dict(QUICK)} | options
    return package.PosteriorRefinement(PRIOR, **options)


def robot():
    return package.SurrogateRobot(cartpole(), [0.7], max_steps=3)


def rows():
    return first_trajectories(CartPoleEnv(2).rollout(4, break_when_any_done=False))


class Learner:
    """Improves nothing; its policy is random."""

    def __init__(self):
        self.policy = PPO(cartpole()).policy

    def update(self, batch, *, key, progress):
        return {}

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def loop():
    return {
        **randomized(),
        "learner": Learner(),
        "robot": robot(),
        "refinement": refinement(),
        "statistics": statistics(),
        "horizon": 3,
        "episodes": 2,
        "updates": 1,
        "shared_batches": 1,
        "prior_share": 0.1,
        "rounds": 1,
        "checkpoint_every": 1,
        "progress": False,
    }


def segments():
    still = torch.zeros(1, 2)
    return {"qpos": still, "qvel": still.clone(), "action": torch.zeros(1, 2, 1)}


def replay():
    return package.Replay(PENDULUM, segments(), physics=package.MujocoPhysics("body_mass[pole]"))


def system():
    task = Task(model=mujoco.MjModel.from_xml_string(ARM), frame_skip=2)
    return package.System(task=task)


def recorded(count):
    phase = 0.2 * torch.arange(count, dtype=torch.float64)[:, None]
    q, v = 0.1 * phase.sin(), 0.1 * 0.2 / system().control_dt * phase.cos()
    return TensorDict({"qpos": q, "qvel": v, "action": q.clone()}, [count])


def logs():
    return package.read_logs(recorded(60), system())


def written(physics, env, theta, **options):
    """Return what an environment holds after a reset with these parameters."""
    env = TransformedEnv(env, package.ApplyPhysics(physics))
    start = env.full_state_spec.zero()
    return env.reset(start.set("theta", theta))["theta"]


def first(turns):
    return next(iter(turns))


def theta_rows():
    return torch.tensor([[0.5], [0.7]])
