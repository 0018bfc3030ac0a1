"""The blind check of the gap diagnosis: causes that it was not told, scored once.

    python recipes/withheld_effects.py short=true          # a few minutes
    python recipes/withheld_effects.py                     # about two hours

A generator of its own (its own stepping loop, laws and finer integration; nothing of the package)
draws robots, causes, strengths, places, noise and excitation. Labels go to ``sealed/labels.json``,
whose SHA-256 is printed and kept before the first diagnosis, with what the methods were set on and
what is scored; the diagnosis is given a folder with
``system.yaml``, the nominal model and CSV files. When all reports are written, the labels are
opened, checked against the sum, and the reports are scored, once.

Tiers: T0 no cause; T1 a cause as the catalogue has it; T2 the same cause in another form; T3 one
whose class is withheld from the catalogue; T4 a cause that no catalogue has; T5 two causes; T6 the
robot in another engine (MuJoCo with another integrator, cone and solver; T6B: the arm in PyBullet,
which needs the extra ``pybullet``); controls: parameters at
the edge of the prior, twice the noise of the data sheet, actions shuffled between trajectories,
and the same case twice, the second time with every name drawn anew.
``robots=fetch_push`` is Gymnasium-Robotics' arm that pushes an object, with causes in its actions,
its encoders, the object and contacts, and none in joints; there is no T4 or T6B of it. It is drawn
where it is asked for only, since a diagnosis of it takes minutes.
``baselines=true`` asks other methods too (see ``baselines/methods.py``), on the same folders.
Causes below ``threshold`` (see ``withheld/detectability.py``) cannot be seen by anyone, and are
left out of the scores of T1 to T6; ``by_detectability`` has them. Of a pair, each is to be seen,
alone and beside the other.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import recipe
from baselines import methods
from tqdm import tqdm
from withheld import cases, folders, frozen, page, plans, scoring
from withheld.classes import class_of
from withheld.comparison import compared
from withheld.oracle import named_by_oracle
from withheld.regime_overlap import overlap
from withheld.renaming import renamed, same_answer
from withheld.shrinkage import gaps_removed, true_shrinkage

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.errors import message
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.whole_file import replacing, write_text

DIAGNOSIS = "diagnosis"
RENAMED = "-renamed"  # after the name of a case that is handed over twice
TIERS = ("T0", "T1", "T2", "T3", "T4", "T5", "T6", "T6B", "controls")
# Robots, and cases by tier and robot. What the issue of a release asks for takes longer than two
# hours: robots=arm,two_links tiers=T0=150,T1=290,T2=290,T3=150,T4=40,T5=30,T6=20,controls=10
SHORT = "arm", {"T0": 1, "T1": 1, "T2": 2, "T3": 1, "T4": 1}
FULL = (
    "arm,two_links,cart_pole,hopper,half_cheetah",
    {"T0": 8, "T1": 6, "T2": 6, "T3": 4, "T4": 2, "T5": 3, "T6": 2, "controls": 1},
)


@dataclass
class Withheld(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    robots: str = ""  # such as arm,two_links; default of short or full
    tiers: str = ""  # such as T0=4,T2=10: cases by tier and robot; default of short or full
    threshold: float = 100.0  # detectability from which a cause counts as visible
    baselines: bool = False  # whether other methods answer too: about three times the time
    oracle: bool = True  # whether one who knows parameters and strengths answers too
    short: bool = False
    resume: str = ""


def job(settings: Withheld, out: Path) -> dict[str, Any]:
    """Generate, seal, diagnose, open, score."""
    usual, counts = SHORT if settings.short else FULL
    robots = (settings.robots or usual).split(",")
    unknown = [name for name in robots if name not in cases.ROBOTS]
    if unknown:
        raise ValueError(message("a robot", unknown[0], available=list(cases.ROBOTS)))
    tiers = _tiers(settings.tiers) if settings.tiers else counts
    sealed = out / "sealed" / "labels.json"
    if not sealed.exists():
        generate(settings, out, robots=robots, tiers=tiers)
    kept = out / "seal.txt"
    if not kept.exists():
        write_text(kept, folders.digest(sealed))
    seal = kept.read_text()
    check_sealed(sealed, seal)
    print(f"labels sealed: sha256 {seal}", flush=True)
    lists = frozen.lists(settings.seed, robots, tiers)
    print(frozen.told(lists), flush=True)
    names = sorted(path.name for path in (out / "cases").iterdir())
    for name in _progress(names, settings, "diagnosing"):
        if not (out / "reports" / f"{name}.json").exists():
            examine(out / "cases" / name, out / "reports" / f"{name}.json", seed=settings.seed)
    if settings.baselines:
        for name in _progress(names, settings, "asking baselines"):
            ask_baselines(out, name, seed=settings.seed)
    check_sealed(sealed, seal)
    labels = json.loads(sealed.read_text())
    everyone = scored(settings, out, labels)
    records = everyone[DIAGNOSIS]
    write_text(out / "records.json", json.dumps(recipe.plain(records), indent=1))
    result = scoring.scores(records, threshold=settings.threshold)
    result |= {"labels_sha256": seal, "frozen": lists}
    if settings.baselines:
        write_text(out / "baselines.json", json.dumps(recipe.plain(everyone), indent=1))
        result["methods"] = compared(everyone, threshold=settings.threshold)
    page.write_page(records, result, out)
    return result


def _tiers(text: str) -> dict[str, int]:
    try:
        counts = {name: int(count) for name, count in (p.split("=") for p in text.split(","))}
    except ValueError:
        raise ValueError(message("tiers such as T0=4,T2=10", text)) from None
    for name in counts:
        if name not in TIERS:
            raise ValueError(message("a tier", name, available=TIERS))
    return counts


def _progress(things: list[Any], settings: Withheld, what: str) -> Iterable[Any]:
    return tqdm(things, desc=what, disable=not settings.progress)


def generate(settings: Withheld, out: Path, *, robots: list[str], tiers: dict[str, int]) -> None:
    """Write the cases' folders, those that a broken run has not written, and seal the labels."""
    rng = np.random.default_rng([settings.seed, 0])
    labels = {}
    drawn = plans.plans(tiers, robots, rng)
    for i, plan in enumerate(_progress(drawn, settings, "generating")):
        name = f"case{i:04d}"
        label = out / "sealed" / name / "label.json"
        if not label.exists():
            rng = np.random.default_rng([settings.seed, 1 + i])
            case = cases.make(plan, rng)
            write_case(out, name, case, rng)
        unseen = folders.digest(out / "sealed" / name / "unseen.npz")
        labels[name] = json.loads(label.read_text()) | {"unseen_sha256": unseen}
    write_text(out / "sealed" / "labels.json", json.dumps(labels, indent=1))


