"""Table 1 of the BayesSim paper (arXiv:1906.01728): how well are known parameters recovered?

    python recipes/posterior_recovery.py paper_mode=true
    python recipes/posterior_recovery.py

Every method gets the same simulations with the same seeds. ``paper_mode=true``: the paper's
protocol (1,000 trajectories of at most 200 steps, 10 real ones): its networks with diagonal and
full covariance and the mean of the statistics of the real trajectories, once with its own
statistics and once with ours; and "BayesSim pooled", our defaults, which multiply the posteriors
of the ten; and methods that simulate for one observation, with the first seed only where a
thousand simulations take a minute, where other truths are a third as many, too. Otherwise our
defaults, the average of three networks, beside sbi's NPE (extra ``sbi``) on the same pairs.
Log-densities at one truth reward a posterior that is too sure, so nats over the prior and coverage
over many other truths stand beside them. Writes result.json, table.md and a picture per problem;
finished parts are kept in ``out``, so that the same command goes on after a break.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
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
    papers_bayessim,
    rejection_abc,
    smc_abc,
)
from recovery_problems import PROBLEMS, Problem
from recovery_table import BY_PRODUCT, joint, rows, table
from torch import Tensor
from workers import workers

from torchrl_bayessim import plots
from torchrl_bayessim.counts import check_count
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.ensemble import NETWORKS
from torchrl_bayessim.inference.identifiability import identifiability
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.simulate import collect_summaries, make_collector
from torchrl_bayessim.sources import draw
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms import DomainRandomizer
from torchrl_bayessim.whole_file import write_text

REAL = 10  # real trajectories of the paper
PAPER = ", the paper's statistics"
POOLED = 16  # other truths that it is tried on: its products take long


@dataclass
class Recovery(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    problem: str = "all"  # or names, separated by commas
    paper_mode: bool = False
    simulations: int = 1000
    seeds: int = 5  # repetitions, from seed on
    truths: int = 64  # other truths per seed, for nats and coverage; see `Problem.costly`
    npe: bool = True  # sbi's NPE beside our defaults, if sbi is installed
    online: bool = True  # in paper_mode: methods that simulate for one observation
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
    names = chosen(settings.problem)
    check_count("seeds", settings.seeds)
    if settings.npe and find_spec("sbi") is None:
        settings.npe = False
        print("sbi is not installed (extra sbi): its NPE and SMC-ABC are left out")
    seeds = range(settings.seed, settings.seed + settings.seeds)
    todo = [(name, seed) for seed in seeds for name in names]
    folder = out / "parts"
    with workers(settings.processes, threads=settings.threads) as pool:
        # the long ones first, so that no worker is left alone with one
        queue = sorted(todo, key=lambda one: not PROBLEMS[one[0]].costly)
        jobs = {one: pool.submit(run, settings, *one, folder) for one in queue}
        parts = []
        for name, seed in todo:
            parts.append(jobs[name, seed].result())
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


def chosen(problem: str) -> list[str]:
    """Return the problems to run, of ``"all"`` or names with commas; says which cannot be."""
    names = list(PROBLEMS) if problem == "all" else list(dict.fromkeys(problem.split(",")))
    for name in names:
        if name not in PROBLEMS:
            raise ValueError(message("a problem", name, available=[*PROBLEMS, "all"]))
    missing = [n for n in names if PROBLEMS[n].needs and find_spec(PROBLEMS[n].needs) is None]
    for name in missing:
        print(f"{name} is left out: {PROBLEMS[name].needs} is not installed (extra pybullet)")
    return [name for name in names if name not in missing]


class Laboratory:
    """A problem's simulator under one policy, and its statistics.

    Args:
        problem: The problem.
        paper: Whether a system shows one trajectory, and the robot several, as in the paper; both
            kinds of statistics then stand side by side.
        environments: Simulated at once, at most; fewer where the problem has fewer.
        seed: Of the simulations.
    """

    def __init__(self, problem: Problem, *, paper: bool, environments: int, seed: int) -> None:
        self.problem, self.paper, self.seed = problem, paper, seed
        functions = (*problem.paper_summaries, *problem.summaries) if paper else problem.summaries
        self.randomizer = DomainRandomizer(problem.prior)
        width = min(environments, problem.environments)
        env = problem.make(self.randomizer, environments=width, seed=seed)
        policy = None if problem.policy is None else problem.policy()
        self.collector = make_collector(env, policy, steps=problem.steps)
        self.statistics = SummaryStatistics(*functions)
        self.calls = 0

    def __call__(self, theta: Tensor, *, real: bool = False) -> Tensor:
        """Return summaries ``(N, R, L)`` of R = 1 trajectory, or as many as the robot runs."""
        self.calls += 1
        runs = REAL if self.paper and real else 1
        found, _ = collect_summaries(
            self.collector,
            self.statistics,
            self.randomizer,
            theta.repeat_interleave(runs, 0),
            trajectories=1 if self.paper else self.problem.episodes,
            key=(self.seed, "laboratory", self.calls),
            progress=False,
        )
        return found.unflatten(0, (len(theta), runs))

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
    asked = settings.simulations
    lab = Laboratory(problem, paper=settings.paper_mode, environments=asked, seed=seed)
    theta = draw(prior, settings.simulations, key=(seed, "theta"))
    x = lab(theta)[:, 0]
    seconds = time.perf_counter() - start
    truth = torch.tensor([[problem.truth[n] for n in prior.names]])
    few = settings.paper_mode and problem.costly  # each takes ten trajectories there
    others = max(1, settings.truths // 3) if few else settings.truths
    # the last row is the truth of the table
    tests = torch.cat([draw(prior, others, key=(seed, "truths")), truth])
    observed = lab(tests, real=True)
    found: dict[str, Any] = {}
    pictured: dict[str, Any] = {}
    for kind, columns in kinds(lab, x).items():
        own, given = x[:, columns], observed[..., columns]
        methods = amortised(settings, prior, theta, own, pooled=kind != PAPER, seed=seed)
        for method, make in methods.items():
            before = time.process_time()
            fitted, condition = make()
            spent = time.process_time() - before
            some = slice(-1 - POOLED if method == BY_PRODUCT else 0, None)
            answer = fitted(tests[some], given[some])
            found[f"{method}{kind}"] = entry(answer, prior, tests[some]) | {"seconds_fit": spent}
            if condition is not None:
                pictured["posterior"] = condition(given[-1])
        once = not problem.costly or seed == settings.seed
        if settings.paper_mode and settings.online and once and kind != PAPER:
            # chains and rounds are small: where each world costs, few are stepped for nothing
            width = 250 if problem.environments > 250 else 50
            small = Laboratory(problem, paper=settings.paper_mode, environments=width, seed=seed)
            alone = lambda t, small=small, columns=columns: small(t)[:, 0, columns]
            mean = given[-1].mean(0)
            for method, answer in online(settings, prior, alone, mean, truth=truth, seed=seed):
                found[f"{method}{kind}"] = entry(answer, prior, truth) | {"seconds_fit": None}
            small.close()
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
    settings: Recovery, prior: Any, theta: Tensor, x: Tensor, *, pooled: bool, seed: int
) -> dict[str, Callable[[], tuple[Fitted, Any]]]:
    """Return the methods that answer for any summary, by name; the pooling one if asked."""
    made: dict[str, Callable[[], tuple[Fitted, Any]]] = {}
    several = len(prior.names) > 1
    if not settings.paper_mode:
        made["BayesSim"] = partial(
            bayessim, prior, theta, x, networks=NETWORKS, pool=False, seed=seed
        )
    else:
        for label, features in {"RFF": "fourier", "NN": "neural"}.items():
            for covariance in ("diagonal", "full") if several else ("diagonal",):
                made[f"BayesSim {label} {covariance}"] = partial(
                    papers_bayessim,
                    prior,
                    theta,
                    x,
                    features=features,  # pyright: ignore[reportArgumentType]
                    covariance=covariance,
                    seed=seed,
                )
        if pooled:
            made[BY_PRODUCT] = partial(
                bayessim, prior, theta, x, networks=NETWORKS, pool=True, seed=seed
            )
    made["Rejection ABC"] = lambda: (rejection_abc(prior, theta, x), None)
    if settings.npe and not settings.paper_mode:
        import_module("sbi.inference")  # seconds that are no part of a fit
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
        "region": None if answer.region is None else answer.region[:-1].tolist(),
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


if __name__ == "__main__":
    recipe.main(Recovery, job)
