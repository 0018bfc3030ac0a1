"""Shared fixtures: every test owns its randomness and leaves the global generators alone."""

import os

import pytest
import torch
from hypothesis import settings

os.environ.setdefault("MUJOCO_GL", "egl")
torch.set_num_threads(1)
settings.register_profile("shared", deadline=None)  # a busy machine is no failure
settings.load_profile("shared")


@pytest.fixture(autouse=True)
def fixed_seed():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