def write_case(out: Path, name: str, case: cases.Case, rng: np.random.Generator) -> None:
    """Write what the diagnosis is given, once more under other names if so planned, and seal."""
    sealed, label, files = out / "sealed" / name, folders.label(case), folders.handed_over(case)
    written = {name: files}
    if case.plan.control == "renamed":
        written[name + RENAMED], label["names"] = renamed(files, rng)
    for folder, texts in written.items():
        for file, text in texts.items():
            write_text(out / "cases" / folder / file, text)
    with replacing(sealed / "unseen.npz") as file:
        file.write(folders.unseen(case))
    write_text(sealed / "label.json", json.dumps(label))


def check_sealed(labels: Path, seal: str) -> None:
    """Refuse labels, or motions sealed with them, that are not those of the seal.

    Raises:
        ValueError: One of these files has changed since.
    """
    if folders.digest(labels) != seal:
        raise ValueError(message("labels as they were sealed", "another file"))
    for name, label in json.loads(labels.read_text()).items():
        if folders.digest(labels.parent / name / "unseen.npz") != label["unseen_sha256"]:
            raise ValueError(message(f"the motions of {name} as they were sealed", "others"))


def examine(case: Path, report: Path, *, seed: int) -> None:
    """Diagnose one folder; whatever goes wrong is its report."""
    begun = time.perf_counter()
    try:
        system = System.load(case / "system.yaml")
        said = diagnose(system, None, read_logs(case, system), seed=seed)
        # frequencies, phases and the like, which the report's form has no place for
        found = said.to_dict() | {"options": {e.name: dict(vars(e)) for e in said.strengths}}
    except Exception as error:
        found = {"verdict": "crash", "summary": f"{type(error).__name__}: {error}"}
    found["seconds"] = time.perf_counter() - begun
    write_text(report, json.dumps(scoring.finite(found)))


def ask_baselines(out: Path, name: str, *, seed: int) -> None:
    """Write what the baselines say of a folder, with the budget that the diagnosis took."""
    file = out / "baselines" / f"{name}.json"
    if file.exists():
        return
    report = json.loads((out / "reports" / f"{name}.json").read_text())
    audit = report.get("audit", {})
    budget, noise = audit.get("simulator_steps", 0), audit.get("noise")
    said = methods.answers(out / "cases" / name, budget=budget, seed=seed, noise=noise)
    write_text(file, json.dumps(scoring.finite(said)))


def scored(
    settings: Withheld, out: Path, labels: Mapping[str, Any]
) -> dict[str, list[dict[str, Any]]]:
    """Return the records of all cases, of the diagnosis and of the baselines if they were asked."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name in sorted(labels):
        reports = reports_of(out, name, baselines=settings.baselines)
        case, unseen = out / "cases" / name, out / "sealed" / name / "unseen.npz"
        system = System.load(case / "system.yaml")
        logs = read_logs(case, system)
        removed: Mapping[str, float | None] = {}
        if settings.baselines:
            removed = gaps_removed(system, logs, unseen, reports)
        for method, report in reports.items():
            names = report["verdict"] in scoring.NAMING
            shrinks = true_shrinkage(system, logs, unseen, report) if names else None
            one = scoring.record(labels[name], report, shrinks) | {"case": name}
            found.setdefault(method, []).append(one | {"removed": removed.get(method)})
        found[DIAGNOSIS][-1]["regime"] = overlap(system, logs, unseen, reports[DIAGNOSIS])
        if "names" in labels[name]:
            others = reports_of(out, name + RENAMED, baselines=settings.baselines)
            for method, other in others.items():
                same = same_answer(reports[method], other, labels[name]["names"])
                found[method][-1]["same"] = same
        if settings.oracle:
            found[DIAGNOSIS][-1] |= ask_oracle(system, logs, labels[name])
    return found


def reports_of(out: Path, name: str, *, baselines: bool) -> dict[str, dict[str, Any]]:
    """Return what was said of a case, by method."""
    said = {DIAGNOSIS: json.loads((out / "reports" / f"{name}.json").read_text())}
    if baselines:
        said |= json.loads((out / "baselines" / f"{name}.json").read_text())
    return said


def ask_oracle(system: System, logs: Sequence[Log], label: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the oracle names, where one cause is true and nothing is left to chance."""
    true = [truth["name"] for truth in label["truths"]]
    if label["tier"] not in {"T1", "T2", "T6", "T6B"} or len(true) != 1 or effect(true[0]).random:
        return {}
    said = named_by_oracle(system, logs, label)
    return {"oracle": said, "oracle_class": class_of(said) == class_of(true[0])}


if __name__ == "__main__":
    recipe.main(Withheld, job)
