r"""Summary statistics of trajectories.

A summary is a function of states :math:`s_t`, actions :math:`a_t`, next states :math:`s_{t+1}` and
a mask, of shapes ``(*, T, D)``, ``(*, T, A)``, ``(*, T, D)`` and ``(*, T)``, with values of shape
``(*, L)``. Differences are :math:`\tau_t = s_{t+1} - s_t`, aligned with the action that caused
them. Sums run over the steps in the mask and are divided by their number, so a summary does not
encode the length of an episode unless it is asked to (:func:`duration`). Steps outside the mask
are never read.
"""

from __future__ import annotations

__all__ = [
    "Summary",
    "SummaryStatistics",
    "autocorrelation",
    "cross_correlation",
    "differences",
    "duration",
    "encode_actions",
    "linear_dynamics",
    "moments",
    "waypoints",
]

import math
from collections.abc import Callable, Sequence
from operator import index

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from .counts import check_count
from .errors import message
from .kinds import check_key, check_kind
from .trajectories import first_trajectories, next_key

Summary = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def encode_actions(action: Tensor) -> Tensor:
    """Return actions as floats: one-hot of two choices as -1 and +1, others unchanged.

    A discrete action coded 0 and 1 would make choice 0 invisible to every product.

    Example:
        >>> encode_actions(torch.tensor([[1, 0], [0, 1]])).flatten()
        tensor([-1.,  1.])
    """
    if not action.is_floating_point() and action.shape[-1] == 2:
        return 2.0 * action[..., 1:].float() - 1.0
    return action.float()


