"""The files of an MJCF model stay inside one folder, and ask for no more than a machine has.

MuJoCo opens whatever a model names, copies parts as often as it says, and allocates what it asks
for; a model that is its own part ends the process. A model from elsewhere is therefore followed
through its includes and parts before MuJoCo sees it.
"""

from __future__ import annotations

__all__ = ["check_model_files", "inside"]

from collections.abc import Iterator
from math import isfinite, prod
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..errors import message

_FOLDERS = ("meshdir", "texturedir", "assetdir")
_MOST_ELEMENTS, _MOST_KEYS = 10_000, 10_000  # which take MuJoCo 10 s and 1 s to compile
_MOST_VALUES = 100_000_000  # of a picture or a height field
_MOST_SIZE = 1_000_000  # of an attribute of <size>
_MOST_MEMORY = 4 << 30  # bytes of <size memory>
_MOST_PARAMS = 200  # of a mesh that MuJoCo makes, in vertices along a side
_UNITS = {"K": 10, "M": 20, "G": 30, "T": 40, "P": 50, "E": 60}


def check_model_files(folder: Path, path: Path) -> None:
    """Check a model and everything that it refers to.

    Args:
        folder: What no file may leave, resolved.
        path: The model's file inside it, resolved.

    Raises:
        ValueError: A file is outside of the folder, is no regular file or no XML, declares a
            document type, or is its own part, or the model asks for too much.
    """
    _elements(folder, path, within=(path,), known={})


def _elements(folder: Path, path: Path, *, within: tuple[Path, ...], known: dict[Path, int]) -> int:
    """Check a model; return how many elements it has with all copies."""
    if path in known:
        return known[path]
    roots = _included(folder, path)
    dirs = _dirs(roots)
    largest = 1  # of the models that are parts of this one
    values = 0.0  # of pictures and height fields
    for element in (element for root in roots.values() for element in root.iter()):
        values += _check_amount(element, path.name)
        _limit(values, _MOST_VALUES, "a number of values", path.name)
        for file in _named(folder, element, dirs):
            if element.tag == "model":
                if file in within:
                    raise ValueError(message("a model that is no part of itself", file.name))
                inner = _elements(folder, file, within=(*within, file), known=known)
                largest = max(largest, inner)
            elif element.tag == "texture":
                _check_picture(file)
    known[path] = _copied(roots, path, largest)
    return known[path]


def _included(folder: Path, path: Path) -> dict[Path, Element]:
    """Return the roots of a model's files, by their paths: its own, and what it includes."""
    roots: dict[Path, Element] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file in roots:
            raise ValueError(message("each file to be included once", file.name))
        roots[file] = _root(file)
        for element in roots[file].iter("include"):
            waiting += _named(folder, element, {path.parent, file.parent})
    return roots


def _root(path: Path) -> Element:
    try:
        return ElementTree.parse(path, ElementTree.XMLParser(target=_Builder())).getroot()
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(message(f"XML in {path.name}", str(error))) from None
    except (ValueError, OSError) as error:
        reason = str(error) if isinstance(error, ValueError) else error.strerror
        raise ValueError(message(f"plain XML in {path.name}", reason)) from None


class _Builder(ElementTree.TreeBuilder):
    def doctype(self, *_: object) -> None:  # entities, which MuJoCo does not have
        raise ValueError("a document type")

    def start_ns(self, *_: object) -> None:  # MuJoCo reads on as if the names were its own
        raise ValueError("a namespace")


def _dirs(roots: dict[Path, Element]) -> set[Path]:
    """Return where a model's files may be looked for."""
    given = [
        element.get(key, "")
        for root in roots.values()
        for element in root.iter("compiler")
        for key in _FOLDERS
    ]
    for name in given:
        _require_plain(name)
    return {path.parent / name for path in roots for name in ("", *given)}


def _require_plain(name: str) -> None:
    """Raise a ValueError for a backslash: a letter here, and the way to a folder for MuJoCo."""
    if "\\" in name:
        raise ValueError(message("names of files with / between folders", name[:80]))


