"""HTML that cannot be injected into: text is escaped unless it was made here.

`element` escapes every child that is not `Markup`, and every attribute. So names of files and
joints, whatever they hold, reach the page as text.
"""

from __future__ import annotations

__all__ = ["Markup", "element", "joined", "table"]

from collections.abc import Iterable, Sequence
from html import escape

_VOID = frozenset({"br", "col", "meta"})


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return an element.

    Args:
        name: Its tag.
        *children: `Markup` as it is, everything else as text; ``None`` is left out.
        **attributes: ``class_`` stands for ``class``, ``stroke_width`` for ``stroke-width``;
            ``None`` is left out.

    Example:
        >>> element("p", "a < b", element("br"), class_="note")
        '<p class="note">a &lt; b<br></p>'
    """
    text = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{text}>")
    return Markup(f"<{name}{text}>{joined(children)}</{name}>")


def joined(children: Iterable[object]) -> Markup:
    """Return children one after the other, text escaped."""
    shown = (child for child in children if child is not None)
    return Markup("".join(c if isinstance(c, Markup) else escape(str(c)) for c in shown))


def table(
    caption: str, head: Sequence[str], rows: Sequence[Sequence[object]], *, shown: int = 12
) -> Markup:
    """Return a table whose first column names the rows; those after ``shown`` are folded.

    Args:
        caption: What it holds.
        head: Names of the columns.
        rows: Cells, as many as ``head``; numbers as text.
        shown: Rows that stand open.
    """
    first = _table(caption, head, rows[:shown])
    if len(rows) <= shown:
        return first
    rest = _table(f"{caption}, continued", head, rows[shown:])
    return joined(
        [first, element("details", element("summary", f"{len(rows) - shown} more"), rest)]
    )


def _table(caption: str, head: Sequence[str], rows: Sequence[Sequence[object]]) -> Markup:
    header = element("tr", *(element("th", name, scope="col") for name in head))
    body = [
        element(
            "tr",
            element("th", row[0], scope="row"),
            *(element("td", cell) for cell in row[1:]),
        )
        for row in rows
    ]
    inner = element(
        "table",
        element("caption", caption),
        element("thead", header),
        element("tbody", *body),
    )
    return element("div", inner, class_="scroll", tabindex=0, role="region", aria_label=caption)
