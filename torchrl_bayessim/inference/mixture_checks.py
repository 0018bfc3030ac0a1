"""What the algebra of mixtures cannot use is refused: shapes, numbers, weights, factors."""

from __future__ import annotations

__all__ = ["check_covariance", "check_mixture", "check_together", "first_marked"]

from collections.abc import Mapping

import torch
from torch import Tensor

from ..errors import message

_ROUNDING = 1e3  # times the precision of the numbers


def check_together(parts: Mapping[str, tuple[Tensor, int]]) -> None:
    """Refuse tensors of several dtypes or devices, or whose batch shapes do not broadcast.

    Args:
        parts: By name, each tensor and how many of its last dimensions are no batch.

    Raises:
        ValueError: So they are.
    """
    floats = all(part.is_floating_point() for part, _ in parts.values())
    kinds = {name: f"{part.dtype} on {part.device}" for name, (part, _) in parts.items()}
    if not floats or len(set(kinds.values())) > 1:
        raise ValueError(
            message(f"{', '.join(parts)} in floats of one dtype, on one device", kinds)
        )
    batches = {name: part.shape[: part.ndim - own] for name, (part, own) in parts.items()}
    try:
        torch.broadcast_shapes(*batches.values())
    except RuntimeError:  # torch's, whose words differ between versions
        got = {name: tuple(batch) for name, batch in batches.items()}
        raise ValueError(
            message(f"{', '.join(parts)} of batch shapes that broadcast", got)
        ) from None


def check_mixture(logits: Tensor, loc: Tensor, scale_tril: Tensor) -> None:
    """Refuse what is no mixture of Gaussians, points among them allowed.

    Args:
        logits: Shape ``(*, K)``.
        loc: Shape ``(*, K, D)``.
        scale_tril: Shape ``(*, K, D, D)``.

    Raises:
        ValueError: Shapes, dtypes (floats) or devices do not belong together, a number is not
            finite, all weights are 0, or a factor is not lower triangular or has a negative
            diagonal.
    """
    parts = [tuple(part.shape) for part in (logits, loc, scale_tril)]
    size = loc.shape[-2:]
    wrong = len(size) < 2 or logits.shape[-1:] != size[:1] or not size[1]
    if wrong or scale_tril.shape[-3:] != (*size, size[1]):
        raise ValueError(message("a mixture of shapes (*, K), (*, K, D), (*, K, D, D)", parts))
    check_together({"logits": (logits, 1), "loc": (loc, 2), "scale_tril": (scale_tril, 3)})
    finite = (scale_tril @ scale_tril.mT).isfinite().flatten(-2).all(-1) & loc.isfinite().all(-1)
    odd = ~finite | logits.isnan() | logits.isposinf()
    if odd.any():
        expected = "components of finite means, covariances and weights"
        raise ValueError(message(expected, f"NaN or infinity in {first_marked(odd)}"))
    if logits.isneginf().all(-1).any():
        raise ValueError(message("a mixture with a weight above 0", "logits of -inf only"))
    negative = (scale_tril.diagonal(dim1=-2, dim2=-1) < 0).any(-1)
    upper = (scale_tril.triu(1) != 0).flatten(-2).any(-1)
    for marked, got in (negative, "a negative diagonal"), (upper, "entries above the diagonal"):
        if marked.any():
            expected = "lower Cholesky factors of covariances"
            raise ValueError(message(expected, f"{got} in {first_marked(marked)}"))


def check_covariance(name: str, matrix: Tensor, size: int) -> None:
    """Refuse covariances of another size, or that are not symmetric but for rounding.

    Raises:
        ValueError: So they are.
    """
    if matrix.shape[-2:] != (size, size):
        raise ValueError(message(f"{name} of shape (*, {size}, {size})", tuple(matrix.shape)))
    apart = (matrix - matrix.mT).abs().flatten(-2).amax(-1)
    widest = matrix.abs().flatten(-2).amax(-1)
    if (apart > _ROUNDING * torch.finfo(matrix.dtype).eps * widest).any():
        got = f"entries that differ by {apart.max().item():.3g} from those mirrored"
        raise ValueError(message(f"{name} to be symmetric", got))


def first_marked(marked: Tensor) -> str:
    """Return the name of the first component that is marked, among ``(*, K)``."""
    *row, k = marked.nonzero()[0].tolist()
    return f"component {k} of {marked.shape[-1]}" + (f", row {row}" if row else "")
