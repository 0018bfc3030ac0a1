"""What a search starts from once it is known what else there is: other logs, less noise, chance."""

from __future__ import annotations

__all__ = ["with_less_noise", "with_less_trust", "with_other_logs"]

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..logs.log import Log
from .chance_contacts import left_to_chance
from .modes import Mode
from .noise import UNCERTAIN
from .objective import Point
from .preparation import Prepared, Started
from .refit import refit

_QUIETER = 0.87  # times the noise: a quarter of its variance was the missing effect


def with_other_logs(
    prepared: Prepared,
    parts: Mapping[str, Sequence[Log]],
    *,
    generator: np.random.Generator,
) -> Prepared:
    """Return what a search starts from if other commands arrived, or other samples were taken.

    Over the same horizon, with a noise of its own: what values spoil that were lost is none.

    Args:
        prepared: With the logs as they were recorded.
        parts: The same logs of each split, with those.
        generator: As in `prepare`.
    """
    history, mode = prepared.sets["train"].segments.history, prepared.mode
    predictor = prepared.predictor.divided(prepared.predictor.substeps)  # searches change theirs
    predictor.steps, alarms = prepared.predictor.steps, list(prepared.alarms)
    noise, source = mode.noise(predictor, parts["train"], history=history, alarms=alarms)
    alarms = tuple(dict.fromkeys(alarms))
    started = Started(predictor, mode, history, prepared.horizon, noise, source, alarms)
    return _trusted_as(prepared, started.fitted(parts, generator), generator)


def with_less_noise(
    prepared: Prepared, found: Point, *, generator: np.random.Generator
) -> Prepared | None:
    """Return the same with the noise that is left beside effects, if it is less somewhere.

    What a missing effect does within a few steps looks like noise, and hides what else is missing.

    Args:
        prepared: With the noise beside the parameters alone.
        found: The simulator with the effects that were found.
        generator: As in `prepare`.
    """
    if not found.strengths or type(prepared.mode) is not Mode:
        return None
    predictor, history = prepared.predictor, prepared.sets["train"].segments.history
    alarms = [alarm for alarm in prepared.alarms if not alarm.startswith(UNCERTAIN)]
    beside = found, prepared.noise
    noise, source = prepared.mode.noise(
        predictor, prepared.logs["train"], history=history, alarms=alarms, beside=beside
    )
    if (noise > _QUIETER * prepared.noise).all():
        return None
    noise = np.minimum(noise, prepared.noise)
    started = Started(
        predictor, prepared.mode, history, prepared.horizon, noise, source, tuple(alarms)
    )
    return _trusted_as(prepared, started.fitted(prepared.logs, generator), generator)


def with_less_trust(
    prepared: Prepared, found: Point, *, generator: np.random.Generator
) -> Prepared | None:
    """Return the same with what chance makes of contacts beside the effects that were found.

    Nothing where none were found, or chance makes little; see `chance_contacts`.

    Args:
        prepared: With the covariance at the parameters alone.
        found: The simulator with the effects.
        generator: Of the noise that is drawn.
    """
    if not found.strengths or type(prepared.mode) is not Mode:
        return None
    less = left_to_chance(prepared.sets, found, noise=prepared.noise, generator=generator)
    if not less:
        return None
    sets = {**prepared.sets, **less}
    nominal = refit(sets["train"], [prepared.nominal.point])[0]
    return replace(prepared, sets=sets, nominal=nominal, beside=found)


def _trusted_as(before: Prepared, anew: Prepared, generator: np.random.Generator) -> Prepared:
    """Return what was prepared anew with chance looked for where it was before."""
    if before.beside is None:
        return anew
    return with_less_trust(anew, before.beside, generator=generator) or anew
