"""Logs as a diagnosis should get them: read, checked, and refused where they are malformed."""

from __future__ import annotations

__all__ = ["checked_logs"]

from collections.abc import Sequence

from ..counts import check_count
from ..errors import message
from ..kinds import check_choice, check_kind
from .log import Log
from .read import Source, read_records
from .record import Record
from .sanity import Finding, check, refuse_spoilt, usable_logs
from .system import System

_SHORTEST = 10  # control steps that a log must have where no horizon is given


def checked_logs(
    source: Source,
    system: System,
    *,
    leave_out: Sequence[str] = (),
    horizon: int | None = None,
    spoilt: str = "refuse",
) -> tuple[list[Log], list[Finding]]:
    """Return the logs that can be used, and what is odd about them.

    Args:
        source: As for `read_logs`.
        system: The robot.
        leave_out: Parts of names of logs to leave out.
        horizon: Control steps that a log must have at least; default 10.
        spoilt: ``refuse`` malformed logs, or ``leave_out`` the rows that are named.

    Raises:
        TypeError: The source or the system is of another kind.
        ValueError: Logs are malformed, in one message that names them all; nothing is left of them;
            no log's name has a part to leave out; or as `read_logs`.
        ImportError: The format needs a package that is not installed.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
        >>> env = BatchedMujocoEnv("InvertedPendulum-v5", 3, seed=0)
        >>> seen = env.rollout(20, policy=lambda td: td.set("action", env.action_spec.zero()))
        >>> qpos, qvel = seen["observation"].chunk(2, -1)
        >>> columns = {"qpos": qpos, "qvel": qvel, "action": seen["action"]}
        >>> logs, findings = checked_logs(
        ...     TensorDict(columns, batch_size=seen.batch_size), System(task=env.task)
        ... )
        >>> len(logs), [finding.kind for finding in findings]
        (3, ['constant_action'])
    """
    check_choice("spoilt", spoilt, ("refuse", "leave_out"))
    check_kind("parts of logs' names to leave out", leave_out, list, tuple)
    if horizon is not None:
        check_count("horizon", horizon)
    records = _kept(read_records(source, system), leave_out)
    findings = check(records, system, horizon=horizon or _SHORTEST)
    if spoilt == "refuse":
        refuse_spoilt(findings)
    return usable_logs(records, system, findings), findings


def _kept(records: list[Record], leave_out: Sequence[str]) -> list[Record]:
    """Return the records whose names contain none of the words."""
    names = [record.name for record in records]
    for word in leave_out:
        check_kind("a part of a log's name to leave out", word, str)
        records = [record for record in records if word.strip() not in record.name]
        if not any(word.strip() in name for name in names):
            raise ValueError(message("a part of a log's name to leave out", word, available=names))
    if not records:
        raise ValueError(message("logs beside those left out", "none", available=names))
    return records
