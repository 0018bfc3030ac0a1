"""What losses are looked for beside, and what is found beside them: of commands or of samples."""

from __future__ import annotations

__all__ = ["CERTAIN", "Beside", "Sought"]

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .as_recorded import Sent
from .chance import Chance
from .loss_suspects import Suspects
from .preparation import Prepared
from .searching import Searching
from .selection import Selection

CERTAIN = 40.0  # deviance by which both together have to explain more than either


@dataclass(frozen=True, eq=False)
class Sought:
    """What was found before effects are looked for where what was lost is known.

    Attributes:
        prepared: Logs as they were recorded, with the commands that were sent.
        selection: The effects that last, found with those.
        found: What was found of losses, beside them or in their place.
        suspects: Short segments in which something may have been lost.
        search: Searches for effects that last.
        generator: Of simulated noise.
    """

    prepared: Prepared
    selection: Selection
    found: Sequence[Chance]
    suspects: Suspects
    search: Searching
    generator: np.random.Generator


@dataclass(frozen=True, eq=False)
class Beside:
    """What was found on the commands that arrived, or on samples that were not lost.

    Attributes:
        sent: The runs that were looked at, with the commands that were sent, or as recorded.
        prepared: With those that arrived, or with others in the place of those that were lost.
        selection: The effects that last; none where losses are all there is.
        chance: The losses.
    """

    sent: Prepared
    prepared: Prepared
    selection: Selection
    chance: Chance

    def told(self) -> tuple[Prepared, Selection, list[Chance], Sent]:
        """Return what a report is made of, with an alarm that says on what it was found."""
        sent = Sent.along(self.prepared, self.sent, self.selection)
        return self.prepared.alarmed(sent.note), self.selection, [self.chance], sent
