"""A policy on film: Gymnasium renders, TorchRL's recorder records, Pillow writes a GIF."""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from tasks import Task
from torch import Tensor
from torchrl.envs import Compose, DoubleToFloat, EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from torchrl.record import VideoRecorder
from torchrl.record.loggers import Logger

from torchrl_bayessim.sources import Grid
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer
from torchrl_bayessim.whole_file import replacing

_EPISODES = 4  # of goals, which are short; one of others
_HEADLESS = {"MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy"}
LONGEST = 250  # steps of an episode


class GifLogger(Logger):
    """Keeps what `VideoRecorder` hands on as a GIF; TorchRL's own loggers need more packages."""

    def __init__(self, path: Path) -> None:
        super().__init__(exp_name=path.stem, log_dir=str(path.parent))
        self.path = path

    def log_video(self, name: str, video: Tensor, step: int | None = None, **_: Any) -> None:
        """Write a video of shape ``(1, T, 3, H, W)``, uint8, 25 pictures a second."""
        from PIL import Image

        del name, step
        frames = [Image.fromarray(f.permute(1, 2, 0).numpy()) for f in video[0]]
        first, *others = [f.quantize(64) for f in frames]
        looped = {"save_all": True, "append_images": others, "duration": 40, "loop": 0}
        with replacing(self.path) as file:
            first.save(file, format="GIF", **looped)

    def log_scalar(self, *args: Any, **options: Any) -> None:
        """Keep nothing: this logger is for videos, as the others below."""

    log_hparams = log_histogram = _create_experiment = log_scalar

    def __repr__(self) -> str:
        return f"GifLogger({self.path})"


class SmallRecorder(VideoRecorder):
    """Keeps pictures small: those of classic control are 400 by 600, and all stay in memory."""

    def __init__(self, logger: Logger, *, tag: str, size: int) -> None:
        super().__init__(logger, tag=tag, skip=1)
        self.size = size

    def _apply_transform(self, observation: Tensor) -> Tensor:
        every = math.ceil(max(observation.shape[:2]) / self.size)
        picture = observation.permute(2, 0, 1).float()
        small = torch.nn.functional.avg_pool2d(picture, every).round().to(torch.uint8)
        super()._apply_transform(small.permute(1, 2, 0))
        return observation


def record(
    task: Task, policy: Any, theta: Tensor, path: Path, *, episodes: int = 0, size: int = 240
) -> str | None:
    """Film a policy at given physics; return the file, or None where nothing can be rendered.

    Args:
        task: Which `Task.rendered` shows, if its simulator has a name.
        policy: What acts.
        theta: The physics.
        path: The file.
        episodes: How many; 0 for four of goals, or the first 250 steps of one.
        size: Pixels of the longer side at most.
    """
    episodes = episodes or (_EPISODES if task.max_steps <= LONGEST / _EPISODES else 1)
    if not task.simulator_name:
        return None
    for name, value in {**_HEADLESS, "PYGAME_HIDE_SUPPORT_PROMPT": "1"}.items():
        os.environ.setdefault(name, value)
    try:
        _film(task, policy, theta, path, episodes=episodes, size=size)
    except Exception as error:  # a driver's, at any step of it; the job goes on without
        print(f"no video: {type(error).__name__}: {error}")
        return None
    return str(path)


def _film(task: Task, policy: Any, theta: Tensor, path: Path, *, episodes: int, size: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        filmed = task.rendered(size)
    recorder = SmallRecorder(GifLogger(path), tag=path.stem, size=size)
    physics = ApplyPhysics(task.physics()), DomainRandomizer(Grid(theta[None]))
    env = TransformedEnv(filmed, Compose(*physics, DoubleToFloat(), recorder))
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            env.set_seed(0)
            for _ in range(episodes):
                _watch(env, policy, steps=min(task.max_steps, LONGEST))
        recorder.dump()
    finally:
        env.close()


def _watch(env: EnvBase, policy: Any, *, steps: int) -> None:
    """Let the policy act; a rollout would keep every picture twice."""
    state = env.reset()
    for _ in range(steps):
        state = step_mdp(env.step(policy(state)))
        if state["done"].all():
            break
