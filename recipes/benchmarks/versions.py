"""Does the package hold at both ends of the versions that it declares, bare, and with each extra?

Each environment is made anew: ``low`` has every dependency at its lower bound, all others the
newest that are declared. The package is built and installed, every module is imported from
elsewhere, then some of the tests run. Prints one JSON line per environment, and ends with status 1
if one failed::

    python recipes/benchmarks/versions.py [low high bare sbi ray ...] [torch=2.13.0]

``NAME=VERSION`` sets a version everywhere: torch's from the package index are gigabytes of CUDA.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
# Documentation examples of every module; simulators, inference and learners against known answers
SMOKE = (
    "torchrl_bayessim",
    "tests/envs/test_mujoco_parity.py",
    "tests/inference/test_posterior.py",
    "tests/physics/test_mujoco_physics.py",
)
# What an extra is for: extras to install, modules to import, tests
OF_EXTRA = {
    "recipes": ("recipes", "matplotlib omegaconf pyarrow", "tests/test_plots.py tests/logs"),
    "sbi": ("sbi", "sbi", "tests/test_sbi_source.py"),
    "ray": ("recipes,ray", "ray", "tests/test_remote_source.py tests/test_ray_collectors.py"),
    "pybullet": ("pybullet", "pybullet pybullet_envs_gymnasium", "tests/physics"),
    "minari": ("minari", "minari h5py", "tests/logs/test_read.py"),
    "tensorboard": ("recipes,tensorboard", "tensorboard", "tests/test_journal.py"),
}
ENVIRONMENTS = {
    "low": ("recipes", "matplotlib omegaconf pyarrow", " ".join(SMOKE)),
    "high": ("recipes", "matplotlib omegaconf pyarrow", " ".join(SMOKE)),
    "bare": ("", "", " ".join([*SMOKE, "--ignore=torchrl_bayessim/plots.py"])),
    **OF_EXTRA,
}
IMPORTS = """
import importlib, pkgutil, sys, torchrl_bayessim
for module in pkgutil.walk_packages(torchrl_bayessim.__path__, "torchrl_bayessim."):
    importlib.import_module(module.name)
for name in sys.argv[1:]:
    importlib.import_module(name)
"""
VERSIONS = """
import importlib.metadata, sys
print(", ".join(f"{name} {importlib.metadata.version(name)}" for name in sys.argv[1:]))
"""


def requirements(*extras: str) -> list[str]:
    """Return what the package asks for, and what these extras do."""
    asked = [*PROJECT["dependencies"], *(line for extra in extras for line in EXTRAS[extra])]
    return [line for line in asked if package(line) != PROJECT["name"]]


def package(requirement: str) -> str:
    """Return the name of what is required."""
    return re.split(r"[<>=\[]", requirement)[0]


def constraints(name: str, given: dict[str, str]) -> Iterator[str]:
    """Yield the versions of an environment: its lower bounds, and those given."""
    for requirement in requirements(*EXTRAS) if name == "low" else ():
        if package(requirement) not in given:
            lower = requirement.split(",")[0].replace(">=", "==")
            yield re.sub(r"\[.*\]", "", lower)  # constraints have no extras
    yield from (f"{one}=={version}" for one, version in given.items())


def examine(name: str, given: dict[str, str]) -> dict[str, object]:
    """Make an environment, and return what failed in it, or what it holds."""
    extras, modules, tests = ENVIRONMENTS[name]
    names = [package(line) for line in requirements(*filter(None, extras.split(",")))]
    testing = [line for line in EXTRAS["test"] if line.startswith(("pytest", "hypothesis"))]
    asked = [f"{ROOT}[{extras}]" if extras else str(ROOT), *testing]
    with tempfile.TemporaryDirectory() as folder:
        python = str(Path(folder, "venv/bin/python"))
        venv.create(Path(folder, "venv"), with_pip=True)
        pins = Path(folder, "constraints.txt")
        pins.write_text("\n".join(constraints(name, given)))
        steps = {
            "install": [python, "-m", "pip", "install", "-c", str(pins), *asked],
            "import": [python, "-W", "ignore", "-c", IMPORTS, *modules.split()],
            "tests": [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests.split()],
            "versions": [python, "-c", VERSIONS, *names],
        }
        return run(steps, Path(folder))


def run(steps: dict[str, list[str]], folder: Path) -> dict[str, object]:
    """Run the steps in turn; return the one that failed, and the last lines it printed."""
    told: dict[str, object] = {}
    for step, command in steps.items():
        where = ROOT if step == "tests" else folder  # elsewhere only what is installed is found
        done = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
        lines = [x for x in (done.stdout + done.stderr).splitlines() if not x.startswith("WARN")]
        if done.returncode:
            return {"failed": step, "said": lines[-15:]}
        told[step] = lines[-1] if lines else ""
    return {"failed": None, "tests": told.get("tests"), "versions": told.get("versions")}


def main(*arguments: str) -> None:
    """Examine the environments in turn."""
    given = dict(a.split("=") for a in arguments if "=" in a)
    names = [a for a in arguments if "=" not in a] or list(ENVIRONMENTS)
    if unknown := set(names) - ENVIRONMENTS.keys():
        raise SystemExit(f"expected environments {list(ENVIRONMENTS)}, got {sorted(unknown)}")
    failed = []
    for name in names:
        found = examine(name, given)
        print(json.dumps({"benchmark": "versions", "case": name, **found}), flush=True)
        failed += [name] if found["failed"] else []
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main(*sys.argv[1:])
