"""Plain training of a learner under one source of physics: resumable, scored as it goes.

The loop of `sim2real` recipes trains within its rounds; this is what happens outside of them: the
data-collecting policy, baselines, and the policies that `robustness.py` compares. A checkpoint is
chosen by its score on episodes of its own; what is reported is scored on others.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

from torchrl_bayessim import checkpoint
from torchrl_bayessim.errors import message
from torchrl_bayessim.loop import ended_return
from torchrl_bayessim.overlapped import Overlapped
from torchrl_bayessim.randomness import isolated, seed_from
from torchrl_bayessim.simulate import make_collector, next_batch
from torchrl_bayessim.transforms import DomainRandomizer


@dataclass(frozen=True)
class Plan:
    """How long to train, and what to do on the way.

    Attributes:
        batches: Batches to collect and learn from.
        horizon: Steps of each environment per batch.
        keep_every: Batches between two checkpoints; episodes begin anew after each.
        score_every: Batches between two scores.
        decays: Whether the learner is told of its progress, on which its learning rate depends.
        file: Where checkpoints go.
    """

    batches: int
    horizon: int
    keep_every: int = 40
    score_every: int = 20
    decays: bool = True
    file: Path | None = None


@dataclass
class Trained:
    """What a training gave.

    Attributes:
        curve: A point per batch: ``frames``, ``return``, what the learner reports, ``seconds`` of
            wall time and ``cpu_seconds``, and now and then ``score``.
        best: Weights of the policy with the best score; of the last one without scores.
    """

    curve: list[dict[str, float]]
    best: dict[str, Any]


def train(
    learner: Any,
    env: Any,
    randomizer: DomainRandomizer,
    plan: Plan,
    *,
    key: tuple[int | str, ...],
    score: Callable[[Any], float] | None = None,
    label: str = "train",
    progress: bool = True,
) -> Trained:
    """Train, from the checkpoint where there is one.

    Args:
        learner: Such as `DDPG` or `PPO`; it holds the last policy afterwards, not the best. If it
            has ``settings``, as a loop's may, a checkpoint of others is refused.
        env: With ``randomizer`` among its transforms, whose source is what it trains under.
        randomizer: Its episodes are part of checkpoints.
        plan: How long, and what on the way.
        key: What this training is: same key, same numbers.
        score: Gives a policy a number to be chosen by.
        label: Of the progress bar.
        progress: Whether to show one.

    Raises:
        ValueError: The checkpoint is damaged, or of another training: of another key, of a plan
            that trains otherwise, or of a learner with other settings or networks.
    """
    settings = dict(getattr(learner, "settings", {}))
    made_by = {"settings": settings, "plan": _course(plan), "key": list(key)}
    state: dict[str, Any] = {"batch": 0, "curve": [], "best": {}, "best_score": -float("inf")}
    if plan.file is not None and plan.file.exists():
        state = checkpoint.load(plan.file)
        _check_made_by(made_by, state, plan.file)
        try:
            learner.load_state_dict(state["learner"])
            randomizer.set_extra_state(dict(state["randomizer"]))
        except (RuntimeError, KeyError) as error:  # which torch says of networks of other sizes
            raise ValueError(_another("this learner's networks", str(error), plan.file)) from error
    begun = randomizer.get_extra_state()
    collector = make_collector(env, learner.policy, steps=plan.horizon)
    randomizer.set_extra_state(begun)  # making a collector resets once
    done = state["batch"]
    bar = tqdm(total=plan.batches, initial=done, desc=label, disable=not progress, leave=False)
    try:
        while state["batch"] < plan.batches:
            _chunk(learner, collector, plan, state, key=key, score=score, bar=bar)
            if plan.file is not None:
                kept = {"learner": learner.state_dict(), "randomizer": randomizer.get_extra_state()}
                checkpoint.save(plan.file, state | kept | made_by)
    finally:
        bar.close()
        collector.shutdown(close_env=False)
    return Trained(state["curve"], state["best"] or _weights(learner))


def _course(plan: Plan) -> dict[str, Any]:
    """Return what of a plan changes the training; without a decay more batches only go on."""
    course = {"horizon": plan.horizon, "keep_every": plan.keep_every, "decays": plan.decays}
    return course | ({"batches": plan.batches} if plan.decays else {})


def _check_made_by(made_by: dict[str, Any], state: dict[str, Any], file: Path) -> None:
    """Refuse the checkpoint of another training; older ones, which do not say, are let pass."""
    key = made_by["key"]
    if state.get("key", key) != key:
        raise ValueError(_another(f"key={tuple(key)}", tuple(state["key"]), file))
    for part in ("settings", "plan"):
        asked = made_by[part]
        found = state.get(part, asked)
        for name in asked | found:
            if asked.get(name) != found.get(name):
                raise ValueError(_another(f"{name}={asked.get(name)!r}", found.get(name), file))


def _another(expected: str, got: object, file: Path) -> str:
    hint = "the settings of the run that wrote it, another folder, or delete the file"
    return message(f"a checkpoint {file} made with {expected}", got, hint=hint)


def _chunk(
    learner: Any,
    collector: Any,
    plan: Plan,
    state: dict[str, Any],
    *,
    key: tuple[int | str, ...],
    score: Callable[[Any], float] | None,
    bar: Any,
) -> None:
    """Train until the next checkpoint."""
    first = state["batch"]
    with isolated(*key, first, "reset"):
        collector.set_seed(seed_from(*key, first, "env") % 2**31)
        collector.reset()
    learning = Overlapped(learner)
    until = min(first + plan.keep_every, plan.batches)
    for index in range(first, until):
        wall, cpu = time.monotonic(), time.process_time()
        with isolated(*key, index):
            batch = next_batch(collector, meanwhile=learning.meanwhile)
        batch = batch.reshape(-1, batch.shape[-1])
        progress = index / plan.batches if plan.decays else 0.0
        last = state["curve"][-1] if state["curve"] else {}
        point = {"frames": last.get("frames", 0.0) + batch.numel(), "return": ended_return(batch)}
        learning.update(batch, into=point, key=(*key, index), progress=progress)
        due = (index + 1) % plan.score_every == 0 or index + 1 == plan.batches
        if due or index + 1 == until:
            learning.finish()
        point["seconds"] = last.get("seconds", 0.0) + time.monotonic() - wall
        point["cpu_seconds"] = last.get("cpu_seconds", 0.0) + time.process_time() - cpu
        if score is not None and due:
            point["score"] = score(learner.policy)
            bar.set_postfix(score=f"{point['score']:.2f}")
            if point["score"] >= state["best_score"]:
                state |= {"best_score": point["score"], "best": _weights(learner)}
        state["curve"] = [*state["curve"], point]
        state["batch"] = index + 1
        bar.update()


def _weights(learner: Any) -> dict[str, Any]:
    return dict(copy.deepcopy(learner.policy).state_dict())


def scored(curve: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return the points of a curve that have a score."""
    return [point for point in curve if "score" in point]


def first_solved(curve: list[dict[str, float]], least: float) -> dict[str, float] | None:
    """Return where a `thinned` curve first scores, or else returns, at least ``least``."""
    for point in curve:
        if point.get("score", point["return"]) >= least:
            return {name: point[name] for name in ("frames", "seconds", "cpu_seconds")}
    return None


def thinned(curve: list[dict[str, float]], points: int) -> list[dict[str, float]]:
    """Return the scored points, or as many as asked for: each the mean return of a stretch.

    A stretch in which no episode ended, as when all of them last, has the return before it.
    """
    if scored(curve):
        return scored(curve)
    size, shown = max(1, len(curve) // points), []
    for first in range(0, len(curve), size):
        stretch = curve[first : first + size]
        ended = [point["return"] for point in stretch if math.isfinite(point["return"])]
        before = shown[-1]["return"] if shown else float("nan")
        shown.append({**stretch[-1], "return": sum(ended) / len(ended) if ended else before})
    return shown
