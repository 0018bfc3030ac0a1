"""What a simulator with given parameters and effects would have measured, segment by segment.

``P`` candidates (parameters and effect strengths) times ``S`` segments are ``P × S`` simulations of
one batch: effects on commands and measurements act on the recorded sequences, effects on the model
once per candidate, effects on forces at every time step. What is returned is the residual
``y ⊖ ŷ``, in the tangent space, of the measured channels.
"""

from __future__ import annotations

__all__ = ["Predictor"]

import copy
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from ..effects.effect import ForceEffect, ModelEffect
from ..effects.fields import ModelFields
from ..envs.model_batch import ModelBatch
from ..envs.stepper import Stepper
from ..logs.system import System
from ..physics.dry_friction import FIELDS, follow_velocity
from .commands import commanded
from .segments import Segments
from .sensing import Sensing
from .stepwise import Stepwise, fewest_parts
from .strengths import Strengths, with_late_commands
from .tangent import Tangent

Array = NDArray[np.float64]
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
        self._stepper = Stepper(model, 1, drive=task.drive, threads=self._threads)
        self._stepwise = Stepwise(
            self._stepper, self._models, self.system.robot, dt=task.dt, substeps=substeps
        )

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
        task, at = self.system.task, segments.history
        count, size, horizon = len(theta), len(segments), segments.horizon
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
            pushed = rows[hooked].reshape(-1)
            self._stepwise.rollout(
                segments,
                {e: s[hooked] for e, s in strengths.items() if isinstance(e, ForceEffect)},
                rows=pushed,
                commands=whole[sequence[pushed]],
                outputs=simulated,
                parts=self.substeps if self.exact else fewest_parts(self.substeps, task.dt),
            )
        return simulated.reshape(count, size, horizon, -1)

    def _converted(self, actions: Array) -> Array:
        """Return the commands that the task makes of actions."""
        convert = self.system.task.command
        if convert is None:
            return actions
        return np.ascontiguousarray(convert(torch.from_numpy(actions)).detach().double().numpy())

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
