"""What a policy is worth under given physics, in the same episodes every time."""

from __future__ import annotations

from typing import Any

from fetch_tasks import GoalTask
from tasks import Task
from torch import Tensor

from torchrl_bayessim.evaluation import evaluate, successes
from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.transforms import DomainRandomizer


class Score:
    """Returns of one policy after another, or whether goals are reached.

    The initial states, goals and physics are the same for all, so that policies are compared in
    pairs.

    Args:
        task: The task.
        source: Physics of the episodes; of the robot's this is the only code that may know them.
        episodes: Their number; each is an environment of its own.
        seed: Other than that of training, and of other scores.
    """

    def __init__(self, task: Task, source: Any, *, episodes: int, seed: int) -> None:
        self.max_steps, self.seed = task.max_steps, seed
        self.rule = successes if isinstance(task, GoalTask) else evaluate
        self.randomizer = DomainRandomizer(source, seed=seed)
        self.begun = self.randomizer.get_extra_state()
        self.env = task.make(episodes, seed=seed, randomizer=self.randomizer)

    def __call__(self, policy: Any) -> Tensor:
        """Return the return of every episode, or 1 for a goal that was reached and 0 for others."""
        self.env.set_seed(self.seed)
        self.randomizer.set_extra_state(dict(self.begun))
        with isolated("score"):
            return self.rule(self.env, policy, max_steps=self.max_steps).float()
