"""Table 1 of the BayesSim paper (arXiv:1906.01728): how well are known parameters recovered?

    python recipes/posterior_recovery.py paper_mode=true
    python recipes/posterior_recovery.py

Every method gets the same simulations with the same seeds. ``paper_mode=true``: the paper's
protocol (1,000 trajectories of at most 200 steps, the mean of the statistics of 10 real ones), its
networks with diagonal and full covariance, once with its own statistics and once with ours.
Otherwise our defaults, beside sbi's NPE (extra ``sbi``) on the same pairs. Log-densities at one
truth reward a posterior that is too sure, so nats over the prior and coverage over many other
truths stand beside them. Writes result.json, table.md and a picture per problem; finished parts
are kept in ``out``, so that the same command goes on after a break.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import recipe
import torch
from recovery_methods import (
    Answer,
    Fitted,
    bayessim,
    epsilon_free,
    from_draws,
    mcmc_abc,
    npe,
    rejection_abc,
    smc_abc,
)
from recovery_problems import PROBLEMS, Problem
from torch import Tensor
from workers import workers

from torchrl_bayessim import plots
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.identifiability import identifiability
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.simulate import collect_summaries, make_collector
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer
from torchrl_bayessim.whole_file import write_text

REAL = 10  # real trajectories of the paper
PAPER = ", the paper's statistics"


@dataclass
class Recovery(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    problem: str = "all"  # or names, separated by commas
    paper_mode: bool = False
    simulations: int = 1000
    seeds: int = 5  # repetitions, from seed on
    truths: int = 64  # other truths per seed, for nats and coverage
    npe: bool = True  # sbi's NPE beside our defaults, if sbi is installed
    online: bool = True  # in paper_mode: methods that simulate for one observation, where cheap
    processes: int = 2
    short: bool = False  # a smoke test: everything runs, little is learned


def job(settings: Recovery, out: Path) -> dict[str, Any]:
    """Run every problem and seed, and write the tables."""
    if settings.short:
        settings.simulations, settings.seeds, settings.truths = 200, 2, 16
        settings.problem = (
            "pendulum,mountain_car" if settings.problem == "all" else settings.problem
        )
        settings.npe = False
    names = chosen(settings)
    seeds = range(settings.seed, settings.seed + settings.seeds)
    todo = [(name, seed) for seed in seeds for name in names]
    folder = out / "parts"
    with workers(settings.processes, threads=settings.threads) as pool:
        jobs = [pool.submit(run, settings, name, seed, folder) for name, seed in todo]
        parts = []
        for (name, seed), done in zip(todo, jobs, strict=True):
            parts.append(done.result())
            print(f"{name}, seed {seed}: {parts[-1]['seconds']:.0f} s")
    result = {
        "paper_mode": settings.paper_mode,
        "rows": list(rows(parts)),
        "joint": list(joint(parts)),
        "said": {part["problem"]: part["said"] for part in parts if part["said"]},
    }
    for part in parts:
        if part["seed"] == settings.seed:
            draw_picture(out, part)
    text = table(result, names)
    write_text(out / "table.md", text)
    print(text)
    return result


def chosen(settings: Recovery) -> list[str]:
    """Return the problems to run; says which cannot be."""
    names = list(PROBLEMS) if settings.problem == "all" else settings.problem.split(",")
    for name in names:
        if name not in PROBLEMS:
            raise ValueError(message("a problem", name, available=[*PROBLEMS, "all"]))
    missing = [n for n in names if PROBLEMS[n].needs and find_spec(PROBLEMS[n].needs) is None]
    for name in missing:
        print(f"{name} is left out: {PROBLEMS[name].needs} is not installed (extra pybullet)")
    if settings.npe and find_spec("sbi") is None:
        settings.npe = False
        print("sbi is not installed (extra sbi): its NPE and SMC-ABC are left out")
    return [name for name in names if name not in missing]


class Laboratory:
    """A problem's simulator under one policy, and its statistics.

    Args:
        problem: The problem.
        paper: Whether statistics of single trajectories are averaged, as in the paper; both kinds
            of statistics then stand side by side.
        environments: Simulated at once.
        seed: Of the simulations.
    """

    def __init__(self, problem: Problem, *, paper: bool, environments: int, seed: int) -> None:
        self.problem, self.paper, self.seed = problem, paper, seed
        functions = (*problem.paper_summaries, *problem.summaries) if paper else problem.summaries
        self.randomizer = DomainRandomizer(problem.prior)
        env = problem.make(self.randomizer, environments=environments, seed=seed)
        policy = None if problem.policy is None else problem.policy()
        self.collector = make_collector(env, policy, steps=problem.steps)
        self.statistics = SummaryStatistics(*functions)
        self.calls = 0

    def __call__(self, theta: Tensor, *, real: bool = False) -> Tensor:
        """Return summaries ``(N, L)``; of as many trajectories as the robot runs if ``real``."""
        self.calls += 1
        mean_of = REAL if self.paper and real else 1
        found, _ = collect_summaries(
            self.collector,
            self.statistics,
            self.randomizer,
            theta.repeat_interleave(mean_of, 0),
            trajectories=1 if self.paper else self.problem.episodes,
            key=(self.seed, "laboratory", self.calls),
            progress=False,
        )
        return found.unflatten(0, (len(theta), mean_of)).mean(1)

    def close(self) -> None:
        """End the collector."""
        self.collector.shutdown()


def run(settings: Recovery, name: str, seed: int, folder: Path) -> dict[str, Any]:
    """Return what every method says about one problem with one seed; kept in a file."""
    protocol = "paper" if settings.paper_mode else "own"
    without = "".join(f"_no_{kind}" for kind in ("npe", "online") if not getattr(settings, kind))
    sizes = f"{settings.simulations}_{settings.truths}"
    file = folder / f"{name}_{protocol}{without}_{sizes}_{seed}.json"
    return recipe.kept(file, lambda: answered(settings, name, seed))


def answered(settings: Recovery, name: str, seed: int) -> dict[str, Any]:
    """Return the same, from simulations and fits."""
    start = time.perf_counter()
    problem = PROBLEMS[name]
    prior = problem.prior
    width = min(problem.environments, settings.simulations)
    lab = Laboratory(problem, paper=settings.paper_mode, environments=width, seed=seed)
    theta = draw(prior, settings.simulations, key=(seed, "theta"))
    x = lab(theta)
    seconds = time.perf_counter() - start
    truth = torch.tensor([[problem.truth[n] for n in prior.names]])
    # the last row is the truth of the table
    tests = torch.cat([draw(prior, settings.truths, key=(seed, "truths")), truth])
    observed = lab(tests, real=True)
    found: dict[str, Any] = {}
    pictured: dict[str, Any] = {}
    for kind, columns in kinds(lab, x).items():
        own, given = x[:, columns], observed[:, columns]
        for method, make in amortised(settings, prior, theta, own, seed=seed).items():
            before = time.process_time()
            fitted, network = make()
            spent = time.process_time() - before
            found[f"{method}{kind}"] = entry(fitted(tests, given), prior, tests) | {
                "seconds_fit": spent
            }
            if network is not None:
                pictured["posterior"] = network.condition(given[-1:])
        if settings.paper_mode and settings.online and not problem.costly and kind != PAPER:
            few = Laboratory(problem, paper=settings.paper_mode, environments=100, seed=seed)
            alone = lambda t, few=few, columns=columns: few(t)[:, columns]
            for method, answer in online(settings, prior, alone, given[-1], truth=truth, seed=seed):
                found[f"{method}{kind}"] = entry(answer, prior, truth) | {"seconds_fit": None}
            few.close()
    lab.close()
    q = pictured["posterior"]
    return {
        "problem": name,
        "seed": seed,
        "methods": found,
        "seconds_simulate": seconds,
        "simulations": settings.simulations,
        "said": identifiability(q).sentences(),
        "draws": draw(q, 2000, key=(seed, "picture")).tolist(),
        "seconds": time.perf_counter() - start,
    }


def kinds(lab: Laboratory, x: Tensor) -> dict[str, slice]:
    """Return the columns of each kind of statistics, by what is added to a method's name."""
    if not lab.paper:
        return {"": slice(0, x.shape[-1])}
    one = SummaryStatistics(*lab.problem.summaries)
    # our statistics stand last; their number follows from one step of one trajectory
    batch = lab.collector.env.rollout(2, break_when_any_done=False)
    own = one(batch.reshape(-1, batch.shape[-1])[:1])["summary"].shape[-1]
    return {
        PAPER: slice(0, x.shape[-1] - own),
        ", our statistics": slice(x.shape[-1] - own, x.shape[-1]),
    }


