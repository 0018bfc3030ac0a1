"""Fit a posterior to pairs of parameters and summaries: minibatches, early stopping, a report."""

from __future__ import annotations

__all__ = ["FitReport", "check_fit_options", "fit", "select_lengthscale", "usable_pairs"]

import copy
import inspect
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from ..counts import check_count
from ..errors import SimulationError, message
from ..kinds import check_choice, check_kind
from ..randomness import generator
from ..scalars import check_number
from .descent import descend
from .features import FourierFeatures
from .input_scaling import InputScaling
from .losses import one_each
from .posterior import MixtureDensityPosterior
from .rows import Rows, mapped, parts

_SEEN = 1000  # summaries kept to compare real ones with
_HELD_OUT = 2**14  # pairs are enough to choose an epoch by, and all are held in memory


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

    Warns of those, and says which of the two are not finite.

    Raises:
        ValueError: If there are no pairs, or one of the two entries is missing.
        SimulationError: If none is left.
    """
    rows = _usable_rows(data, theta_key, summary_key)
    return data[rows], len(data) - len(rows)


def _usable_rows(data: TensorDictBase, *keys: NestedKey) -> Tensor:
    for key in keys:
        if data.get(key, None) is None:
            found = sorted(map(str, data.keys(include_nested=True)))
            raise ValueError(message("pairs with an entry", str(key), available=found))
    if not data.batch_size.numel():
        raise ValueError(message("at least one pair", "none", hint="simulate some"))
    finite = torch.cat(
        [
            torch.stack([data[part].get(key).isfinite().all(-1) for key in keys], -1)
            for part in parts(len(data))
        ]
    )
    good = finite.all(-1)
    if good.all():
        return good.nonzero().flatten()
    bad = zip(keys, (~finite).sum(0).tolist(), strict=True)
    where = "NaN or infinity in " + " and ".join(f"{key} of {rows}" for key, rows in bad if rows)
    if not finite[:, 0].any():
        expected, hint = f"finite parameters in {keys[0]!r}", "parameters as they were drawn"
        raise SimulationError(message(expected, f"{where} of {len(good)} pairs", hint=hint))
    if not good.any():
        raise SimulationError(
            message(
                "at least one simulation with finite summaries",
                f"{len(good)} diverged simulations of {len(good)}: {where}",
                hint="a smaller prior, a smaller time step, or a summary that masks the divergence",
            )
        )
    text = f"{int((~good).sum())} of {len(good)} pairs are not finite: left out ({where})"
    warnings.warn(text, stacklevel=3)
    return good.nonzero().flatten()


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
    split_seed: int | None = None,
    progress: bool = True,
) -> FitReport:
    """Maximise the posterior's log-density over pairs ``{"theta", "summary"[, "weight"]}``.

    If the posterior was made with an ``in_key`` or ``out_key``, the pairs' entries are those.

    Pairs on disk, of ``simulate(folder=)`` or ``memmap_``, stay there: a minibatch is read at a
    time.

    AdamW with one cycle of the learning rate: see :mod:`.descent`. After every epoch the loss on
    held-out pairs is computed, and the parameters of the best epoch are kept. Pairs that are not
    finite are dropped, counted and warned of; those of weight 0 are left out.

    Warns if no statistic varies, so that there is nothing to learn, and of statistics that are
    scaled by their quartiles because a few pairs lie absurdly far out: see :mod:`.input_scaling`.

    Args:
        posterior: Changed in place.
        data: Batch size ``(N,)``, or any other, which is taken for one row of pairs; ``"theta"``
            ``(N, D)``, ``"summary"`` ``(N, L)``, of which counts become floats; ``"weight"``, one
            for each.
        epochs: At most so many passes.
        batch_size: Pairs per step.
        lr: Highest learning rate.
        weight_decay: Of AdamW.
        validation_fraction: Share of the pairs that is held out: at least one, all but two at
            most, and no more than 16,384.
        patience: Epochs without improvement after which it stops: see :func:`.descent.descend`.
        rescale: Whether to set the input scaling from these pairs (yes on the first fit).
        seed: Of the split and of the minibatches.
        split_seed: Of the split, if not ``seed``: networks that share it hold out the same pairs.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: For fewer than 4 usable pairs, shapes that do not match the posterior,
            parameters outside the prior, weights that are not one for each pair or not finite, a
            share that is not between 0 and 1, or a learning rate that is not positive.
        SimulationError: If no pair is finite, or the loss is not.
        TypeError: The posterior is none, the pairs are not a TensorDict, a count is no whole
            number, or a rate or share no number.
    """
    if not isinstance(posterior, MixtureDensityPosterior):
        raise TypeError(message("a MixtureDensityPosterior", type(posterior).__name__))
    if not isinstance(data, TensorDictBase):
        raise TypeError(message("pairs in a TensorDict of batch size (N,)", type(data).__name__))
    check_number("validation_fraction", validation_fraction, above=0.0, below=1.0)
    check_number("lr", lr, above=0.0)
    check_number("weight_decay", weight_decay, least=0.0)
    for name, value in {"epochs": epochs, "batch_size": batch_size, "patience": patience}.items():
        check_count(name, value)
    split_seed = seed if split_seed is None else split_seed
    data = _in_floats(data, posterior.theta_key, posterior.summary_key)
    keys = (posterior.theta_key, posterior.summary_key)
    data = data.select(*keys, "weight", strict=False)
    rows = _usable_rows(data, *keys)
    dropped = len(data) - len(rows)
    rows = _check_pairs(posterior, Rows(data, rows))
    order = rows[torch.randperm(len(rows), generator=generator(split_seed, "split"))]
    held_out = min(max(1, round(validation_fraction * len(rows))), len(rows) - 2, _HELD_OUT)
    validation, train = data[order[:held_out]], Rows(data, order[held_out:])
    if rescale:
        summaries = (part.get(posterior.summary_key) for part in train.parts())
        _warn_of(posterior.network.standardize_inputs(summaries), Rows(data, rows), keys[1])
    posterior.seen = train[:_SEEN].get(posterior.summary_key)
    posterior.held_out = validation
    trace = descend(
        posterior,
        train if mapped(data) else train[:],
        validation,
        epochs=epochs,
        batch_size=batch_size,
        lr=lr,
        weight_decay=weight_decay,
        patience=patience,
        seed=seed,
        progress=progress,
    )
    return FitReport(len(rows), dropped, len(trace[0]), *trace)


def check_fit_options(options: Collection[str]) -> None:
    """Refuse names that :func:`fit` has no option of.

    Raises:
        ValueError: There is one.
        TypeError: They are no mapping.
    """
    check_kind("options of fit by name", options, Mapping, Sequence)
    known = [p.name for p in inspect.signature(fit).parameters.values() if p.kind == p.KEYWORD_ONLY]
    for name in dict(options) if isinstance(options, Mapping) else options:
        check_choice("an option of fit", name, known)


def _in_floats(data: TensorDictBase, *keys: NestedKey) -> TensorDictBase:
    """Return pairs of batch size ``(N,)``, as floats of which no gradient is asked."""
    data = data.copy() if data.ndim == 1 else data.reshape(-1)
    for key in keys:
        value = data.get(key, None)
        if value is not None and not isinstance(value, Tensor):
            raise TypeError(message(f"a tensor in {key!r}", type(value).__name__))
    if any(value.requires_grad for value in data.values(include_nested=True, leaves_only=True)):
        data = data.detach()
    for key in keys:
        value = data.get(key, None)
        if value is not None and (value.ndim != 2 or not value.shape[1]):
            expected = f"vectors in {key!r}, shape (N, size)"
            raise ValueError(message(expected, tuple(value.shape), hint="unsqueeze(-1)"))
        if value is not None and value.is_complex():
            hint = "its real and imaginary parts, or magnitude and phase"
            raise TypeError(message(f"real numbers in {key!r}", str(value.dtype), hint=hint))
        if value is not None and not value.is_floating_point():
            data.set(key, value.to(torch.get_default_dtype()))
    return data


def _warn_of(scaling: InputScaling, pairs: Rows, key: NestedKey) -> None:
    """Warn of statistics that say nothing, and of pairs that lie absurdly far out."""
    count = len(scaling.scale)
    if scaling.scale.isinf().all():
        text = (
            f"None of the {count} statistics varies over {len(pairs)} simulations: these data say "
            "nothing about the parameters, and the posterior is what they were drawn from, the "
            "prior if it was. Do the parameters reach the simulator, and the statistics see it?"
        )
        warnings.warn(text, stacklevel=3)
    for column in scaling.absurd.nonzero().flatten().tolist()[:3]:
        values = torch.cat([part.get(key)[:, column] for part in pairs.parts()])
        row = int((values - scaling.shift[column]).abs().argmax())
        text = (
            f"Statistic {column} of pair {int(pairs.index[row])} is {values[row]:.3g}, so far from "
            f"those of the others that they could not be told apart beside it (median "
            f"{scaling.shift[column]:.3g}): scaled by the quartiles. Did this simulation diverge?"
        )
        warnings.warn(text, stacklevel=3)


def _check_pairs(posterior: MixtureDensityPosterior, pairs: Rows) -> Tensor:
    """Return which rows count, those whose weight is not 0."""
    pairs = _weighted(pairs)
    if len(pairs) < 4:
        raise ValueError(message("at least 4 usable pairs", len(pairs), hint="simulate more"))
    expected = (len(posterior.prior.names), len(posterior.network.shift))
    got = tuple(pairs[:1].get(k).shape[-1] for k in (posterior.theta_key, posterior.summary_key))
    if got != expected:
        raise ValueError(message("pairs with (D, L) of the posterior, " + str(expected), got))
    theta = (part.get(posterior.theta_key) for part in pairs.parts())
    inside = torch.cat([posterior.prior.contains(part) for part in theta])
    if not inside.all():
        row = int((~inside).nonzero()[0])
        first = pairs[row : row + 1].get(posterior.theta_key)[0]
        raise ValueError(
            message(
                f"parameters inside the prior {posterior.prior!r}",
                f"{int((~inside).sum())} outside it, the first {first.tolist()}",
                hint="the prior that the parameters were drawn from",
            )
        )
    return pairs.index


def _weighted(pairs: Rows) -> Rows:
    """Return the pairs whose weight is not 0: if only others were held out, none would count."""
    if "weight" not in pairs.pairs.keys():  # noqa: SIM118
        return pairs
    given = torch.cat([part.get("weight") for part in pairs.parts()])
    weight = one_each("weight", given, pairs.index.shape)
    if weight.is_complex():
        raise TypeError(message("weights that are real numbers", str(weight.dtype)))
    good = weight.isfinite() & (weight >= 0)
    if not good.all() or not weight.any():
        text = f"{int((~good).sum())} that are not, sum {weight.sum().item():.3g}"
        raise ValueError(message("finite weights of 0 or more, some positive", text))
    return Rows(pairs.pairs, pairs.index[weight > 0])


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
    data = _in_floats(data, posterior.theta_key, key)
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
