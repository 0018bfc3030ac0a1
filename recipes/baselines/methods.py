"""All baselines by name, and their answers to one case."""

from __future__ import annotations

__all__ = ["METHODS", "answers"]

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System

from .classifier import classifier
from .misspecification import misspecification
from .parameters_only import parameters_only
from .sparse_regression import sparse_regression
from .strength_grid import strength_grid
from .whole_refit import whole_refit
from .whole_runs import Runs, whole_runs

Method = Callable[[Runs, int, int], dict[str, Any]]

METHODS: Mapping[str, Method] = {
    "strength grid": lambda runs, _, __: strength_grid(runs),
    "whole-run refit": lambda runs, _, __: whole_refit(runs),
    "sparse regression": lambda runs, _, __: sparse_regression(runs),
    "classifier": lambda runs, budget, seed: classifier(runs, budget=budget, seed=seed),
    "misspecification": lambda runs, budget, seed: misspecification(runs, budget=budget, seed=seed),
    "parameters only": lambda runs, _, __: parameters_only(runs),
}
"""Functions of the runs, the diagnosis' simulated time steps and a seed."""


def answers(
    case: Path, *, budget: int, seed: int, noise: Mapping[str, float] | None = None
) -> dict[str, dict[str, Any]]:
    """Return every baseline's answer to a case; whatever goes wrong is its answer.

    Args:
        case: The folder that the diagnosis was given.
        budget: Time steps that the diagnosis simulated.
        seed: Of draws.
        noise: What the diagnosis estimated, so that no baseline fails for want of it.
    """
    found: dict[str, dict[str, Any]] = {}
    with threadpool_limits(1, user_api="blas"):
        for name, method in METHODS.items():
            begun = time.perf_counter()
            try:
                system = System.load(case / "system.yaml")
                runs = whole_runs(system, read_logs(case, system), noise=noise)
                found[name] = method(runs, budget, seed)
            except Exception as error:
                found[name] = {"verdict": "crash", "summary": f"{type(error).__name__}: {error}"}
            found[name]["seconds"] = time.perf_counter() - begun
    return found
