"""The batched tasks give Gymnasium's numbers, step for step, over whole episodes."""

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.catalogue import TASKS

gymnasium.register_envs(gymnasium_robotics)

N = 3
# Physics are compared bit for bit. What remains is the order of sums in observations and rewards:
# of NumPy and torch, of BLAS and the kernel in the Fetch velocities; Humanoid's centre of mass is
# summed by MuJoCo here and by NumPy there, then divided by dt = 0.015 s.
TOLERANCE = 1e-11
STATE = {
    "qpos": "qpos",
    "qvel": "qvel",
    "warmstart": "qacc_warmstart",
    "mocap_pos": "mocap_pos",
    "mocap_quat": "mocap_quat",
}


def originals(name):
    return [gymnasium.make(name).unwrapped for _ in range(N)]


def vary(env, envs):
    """Write the same differing masses, frictions and time steps to both."""
    for body in range(1, env.task.model.nbody):
        factor = 1.0 + 0.1 * np.arange(N)
        env.models.write("body_mass", (body,), env.task.model.body_mass[body] * factor)
    for geom in range(env.task.model.ngeom):
        friction = env.task.model.geom_friction[geom, 0] * (1.0 - 0.2 * np.arange(N))
        env.models.write("geom_friction", (geom, 0), friction)
    timestep = env.task.model.opt.timestep * (1.0 - 0.1 * np.arange(N))
    env.models.write("opt.timestep", (), timestep)
    env.models.refresh()
    for i, original in enumerate(envs):
        original.model.body_mass[:] *= 1.0 + 0.1 * i
        original.model.geom_friction[:, 0] *= 1.0 - 0.2 * i
        original.model.opt.timestep *= 1.0 - 0.1 * i
        mujoco.mj_setConst(original.model, mujoco.MjData(original.model))


def begin(env, envs):
    """Reset the originals, and start the batch in their states."""
    observed = [original.reset(seed=i)[0] for i, original in enumerate(envs)]
    components = {
        name: np.stack([getattr(original.data, name) for original in envs])
        for name in ("qpos", "qvel")
    }
    if hasattr(envs[0], "goal") and isinstance(observed[0], dict):
        components["goal"] = np.stack([original.goal for original in envs])
    return observed, env.place(components)


def same(observed, got, row):
    observed = observed if isinstance(observed, dict) else {"observation": observed}
    for name, value in observed.items():
        np.testing.assert_allclose(got[name][row].numpy(), value, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", TASKS)
def test_episodes_equal_the_original(name):
    env, envs = BatchedMujocoEnv(name, N, dtype=torch.float64), originals(name)
    vary(env, envs)
    observed, td = begin(env, envs)
    for i in range(N):
        same(observed[i], td, i)
    rng = np.random.default_rng(0)
    low, high = env.action_spec.low.numpy(), env.action_spec.high.numpy()
    alive = np.ones(N, dtype=bool)
    for step in range(env.max_steps):
        # small actions keep bodies up for a while; single precision, as policies act
        action = (min(1.0, 0.01 * (step + 1)) * rng.uniform(low, high)).astype(np.float32)
        td["action"] = torch.from_numpy(action)
        td = env.step(td)["next"]
        for i in np.flatnonzero(alive):
            original = envs[i]
            # Gymnasium squares actions in their own precision, we in double
            mine = action[i] if name.startswith("Fetch") else action[i].astype(np.float64)
            want, reward, terminated, _, _ = original.step(mine)
            same(want, td, i)
            np.testing.assert_allclose(td["reward"][i].item(), reward, rtol=0, atol=TOLERANCE)
            assert td["terminated"][i].item() == terminated
            assert td["truncated"][i].item() == (step == env.max_steps - 1)
            for component, array in STATE.items():
                mine = env.stepper[component][i]
                np.testing.assert_array_equal(mine, getattr(original.data, array).ravel())
            alive[i] = not terminated
        if not alive.any():
            break
    assert step >= 5  # enough to tell physics apart