def amortised(
    settings: Recovery, prior: Any, theta: Tensor, x: Tensor, *, seed: int
) -> dict[str, Callable[[], tuple[Fitted, Any]]]:
    """Return the methods that answer for any summary, by name."""
    made: dict[str, Callable[[], tuple[Fitted, Any]]] = {}

    def network(features: str, covariance: str) -> Callable[[], tuple[Fitted, Any]]:
        return lambda: bayessim(
            prior,
            theta,
            x,
            features=features,  # pyright: ignore[reportArgumentType]
            covariance=covariance,  # pyright: ignore[reportArgumentType]
            paper=settings.paper_mode,
            seed=seed,
        )

    several = len(prior.names) > 1
    if settings.paper_mode:
        for label, features in {"RFF": "fourier", "NN": "neural"}.items():
            for covariance in ("diagonal", "full") if several else ("diagonal",):
                made[f"BayesSim {label} {covariance}"] = network(features, covariance)
    else:
        made["BayesSim"] = network("neural", "full")
    made["Rejection ABC"] = lambda: (rejection_abc(prior, theta, x), None)
    if settings.npe and not settings.paper_mode:
        for kind in ("mdn", "maf", "nsf"):
            made[f"NPE {kind.upper()} (sbi)"] = lambda kind=kind: (
                npe(prior, theta, x, kind=kind, seed=seed),
                None,
            )
    return made


