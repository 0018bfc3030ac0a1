"""What a simulator with given parameters and effects would have measured, segment by segment.

``P`` candidates (parameters and effect strengths) times ``S`` segments are ``P × S`` simulations of
one batch: effects on commands and measurements act on the recorded sequences, effects on the model
once per candidate, effects on forces at every time step. What is returned is the residual
``y ⊖ ŷ``, in the tangent space, of the measured channels.
"""

from __future__ import annotations

__all__ = ["Predictor", "fewest_parts"]

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from ..effects.effect import (
    ForceEffect,
    Memory,
    ModelEffect,
)
from ..effects.fields import ModelFields
from ..effects.forcing import Forcing
from ..effects.sequence import forces_in_stages
from ..envs.bias_forces import BeforeStep, BiasForces
from ..envs.held_command import HeldCommand
from ..envs.model_batch import ModelBatch
from ..envs.stepper import Stepper
from ..envs.task import Readings
from ..logs.system import System
from ..physics.dry_friction import FIELDS, follow_velocity
from .commands import commanded
from .segments import Segments
from .sensing import Sensing
from .strengths import Strengths, with_late_commands
from .tangent import Tangent

Array = NDArray[np.float64]
_HELD = 0.010  # s that forces may be held while searching
_ROWS = 30_000  # simulations per native call: bounds the memory, and costs nothing


class _Batch:
    """What physics needs of an environment: its models and their number."""

    def __init__(self, models: ModelBatch) -> None:
        self._models = models

    @property
    def models(self) -> ModelBatch:
        return self._models

    @property
    def batch_size(self) -> torch.Size:
        return torch.Size([self._models.num_envs])


