"""Fit a posterior to pairs of parameters and summaries: minibatches, early stopping, a report."""

from __future__ import annotations

__all__ = ["FitReport", "fit", "select_lengthscale", "usable_pairs"]

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from tensordict import NestedKey, TensorDictBase

from ..counts import check_count
from ..errors import SimulationError, message
from ..randomness import generator
from .descent import descend
from .features import FourierFeatures
from .posterior import MixtureDensityPosterior

_SEEN = 1000  # summaries kept to compare real ones with


@dataclass(frozen=True)
class FitReport:
    """What a fit did.

    Attributes:
        pairs: Number of pairs used for training and validation together.
        dropped: Number of pairs left out because a simulation diverged or was not finite.
        epochs: Epochs run; the parameters kept are those of the best one.
        train: Training loss per epoch, in nats.
        validation: Loss on held-out pairs per epoch, in nats.
    """

    pairs: int
    dropped: int
    epochs: int
    train: list[float] = field(repr=False)
    validation: list[float] = field(repr=False)

    @property
    def best(self) -> float:
        """The lowest held-out loss, in nats."""
        return min(self.validation)


def usable_pairs(
    data: TensorDictBase,
    *,
    theta_key: NestedKey = "theta",
    summary_key: NestedKey = "summary",
) -> tuple[TensorDictBase, int]:
    """Return the pairs whose parameters and summaries are finite, and how many were dropped.

    Raises:
        ValueError: If there are no pairs, or one of the two entries is missing.
        SimulationError: If none is left.
    """
    for key in (theta_key, summary_key):
        if data.get(key, None) is None:
            found = sorted(map(str, data.keys(include_nested=True)))
            raise ValueError(message("pairs with an entry", str(key), available=found))
    if not data.batch_size.numel():
        raise ValueError(message("at least one pair", "none", hint="simulate some"))
    good = data[theta_key].isfinite().all(-1) & data[summary_key].isfinite().all(-1)
    dropped = int((~good).sum())
    if dropped == good.numel():
        raise SimulationError(
            message(
                "at least one simulation with finite summaries",
                f"{dropped} diverged simulations of {dropped}",
                hint="a smaller prior, a smaller time step, or a summary that masks the divergence",
            )
        )
    return data[good], dropped


def fit(
    posterior: MixtureDensityPosterior,
    data: TensorDictBase,
    *,
    epochs: int = 100,
    batch_size: int = 128,
    lr: float = 1e-2,
    weight_decay: float = 1e-4,
    validation_fraction: float = 0.1,
    patience: int = 25,
    rescale: bool = True,
    seed: int = 0,
    progress: bool = True,
) -> FitReport:
    """Maximise the posterior's log-density over pairs ``{"theta", "summary"[, "weight"]}``.

    If the posterior was made with an ``in_key`` or ``out_key``, the pairs' entries are those.

    AdamW with one cycle of the learning rate: see :mod:`.descent`. After every epoch the loss on
    held-out pairs is computed, and the parameters of the best epoch are kept. Pairs that are not
    finite are dropped and counted.

    Args:
        posterior: Changed in place.
        data: Batch size ``(N,)``; ``"theta"`` ``(N, D)``, ``"summary"`` ``(N, L)``.
        epochs: At most so many passes.
        batch_size: Pairs per step.
        lr: Highest learning rate.
        weight_decay: Of AdamW.
        validation_fraction: Share of the pairs that is held out: at least one, all but two at most.
        patience: Epochs without improvement after which it stops: see :func:`.descent.descend`.
        rescale: Whether to set the input scaling from these pairs (yes on the first fit).
        seed: Of the split and of the minibatches.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: For fewer than 4 usable pairs, shapes that do not match the posterior,
            parameters outside the prior, or a share that is not between 0 and 1.
        SimulationError: If no pair is finite, or the loss is not.
        TypeError: The pairs are not a TensorDict, or a count is no whole number.
    """
    if not isinstance(data, TensorDictBase):
        raise TypeError(message("pairs in a TensorDict of batch size (N,)", type(data).__name__))
    if not 0 < validation_fraction < 1:
        raise ValueError(message("a validation_fraction between 0 and 1", validation_fraction))
    for name, value in {"epochs": epochs, "batch_size": batch_size}.items():
        check_count(name, value)
    entries = {"theta_key": posterior.theta_key, "summary_key": posterior.summary_key}
    pairs, dropped = usable_pairs(data.select(*entries.values(), "weight", strict=False), **entries)
    if dropped:
        warnings.warn(
            f"{dropped} of {len(data)} simulations are not finite: left out", stacklevel=2
        )
    _check_pairs(posterior, pairs)
    order = torch.randperm(len(pairs), generator=generator(seed, "split"))
    held_out = min(max(1, round(validation_fraction * len(pairs))), len(pairs) - 2)
    validation, train = pairs[order[:held_out]], pairs[order[held_out:]].contiguous()
    if rescale:
        posterior.network.standardize_inputs(train.get(posterior.summary_key))
    posterior.seen = train.get(posterior.summary_key)[:_SEEN]
    posterior.held_out = None if "weight" in pairs.keys() else validation  # noqa: SIM118
    trace = descend(
        posterior,
        train,
        validation,
        epochs=epochs,
        batch_size=batch_size,
        lr=lr,
        weight_decay=weight_decay,
        patience=patience,
        seed=seed,
        progress=progress,
    )
    return FitReport(len(pairs), dropped, len(trace[0]), *trace)


