"""The same case under other names: what a diagnosis says of it must not hang on what it reads.

Bodies, joints and actuators of the model, columns of the logs and their order are drawn anew; the
physics, the numbers and the order of joints stay.
"""

from __future__ import annotations

__all__ = ["renamed", "same_answer", "translated"]

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

_LETTERS = "bcdfghjklmnpqrstvwxz"
_WITHIN = 0.01  # of a strength


def renamed(files: Mapping[str, str], rng: np.random.Generator) -> tuple[dict[str, str], dict]:
    """Return the files of a folder under other names, and the new name of each old one.

    Args:
        files: ``system.yaml``, ``robot.xml`` and CSV files, by name.
        rng: Of names and the order of columns.
    """
    system = yaml.safe_load(files["system.yaml"])
    columns = system["columns"]
    old = [*re.findall(r'\bname="([^"]*)"', files["robot.xml"]), columns["time"]]
    for kind in ("qpos", "qvel", "ctrl"):
        old += columns.get(kind, {}).values()
    names = {name: _name(rng) for name in old}
    columns["time"] = names[columns["time"]]
    for kind in {"qpos", "qvel", "ctrl"} & set(columns):
        columns[kind] = {names[place]: names[column] for place, column in columns[kind].items()}
    system["parameters"] = {_entry(e, names): b for e, b in system["parameters"].items()}
    if "noise" in system:
        system["noise"] = {names[column]: value for column, value in system["noise"].items()}
    made = {"system.yaml": yaml.safe_dump(system, sort_keys=False)}
    made["robot.xml"] = re.sub(
        r'\b(name|joint)="([^"]*)"',
        lambda found: f'{found[1]}="{names[found[2]]}"',
        re.sub(r'\bmodel="[^"]*"', 'model="robot"', files["robot.xml"]),
    )
    logs = {name: text for name, text in files.items() if name.endswith(".csv")}
    return made | {name: _reordered(text, names, rng) for name, text in logs.items()}, names


def _name(rng: np.random.Generator) -> str:
    return "".join(rng.choice(list(_LETTERS), 8))


def _entry(entry: str, names: Mapping[str, str]) -> str:
    return re.sub(r"\[(\w+)\]", lambda found: f"[{names[found[1]]}]", entry)


def _reordered(text: str, names: Mapping[str, str], rng: np.random.Generator) -> str:
    header, *rows = (line.split(",") for line in text.splitlines())
    order = rng.permutation(len(header))
    lines = [",".join(names[header[i]] for i in order)]
    lines += [",".join(row[i] for i in order) for row in rows]
    return "\n".join(lines) + "\n"


def translated(where: str, names: Mapping[str, str]) -> str:
    """Return a place in the new names: a name, perhaps with an axis after it.

    Example:
        >>> translated("link z", {"link": "abc"})
        'abc z'
    """
    for name in sorted(names, key=len, reverse=True):
        if where == name or where.startswith(f"{name} "):
            return names[name] + where[len(name) :]
    return where


def same_answer(
    report: Mapping[str, Any], other: Mapping[str, Any], names: Mapping[str, str]
) -> bool:
    """Return whether two reports say the same up to names: verdict, causes, places, strengths."""
    mine, others = ([(e["name"], e["where"], e["strength"]) for e in one.get("effects", ())]
                    for one in (report, other))  # fmt: skip
    if "crash" in {report["verdict"], other["verdict"]}:
        return False
    if report["verdict"] != other["verdict"] or len(mine) != len(others):
        return False
    return all(
        name == other_name
        and translated(where, names) == place
        and abs(strength - value) <= _WITHIN * abs(strength)
        for (name, where, strength), (other_name, place, value) in zip(mine, others, strict=True)
    )
