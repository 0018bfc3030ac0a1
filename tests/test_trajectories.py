import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_bayessim.trajectories import concatenate, first_trajectories, pad, returns


def rows(*done, **entries):
    """Batch ``[n, T]`` from strings of steps, ``x`` where an episode ends."""
    flags = torch.tensor([[letter == "x" for letter in row] for row in done]).unsqueeze(-1)
    entries = {"reward": torch.ones(flags.shape)} | entries
    return TensorDict({"next": {"done": flags, **entries}}, flags.shape[:2])


def kept(batch):
    return ["".join("#" if on else "." for on in row) for row in first_trajectories(batch)["mask"]]


def test_the_first_trajectory_of_a_row_ends_with_its_first_done():
    assert kept(rows("....", "x...", ".x.x", "...x")) == ["####", "#...", "##..", "####"]


def test_a_collectors_own_mask_counts_too():
    batch = rows("....", ".x..")
    batch["collector", "mask"] = torch.tensor([[1, 1, 1, 0], [1, 1, 0, 0]]).bool()
    assert kept(batch) == ["###.", "##.."]


def test_the_batch_is_left_as_it_was():
    batch = rows("..x.")
    first_trajectories(batch)
    assert list(batch.keys()) == ["next"]


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5))
@settings(deadline=None, max_examples=30)
def test_padding_keeps_every_step_and_masks_the_rest(lengths):
    steps = [
        TensorDict({"action": torch.full((t, 2), float(i)), "count": torch.arange(t)}, [t])
        for i, t in enumerate(lengths)
    ]
    padded = pad(steps)
    assert padded.batch_size == (len(lengths), max(lengths))
    assert padded["mask"].sum(-1).tolist() == lengths
    assert padded["count"].dtype == torch.int64
    for row, step in zip(padded, steps, strict=True):
        for name in ("action", "count"):
            assert torch.equal(row[name][row["mask"]], step[name])
    assert padded["action"].isfinite().all()


@pytest.mark.parametrize("given_rows", [[], [TensorDict({"a": torch.ones(0, 1)}, [0])]])
def test_nothing_to_pad_is_refused(given_rows):
    with pytest.raises(ValueError, match=r"at least one trajectory.*drop the empty logs"):
        pad(given_rows)


def test_returns_sum_the_rewards_that_count():
    batch = rows("....", ".x..")
    batch["next", "reward"][1, 2:] = torch.nan
    assert returns(first_trajectories(batch)).tolist() == [4.0, 2.0]


def test_batches_are_joined_row_by_row():
    joined = concatenate([rows("..x"), rows("x..", "...")])
    assert kept(joined) == ["###", "#..", "###"]
