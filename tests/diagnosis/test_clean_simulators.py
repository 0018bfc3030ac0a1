"""Nothing is missing from a simulator whose parameters alone differ: dm_control's own cart-pole."""

import mujoco
import numpy as np
import pytest
import yaml
from dm_control import suite

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System

NOISE = {"x": 0.001, "th": 0.002, "xd": 0.01, "thd": 0.02}
MASSES = {"body_mass[cart]": [0.6, 1.6], "body_mass[pole_1]": [0.06, 0.16]}


def drawn(rng, *, friction):
    """Return an environment of the suite with masses from the prior."""
    env = suite.load("cartpole", "swingup", task_kwargs={"random": 0})
    model = env.physics.model
    for body, bounds in enumerate(MASSES.values(), 1):
        mass = rng.uniform(*bounds)
        model.body_inertia[body] *= mass / model.body_mass[body]
        model.body_mass[body] = mass
    model.dof_frictionloss[0] = friction
    mujoco.mj_setConst(model.ptr, mujoco.MjData(model.ptr))
    return env


def run(env, rng, *, closed):
    """Return rows t, x, th, xd, thd, u: a policy that holds the pole, or sines."""
    env.reset()
    data = env.physics.data
    with env.physics.reset_context():
        data.qpos[:] = rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3) if closed else np.pi
    frequency, phase = rng.uniform(0.3, 2.5, 4), rng.uniform(0, 6, 4)
    rows = []
    for k in range(200):
        x, th, xd, thd = *data.qpos, *data.qvel
        hold = 3 * th + 0.6 * thd + 0.3 * x + 0.5 * xd + 0.3 * rng.standard_normal()
        swing = 0.5 * np.sin(0.02 * np.pi * frequency * k + phase).sum() - 0.6 * x - 0.3 * xd
        u = np.clip(hold if closed else swing, -1, 1)
        measured = (x, th, xd, thd) + rng.standard_normal(4) * list(NOISE.values())
        rows.append([0.01 * k, *measured, u])
        env.step(np.array([u]))
    return np.array(rows)


def diagnosed(folder, *, closed, velocities, friction=0.0):
    rng = np.random.default_rng(7)
    env = drawn(rng, friction=friction)
    names = ["t", *NOISE, "u"]
    kept = [i for i, name in enumerate(names) if velocities or name not in {"xd", "thd"}]
    for i in range(8):
        header = ",".join(names[k] for k in kept)
        rows = run(env, rng, closed=closed)[:, kept]
        np.savetxt(folder / f"run{i}.csv", rows, delimiter=",", header=header, comments="")
    columns = {"time": "t", "qpos": {"slider": "x", "hinge_1": "th"}, "ctrl": {"slide": "u"}}
    if velocities:
        columns["qvel"] = {"slider": "xd", "hinge_1": "thd"}
    described = {
        "simulator": "dm_control:cartpole/swingup",
        "columns": columns,
        "parameters": MASSES,
        "noise": {name: NOISE[name] for name in NOISE if velocities or name in {"x", "th"}},
    }
    (folder / "system.yaml").write_text(yaml.safe_dump(described))
    system = System.load(folder / "system.yaml")
    return diagnose(system, None, read_logs(folder, system))


@pytest.mark.parametrize(("closed", "velocities"), [(True, False), (False, True)])
def test_nothing_is_missing(tmp_path, closed, velocities):
    report = diagnosed(tmp_path, closed=closed, velocities=velocities)
    assert report.verdict == "none"
    out = {(c.name, c.where) for c in report.candidates if c.status == "ruled_out"}
    assert {("coulomb_friction", "slider"), ("action_delay", "slide")} <= out


def test_friction_of_the_rail_is_found(tmp_path):
    report = diagnosed(tmp_path, closed=False, velocities=True, friction=1.0)
    assert [(e.name, e.where) for e in report.effects] == [("coulomb_friction", "slider")]
    assert report.effects[0].strength == pytest.approx(1.0, rel=0.05)
