"""Logs are read from every format alike, and malformed ones end in one message."""

import importlib.util
import json
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import NonTensorData, TensorDict, lazy_stack

from torchrl_bayessim.logs.columns import Columns
from torchrl_bayessim.logs.read import read_logs, read_records
from torchrl_bayessim.logs.system import System

ROWS = "t,q,qd,tau,note\n0.00,0.1,0.0,1.0,7\n0.01,0.1,0.1,1.0,7\n0.02,0.1,0.2,0.5,7\n"
CUT = "t,q,qd,tau\n0.00,0.1,0.0,1.0\n0.01,0.1,0.1,0.5"


@pytest.fixture
def write(tmp_path):
    def write(text, name="log.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_csv(write, pendulum):
    path = write("\ufeff" + ROWS)
    (log,) = read_logs(path, pendulum)
    assert log.name == "log.csv"
    assert log.first_row == 0
    torch.testing.assert_close(log.qvel[:, 0], torch.tensor([0.0, 0.1, 0.2]).double())
    torch.testing.assert_close(log.ctrl[:, 0], torch.tensor([1.0, 1.0, 0.5]).double())
    assert log.qpos.dtype == torch.float64
    assert log.measured.tolist() == [True, True]
    assert log.velocity_gain.tolist() == [0.0]


def test_files_of_one_name_are_told_apart(write, tmp_path, pendulum):
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        write(ROWS, f"{folder}/run.csv")
    files = [tmp_path / "monday" / "run.csv", tmp_path / "tuesday" / "run.csv"]
    names = [record.name for record in read_records(files, pendulum)]
    assert names == [str(file) for file in files]
    with pytest.raises(ValueError, match=r"each file once, got '.*run\.csv twice'"):
        read_records([files[0], str(files[0])], pendulum)


def test_a_folder_is_read_in_order(write, tmp_path, pendulum):
    write(ROWS, "b.csv")
    write(ROWS, "a.csv")
    write("no log", "README.md")
    write(b"\0\5\26\7 Mac OS X", "._a.csv")
    assert [record.name for record in read_records(tmp_path, pendulum)] == ["a.csv", "b.csv"]
    files = [tmp_path / "b.csv", str(tmp_path / "a.csv")]
    assert [record.name for record in read_records(files, pendulum)] == ["b.csv", "a.csv"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "a header and rows"),
        ("t,q,qd,tau\n", "a header and rows"),
        (ROWS.replace("qd", "q", 1), "each column once in log.csv, got 'q'"),
        (ROWS.replace("qd", "dq", 1), "a column of log.csv, got 'qd'"),
        (ROWS[:-12], "5 cells in row 2 of log.csv"),
        (ROWS.replace("0.5", "half"), "a number in row 2, column 'tau' of log.csv, got 'half'"),
        (ROWS.replace(",", ";"), "a column of log.csv, got 't'"),
        ("t,q,qd,tau,größe\n".encode("latin-1"), "UTF-8"),
        (ROWS.encode("utf-16"), "UTF-8"),
        (ROWS.replace("0.02,", "0.005,"), "increasing time in log.csv, got '0.005 s after"),
        (ROWS.replace("0.1,", "nan,"), "that can be used"),
        (
            ROWS.replace(",note", "").replace(",7\n", "\n")[:-1],
            r"column 'tau' of log.csv, got '\S+ and no line end: is it cut off",
        ),
    ],
)
def test_malformed_csv_is_named(write, pendulum, text, match):
    with pytest.raises(ValueError, match=match):
        read_logs(write(text), pendulum)


def test_cells_left_empty_at_the_ends_of_rows_are_no_columns(write, pendulum):
    plain, padded = (
        read_logs(write(ROWS), pendulum),
        read_logs(write(ROWS.replace("\n", ",,\n"), "padded.csv"), pendulum),
    )
    torch.testing.assert_close(padded[0].qpos, plain[0].qpos)


def test_of_many_columns_the_first_by_name_that_is_there_twice_is_named(write, pendulum):
    names = ",".join(f"c{number}" for number in range(100_000))
    with pytest.raises(ValueError, match=r"each column once in log.csv, got 'c99998'"):
        read_logs(write(f"{names},c99999,c99998\n1\n"), pendulum)


