"""Recipes from their command line, in a process of their own as users run them, or in this one."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor


def run_recipe(recipe, *arguments, folder):
    """Return the exit status, and what was printed to each stream."""
    done = subprocess.run(
        [sys.executable, str(recipe), "progress=false", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def run_here(monkeypatch, recipe, settings, *arguments):
    """Run the recipe in this process, which is spared the time that another takes to begin.

    What it would give to workers is done here too.
    """
    monkeypatch.syspath_prepend(recipe.parent)
    from importlib import import_module

    module = import_module(recipe.stem)
    monkeypatch.setattr(module, "workers", lambda *_, **__: ThreadPoolExecutor(1))
    monkeypatch.setattr(sys, "argv", [recipe.name, "progress=false", *arguments])
    import_module("recipe").main(getattr(module, settings), module.job)
