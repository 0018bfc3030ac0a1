"""A posterior that is refined each time it is asked: the inference half of the loop.

Every refinement simulates where the last posterior is, fits a fresh network, and conditions it on
*all* the real data together. With a box prior the simulations come from a smaller box around the
last posterior (see :func:`.proposals.focus`): uniform, so nothing needs weights, and the network
resolves what it sees. With an unbounded prior they come from the last posterior mixed with the
prior, weighted by bounded importance weights.
"""

from __future__ import annotations

__all__ = ["PosteriorRefinement"]

import math
import warnings
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from ..counts import check_count
from ..errors import message
from ..kinds import check_function, check_kind
from ..randomness import check_draw_key, seed_from
from ..sources import Defensive, check_prior_share, draw
from .averaged_posterior import AveragedPosterior
from .ensemble import NETWORKS, PosteriorMaker, learn, pairs_of, real_summaries
from .fit import FitReport, check_fit_options
from .misspecification import doubts
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior
from .priors import BoxPrior, Prior, check_prior
from .proposals import focus, importance_weights
from .truncation import TruncatedGaussianMixture
from .trust import (
    FEWEST,
    LEAST_SIMULATIONS,
    Trust,
    contradictions,
    reported,
    with_pooled,
    with_predictive,
)


class PosteriorRefinement:
    """The posterior so far, and how to improve it.

    Args:
        prior: What is believed before any data.
        simulations: Pairs per refinement, where it simulates itself. Fewer than 50 are too few to
            tell whether the real summary lies apart, and nothing is said of it then.
        networks: Networks fitted each time; the posterior is their average, which is less sure
            where they disagree: see :mod:`.ensemble`.
        make_posterior: ``(prior, summary size)`` to a fresh network; a default one if omitted.
        margin: Widening of the box around the last posterior, as a share of it: see
            :func:`.proposals.focus`.
        predictive: Further simulations, each time that :meth:`refine` has conditioned, which tell
            whether the posterior gives the real summary: at least 99; 0 for no such check.
            :meth:`learn`, which does not simulate, has none.
        truths: Known parameters, each time, at which the answer for n trajectories together is
            checked with n simulations each: at least 50; 0 for no such check, nor for one.
        prior_share: Share of prior draws where importance weights are used; bounds them by its
            inverse.
        seed: Same seed, same refinements.
        fit_options: Passed to :func:`.fit.fit`.

    Attributes:
        posterior: The last posterior; ``None`` before the first refinement.
        network: The networks that gave it, for other real data; ``None`` before the first
            refinement, and after a state was loaded.
        trust: What is to be said of it: what the data tell about each parameter, calibration,
            doubts and, with ``predictive``, whether simulations at it give the real summary, see
            :mod:`.trust`; ``None`` as ``network`` is.

    Raises:
        TypeError: The prior is none of :mod:`.priors`, or a count is no whole number.
        ValueError: For counts that are too small, a margin that is negative or not finite, a
            ``prior_share`` that is no probability, or options that :func:`.fit.fit` does not have.

    Example:
        >>> prior = BoxPrior({"a": (-1.0, 1.0)})
        >>> refinement = PosteriorRefinement(prior, simulations=512,
        ...                                  fit_options={"epochs": 60, "progress": False})
        >>> for turn in range(2):  # x = theta, so the posterior is as sharp as the network is
        ...     report = refinement.refine(lambda theta: theta, torch.tensor([0.5]), key=(turn,))
        >>> abs(refinement.posterior.mean.item() - 0.5) < 0.1
        True
        >>> print(refinement.trust)
        These data say much about a: ...
    """

    def __init__(
        self,
        prior: Prior,
        *,
        simulations: int = 1024,
        networks: int = NETWORKS,
        make_posterior: PosteriorMaker | None = None,
        margin: float = 1.0,
        predictive: int = 0,
        truths: int = 0,
        prior_share: float = 0.25,
        seed: int = 0,
        fit_options: Mapping[str, Any] | None = None,
    ) -> None:
        check_prior(prior)
        check_count("simulations", simulations, least=4)
        check_count("networks", networks)
        if not (isinstance(margin, Real) and 0 <= margin < math.inf):
            raise ValueError(message("a finite margin of 0 or more", margin))
        check_prior_share(prior_share)
        if predictive != 0:
            check_count("predictive", predictive, least=LEAST_SIMULATIONS)
        if truths != 0:
            check_count("truths", truths, least=FEWEST)
        check_fit_options({} if fit_options is None else fit_options)
        if make_posterior is not None:
            expected = "make_posterior, a function of the prior and the summary's size"
            check_function(expected, make_posterior)
        self.prior, self.simulations, self.networks = prior, simulations, networks
        self.make_posterior = MixtureDensityPosterior if make_posterior is None else make_posterior
        self.margin, self.prior_share, self.seed = margin, prior_share, seed
        self.predictive, self.truths = predictive, truths
        self.fit_options = {} if fit_options is None else dict(fit_options)
        self.posterior: PhysicsPosterior | None = None
        self.network: AveragedPosterior | None = None
        self.trust: Trust | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """What refinements depend on besides their data; a loop refuses a checkpoint of others."""
        return {
            "prior": self.prior.settings,
            "simulations": self.simulations,
            "networks": self.networks,
            "make_posterior": getattr(self.make_posterior, "__qualname__", ""),
            "margin": self.margin,
            "prior_share": self.prior_share,
            "seed": self.seed,
            "fit_options": repr({k: v for k, v in self.fit_options.items() if k != "progress"}),
            # not there in checkpoints of before
            **({"predictive": self.predictive} if self.predictive else {}),
            **({"truths": self.truths} if self.truths else {}),
        }

    def refine(
        self,
        simulate: Callable[[Tensor], Tensor],
        observed: Any,
        *,
        key: tuple[int | str, ...],
        progress: bool = True,
    ) -> FitReport:
        """Simulate, fit and condition once; the result is :attr:`posterior`.

        Args:
            simulate: Parameters ``(N, D)`` to summaries ``(N, L)``.
            observed: The real summary, shape ``(L,)``, or those of n independent trajectories,
                shape ``(n, L)``.
            key: What this refinement is: same key, same parameters are drawn.
            progress: Whether the fits show progress bars, where ``fit_options`` do not say.

        Raises:
            TypeError: ``observed`` is not made of numbers, ``simulate`` no function or ``key`` no
                tuple; nothing is simulated then.
            ValueError: ``observed`` is not finite, or of another shape; nor then.
        """
        observed = real_summaries(observed)
        check_draw_key(key)
        check_function("simulate, a function of parameters (N, D)", simulate)
        theta = draw(self.proposal(), self.simulations, key=(self.seed, *key, "theta"))
        report = self.learn(theta, simulate(theta), observed, key=key, progress=progress)
        self._check(simulate, observed, key=key)
        return report

    def _check(
        self, simulate: Callable[[Tensor], Tensor], observed: Tensor, *, key: tuple[int | str, ...]
    ) -> None:
        """Add to the report what takes simulations."""
        assert self.trust is not None
        assert self.network is not None
        before, rows = self.trust.doubts, torch.atleast_2d(observed)
        if self.truths and len(rows) > 1:
            own = seed_from(self.seed, *key, "truths")
            self.trust = with_pooled(
                self.trust, self.network, simulate, rows, truths=self.truths, seed=own
            )
        if self.predictive:
            own = seed_from(self.seed, *key, "predictive")
            self.trust = with_predictive(
                self.trust, simulate, observed, simulations=self.predictive, seed=own
            )
        for doubt in self.trust.doubts[len(before) :]:
            warnings.warn(doubt, stacklevel=3)

    def proposal(self) -> Any:
        """Return the source that the parameters of the next pairs are to be drawn from."""
        return self._proposal()[1]

    def learn(
        self,
        theta: Tensor,
        summary: Tensor,
        observed: Any,
        *,
        key: tuple[int | str, ...],
        progress: bool = True,
    ) -> FitReport:
        """Fit and condition once, on pairs that were simulated elsewhere.

        Warns if the real summary lies apart from all simulated ones, or the posterior at an edge:
        see :mod:`.misspecification`.

        Args:
            theta: Drawn from the present :meth:`proposal`, shape ``(N, D)``.
            summary: Simulated at ``theta``, shape ``(N, L)``.
            observed: The real summary, shape ``(L,)``, or those of n independent trajectories,
                shape ``(n, L)``.
            key: What this refinement is.
            progress: Whether the fits show progress bars, where ``fit_options`` do not say.
        """
        observed = real_summaries(observed)
        check_draw_key(key)
        local, proposal = self._proposal()
        pairs = pairs_of(theta, summary)
        if proposal is not local:
            counted = [(proposal, len(theta))]
            pairs["weight"] = importance_weights(theta, self.prior, counted)
        self.network, self.posterior, report = learn(
            pairs,
            local,
            observed,
            make_posterior=self.make_posterior,
            seeds=[seed_from(self.seed, *key, "fit", i) for i in range(self.networks)],
            fit_options={"progress": progress} | self.fit_options,
        )
        found = [
            *doubts(summary, observed, self.posterior),
            *contradictions(self.network, observed),
        ]
        for doubt in found:
            warnings.warn(doubt, stacklevel=2)
        own = seed_from(self.seed, *key, "trust")
        self.trust = reported(
            self.network,
            self.posterior,
            found,
            trajectories=len(torch.atleast_2d(observed)),
            prior=self.prior,
            seed=own,
        )
        return report

    def _proposal(self) -> tuple[Prior, Any]:
        """Return the prior that the network is to know, and what is simulated."""
        if self.posterior is None:
            return self.prior, self.prior
        if isinstance(self.prior, BoxPrior):
            local = focus(self.prior, self.posterior, margin=self.margin, seed=self.seed)
            return local, local
        return self.prior, Defensive(self.posterior, self.prior, self.prior_share)

    def state_dict(self) -> dict[str, Any]:
        """Return the posterior as tensors and plain values."""
        if self.posterior is None:
            return {}
        mixture, local = self.posterior.mixture, self.posterior.prior
        state: dict[str, Any] = {
            "logits": mixture.logits,
            "loc": mixture.loc,
            "scale_tril": mixture.scale_tril,
            "diagonal": mixture.diagonal,
        }
        if isinstance(local, BoxPrior):
            state |= {"low": local.low, "high": local.high}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from such a state.

        Raises:
            TypeError: It is no mapping.
            ValueError: It is of another kind of prior, or not whole.
        """
        check_kind("the state of a refinement", state, Mapping)
        state = dict(state)
        needed = ["logits", "loc", "scale_tril", "diagonal"]
        needed += ["low", "high"] if isinstance(self.prior, BoxPrior) else []
        for name in needed if state else ():
            if name not in state:
                expected = f"the state of a refinement under {self.prior!r}, with {name!r}"
                raise ValueError(message(expected, sorted(map(str, state))))
        self.network = self.trust = None
        if not state:
            self.posterior = None
            return
        local = self.prior
        if isinstance(local, BoxPrior):
            local = local.within(state["low"], state["high"])
        mixture = TruncatedGaussianMixture(
            state["logits"],
            state["loc"],
            state["scale_tril"],
            local.box,
            diagonal=state["diagonal"],
        )
        self.posterior = PhysicsPosterior(mixture, local)