def _check_pairs(posterior: MixtureDensityPosterior, pairs: TensorDictBase) -> None:
    if len(pairs) < 4:
        raise ValueError(message("at least 4 usable pairs", len(pairs), hint="simulate more"))
    expected = (len(posterior.prior.names), len(posterior.network.shift))
    theta, summary = pairs[posterior.theta_key], pairs[posterior.summary_key]
    got = (theta.shape[-1], summary.shape[-1])
    if got != expected:
        raise ValueError(message("pairs with (D, L) of the posterior, " + str(expected), got))
    weight = pairs.get("weight", None)
    if weight is not None:
        good = weight.isfinite() & (weight >= 0)
        if not good.all() or not weight.any():
            text = f"{int((~good).sum())} that are not, sum {weight.sum().item():.3g}"
            raise ValueError(message("finite weights of 0 or more, some positive", text))
    outside = ~posterior.prior.contains(theta)
    if outside.any():
        row = int(outside.nonzero()[0])
        raise ValueError(
            message(
                f"parameters inside the prior {posterior.prior!r}",
                f"{int(outside.sum())} outside it, the first {theta[row].tolist()}",
                hint="the prior that the parameters were drawn from",
            )
        )


def select_lengthscale(
    posterior: MixtureDensityPosterior,
    data: TensorDictBase,
    *,
    factors: Sequence[float] = (0.25, 0.5, 1.0, 2.0, 4.0),
    epochs: int = 40,
    seed: int = 0,
    progress: bool = True,
) -> float:
    """Set the length scale of Fourier features by cross-validation, and return it.

    The grid is the median distance between standardised summaries (the median heuristic) times
    each of ``factors``; the one with the lowest held-out loss after a short fit is kept. The
    posterior's weights are left as they were.

    Raises:
        TypeError: If the posterior's features are not Fourier features.
    """
    network = posterior.network
    features = network.features
    if not isinstance(features, FourierFeatures):
        raise TypeError(message("a posterior over FourierFeatures", type(features).__name__))
    key = posterior.summary_key
    pairs, _ = usable_pairs(data, theta_key=posterior.theta_key, summary_key=key)
    network.standardize_inputs(pairs[key])
    some = torch.randperm(len(pairs), generator=generator(seed, "median"))[:500]
    median = torch.pdist(network.scaled(pairs[key][some])).median().item()
    scores = {}
    for factor in factors:
        trial = copy.deepcopy(posterior)
        trial.network.features.lengthscale.fill_(factor * median)  # pyright: ignore[reportCallIssue]
        report = fit(trial, pairs, epochs=epochs, seed=seed, progress=progress)
        scores[factor * median] = report.best
    best = min(scores, key=scores.__getitem__)
    features.lengthscale.fill_(best)
    return best
