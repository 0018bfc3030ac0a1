"""Trajectories, logs and their diagnosis."""

from entry import Entry
from makers import (
    FOLDER,
    logs,
    recorded,
    rows,
    statistics,
    system,
)

import torchrl_bayessim as package
from torchrl_bayessim.summaries import moments

ENTRIES = {
    "SummaryStatistics": Entry(
        lambda function, **given: package.SummaryStatistics(function, **given)(rows()),
        lambda: {"function": moments, "angles": (), "observation_key": "observation"},
        {"function": "function", "angles": "columns", "observation_key": "name"},
    ),
    "SummaryStatistics.together": Entry(
        lambda trajectories: statistics().together(trajectories),
        lambda: {"trajectories": rows()},
        {"trajectories": "rows"},
    ),
    "System": Entry(
        package.System,
        lambda: {
            "task": system().task,
            "columns": None,
            "physics": None,
            "prior": None,
            "noise": {},
            "effects": None,
        },
        {
            "task": "object",
            "columns": "object or none",
            "physics": "object or none",
            "prior": "object or none",
            "noise": "noise",
            "effects": "names or none",
        },
    ),
    "System.load": Entry(
        package.System.load, lambda: {"path": f"{FOLDER.name}/robot.yaml"}, {"path": "path"}
    ),
    "read_logs": Entry(
        package.read_logs,
        lambda: {
            "source": recorded(8),
            "system": system(),
        },
        {"source": "source of logs", "system": "object"},
    ),
    "checked_logs": Entry(
        package.checked_logs,
        lambda: {
            "source": recorded(40),
            "system": system(),
            "leave_out": (),
            "horizon": None,
            "spoilt": "leave_out",
        },
        {
            "source": "source of logs",
            "system": "object",
            "leave_out": "names",
            "horizon": "count or none",
            "spoilt": "name",
        },
    ),
    "diagnose": Entry(
        package.diagnose,
        lambda: {
            "simulator": system(),
            "prior": None,
            "logs": logs(),
            "effects": ["action_bias"],
            "findings": (),
            "mode": None,
            "horizon": None,
            "seed": 0,
        },
        {
            "simulator": "object",
            "prior": "object or none",
            "logs": "logs",
            "effects": "names or none",
            "mode": "name or none",
            "horizon": "count or none",
            "seed": "count or zero",
        },
    ),
}
