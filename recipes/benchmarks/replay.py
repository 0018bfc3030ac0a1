"""How fast are logs replayed under many physics, and what does a hook cost?

Segments of Hopper-v5 under P parameter vectors: `Replay`, with a hook at every control step and at
every time step, against `mujoco.rollout` with one model per simulation, built beforehand, and the
same states, controls and threads; the replay's own time includes writing the parameters. Prints one
JSON line per case::

    python recipes/benchmarks/replay.py [parameters=16] [segments=32] [steps=25] [runs=7]
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np
import torch
from measuring import compare, options, report
from mujoco import rollout

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay import Replay


def main(*arguments: str) -> None:
    """Measure a replay with and without hooks."""
    given = options(list(arguments), parameters=16, segments=32, steps=25, runs=7, threads=2)
    count, size, steps = given["parameters"], given["segments"], given["steps"]
    torch.set_num_threads(1)
    torch.manual_seed(0)
    env = BatchedMujocoEnv("Hopper-v5", size)
    env.reset()
    action = torch.rand(size, steps, 3) * 2 - 1
    segments = {name: torch.from_numpy(env.stepper[name].copy()) for name in ("qpos", "qvel")}
    physics = MujocoPhysics("body_mass[torso]", "geom_friction[floor,0]")
    model = Replay(
        "Hopper-v5", {**segments, "action": action}, physics=physics, threads=given["threads"]
    )
    theta = torch.stack([torch.rand(count) * 2 + 2.5, torch.rand(count) + 0.5], -1)
    model(theta)
    models = [model.models.copy_of(p) for p in range(count) for _ in range(size)]
    data = [mujoco.MjData(models[0]) for _ in range(given["threads"])]
    pool = rollout.Rollout(nthread=given["threads"])
    start = [np.zeros((size, 1)), segments["qpos"].numpy(), segments["qvel"].numpy()]
    start = np.tile(np.concatenate(start, 1), (count, 1))
    held = np.tile(np.repeat(action.double().numpy(), 4, axis=1), (count, 1, 1))
    frames = count * size * steps

    def drag(now: object) -> dict[str, torch.Tensor]:
        return {"qfrc_applied": -0.1 * now.qvel}

    def replaying(**options: object) -> int:
        model(theta, **options)
        return frames

    def bare() -> int:
        pool.rollout(models, data, start, held)
        return frames

    cases = {
        "replay": replaying,
        "replay, hook every control step": lambda: replaying(hook=drag),
        "replay, hook every time step": lambda: replaying(hook=drag, every="time"),
        "mujoco.rollout": bare,
    }
    rates = compare(cases, runs=given["runs"])
    for name, values in rates.items():
        against = {"mujoco.rollout": rates["mujoco.rollout"]}
        report("replay", name, values, against=against, seed=0, **given)


if __name__ == "__main__":
    main(*sys.argv[1:])
