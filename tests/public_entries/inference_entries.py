"""Posteriors and priors."""

import torch
from entry import Entry
from makers import (
    PRIOR,
    QUICK,
    first,
    pairs,
    posterior,
    refinement,
)

import torchrl_bayessim as package

FIT = {
    "posterior": "object",
    "data": "pairs",
    "epochs": "count",
    "batch_size": "count",
    "lr": "rate",
    "validation_fraction": "rate",
    "patience": "count or none",
}

ENTRIES = {
    "fit": Entry(
        package.fit,
        lambda: {
            "posterior": posterior(),
            "data": pairs(),
            "batch_size": 8,
            "lr": 1e-2,
            "weight_decay": 1e-4,
            "validation_fraction": 0.1,
            "patience": 2,
            **QUICK,
        },
        FIT,
    ),
    "MixtureDensityPosterior": Entry(
        package.MixtureDensityPosterior,
        lambda: {"prior": PRIOR, "summary_dim": 1, "components": 1, "features": "neural"},
        {"prior": "object", "summary_dim": "count", "components": "count", "features": "name"},
    ),
    "MixtureDensityPosterior.paper_mode": Entry(
        package.MixtureDensityPosterior.paper_mode,
        lambda: {"prior": PRIOR, "summary_dim": 1, "features": "neural"},
        {"prior": "object", "summary_dim": "count", "features": "name"},
    ),
    "MixtureDensityPosterior.condition": Entry(
        lambda **given: posterior().condition(**given),
        lambda: {"summaries": torch.zeros(2, 1), "pooling": "product", "check": True},
        {"summaries": "summary", "pooling": "name"},
    ),
    "MixtureDensityPosterior.distribution": Entry(
        lambda **given: posterior().distribution(**given),
        lambda: {"summary": torch.zeros(2, 1), "points": 8},
    ),
    "PosteriorRefinement": Entry(
        package.PosteriorRefinement,
        lambda: {
            "prior": PRIOR,
            "simulations": 8,
            "networks": 1,
            "make_posterior": None,
            "margin": 1.0,
            "prior_share": 0.25,
            "fit_options": dict(QUICK),
        },
        {
            "prior": "object",
            "simulations": "count",
            "networks": "count",
            "margin": "share below",
            "prior_share": "share",
            "make_posterior": "function or none",
        },
    ),
    "PosteriorRefinement.refine": Entry(
        lambda **given: refinement().refine(**given),
        lambda: {
            "simulate": lambda theta: theta,
            "observed": torch.tensor([0.5]),
            "key": (0,),
            "progress": False,
        },
        {"simulate": "function", "observed": "summary"},
    ),
    "PosteriorRefinement.learn": Entry(
        lambda **given: refinement().learn(**given),
        lambda: {
            "theta": pairs()["theta"],
            "summary": pairs()["summary"],
            "observed": torch.tensor([0.5]),
            "key": (0,),
            "progress": False,
        },
        {"theta": "parameters", "summary": "summaries", "observed": "summary"},
    ),
    "PosteriorRefinement.load_state_dict": Entry(
        lambda **given: refinement().load_state_dict(**given),
        lambda: {"state": {}},
        {"state": "state"},
    ),
    "sequential": Entry(
        lambda **given: first(package.sequential(**given)),
        lambda: {
            "simulator": lambda theta: theta,
            "prior": PRIOR,
            "observed": torch.tensor([0.5]),
            "rounds": 1,
            "simulations": 8,
            "correction": "importance",
            "prior_share": 0.2,
            "networks": 1,
            "make_posterior": None,
            **QUICK,
        },
        {
            "simulator": "function",
            "prior": "object",
            "observed": "summary",
            "rounds": "count",
            "simulations": "count",
            "networks": "count",
            "correction": "name or none",
            "prior_share": "share",
            "make_posterior": "function or none",
        },
    ),
    "PosteriorLoss": Entry(
        package.PosteriorLoss,
        lambda: {"posterior_network": posterior(), "reduction": "mean"},
        {"posterior_network": "object", "reduction": "name"},
    ),
    "BoxPrior": Entry(
        package.BoxPrior,
        lambda: {"bounds": {"a": (0.1, 1.0)}, "log": ["a"], "units": {"a": "m"}},
        {"bounds": "pairs of numbers", "log": "names", "units": "units"},
    ),
    "GaussianPrior": Entry(
        package.GaussianPrior,
        lambda: {"moments": {"a": (0.1, 1.0)}, "correlation": torch.eye(1), "units": {"a": "m"}},
        {"moments": "pairs of numbers", "correlation": "matrix", "units": "units"},
    ),
    **{
        f"{name}.{method}": Entry(
            lambda method=method, prior=prior, **given: getattr(prior, method)(**given),
            lambda argument=argument: {argument: torch.full((3, 1), 0.5)},
            {argument: "rows of parameters"},
        )
        for name, prior in {
            "BoxPrior": PRIOR,
            "GaussianPrior": package.GaussianPrior({"length": (0.5, 0.1)}),
        }.items()
        for method, argument in {
            "log_prob": "value",
            "contains": "theta",
            "standardize": "theta",
            "unstandardize": "z",
        }.items()
    },
    **{
        f"{name}.sample": Entry(
            lambda prior=prior, **given: prior.sample(**given),
            lambda: {"sample_shape": (3,)},
            {"sample_shape": "shape"},
        )
        for name, prior in {
            "BoxPrior": PRIOR,
            "GaussianPrior": package.GaussianPrior({"length": (0.5, 0.1)}),
        }.items()
    },
    "BoxPrior.within": Entry(
        PRIOR.within, lambda: {"low": torch.tensor([0.3]), "high": torch.tensor([0.9])}
    ),
}