class Predictor:
    """Simulates segments under many candidates.

    Args:
        system: The robot, its simulator and what was measured.
        substeps: Time steps per control step; default the task's.
        threads: Threads; default all cores that this process may use.

    Attributes:
        system: The robot.
        tangent: The tangent space of its positions.
        sensing: Its measured channels.
        substeps: Time steps per control step.
        steps: Time steps simulated so far.
        exact: Whether forces follow the state at every time step, as in an environment, and not
            only every 10 ms, which is enough to tell effects apart.
        realisation: Seed of random effects.
    """

    def __init__(
        self, system: System, *, substeps: int | None = None, threads: int | None = None
    ) -> None:
        self.system = system
        self.tangent = Tangent(system.task.model)
        self.sensing = Sensing(system, self.tangent)
        self.steps = 0
        self.exact = False
        self.realisation = 0
        self._threads = threads
        self._forcing = Forcing(system.robot)
        self._divide(substeps or system.task.frame_skip)

    def _divide(self, substeps: int) -> None:
        """Take so many time steps per control step."""
        self.substeps = substeps
        task = self.system.task
        model = copy.copy(task.model)
        model.opt.timestep = task.dt / substeps
        follow_velocity(model, but=self._own_friction(model))
        if not self.colliding:
            # looking for contacts that cannot be takes an eighth of the time
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        if model.ntree == 1:
            # one tree is one island at most: looking for it changes no bit, and takes a twelfth
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        self._models = ModelBatch(model, 1)
        # from the beginning, since what one table overrides stays in a thread's model after it
        self._entries = {
            name: np.array([self._models.column(name, (d,)) for d in range(self.tangent.size)])
            for name in ("dof_frictionloss", "dof_damping")
        }
        self._stepper = Stepper(model, 1, drive=task.drive, threads=self._threads)
        self._bias = BiasForces(self._stepper)

    def _own_friction(self, model: mujoco.MjModel) -> list[int]:
        """Return the degrees of freedom whose dry friction is among the parameters."""
        physics = self.system.physics
        groups = [] if physics is None else physics.entries(model)
        entries = [entry for group in groups for entry in group if entry.field in FIELDS]
        return [int(place[0]) for entry in entries for place in entry.indices]

    @property
    def colliding(self) -> bool:
        """Whether anything can touch anything."""
        model = self.system.task.model
        colliding = (model.geom_contype | model.geom_conaffinity).any()
        return bool(colliding or model.npair or model.nflex)

    def exactly(self, substeps: int | None = None) -> None:
        """From now on let forces follow the state at each time step.

        Args:
            substeps: Time steps per control step from now on; default the task's.
        """
        self.exact = True
        substeps = substeps or self.system.task.frame_skip
        if self.substeps != substeps:
            self._divide(substeps)
            self.__dict__.pop("finer", None)

    def divided(self, substeps: int) -> Predictor:
        """Return the same with another number of time steps per control step."""
        other = Predictor(self.system, substeps=substeps, threads=self._threads)
        other.exact, other.realisation = self.exact, self.realisation
        return other

    @cached_property
    def finer(self) -> Predictor:
        """The same with half the time step, to see what the time step does."""
        return self.divided(2 * self.substeps)

    def residuals(
        self,
        segments: Segments,
        theta: Array,
        strengths: Strengths | None = None,
        offsets: Array | None = None,
    ) -> Array:
        """Return measured minus simulated.

        Args:
            segments: What to replay.
            theta: Parameters, shape ``(P, D)``.
            strengths: Of the effects that are on somewhere.
            offsets: Steps from the measured start states, in the tangent space, ``(P, 2 nv)``
                or for each segment ``(P, S, 2 nv)``.

        Returns:
            Shape ``(P, S, K, C)``; NaN where a simulation diverged.
        """
        strengths = with_late_commands(strengths or {}, self.system.robot)
        chunk = max(1, _ROWS // len(segments))
        parts = []
        for begin in range(0, len(theta), chunk):
            part = slice(begin, begin + chunk)
            some = {e: s[part] for e, s in strengths.items() if s[part].any()}
            steps = None if offsets is None else offsets[part]
            parts.append(self._residuals(segments, theta[part], some, steps))
        return np.concatenate(parts)

    def states(
        self,
        segments: Segments,
        theta: Array,
        strengths: Strengths | None = None,
        offsets: Array | None = None,
    ) -> tuple[Array, Array]:
        """Return simulated positions and velocities, ``(P, S, H, nq)`` and ``(P, S, H, nv)``.

        Arguments are those of `residuals`.
        """
        strengths = with_late_commands(strengths or {}, self.system.robot)
        restored = self.sensing.restored(segments, strengths, len(theta))
        simulated = self._simulate(segments, theta, strengths, restored=restored, offsets=offsets)
        nq = self.system.task.model.nq
        return simulated[..., :nq], simulated[..., nq : nq + self.tangent.size]

    def _residuals(
        self, segments: Segments, theta: Array, strengths: Strengths, offsets: Array | None
    ) -> Array:
        restored = self.sensing.restored(segments, strengths, len(theta))
        simulated = self._simulate(segments, theta, strengths, restored=restored, offsets=offsets)
        return self.sensing.compare(segments, simulated, restored, strengths, seed=self.realisation)

    def _simulate(
        self,
        segments: Segments,
        theta: Array,
        strengths: Strengths,
        *,
        restored: Array | None,
        offsets: Array | None = None,
    ) -> Array:
        """Return what follows from the start states, shape ``(P, S, H, outputs)``."""
        count, size, horizon, at = len(theta), len(segments), segments.horizon, segments.history
        actions, sequence = commanded(
            self.system.robot, segments, strengths, count, seed=self.realisation
        )
        whole = self._converted(actions)
        commands = np.ascontiguousarray(whole[:, at:])
        self._write(theta, strengths)
        stepper = self._stepper
        if stepper.num_envs != count * size:
            stepper.resize(count * size)
        stepper.use(self._models.repeated(size))
        stepper.state[:] = stepper.initial
        step = np.zeros((count, size, 2 * self.tangent.size))
        if restored is not None:
            step[..., self.sensing.channels] = restored[:, :, at]
            step = segments.freed(step)
        if segments.touching is not None:
            step += segments.touching.step
        if offsets is not None:
            step += offsets if offsets.ndim == 3 else offsets[:, None]
        half = self.tangent.size
        start = self.tangent.displace(segments.qpos[:, at], step[..., :half])
        stepper["qpos"][:] = start.reshape(count * size, -1)
        stepper["qvel"][:] = (segments.qvel[:, at] + step[..., half:]).reshape(count * size, -1)
        stepper["time"][:] = np.tile(segments.time[:, at], count)[:, None]
        simulated = np.full((count * size, horizon, stepper.output_size), np.nan)
        hooked = np.zeros(count, dtype=bool)
        for effect, values in strengths.items():
            if isinstance(effect, ForceEffect):
                hooked |= values.any(1)
        rows = np.arange(count * size).reshape(count, size)
        if stepper.welded:
            self._place_welds()
        self.steps += count * size * horizon * self.substeps
        free = rows[~hooked].reshape(-1)
        if len(free):
            stepper.rollout(
                commands,
                substeps=self.substeps,
                sequence=sequence,
                rows=free,
                outputs=simulated,
            )
        if hooked.any():
            some = {e: s[hooked] for e, s in strengths.items() if isinstance(e, ForceEffect)}
            pushed = rows[hooked].reshape(-1)
            self._push(
                segments,
                some,
                rows=pushed,
                commands=whole[sequence[pushed]],
                simulated=simulated,
            )
        return simulated.reshape(count, size, horizon, -1)

    def _converted(self, actions: Array) -> Array:
        """Return the commands that the task makes of actions."""
        convert = self.system.task.command
        if convert is None:
            return actions
        return np.ascontiguousarray(convert(torch.from_numpy(actions)).detach().double().numpy())

    def _push(
        self,
        segments: Segments,
        strengths: Mapping[ForceEffect, Array],
        *,
        rows: NDArray[np.int64],
        commands: Array,
        simulated: Array,
    ) -> None:
        """Simulate ``rows`` with forces of their own, one time step after the other.

        Of commands there are those of the whole windows, up to the horizon.
        """
        stepper, models = self._stepper, self._stepper.models
        active = [
            (e, torch.from_numpy(np.repeat(strengths[e], len(segments), axis=0)))
            for e in forces_in_stages(strengths)
        ]
        memories = self._warm(segments, active, commands)
        commands = commands[:, segments.history :]
        nominal = {name: models.table[rows][:, at] for name, at in self._entries.items()}
        command = np.empty((stepper.num_envs, 1, commands.shape[2]))
        alive = np.ones(len(rows), dtype=bool)
        parts = self.substeps if self.exact else fewest_parts(self.substeps, self.system.task.dt)
        held = self.system.task.dt / parts
        for t in range(segments.horizon):
            kept = HeldCommand(stepper, rows)
            ctrl = torch.from_numpy(kept.controls(commands[:, t]))
            for left in reversed(range(parts)):
                state = {n: torch.from_numpy(stepper[n][rows]) for n in ("qpos", "qvel", "time")}
                now = BeforeStep(partial(self._bias_of, rows), **state, ctrl=ctrl)
                added, memories = self._forcing(active, memories, now, timestep=held)
                for name, at in self._entries.items():
                    if name in added:
                        models.table[np.ix_(rows, at)] = nominal[name] + added[name].numpy()
                if "qfrc_applied" in added:
                    stepper["qfrc_applied"][rows] = added["qfrc_applied"].numpy()
                command[rows, 0] = kept.again(commands[:, t])
                if "ctrl" in added:
                    command[rows, 0, : ctrl.shape[1]] += added["ctrl"].numpy()
                going = rows[alive]
                stepper.rollout(
                    command,
                    substeps=self.substeps // parts,
                    rows=going,
                    outputs=stepper.outputs,
                    ends=not left,
                )
                alive[alive] = stepper.status[going] == 0
            simulated[rows[alive], t] = stepper.outputs[rows[alive], 0]

    def _bias_of(self, rows: NDArray[np.int64], some: NDArray[np.int64] | None = None) -> Tensor:
        """Return ``qfrc_bias`` of rows, or of some among them."""
        return self._bias(rows if some is None else rows[some])

    def _place_welds(self) -> None:
        """Let the first command step from where the welded body is in each start state.

        As it stood at the beginning of the last time step, where nothing evaluates it anew.
        """
        stepper, drive = self._stepper, self.system.task.drive
        starts = stepper.state.copy()
        if not drive.pinned:
            back = -float(self.system.task.model.opt.timestep) * stepper["qvel"]
            stepper["qpos"][:] = self.tangent.displace(stepper["qpos"], back)
        stepper.begin()
        starts[:, stepper.components["weld_pose"]] = stepper["weld_pose"]
        stepper.state[:] = starts

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
                _, told = self._forcing(some, told, measured(k), timestep=self.system.task.dt)
            for i, memory in zip(kept, told, strict=True):
                memories[i] = memory
        return memories

    def _write(self, theta: Array, strengths: Strengths) -> None:
        """Set the model entries of every candidate: parameters first, then effects on top."""
        models = self._models
        models.resize(len(theta))
        models.restore()
        everyone = torch.ones(len(theta), dtype=torch.bool)
        if self.system.physics is not None:
            batch: Any = _Batch(models)
            values = torch.from_numpy(np.ascontiguousarray(theta))
            empty = TensorDict(batch_size=batch.batch_size)
            self.system.physics.write(batch, values, mask=everyone, tensordict=empty)
        fields = ModelFields(models)
        for effect, values in strengths.items():
            if isinstance(effect, ModelEffect):
                effect.write(fields, torch.from_numpy(values), self.system.robot)
        fields.finish()


def fewest_parts(substeps: int, dt: float) -> int:
    """Return into how many equal parts a control step is divided, each 10 ms at most."""
    fewest = max(1, int(np.ceil(dt / _HELD - 1e-9)))
    whole = (n for n in range(fewest, substeps + 1) if substeps % n == 0)
    return next(whole, substeps)
