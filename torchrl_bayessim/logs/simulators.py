"""The simulator that a description names, as a task.

``robot.xml``                    an MJCF file beside the description
``gymnasium:Hopper-v5``          a MuJoCo task of Gymnasium
``dm_control:cartpole/swingup``  a task of the DeepMind Control Suite

An MJCF file may include files and meshes of its own folder only, so that a description from
elsewhere cannot read the rest of the disk; see `model_files`.
"""

from __future__ import annotations

__all__ = ["simulator_task"]


from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from ..envs.task import Task
from ..envs.tasks.catalogue import known_task
from ..errors import message
from .model_files import check_model_files, inside
from .room import room


def simulator_task(simulator: str, folder: Path, control_dt: float | None) -> Task:
    """Return the task that a description's ``simulator`` names.

    Args:
        simulator: As above.
        folder: Where the description is.
        control_dt: Seconds between actions, a multiple of the model's time step; ``None`` for that
            of the named task.

    Raises:
        ValueError: There is no such simulator, its file cannot be compiled or leaves the folder, or
            ``control_dt`` is not a multiple of the time step.

    Example:
        >>> simulator_task("gymnasium:Hopper-v5", Path(), 0.016).frame_skip
        8
    """
    kind, colon, name = simulator.partition(":")
    if not colon:
        if control_dt is None:
            raise ValueError(message("control_dt beside an MJCF file", "none"))
        return at_control_step(Task(model=_compiled(folder, simulator), frame_skip=1), control_dt)
    if kind == "gymnasium":
        task = known_task(name)
    elif kind == "dm_control":
        task = _suite_task(name)
    else:
        expected = "an MJCF file, gymnasium:NAME or dm_control:DOMAIN/TASK"
        raise ValueError(message(expected, simulator))
    return task if control_dt is None else at_control_step(task, control_dt)


def at_control_step(task: Task, control_dt: float) -> Task:
    """Return the task with as many time steps per control step as ``control_dt`` has.

    Raises:
        ValueError: That is not a whole number from 1 to 10,000.
    """
    timestep = task.model.opt.timestep
    if timestep > 0 and control_dt < 1e6 and control_dt > _MOST_STEPS * timestep:
        expected = f"at most {_MOST_STEPS} time steps in a control step of {control_dt:g} s"
        hint = "a larger <option timestep>, or a smaller control_dt"
        raise ValueError(message(expected, f"a time step of {timestep:g} s", hint=hint))
    steps = round(control_dt / timestep) if 0 < control_dt < 1e6 and timestep > 0 else 0
    if steps < 1 or abs(steps * timestep - control_dt) > 1e-6 * control_dt:
        hint = "change the model's <option timestep> or control_dt"
        expected = f"control_dt to be a multiple of the model's time step {timestep:g} s"
        raise ValueError(message(expected, control_dt, hint=hint))
    return replace(task, frame_skip=steps)


def _suite_task(name: str) -> Task:
    from dm_control import suite  # slow to import

    names = [f"{domain}/{task}" for domain, task in suite.ALL_TASKS]
    if name not in names:
        expected = "a task of the control suite as dm_control:DOMAIN/TASK"
        raise ValueError(message(expected, name, available=names))
    domain, task = name.split("/")
    env = suite.load(domain, task)
    model = env.physics.model.ptr
    return at_control_step(Task(model=model, frame_skip=1), env.control_timestep())


def _compiled(folder: Path, name: str) -> mujoco.MjModel:
    folder = folder.resolve()
    path = inside(folder, folder / name, name)
    if not path.is_file():
        available = sorted(p.name for p in folder.glob("*.xml"))
        raise ValueError(message("a file that exists", name, available=available))
    check_model_files(folder, path)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(message(f"an MJCF file that compiles in {name}", reason)) from None
    _check_numbers(model, name)
    _check_iterations(model, name)
    _check_room(model, name)
    return model


def _check_numbers(model: mujoco.MjModel, name: str) -> None:
    """Raise a ValueError if the model holds NaN or a number that no simulation survives."""
    parts = {"option": model.opt, "statistic": model.stat, "model": model}
    for part, owner in parts.items():
        for key in dir(owner):
            value = getattr(owner, key) if not key.startswith("_") else None
            if isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f":
                wrong = np.asarray(value)[~(np.abs(value) < _LARGEST)]
                if wrong.size:
                    got = f"{key} {wrong.flat[0]:g} of the {part}"
                    expected = f"numbers below {_LARGEST:g} in {name}"
                    raise ValueError(message(expected, got))


def _check_room(model: mujoco.MjModel, name: str) -> None:
    """Raise a ValueError if the memory that the model reserves is too little where it begins."""
    data = mujoco.MjData(model)
    with room(name):
        mujoco.mj_forward(model, data)
    full = mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL
    if any(data.warning[int(kind)].number for kind in full):
        expected, hint = f"room for all contacts and constraints of {name}", "more <size memory>"
        raise ValueError(message(expected, f"{model.narena} bytes", hint=hint))


def _check_iterations(model: mujoco.MjModel, name: str) -> None:
    """Raise a ValueError if a solver may go on for what would not end."""
    kinds = "", "ls_", "noslip_", "ccd_", "sdf_"
    for key in (f"{kind}iterations" for kind in kinds):
        value = getattr(model.opt, key)
        if value > _MOST_STEPS:
            expected = f"{key} of at most {_MOST_STEPS} in the <option> of {name}"
            raise ValueError(message(expected, value))


_LARGEST = 1e15
_MOST_STEPS = 10_000  # of time in a control step, and of a solver in a time step
