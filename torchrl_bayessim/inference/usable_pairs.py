"""Which pairs a network can be fitted to: finite ones, inside the prior, of weights that count."""

from __future__ import annotations

__all__ = ["in_floats", "rows_that_count", "usable_pairs", "usable_rows", "warn_of"]

import warnings

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from ..errors import SimulationError, message
from .input_scaling import InputScaling
from .losses import one_each
from .posterior import MixtureDensityPosterior
from .rows import Rows, parts


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
    rows = usable_rows(data, theta_key, summary_key)
    return data[rows], len(data) - len(rows)


def usable_rows(data: TensorDictBase, *keys: NestedKey, stacklevel: int = 3) -> Tensor:
    """Return the rows in which all entries of these keys are finite; warn of the others."""
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
    warnings.warn(text, stacklevel=stacklevel)
    return good.nonzero().flatten()


def in_floats(data: TensorDictBase, *keys: NestedKey) -> TensorDictBase:
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


def warn_of(scaling: InputScaling, pairs: Rows, key: NestedKey) -> None:
    """Warn of statistics that say nothing, and of pairs that lie absurdly far out."""
    count = len(scaling.scale)
    if scaling.scale.isinf().all():
        text = (
            f"None of the {count} statistics varies over {len(pairs)} simulations: these data say "
            "nothing about the parameters, and the posterior is what they were drawn from, the "
            "prior if it was. Do the parameters reach the simulator, and the statistics see it?"
        )
        warnings.warn(text, stacklevel=4)
    for column in scaling.absurd.nonzero().flatten().tolist()[:3]:
        values = torch.cat([part.get(key)[:, column] for part in pairs.parts()])
        row = int((values - scaling.shift[column]).abs().argmax())
        text = (
            f"Statistic {column} of pair {int(pairs.index[row])} is {values[row]:.3g}, so far from "
            f"those of the others that they could not be told apart beside it (median "
            f"{scaling.shift[column]:.3g}): scaled by the quartiles. Did this simulation diverge?"
        )
        warnings.warn(text, stacklevel=4)


def rows_that_count(posterior: MixtureDensityPosterior, pairs: Rows) -> Tensor:
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