def online(
    settings: Recovery, prior: Any, simulate: Any, observed: Tensor, *, truth: Tensor, seed: int
) -> Iterator[tuple[str, Answer]]:
    """Yield the answers of methods that simulate for one observation."""
    budget = {"budget": settings.simulations, "seed": seed}
    draws = mcmc_abc(simulate, prior, observed, **budget)
    yield "MCMC-ABC", from_draws(prior, truth, draws[:, None])
    if find_spec("sbi"):
        draws = smc_abc(simulate, prior, observed, **budget)
        yield "SMC-ABC (sbi)", from_draws(prior, truth, draws[:, None])
    q = epsilon_free(simulate, prior, observed, **budget)
    some = q.sample((200,), generator=torch.Generator().manual_seed(seed))
    place = (some < truth).float().mean(0, keepdim=True)
    yield "epsilon-free", Answer(marginal_log_prob(q, truth[0])[None], place, q.log_prob(truth))


def entry(answer: Answer, prior: Any, tests: Tensor) -> dict[str, Any]:
    """Return an answer as numbers: the table's truth is the last row."""
    under_prior = -(prior.high - prior.low).log()
    joint_nats = None
    if answer.joint is not None and len(tests) > 1:
        joint_nats = (answer.joint - prior.log_prob(tests))[:-1].tolist()
    return {
        "log_prob": answer.marginal[-1].tolist(),
        "nats": (answer.marginal - under_prior)[:-1].tolist(),
        "place": answer.place[:-1].tolist(),
        "joint_nats": joint_nats,
    }


