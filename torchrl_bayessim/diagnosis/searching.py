"""What searches for effects that last, on logs and noise as they are prepared, or anew."""

from __future__ import annotations

__all__ = ["Searching"]

from typing import Protocol

from .preparation import Prepared
from .selection import Selection


class Searching(Protocol):
    """A search whose robot, effects and random numbers are set."""

    def __call__(
        self,
        prepared: Prepared,
        *,
        known: Selection | None = None,
        varied: bool = False,
        pairs: bool = True,
    ) -> tuple[Prepared, Selection]:
        """Return what it went by, with alarms, and what it found.

        Args:
            prepared: Logs, noise and nominal fit.
            known: What was found before, to go on from; None to begin with none.
            varied: Whether what varies counts as noise.
            pairs: Whether to look for two effects of which neither explains most alone.
        """
        ...
