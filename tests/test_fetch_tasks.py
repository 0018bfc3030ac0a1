"""What the Fetch tasks of the recipes say about sliding objects."""

from itertools import pairwise
from pathlib import Path

import pytest
import torch

RECIPES = Path(__file__).parent.parent / "recipes"


@pytest.fixture
def fetch_tasks(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)
    import fetch_tasks

    return fetch_tasks


def test_slowing_tells_how_much_speed_a_free_object_loses(fetch_tasks):
    friction, g, dt = 0.2, 9.81, 0.04
    lost = friction * g * dt**2  # m per control step, and step
    speed = (0.03 - lost * torch.arange(11.0)).clamp(min=0.0)
    state = torch.zeros(11, 25)
    state[:, 20] = -0.01  # the hand draws back
    state[:, 14] = speed + 0.01  # relative to it
    state[:, 6] = torch.where(torch.arange(11) < 3, 0.02, 0.2)  # near it, then away
    state, next_state = state[None, :-1], state[None, 1:]
    mask = torch.ones(1, 10, dtype=torch.bool)
    action = torch.zeros(1, 10, 4)
    (found,) = fetch_tasks.slowing(state, action, next_state, mask)
    both, away = found.split(9)
    moving = int((speed[:-1] > 0.02 * dt).sum())
    assert both[0] == pytest.approx(moving / 10)
    assert away[0] == pytest.approx((moving - 2) / 10)  # the first two steps end near the hand
    assert both[5].item() == pytest.approx(100 * lost, rel=1e-3)  # the quantile 0.3
    assert away[6].item() == pytest.approx(100 * lost, rel=1e-3)  # the median
    still = fetch_tasks.slowing(torch.zeros(1, 10, 25), action, torch.zeros(1, 10, 25), mask)
    assert still.tolist() == [[0.0] * 18]


def test_episodes_put_together_count_like_one_long_one(fetch_tasks):
    steps = 0.01 * torch.randn(2, 10, 25)
    mask = torch.ones(2, 10, dtype=torch.bool)
    action = torch.zeros(2, 10, 4)
    pairs = steps, action, steps.roll(1, 1), mask
    apart = fetch_tasks.slowing(*pairs)[:, 0]
    together = fetch_tasks.slowing(*(part.flatten(0, 1)[None] for part in pairs))[:, 0]
    assert together.item() == pytest.approx(apart.mean().item())


def test_push_makes_a_fifth_of_the_multiplications_of_its_wide_preset(fetch_tasks):
    """Forward and backward, a network and its target: five products a layer of each update."""
    task = fetch_tasks.FETCH["fetch_push"]
    inputs, outputs = 28, 4

    def products(task):
        learner = task.learner(task.make(2, seed=0, randomizer=None))
        widths = [inputs + outputs, *learner.settings["hidden"], 1]
        network = sum(a * b for a, b in pairwise(widths))
        every = learner.settings["actor_every"] or 1
        return learner.updates_per_frame * network * (5 + 5 / every)

    wide = fetch_tasks.wide(task)
    assert products(task) / products(wide) == pytest.approx(0.2, abs=0.01)
    frames = {t.budget * t.environments * t.horizon for t in (task, wide)}
    assert frames == {600_000}
    assert {t.warmup * t.environments for t in (task, wide)} == {4000}
