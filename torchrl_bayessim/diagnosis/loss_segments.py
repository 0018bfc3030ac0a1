"""Short segments in which values may have been lost, under every pattern of a few losses.

Effects of commands are nearly linear in them over so few steps, so every pattern is made of one
simulation per step, in which the command of that step is the one before it: of one loss that is
what happened, whatever the drive does with commands. Those of samples are the simulated values.
"""

from __future__ import annotations

__all__ = ["LossSegments", "command_slopes", "loss_segments", "steps_of"]

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..effects.action import PacketDrop
from .loss_law import LossLaw, Tried
from .objective import Objective, Point, Unit, strengths_of
from .preparation import Prepared
from .segments import cut

Array = NDArray[np.float64]
Patterns = Sequence[tuple[bool, ...]]
_STEPS = 8  # of a segment, at most
_TOGETHER = 4  # losses in a segment, at most
_MOST = {"train": 90, "validation": 45, "test": 45}  # segments of so many steps
_NUDGE, _SAME = 0.2, 0.01  # of the largest command, and of that: a change that is none


@dataclass(frozen=True, eq=False)
class LossSegments:
    """Short segments of a split.

    Attributes:
        objective: Evaluates them.
        point: The simulator.
        left: Its innovations, shape ``(S, M)``.
    """

    objective: Objective
    point: Point
    left: Array

    @classmethod
    def of(cls, objective: Objective, point: Point) -> LossSegments:
        """Return the segments of an objective in a simulator."""
        return cls(objective, point, objective([point])[0])

    def at(self, point: Point) -> LossSegments:
        """Return the segments in another simulator."""
        return self.of(self.objective, point)

    @property
    def colliding(self) -> bool:
        """Whether anything of the robot may touch anything."""
        return self.objective.predictor.colliding

    @property
    def without(self) -> Tried:
        """The segments without losses."""
        squares = (self.left**2).mean(-1)[None]
        return Tried(squares, np.zeros(1, dtype=np.int64), self.objective.segments.horizon)

    def tried(self, unit: Unit) -> Tried:
        """Return the segments under every pattern of losses."""
        targets, steps = unit.targets, self.objective.segments.horizon
        commands = isinstance(unit.effect, PacketDrop)
        patterns = _patterns(steps if commands else 1 + steps)
        of = self._of_commands if commands else self._of_samples
        parts = [of(target, patterns) for target in targets]  # lost together
        columns, changes = (np.concatenate(part, -1) for part in zip(*parts, strict=True))
        squares = _squares(self.left, columns, changes)
        return Tried(squares, np.array([sum(p) for p in patterns]), len(patterns[0]))

    def lost(self, unit: Unit, law: LossLaw) -> Array:
        """Return how likely each sample of a unit was lost, the start's first, ``(S, 1 + H)``."""
        patterns = np.array(_patterns(1 + self.objective.segments.horizon))
        return law.likely(self.tried(unit))[:-1].T @ patterns.astype(np.float64)

    @cached_property
    def _known(self) -> dict[int, Array]:
        """Slopes by actuator."""
        return {}

    @cached_property
    def _simulated(self) -> Array:
        """What all channels would show, shape ``(S, H, C)``."""
        predictor = self.objective.predictor
        theta = self.objective.theta(self.point.z[None])
        strengths = strengths_of([self.point], predictor.system.robot)
        qpos, qvel = predictor.states(self.objective.segments, theta, strengths)
        return np.nan_to_num(predictor.sensing.values(qpos[0], qvel[0]))

    def _of_commands(self, actuator: int, patterns: Patterns) -> tuple[Array, Array]:
        """Return what a change of each command does, ``(S, M, T)``, and changes, ``(B, S, T)``."""
        segments = self.objective.segments
        at, steps = segments.history, segments.horizon
        sent = segments.ctrl[:, at - 1 : at + steps, actuator]
        changes = [sent[:, _last(lost)] - sent[:, 1:] for lost in patterns]
        return self._slopes(actuator, sent), np.stack(changes)

    def _slopes(self, actuator: int, sent: Array) -> Array:
        """Return what a change of each command of an actuator does, ``(S, M, T)``."""
        if actuator not in self._known:
            self._known[actuator] = command_slopes(
                self.objective, self.point, self.left, actuator, others=sent[:, :-1]
            )
        return self._known[actuator]

    def _of_samples(self, channel: int, patterns: Patterns) -> tuple[Array, Array]:
        """Return the same of samples, the start's first."""
        objective, segments = self.objective, self.objective.segments
        predictor, at = objective.predictor, segments.history
        sensing = predictor.sensing
        first = sensing.values(segments.qpos[:, at], segments.qvel[:, at])[:, channel]
        shown = np.c_[first, self._simulated[..., channel]]
        # a start that was not renewed is where the robot was a step before
        offsets = np.zeros((1, len(segments), 2 * predictor.tangent.size))
        offsets[0, :, sensing.channels[channel]] = shown[:, 1] - shown[:, 0]
        start = objective([self.point], segments.freed(offsets))[0] - self.left
        columns = objective.whitening.inverse[:, :, channel :: len(sensing.channels)]
        begun = np.ones(len(segments))
        changes = [  # what was measured, minus what would have been shown
            np.c_[begin * begun, shown[:, 1:] - shown[:, _last(lost)]] for begin, *lost in patterns
        ]
        return np.concatenate([start[..., None], columns], -1), np.stack(changes)


