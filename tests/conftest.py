"""Shared fixtures: every test owns its randomness and leaves the global generators alone."""

import gc
import os
from pathlib import Path
from weakref import WeakSet

import numpy as np
import pytest
import torch
from hypothesis import settings
from torchrl.envs.batched_envs import BatchedEnvBase

os.environ.setdefault("MUJOCO_GL", "egl")
torch.set_num_threads(1)
settings.register_profile("shared", deadline=None)  # a busy machine is no failure
settings.load_profile("shared")


@pytest.fixture(autouse=True)
def fixed_seed():
    torch.set_num_threads(1)  # whatever the test before has closed
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="session", autouse=True)
def batched_environments():
    """Note the environments of several that are made: to look through all objects takes long."""
    made, begin = WeakSet(), BatchedEnvBase.__init__

    def noted(self, *given, **options):
        made.add(self)
        begin(self, *given, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BatchedEnvBase, "__init__", noted)
        yield made


@pytest.fixture(scope="module", autouse=True)
def no_workers_are_left(batched_environments):
    """Collect what a file of tests leaves, and close what is still held.

    An environment that is collected in the midst of a test of another file closes itself then, and
    torchrl raises the number of torch's threads as it does: from there on, numbers differ in their
    last bits from those of the same seed.
    """
    yield
    if batched_environments:
        gc.collect()
    for env in list(batched_environments):
        if not env.is_closed:
            env.close()
    torch.set_num_threads(1)


@pytest.fixture
def moves():
    """Return what asserts that a film has pictures, and that something moves in them."""
    from PIL import Image

    def check(film, *, pictures=20):
        with Image.open(film) as shown:
            assert shown.n_frames > pictures
            assert max(shown.size) <= 240  # small in memory, too
            first = np.asarray(shown.convert("L"))
            shown.seek(shown.n_frames // 2)
            later = np.asarray(shown.convert("L"))
        assert first.std() > 5
        assert (first != later).any()

    return check


@pytest.fixture
def same_numbers(monkeypatch):
    """Return what asserts that two runs of a recipe wrote the same numbers, but times and paths."""
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "recipes" / "benchmarks")
    from written_numbers import differing, read

    def check(one, other):
        numbers = read(one)
        assert "result.json" in {name.split("/")[0] for name in numbers}
        assert differing(numbers, read(other)) == []

    return check
