"""What every recipe shares: settings from ``key=value``, a folder, provenance, one RESULT line.

A recipe's settings are a dataclass; ``key=value`` arguments override its fields. The result is
written to ``out/result.json`` and printed as the last line. Bad input ends in one message and
exit status 2; ``debug=true`` shows the traceback instead.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import kept_json
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torchrl_bayessim.errors import BayesSimError, message
from torchrl_bayessim.whole_file import replacing, write_text, write_texts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "mujoco", "torchrl_bayessim")
SEEDS = 2**32
THREADS = 1024
MATMUL_PRECISIONS = ("highest", "high", "medium")


@dataclasses.dataclass
class Settings:
    """Fields of every recipe; those that are ``free`` may be others when a run is resumed."""

    free: ClassVar[tuple[str, ...]] = ("progress", "debug", "logger")

    seed: int = 0
    out: str = ""  # folder; outputs/NAME/TIME by default
    threads: int = 1  # of torch, for which batches are small; simulations have their own
    matmul_precision: str = "highest"  # of torch; "medium": bfloat16 products where CPUs have them
    progress: bool = True
    debug: bool = False


S = TypeVar("S", bound=Settings)


_EXPECTED = (
    ValueError,
    TypeError,
    KeyError,
    OSError,
    ImportError,
    MemoryError,
    BayesSimError,
)  # which are told in one line


def main(settings_type: type[S], job: Callable[[S, Path], dict[str, Any]]) -> None:
    """Run ``job(settings, folder)`` with the command line's settings, and report its result.

    The settings are written before the job where a run can be resumed, and with its result
    otherwise: input that is refused leaves the folder as it was. A folder that holds a run that
    can be resumed is not taken for another.
    """
    name = Path(sys.argv[0]).stem
    start = time.monotonic()
    made: list[Path] = []
    alone = False
    try:
        settings = parse(settings_type, sys.argv[1:])
        torch.set_num_threads(settings.threads)
        torch.set_float32_matmul_precision(settings.matmul_precision)
        folder = Path(settings.out or f"outputs/{name}/{datetime.now():%Y-%m-%d_%H-%M-%S}")
        made = opened(folder)
        made, alone = [*begun(settings, folder), *made], True
        result = job(settings, folder)
        result["provenance"] = provenance(settings, seconds=time.monotonic() - start)
        text = json.dumps(plain(result))
        write_texts(
            {folder / "settings.json": noted(settings), folder / "result.json": f"{text}\n"}
        )
    except _EXPECTED as error:
        leave(made, within=alone)
        if debugging(sys.argv[1:]):
            raise
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        print(f"{name}: {' '.join(str(text).split()) or type(error).__name__}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(f"{name}: stopped; resume=FOLDER goes on where a recipe has it", file=sys.stderr)
        raise SystemExit(130) from None
    print(f"RESULT {text}")


def opened(folder: Path) -> list[Path]:
    """Make a folder where there is none; return what this run made, the innermost first.

    Raises:
        ValueError: It cannot be made.
    """
    made: list[Path] = []
    try:
        for path in reversed([folder, *folder.parents]):
            try:
                if not path.exists():
                    path.mkdir()
                    made = [path, *made]
            except FileExistsError:  # another run has just made it
                pass
        folder.mkdir(exist_ok=True)  # which says so where it is a file
    except (OSError, ValueError) as error:  # ValueError: a name with NUL
        leave(made, within=False)
        reason = getattr(error, "strerror", None) or error
        got = f"{str(folder)[:200]}: {reason}"
        raise ValueError(message("out= to be a folder to write to", got)) from None
    return made


def begun(settings: Settings, folder: Path) -> list[Path]:
    """Note the settings of a run that can be resumed; return the file if it is new.

    Raises:
        ValueError: The folder holds another run that can be resumed.
    """
    path, resumable = folder / "settings.json", hasattr(settings, "resume")
    going_on = bool(getattr(settings, "resume", ""))
    try:
        if not going_on and (folder / "checkpoint.pt").exists():
            raise FileExistsError
        if resumable:
            write_text(path, noted(settings), new=not going_on)
    except FileExistsError:
        hint = f"another out=, or resume={folder} to go on with that run"
        got = str(folder)
        raise ValueError(message("out= to be a folder without a run", got, hint=hint)) from None
    return [path] if resumable and not going_on else []


def leave(made: list[Path], *, within: bool) -> None:
    """Remove what was made for a run, where the job wrote no file beside it.

    Args:
        made: Files and folders.
        within: Whether what is in the folders is this run's too.
    """
    noted = [path for path in made if path.is_file()]
    for path in noted:
        written = (file for file in path.parent.rglob("*") if file.is_file())
        if all(file == path for file in written):
            path.unlink()
    for path in made:
        folders = [inner for inner in path.rglob("*") if within and inner.is_dir()]
        for folder in [*sorted(folders, reverse=True), path]:  # innermost first; the empty ones
            with suppress(OSError):
                folder.rmdir()


def debugging(arguments: list[str]) -> bool:
    """Return whether ``debug=true``, in any of YAML's spellings, is among the arguments."""
    values = [a.partition("=")[2].lower() for a in arguments if a.partition("=")[0] == "debug"]
    return bool(values) and values[-1] in {"true", "yes", "on", "1"}


