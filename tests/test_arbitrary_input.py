"""Whatever is given to public entries, they answer, or raise what their documentation says."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from one_joint_arm import ARM, SYSTEM
from tensordict import TensorDict

from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.effects.strength import strength_of
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.logs.description import read_description
from torchrl_bayessim.logs.read import read_logs, read_records
from torchrl_bayessim.logs.record import Record
from torchrl_bayessim.logs.sanity import check, usable_logs
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.summaries import (
    SummaryStatistics,
    autocorrelation,
    cross_correlation,
    duration,
    linear_dynamics,
    moments,
    waypoints,
)


def explained(error):
    """Assert that an error has the one wording that all have."""
    assert str(error.args[0]).startswith("expected")


HERE = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
any_float = st.floats(width=64)
leaves = st.none() | st.booleans() | any_float | st.text(max_size=4)
anything = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner)
)
cells = st.sampled_from(["0.1", "-2", "nan", "1e400", "", " ", '"', "x", "0,5", "\0", "1_0", "é"])
lines = st.lists(cells, max_size=6).map(",".join)
names = st.sampled_from(["t,q,qd,tau", "t,q,qd,tau,t", "t;q", "", "q,t,tau,qd,note"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arbitrary")
    (folder / "robot.xml").write_text(ARM)
    (folder / "robot.yaml").write_text(SYSTEM)
    return folder


@pytest.fixture(scope="module")
def system(folder):
    return System.load(folder / "robot.yaml")


@HERE
@given(
    st.tuples(names, st.lists(lines, max_size=8), st.sampled_from(["\n", "\r\n", "\r", ""])),
    st.binary(max_size=3),
)
def test_csv_files(folder, system, text, tail):
    header, rows, end = text
    path = folder / "log.csv"
    path.write_bytes(end.join([header, *rows]).encode() + tail)
    try:
        (record,) = read_records(path, system)
    except ValueError as error:
        explained(error)
    else:
        assert len(record) >= 1
        assert record.qpos.shape == record.qvel.shape == record.ctrl.shape == (len(record), 1)


@HERE
@given(st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode(errors="ignore")))
def test_descriptions(folder, content):
    path = folder / "other.yaml"
    path.write_bytes(content)
    try:
        read_description(path)
        System.load(path)
    except ValueError as error:
        explained(error)


PLACES = ["robot.xml", "0.01", "time", "hinge", "q}", "motor", "body_mass[link]", "0.3", "noise"]


@HERE
@given(st.sampled_from(PLACES), st.text("ab01.-[]{}:,#&*!|>'\"% \n\t_é", max_size=6))
def test_systems(folder, old, new):
    path = folder / "changed.yaml"
    path.write_text(SYSTEM.replace(old, new, 1))
    try:
        assert System.load(path).robot.channels
    except (ValueError, PhysicsError) as error:
        explained(error)


shapes = st.integers(1, 40)


@HERE
@given(st.data())
def test_the_gate(system, data):
    records = []
    for i in range(data.draw(st.integers(1, 3))):
        rows = data.draw(shapes)
        number = any_float | st.sampled_from([0.0, 0.01, 1.0, 1e8, 1e20])
        values = data.draw(arrays.arrays(np.float64, (rows, 4), elements=number, fill=st.just(0.1)))
        if data.draw(st.booleans()):
            values[:, 0] = 0.01 * np.arange(rows)
        time = np.where(np.abs(values[:, 0]) < 1e20, values[:, 0], np.nan)
        parts = {n: values[:, [c]] for n, c in (("qpos", 1), ("qvel", 2), ("ctrl", 3))}
        records.append(Record(name=f"{i}.csv", time=time, **parts))
    findings = check(records, system)
    assert all(0 <= f.rows[0] <= f.rows[1] < 40 for f in findings)
    try:
        logs = usable_logs(records, system, findings)
    except ValueError as error:
        explained(error)
    else:
        assert all(log.qpos.isfinite().all() and log.qvel.isfinite().all() for log in logs)
        assert all(log.ctrl.isfinite().all() for log in logs)


entries = st.sampled_from(["t", "q", "qd", "tau", "note"])
dtypes = st.sampled_from([torch.float32, torch.int8, torch.bool, torch.bfloat16, torch.complex64])
tails = st.sampled_from([(), (1,), (3,), (0,)])


@HERE
@given(
    st.sampled_from([(), (1,), (5,), (2, 4), (2, 0)]),
    st.dictionaries(entries, st.tuples(dtypes, tails), max_size=5),
)
def test_tensordicts(system, batch, columns):
    given = {k: torch.ones((*batch, *tail)).to(dtype) for k, (dtype, tail) in columns.items()}
    try:
        logs = read_logs(TensorDict(given, batch_size=batch), system)
    except ValueError as error:
        explained(error)
    else:
        assert all(len(log) >= 2 for log in logs)


@HERE
@given(anything | st.dictionaries(st.text(max_size=3), st.tuples(any_float, any_float)), anything)
def test_priors(bounds, extra):
    for make, options in ((BoxPrior, {"log": extra}), (BoxPrior, {}), (GaussianPrior, {})):
        try:
            prior = make(bounds, **options)
        except (ValueError, TypeError) as error:
            explained(error)
            continue
        theta = prior.sample((8,), generator=torch.Generator().manual_seed(0))
        assert prior.contains(theta).all()
        assert not prior.log_prob(theta).isnan().any()


@HERE
@given(st.sampled_from(sorted(CATALOGUE)) | st.text(max_size=8))
def test_names_of_effects(name):
    try:
        assert effect(name).name == name
    except KeyError as error:
        explained(error)


@HERE
@given(anything, st.lists(st.sampled_from("abc"), unique=True))
def test_strengths(strength, targets):
    try:
        values = strength_of("coulomb_friction", strength, tuple(targets))
    except (KeyError, ValueError) as error:
        explained(error)
    else:
        assert values.isfinite().all()
        assert values.shape[-1] == len(targets)


FUNCTIONS = (
    linear_dynamics,
    moments,
    cross_correlation,
    duration,
    autocorrelation(1),
    waypoints(3),
)


@HERE
@given(
    st.sampled_from(FUNCTIONS),
    st.sampled_from([(), (3,), (2, 1), (2, 5), (1, 2, 4), (0, 3), (2, 0)]),
    st.sets(st.sampled_from(["observation", "action", "next"])),
    st.tuples(st.sampled_from([0.0, 1.0, 1e-30, 1e15]), st.booleans()),
)
def test_summaries(function, batch, missing, values):
    scale, indices = values
    steps = lambda *size: scale * torch.ones((*batch, *size))
    action = torch.ones((*batch, 1), dtype=torch.int64) if indices else steps(1)
    done = torch.zeros((*batch, 1), dtype=torch.bool)
    following = {"observation": steps(2), "done": done}
    data = TensorDict({"observation": steps(2), "action": action, "next": following}, batch)
    data = data.exclude(*missing)
    try:
        summary = SummaryStatistics(function)(data)["summary"]
    except (ValueError, KeyError) as error:
        explained(error)
    else:
        assert summary.shape[:-1] == batch[:-1]
        assert summary.isfinite().all()