def differences(state: Tensor, next_state: Tensor, angles: Sequence[int] = ()) -> Tensor:
    r"""Return :math:`\tau_t`, wrapped to :math:`[-\pi, \pi)` in the columns ``angles``."""
    tau = next_state - state
    if angles:
        turns = tau[..., list(angles)]
        tau[..., list(angles)] = torch.remainder(turns + math.pi, 2 * math.pi) - math.pi
    return tau


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over time, ``(*, T, F)`` to ``(*, F)``."""
    count = mask.sum(-1, keepdim=True).clamp_min(1)
    return torch.where(mask.unsqueeze(-1), values, 0.0).sum(-2) / count


def cross_correlation(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    r"""The BayesSim paper's statistics, L = D A + 2 D.

    .. math::
        \psi = \big(\{\langle\tau_i, a_j\rangle\}_{i=1..D, j=1..A},\;
        \operatorname{E}[\tau],\; \operatorname{Var}[\tau]\big)

    (Ramos et al., 2019, arXiv:1906.01728, eq. 22), with the inner product divided by the number of
    steps and the variance unbiased. The paper sums without dividing, which makes the statistics of
    an environment that ends early mostly a measure of length.

    Example:
        >>> s = torch.tensor([[0.0], [1.0], [3.0]])
        >>> cross_correlation(s[:2], torch.tensor([[1.0], [-1.0]]), s[1:], torch.ones(2).bool())
        tensor([-0.5000,  1.5000,  0.5000])
    """
    tau = next_state - state
    product = (tau.unsqueeze(-1) * action.unsqueeze(-2)).flatten(-2)
    return torch.cat([_mean(product, mask), moments(state, action, next_state, mask)], -1)


def moments(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """Mean and unbiased variance of the differences, L = 2 D."""
    del action
    tau = next_state - state
    mean = _mean(tau, mask)
    count = mask.sum(-1, keepdim=True)
    centred = torch.where(mask.unsqueeze(-1), tau - mean.unsqueeze(-2), 0.0)
    variance = centred.square().sum(-2) / (count - 1).clamp_min(1)
    return torch.cat([mean, variance], -1)


def duration(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    """Logarithm of the number of steps, L = 1: when an episode ends is information too."""
    del state, action, next_state
    return mask.sum(-1, keepdim=True).clamp_min(1).float().log()


def autocorrelation(*lags: int) -> Summary:
    r"""Autocorrelations of the differences at each lag, and their variances; L = D (lags + 1).

    :math:`\rho_k = \operatorname{E}[\tau_t \tau_{t+k}] / \operatorname{E}[\tau_t^2]`, over the
    pairs of steps that both count. Frequencies and damping show here.

    Raises:
        TypeError: For a lag that is no whole number.
        ValueError: For no lags, or lags that are not positive.
    """
    if not lags:
        raise ValueError(message("positive lags", lags, hint="autocorrelation(1, 2, 4, 8)"))
    for lag in lags:
        check_count("steps of a lag", lag)

    def summary(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
        del action
        tau = next_state - state
        power = _mean(tau.square(), mask)
        parts = [power.clamp_min(1e-20).log()]
        for lag in lags:
            if lag >= tau.shape[-2]:
                parts.append(torch.zeros_like(power))
                continue
            both = mask[..., lag:] & mask[..., :-lag]
            product = tau[..., lag:, :] * tau[..., :-lag, :]
            parts.append(_mean(product, both) / power.clamp_min(1e-20))
        return torch.cat(parts, -1)

    return _ordered(summary, f"autocorrelation({', '.join(map(str, lags))})")


def waypoints(count: int) -> Summary:
    """States at ``count`` moments spread evenly over each trajectory's own length; L = D count.

    Raises:
        TypeError: If ``count`` is no whole number.
        ValueError: If ``count`` is not positive.
    """
    check_count("waypoints", count)

    def summary(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
        del state, action
        length = mask.sum(-1, keepdim=True).clamp_min(1)
        share = torch.arange(1, count + 1, device=mask.device) / count
        place = (share * length).ceil().long().clamp_min(1) - 1  # among the steps that count
        step = (~mask).long().argsort(dim=-1, stable=True).gather(-1, place)
        return next_state.take_along_dim(step.unsqueeze(-1), -2).flatten(-2)

    return _ordered(summary, f"waypoints({count})")


def _ordered(summary: Summary, name: str) -> Summary:
    """Name a summary whose value depends on the order of the steps, and say that it does."""
    setattr(summary, "__qualname__", name)  # noqa: B010 (a function's attributes have no types)
    setattr(summary, "ordered", True)  # noqa: B010
    return summary


def linear_dynamics(state: Tensor, action: Tensor, next_state: Tensor, mask: Tensor) -> Tensor:
    r"""Least-squares dynamics and what they leave, L = D (D + A + 1) + D.

    The coefficients W of :math:`\tau_t \approx W [s_t, a_t, 1]` and the logarithm of each output's
    residual variance. The coefficients depend on the physics and hardly on the policy, which makes
    them sharper than correlations wherever the dynamics are smooth. A ridge of 1e-6 of each
    regressor's own variance keeps short trajectories and constant columns harmless.

    Example:
        >>> s = torch.cumsum(torch.randn(1, 65, 1), -2)
        >>> a = s[:, 1:] - 0.9 * s[:, :-1]            # s' = 0.9 s + a
        >>> mask = torch.ones(1, 64, dtype=torch.bool)
        >>> linear_dynamics(s[:, :-1], a, s[:, 1:], mask)[0, :2].round(decimals=3)
        tensor([-0.1000,  1.0000])
    """
    state, next_state = _float(state), _float(next_state)
    count = mask.sum(-1).clamp_min(1)[..., None, None]

    def centred(values: Tensor) -> tuple[Tensor, Tensor]:
        values = torch.where(mask.unsqueeze(-1), values, 0.0).double()
        mean = values.sum(-2, keepdim=True) / count
        return torch.where(mask.unsqueeze(-1), values - mean, 0.0), mean

    # centred, so that the ridge does not grow with the distance of a state from its origin
    regressors, mean = centred(torch.cat([state, action], -1))
    tau, drift = centred(next_state - state)
    gram = regressors.mT @ regressors / count
    power = gram.diagonal(dim1=-2, dim2=-1)
    gram = gram + torch.diag_embed(1e-6 * power + 1e-12)
    solution, _ = torch.linalg.solve_ex(gram, regressors.mT @ tau / count)
    constant = drift - mean @ solution
    residual = (tau - regressors @ solution).square().sum(-2) / count.squeeze(-1)
    scale = tau.square().sum(-2) / count.squeeze(-1) + drift.squeeze(-2).square()
    left = ((residual + 1e-12) / (scale + 1e-12)).log()
    coefficients = torch.cat([solution, constant], -2).mT.flatten(-2)
    return torch.cat([coefficients, left], -1).to(state.dtype)


class SummaryStatistics(TensorDictModuleBase):
    """Summaries of a batch of trajectories: a TensorDict module, and a collector's ``postproc``.

    Turns a batch of size ``[*, T]`` into one of size ``[*]`` with the summary and, where present,
    the parameters of each row's first trajectory. A row counts from its first step on: as a
    ``postproc`` it needs a collector with ``reset_at_each_iter=True``, or the later batches of an
    episode are summarised as if they were trajectories of their own.

    Args:
        *functions: Summaries; their values are concatenated. One whose value depends on the order
            of the steps has an attribute ``ordered = True``: see :meth:`together`.
        angles: Columns of the observation that are raw angles in radians.
        observation_key: Key of the state.
        action_key: Key of the action; one-hot actions are encoded by :func:`encode_actions`.
        out_key: Key of the summary.
        theta_key: Key of the parameters, which are handed on where present.

    Raises:
        TypeError: For what is not a function, angles that are no sequence of columns, or keys that
            are none; in a call, for what is no TensorDict, or a function that returns no tensor.
        ValueError: For no functions; in a call, for discrete actions given as indices, no step, no
            batch size, observations that are no vectors, or a function that returns no summary of
            shape ``(*, L)``.
        KeyError: In a call, for a missing entry.

    Example:
        >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
        >>> statistics = SummaryStatistics(cross_correlation, duration)
        >>> statistics(CartPoleEnv(8).rollout(50, break_when_any_done=False))["summary"].shape
        torch.Size([8, 13])
    """

    def __init__(
        self,
        *functions: Summary,
        angles: Sequence[int] = (),
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        out_key: NestedKey = "summary",
        theta_key: NestedKey = "theta",
        one_hot: bool = True,
    ) -> None:
        super().__init__()
        if not functions:
            raise ValueError(message("at least one summary", "none", hint="cross_correlation"))
        for function in functions:
            if not callable(function):
                expected = "functions of (state, action, next_state, mask)"
                raise TypeError(message(expected, function, hint="summaries.linear_dynamics"))
        keys = {"observation": observation_key, "action": action_key, "theta": theta_key}
        for name, key in {**keys, "out": out_key}.items():
            check_key(f"{name}_key", key)
        self.functions, self.angles = functions, _columns(angles)
        self.observation_key, self.action_key = observation_key, action_key
        self.theta_key, self.one_hot = theta_key, one_hot
        self.in_keys = [observation_key, action_key, next_key(observation_key), ("next", "done")]
        self.out_keys = [out_key]

    def together(self, trajectories: TensorDictBase) -> Tensor:
        """Return one summary of n trajectories of one system, ``[*, n, T]`` to ``(*, L)``.

        The steps of all n count as those of one long trajectory (each difference lies within its
        own), so regressions and correlations use all the data at once. A posterior learned on
        such summaries is that of the n trajectories together; multiplying n single-trajectory
        posteriors would multiply the network's errors too. Summaries that depend on the order of
        the steps (``ordered``: autocorrelations, waypoints) are those of each trajectory, averaged
        over the n.

        Example:
            >>> from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
            >>> rows = first_trajectories(CartPoleEnv(8).rollout(50, break_when_any_done=False))
            >>> SummaryStatistics(moments).together(rows.unflatten(0, (2, 4))).shape
            torch.Size([2, 8])
        """
        trajectories = self._masked(trajectories)
        self._check_vectors(trajectories)
        mask = trajectories.get("mask")
        # steps that do not count go to the end, as in any padded trajectory
        order = (~mask.flatten(-2)).long().argsort(dim=-1, stable=True)
        steps = TensorDict({"mask": mask.flatten(-2).gather(-1, order)}, order.shape)
        for key in (self.observation_key, self.action_key, next_key(self.observation_key)):
            values = trajectories.get(key).flatten(-3, -2)
            rows = order.unsqueeze(-1).expand(values.shape)
            steps.set(key, values.gather(-2, rows))
        pooled = self._values(steps, ordered=False)
        each = self._values(trajectories, ordered=True)
        parts = [
            each[i].mean(-2) if _is_ordered(function) else pooled[i]
            for i, function in enumerate(self.functions)
        ]
        return torch.cat(parts, -1)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``{"summary": (*, L)[, "theta": (*, D)]}`` of trajectories ``[*, T]``."""
        check_kind("trajectories in a TensorDict", tensordict, TensorDictBase)
        if not tensordict.ndim:
            raise ValueError(message("trajectories of batch size [*, T]", "no batch size"))
        tensordict = self._masked(tensordict)
        values = self._values(tensordict)
        out = TensorDict({}, batch_size=tensordict.batch_size[:-1])
        out.set(self.out_keys[0], torch.cat(list(values.values()), -1))
        theta = tensordict.get(self.theta_key, None)
        if theta is None:
            return out
        first = tensordict.get("mask").long().argmax(-1)[..., None, None]
        return out.set(self.theta_key, theta.take_along_dim(first, -2).squeeze(-2))

    def _values(
        self, tensordict: TensorDictBase, *, ordered: bool | None = None
    ) -> dict[int, Tensor]:
        """Return the values of all functions, or of those that are ``ordered`` or not."""
        self._check_vectors(tensordict)
        state, mask = _float(tensordict.get(self.observation_key)), tensordict.get("mask")
        following = _float(tensordict.get(next_key(self.observation_key)))
        if any(not -state.shape[-1] <= column < state.shape[-1] for column in self.angles):
            columns = f"angles among the {state.shape[-1]} columns of {self.observation_key!r}"
            raise ValueError(message(columns, self.angles))
        action = self._encoded(tensordict.get(self.action_key), mask)
        # angles are unwrapped through their wrapped differences, once, for every summary
        tau = differences(state, following, self.angles)
        finite = torch.stack([x.isfinite().all(-1) for x in (state, action, following)]).all(0)
        usable = (mask.any(-1) & (finite | ~mask).all(-1)).unsqueeze(-1)
        return {
            i: torch.where(usable, _summary(function, state, action, state + tau, mask), torch.nan)
            for i, function in enumerate(self.functions)
            if ordered in (None, _is_ordered(function))
        }

    def _masked(self, trajectories: TensorDictBase) -> TensorDictBase:
        """Return trajectories with a ``"mask"``: of each row's first one, unless there is one."""
        check_kind("trajectories in a TensorDict", trajectories, TensorDictBase)
        mask = trajectories.get("mask", None)
        if mask is None:
            _check_entries(trajectories, self.in_keys)
            return first_trajectories(trajectories)
        if mask.dtype != torch.bool:
            raise TypeError(message("booleans in 'mask'", str(mask.dtype), hint="mask > 0"))
        return trajectories

    def _check_vectors(self, trajectories: TensorDictBase) -> None:
        """Refuse states and actions that are not of shape ``(*, T, size)``."""
        _check_entries(trajectories, self.in_keys[:3])
        dimensions = trajectories.get("mask").ndim + 1
        shape = trajectories.get(self.observation_key).shape
        if len(shape) != dimensions:
            expected = f"vectors in {self.observation_key!r}, shape (*, T, D)"
            hint = "FlattenObservation(-2, -1) for matrices, CatTensors for several entries"
            raise ValueError(message(expected, tuple(shape), hint=hint))
        action = trajectories.get(self.action_key)
        index = self.one_hot and action.shape[-1] == 1 and not action.is_floating_point()
        if index or action.ndim != dimensions:
            kind = "" if action.is_floating_point() else "indices of "
            raise ValueError(
                message(
                    "one-hot actions or torques, of shape (*, T, A)",
                    f"{kind}shape {tuple(action.shape)}",
                    hint="an environment with categorical_action_encoding=False; in logs, "
                    "torch.nn.functional.one_hot"
                    if kind
                    else "unsqueeze(-1) for one torque",
                )
            )

    def _encoded(self, action: Tensor, mask: Tensor) -> Tensor:
        """Return actions as floats, shape ``(*, T, A)``."""
        if action.is_floating_point():
            return action
        if not self.one_hot:
            return action.float()
        encoded = encode_actions(action)
        if action.shape[-1] == 2:  # of which one column is kept
            wrong = action[mask & (action.long().sum(-1) != 1)]
            if len(wrong):
                hint = "SummaryStatistics(..., one_hot=False)"
                raise ValueError(message("one-hot actions", wrong[0].tolist(), hint=hint))
        return encoded

    def __repr__(self) -> str:
        names = [getattr(f, "__qualname__", type(f).__name__) for f in self.functions]
        keys = f"{self.observation_key!r}, {self.action_key!r} -> {self.out_keys[0]!r}"
        options = "" if self.one_hot else ", one_hot=False"
        return f"SummaryStatistics({', '.join(names)}, angles={self.angles}, {keys}{options})"


