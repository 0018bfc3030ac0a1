"""Fit a posterior to pairs of parameters and summaries: minibatches, early stopping, a report."""

from __future__ import annotations

__all__ = ["FitReport", "check_fit_options", "fit", "fit_several", "select_lengthscale"]

import copy
import inspect
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase

from ..counts import check_count
from ..errors import message
from ..kinds import check_choice, check_kind
from ..randomness import generator
from ..scalars import check_number
from .descent import descend
from .features import FourierFeatures
from .input_scaling import input_scaling
from .placement import check_one_device, placed
from .posterior import MixtureDensityPosterior
from .rows import Rows, mapped
from .stacked import alike
from .usable_pairs import in_floats, rows_that_count, usable_pairs, usable_rows, warn_of
from .weights import effective_sample_size, weights_of
from .widening import learn_shared, widen

_SEEN = 1000  # summaries kept to compare real ones with, and pairs that are neighbours
_FEWEST = 50  # held-out pairs that choose how wide an average is
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


def fit(
    posterior: MixtureDensityPosterior,
    data: TensorDictBase,
    *,
    epochs: int = 42,
    batch_size: int = 64,
    lr: float = 1e-2,
    weight_decay: float = 1e-4,
    validation_fraction: float = 0.1,
    patience: int | None = None,
    rescale: bool = True,
    seed: int = 0,
    split_seed: int | None = None,
    progress: bool = True,
) -> FitReport:
    """Maximise the posterior's log-density over pairs ``{"theta", "summary"[, "weight"]}``.

    If the posterior was made with an ``in_key`` or ``out_key``, the pairs' entries are those.

    Pairs on disk, of ``simulate(folder=)`` or ``memmap_``, stay there: some minibatches are
    read at a time. Others are taken to the device of the posterior.

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
        patience: Epochs without improvement after which it stops, None to leave it to the number
            of epochs: see :func:`.descent.descend`.
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
    (report,) = fit_several(
        [posterior],
        data,
        seeds=[seed],
        epochs=epochs,
        batch_size=batch_size,
        lr=lr,
        weight_decay=weight_decay,
        validation_fraction=validation_fraction,
        patience=patience,
        rescale=rescale,
        split_seed=split_seed,
        progress=progress,
    )
    return report


def fit_several(
    posteriors: Sequence[MixtureDensityPosterior],
    data: TensorDictBase,
    *,
    seeds: Sequence[int],
    together: bool = False,
    **options: Any,
) -> list[FitReport]:
    """Do what :func:`fit` does for several posteriors on one split, and return what each did.

    Those that are :func:`.stacked.alike` are fitted at once, in little more time than one.

    Args:
        posteriors: Changed in place; of the same keys.
        data: As for :func:`fit`.
        seeds: Of the minibatches, one for each; the split is the first's, if no other is given.
        together: Whether their answers will be averaged: all get the factors on deviations, and
            their powers, that the average needs, see :mod:`.widening`. With fewer than 50 effective
            pairs held out each keeps its own: the few would choose them by chance.
        options: Of :func:`fit`, but for its seed; the patience is that of all of them.

    Raises:
        ValueError: As :func:`fit`, no posterior, other keys of some, several devices, or not one
            seed for each.
        SimulationError: As :func:`fit`.
        TypeError: As :func:`fit`, or one seed for all.
    """
    check_fit_options(options)
    if "seed" in options:
        raise TypeError(message("seeds, one for each posterior", "one seed"))
    options = _defaults() | options
    _check(posteriors, seeds, data, options)
    first = posteriors[0]
    keys = (first.theta_key, first.summary_key)
    split_seed = seeds[0] if options["split_seed"] is None else options["split_seed"]
    data = in_floats(data, *keys).select(*keys, "weight", strict=False)
    on_disk = mapped(data)
    data = data if on_disk else placed(data, first.device)
    rows = usable_rows(data, *keys, stacklevel=4)
    dropped = len(data) - len(rows)
    # once for those that ask for the same; which rows count is the same for all
    unlike = {(str(p.prior.settings), len(p.network.shift)): p for p in posteriors}
    rows = [rows_that_count(posterior, Rows(data, rows)) for posterior in unlike.values()][-1]
    order = rows[torch.randperm(len(rows), generator=generator(split_seed, "split"))]
    share = options["validation_fraction"]
    held_out = min(max(1, round(share * len(rows))), len(rows) - 2, _HELD_OUT)
    validation = placed(data[order[:held_out]], first.device)
    train = Rows(data, order[held_out:])
    if options["rescale"]:
        scaling = input_scaling(part.get(keys[1]) for part in train.parts())
        warn_of(scaling, Rows(data, rows), keys[1])
        for posterior in posteriors:
            posterior.network.set_inputs(scaling)
    for posterior in posteriors:
        posterior.seen = train[:_SEEN].get(keys[1])
        posterior.held_out = validation
    names = "epochs", "batch_size", "lr", "weight_decay", "patience", "progress"
    settings = {name: options[name] for name in names}
    train = train if on_disk else train[:]
    traces = []
    for group, own in _groups(posteriors, seeds):
        traces += descend(group, train, validation, seeds=own, **settings)
    averaged = together and effective_sample_size(weights_of(validation)) >= _FEWEST
    for group in [posteriors] if averaged else [[posterior] for posterior in posteriors]:
        widen(group, validation)
    near = data[order[:_SEEN]]
    for posterior in posteriors:
        learn_shared(posterior, near)
    return [FitReport(len(rows), dropped, len(trace[0]), *trace) for trace in traces]


def _groups(
    posteriors: Sequence[MixtureDensityPosterior], seeds: Sequence[int]
) -> list[tuple[Sequence[MixtureDensityPosterior], Sequence[int]]]:
    """Return what is fitted at once: all, or each alone."""
    same = all(p.prior.settings == posteriors[0].prior.settings for p in posteriors)
    if same and alike([posterior.network for posterior in posteriors]):
        return [(posteriors, seeds)]
    return [([posterior], [seed]) for posterior, seed in zip(posteriors, seeds, strict=True)]


def _check(
    posteriors: Sequence[MixtureDensityPosterior],
    seeds: Sequence[int],
    data: TensorDictBase,
    options: dict[str, Any],
) -> None:
    if not posteriors or len(seeds) != len(posteriors):
        got = f"{len(posteriors)} and {len(seeds)}"
        raise ValueError(message("posteriors, and as many seeds", got))
    for posterior in posteriors:
        if not isinstance(posterior, MixtureDensityPosterior):
            raise TypeError(message("a MixtureDensityPosterior", type(posterior).__name__))
    check_one_device(posterior.device for posterior in posteriors)
    keys = {(posterior.theta_key, posterior.summary_key) for posterior in posteriors}
    if len(keys) > 1:
        raise ValueError(message("posteriors of the same keys", sorted(map(str, keys))))
    if not isinstance(data, TensorDictBase):
        raise TypeError(message("pairs in a TensorDict of batch size (N,)", type(data).__name__))
    check_number("validation_fraction", options["validation_fraction"], above=0.0, below=1.0)
    check_number("lr", options["lr"], above=0.0)
    check_number("weight_decay", options["weight_decay"], least=0.0)
    for name in ("epochs", "batch_size"):
        check_count(name, options[name])
    if options["patience"] is not None:
        check_count("patience", options["patience"])


def _defaults() -> dict[str, Any]:
    named = inspect.signature(fit).parameters.values()
    return {p.name: p.default for p in named if p.kind == p.KEYWORD_ONLY and p.name != "seed"}


def check_fit_options(options: Collection[str]) -> None:
    """Refuse names that :func:`fit` has no option of.

    Raises:
        ValueError: There is one.
        TypeError: They are no mapping.
    """
    check_kind("options of fit by name", options, Mapping, Sequence)
    for name in dict(options) if isinstance(options, Mapping) else options:
        check_choice("an option of fit", name, ["seed", *_defaults()])


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
    data = in_floats(data, posterior.theta_key, key)
    data = placed(data, posterior.device)
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
