"""What do simulations on Ray send, hold and take? Bytes, memory and seconds with two workers.

CartPole with PPO's policy: pairs here and on Ray, which must be the same; a training batch; and a
worker that is killed. Memory is that of processes together, a page that several map in equal parts
(Pss). Prints one JSON line per figure::

    python recipes/benchmarks/ray_workers.py [workers=2] [environments=128] [pairs=2048] [runs=3]
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from measuring import options, report

sys.path.append(RECIPES := str(Path(__file__).parent.parent))
from collectors import make
from tasks import TASKS

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.ray_collectors import RayCollectors
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.sources import Defensive
from torchrl_bayessim.summaries import SummaryStatistics
from torchrl_bayessim.transforms.domain_randomizer import randomizers

TASK = TASKS["cartpole"]


def processes(*names: str) -> Iterator[int]:
    """Yield the processes of this machine whose command has one of these names."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = path.read_text(errors="replace")
        except OSError:  # it has ended
            continue
        if any(name in command.split("\0")[0] for name in names):
            yield int(path.parent.name)


def memory(*names: str) -> float:
    """Return what these processes hold together, in MiB."""
    total = 0
    for process in processes(*names):
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


def timed(job: Callable[[], Any], runs: int) -> list[float]:
    """Return the seconds of each run."""
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - begun)
    return seconds


def sizes(collectors: RayCollectors, env: Any, learner: PPO) -> Iterator[tuple[str, int]]:
    """Yield the bytes of what goes to a worker and of what comes back."""
    statistics = SummaryStatistics(*TASK.summaries)
    (randomizer,) = randomizers(env)
    posterior = MixtureDensityPosterior(TASK.prior, 31).condition(torch.zeros(31), check=False)
    yield "bytes of a policy's weights", len(pickle.dumps(dict(learner.policy.state_dict())))
    source = Defensive(posterior, TASK.prior, 0.1)
    yield "bytes of a posterior", len(pickle.dumps(source))
    theta = TASK.prior.sample((collectors.environments,), generator=torch.Generator())
    asked = {"steps": TASK.horizon, "key": (0,), "progress": False}
    found, _ = collectors.summaries(learner.policy, statistics, theta, **asked)
    yield "bytes of a pair's summary", len(pickle.dumps(found)) // len(found)
    randomizer.source = source
    collectors.begin(randomizer, key=(0, "size"))
    batch = collectors.batch(learner.policy)
    yield "bytes of a training trajectory", len(pickle.dumps(batch)) // len(batch)


def main(*arguments: str) -> None:
    """Measure sizes, times, memory, and a death."""
    given = options(list(arguments), workers=2, environments=128, pairs=2048, runs=3)
    torch.set_num_threads(1)
    os.environ["PYTHONPATH"] = os.pathsep.join([RECIPES, os.environ.get("PYTHONPATH", "")])
    env = make(TASK, 0, given["environments"])
    learner = PPO(env, seed=0, **TASK.ppo)
    (randomizer,) = randomizers(env)
    statistics = SummaryStatistics(*TASK.summaries)
    told = {"seed": 0, "threads": 1, **{k: given[k] for k in ("workers", "environments")}}
    line = partial(report, "ray_workers", **told)
    begun = time.perf_counter()
    collectors = RayCollectors(
        partial(make, TASK, 0),
        learner.policy,
        environments=given["environments"],
        steps=TASK.horizon,
        workers=given["workers"],
        cluster={"num_cpus": given["workers"], "object_store_memory": 200 * 2**20},
    )
    with collectors:
        for case, size in sizes(collectors, env, learner):
            line(case, [size], unit="bytes")
        line("begin the cluster and its workers", [time.perf_counter() - begun], unit="s")
        here = {"pairs": given["pairs"], "max_steps": TASK.horizon, "progress": False}
        simulated = partial(simulate, env, learner.policy, statistics, randomizer, **here)
        same = torch.equal(simulated()["summary"], simulated(collectors=collectors)["summary"])
        rates = {
            name: [given["pairs"] / s for s in timed(job, given["runs"])]
            for name, job in {
                "here": simulated,
                "on Ray": partial(simulated, collectors=collectors),
            }.items()
        }
        line("pairs here", rates["here"], unit="pairs/s")
        ratio = {"here": rates["here"]}
        line("pairs on Ray", rates["on Ray"], unit="pairs/s", against=ratio, same=same)
        none = torch.empty(0)
        idle = [(None, none, 0, 0)] * given["workers"]
        asked = timed(lambda: collectors._ask("summarise", idle), 50)
        line("a question to all workers, and no answer", asked, unit="s")
        line("memory of a worker", [memory("ray::RayWorker") / given["workers"]], unit="MiB")
        line("memory of Ray beside the workers", [memory("gcs_server", "raylet")], unit="MiB")
        os.kill(next(processes("ray::RayWorker")), signal.SIGKILL)
        (seconds,) = timed(lambda: collectors._ask("summarise", idle), 1)
        line("begin a worker anew that was killed", [seconds], unit="s")


if __name__ == "__main__":
    main(*sys.argv[1:])
