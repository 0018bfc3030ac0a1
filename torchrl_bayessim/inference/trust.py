"""Everything that says whether to believe a posterior, in one report.

What the network knows from its fit is enough for the first three; the posterior predictive check
needs the simulator:

* does the real summary lie apart from all simulated ones, or the posterior at an edge
  (:mod:`.misspecification`);
* is the network calibrated on pairs that it was not trained on (:mod:`.calibration`);
* what do the data say about each parameter (:mod:`.identifiability`);
* would simulations at the posterior give the real summary: the share of them that lies at least as
  far from the others as the real one does.
"""

from __future__ import annotations

__all__ = ["Trust", "trust"]

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ..counts import check_count
from ..errors import message
from ..kinds import check_function, check_kind
from ..sources import draw
from .calibration import Calibration, calibrate
from .ensemble import real_summaries
from .identifiability import Identifiability, identifiability
from .misspecification import doubts, strangeness
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior

_FEWEST = 50  # pairs, below which shares say too little
_SURPRISE = 0.01  # share below which the real data are a surprise to the posterior


@dataclass(frozen=True)
class Trust:
    """The report; ``print`` shows it.

    Attributes:
        posterior: Given the real data.
        doubts: One sentence per reason not to believe it.
        identifiability: What the data say about each parameter.
        calibration: On held-out pairs; ``None`` if there are fewer than 50.
        predictive: Share of simulations at the posterior that lie at least as far out as the real
            summary, the least over several; ``None`` without a simulator.
    """

    posterior: PhysicsPosterior
    doubts: tuple[str, ...]
    identifiability: Identifiability
    calibration: Calibration | None
    predictive: float | None

    def __str__(self) -> str:
        found = [f"Doubt: {text}" for text in self.doubts] or ["No reason to doubt this posterior."]
        return "\n".join([*self.identifiability.sentences(), *found])


def trust(
    network: MixtureDensityPosterior,
    observed: Tensor,
    *,
    held_out: TensorDictBase | None = None,
    simulate: Callable[[Tensor], Tensor] | None = None,
    simulations: int = 200,
    seed: int = 0,
) -> Trust:
    """Condition a fitted network on real summaries, and report on the result.

    Args:
        network: After :func:`.fit.fit`.
        observed: Real summaries, shape ``(n, L)`` or ``(L,)``.
        held_out: Pairs that it was not trained on; by default those that chose its best epoch,
            which flatter it a little; none if the fit had weights.
        simulate: Parameters ``(N, D)`` to summaries ``(N, L)``, for the posterior predictive check.
        simulations: Of that check.
        seed: Same seed, same report.

    Raises:
        TypeError: An argument is of another kind, or ``observed`` is no numbers.
        ValueError: The network has not been fitted, or ``observed`` is not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bayessim.inference.fit import fit
        >>> from torchrl_bayessim.inference.priors import BoxPrior
        >>> prior = BoxPrior({"mass": (2.0, 6.0), "colour": (0.0, 1.0)})
        >>> theta = prior.sample((600,))
        >>> pairs = TensorDict({"theta": theta, "summary": theta[:, :1] + 0.1}, [600])
        >>> network = MixtureDensityPosterior(prior, 1)
        >>> report = fit(network, pairs, epochs=20, progress=False)
        >>> "nothing about colour" in str(trust(network, torch.tensor([4.0])))
        True
    """
    check_kind("a MixtureDensityPosterior", network, MixtureDensityPosterior)
    check_count("simulations", simulations)
    if simulate is not None:
        check_function("simulate, a function of parameters (N, D)", simulate)
    if held_out is not None:
        check_kind("held-out pairs in a TensorDict", held_out, TensorDictBase)
    if network.seen is None:
        raise ValueError(message("a fitted network", "one that is not", hint="fit(network, pairs)"))
    rows = torch.atleast_2d(real_summaries(observed))
    posterior = network.condition(rows, check=False)
    found = doubts(network.seen, rows, posterior)
    pairs = _unweighted(network.held_out) if held_out is None else held_out
    calibration = None
    if pairs is not None and len(pairs) >= _FEWEST:
        calibration = calibrate(network, pairs, seed=seed)
        found += calibration.doubts()
    predictive = None
    if simulate is not None:
        theta = draw(posterior, simulations, key=(seed, "predictive"))
        predicted = simulate(theta)
        predictive = min(strangeness(predicted, row)[0] for row in rows)
        if predictive <= max(_SURPRISE, 1.5 / simulations) / len(rows):
            found.append(
                f"only {predictive:.1%} of {simulations} simulations at the posterior lie as far "
                "out as the real summary: they do not reproduce the data."
            )
    return Trust(posterior, tuple(found), identifiability(posterior), calibration, predictive)


def _unweighted(pairs: TensorDictBase | None) -> TensorDictBase | None:
    """Return pairs that are all worth the same, as the ranks of a calibration need them."""
    return None if pairs is None or "weight" in pairs.keys() else pairs  # noqa: SIM118
