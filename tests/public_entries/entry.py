"""What an entry of the table says."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Entry:
    """A public callable.

    Attributes:
        call: Takes the arguments by name; what is lazy is run to its first result.
        good: Makes arguments that work, anew for each call.
        kinds: The kind of each argument, as in `wrong_values`; others may be anything at all.
        carried: Whether its argument reaches it in a TensorDict, which refuses other kinds itself.
    """

    call: Callable[..., Any]
    good: Callable[[], dict[str, Any]]
    kinds: Mapping[str, str] = field(default_factory=dict)
    carried: bool = False
