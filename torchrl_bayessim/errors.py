"""One wording for every error: expected X (why), got Y, available Z, try W."""

from __future__ import annotations

__all__ = ["BayesSimError", "PhysicsError", "SimulationError", "message", "printable"]

import difflib
from collections.abc import Iterable


class BayesSimError(Exception):
    """Base of the errors that only this package raises."""


class PhysicsError(BayesSimError):
    """A parameter did not reach the simulator, or the simulator does not have it."""


class SimulationError(BayesSimError):
    """Simulations diverged, or none of them can be used."""


def printable(text: str) -> str:
    """Return a text without what would move a terminal's cursor or turn its direction."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def message(expected: str, got: object, *, available: Iterable[object] = (), hint: str = "") -> str:
    """Return the one-line message ``expected …, got …. Available: …. Try: …``.

    With ``available`` names and a string ``got``, the nearest names are put first.

    Example:
        >>> message("a body name", "tosro", available=["foot", "torso"])
        "expected a body name, got 'tosro'. Available: torso (did you mean this?), foot."
        >>> message("low < high for every bound", "low=2.0, high=1.0", hint="swap them")
        "expected low < high for every bound, got 'low=2.0, high=1.0'. Try: swap them."
    """
    text = f"expected {expected}, got {got!r}."
    names = [printable(str(name)) for name in available]
    if names:
        near = difflib.get_close_matches(str(got), names, n=3, cutoff=0.6)
        rest = [name for name in names if name not in near]
        shown = [f"{name} (did you mean this?)" for name in near] + rest[: 20 - len(near)]
        more = f", and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
        text += f" Available: {', '.join(shown)}{more}."
    return f"{text} Try: {hint}." if hint else text