def noted(settings: Settings) -> str:
    """Return the settings as the folder of a run keeps them."""
    return json.dumps(dataclasses.asdict(settings)) + "\n"


def parse(settings_type: type[S], arguments: list[str]) -> S:
    """Return settings from ``key=value`` arguments; ``resume=FOLDER`` brings those of that run.

    Raises:
        ValueError: For an unknown key, a value of the wrong type, an argument without ``=``, a
            folder without a run to resume, or a setting that differs from that run's.
    """
    fields = [field.name for field in dataclasses.fields(settings_type)]
    for argument in arguments:
        key, equals, _ = argument.partition("=")
        if not equals:
            raise ValueError(message("arguments of the form key=value", argument))
        if key not in fields:
            raise ValueError(message("the name of a setting", key, available=fields))
    given: Any = OmegaConf.structured(settings_type)
    for argument in arguments:
        key, _, value = argument.partition("=")
        try:
            given = OmegaConf.merge(given, OmegaConf.from_cli([argument if value else f"{key}=''"]))
            getattr(given, key)  # which resolves ${...}
        except (OmegaConfBaseException, YAMLError) as error:
            reason = str(error).splitlines()[0]
            got = f"{key}={value[:80]}: {reason[:200]}"
            raise ValueError(message("values of the settings' types", got)) from None
    settings: Any = OmegaConf.to_object(given)
    if not 0 <= settings.seed < SEEDS:
        raise ValueError(message(f"a seed from 0 to {SEEDS - 1}", settings.seed))
    if not 1 <= settings.threads <= THREADS:
        raise ValueError(message(f"threads from 1 to {THREADS}", settings.threads))
    if settings.matmul_precision not in MATMUL_PRECISIONS:
        expected, given = "a matmul_precision of torch", settings.matmul_precision
        raise ValueError(message(expected, given, available=MATMUL_PRECISIONS))
    keys = [argument.partition("=")[0] for argument in arguments]
    return resumed(settings, keys) if getattr(settings, "resume", "") else settings


def resumed(settings: S, given: list[str]) -> S:
    """Return the settings of the run to resume, and ``given`` ones where they may differ."""
    folder: str = settings.resume  # pyright: ignore[reportAttributeAccessIssue]
    path = Path(folder, "settings.json")
    if not path.exists():
        raise ValueError(message("the folder of a run to resume", folder, hint="the out= of a run"))
    earlier = _earlier(path, type(settings)) | {"resume": folder, "out": folder}
    for key in given:
        value = getattr(settings, key)
        if key in settings.free:
            earlier[key] = value
        elif value != earlier[key]:
            raise ValueError(message(f"{key}={earlier[key]}, as in the run to resume", value))
    return dataclasses.replace(settings, **earlier)


def _earlier(path: Path, settings_type: type[Settings]) -> dict[str, Any]:
    """Return the settings that a run has noted, all of them and of their types."""
    fields = {field.name for field in dataclasses.fields(settings_type)}
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict) or found.keys() != fields:
            raise ValueError
        typed: Any = OmegaConf.to_object(
            OmegaConf.merge(OmegaConf.structured(settings_type), OmegaConf.create(found))
        )
    except (ValueError, OmegaConfBaseException):
        expected, hint = f"the settings of a {settings_type.__name__} run", "begin the run anew"
        raise ValueError(message(expected, f"another {path}", hint=hint)) from None
    return dataclasses.asdict(typed)


def provenance(settings: Settings, *, seconds: float) -> dict[str, Any]:
    """Return what is needed to run this again and to judge its timing."""
    root = Path(__file__).parent
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "commit": git.stdout.strip() or None,
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "seed": settings.seed,
        "command": "python " + " ".join(sys.argv),
        "machine": {
            "system": platform.platform(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "matmul_precision": torch.get_float32_matmul_precision(),
        },
        "seconds": round(seconds, 2),
    }


def save_picture(figure: Figure, path: Path, *, dpi: int = 150) -> None:
    """Write a figure as PNG, wholly or not at all."""
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=dpi)


def kept(path: Path, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what a part of a run gave: from its file, or from ``work()``, which is then kept."""
    if not path.exists():
        write_text(path, json.dumps(plain(work())))
    return kept_json.read(path, dict, hint="delete the file, and the part is done again")


def plain(value: Any) -> Any:
    """Return what JSON can hold."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, torch.Tensor):
        return plain(value.tolist())
    if isinstance(value, float):  # JSON has neither NaN nor infinity
        return value if abs(value) < float("inf") else None
    return str(value) if isinstance(value, Path) else value
