"""Every block of the README runs as it stands."""

import re
import subprocess
from pathlib import Path

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


def test_every_path_that_the_readme_names_exists():
    for path in re.findall(r"`((?:recipes|tests|torchrl_bayessim|\.ci)/[\w./]*)`", README):
        assert (ROOT / path).exists(), path
