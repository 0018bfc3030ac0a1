"""What is handed over, and what is sealed.

The diagnosis is given one folder per case: ``system.yaml``, the nominal model and CSV files. The
labels are in one file beside them, whose SHA-256 is printed before the first diagnosis starts.
"""

from __future__ import annotations

__all__ = ["digest", "handed_over", "label", "unseen"]

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from .cases import Case
from .coordinates import positions
from .plant import Motion
from .robots import ROBOTS, Robot, nominal_model

_POSE = "x", "y", "z", "qw", "qx", "qy", "qz"  # of a free joint
_TWIST = "vx", "vy", "vz", "wx", "wy", "wz"


def handed_over(case: Case) -> dict[str, str]:
    """Return the files that the diagnosis may see, by name."""
    robot = ROBOTS[case.plan.robot]
    model = nominal_model(robot)
    actuators = [model.actuator(a).name or f"actuator{a}" for a in range(model.nu)]
    columns: dict[str, Any] = {
        "time": "t",
        "qpos": _columns(model, "q", _POSE),
        "ctrl": {command: f"u_{command}" for command in robot.commands or actuators},
    }
    if case.velocities:
        columns["qvel"] = _columns(model, "v", _TWIST)
    system: dict[str, Any] = {
        "simulator": robot.simulator,
        "control_dt": robot.control_dt,
        "columns": columns,
        "parameters": {entry: list(bounds) for entry, bounds in case.priors.items()},
        "effects": "all" if case.effects is None else list(case.effects),
    }
    if case.noise is not None:
        system["noise"] = dict(zip(_channels(columns), map(float, case.noise), strict=False))
    files = {"system.yaml": yaml.safe_dump(system, sort_keys=False)}
    if robot.simulator == "robot.xml":
        files["robot.xml"] = robot.xml
    return files | _logs(case.motions, columns=columns, dt=robot.control_dt, model=model)


def _columns(
    model: mujoco.MjModel, kind: str, of_free: Sequence[str]
) -> dict[str, str | list[str]]:
    """Return the columns of every joint: one, or those of a free joint."""
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    names = [model.joint(j).name for j in range(model.njnt)]
    return {
        name: [f"{kind}_{name}_{axis}" for axis in of_free] if free[j] else f"{kind}_{name}"
        for j, name in enumerate(names)
    }


def _flat(columns: Mapping[str, str | list[str]]) -> list[str]:
    return [name for c in columns.values() for name in ([c] if isinstance(c, str) else c)]


def _channels(columns: Mapping[str, Any]) -> list[str]:
    """Return what the measured tangent coordinates are called: their columns, but for rotations."""
    channels: list[str] = []
    for joint, names in columns["qpos"].items():
        turns = [f"{joint} rotation {axis}" for axis in "xyz"]
        channels += [names] if isinstance(names, str) else [*names[:3], *turns]
    return channels + _flat(columns.get("qvel", {}))


def unseen(case: Case) -> bytes:
    """Return what is sealed with the labels, as a compressed file of arrays.

    Noise-free motions with new inputs, for the true shrinkage, and when the causes act in the runs
    that are handed over.
    """
    arrays = {f"clean{i}": m.clean for i, m in enumerate(case.unseen)}
    arrays |= {f"acts{i}": m.acts for i, m in enumerate(case.motions)}
    arrays |= {f"ctrl{i}": m.ctrl for i, m in enumerate(case.unseen)}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _logs(
    motions: Sequence[Motion], *, columns: dict, dt: float, model: mujoco.MjModel
) -> dict[str, str]:
    header = ["t", *_flat(columns["qpos"]), *_flat(columns.get("qvel", {}))]
    header += columns["ctrl"].values()
    files = {}
    for i, motion in enumerate(motions):
        time = dt * np.arange(len(motion.ctrl))[:, None]
        y, v = np.split(motion.measured, 2, axis=1)
        q = np.array([positions(model, row) for row in y])
        rows = np.concatenate([time, q, *([v] if "qvel" in columns else []), motion.ctrl], 1)
        text = ",".join(header) + "\n"
        text += "\n".join(",".join(f"{x:.9g}" for x in row) for row in rows) + "\n"
        files[f"run{i:02d}.csv"] = text
    return files


def label(case: Case) -> dict[str, Any]:
    """Return what is true of a case."""
    return {
        **asdict(case.plan),
        "truths": [
            asdict(truth) | {"places": _places(ROBOTS[case.plan.robot], truth.joint)}
            for truth in case.truths
        ],
        "theta": case.theta,
        "noise": case.real_noise.tolist(),
        "detectability": case.detectability,
        "excitation": case.excitation,
        "velocities": case.velocities,
        "runs": len(case.motions),
        "steps": len(case.motions[0].ctrl),
        "noise_told": case.noise is not None,
    }


def _places(robot: Robot, joint: str) -> list[str]:
    """Return what a joint, its actuators and its body are called; a command, as it is."""
    if joint == "all":
        return []
    if joint in robot.commands:
        return [joint]
    model = nominal_model(robot)
    number = model.joint(joint).id
    driven = [a for a in range(model.nu) if model.actuator_trnid[a, 0] == number]
    actuators = [model.actuator(a).name or f"actuator{a}" for a in driven]
    return [joint, *actuators, model.body(int(model.jnt_bodyid[number])).name]


def digest(path: Path) -> str:
    """Return a file's SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
