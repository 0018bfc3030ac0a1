"""A gap that all splits show plainly is one, though few segments say by how much."""

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.checked import checked_logs
from torchrl_bayessim.logs.system import System

CUBE = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 1"><freejoint name="free"/>
      <geom type="box" size=".05 .05 .05" mass=".4"/></body>
  </worldbody>
</mujoco>
"""
NOISE = 0.0005, 0.02


def tosses(model, *, unit):
    """Return a cube thrown to the ground four times, with lengths in a unit."""
    rows = []
    for seed in range(4):
        generator = np.random.default_rng(seed)
        data = mujoco.MjData(model)
        data.qpos[2], data.qvel[:] = 0.5, generator.uniform(-2, 2, 6)
        orientation = generator.standard_normal(4)
        data.qpos[3:] = orientation / np.linalg.norm(orientation)
        for _ in range(120):
            qpos = data.qpos + NOISE[0] * generator.standard_normal(7)
            qvel = data.qvel + NOISE[1] * generator.standard_normal(6)
            rows.append([*(qpos[:3] / unit), *qpos[3:], *(qvel[:3] / unit), *qvel[3:]])
            mujoco.mj_step(model, data, 2)
    seen = torch.tensor(np.array(rows)).reshape(4, 120, 13)
    return TensorDict({"qpos": seen[..., :7], "qvel": seen[..., 7:]}, batch_size=(4, 120))


def diagnosed(*, unit):
    system = System(task=Task(model=mujoco.MjModel.from_xml_string(CUBE), frame_skip=2))
    logs, findings = checked_logs(tosses(system.task.model, unit=unit), system)
    return diagnose(system, None, logs, effects=["gravity_tilt"], findings=findings)


def test_millimetres_of_a_free_body_are_no_noise():
    assert diagnosed(unit=1.0).verdict == "none"
    report = diagnosed(unit=1e-3)
    assert report.verdict == "unknown"
    assert "It is real" in str(report)