def test_missing_logs_are_named(tmp_path, write, pendulum):
    with pytest.raises(ValueError, match="a folder or file of logs"):
        read_logs(tmp_path / "none", pendulum)
    with pytest.raises(ValueError, match="a folder with CSV or Parquet files"):
        read_logs(tmp_path, pendulum)
    with pytest.raises(ValueError, match=r"a \.csv or \.parquet file"):
        read_logs(write(ROWS, "log.txt"), pendulum)
    with pytest.raises(ValueError, match="a file that exists"):
        read_logs([tmp_path / "none.csv"], pendulum)
    with pytest.raises(ValueError, match="at least one log"):
        read_logs([], pendulum)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("run.csv.gz", "unpack run.csv.gz first"),
        ("run.txt", "by commas and call it run.csv"),
        ("run.mat", "write columns with a header"),
    ],
)
def test_files_of_other_kinds_are_refused_with_how_to_convert_them(tmp_path, name, hint, pendulum):
    (tmp_path / name).write_bytes(b"\x1f\x8b")
    with pytest.raises(
        ValueError, match=rf"a folder with CSV .* Available: {name}\. Try: .*{hint}"
    ):
        read_logs(tmp_path, pendulum)
    with pytest.raises(ValueError, match=rf"a \.csv or \.parquet file.* Try: .*{hint}"):
        read_logs(tmp_path / name, pendulum)


@pytest.mark.parametrize("first", ["# of 3 May\n", "# "], ids=["a comment", "before the names"])
def test_a_line_that_begins_with_a_number_sign_is_no_header(first, write, pendulum):
    with pytest.raises(ValueError, match="Try: a first line with the names alone, without #"):
        read_logs(write(first + ROWS), pendulum)


def test_rows_that_are_not_finite_split_a_log(write, pendulum):
    rows = [f"{0.01 * i:.2f},{0.1 * i},0,{'' if i == 4 else 1},7" for i in range(10)]
    logs = read_logs(write("t,q,qd,tau,note\n" + "\n".join(rows)), pendulum)
    assert [log.name for log in logs] == ["log.csv rows 0 to 3", "log.csv rows 5 to 9"]
    assert [log.first_row for log in logs] == [0, 5]


def test_a_tensordict_is_cut_where_an_episode_ends(tmp_path, pendulum):
    done = torch.zeros(2, 6, 1, dtype=torch.bool)
    done[0, 3] = True
    data = TensorDict(
        {
            "t": 0.01 * torch.arange(6.0).expand(2, 6),
            "q": torch.randn(2, 6, 1),
            "qd": torch.randn(2, 6, 1),
            "tau": torch.randn(2, 6, 1),
            "next": {"done": done},
        },
        batch_size=[2, 6],
    )
    logs = read_logs(data, pendulum)
    assert [len(log) for log in logs] == [4, 2, 6]
    torch.testing.assert_close(logs[1].qpos, data["q"][0, 4:].double())
    data.memmap(tmp_path / "saved")
    saved = read_logs(tmp_path / "saved", pendulum)
    assert [log.name for log in saved] == ["saved[0]", "saved[1]", "saved[2]"]
    torch.testing.assert_close(saved[2].ctrl, logs[2].ctrl)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda data: data.to("meta"), "dense tensors that hold values in tensordict, got .*meta"),
        (lambda data: data.set("q", data["q"].to_sparse()), "got 'one that is torch.sparse_coo'"),
        (lambda data: lazy_stack([data, data[:5]]), "trajectories of one length in tensordict"),
    ],
)
def test_tensors_that_cannot_be_read_are_named(pendulum, change, match):
    names = ("t", "q", "qd", "tau")
    data = TensorDict({name: torch.zeros(20, 1) for name in names}, batch_size=[20])
    with pytest.raises(ValueError, match=match):
        read_logs(change(data), pendulum)


def test_what_a_batch_cuts_off_an_episode_is_left_out(pendulum):
    done = torch.zeros(2, 40, 1, dtype=torch.bool)
    done[0, 33] = True
    data = TensorDict(
        {
            "t": 0.01 * torch.arange(40.0).expand(2, 40),
            "q": torch.randn(2, 40, 1),
            "qd": torch.randn(2, 40, 1, requires_grad=True),
            "tau": torch.randn(2, 40, 1),
            "next": {"done": done},
        },
        batch_size=[2, 40],
    )
    assert [len(log) for log in read_logs(data, pendulum)] == [34, 40]


def test_arrays_may_be_named_as_in_mujoco_and_need_no_time(box):
    pose = torch.tensor([0.0, 0, 1, 1, 0, 0, 0]).expand(7, 7)
    data = TensorDict({"state": {"qpos": pose, "qvel": torch.zeros(7, 6)}}, batch_size=[7])
    (log,) = read_logs(data, box)
    torch.testing.assert_close(log.qpos, pose.double())
    torch.testing.assert_close(log.time, 0.01 * torch.arange(7).double())
    assert log.ctrl.shape == (7, 0)


