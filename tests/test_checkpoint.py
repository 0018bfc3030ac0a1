import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.checkpoint import SCHEMA, load, save
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv


@pytest.fixture
def file(tmp_path):
    return tmp_path / "state.pt"


LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
STATES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text() | st.integers(), inner, max_size=3)
        | st.tuples(inner, inner)
    ),
    max_leaves=8,
)


@given(state=st.dictionaries(st.text(), STATES, max_size=3))
def test_plain_values_come_back_as_they_were(state, tmp_path_factory):
    file = tmp_path_factory.getbasetemp() / "plain.pt"
    save(file, state)
    assert load(file) == state


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.bool])
def test_tensors_come_back_exactly(file, dtype):
    tensor = (torch.randn(3, 4) * 2).to(dtype)
    save(file, {"nested": {"x": tensor}})
    restored = load(file)["nested"]["x"]
    assert restored.dtype == dtype
    assert torch.equal(restored, tensor)


def test_a_view_does_not_drag_its_storage_along(file):
    save(file, {"x": torch.zeros(1_000_000)[:3].requires_grad_()})
    assert file.stat().st_size < 10_000
    assert not load(file)["x"].requires_grad


def test_a_learner_goes_through_a_file(file):
    env = CartPoleEnv(4, max_steps=10)
    ppo = PPO(env, minibatch_size=16, epochs=1)
    with torch.no_grad():
        batch = env.rollout(16, ppo.policy, break_when_any_done=False)
    ppo.update(batch, key=(0,))
    save(file, {"ppo": ppo.state_dict()})
    resumed = PPO(env, minibatch_size=16, epochs=1)
    resumed.load_state_dict(load(file)["ppo"])
    assert resumed.update(batch, key=(1,)) == ppo.update(batch, key=(1,))


def test_saving_replaces_and_leaves_nothing_else_behind(file):
    for i in range(3):
        save(file, {"i": i})
    assert load(file) == {"i": 2}
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize(
    ("state", "match"),
    [
        ({"a": {"b": [torch.nn.Linear(1, 1)]}}, r"state\['a'\]\['b'\]\[0\].*got 'Linear'"),
        ({"a": np.float64(1)}, r"state\['a'\] to be a tensor or a plain value, got 'float64'"),
        ({(1, 2): 0}, r"keys of state to be str or int, got \(1, 2\)"),
    ],
)
def test_what_would_need_pickle_is_refused_and_the_old_file_stays(file, state, match):
    save(file, {"good": 1})
    with pytest.raises(TypeError, match=match):
        save(file, state)
    assert load(file) == {"good": 1}
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_file_is_refused(file, share):
    save(file, {"x": torch.randn(1_000)})
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=r"expected a whole checkpoint.*Try: another"):
        load(file)


def test_a_flipped_bit_in_a_tensor_is_noticed(file):
    save(file, {"x": torch.full((1_000,), 1.5)})
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(ValueError, match="whole checkpoint"):
        load(file)


def test_whatever_byte_is_altered_the_state_is_whole_or_refused_in_words(file):
    state = {"loop": {"round": 1, "curve": [{"frames": 3.5}]}, "x": torch.arange(8.0)}
    save(file, state)
    data, said = file.read_bytes(), []
    changes = np.random.default_rng(0).integers([[0, 1]], [[len(data), 256]], (600, 2))
    for place, change in changes.tolist():
        altered = bytearray(data)
        altered[place] ^= change
        file.write_bytes(altered)
        try:
            found = load(file)
        except ValueError as error:
            said.append(str(error))
        else:
            assert str(found) == str(state)
    assert len(said) > 100
    known = ("expected a whole checkpoint", "expected a checkpoint written")
    assert [text for text in said if not text.startswith(known)] == []


def test_an_archive_with_two_parts_of_one_name_is_refused(file):
    save(file, {"x": torch.arange(8.0), "y": torch.zeros(8)})
    data = file.read_bytes()
    assert data.count(b"data/1") == 2  # in its header, and in the directory
    file.write_bytes(data.replace(b"data/1", b"data/0"))
    with pytest.raises(ValueError, match="a whole checkpoint written by this package"):
        load(file)


def test_foreign_files_are_refused(file):
    file.write_text("time,q\n0,1\n")
    with pytest.raises(ValueError, match="whole checkpoint"):
        load(file)
    torch.save({"weight": torch.ones(1)}, file)
    with pytest.raises(ValueError, match="expected a checkpoint written by this package"):
        load(file)


def test_code_in_a_file_is_not_run(file):
    class Payload:
        def __reduce__(self):
            return (pytest.fail, ("code was run",))

    torch.save({"format": "torchrl_bayessim checkpoint", "state": Payload()}, file)
    with pytest.raises(ValueError, match="whole checkpoint") as caught:
        load(file)
    assert isinstance(caught.value.__cause__, pickle.UnpicklingError)


def test_another_schema_is_refused(file):
    content = {"format": "torchrl_bayessim checkpoint", "schema": SCHEMA + 1, "state": {}}
    torch.save(content, file)
    with pytest.raises(ValueError, match=f"schema {SCHEMA}, got {SCHEMA + 1}"):
        load(file)


def test_a_missing_file_is_said_to_be_missing(file):
    with pytest.raises(FileNotFoundError, match=r"state\.pt"):
        load(file)


SAVE_FOR_EVER = """
import itertools, sys, torch
from torchrl_bayessim.checkpoint import save
for i in itertools.count():
    save(sys.argv[1], {"i": i, "x": torch.full((200_000,), float(i))})
"""


def test_killed_at_any_moment_the_file_is_whole(tmp_path):
    files = [tmp_path / str(i) / "state.pt" for i in range(2)]
    writers = [
        subprocess.Popen([sys.executable, "-W", "ignore", "-c", SAVE_FOR_EVER, str(file)])
        for file in files
    ]
    for i, (file, writer) in enumerate(zip(files, writers, strict=True)):
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        for _ in range(10):  # while it is being written, too
            state = load(file)
            assert (state["x"] == state["i"]).all()
        time.sleep(0.0137 * (i + 1))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        state = load(file)
        assert (state["x"] == state["i"]).all()
        save(file, {"after": 1})
        assert load(file) == {"after": 1}


def test_a_folder_is_no_checkpoint(tmp_path):
    with pytest.raises(IsADirectoryError, match="expected the file of a checkpoint"):
        save(tmp_path, {"round": 1})
    with pytest.raises(IsADirectoryError, match="name a file in it"):
        load(tmp_path)
