"""An arm that has to hold itself upright, and a robot whose commands arrive late.

One link on a motor that is twice as strong as gravity, from hanging to upright and there to stay,
in three seconds. Where a command acts some control steps late, feedback must be softer than without
delay, or it swings around the top for ever; and no mass and no damping can stand for a delay. So
the effect changes the best policy, and retuning the simulator's parameters does not bring it back.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv, UnaryTransform

from torchrl_bayessim.diagnosis.excitation_library import excitations
from torchrl_bayessim.effects.catalogue import CATALOGUE
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Readings, Task, uniform_reset
from torchrl_bayessim.evaluation import evaluate
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import isolated, seed_from
from torchrl_bayessim.replay_actions import ReplayActions
from torchrl_bayessim.robots import SurrogateRobot
from torchrl_bayessim.sources import Grid
from torchrl_bayessim.transforms import ApplyEffect, ApplyPhysics, DomainRandomizer

MODEL = """<mujoco model="arm">
  <option timestep="0.01" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="link">
    <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.005"/>
    <inertial pos="0 0 -0.2" mass="1" diaginertia="0.014 0.014 0.001"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-4 4" ctrllimited="true"/></actuator>
</mujoco>
"""
STEPS = 150  # of an episode and of a log, 0.02 s each
NOISE = (0.002, 0.02)  # standard deviations of the encoder: rad, rad/s
PRIOR = BoxPrior(
    {"body_mass[link]": (0.5, 2.0), "dof_damping[hinge]": (0.02, 0.4)},
    units={"body_mass[link]": "kg", "dof_damping[hinge]": "N m s/rad"},
)
PHYSICS = MujocoPhysics(*PRIOR.names)
# What the robot hides from everything but the final score.
TRUE_PARAMETERS = torch.tensor([1.1, 0.08])
TRUE_EFFECT = ("action_delay", "motor", 0.06)  # s


def _reward(_: Readings, after: Readings, action: Tensor) -> Tensor:
    """Return at most 1 for each step: upright within a tenth of a radian, at rest, at no effort."""
    height = (1.0 - after.qpos[..., 0].cos()) / 2.0  # 1 upright, at π
    pointed = torch.exp(-4.0 * (1.0 - height) / 0.1**2)  # 4 (1 - height) is the angle's square
    effort = 0.001 * (after.qvel[..., 0].square() + action[..., 0].square())
    return 0.2 * height + 0.8 * pointed - effort


def make_task() -> Task:
    """Return the task; it starts within 0.1 rad of hanging."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    return Task(
        model=model,
        frame_skip=2,
        observation=lambda now: {"encoder": torch.cat([now.qpos, now.qvel], -1)},
        reward=_reward,
        reset=uniform_reset(model, 0.1),
        max_steps=STEPS,
    )


def make_system() -> System:
    """Return what the diagnosis is told of the robot.

    Effects on sensors are left out, as of an encoder that was checked: of a late command and late
    sensors logs cannot tell which, and a policy need not know.
    """
    noise = dict(zip(("hinge position", "hinge velocity"), NOISE, strict=True))
    effects = tuple(name for name, kind in CATALOGUE.items() if kind.channel != "sensing")
    return System(task=make_task(), physics=PHYSICS, prior=PRIOR, noise=noise, effects=effects)


def simulator(environments: int, *, seed: int) -> BatchedMujocoEnv:
    """Return the nominal simulator, on one thread."""
    return BatchedMujocoEnv(make_task(), environments, seed=seed, threads=1)


def observed(
    env: EnvBase, *, seed: int, randomizer: DomainRandomizer | None = None
) -> TransformedEnv:
    """Return the environment with the encoder's noise and what a policy sees of it.

    That is cosine and sine of the angle, and a tenth of the velocity, of the noisy encoder.

    Args:
        env: With `ApplyPhysics`, and effects if there are any.
        seed: Of the noise.
        randomizer: Draws the parameters, where the robot does not set them.
    """
    noise = ApplyEffect("sensor_noise", NOISE, key="encoder", seed=seed)
    features = UnaryTransform(["encoder"], ["observation"], fn=_features)
    drawn = [] if randomizer is None else [randomizer]
    chain = Compose(noise, features, *drawn, StepCounter(STEPS), RewardSum())
    return TransformedEnv(env, chain, auto_unwrap=True)


def _features(encoder: Tensor) -> Tensor:
    angle, velocity = encoder[..., :1], encoder[..., 1:]
    return torch.cat([angle.cos(), angle.sin(), velocity / 10.0], -1)


def real_robot(environments: int, *, seed: int) -> EnvBase:
    """Return what stands for the robot: its effect is there, its parameters are not set yet."""
    name, where, strength = TRUE_EFFECT
    env = simulator(environments, seed=seed)
    chain = Compose(ApplyPhysics(PHYSICS), ApplyEffect(name, {where: strength}))
    return TransformedEnv(env, chain)


def record(*, seed: int) -> TensorDictBase:
    """Return logs of the robot, one for each excitation of the library, ``[6, STEPS]``."""
    limit = make_task().model.actuator_ctrlrange[:, 1]
    rng = np.random.default_rng(seed_from(seed, "excitation"))
    waves = excitations(-limit / 2, limit / 2, steps=STEPS, dt=make_task().dt, generator=rng)
    commands = torch.from_numpy(np.stack(list(waves.values()))).float()
    noise_seed = seed_from(seed, "robot") % 2**31
    robot = SurrogateRobot(
        observed(real_robot(len(commands), seed=seed), seed=noise_seed),
        TRUE_PARAMETERS,
        max_steps=STEPS,
        measured=("encoder", "observation", "step_count"),
    )
    return robot.rollouts(ReplayActions(commands), episodes=len(commands), key=(seed, "logs"))


def logs_of(real: TensorDictBase, system: System) -> Sequence[Log]:
    """Return the robot's logs as a diagnosis reads them."""
    columns = {
        "time": (system.control_dt * torch.arange(real.shape[1])).double().expand(real.shape),
        "hinge position": real["encoder"][..., 0],
        "hinge velocity": real["encoder"][..., 1],
        "motor": real["action"][..., 0],
    }
    return read_logs(TensorDict(columns, batch_size=real.shape), system)


def returns_at_robot(policy: object, *, episodes: int) -> Tensor:
    """Return the return of every episode; initial states and noise are the same every time."""
    env = real_robot(episodes, seed=0)
    randomizer = DomainRandomizer(Grid(TRUE_PARAMETERS[None]))
    env = observed(env, seed=1_000_003, randomizer=randomizer)
    env.set_seed(1_000_003)
    with isolated("score"):
        return evaluate(env, policy, max_steps=STEPS)
