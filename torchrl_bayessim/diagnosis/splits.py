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
_AGAIN = "train", "validation", "train"
_SHOWS = 1.5  # mean squared innovation of a log in which something is missing


def split(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return training, validation and test logs.

    From the longest to the shortest, and among those about as long from the widest motion to the
    least, of every four logs the first and last train, one tests, one validates: what acts in wide
    motion only should act in each split. Pieces that are much shorter than the others train: over
    them no error grows. Fewer than three logs are each divided in time: half, a quarter, a quarter.
    """
    parts: dict[str, list[Log]] = {"train": [], "validation": [], "test": []}
    whole, pieces = _whole(logs)
    if len(whole) >= _APART:
        for log, name in zip(_ordered(whole), cycle(_DEAL), strict=False):
            parts[name].append(log)
    else:
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
    """Return the same with training and validation logs exchanged, where that is called for.

    Where what is missing shows in two logs or more, as friction that matters only in the widest
    motion, and all of them are in one of the two splits, the other cannot judge what explains them.
    Then both are dealt anew, from the log in which most is missing to the least; pieces of logs
    train, as ever, and test logs stay.

    Args:
        parts: The logs of each split.
        left: Mean squared innovations with parameters alone, of each log of the two splits.
    """
    shows = {name: int((left[name] > _SHOWS).sum()) for name in ("train", "validation")}
    if min(shows.values()) or max(shows.values()) < 2:
        return parts
    every = np.concatenate([left["train"], left["validation"]])
    logs = [*parts["train"], *parts["validation"]]
    pieces = _whole([log for part in parts.values() for log in part])[1]
    again: dict[str, list[Log]] = {"train": [], "validation": []}
    order = [logs[at] for at in np.argsort(-every, kind="stable")]
    whole = [log for log in order if not any(log is piece for piece in pieces)]
    for log, name in zip(whole, cycle(_AGAIN), strict=False):
        again[name].append(log)
    if not again["validation"]:
        return parts
    again["train"] += [log for log in order if any(log is piece for piece in pieces)]
    return {**parts, **again}
