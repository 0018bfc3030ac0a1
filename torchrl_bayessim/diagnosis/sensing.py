"""What is measured of a simulation, beside what was measured of the robot: channels and sensors.

An effect on measurements is undone on the record, so that simulations start where the robot truly
was, and done to what is simulated, so that both are compared as the sensors show them.
"""

from __future__ import annotations

__all__ = ["Sensing"]

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..effects.effect import SensorEffect
from ..effects.sequence import measured_sequence, restored_sequence
from ..logs.system import System
from .segments import Segments
from .strengths import Strengths
from .tangent import Tangent

Array = NDArray[np.float64]


class Sensing:
    """The measured channels of a system.

    Args:
        system: The robot, its simulator and what was measured.
        tangent: The tangent space of its positions.

    Attributes:
        channels: Which of the ``2 nv`` tangent coordinates are measured, shape ``(C,)``.
    """

    def __init__(self, system: System, tangent: Tangent) -> None:
        self._system, self._tangent = system, tangent
        self.channels = np.array(system.channel_index, dtype=np.int64)

    def restored(self, segments: Segments, strengths: Strengths, count: int) -> Array | None:
        """Return true minus measured channels over the windows, ``(P, S, W, C)``, or nothing."""
        kinds = [(e, s) for e, s in strengths.items() if isinstance(e, SensorEffect)]
        if not kinds:
            return None
        measured = torch.from_numpy(self.values(segments.qpos, segments.qvel))
        true = measured.expand(count, *measured.shape).clone()
        time, robot = torch.from_numpy(segments.time), self._system.robot
        for effect, values in reversed(kinds):
            on = torch.from_numpy(values.any(1))
            if on.any():
                strength = torch.from_numpy(values)[on][:, None]
                true[on] = restored_sequence(effect, true[on], strength, robot, time=time)
        return (true - measured).numpy()

    def scattered(self, segments: Segments, strengths: Strengths, *, seed: int) -> Array | None:
        """Return true start states minus measured ones, drawn, ``(P, S, 2 nv)``, or nothing.

        What a random effect would have made of the record, had it been true, with the other sign.
        """
        kinds = [e for e in strengths if isinstance(e, SensorEffect) and e.random]
        if not kinds:
            return None
        at = segments.history
        measured = torch.from_numpy(self.values(segments.qpos, segments.qvel)[:, : at + 1])
        time = torch.from_numpy(segments.time[:, : at + 1])
        count = len(strengths[kinds[0]])
        steps = np.zeros((count, len(segments), 2 * self._tangent.size))
        for effect in kinds:
            strength = torch.from_numpy(strengths[effect])[:, None]
            robot = self._system.robot
            record = measured.expand(count, *measured.shape)
            seen = measured_sequence(effect, record, strength, robot, time=time, seed=seed)
            steps[..., self.channels] += (measured - seen)[:, :, at].numpy()
        return segments.freed(steps)

    def values(self, qpos: Array, qvel: Array) -> Array:
        """Return what the channels of hinges and slides hold, zero for the others."""
        values = np.zeros((*qpos.shape[:-1], len(self.channels)))
        robot = self._system.robot
        for c, (joint, kind) in enumerate(
            zip(robot.channel_joint, robot.channel_kind, strict=True)
        ):
            if joint >= 0 and kind == "position":
                values[..., c] = qpos[..., robot.qpos_index[joint]]
            elif joint >= 0 and kind == "velocity":
                values[..., c] = qvel[..., robot.dof_index[joint]]
        return values

    def compare(
        self,
        segments: Segments,
        simulated: Array,
        restored: Array | None,
        strengths: Strengths,
        *,
        seed: int = 0,
    ) -> Array:
        """Return measured minus simulated, ``(P, S, K, C)``; random effects from ``seed``."""
        nq = self._system.task.model.nq
        rows, checked = segments.rows, segments.checked - 1
        qpos, qvel = simulated[..., :nq], simulated[..., nq : nq + self._tangent.size]
        with np.errstate(invalid="ignore"):
            position = self._tangent.difference(qpos[:, :, checked], segments.qpos[:, rows])
        velocity = segments.qvel[:, rows] - qvel[:, :, checked]
        residual = np.concatenate([position, velocity], -1)[..., self.channels]
        kinds = [(e, s) for e, s in strengths.items() if isinstance(e, SensorEffect)]
        if restored is None or not kinds:
            return residual
        true = self.values(qpos, qvel)
        before = self.values(segments.qpos, segments.qvel)[:, : segments.history + 1]
        history = before + restored[:, :, : segments.history + 1]
        wrong = self._seen(segments, history, true, kinds, seed=seed) - true
        return residual - wrong[:, :, checked]

    def _seen(
        self,
        segments: Segments,
        history: Array,
        true: Array,
        kinds: Sequence[tuple[SensorEffect, Array]],
        *,
        seed: int,
    ) -> Array:
        """Return what sensors show of simulated values, given the true ones before the start."""
        record = torch.from_numpy(np.concatenate([history, true], axis=2))
        time = torch.from_numpy(segments.time[:, : record.shape[2]])
        robot = self._system.robot
        for effect, values in kinds:
            on = torch.from_numpy(values.any(1))
            if on.any():
                strength = torch.from_numpy(values)[on][:, None]
                record[on] = measured_sequence(
                    effect, record[on], strength, robot, time=time, seed=seed
                )
        return record[:, :, segments.history + 1 :].numpy()
