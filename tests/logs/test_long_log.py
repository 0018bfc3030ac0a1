"""A log of ten million rows is read in bounded memory, and a slip in its last row is found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from one_joint_arm import describe

READ = """
import json, resource, sys
import numpy as np, pyarrow as pa, pyarrow.parquet as pq
from torchrl_bayessim.logs.read import read_logs, read_records
from torchrl_bayessim.logs.system import System

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # GiB

rows, before = 10_000_000, peak()
time = 0.01 * np.arange(rows)
columns = {"t": time, "q": np.sin(time), "qd": np.cos(time), "tau": np.zeros(rows)}
pq.write_table(pa.table(columns), "log.parquet")
(record,) = read_records("log.parquet", System.load("robot.yaml"))
last = [record.qpos[-1].item(), float(np.sin(time[-1]))]
told = {"rows": len(record), "last": last, "peak": peak() - before}
del record
time[-1] = 0.0
pq.write_table(pa.table(columns), "log.parquet")
try:
    read_logs("log.parquet", System.load("robot.yaml"))
except ValueError as error:
    told["said"] = str(error)
print(json.dumps(told))
"""


@pytest.mark.slow
def test_ten_million_rows(tmp_path):
    describe(tmp_path)
    command = [sys.executable, "-W", "ignore", "-c", READ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["rows"] == 10_000_000
    assert told["last"][0] == told["last"][1]
    assert told["peak"] < 2.0  # of which the columns are 0.3, and 0.3 the file's
    assert "9999999" in told["said"].replace(",", "")
    assert sum(path.stat().st_size for path in Path(tmp_path).iterdir()) > 1e8
