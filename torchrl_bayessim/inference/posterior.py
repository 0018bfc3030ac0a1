r"""BayesSim's posterior: a mixture density network over features of the summary statistics.

.. math::
    q_\phi(\theta \mid x) = \Big|\tfrac{\partial z}{\partial\theta}\Big|
    \sum_{k=1}^K \pi_k(x)\, \frac{N(z; \mu_k(x), \Sigma_k(x))}{Z_k(x)}
    \quad\text{inside the prior's support, 0 outside,}

with :math:`z` the standardised parameters, :math:`Z_k` the mass of component k inside the prior's
box, and weights, means and covariances linear in the features of :math:`x` (Ramos, Possas & Fox,
2019, "BayesSim: adaptive domain randomization via probabilistic inference for robotics
simulators", arXiv:1906.01728, eq. 9-13). Nothing leaks outside the box and nothing is clipped.
"""

from __future__ import annotations

__all__ = ["TRAINING_POINTS", "MixtureDensityPosterior"]

import warnings
from functools import partial
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor

from ..counts import check_count
from ..errors import message
from ..kinds import check_choice, check_kind, real_numbers
from .design_effect import design_effect
from .features import Features, FourierFeatures, NeuralFeatures, ResidualFeatures
from .misspecification import doubts
from .mixtures import Mixture
from .network import Covariance, MixtureDensityNetwork
from .physics_posterior import PhysicsPosterior
from .pooling import pool
from .priors import Prior, check_prior
from .truncation import POINTS, TruncatedGaussianMixture

Pooling = Literal["product", "mean"]
MAPS = {"residual": ResidualFeatures, "neural": NeuralFeatures, "fourier": FourierFeatures}
TRAINING_POINTS = 8  # for the mass of correlated components while the loss is minimised


