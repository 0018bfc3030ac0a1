"""Everything that says whether to believe a posterior, in one report.

What the network knows from its fit is enough for the first three; the posterior predictive check
needs the simulator:

* does the real summary lie apart from all simulated ones, or the posterior at an edge
  (:mod:`.misspecification`);
* is the network calibrated on pairs that it was not trained on (:mod:`.calibration`), and, which
  takes the simulator, its answer for as many trajectories together as there are;
* what do the data say about each parameter (:mod:`.identifiability`);
* would simulations at the posterior give the real summary: the share of them that lies at least as
  far from the others as the real one does; of n trajectories, the share of groups of n, by their
  means and by how far they lie apart.
"""

from __future__ import annotations

__all__ = [
    "FEWEST",
    "LEAST_SIMULATIONS",
    "Trust",
    "contradictions",
    "reported",
    "trust",
    "with_pooled",
    "with_predictive",
]

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ..counts import check_count
from ..errors import message
from ..kinds import check_function, check_kind
from ..randomness import generator
from ..sources import draw
from .averaged_posterior import AveragedPosterior
from .calibration import Calibration, calibrate, calibrate_pooled
from .design_effect import dispersion
from .ensemble import real_summaries
from .identifiability import Identifiability, identifiability
from .misspecification import doubts, strangeness
from .physics_posterior import PhysicsPosterior
from .posterior import MixtureDensityPosterior
from .priors import Prior

FEWEST = 50  # pairs, below which shares say too little
_ALIKE = 20  # simulations of which the parameters are nearly the same
_SURPRISE = 0.01  # share below which the real data are a surprise to the posterior
_APART, _UNLIKELY = 2.0, 1e-4  # how far answers lie apart, and how likely: they contradict
LEAST_SIMULATIONS = round(1 / _SURPRISE) - 1  # that can tell such a share


@dataclass(frozen=True)
class Trust:
    """The report; ``print`` shows it.

    Attributes:
        posterior: Given the real data.
        doubts: One sentence per reason not to believe it.
        identifiability: What the data say about each parameter.
        calibration: Of answers for one trajectory, on held-out pairs; ``None`` without at least 50.
        predictive: Share of simulations at the posterior that lie at least as far out as the real
            summary, or of n of them as far as n real ones, by their means and by how much farther
            than usual they lie apart; 0 if all diverged, ``None`` without a simulator.
        pooled: Calibration of answers for n trajectories together, at parameters of the prior;
            ``None`` for one trajectory, or without a simulator and ``truths``.
        trajectories: How many real ones there are.
    """

    posterior: PhysicsPosterior
    doubts: tuple[str, ...]
    identifiability: Identifiability
    calibration: Calibration | None
    predictive: float | None
    pooled: Calibration | None = None
    trajectories: int = 1

    @property
    def unchecked(self) -> tuple[str, ...]:
        """What could not be looked at, in words."""
        found = []
        if self.calibration is None:
            found.append(f"calibration, without {FEWEST} held-out pairs of equal weight")
        if self.trajectories > 1 and self.pooled is None:
            found.append(
                f"calibration of {self.trajectories} together, without simulate and truths"
            )
        if self.predictive is None:
            found.append("whether simulations at the posterior give such data, without simulate")
        return tuple(found)

    def __str__(self) -> str:
        found = [f"Doubt: {text}" for text in self.doubts] or ["No reason to doubt this posterior."]
        found += [f"Not checked: {text}." for text in self.unchecked]
        return "\n".join([*self.identifiability.sentences(), *found])


