"""Simulations with forces that follow the state: one time step after the other, all at once.

Friction, springs, backlash and whatever else depends on where a joint is and how fast are worked
out from the state before each time step, or from that every 10 ms while effects are compared.
"""

from __future__ import annotations

__all__ = ["Stepwise", "fewest_parts"]

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..effects.effect import ForceEffect, Memory
from ..effects.forcing import Forcing
from ..effects.robot import Robot
from ..effects.sequence import forces_in_stages
from ..envs.additions import ADDED
from ..envs.bias_forces import BeforeStep, BiasForces
from ..envs.held_command import HeldCommand
from ..envs.model_batch import ModelBatch
from ..envs.stepper import Stepper
from ..envs.task import Readings
from .segments import Segments

Array = NDArray[np.float64]
_HELD = 0.010  # s that forces may be held while searching


class Stepwise:
    """Steps some of a stepper's simulations under forces of their own.

    Args:
        stepper: Of all simulations.
        models: Its table of models; friction and damping get entries there from the beginning,
            since what one table overrides stays in a thread's model after it.
        robot: Where effects act.
        dt: Of a control step, s.
        substeps: Time steps of that.
    """

    def __init__(
        self, stepper: Stepper, models: ModelBatch, robot: Robot, *, dt: float, substeps: int
    ) -> None:
        self._stepper, self._dt, self._substeps = stepper, dt, substeps
        self._entries = {
            name: np.array([models.column(name, (d,)) for d in range(models.model.nv)])
            for name in ADDED
        }
        self._forcing = Forcing(robot)
        self._bias = BiasForces(stepper)

    def rollout(
        self,
        segments: Segments,
        strengths: Mapping[ForceEffect, Array],
        *,
        rows: NDArray[np.int64],
        commands: Array,
        outputs: Array,
        parts: int,
    ) -> None:
        """Simulate from the states that the stepper is in.

        Args:
            segments: What is replayed.
            strengths: Of effects, for each candidate ``(P, targets)``.
            rows: The simulations, those of a candidate's segments one after the other.
            commands: For each of them, of the whole windows, up to the horizon.
            outputs: Of all simulations, ``(N, H, outputs)``: written until one diverges.
            parts: Into how many a control step is divided, in each of which forces are held.
        """
        stepper, held = self._stepper, self._dt / parts
        active = [
            (e, torch.from_numpy(np.repeat(strengths[e], len(segments), axis=0)))
            for e in forces_in_stages(strengths)
        ]
        memories = self._warm(segments, active, commands)
        commands = commands[:, segments.history :]
        nominal = self._nominal(rows)
        command = np.empty((stepper.num_envs, 1, commands.shape[2]))
        alive = np.ones(len(rows), dtype=bool)
        for t in range(segments.horizon):
            kept = HeldCommand(stepper, rows)
            ctrl = torch.from_numpy(kept.controls(commands[:, t]))
            for left in reversed(range(parts)):
                state = {n: torch.from_numpy(stepper[n][rows]) for n in ("qpos", "qvel", "time")}
                now = BeforeStep(partial(self._bias_of, rows), **state, ctrl=ctrl)
                added, memories = self._forcing(active, memories, now, timestep=held)
                self._add(added, rows, nominal)
                command[rows, 0] = kept.again(commands[:, t])
                if "ctrl" in added:
                    command[rows, 0, : ctrl.shape[1]] += added["ctrl"].numpy()
                going = rows[alive]
                stepper.rollout(
                    command,
                    substeps=self._substeps // parts,
                    rows=going,
                    outputs=stepper.outputs,
                    ends=not left,
                )
                alive[alive] = stepper.status[going] == 0
            outputs[rows[alive], t] = stepper.outputs[rows[alive], 0]

    def _nominal(self, rows: NDArray[np.int64]) -> dict[str, Array]:
        """Return friction and damping of the models, which forces add to."""
        table = self._stepper.models.table
        return {name: table[rows][:, at] for name, at in self._entries.items()}

    def _add(
        self,
        added: Mapping[str, Tensor],
        rows: NDArray[np.int64],
        nominal: Mapping[str, Array],
    ) -> None:
        """Set friction, damping and forces of the next time step."""
        table = self._stepper.models.table
        for name, at in self._entries.items():
            if name in added:
                table[np.ix_(rows, at)] = nominal[name] + added[name].numpy()
        if "qfrc_applied" in added:
            self._stepper["qfrc_applied"][rows] = added["qfrc_applied"].numpy()

    def _bias_of(self, rows: NDArray[np.int64], some: NDArray[np.int64] | None = None) -> Tensor:
        """Return ``qfrc_bias`` of rows, or of some among them."""
        return self._bias(rows if some is None else rows[some])

    def _warm(
        self, segments: Segments, active: Sequence[tuple[ForceEffect, Tensor]], commands: Array
    ) -> list[Memory]:
        """Run hidden states along the measured motion and commands that lead to the start."""
        count = len(commands) // len(segments)
        relative = self._stepper.relative
        moved = np.flatnonzero(relative >= 0)

        def measured(k: int) -> Readings:
            values = {"qpos": segments.qpos, "qvel": segments.qvel}
            values["time"] = segments.time[..., None]
            # what depends on it remembers nothing
            values["qfrc_bias"] = np.zeros_like(segments.qvel)
            tiled = {n: np.tile(v[:, k], (count, 1)) for n, v in values.items()}
            tiled["ctrl"] = commands[:, k, : len(relative)].copy()
            tiled["ctrl"][:, moved] += tiled["qpos"][:, relative[moved]]
            return Readings(**{n: torch.from_numpy(v) for n, v in tiled.items()})

        first = measured(0)
        memories = self._forcing.start(active, first)
        if any(memories):
            kept = self._forcing.lasting(active, memories, first)
            some, told = [active[i] for i in kept], [memories[i] for i in kept]
            for k in range(segments.history):
                _, told = self._forcing(some, told, measured(k), timestep=self._dt)
            for i, memory in zip(kept, told, strict=True):
                memories[i] = memory
        return memories


def fewest_parts(substeps: int, dt: float) -> int:
    """Return into how many equal parts a control step is divided, each 10 ms at most."""
    fewest = max(1, int(np.ceil(dt / _HELD - 1e-9)))
    whole = (n for n in range(fewest, substeps + 1) if substeps % n == 0)
    return next(whole, substeps)
