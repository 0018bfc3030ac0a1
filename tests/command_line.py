"""Recipes from their command line, each in a process of its own, as users run them."""

import os
import subprocess
import sys


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