def _named(folder: Path, element: Element, dirs: set[Path]) -> Iterator[Path]:
    """Yield the files that an element names, and that exist."""
    names = [value for key, value in element.attrib.items() if key.startswith("file") and value]
    if element.tag == "config" and {"/", "\\"} & set(element.get("value", "")):  # of a plugin
        names.append(element.get("value", ""))
    for name in names:
        _require_plain(name)
        for path in sorted({inside(folder, place / name, name) for place in dirs}):
            if path.is_file():
                yield path
            elif path.exists():
                raise ValueError(message("a file that exists", f"{name}, which is none"))


def inside(folder: Path, path: Path, shown: str) -> Path:
    """Return a path without links; raise a ValueError if it is outside of a folder."""
    try:
        resolved = path.resolve()
        within = resolved.is_relative_to(folder)
        resolved.exists()
    except (OSError, ValueError, RuntimeError) as error:  # too long, NUL, links in a circle
        raise ValueError(message("a file's name", f"{shown[:80]}: {error.args[-1]}")) from None
    if not within:
        raise ValueError(message("files inside the folder of system.yaml", shown))
    return resolved


def _check_amount(element: Element, file: str) -> float:
    """Return how many values a picture or a height field holds.

    Raises:
        ValueError: The element asks for more than any model needs, or holds no number.
    """
    for key, value in element.attrib.items():
        if "nan" in value.lower().split() and key != "name":
            raise ValueError(message(f"numbers in {file}", f'{key}="{value}"'))
    values = 0.0
    for pair in ("nrow", "ncol"), ("width", "height"):
        own = prod(_numbers(element.get(key, "1")) for key in pair)
        _limit(own, _MOST_VALUES, pair[0], file)
        values += own if pair[0] in element.attrib else 0.0
    for key in ("dim", "actdim"):
        _limit(_numbers(element.get(key, "1")), _MOST_SIZE, key, file)
    for word in element.get("params", "").split():
        _limit(_numbers(word), _MOST_PARAMS, "params", file)
    for key, value in element.attrib.items() if element.tag == "size" else ():
        unit = _UNITS.get(value.strip()[-1:].upper(), 0) if key == "memory" else 0
        amount = _numbers(value.strip()[:-1] if unit else value) * 2**unit
        most = {"memory": _MOST_MEMORY, "nkey": _MOST_KEYS}.get(key, _MOST_SIZE)
        _limit(amount, most, key, file)
    return values


def _check_picture(path: Path) -> None:
    """Raise a ValueError if a PNG file's header says that it is huge."""
    with path.open("rb") as file:
        header = file.read(24)
    if header[12:16] == b"IHDR" and len(header) == 24:
        width, height = (int.from_bytes(header[i : i + 4], "big") for i in (16, 20))
        _limit(width * height, _MOST_VALUES, "width", path.name)


def _limit(amount: float, most: float, name: str, file: str) -> None:
    if amount > most:
        raise ValueError(message(f"{name} of at most {most:g} in {file}", f"{amount:.6g}"))


def _numbers(text: str) -> float:
    """Return the product of a text's numbers; what is none is left to MuJoCo to refuse."""
    try:
        product = prod(float(word) for word in text.split())
    except ValueError:
        return 1.0
    return product if isfinite(product) else float("inf")


def _copied(roots: dict[Path, Element], path: Path, largest: int) -> int:
    """Return the number of elements after replication and attachment, or raise a ValueError."""
    total, waiting = 0.0, [(roots[path], 1.0)]
    while waiting:
        element, times = waiting.pop()
        count = _numbers(element.get("count", "1"))
        inner = times * max(1.0, count) if element.tag == "replicate" else times
        waiting += [(child, inner) for child in element]
        if element.tag == "include":
            places = {path.parent, *(file.parent for file in roots)}
            files = {(place / element.get("file", "")).resolve() for place in places}
            waiting += [(roots[file], times) for file in files if file in roots]
        own = count if element.tag in {"replicate", "composite", "flexcomp"} else 1.0
        total += times * max(own, largest if element.tag == "attach" else 1)
        _limit(total, _MOST_ELEMENTS, "a number of elements", path.name)
    return int(total)
