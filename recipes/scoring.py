"""What a policy is worth under given physics, in the same episodes every time."""

from __future__ import annotations

from typing import Any

from tasks import Task
from torch import Tensor

from torchrl_bayessim.randomness import isolated
from torchrl_bayessim.transforms import DomainRandomizer


class Score:
    """Scores of one policy after another, as the task has them: returns, or goals reached.

    The initial states, goals and physics are the same for all, so that policies are compared in
    pairs.

    Args:
        task: The task.
        source: Physics of the episodes; of the robot's this is the only code that may know them.
        episodes: Their number; each is an environment of its own.
        seed: Other than that of training, and of other scores.
    """

    def __init__(self, task: Task, source: Any, *, episodes: int, seed: int) -> None:
        self.task, self.seed = task, seed
        self.randomizer = DomainRandomizer(source, seed=seed)
        self.begun = self.randomizer.get_extra_state()
        self.env = task.make(episodes, seed=seed, randomizer=self.randomizer)

    def __call__(self, policy: Any) -> Tensor:
        """Return the score of every episode, shape ``(episodes,)``."""
        self.env.set_seed(self.seed)
        self.randomizer.set_extra_state(dict(self.begun))
        with isolated("score"):
            return self.task.scores(self.env, policy)
