"""Which commands arrived, of those that were sent: decided on one after the other.

A lost command leaves the last one that arrived in its place. Every command of a log is decided on
by the ``H`` steps that follow from a measured state, in which all ``2^H`` patterns of losses are
compared by their density (see `loss_law`); the first steps are settled by what is likeliest
whatever happens after them, the others decided on again from the next start.
"""

from __future__ import annotations

__all__ = ["Arrivals", "fewer"]

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp

from ..logs.log import Log
from .loss_law import LossLaw
from .loss_segments import command_slopes, steps_of
from .objective import Point
from .preparation import Prepared
from .segments import cut

Array = NDArray[np.float64]
_LARGEST = 1_000_000  # control steps simulated to decide on all commands
_SOME = "which commands arrived was decided on in {} of {} runs: all would have taken long"
_SIMULATED = 18  # for each row and actuator, at most


@dataclass(frozen=True, eq=False)
class Arrivals:
    """What decides whether commands arrived.

    Attributes:
        prepared: Logs with the commands that were sent.
        point: The simulator.
        actuators: Those whose commands are lost together.
        law: How losses come about.
    """

    prepared: Prepared
    point: Point
    actuators: Sequence[int]
    law: LossLaw

    def decided(self, known: Mapping[str, Sequence[Log]]) -> dict[str, list[Log]]:
        """Return the logs of each split with the commands that are likely to have arrived.

        Args:
            known: With those that were taken to have arrived; what others do is linear from there.
        """
        sent = self.prepared.logs
        return {name: self._decided(part, known[name]) for name, part in sent.items()}

    def _decided(self, sent: Sequence[Log], known: Sequence[Log]) -> list[Log]:
        number = [i for i, log in enumerate(sent) if len(log) > steps_of(self.prepared)]
        if not number:
            return list(known)
        effects = _Overlapping.of(self, [sent[i] for i in number], [known[i] for i in number])
        found = list(known)
        for i, log in enumerate(number):
            ctrl = effects.arrived(i, self.law)
            found[log] = replace(sent[log], ctrl=torch.from_numpy(ctrl))
        return found


