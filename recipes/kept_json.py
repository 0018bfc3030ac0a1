"""JSON that a run has kept for itself, read again: a damaged file is named, with a way out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torchrl_bayessim.errors import message


def read(path: Path, expected: type, *, entries: type = object, hint: str) -> Any:
    """Return what a file holds.

    Args:
        path: The file, as the recipe has written it.
        expected: Of which type that is, ``dict`` or ``list``.
        entries: Of which type each element of a list is.
        hint: What to do where it is not so.

    Raises:
        ValueError: The file is damaged, or holds something else.
    """
    kind = {dict: "an object", list: "a list"}[expected]
    try:
        found = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:  # ValueError: no JSON, or no UTF-8
        reason = f"{path}: {error}"
    else:
        entry = found if isinstance(found, list) else []
        if isinstance(found, expected) and all(isinstance(part, entries) for part in entry):
            return found
        reason = f"{path}: {type(found).__name__}"
    raise ValueError(message(f"{kind} in JSON, as this recipe keeps it", reason, hint=hint))
