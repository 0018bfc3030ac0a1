"""Imports point down only, and the public names are what the package says they are."""

import ast
from pathlib import Path

import torchrl_bayessim

ROOT = Path(torchrl_bayessim.__file__).parent

# From the bottom up. A module may import from the layers below its own, and from its own layer as
# long as no cycle arises.
LAYERS = [
    {"counts", "errors", "kinds", "randomness", "scalars", "whole_file"},
    {
        "sources",
        "sbi_source",
        "trajectories",
        "checkpoint",
        "plots",
        "physics",
        "envs",
        "evaluation",
        "replay_actions",
    },
    {"summaries", "episode_draws", "remote_source", "inference", "agents", "replay", "effects"},
    {"logs"},
    {"transforms"},
    {
        "diverged",
        "pairs",
        "simulate",
        "ray_collectors",
        "ray_probe",
        "ray_waiting",
        "ray_worker",
        "real_trajectories",
        "robots",
        "influence",
        "excitation",
        "information",
        "diagnosis",
    },
    {"evidence", "overlapped"},
    {"loop"},
    {"trainer"},
]


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if not name.endswith("__init__") and name != "conftest":
            yield name, path


def imports(name, path):
    """Yield the package's own modules that a file imports at run time, and how."""
    tree = ast.parse(path.read_text())
    guarded = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and id(node) not in guarded:
            if node.level:
                base = name.split(".")[: -node.level]
                if node.module:
                    yield ".".join([*base, node.module])
                else:
                    yield from (".".join([*base, alias.name]) for alias in node.names)
            elif (node.module or "").split(".")[0] == "torchrl_bayessim":
                raise AssertionError(f"{name} imports {node.module} from the package's root")


def layer(name):
    found = [i for i, members in enumerate(LAYERS) if name.split(".")[0] in members]
    assert found, f"{name} has no layer: give it one"
    return found[0]


def test_imports_point_down():
    for name, path in modules():
        for target in imports(name, path):
            assert layer(target) <= layer(name), f"{name} imports {target} from above"


def test_no_import_cycles():
    graph = {name: set(imports(name, path)) for name, path in modules()}
    done, active = set(), []

    def visit(name):
        assert name not in active, f"cycle: {' -> '.join([*active, name])}"
        if name in done:
            return
        active.append(name)
        for target in graph.get(name, ()):
            visit(target)
        done.add(active.pop())

    for name in graph:
        visit(name)


def test_public_names_exist_and_are_documented():
    assert torchrl_bayessim.__all__ == sorted(torchrl_bayessim.__all__)
    readme = (ROOT.parent / "README.md").read_text()
    for name in torchrl_bayessim.__all__:
        assert getattr(torchrl_bayessim, name).__doc__, f"{name} has no docstring"
        assert f"`{name}`" in readme or name in readme, f"{name} is not in README.md"


def test_every_module_says_what_it_exports():
    for name, path in modules():
        tree = ast.parse(path.read_text())
        exported = [
            ast.literal_eval(node.value)
            for node in tree.body
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__"
        ]
        defined = {n.name for n in tree.body if isinstance(n, ast.ClassDef | ast.FunctionDef)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                defined.add(node.id)
        assert exported, f"{name} has no __all__"
        assert set(exported[0]) <= defined, f"{name} exports {set(exported[0]) - defined}"
        assert ast.get_docstring(tree), f"{name} has no docstring"
