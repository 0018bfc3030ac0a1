r"""How a posterior's loss goes down: one cycle of the learning rate, the box in the last part only.

The mass :math:`Z_k \leq 1` of a component inside the prior's box costs most of a step to compute.
As :math:`\log(N_k / Z_k) \geq \log N_k`, the loss of the mixture before truncation bounds the loss
from above, and its minimum is near: the descent begins with it and ends with the loss itself.
"""

from __future__ import annotations

__all__ = ["descend"]

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from tqdm.auto import tqdm

from ..errors import SimulationError, message
from ..randomness import generator
from .mixture_gradients import log_density_and_pullback
from .placement import placed
from .posterior import TRAINING_POINTS, MixtureDensityPosterior
from .rows import PART, Rows
from .stacked import OneNetwork, StackedNetworks, as_one
from .steps import Steps
from .weights import weights_of

_FREE = 0.6  # share of the epochs that do without the box
_PATIENCE = 25  # epochs without improvement
_IN_VAIN = 0.12  # at most, as a share of the epochs, in the last part
_OVERFITTED = 0.5  # nats a parameter by which pairs that were learned from are likelier
_GATHERED = 64  # minibatches of which the pairs are gathered at once


class _Pairs(NamedTuple):
    scaled: Tensor
    z: Tensor
    volume: Tensor
    weight: Tensor


def descend(
    posteriors: Sequence[MixtureDensityPosterior],
    train: TensorDictBase | Rows,
    validation: TensorDictBase,
    *,
    epochs: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    patience: int | None,
    seeds: Sequence[int],
    progress: bool,
) -> list[tuple[list[float], list[float]]]:
    """Leave each posterior with the parameters of its best epoch; return its losses per epoch.

    An interrupt or an error leaves them so, too.

    Args:
        posteriors: Changed in place. Several are :func:`.stacked.alike` and have one prior.
        train: Pairs to learn from, or rows of pairs on disk, which are read as they are needed.
        validation: Pairs that say which epoch is the best.
        epochs: At most so many passes.
        batch_size: Pairs per step.
        lr: Highest learning rate.
        weight_decay: Of AdamW.
        patience: Epochs that do not improve the mean loss of all posteriors, after which the box
            comes in, and then the end; counted anew where the last part begins. None for 25, but
            in the last part, where the learning rate is low, for no more than 12 % of ``epochs``,
            and half as many where pairs that were learned from are likelier than held-out ones by
            more than 0.5 nats a parameter: what is overfitted by then only gets worse.
        seeds: Of the minibatches, one for each posterior.
        progress: Whether to show a progress bar.

    Raises:
        SimulationError: A loss is not finite.
    """
    for posterior in posteriors:
        posterior.network.widening.fill_(1.0)
        posterior.network.contrast.fill_(1.0)
        posterior.network.apart.fill_(1.0)
        posterior.network.tails = posterior.network.tails.new_zeros(0)
    networks = as_one([posterior.network for posterior in posteriors])
    try:
        with torch.enable_grad(), torch.autocast(posteriors[0].device.type, enabled=False):
            trace = _epochs(
                posteriors[0],
                networks,
                _reader(posteriors[0], train),
                _prepared(posteriors[0], validation),
                count=len(train),
                epochs=epochs,
                batch_size=batch_size,
                lr=lr,
                weight_decay=weight_decay,
                patience=patience,
                shuffles=[generator(seed, "minibatches") for seed in seeds],
                progress=progress,
            )
    finally:  # interrupted, too, each is what it was at its best
        networks.restore()
    learned, held_out = (torch.stack(part).T.tolist() for part in zip(*trace, strict=True))
    return list(zip(learned, held_out, strict=True))


