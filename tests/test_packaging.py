"""The wheel builds with everything in it, and the package imports without any extra."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent

BARE = """
import importlib, pkgutil, sys
for name in {blocked!r}:
    sys.modules[name] = None  # as if it were not installed
import torchrl_bayessim
for module in pkgutil.walk_packages(torchrl_bayessim.__path__, "torchrl_bayessim."):
    if not module.name.endswith("conftest"):
        importlib.import_module(module.name)
"""


def test_every_module_imports_without_the_extras():
    blocked = ["matplotlib", "omegaconf", "sbi", "ray", "pybullet", "minari", "tensorboard"]
    source = BARE.format(blocked=[*blocked, "pybullet_envs_gymnasium", "pytest", "hypothesis"])
    subprocess.run([sys.executable, "-c", source], check=True)


def test_the_wheel_holds_every_module(tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for path in (ROOT / "torchrl_bayessim").rglob("*.py"):
        assert (str(path.relative_to(ROOT)) in names) == (path.name != "conftest.py")
    assert "torchrl_bayessim/py.typed" in names


def test_the_extras_are_those_that_the_readers_expect():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(project["optional-dependencies"])
    assert extras >= {"test", "recipes", "sbi", "ray", "pybullet", "minari"}
    for requirement in project["dependencies"]:
        assert "<" in requirement, f"{requirement} has no upper bound"