def rows(parts: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield one row per problem, parameter and method."""
    for name in dict.fromkeys(part["problem"] for part in parts):
        own = [part for part in parts if part["problem"] == name]
        problem = PROBLEMS[name]
        for d, parameter in enumerate(problem.prior.names):
            for method in own[0]["methods"]:
                entries = [part["methods"][method] for part in own]
                at_truth = [e["log_prob"][d] for e in entries]
                nats = [row[d] for e in entries for row in e["nats"]]
                place = torch.tensor([row[d] for e in entries for row in e["place"]])
                fits = [e["seconds_fit"] for e in entries]
                yield {
                    "problem": name,
                    "parameter": parameter,
                    "method": method,
                    "log_prob_mean": statistics.fmean(at_truth),
                    "log_prob_sd": statistics.stdev(at_truth) if len(at_truth) > 1 else None,
                    "nats_over_prior": statistics.fmean(nats) if nats else None,
                    "coverage_50": covered(place, 0.5),
                    "coverage_90": covered(place, 0.9),
                    "truths": len(place),
                    "seconds_simulate": statistics.fmean(p["seconds_simulate"] for p in own),
                    "seconds_fit": None if None in fits else statistics.fmean(fits),
                    "simulations": own[0]["simulations"],
                    "seeds": len(own),
                    "paper_best": problem.paper[parameter],
                    "prior": -math.log(problem.prior.high[d] - problem.prior.low[d]),
                }


def covered(place: Tensor, level: float) -> float | None:
    """Return the share of truths in central intervals of this level."""
    return ((place - 0.5).abs() <= level / 2).float().mean().item() if len(place) else None


def joint(parts: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield nats over the prior of all parameters together, and the time to fit, per method."""
    for name in dict.fromkeys(part["problem"] for part in parts):
        own = [part for part in parts if part["problem"] == name]
        for method in own[0]["methods"]:
            entries = [part["methods"][method] for part in own]
            if all(e["joint_nats"] for e in entries):
                yield {
                    "problem": name,
                    "method": method,
                    "nats": statistics.fmean(v for e in entries for v in e["joint_nats"]),
                    "seconds_fit": statistics.fmean(e["seconds_fit"] for e in entries),
                }


def draw_picture(out: Path, part: dict[str, Any]) -> None:
    """Draw the posterior of the last network fitted."""
    problem = PROBLEMS[part["problem"]]
    figure = plots.pair_plot(
        torch.tensor(part["draws"]),
        names=problem.prior.names,
        prior_samples=draw(problem.prior, 2000, key=("picture",)),
        truth=torch.tensor([problem.truth[n] for n in problem.prior.names]),
    )
    recipe.save_picture(figure, out / f"{part['problem']}.png", dpi=80)


def table(result: dict[str, Any], names: list[str]) -> str:
    """Return the tables in Markdown."""
    lines = [
        "Log-density at the truth, mean ± deviation over seeds; in brackets nats over the prior, "
        "averaged over other truths, and how many of these 50 % and 90 % intervals hold.",
        "",
    ]
    for name in names:
        found = [row for row in result["rows"] if row["problem"] == name]
        parameters = list(dict.fromkeys(row["parameter"] for row in found))
        lines += [f"**{name}**", "", f"| method | {' | '.join(parameters)} | fit [s] |"]
        lines += ["|---" * (len(parameters) + 2) + "|"]
        best = {row["parameter"]: row["paper_best"] for row in found}
        flat = {row["parameter"]: row["prior"] for row in found}
        lines += [f"| prior | {' | '.join(f'{flat[p]:.2f}' for p in parameters)} | |"]
        lines += [f"| paper, best | {' | '.join(f'{best[p]:.2f}' for p in parameters)} | |"]
        for method in dict.fromkeys(row["method"] for row in found):
            own = [row for row in found if row["method"] == method]
            spent = own[0]["seconds_fit"]
            cells = " | ".join(cell(row) for row in own)
            lines += [f"| {method} | {cells} | {'' if spent is None else f'{spent:.1f}'} |"]
        lines += ["", *(f"- {text}" for text in result["said"].get(name, [])), ""]
    lines += ["All parameters together, nats over the prior averaged over other truths:", ""]
    lines += ["| problem | method | nats | fit [s] |", "|---|---|---|---|"]
    lines += [
        f"| {row['problem']} | {row['method']} | {row['nats']:.2f} | {row['seconds_fit']:.1f} |"
        for row in result["joint"]
    ]
    return "\n".join(lines) + "\n"


def cell(row: dict[str, Any]) -> str:
    """Return one row's cell."""
    sd = "" if row["log_prob_sd"] is None else f" ± {row['log_prob_sd']:.2f}"
    text = f"{row['log_prob_mean']:.2f}{sd}"
    if row["nats_over_prior"] is None:
        return text
    return (
        f"{text} [{row['nats_over_prior']:+.2f}; "
        f"{row['coverage_50']:.0%}, {row['coverage_90']:.0%}]"
    )


if __name__ == "__main__":
    recipe.main(Recovery, job)
