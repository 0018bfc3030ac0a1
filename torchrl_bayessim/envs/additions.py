"""Forces that a simulator lacks, added before every time step instead of every control step.

An *addition* is a function of the states before a time step, tensors ``(*batch, size)``: ``qpos``,
``qvel``, ``time``, ``ctrl`` and ``qfrc_bias`` (`BeforeStep`). It returns what is added in that time
step alone to ``ctrl`` (seen by the additions that follow), to ``qfrc_applied``, or to the model's
``dof_frictionloss`` and ``dof_damping``; whatever else has set these stays in force underneath.
Where there was no dry friction, what is added follows the velocity (`dry_friction`).
"""

from __future__ import annotations

__all__ = ["ADDED", "Addition", "rollout_with", "steps_with"]

from collections.abc import Callable, Iterable, Mapping
from functools import partial

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..physics.dry_friction import FIELDS, follow_velocity, may_follow, reference
from .bias_forces import BeforeStep, BiasForces, bias_force
from .held_command import HeldCommand
from .model_batch import ModelBatch
from .stepper import Stepper

Addition = Callable[[BeforeStep], Mapping[str, Tensor]]
ADDED = "dof_frictionloss", "dof_damping"  # of a model, which an addition may raise
_Array = NDArray[np.float64]
_Entry = tuple[str, tuple[int, ...]]


def rollout_with(
    stepper: Stepper,
    additions: Iterable[Addition],
    commands: _Array,
    *,
    substeps: int,
    bias: BiasForces | None = None,
) -> _Array:
    """Apply sequences of commands, as `Stepper.rollout` does, with additions at every time step.

    Args:
        stepper: The simulations; those that diverge stay in the state before that time step.
        additions: In their order.
        commands: Shape ``(N, T, C)``; what is added to them, to their controls.
        substeps: Time steps per command.
        bias: Of the simulations, where they are stepped more than once; default its own.

    Returns:
        The outputs after each command, shape ``(N, T, M)``; NaN after a divergence.
    """
    nu, resistance = len(stepper.relative), _Resistance(stepper.models)
    applied = stepper["qfrc_applied"].copy()
    bias, rows = bias or BiasForces(stepper), np.arange(stepper.num_envs)
    outputs = np.full((*commands.shape[:2], stepper.output_size), np.nan)
    after = np.empty((stepper.num_envs, 1, stepper.output_size))
    try:
        for t in range(commands.shape[1]):
            held = HeldCommand(stepper, np.arange(stepper.num_envs))
            control = torch.from_numpy(held.controls(commands[:, t]))
            for left in reversed(range(substeps)):
                names = "qpos", "qvel", "time"
                state = {name: torch.from_numpy(stepper[name]) for name in names}
                added = _total(additions, BeforeStep(bias, ctrl=control, **state))
                stepper["qfrc_applied"][:] = applied + added.get("qfrc_applied", 0.0)
                resistance.add(added)
                command = held.again(commands[:, t]).copy()
                command[:, :nu] += added.get("ctrl", 0.0)
                stepper.rollout(
                    command[:, None], substeps=1, rows=rows, outputs=after, ends=not left
                )
                rows = rows[stepper.status[rows] == 0]
            outputs[rows, t] = after[rows, 0]
    finally:
        stepper["qfrc_applied"][:] = applied
        resistance.restore()
    return outputs


class _Resistance:
    """Dry friction and damping of models, and what is added to them.

    Args:
        models: The models, of ``N`` simulations.
    """

    def __init__(self, models: ModelBatch) -> None:
        self._models = models
        dofs = range(models.model.nv)
        self._own = {f: [models.read(f, (d,)) for d in dofs] for f in ADDED}
        self._before: dict[_Entry, _Array] = {}

    def add(self, added: Mapping[str, _Array]) -> None:
        """Set what there is with what is added in this time step, ``(N, nv)`` of each field."""
        for field, own in self._own.items():
            for d, value in enumerate(own if field in added else ()):
                self._models.write(field, (d,), value + added[field][:, d])
        rubbed = added.get("dof_frictionloss", np.zeros((1, 0))).any(0)
        for d in np.flatnonzero(rubbed).tolist():
            if ("dof_solref", (d, 0)) not in self._before:
                self._follow(d)

    def _follow(self, dof: int) -> None:
        """Let dry friction follow the velocity where there is none, and nobody has said how."""
        models = self._models
        own = self._own["dof_frictionloss"][dof]
        free = may_follow(own, models.read("dof_solref", (dof, 0)))
        for (field, column), value in reference(float(models.model.opt.timestep)).items():
            entry = field, (dof, *column)
            self._before[entry] = models.read(*entry)
            models.write(*entry, np.where(free, value, self._before[entry]))

    def restore(self) -> None:
        """Set what was there before."""
        entries = {(f, (d,)): v for f, own in self._own.items() for d, v in enumerate(own)}
        for entry, value in (entries | self._before).items():
            if not np.array_equal(self._models.read(*entry), value):
                self._models.write(*entry, value)


def steps_with(
    model: mujoco.MjModel, data: mujoco.MjData, additions: Iterable[Addition], *, count: int
) -> None:
    """Step one simulation ``count`` times under its present controls, with additions each time."""
    control, applied = data.ctrl.copy(), data.qfrc_applied.copy()
    base = {field: getattr(model, field).copy() for field in {*ADDED, *FIELDS}}
    followed = False
    try:
        for _ in range(count):
            state = {n: torch.from_numpy(getattr(data, n).copy()) for n in ("qpos", "qvel")}
            time = torch.tensor([data.time], dtype=torch.float64)
            bias = partial(bias_force, model, data)
            now = BeforeStep(bias, ctrl=torch.from_numpy(control), time=time, **state)
            added = _total(additions, now)
            data.ctrl[:] = control + added.get("ctrl", 0.0)
            data.qfrc_applied[:] = applied + added.get("qfrc_applied", 0.0)
            if "dof_frictionloss" in added and not followed:
                follow_velocity(model)
                followed = True
            for field in ADDED:
                getattr(model, field)[:] = base[field] + added.get(field, 0.0)
            mujoco.mj_step(model, data)
    finally:
        data.ctrl[:] = control
        data.qfrc_applied[:] = applied
        for field, values in base.items():
            getattr(model, field)[:] = values


def _total(additions: Iterable[Addition], now: BeforeStep) -> dict[str, _Array]:
    """Return the sum of what all additions add."""
    total: dict[str, _Array] = {}
    for addition in additions:
        for name, value in addition(now).items():
            total[name] = total.get(name, 0.0) + value.numpy()
            if name == "ctrl":
                now.ctrl = now.ctrl + value
    return total