def _columns(angles: Sequence[int]) -> tuple[int, ...]:
    try:
        return tuple(index(column) for column in angles)
    except (TypeError, RuntimeError):
        expected = "a sequence of columns of the observation that are angles"
        raise TypeError(message(expected, angles, hint="angles=(0,)")) from None


def _check_entries(trajectories: TensorDictBase, keys: Sequence[NestedKey]) -> None:
    missing = [key for key in keys if trajectories.get(key, None) is None]
    if missing:
        available = trajectories.keys(include_nested=True, leaves_only=True)
        raise KeyError(message("trajectories with an entry", missing[0], available=available))
    if not trajectories.batch_size.numel():
        got = f"batch size {tuple(trajectories.batch_size)}"
        raise ValueError(message("trajectories of at least one step", got))


def _float(values: Tensor) -> Tensor:
    """Return encoder counts and other integers as floats, which differences and means are."""
    return values if values.is_floating_point() else values.to(torch.get_default_dtype())


def _is_ordered(function: Summary) -> bool:
    return getattr(function, "ordered", False)


def _summary(function: Summary, *trajectories: Tensor) -> Tensor:
    """Return a function's value, which is not broadcast where it has another shape."""
    value = function(*trajectories)
    name = getattr(function, "__name__", type(function).__name__)
    check_kind(f"a tensor from {name}", value, Tensor)
    batch = trajectories[0].shape[:-2]
    if value.ndim != len(batch) + 1 or value.shape[:-1] != batch:
        expected = f"a summary of shape {(*batch, 'L')} from {name}, one for each trajectory"
        raise ValueError(message(expected, tuple(value.shape), hint="unsqueeze(-1) of one number"))
    return value
