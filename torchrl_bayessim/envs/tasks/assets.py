"""Where the models of the known tasks are: in the packages that define the tasks."""

from __future__ import annotations

__all__ = ["gymnasium_model", "robotics_model"]

from importlib.resources import as_file, files

import mujoco


def _load(package: str, path: str) -> mujoco.MjModel:
    with as_file(files(package) / path) as file:
        return mujoco.MjModel.from_xml_path(str(file))


def gymnasium_model(name: str) -> mujoco.MjModel:
    """Return a model of Gymnasium's MuJoCo tasks."""
    return _load("gymnasium", f"envs/mujoco/assets/{name}")


def robotics_model(name: str) -> mujoco.MjModel:
    """Return a model of Gymnasium-Robotics."""
    return _load("gymnasium_robotics", f"envs/assets/{name}")
