"""Every block of the README runs as it stands, or its commands are those of the recipes."""

import importlib
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_python_blocks_run_in_order(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    namespace = {}
    for source in blocks("python"):
        exec(compile(source, "README.md", "exec"), namespace)
    printed = capsys.readouterr().out
    assert "tensor([" in printed
    assert namespace["rollout"]["theta"].shape == (2, 10, 2)
    assert namespace["report"].effects[0].name == "coulomb_friction"


def test_shell_blocks_are_what_ci_runs():
    run, test = blocks("bash")
    assert "python recipes/sim2real_ppo.py" in run
    assert "pytest" in test
    for line in (run + test).splitlines():
        subprocess.run(["bash", "-n", "-c", line], check=True)
    script = (ROOT / ".ci/run").read_text()
    assert "block Run" in script
    assert "block Test" in script


def commands():
    """Yield the shell commands that no test runs as they stand, without their comments."""
    for source in blocks("sh"):
        for line in source.splitlines():
            if words := shlex.split(line, comments=True):
                yield words


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_other_shell_blocks_name_settings_and_extras_that_exist(words, monkeypatch):
    """Of half an hour and more, or with files of the user's own; what they say is parsed."""
    monkeypatch.syspath_prepend(ROOT / "recipes")
    if words[0] == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        (asked,) = re.findall(r"\.\[(.*)\]", words[-1])
        assert set(asked.split(",")) <= extras["optional-dependencies"].keys()
        return
    python, script, *arguments = words
    assert python == "python"
    recipe, module = (importlib.import_module(name) for name in ("recipe", Path(script).stem))
    assert Path(module.__file__) == ROOT / script
    kinds = [kind for kind in vars(module).values() if is_settings(kind, recipe, module)]
    (settings,) = kinds
    recipe.parse(settings, arguments)


def is_settings(kind, recipe, module):
    mine = isinstance(kind, type) and kind.__module__ == module.__name__
    return mine and issubclass(kind, recipe.Settings)


def test_every_block_of_the_readme_is_of_a_kind_that_is_tested():
    kinds = set(re.findall(r"^```(\w+)$", README, flags=re.MULTILINE))
    assert kinds <= {"python", "bash", "sh"}


def test_every_path_that_the_readme_names_exists():
    for path in re.findall(r"`((?:recipes|tests|torchrl_bayessim|\.ci)/[\w./]*)`", README):
        assert (ROOT / path).exists(), path