def trust(
    network: MixtureDensityPosterior | AveragedPosterior,
    observed: Tensor,
    *,
    prior: Prior | None = None,
    held_out: TensorDictBase | None = None,
    simulate: Callable[[Tensor], Tensor] | None = None,
    simulations: int = 200,
    truths: int = 0,
    seed: int = 0,
) -> Trust:
    """Condition a fitted network, or several, on real summaries, and report on the result.

    Args:
        network: After :func:`.fit.fit`; or the average of several.
        observed: Real summaries, shape ``(n, L)`` or ``(L,)``.
        prior: What was believed before any data, if not what the network was fitted under.
        held_out: Pairs that it was not trained on; by default those that chose its best epoch and
            its width, which flatter it; none if the fit had weights.
        simulate: Parameters ``(N, D)``, on the CPU, to summaries ``(N, L)``, for the posterior
            predictive check.
        simulations: Of that check, at least 99.
        truths: Known parameters at which the answer for n trajectories is checked, at least 50,
            with n simulations each; 0 for none. A hundred of ten take half a minute to condition.
        seed: Same seed, same report.

    Raises:
        TypeError: An argument is of another kind, or ``observed`` is no numbers.
        ValueError: The network has not been fitted, ``observed`` is not finite, or ``simulate``
            does not give a summary like it for each simulation.

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
    check_kind("a MixtureDensityPosterior", network, MixtureDensityPosterior, AveragedPosterior)
    check_count("simulations", simulations, least=LEAST_SIMULATIONS)
    if simulate is not None:
        check_function("simulate, a function of parameters (N, D)", simulate)
    if held_out is not None:
        check_kind("held-out pairs in a TensorDict", held_out, TensorDictBase)
    if network.seen is None:
        raise ValueError(message("a fitted network", "one that is not", hint="fit(network, pairs)"))
    if truths != 0:
        check_count("truths", truths, least=FEWEST)
        if simulate is None:
            raise ValueError(message("simulate, for summaries at the truths", "truths without it"))
    rows = torch.atleast_2d(real_summaries(observed))
    posterior = network.condition(rows, check=False)
    found = [*doubts(network.seen, rows, posterior), *contradictions(network, rows)]
    count = len(rows)
    told = reported(
        network, posterior, found, trajectories=count, prior=prior, held_out=held_out, seed=seed
    )
    if simulate is None:
        return told
    if count > 1 and truths:
        told = with_pooled(told, network, simulate, rows, truths=truths, seed=seed)
    return with_predictive(told, simulate, rows, simulations=simulations, seed=seed)


@torch.no_grad()
def contradictions(
    network: MixtureDensityPosterior | AveragedPosterior, observed: Tensor
) -> list[str]:
    """Return a sentence where answers to single trajectories lie too far apart for one system.

    Twice as far as networks may be too sure of, and less likely than 1 in 10,000 of right ones: see
    :func:`.design_effect.dispersion`.

    Args:
        network: As of :func:`trust`.
        observed: As of :func:`trust`.
    """
    rows = torch.atleast_2d(observed)
    if len(rows) < 2:
        return []
    each = network.distribution(rows.to(torch.get_default_dtype())).mixture.untruncated
    apart, likely = dispersion(each, bounded=network.prior.box is not None)
    names = [
        name
        for name, far, p in zip(network.prior.names, apart, likely, strict=True)
        if far > _APART and p < _UNLIKELY
    ]
    if not names:
        return []
    return [
        f"the {len(rows)} trajectories contradict each other about {', '.join(names)}. Either they "
        "are of several systems, or no parameter explains them all: torchrl_bayessim.diagnosis "
        "finds what the simulator lacks."
    ]


def with_predictive(
    told: Trust,
    simulate: Callable[[Tensor], Tensor],
    observed: Tensor,
    *,
    simulations: int,
    seed: int = 0,
) -> Trust:
    """Return the report with a posterior predictive check.

    Args:
        told: Without one.
        simulate: As of :func:`trust`.
        observed: As of :func:`trust`.
        simulations: As of :func:`trust`.
        seed: Same seed, same parameters.

    Raises:
        ValueError: ``simulate`` does not give a summary like it for each simulation.
    """
    rows = torch.atleast_2d(observed).cpu()
    theta = draw(told.posterior, simulations, key=(seed, "predictive"))
    predicted = _predicted(simulate, theta, rows)
    finite = predicted.isfinite().all(-1)
    theta, predicted = theta[finite], predicted[finite]
    if not len(predicted):
        surprise = f"all {simulations} simulations at the posterior diverged: the robot did not."
        return replace(told, doubts=(*told.doubts, surprise), predictive=0.0)
    predictive = _share_as_far(theta, predicted, rows, seed=seed)
    if predictive <= _SURPRISE:
        real = "summary" if len(rows) == 1 else f"{len(rows)} summaries together"
        surprise = (
            f"only {predictive:.1%} of {simulations} simulations at the posterior lie as far "
            f"out as the real {real}: they do not reproduce the data. If more simulations for the "
            "fit change nothing, no parameter does: torchrl_bayessim.diagnosis finds what lacks."
        )
        told = replace(told, doubts=(*told.doubts, surprise))
    return replace(told, predictive=predictive)


def reported(
    network: MixtureDensityPosterior | AveragedPosterior,
    posterior: PhysicsPosterior,
    found: Sequence[str],
    *,
    trajectories: int = 1,
    prior: Prior | None = None,
    held_out: TensorDictBase | None = None,
    seed: int = 0,
) -> Trust:
    """Return the report on what a network was conditioned to, without simulations.

    Args:
        network: As of :func:`trust`.
        posterior: Given the real data.
        found: Doubts of :func:`.misspecification.doubts`.
        trajectories: How many it was conditioned to together.
        prior: As of :func:`trust`.
        held_out: As of :func:`trust`.
        seed: Of the calibration.
    """
    if held_out is None and network.seen is not None and len(network.seen) < FEWEST:
        few = (
            f"it was fitted to {len(network.seen)} pairs only, too few to tell what it gets wrong."
        )
        found = [*found, few]
    pairs = _unweighted(network.held_out) if held_out is None else held_out
    calibration = None
    if pairs is not None and len(pairs) >= FEWEST:
        calibration = calibrate(network, pairs, seed=seed)
        found = [*found, *calibration.doubts()]
    told = identifiability(posterior, prior=prior)
    return Trust(
        posterior, tuple(found), told, calibration, predictive=None, trajectories=trajectories
    )


def with_pooled(
    told: Trust,
    network: MixtureDensityPosterior | AveragedPosterior,
    simulate: Callable[[Tensor], Tensor],
    rows: Tensor,
    *,
    truths: int,
    seed: int,
) -> Trust:
    """Return the report with the calibration of answers for as many trajectories together.

    Args:
        told: Without it.
        network: As of :func:`trust`.
        simulate: As of :func:`trust`.
        rows: Real summaries, shape ``(n, L)``.
        truths: As of :func:`trust`.
        seed: Same seed, same truths.
    """
    theta = draw(network.prior, truths, key=(seed, "truths"))
    count = len(rows)
    groups = _predicted(simulate, theta.repeat_interleave(count, 0), rows).unflatten(0, (-1, count))
    whole = groups.isfinite().flatten(1).all(-1)
    if whole.sum() < FEWEST:
        return told
    pooled = calibrate_pooled(network, theta[whole], groups[whole], seed=seed)
    doubts = pooled.doubts(what=f"the answer for {count} trajectories together")
    return replace(told, pooled=pooled, doubts=(*told.doubts, *doubts))


def _predicted(simulate: Callable[[Tensor], Tensor], theta: Tensor, rows: Tensor) -> Tensor:
    predicted = simulate(theta)
    shape = len(theta), rows.shape[-1]
    if not isinstance(predicted, Tensor) or predicted.shape != shape:
        got = tuple(predicted.shape) if isinstance(predicted, Tensor) else type(predicted).__name__
        raise ValueError(message(f"summaries of shape {shape} from simulate", got))
    return predicted.to(theta.device, rows.dtype)


def _share_as_far(theta: Tensor, predicted: Tensor, rows: Tensor, *, seed: int) -> float:
    """Return how many simulations lie as far out as real rows do, by their means and spreads.

    A product of n answers is as sure as n times as many data: the rows one by one may all be likely
    where their mean is not, or where no parameter makes them differ so much. Means and spreads are
    of n simulations drawn at random (a bootstrap) from those of nearly the same parameters; means
    vary as well by what the mean of so few simulations may be off. A spread that is smaller than
    usual is no reason to doubt: parameters are not quite the same in a group.
    """
    if len(rows) < 2:
        return strangeness(predicted, rows[0])[0]
    g, count = generator(seed, "groups"), len(predicted)
    u = theta / theta.std(0, correction=0).clamp_min(1e-12)
    alike = torch.cdist(u, u).topk(min(_ALIKE, count), largest=False).indices
    some = lambda of, size: predicted[of[torch.randint(len(of), (size,), generator=g)]]
    every = torch.arange(count)
    off = torch.stack([some(every, count).mean(0) for _ in every]) - predicted.mean(0)
    groups = torch.stack([some(near, len(rows)) for near in alike])
    usual = groups.std(1).median(0).values
    by_groups = torch.cat([groups.mean(1) + off, torch.maximum(groups.std(1), usual)], -1)
    real = torch.cat([rows.mean(0), torch.maximum(rows.std(0), usual)])
    return strangeness(by_groups, real)[0]


def _unweighted(pairs: TensorDictBase | None) -> TensorDictBase | None:
    """Return pairs that are all worth the same, as the ranks of a calibration need them."""
    return None if pairs is None or "weight" in pairs.keys() else pairs  # noqa: SIM118