@dataclass(frozen=True, eq=False)
class _Overlapping:
    """Segments that overlap, and what commands do in them.

    Attributes:
        sent: Commands of each log, shape ``(T, nu)``.
        known: Those from which changes are counted.
        actuators: Those whose commands are lost together.
        log: Which log each segment is from, shape ``(S,)``.
        start: The row at which each starts, shape ``(S,)``.
        left: Innovations, shape ``(S, M)``.
        slopes: What a change of each command does, shape ``(S, M, A H)``.
        steps: ``H``.
    """

    sent: Sequence[Array]
    known: Sequence[Array]
    actuators: Sequence[int]
    log: NDArray[np.int64]
    start: NDArray[np.int64]
    left: Array
    slopes: Array
    steps: int

    @classmethod
    def of(cls, arrivals: Arrivals, sent: Sequence[Log], known: Sequence[Log]) -> _Overlapping:
        """Simulate segments of some logs, and what a change of each command does to them."""
        prepared, point = arrivals.prepared, arrivals.point
        history = max(prepared.sets["train"].segments.history, 1)
        steps = steps_of(prepared)
        pieces = cut(known, steps, history=history, stride=_settled(steps))
        prior, noise = prepared.predictor.system.prior, prepared.noise
        objective = prepared.mode.objective(
            prepared.predictor, prior, pieces, z=point.z, noise=noise
        )
        left = objective([point])[0]
        commands = [log.ctrl.numpy() for log in sent]
        rows = pieces.start[:, None] + np.arange(steps)
        told = np.stack([commands[i][k] for i, k in zip(pieces.log, rows, strict=True)])
        at, slopes = history, []
        for a in arrivals.actuators:
            now = pieces.ctrl[:, at : at + steps, a]
            before = pieces.ctrl[:, at - 1 : at + steps - 1, a]
            others = np.where(now == told[..., a], before, told[..., a])
            slopes.append(command_slopes(objective, point, left, a, others=others))
        return cls(
            sent=commands,
            known=[log.ctrl.numpy() for log in known],
            actuators=list(arrivals.actuators),
            log=pieces.log,
            start=pieces.start,
            left=left,
            slopes=np.concatenate(slopes, -1),
            steps=steps,
        )

    def arrived(self, log: int, law: LossLaw) -> Array:
        """Return the commands of a log that are likely to have arrived, ``(T, nu)``."""
        sent, found = self.sent[log][:, self.actuators], self.sent[log].copy()
        steps, settled, patterns = self.steps, _settled(self.steps), _patterns(self.steps)
        held, mine = sent[0], np.flatnonzero(self.log == log)
        ends = [*self.start[mine[1:]].tolist(), int(self.start[mine[-1]]) + steps]
        for segment, end in zip(mine, ends, strict=True):
            at = int(self.start[segment])
            paths = _paths(sent[at : at + steps], held)
            logs = self._density(int(segment), paths, law)
            if at == 0:  # nothing is known from before the first
                logs = np.where(patterns[:, 0], -np.inf, logs)
            if segment == mine[-1]:
                chosen = int(logs.argmax())
            else:
                first = logsumexp(logs.reshape(1 << settled, -1), axis=1)
                chosen = int(first.argmax()) << (steps - settled)
            found[at:end, self.actuators] = paths[chosen, : end - at]
            held = paths[chosen, end - at - 1]
        return found

    def _density(self, segment: int, paths: Array, law: LossLaw) -> Array:
        """Return the log density of a segment under each pattern of losses, ``(B,)``."""
        at, lost = int(self.start[segment]), _patterns(self.steps).sum(1)
        now = self.known[int(self.log[segment])][at : at + self.steps, self.actuators]
        change = (paths - now).transpose(0, 2, 1).reshape(len(paths), -1)
        squares = ((self.left[segment] + change @ self.slopes[segment].T) ** 2).sum(-1)
        prior = lost * np.log(law.share) + (self.steps - lost) * np.log1p(-law.share)
        return np.asarray(prior - 0.5 * squares / law.scatter)


def _settled(steps: int) -> int:
    """Return how many of the steps of a segment are decided on."""
    return max(1, steps // 2)


@cache
def _patterns(steps: int) -> NDArray[np.bool_]:
    """Return every pattern of losses, the first steps vary slowest, ``(2^H, H)``."""
    return np.array(list(product((False, True), repeat=steps)))


def _paths(sent: Array, held: Array) -> Array:
    """Return what arrives of commands under every pattern, ``(B, H, A)``.

    Args:
        sent: Shape ``(H, A)``.
        held: The one that arrived last before them, shape ``(A,)``.

    Example:
        >>> paths = _paths(np.arange(1.0, 9.0)[:, None], np.zeros(1))
        >>> paths[0b10010000, :, 0]  # the first and the fourth are lost
        array([0., 2., 3., 3., 5., 6., 7., 8.])
    """
    patterns = _patterns(len(sent))
    now = np.broadcast_to(held, (len(patterns), len(held)))
    paths = np.empty((len(patterns), *sent.shape))
    for t, command in enumerate(sent):
        now = np.where(patterns[:, t, None], now, command)
        paths[:, t] = now
    return paths


def fewer(prepared: Prepared, actuators: int) -> Prepared:
    """Return what was prepared, with some of the runs where to decide on all would take long."""
    every = prepared.logs
    rows = sum(len(log) for part in every.values() for log in part)
    share = _LARGEST / (_SIMULATED * rows * actuators)
    if share >= 1.0:
        return prepared
    some = {}
    for name, part in every.items():
        count = min(max(2, int(share * len(part))), len(part))
        some[name] = [part[i] for i in np.linspace(0, len(part) - 1, count).round().astype(int)]
    kept, total = (sum(map(len, parts.values())) for parts in (some, every))
    return replace(prepared, logs=some).alarmed(_SOME.format(kept, total))