def _epochs(
    first: MixtureDensityPosterior,
    networks: OneNetwork | StackedNetworks,
    pairs: Callable[[Tensor], _Pairs],
    held: _Pairs,
    *,
    count: int,
    epochs: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    patience: int | None,
    shuffles: Sequence[torch.Generator],
    progress: bool,
) -> list[tuple[Tensor, Tensor]]:
    """Pass over the pairs again and again; return the losses of each network by epoch."""
    size = len(shuffles)
    held = _Pairs(*(value.expand(size, *value.shape) for value in held))
    length = math.ceil(count / math.ceil(count / batch_size))
    gathered = max(1, min(_GATHERED, PART // (size * length)))
    step = Steps(networks, epochs * math.ceil(count / length), lr=lr, weight_decay=weight_decay)
    best, least = torch.full((size,), math.inf), math.inf
    boxed, late, stale = first.prior.box is not None, False, 0
    in_vain = patience or min(_PATIENCE, max(1, round(_IN_VAIN * epochs)))
    sooner = patience or max(1, in_vain // 2)
    patience = patience or _PATIENCE
    trace: list[tuple[Tensor, Tensor]] = []
    bar = tqdm(range(epochs), desc="fit", disable=not progress, leave=False, unit="epoch")
    for epoch in bar:
        spent = boxed and stale >= patience
        if not late and (spent or epoch >= min(_FREE * epochs, epochs - 1)):
            late, stale = True, 0
        order = torch.stack([torch.randperm(count, generator=g) for g in shuffles])
        parts = [
            _learn(first, networks, pairs(rows), step, length=length, truncated=late)
            for rows in order.split(gathered * length, 1)
        ]
        total, weight = torch.stack(parts).sum(0)
        learned, held_out = (total / weight).cpu(), _loss(first, networks, held).cpu()
        trace.append((_checked(learned), _checked(held_out)))
        bar.set_postfix(train=f"{learned.mean():.2f}", held_out=f"{held_out.mean():.2f}")
        better = held_out < best - 1e-4
        if better.any():
            best = torch.where(better, held_out, best)
            networks.keep(better)
        mean = held_out.mean().item()
        least, stale = (mean, 0) if mean < least - 1e-4 else (least, stale + 1)
        overfitted = mean - learned.mean().item() > _OVERFITTED * held.z.shape[-1]
        limit = patience if not late else sooner if overfitted else in_vain
        if (late or not boxed) and stale >= limit:
            break
    return trace


def _learn(
    posterior: MixtureDensityPosterior,
    networks: OneNetwork | StackedNetworks,
    pairs: _Pairs,
    step: Callable[[], None],
    *,
    length: int,
    truncated: bool,
) -> Tensor:
    """Make a step for every minibatch; return each network's weighted losses, and the weights."""
    network, box = posterior.network, posterior.prior.box if truncated else None
    share = _shares(pairs.weight, length)
    log_q: list[Tensor] = []
    for scaled, z, own in _minibatches(pairs.scaled, pairs.z, -share, length=length):
        raw = networks.raw(scaled)
        found, pullback = log_density_and_pullback(network, raw, z, box=box, points=TRAINING_POINTS)
        networks.backpropagate(pullback(own))
        step()
        log_q.append(found)
    weighted = (pairs.volume - torch.cat(log_q, 1)) * pairs.weight
    return torch.stack([weighted.sum(-1), pairs.weight.sum(-1)])


def _reader(
    posterior: MixtureDensityPosterior, pairs: TensorDictBase | Rows
) -> Callable[[Tensor], _Pairs]:
    """Return what gives rows ``(M, B)``: prepared once where all pairs are in memory."""
    if isinstance(pairs, Rows):
        return lambda rows: _Pairs(
            *map(torch.stack, zip(*(_prepared(posterior, pairs[own]) for own in rows), strict=True))
        )
    whole = _prepared(posterior, pairs)
    return lambda rows: _Pairs(*(value[rows] for value in whole))


def _prepared(posterior: MixtureDensityPosterior, pairs: TensorDictBase) -> _Pairs:
    """Return what does not change from epoch to epoch."""
    pairs = placed(pairs, posterior.device)
    theta = pairs.get(posterior.theta_key).double()
    z = posterior.prior.standardize(theta)
    volume = posterior.prior.standardization.log_abs_det_jacobian(z, theta)
    scaled = posterior.network.scaled(pairs.get(posterior.summary_key))
    return _Pairs(scaled, z, volume, weights_of(pairs).to(z))


def _shares(weight: Tensor, length: int) -> Tensor:
    """Return weights ``(M, N)`` that sum to 1 in every minibatch."""
    parts = pad(weight, (0, -weight.shape[1] % length)).unflatten(1, (-1, length))
    return (parts / parts.sum(-1, keepdim=True)).flatten(1)[:, : weight.shape[1]]


def _minibatches(*values: Tensor, length: int) -> Iterator[tuple[Tensor, ...]]:
    return zip(*(value.split(length, 1) for value in values), strict=True)


@torch.no_grad()
def _loss(
    posterior: MixtureDensityPosterior, networks: OneNetwork | StackedNetworks, pairs: _Pairs
) -> Tensor:
    """Return each network's weighted negative log-density in nats, as `PosteriorLoss` does."""
    log_q, _ = log_density_and_pullback(
        posterior.network,
        networks.raw(pairs.scaled),
        pairs.z,
        box=posterior.prior.box,
        points=TRAINING_POINTS,
    )
    return ((pairs.volume - log_q) * pairs.weight).sum(-1) / pairs.weight.sum(-1)


def _checked(loss: Tensor) -> Tensor:
    if not loss.isfinite().all():
        raise SimulationError(
            message(
                "a finite loss",
                loss[~loss.isfinite()][0].item(),
                hint="a smaller learning rate, or fewer constant or redundant statistics",
            )
        )
    return loss