def command_slopes(
    objective: Objective, point: Point, left: Array, actuator: int, *, others: Array
) -> Array:
    """Return what a change of each command of an actuator does, ``(S, M, H)``.

    Args:
        objective: Segments of ``H`` steps.
        point: The simulator.
        left: Its innovations, ``(S, M)``.
        actuator: Its number.
        others: The commands that each may be changed to, ``(S, H)``: slopes are those of chords.
    """
    segments, at = objective.segments, objective.segments.history
    least = _NUDGE * float(objective.predictor.system.robot.command_scale[actuator])
    now = segments.ctrl[:, at : at + segments.horizon, actuator]
    nudge = others - now
    nudge = np.where(np.abs(nudge) < _SAME * least, -least * np.sign(now), nudge)
    nudge = np.where(nudge == 0, -least, nudge)
    count, steps = nudge.shape
    each = segments.take(np.tile(np.arange(count), steps))
    ctrl = each.ctrl.copy().reshape(steps, *segments.ctrl.shape)
    every = np.arange(steps)
    ctrl[every, :, at + every, actuator] += nudge.T
    raw = objective.along(replace(each, ctrl=ctrl.reshape(each.ctrl.shape))).raw([point])
    raw = raw.reshape(steps, count, *raw.shape[2:])
    moved = objective.innovations([point] * steps, raw)
    return np.moveaxis((moved - left) / nudge.T[..., None], 0, -1)


def steps_of(prepared: Prepared) -> int:
    """Return how many steps a segment has: no more than contacts leave of the effects there."""
    return min(_STEPS, prepared.horizon)


def loss_segments(prepared: Prepared) -> dict[str, LossSegments]:
    """Return short segments of every split, compared after each of their steps."""
    prior, point = prepared.predictor.system.prior, Point(prepared.nominal.point.z)
    history = max(prepared.sets["train"].segments.history, 1)
    found, steps = {}, steps_of(prepared)
    for name, logs in prepared.logs.items():
        most = _MOST[name] * _STEPS // steps
        pieces = cut(logs, steps, history=history, most=most, burn_in=history)
        objective = prepared.mode.objective(
            prepared.predictor, prior, pieces, z=point.z, noise=prepared.noise
        )
        found[name] = LossSegments.of(objective, point)
    return found


def _squares(left: Array, columns: Array, changes: Array) -> Array:
    """Return mean squares of ``left + columns @ changes``, ``(B, S)``.

    Args:
        left: Shape ``(S, M)``.
        columns: Shape ``(S, M, T)``.
        changes: Shape ``(B, S, T)``.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> left, columns, changes = (rng.normal(size=n) for n in ((2, 5), (2, 5, 3), (4, 2, 3)))
        >>> direct = ((left + np.einsum("smt,bst->bsm", columns, changes)) ** 2).mean(-1)
        >>> bool(np.allclose(_squares(left, columns, changes), direct))
        True
    """
    inner, gram = np.einsum("smt,sm->st", columns, left), columns.mT @ columns
    both = np.einsum("bst,bst->bs", changes, np.einsum("bst,stu->bsu", changes, gram))
    total = (left**2).sum(-1) + 2 * np.einsum("bst,st->bs", changes, inner) + both
    return np.maximum(total, 0.0) / left.shape[-1]


def _patterns(values: int) -> Patterns:
    """Return the patterns of a few losses among so many values, none first."""
    some = [c for count in range(_TOGETHER + 1) for c in combinations(range(values), count)]
    return [tuple(value in lost for value in range(values)) for lost in some]


def _last(lost: Sequence[bool]) -> list[int]:
    """Return for every step the one whose value is there, counted from the one before the first."""
    last = [0]
    for step, missing in enumerate(lost, 1):
        last.append(last[-1] if missing else step)
    return last[1:]
