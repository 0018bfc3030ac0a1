"""Doctests run seeded, with ``torch`` at hand."""

from collections.abc import Iterator

import pytest
import torch

torch.set_num_threads(1)  # small tensors: a second thread costs more than it brings


@pytest.fixture(autouse=True)
def _doctest(doctest_namespace: dict[str, object]) -> Iterator[None]:
    doctest_namespace["torch"] = torch
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
