"""YAML as a description needs it: mappings, lists and text, nothing that runs or hides.

Every scalar stays text, so that ``1e-3`` is a number where one is expected and a column may be
called ``on``. Repeated keys, aliases and language tags are errors.
"""

from __future__ import annotations

__all__ = ["Description", "read_description"]

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from ..errors import message


class _Loader(yaml.SafeLoader):
    """Knows text, lists and mappings only."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 (as the base class has it)
    _nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._nodes += 1
        if self._nodes > _MOST:
            raise yaml.YAMLError(f"more than {_MOST} keys and values")
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name)")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:  # noqa: FBT001, FBT002
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.YAMLError("a key that is no text")
            if key.value in seen:
                raise yaml.YAMLError(f"the key {key.value!r} twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


_Loader.yaml_constructors = {  # of SafeLoader's, without its numbers, dates, sets and bytes
    tag: make
    for tag, make in yaml.SafeLoader.yaml_constructors.items()
    if tag in {None, *(f"tag:yaml.org,2002:{name}" for name in ("str", "seq", "map"))}
}
_LARGEST = 100_000  # bytes
_MOST = 5_000  # keys and values


def read_description(path: Path) -> Description:
    """Return a YAML file's contents.

    Raises:
        ValueError: There is no such file, or it is not plain YAML in UTF-8 of at most 100 kB and
            5,000 keys and values.
    """
    try:
        if path.exists() and not path.is_file():  # a pipe or a device has no end
            raise ValueError(message("a file to read", f"{path}, which is none"))
        if path.exists() and path.stat().st_size > _LARGEST:
            got = f"{path.stat().st_size} bytes"
            raise ValueError(message(f"at most 100 kB of YAML in {path.name}", got))
        value = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except OSError as error:
        raise ValueError(
            message("a file to read", f"{str(path)[:200]}: {error.strerror}")
        ) from None
    except UnicodeDecodeError:
        raise ValueError(message("YAML in UTF-8", str(path))) from None
    except (yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200] or "too deep a nesting"
        raise ValueError(message(f"plain YAML in {path.name}", reason)) from None
    return Description(value, path.name)


class Description:
    """A mapping whose every access says what was expected.

    Example:
        >>> bounds = Description({"mass": ["0.3", "1.2"]}, "prior")
        >>> bounds.numbers("mass", 2)
        (0.3, 1.2)

    Args:
        value: A mapping; empty text stands for an empty one.
        place: What messages call it.
    """

    def __init__(self, value: object, place: str) -> None:
        value = {} if value in ("", None) else value
        if not isinstance(value, Mapping):
            expected = f"a mapping (key: value) in {place}"
            raise ValueError(message(expected, _short(value)))  # noqa: TRY004 (the file's value)
        self._value, self._place = value, place

    def __iter__(self) -> Any:
        return iter(self._value)

    def __contains__(self, key: str) -> bool:
        return key in self._value

    def only(self, *keys: str) -> Description:
        """Return itself if there are no other keys; otherwise raise a ValueError."""
        for key in self._value:
            if key not in keys:
                raise ValueError(message(f"a key of {self._place}", key, available=keys))
        return self

    def inner(self, key: str) -> Description:
        """Return the mapping under a key, empty where the key is not there."""
        place = f"{self._place}: {key}"
        if self._value.get(key) in ("", None) and key in self._value:
            raise ValueError(message(f"something in {place}", "nothing", hint="leave out the key"))
        return Description(self._value.get(key), place)

    def is_mapping(self, key: str) -> bool:
        """Return whether there is a mapping under a key."""
        return isinstance(self._value.get(key), Mapping)

    def text(self, key: str) -> str:
        """Return the text under a key."""
        value = self._value.get(key)
        if not isinstance(value, str) or not value:
            raise ValueError(message(f"text under {key!r} in {self._place}", _short(value)))
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts; a single one counts as a list."""
        value = self._value.get(key)
        values = [value] if isinstance(value, str) and value else value
        texts = isinstance(values, list) and all(isinstance(v, str) and v for v in values)
        if not texts or not values:
            raise ValueError(message(f"names under {key!r} in {self._place}", _short(value)))
        return tuple(values)

    def number(self, key: str) -> float:
        """Return the number under a key."""
        return _number(self._value.get(key), f"{key!r} in {self._place}")

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return a list of ``count`` numbers."""
        value = self._value.get(key)
        if not isinstance(value, list) or len(value) != count:
            expected = f"{count} numbers under {key!r} in {self._place}"
            raise ValueError(message(expected, _short(value)))
        return tuple(_number(v, f"{key!r} in {self._place}") for v in value)


def _number(value: object, place: str) -> float:
    text = str(value)
    try:
        if text.isascii() and "_" not in text:  # Python takes 1_000 and digits of any script
            return float(text)
    except ValueError:
        pass
    raise ValueError(message(f"a number under {place}", _short(value)))


def _short(value: object) -> object:
    text = repr(value)
    return value if len(text) < 80 else f"{text[:80]}…"
