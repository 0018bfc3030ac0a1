r"""How a posterior's loss goes down: one cycle of the learning rate, the box in the last part only.

The mass :math:`Z_k \leq 1` of a component inside the prior's box costs most of a step to compute.
As :math:`\log(N_k / Z_k) \geq \log N_k`, the loss of the mixture before truncation bounds the loss
from above, and its minimum is near: the descent begins with it and ends with the loss itself.
"""

from __future__ import annotations

__all__ = ["descend"]

import copy
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from tqdm.auto import tqdm

from ..errors import SimulationError, message
from ..randomness import generator
from .posterior import TRAINING_POINTS, MixtureDensityPosterior
from .rows import Rows
from .truncation import TruncatedGaussianMixture
from .weights import weighted_mean, weights_of
from .widening import widen

_WARM_UP = 0.1  # share of the steps in which the learning rate rises
_FREE = 0.5  # share of the epochs that do without the box
_CLIP = 10.0  # of the gradient's norm


class _Pairs(NamedTuple):
    scaled: Tensor
    z: Tensor
    volume: Tensor
    weight: Tensor


def descend(
    posterior: MixtureDensityPosterior,
    train: TensorDictBase | Rows,
    validation: TensorDictBase,
    *,
    epochs: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    patience: int,
    seed: int,
    progress: bool,
) -> tuple[list[float], list[float]]:
    """Leave the posterior with the parameters of its best epoch; return the losses per epoch.

    Args:
        posterior: Changed in place.
        train: Pairs to learn from, or rows of pairs on disk, which are read as they are needed.
        validation: Pairs that say which epoch is the best.
        epochs: At most so many passes.
        batch_size: Pairs per step.
        lr: Highest learning rate.
        weight_decay: Of AdamW.
        patience: Epochs without improvement after which the box comes in, and then the end.
        seed: Of the minibatches.
        progress: Whether to show a progress bar.

    Raises:
        SimulationError: The loss is not finite.
    """
    pairs, held = _reader(posterior, train), _prepared(posterior, validation)
    batches = math.ceil(len(train) / batch_size)
    steps = epochs * batches
    optimizer = torch.optim.AdamW(
        posterior.parameters(), lr=lr, weight_decay=weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _one_cycle(step, steps))
    shuffle = generator(seed, "minibatches")
    posterior.network.widening.fill_(1.0)
    best, best_state, stale = math.inf, copy.deepcopy(posterior.state_dict()), 0
    truncated = posterior.prior.box is None
    losses: tuple[list[float], list[float]] = ([], [])
    bar = tqdm(range(epochs), desc="fit", disable=not progress, leave=False, unit="epoch")
    for epoch in bar:
        if not truncated and (epoch >= _FREE * epochs or stale >= patience):
            truncated, stale = True, 0
        total = 0.0
        for rows in torch.randperm(len(train), generator=shuffle).chunk(batches):
            loss = _loss(posterior, pairs(rows), truncated=truncated)
            _check_loss(loss)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(posterior.parameters(), _CLIP)
            optimizer.step()
            schedule.step()
            total += loss.item() * len(rows) / len(train)
        with torch.no_grad():
            held_out = _loss(posterior, held, truncated=True).item()
        losses[0].append(total)
        losses[1].append(held_out)
        bar.set_postfix(train=f"{total:.2f}", held_out=f"{held_out:.2f}")
        stale += 1
        if held_out < best - 1e-4:
            best, best_state, stale = held_out, copy.deepcopy(posterior.state_dict()), 0
        if truncated and stale >= patience:
            break
    posterior.load_state_dict(best_state)
    widen([posterior], validation)
    return losses


def _one_cycle(step: int, steps: int) -> float:
    """Return the share of the highest learning rate: a short rise, then half a cosine to 0."""
    rise = max(1.0, _WARM_UP * steps)
    if step < rise:
        return 0.1 + 0.9 * step / rise
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1.0, steps - rise))))


def _reader(
    posterior: MixtureDensityPosterior, pairs: TensorDictBase | Rows
) -> Callable[[Tensor], _Pairs]:
    """Return what gives rows of the pairs: prepared once where all of them are in memory."""
    if isinstance(pairs, Rows):
        return lambda rows: _prepared(posterior, pairs[rows])
    whole = _prepared(posterior, pairs)
    return lambda rows: _Pairs(*(value[rows] for value in whole))


def _prepared(posterior: MixtureDensityPosterior, pairs: TensorDictBase) -> _Pairs:
    """Return what does not change from epoch to epoch."""
    theta = pairs.get(posterior.theta_key).double()
    z = posterior.prior.standardize(theta)
    volume = posterior.prior.standardization.log_abs_det_jacobian(z, theta)
    scaled = posterior.network.scaled(pairs.get(posterior.summary_key))
    return _Pairs(scaled, z, volume, weights_of(pairs).to(z))


def _loss(posterior: MixtureDensityPosterior, pairs: _Pairs, *, truncated: bool) -> Tensor:
    """Return the weighted negative log-density in nats, as `PosteriorLoss` does."""
    network = posterior.network
    logits, loc, scale_tril = network.mixture(pairs.scaled)
    mixture = TruncatedGaussianMixture(
        logits,
        loc,
        scale_tril,
        posterior.prior.box if truncated else None,
        diagonal=network.covariance == "diagonal",
        points=TRAINING_POINTS,
    )
    return weighted_mean(pairs.volume - mixture.log_prob(pairs.z), pairs.weight)


def _check_loss(loss: Tensor) -> None:
    if not loss.isfinite():
        raise SimulationError(
            message(
                "a finite loss",
                loss.item(),
                hint="a smaller learning rate, or fewer constant or redundant statistics",
            )
        )
