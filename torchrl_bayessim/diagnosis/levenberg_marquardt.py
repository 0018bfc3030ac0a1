"""One Levenberg-Marquardt fit that is told what it asked for, so that many can run side by side.

Derivatives cost a simulation per coordinate, so they are made once and then updated by what each
step taught (Broyden 1965)::

    J ← J + (Δr − J Δx) Δxᵀ / ‖Δx‖²,

and made anew only where a step fails that they had promised, or at the end unless the last step
kept its promise.
"""

from __future__ import annotations

__all__ = ["LevenbergMarquardt"]

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_CAREFUL = (3.0, 100.0)  # dampings tried after a step that failed, times the one before
_FULL = 1e-3  # damping of a step that is hardly damped
_RANGE = (_FULL, 0.1, 1.0, 10.0)  # dampings of steps that may promise something
_STUCK = 1e4  # damping beyond which there is nothing to gain
_LITTLE = 1e-3, 1e-4  # gains that end a descent: absolute, and of the cost
_KEPT = 0.25  # of a promise: by how much a gain may differ from it where derivatives are right


class LevenbergMarquardt:
    """Minimises ``‖r(x)‖² + Σ_{i<size} x_i²`` between bounds, asking for ``r`` where it needs it.

    Args:
        vector: Where to begin, shape ``(n,)``.
        bounds: Lowest and highest ``x``, shape ``(n,)`` each.
        size: The first coordinates, which have a standard normal prior.
        origin: A point, ``r`` there and its Jacobian ``(m, n)``, from which the beginning is the
            first step; without it derivatives are made at the beginning.
        begun: Whether the origin is where it begins, and ``r`` is known there.
        renew: Whether derivatives are made anew where the updated ones fail, and before it stops.
        width: Step of derivatives.

    Attributes:
        vector: The best point so far.
        residual: ``r`` there, of any shape with ``m`` numbers.
        jacobian: Its derivative, shape ``(m, n)``, approximately.
        cost: What it minimises, there.
        gain: By how much the last step made it smaller; infinite before the first.
        done: Whether nothing more is to be gained.
    """

    def __init__(
        self,
        vector: Array,
        bounds: tuple[Array, Array],
        *,
        size: int,
        origin: tuple[Array, Array, Array] | None = None,
        begun: bool = False,
        renew: bool = True,
        width: float = 0.01,
    ) -> None:
        self._low, self._high = bounds
        self.vector = np.clip(vector, *bounds)
        self._size, self._renew, self._width = size, renew, width
        self._damping, self._factors = _FULL, (1.0,)
        self._asked: list[Array] = []
        self._origin, self._begun = origin, begun
        self._stage = "begin"
        self._fresh = self._settled = self._right = self.done = False
        self.cost = self.gain = np.inf

    def ask(self) -> list[Array]:
        """Return points at which residuals are wanted, none where it is done or need not ask."""
        if self.done:
            self._asked = []
        elif self._stage == "begin":
            self._asked = self._first()
        elif self._stage == "renew":
            self._asked = self._around()[1:]
        else:
            if (self._fresh or self._right) and self._at_end():
                self.done = True
                return self.ask()
            self._asked = [self._trial(self._damping * factor) for factor in self._factors]
        return self._asked

    def tell(self, residuals: Sequence[Array]) -> None:
        """Take the residuals at the points asked for."""
        if self._stage == "begin":
            self._begin(residuals)
        elif self._stage == "renew":
            self._renewed(residuals)
        else:
            self._tried(residuals)

    def _first(self) -> list[Array]:
        """Return where to begin, with what derivatives take; nothing where both are known."""
        if self._origin is None:
            return self._around()
        if not self._begun:
            return [self.vector]
        self._begin([self._origin[1]])
        return []

    def _around(self) -> list[Array]:
        points = [self.vector]
        for d in range(len(self.vector)):
            moved = self.vector.copy()
            moved[d] += self._step(d)
            points.append(moved)
        return points

    def _step(self, d: int) -> float:
        return -self._width if self.vector[d] + self._width > self._high[d] else self._width

    def _begin(self, residuals: Sequence[Array]) -> None:
        self.residual, self.cost = residuals[0], self._price(residuals[0], self.vector)
        if self._origin is None:
            self._renewed(residuals[1:])
            return
        vector, residual, jacobian = self._origin
        self._stage, self.jacobian = "step", jacobian
        self._learn(self.vector - vector, residuals[0] - residual)

    def _renewed(self, residuals: Sequence[Array]) -> None:
        columns = [(r - self.residual).ravel() / self._step(d) for d, r in enumerate(residuals)]
        empty = np.zeros((self.residual.size, 0))
        self.jacobian = np.stack(columns, 1) if columns else empty
        self._stage, self._fresh, self._factors = "step", True, (1.0,)
        self._damping = min(self._damping, 1e-1)
        self.done = not columns

    def _tried(self, residuals: Sequence[Array]) -> None:
        costs = [self._price(r, v) for r, v in zip(residuals, self._asked, strict=True)]
        best = int(np.argmin(costs))
        promised = [self._promise(vector) for vector in self._asked]
        if costs[best] >= self.cost:
            self._failed()
            return
        self.gain = self.cost - costs[best]
        moved, change = self._asked[best] - self.vector, residuals[best] - self.residual
        self.vector, self.residual, self.cost = self._asked[best], residuals[best], costs[best]
        self._damping = max(self._damping * self._factors[best] * 0.1, 1e-9)
        self._factors = (1.0,)
        self._right = abs(self.gain - promised[best]) <= _KEPT * promised[best]
        self._learn(moved, change)
        if self.gain <= self._little:
            self._settle()
        else:
            self._settled = False

    @property
    def _little(self) -> float:
        return _LITTLE[0] + _LITTLE[1] * self.cost

    def _failed(self) -> None:
        self.gain, self._right = 0.0, False
        if self._settled:
            self.done = True
        elif self._renew and not self._fresh:
            self._stage = "renew"
        else:
            self._damping *= _CAREFUL[-1] if len(self._factors) > 1 else 1.0
            self._factors = _CAREFUL
            self.done = self._damping > _STUCK

    def _settle(self) -> None:
        """Make sure of the derivatives, once, before it stops."""
        if self._renew and not (self._fresh or self._right or self._settled):
            self._stage, self._settled = "renew", True
        else:
            self.done = True

    def _learn(self, moved: Array, change: Array) -> None:
        length = float(moved @ moved)
        if length > 0:
            wrong = change.ravel() - self.jacobian @ moved
            self.jacobian = self.jacobian + np.outer(wrong, moved / length)
            self._fresh = False

    def _at_end(self) -> bool:
        """Return whether no step promises anything.

        A damped one promises little anywhere; a full one may be cut off at a bound.
        """
        steps = [self._trial(damping) for damping in _RANGE]
        return max(self._promise(step) for step in steps) <= self._little

    def _promise(self, vector: Array) -> float:
        """Return what a point would gain if the derivatives held."""
        residual = self.residual.ravel() + self.jacobian @ (vector - self.vector)
        return self.cost - self._price(residual, vector)

    def _price(self, residual: Array, vector: Array) -> float:
        return float((residual**2).sum() + (vector[: self._size] ** 2).sum())

    def _trial(self, damping: float) -> Array:
        """Return the damped Gauss-Newton step's end, inside the bounds."""
        prior = np.zeros(len(self.vector))
        prior[: self._size] = 1.0
        normal = self.jacobian.T @ self.jacobian + np.diag(prior)
        gradient = self.jacobian.T @ self.residual.ravel() + prior * self.vector
        # coordinates at a bound that the gradient pushes against stay there
        low, high = self.vector <= self._low, self.vector >= self._high
        free = ~((low & (gradient > 0)) | (high & (gradient < 0)))
        step = np.zeros(len(self.vector))
        if free.any():
            part = normal[np.ix_(free, free)]
            part = part + damping * np.diag(np.diag(part) + 1e-9)
            step[free] = -np.linalg.solve(part, gradient[free])
        return np.clip(self.vector + step, self._low, self._high)
