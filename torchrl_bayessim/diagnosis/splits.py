"""Which logs models are fitted on, judged on, and tested on.

The data are split by trajectory: fits and screening see the training logs, the choice of effects
the validation logs too, and the test logs are opened once, for the figures that are reported.
"""

from __future__ import annotations

__all__ = ["dealt_anew", "few", "split", "stretch"]

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle, pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from ..logs.log import Log

Array = NDArray[np.float64]
_PIECE = 0.25  # of the median log's length, below which it is a piece of one
_AS_LONG = 1.25  # ratio of two lengths that count as one
_APART = 3  # runs from which each split has one of its own
_DEAL = "train", "test", "validation", "train", "train", "test", "validation", "train"
# where little shows what is missing, it is to be found before it can be tested
_AGAIN = "train", "validation", "test", "train", "train", "validation", "test", "train"
_SHOWS = 1.5  # mean squared innovation of a log in which something is missing
_FAR, _PLENTY = 1.5, 6.0  # times what is missing in any log that trains; what is enough to fit


def split(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return training, validation and test logs.

    From the longest to the shortest, and among those about as long from the widest motion to the
    least, of every four logs the first and last train, one tests, one validates: what acts in wide
    motion only should act in each split. Pieces that are much shorter than the others train: over
    them no error grows. Fewer than three logs are each divided in time: half, a quarter, a quarter.
    """
    whole, pieces = _whole(logs)
    if len(whole) >= _APART:
        parts = _dealt(_ordered(whole))
    else:
        parts = _dealt([])
        for log in whole:
            ends = 0, len(log) // 2, 3 * len(log) // 4, len(log)
            for name, (begin, end) in zip(parts, pairwise(ends), strict=True):
                parts[name].append(stretch(log, begin, end))
    parts["train"] += pieces
    return parts


def _whole(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """Return the logs, and those that are pieces, much shorter than the others."""
    least = _PIECE * float(np.median([len(log) for log in logs])) if logs else 0.0
    return [log for log in logs if len(log) >= least], [log for log in logs if len(log) < least]


def _ordered(logs: Sequence[Log]) -> list[Log]:
    """Return the longest first; of those about as long, what moves and commands most."""
    peaks = np.array([torch.cat([log.ctrl, log.qvel], 1).abs().amax(0).numpy() for log in logs])
    width = (peaks / np.maximum(peaks.max(0), 1e-12)).mean(1)
    length = np.round(np.log([len(log) for log in logs]) / np.log(_AS_LONG))
    return [logs[at] for at in np.lexsort((-width, -length))]


def stretch(log: Log, begin: int, end: int) -> Log:
    """Return some rows of a log, the last of which is before ``end``."""
    part = slice(begin, end)
    arrays = {n: getattr(log, n)[part] for n in ("time", "qpos", "qvel", "ctrl")}
    if log.uncertainty is not None:
        arrays["uncertainty"] = log.uncertainty[part]
    return replace(
        log,
        name=f"{log.name} [{begin}:{end}]",
        first_row=log.first_row + begin,
        touching=None if log.touching is None else log.touching.take(np.arange(begin, end)),
        **arrays,
    )


def few(logs: Sequence[Log]) -> bool:
    """Return whether there are too few logs for each split to have one of its own."""
    return len(_whole(logs)[0]) < _APART


def dealt_anew(
    parts: Mapping[str, list[Log]], left: Mapping[str, Array]
) -> Mapping[str, list[Log]]:
    """Return the logs dealt by how much is missing in each, where that is called for.

    What is missing may show in a few logs only, as friction that matters only in the widest motion.
    If none of them is in a split, that split can neither teach nor judge what explains them; and if
    little is missing in those that train, and far more in another, no fit has seen the like. Then
    all are dealt anew, from the log in which most is missing to the least; pieces of logs train, as
    ever. No effect has been looked for when this is decided.

    Args:
        parts: The logs of each split.
        left: Mean squared innovations with parameters alone, of each log of each split.
    """
    if not _lopsided(left):
        return parts
    names = list(parts)
    every = np.concatenate([left[name] for name in names])
    logs = [log for name in names for log in parts[name]]
    whole, pieces = _whole([logs[at] for at in np.argsort(-every, kind="stable")])
    again = _dealt(whole, _AGAIN)
    again["train"] += pieces
    return again


def _dealt(logs: Sequence[Log], names: Sequence[str] = _DEAL) -> dict[str, list[Log]]:
    """Return the logs in the splits that they are dealt to, in order."""
    parts: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    for log, name in zip(logs, cycle(names), strict=False):
        parts[name].append(log)
    return parts


def _lopsided(left: Mapping[str, Array]) -> bool:
    """Return whether what shows in several logs is not in each split, or hardly in training."""
    if sum(int((errors > _SHOWS).sum()) for errors in left.values()) < 2:
        return False
    most = {name: float(errors.max(initial=1.0)) - 1.0 for name, errors in left.items()}
    far = max(most.values()) > _FAR * most["train"] and most["train"] < _PLENTY
    return far or min(most.values()) < _SHOWS - 1.0
