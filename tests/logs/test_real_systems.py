"""The systems in recipes/systems: they load, and simulate the real logs as their signs demand.

The logs are not part of the project: TORCHRL_BAYESSIM_REALDATA names their folder.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_bayessim.logs.read import read_records
from torchrl_bayessim.logs.sanity import check, usable_logs
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay import Replay

SYSTEMS = Path(__file__).parents[2] / "recipes" / "systems"
NAMES = ["contactnets_cube", "dfki_simple_pendulum", "sage_so101_arm", "unitree_go2_legs"]
REAL = os.environ.get("TORCHRL_BAYESSIM_REALDATA", "")
needs_logs = pytest.mark.skipif(
    not Path(REAL, NAMES[0]).is_dir() or not REAL,
    reason="TORCHRL_BAYESSIM_REALDATA does not name the folder of the real logs",
)


@pytest.mark.parametrize("name", NAMES)
def test_systems_load(name):
    system = System.load(SYSTEMS / name / "system.yaml")
    assert (system.task.model.dof_frictionloss == 0).all()
    theta = system.prior.sample((1,), generator=torch.Generator().manual_seed(0))
    model = system.task.model
    still = {
        "qpos": torch.from_numpy(model.qpos0)[None],
        "qvel": torch.zeros(1, model.nv),
        "action": torch.zeros(1, 5, model.nu),
    }
    moved = Replay(system.task, still, physics=system.physics, threads=1)(theta)
    assert moved["qpos"].isfinite().all()
    assert (SYSTEMS / name / "README.md").read_text().startswith("#")


def load(name):
    system = System.load(SYSTEMS / name / "system.yaml")
    records = read_records(Path(REAL, name), system)
    findings = check(records, system)
    return system, {log.name: log for log in usable_logs(records, system, findings)}, findings


def rollout_error(system, logs, physics, theta):
    """Return the open-loop error of positions over whole logs, ``(P,)``, the mean of their rms."""
    errors = []
    for log in logs:
        start = {"qpos": log.qpos[:1], "qvel": log.qvel[:1], "action": log.ctrl[None, :-1]}
        out = Replay(system.task, start, physics=physics, threads=1)(torch.tensor(theta))
        errors.append((out["qpos"][:, 0] - log.qpos[1:]).square().mean((1, 2)).sqrt())
    return np.mean([error.numpy() for error in errors], axis=0)


@needs_logs
def test_the_pendulum_has_dry_friction_and_one_push():
    system, logs, findings = load("dfki_simple_pendulum")
    (error,) = [f for f in findings if f.severity == "error"]
    assert (error.kind, error.file) == ("push", "ilqr_anomaly.csv")
    time = 0.02 * np.array(error.rows)
    assert time[0] < 0.45  # the velocity jumps from 0.3 to 0.45 s after the beginning
    assert time[1] > 0.3
    assert time[1] - time[0] < 0.3
    physics = MujocoPhysics("body_mass[bob]", "dof_frictionloss[hinge]")
    held_out = [logs[f"{name}.csv"] for name in ("energyshaping", "sac", "ilqr")]
    without, with_friction = rollout_error(
        system, held_out, physics, [[0.683, 0.0], [0.683, 0.165]]
    )
    assert with_friction < 0.08
    assert with_friction < without / 4


@needs_logs
def test_the_legs_have_dry_friction():
    system, logs, _ = load("unitree_go2_legs")
    legs = ("FL", "FR", "RL", "RR")
    physics = MujocoPhysics(
        **{
            part: tuple(f"dof_frictionloss[{leg}_{part}]" for leg in legs)
            for part in ("hip", "thigh", "calf")
        }
    )
    theta = [[0.0, 0.0, 0.0], [0.31, 0.29, 1.0]]
    without, with_friction = rollout_error(system, logs.values(), physics, theta)
    assert without < 0.05
    assert with_friction < without / 2.5


@needs_logs
def test_the_cube_slides_more_than_the_model():
    system, logs, findings = load("contactnets_cube")
    assert not [f for f in findings if f.severity == "error"]
    assert len(logs) == 80
    physics = MujocoPhysics(friction=("geom_friction[table,0]", "geom_friction[cube,0]"))
    tosses = list(logs.values())[::8]
    nominal, slippery = rollout_error(system, tosses, physics, [[1.0], [0.2]])
    assert slippery < nominal / 2


@needs_logs
def test_the_servo_follows_its_commands():
    system, logs, findings = load("sage_so101_arm")
    assert not [f for f in findings if f.severity == "error"]
    log = logs["step_response.csv"]
    assert float(log.velocity_gain[0]) > 0
    theta = [[300.0, 30.0], [800.0, 80.0]]
    errors = rollout_error(system, [log], system.physics, theta)
    assert (errors < 0.02).all()
