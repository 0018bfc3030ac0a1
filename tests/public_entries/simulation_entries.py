"""Simulators, their physics, robots and the loop."""

import torch
from entry import Entry
from makers import (
    PENDULUM,
    PRIOR,
    cartpole,
    first,
    loop,
    randomized,
    replay,
    robot,
    rows,
    segments,
    statistics,
    theta_rows,
    written,
)
from torchrl.envs import TransformedEnv

import torchrl_bayessim as package
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv

STEPS = {"env": "object", "statistics": "object", "randomizer": "object"}
COUNTS = ("pairs", "max_steps", "trajectories")
LOOPS = dict.fromkeys(("horizon", "episodes", "rounds", "checkpoint_every"), "count")

ENTRIES = {
    "simulate": Entry(
        package.simulate,
        lambda: {
            **randomized(),
            "policy": None,
            "statistics": statistics(),
            "pairs": 2,
            "max_steps": 3,
            "trajectories": 1,
            "seed": 0,
            "collectors": None,
            "progress": False,
        },
        {**STEPS, **dict.fromkeys(COUNTS, "count"), "policy": "object or none"},
    ),
    "AttributePhysics": Entry(
        lambda name: written(package.AttributePhysics(name), CartPoleEnv(2), theta_rows()),
        lambda: {"name": "length"},
        {"name": "name"},
    ),
    "AttributePhysics.write": Entry(
        lambda theta: written(package.AttributePhysics("length"), CartPoleEnv(2), theta),
        lambda: {"theta": theta_rows()},
        {"theta": "rows of theta"},
        carried=True,
    ),
    "MujocoPhysics": Entry(
        lambda name: written(
            package.MujocoPhysics(name), package.BatchedMujocoEnv(PENDULUM, 2), 9 * theta_rows()
        ),
        lambda: {"name": "body_mass[pole]"},
        {"name": "name"},
    ),
    "MujocoPhysics.write": Entry(
        lambda theta: written(
            package.MujocoPhysics("body_mass[pole]"),
            package.BatchedMujocoEnv(PENDULUM, 2),
            theta,
        ),
        lambda: {"theta": theta_rows()},
        {"theta": "rows of theta"},
        carried=True,
    ),
    "StatePhysics": Entry(
        lambda name, group: package.StatePhysics(name, group=group),
        lambda: {"name": "m", "group": "params"},
        {"name": "string", "group": "key"},
    ),
    "ApplyPhysics": Entry(
        lambda **given: TransformedEnv(CartPoleEnv(2), package.ApplyPhysics(**given)),
        lambda: {"physics": package.AttributePhysics("length"), "key": "theta"},
        {"physics": "object", "key": "key"},
    ),
    "DomainRandomizer": Entry(
        lambda **given: cartpole(package.DomainRandomizer(**given)).reset(),
        lambda: {
            "source": PRIOR,
            "key": "theta",
            "names": ("length",),
            "first_environment": None,
            "pool": None,
        },
        {"source": "object", "key": "key", "pool": "count or none", "names": "names or none"},
    ),
    "DomainRandomizer.pin": Entry(
        lambda theta: package.DomainRandomizer(PRIOR).pin(theta),
        lambda: {"theta": [0.5]},
        {"theta": "parameters"},
    ),
    "ApplyEffect": Entry(
        lambda effect, strength: TransformedEnv(
            package.BatchedMujocoEnv(PENDULUM, 2), package.ApplyEffect(effect, strength)
        ),
        lambda: {"effect": "action_bias", "strength": 0.1},
        {"effect": "name", "strength": "strength"},
    ),
    "BatchedMujocoEnv": Entry(
        package.BatchedMujocoEnv,
        lambda: {
            "task": PENDULUM,
            "num_envs": 2,
            "seed": 0,
            "threads": None,
            "max_steps": None,
            "dtype": torch.float32,
        },
        {
            "task": "name",
            "num_envs": "count",
            "threads": "count or none",
            "max_steps": "count or none",
            "dtype": "object",
        },
    ),
    "BatchedMujocoEnv.place": Entry(
        lambda **given: package.BatchedMujocoEnv(PENDULUM, 2).place(**given),
        lambda: {"components": {"qpos": torch.zeros(2, 2)}, "mask": None},
        {"components": "components", "mask": "mask or none"},
    ),
    "BatchedMujocoEnv.open_loop": Entry(
        lambda **given: package.BatchedMujocoEnv(PENDULUM, 2).open_loop(**given),
        lambda: {"actions": torch.zeros(2, 3, 1)},
        {"actions": "parameters"},
    ),
    "SurrogateRobot": Entry(
        package.SurrogateRobot,
        lambda: {"env": cartpole(), "theta": [0.7], "max_steps": 3, "measured": ("observation",)},
        {"env": "object", "theta": "hidden parameters", "max_steps": "count", "measured": "names"},
    ),
    "SurrogateRobot.rollouts": Entry(
        lambda **given: robot().rollouts(**given),
        lambda: {"policy": None, "episodes": 2, "key": (0,)},
        {"policy": "object or none", "episodes": "count"},
    ),
    "RecordedLogs": Entry(
        package.RecordedLogs,
        lambda: {"trajectories": rows(), "measured": ("observation",), "action_key": "action"},
        {"trajectories": "rows", "measured": "names", "action_key": "name"},
    ),
    "RecordedLogs.rollouts": Entry(
        lambda **given: package.RecordedLogs(rows()).rollouts(**given),
        lambda: {"policy": None, "episodes": 2, "key": (0,)},
    ),
    "Replay": Entry(
        package.Replay,
        lambda: {
            "task": PENDULUM,
            "segments": segments(),
            "physics": None,
            "outputs": ("qpos", "qvel"),
            "threads": None,
            "dt": None,
        },
        {
            "task": "name",
            "segments": "segments",
            "physics": "object or none",
            "outputs": "names of outputs",
            "threads": "count or none",
            "dt": "rate or none",
        },
    ),
    "Replay.__call__": Entry(
        replay(),
        lambda: {"theta": torch.tensor([[5.0]]), "hook": None, "every": "control"},
        {"theta": "parameters or none", "hook": "function or none"},
    ),
    "SimToRealLoop": Entry(
        lambda **given: first(package.SimToRealLoop(**given)),
        loop,
        {
            **STEPS,
            **LOOPS,
            "learner": "object",
            "robot": "object",
            "refinement": "object",
            "updates": "count or zero",
            "shared_batches": "count or zero",
            "prior_share": "share",
        },
    ),
    "SimToRealLoop.load_state_dict": Entry(
        lambda state: package.SimToRealLoop(**loop()).load_state_dict(state),
        lambda: {"state": package.SimToRealLoop(**loop()).state_dict()},
        {"state": "state"},
    ),
}