class MixtureDensityPosterior(ProbabilisticTensorDictSequential):
    """The amortised posterior as a TensorDict module: reads ``"summary"``, writes ``"theta"``.

    ``posterior.get_dist(td)`` returns the distribution for every summary in ``td``;
    ``posterior.condition(real)`` the one posterior for all the real trajectories together, which
    can be assigned to a randomizer's ``source``.

    Its ``state_dict`` holds what identifies the prior, and ``seen``: weights that were fitted under
    another prior are refused, and what was loaded warns as what was fitted does.

    Args:
        prior: Names, units, support and scaling of the parameters.
        summary_dim: Size L of the summary statistics.
        components: Number K of mixture components.
        covariance: ``"full"``, or ``"diagonal"`` as in the paper.
        features: ``"residual"``, ``"neural"``, ``"fourier"``, or a ``Features`` module.
        compress: Whether heavy tails of the summaries are compressed.
        in_key: Key of the summaries, shape ``(*, L)``.
        out_key: Key of the parameters, shape ``(*, D)``.
        seed: Of the initial weights and frequencies.

    Attributes:
        seen: Summaries that it was fitted to, up to a thousand; ``None`` before a fit.
        held_out: Pairs that chose the best epoch, with their weights if the fit had some.

    Raises:
        TypeError: The prior is none of :mod:`.priors`, or a size is no whole number.
        ValueError: A size that is not positive, an unknown feature map, or one of summaries of
            another size; when a state is loaded, one of another prior or another ``compress``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0), "friction": (0.5, 2.0)})
        >>> posterior = MixtureDensityPosterior(prior, 10)
        >>> data = posterior(TensorDict({"summary": torch.zeros(32, 10)}, [32]))
        >>> data["theta"].shape, data["theta_log_prob"].shape
        (torch.Size([32, 2]), torch.Size([32]))
        >>> posterior.condition(torch.zeros(3, 10)).sample((5,)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        prior: Prior,
        summary_dim: int,
        *,
        components: int = 4,
        covariance: Covariance = "full",
        features: Literal["residual", "neural", "fourier"] | Features = "residual",
        compress: bool = True,
        in_key: NestedKey = "summary",
        out_key: NestedKey = "theta",
        seed: int = 0,
    ) -> None:
        check_prior(prior)
        check_count("summary_dim", summary_dim)
        if not isinstance(features, Features):
            check_choice("the name of a feature map", features, MAPS)
        if isinstance(features, Features) and features.dim != summary_dim:
            expected = f"features of summaries of size {summary_dim}"
            raise ValueError(message(expected, f"of size {features.dim}", hint="summary_dim"))
        network = MixtureDensityNetwork(
            features if isinstance(features, Features) else MAPS[features](summary_dim, seed=seed),
            len(prior.names),
            components=components,
            covariance=covariance,
            reach=8.0 if prior.box is None else prior.box[1].max().item(),
            compress=compress,
            seed=seed,
        )
        keys: dict[str, NestedKey] = {name: ("posterior", name) for name in Mixture._fields}
        diagonal = covariance == "diagonal"
        modules = [
            TensorDictModule(network, in_keys=[in_key], out_keys=list(keys.values())),
            ProbabilisticTensorDictModule(
                in_keys=keys,
                out_keys=[out_key],
                distribution_class=partial(  # pyright: ignore[reportArgumentType]
                    _distribution, prior=prior, diagonal=diagonal, points=TRAINING_POINTS
                ),
                return_log_prob=True,
                log_prob_key=f"{out_key}_log_prob" if isinstance(out_key, str) else None,
            ),
        ]
        super().__init__(*modules)  # pyright: ignore[reportCallIssue, reportArgumentType]
        self.prior, self.summary_key, self.theta_key = prior, in_key, out_key
        self.compress = compress
        self.seen: Tensor | None = None
        self.held_out: TensorDictBase | None = None

    @classmethod
    def paper_mode(
        cls,
        prior: Prior,
        summary_dim: int,
        *,
        features: Literal["fourier", "neural"] = "fourier",
        seed: int = 0,
    ) -> MixtureDensityPosterior:
        """Return a posterior with the BayesSim paper's choices (arXiv:1906.01728, sec. III and V).

        Diagonal components, variances by the modified ELU, RBF features of plainly standardised
        summaries (length scale by :func:`.fit.select_lengthscale`) or two layers of 24 units. The
        paper does not say how many components and frequencies: 10 and 500, as in its code. The
        support is truncated all the same. Use it with ``cross_correlation`` and
        ``condition(..., pooling="mean")``.

        Example:
            >>> from torchrl_bayessim.inference.priors import BoxPrior
            >>> posterior = MixtureDensityPosterior.paper_mode(BoxPrior({"dt": (0.01, 0.3)}), 7)
            >>> posterior.network.components, posterior.network.covariance
            (10, 'diagonal')
        """
        check_prior(prior)
        check_count("summary_dim", summary_dim)
        maps = {
            "fourier": lambda: FourierFeatures(summary_dim, frequencies=500, seed=seed),
            "neural": lambda: NeuralFeatures(summary_dim, widths=(24, 24), seed=seed),
        }
        check_choice("the name of a feature map", features, maps)
        return cls(
            prior,
            summary_dim,
            components=10,
            covariance="diagonal",
            features=maps[features](),
            compress=False,
            seed=seed,
        )

    @property
    def network(self) -> MixtureDensityNetwork:
        """The network from summaries to mixture parameters."""
        return self.module[0].module  # pyright: ignore[reportReturnType]

    @property
    def device(self) -> torch.device:
        """Where the weights are: pairs and summaries are taken there, and answers lie there."""
        return self.network.shift.device

    def distribution(self, summary: Tensor, *, points: int = POINTS) -> PhysicsPosterior:
        """Return one posterior per summary, for summaries ``(*, L)``.

        ``points`` integrate the mass of a correlated component inside a box.
        """
        check_kind("summaries of shape (*, L), a tensor", summary, Tensor)
        check_count("points", points)
        if not summary.is_floating_point():
            raise TypeError(message("summaries of floats", str(summary.dtype)))
        return _distribution(
            **self.network(summary.to(self.device))._asdict(),
            prior=self.prior,
            diagonal=self.network.covariance == "diagonal",
            points=points,
        )

    @torch.no_grad()
    def condition(
        self, summaries: Tensor, *, pooling: Pooling = "product", check: bool = True
    ) -> PhysicsPosterior:
        r"""Return the posterior given the summaries of n real trajectories together.

        Warns if they lie apart from all the summaries that it was fitted to, or if the posterior
        piles up at an edge: see :mod:`.misspecification`.

        Args:
            summaries: Shape ``(n, L)`` or ``(L,)``, of trajectories as long as those that it was
                fitted to: it knows how sure a summary of so many steps is, and of no others. Of
                unequal lengths, fit it to summaries of all n together, as
                :meth:`.SummaryStatistics.together` makes them and the loop does.
            pooling: ``"product"``: :math:`\prod_i q(\theta \mid x_i) / p(\theta)^{n-1}`, the
                posterior of independent trajectories, so that more data sharpen it, with each
                answer as wide as :mod:`.design_effect` finds that they err together;
                ``"mean"``: the posterior of the averaged summary, as the paper does, which does
                not become sharper with n.
            check: Whether to look for reasons to doubt the result.

        Raises:
            TypeError: For what is not made of numbers, or ragged.
            ValueError: For no summaries, wrong shapes, NaN or infinite statistics.
        """
        size = len(self.network.shift)
        expected = f"summaries of n >= 1 real trajectories, numbers of shape (n, {size})"
        given = real_numbers(expected, summaries)
        given = given if given.is_floating_point() else given.to(torch.get_default_dtype())
        summaries = torch.atleast_2d(given.to(self.device))
        if summaries.shape != (len(summaries), size) or len(summaries) == 0:
            raise ValueError(
                message(
                    f"summaries of n >= 1 real trajectories, shape (n, {size})", tuple(given.shape)
                )
            )
        bad = ~summaries.isfinite().all(-1)
        if bad.any():
            raise ValueError(
                message(
                    "finite summary statistics of the real trajectories",
                    f"NaN or infinity in rows {bad.nonzero().flatten().tolist()}",
                    hint="drop these trajectories, or repair their logs",
                )
            )
        # sums and matrix products round a row differently at another place
        summaries = summaries[sorted(range(len(summaries)), key=summaries.tolist().__getitem__)]
        check_choice("a pooling", pooling, ["product", "mean"])
        if pooling == "mean":
            summaries = summaries.mean(0, keepdim=True)
        each = self.distribution(summaries).mixture
        bounded = self.prior.box is not None
        network = self.network
        effect = design_effect(
            each.untruncated, network.shared, at_edges=network.shared_at_edges, bounded=bounded
        )
        found = PhysicsPosterior(pool(each, bounded=bounded, effect=effect), self.prior)
        if check and self.seen is not None:
            for doubt in doubts(self.seen.to(summaries), summaries, found):
                warnings.warn(doubt, stacklevel=3)  # past the decorator
        return found

    def get_extra_state(self) -> dict[str, Any]:
        """Return what identifies the prior, what no weight shows, and the summaries of the fit."""
        settings = dict(self.prior.settings)
        return {"prior": settings, "compress": self.compress, "seen": self.seen}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Refuse weights that were fitted under another prior or other summaries."""
        fitted = dict(state["prior"])
        if fitted != self.prior.settings:
            raise ValueError(
                message(
                    f"weights fitted under {self.prior.settings}",
                    fitted,
                    hint="a posterior over the prior that they were fitted under",
                )
            )
        if state.get("compress", self.compress) != self.compress:
            expected = f"weights fitted with compress={self.compress}"
            raise ValueError(message(expected, f"compress={state['compress']}"))
        self.seen = state["seen"]

    def extra_repr(self) -> str:
        """Show the prior."""
        return repr(self.prior)


def _distribution(
    logits: Tensor,
    loc: Tensor,
    scale_tril: Tensor,
    *,
    prior: Prior,
    diagonal: bool,
    points: int = POINTS,
) -> PhysicsPosterior:
    mixture = TruncatedGaussianMixture(
        logits, loc, scale_tril, prior.box, diagonal=diagonal, points=points
    )
    return PhysicsPosterior(mixture, prior)