def test_a_saved_tensordict_cannot_run_code(tmp_path, pendulum):
    data = TensorDict({"q": torch.zeros(3), "code": NonTensorData(print, batch_size=[3])}, [3])
    data.memmap(tmp_path / "saved")
    with pytest.raises(ValueError, match="a tensordict without pickles"):
        read_logs(tmp_path / "saved", pendulum)
    empty = TensorDict({name: torch.zeros(0) for name in ("t", "q", "qd", "tau")}, [0])
    with pytest.raises(ValueError, match="at least one log"):
        read_logs(empty, pendulum)
    with pytest.raises(ValueError, match="batch size"):
        read_logs(TensorDict({"q": torch.zeros(3)}, []), pendulum)


def test_a_folder_that_only_looks_like_a_tensordict(tmp_path, pendulum):
    (tmp_path / "meta.json").write_text(json.dumps({"name": "robot"}))
    with pytest.raises(ValueError, match="a tensordict without pickles"):
        read_logs(tmp_path, pendulum)


def test_parquet(tmp_path, pendulum):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet needs pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = {"t": [0.0, 0.01, 0.02], "q": [1, 2, 3], "qd": [0.0, 0.1, 0.2], "tau": [1.0, 1.0, None]}
    parquet.write_table(pyarrow.table(table), tmp_path / "log.parquet")
    (record,) = read_records(tmp_path, pendulum)
    np.testing.assert_array_equal(record.qpos[:, 0], [1, 2, 3])
    assert np.isnan(record.ctrl[2, 0])
    parquet.write_table(pyarrow.table({**table, "q": ["a", "b", "c"]}), tmp_path / "log.parquet")
    with pytest.raises(ValueError, match="numbers in Parquet"):
        read_records(tmp_path, pendulum)
    (tmp_path / "log.parquet").write_text("no parquet")
    with pytest.raises(ValueError, match="numbers in Parquet"):
        read_records(tmp_path, pendulum)


@pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is not None, reason="only where pyarrow is missing"
)
def test_parquet_without_pyarrow(write, pendulum):
    with pytest.raises(ImportError, match=r"torchrl_bayessim\[recipes\]"):
        read_records(write("", "log.parquet"), pendulum)


@pytest.mark.skipif(
    importlib.util.find_spec("minari") is not None, reason="only where Minari is missing"
)
def test_minari_without_minari(tmp_path, pendulum):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "metadata.json").write_text("{}")
    with pytest.raises(ImportError, match=r"torchrl_bayessim\[minari\]"):
        read_records(tmp_path, pendulum)


@pytest.mark.parametrize(
    "metadata",
    [
        {"env_spec": '{"entry_point": "subprocess:run"}'},
        {"env_spec": "{}", "observation_space": "{}"},
        {"observation_space": {}, "action_space": {}},
        {},
        [],
        None,
    ],
)
def test_minari_never_makes_the_environment_that_a_dataset_names(
    tmp_path, monkeypatch, pendulum, metadata
):
    """It does so where the metadata lack a space, and an entry point may be anything."""

    class Opened:
        def __init__(self, _):
            raise AssertionError("opened")

    monkeypatch.setitem(sys.modules, "minari", SimpleNamespace(MinariDataset=Opened))
    (tmp_path / "data").mkdir()
    file = tmp_path / "data" / "metadata.json"
    file.write_text("[" if metadata is None else json.dumps(metadata))
    with pytest.raises(ValueError, match=r"whose metadata\.json has its spaces"):
        read_records(tmp_path, pendulum)
    spaces = {"observation_space": "{}", "action_space": "{}"}
    file.write_text(json.dumps(spaces))
    with pytest.raises(ValueError, match=r"a Minari dataset in .*, got 'opened'"):
        read_records(tmp_path, pendulum)


@pytest.mark.filterwarnings("ignore::UserWarning:minari.*")  # of metadata that nobody gave
def test_minari(tmp_path, monkeypatch, pendulum):
    minari = pytest.importorskip("minari", reason="needs Minari")
    pytest.importorskip("h5py")
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    states = np.arange(12.0).reshape(6, 2)
    buffer = EpisodeBuffer(
        observations=states,
        actions=np.arange(5.0)[:, None],
        rewards=[0.0] * 5,
        terminations=[False] * 5,
        truncations=[False] * 4 + [True],
        infos={"clock": 0.01 * np.arange(6)},
    )
    space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    minari.create_dataset_from_buffers(
        "swing/test-v0",
        buffer=[buffer, buffer],
        observation_space=space,
        action_space=gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64),
    )
    columns = Columns(
        "infos.clock",
        {"hinge": ("observations[0]",)},
        {"hinge": ("observations[1]",)},
        {"motor": "actions[0]"},
    )
    system = System(task=pendulum.task, columns=columns)
    first, second = read_logs(tmp_path / "swing" / "test-v0", system)
    assert second.name == "test-v0[1]"
    torch.testing.assert_close(first.qpos[:, 0], torch.from_numpy(states[:5, 0]))
    torch.testing.assert_close(first.ctrl[:, 0], torch.arange(5.0).double())
