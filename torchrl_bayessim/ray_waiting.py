"""Waiting for workers on Ray: no longer than they may take, and only while Ray itself lives."""

from __future__ import annotations

__all__ = ["Waiting"]

import socket
import time
from collections.abc import Sequence
from typing import Any

from .errors import SimulationError, message

_GLANCE = 1.0  # seconds between two looks at whether Ray lives
_STARTS = 2.0  # times what the first start took, that another may take


class Waiting:
    """What waits for the workers' start and answers.

    A worker begins anew before it answers, where it has died or been ended; this is not counted.

    Args:
        ray: The package, of a running cluster.
        timeout: Seconds that a worker may take to begin, and to answer; ``None``: any time.
    """

    def __init__(self, ray: Any, timeout: float | None) -> None:
        self._ray, self.timeout = ray, timeout
        self.start, self.ended = 0.0, 0
        here = ray.get_runtime_context().get_node_id()
        places = [
            (node["NodeManagerAddress"], node["NodeManagerPort"])
            for node in ray.nodes()
            if node["NodeID"] == here
        ]
        self._places = [place for place in places if _listens(place)]

    def put(self, value: Any) -> Any:
        """Return a reference to a value in Ray's store."""
        self._check_alive()
        return self._ray.put(value)

    def begun(self, workers: Sequence[Any]) -> None:
        """Wait until workers have begun.

        Raises:
            SimulationError: One has not within the timeout, or Ray has died.
        """
        since = time.monotonic()
        late = [worker.cascade_execute.remote("described") for worker in workers]
        while late:
            late = self._look(late)
            self.start = time.monotonic() - since
            if late and self.timeout is not None and self.start > self.timeout:
                for worker in workers:
                    self._ray.kill(worker)
                raise SimulationError(
                    message(
                        f"workers that begin within timeout={self.timeout:g} seconds",
                        f"{len(late)} of {len(workers)} that have not",
                        hint="a longer timeout; does make() end there, and has the cluster room?",
                    )
                )

    def answers(self, workers: dict[Any, Any]) -> list[Any]:
        """Return what workers answer, by the reference to it; Ray begins those anew that it ends.

        Raises:
            SimulationError: Ray has died.
        """
        late, since = list(workers), time.monotonic()
        while late := self._look(late):
            took = time.monotonic() - since - _STARTS * self.start
            if self.timeout is not None and took > self.timeout:
                for answer in late:
                    self._ray.kill(workers[answer], no_restart=False)
                self.ended, since = self.ended + len(late), time.monotonic()
        return self._ray.get(list(workers))

    def _look(self, late: list[Any]) -> list[Any]:
        """Return what is still not answered after a glance."""
        self._check_alive()
        return self._ray.wait(late, num_returns=len(late), timeout=_GLANCE, fetch_local=False)[1]

    def _check_alive(self) -> None:
        """Refuse to ask a store that is gone, as Ray ends this process then without a word."""
        for place in self._places:
            if not _listens(place):
                got = f"none that answers at {place[0]}:{place[1]}"
                hint = "run it again; it goes on from its checkpoint. Was the memory enough?"
                raise SimulationError(message("Ray's node manager on this machine", got, hint=hint))


def _listens(place: tuple[str, int]) -> bool:
    """Return whether somebody accepts connections there."""
    try:
        socket.create_connection(place, timeout=10.0).close()
    except OSError:
        return False
    return True
