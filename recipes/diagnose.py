"""What a simulator lacks, from logs of the real robot.

    python recipes/diagnose.py system=robot.yaml data=logs/ out=report/

Reads the description of the robot and its logs, checks whether the logs can be believed, and says
where the gap lies, which effect causes it and how far it shrinks. Malformed logs are refused, in
one message that names all that is wrong with them; spoilt=leave_out goes on without those parts.
Writes report.html (one file), report.json and result.json; the last line but one is the verdict in
a sentence.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import recipe
from tqdm import tqdm

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.page import page
from torchrl_bayessim.errors import message
from torchrl_bayessim.logs.checked import checked_logs
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.sanity import Finding
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.whole_file import write_texts

STAGES = 6  # of a search that ends after one round
LONGEST = 10_000


@dataclass
class Diagnosis(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    system: str = ""  # system.yaml
    data: str = ""  # a folder of CSV or Parquet files, a Minari dataset, a saved TensorDict
    spoilt: str = "refuse"  # malformed logs, or leave_out: go on without the rows that are named
    leave_out: str = ""  # logs whose names contain one of these, with commas between them
    effects: str = ""  # names with commas between them; the system's own by default
    mode: str = ""  # segments, trajectories, or summaries where clocks are not synchronised
    horizon: int = 0  # control steps predicted at a time; 0: chosen from the data
    short: bool = False  # a smoke test: a diagnosis is one already


def job(settings: Diagnosis, out: Path) -> dict[str, Any]:
    """Read, check, diagnose, and write the report."""
    system, logs, findings = read(settings)
    with stages(shown=settings.progress) as progress:
        report = diagnose(
            system,
            None,
            logs,
            effects=chosen(settings.effects),
            findings=findings,
            mode=settings.mode or None,
            horizon=settings.horizon or None,
            seed=settings.seed,
            progress=progress,
        )
    text = report.as_json()
    write_texts({out / "report.json": text, out / "report.html": page(report)})
    print(f"The page is {out / 'report.html'}")
    print(report.summary)
    return json.loads(text)


def read(settings: Diagnosis) -> tuple[System, list[Log], list[Finding]]:
    """Return the system, the logs that can be used, and what is odd about them."""
    for name in ("system", "data"):
        if not getattr(settings, name):
            raise ValueError(message(f"{name}=PATH", "none"))
    if settings.horizon < 0:
        raise ValueError(message("a horizon of 1 or more, or 0 to choose one", settings.horizon))
    if settings.horizon > LONGEST:
        raise ValueError(message(f"a horizon of at most {LONGEST} steps", settings.horizon))
    system = System.load(settings.system)
    logs, findings = checked_logs(
        settings.data,
        system,
        leave_out=settings.leave_out.split(",") if settings.leave_out else (),
        horizon=settings.horizon or None,
        spoilt=settings.spoilt,
    )
    for finding in findings:
        print(finding)
    return system, logs, findings


def chosen(effects: str) -> list[str] | None:
    """Return the names of the effects to consider, ``None`` for the system's own."""
    if not effects:
        return None
    return [name.strip() for name in effects.split(",")]


@contextmanager
def stages(*, shown: bool) -> Iterator[Any]:
    """Give what shows the stage that a diagnosis is at, in a bar."""
    with tqdm(total=STAGES, disable=not shown, bar_format="{l_bar}{bar}| {elapsed}") as bar:

        def begin(stage: str) -> None:
            bar.total = max(bar.total, bar.n + 2)  # a further round of the search
            bar.set_description(stage)
            bar.update()

        yield begin
        bar.set_description("done")
        bar.update(bar.total - bar.n)


if __name__ == "__main__":
    recipe.main(Diagnosis, job)
