"""Logs whose text is spoilt: cut off, in other encodings or shapes, with words for numbers."""

import gzip
import io
import zipfile

from case import ROWS, Case, put, rows, text

HEADER = "t,q,qd,tau"
LINES = [",".join(map(str, row)) for row in rows(2)]
LOG = "\r\n".join([HEADER, *LINES, ""])


def cell_start(row, cell):
    """Return where a cell of a row begins in the text."""
    begin = len(HEADER) + 2 + sum(len(line) + 2 for line in LINES[:row])
    return begin + sum(len(value) + 1 for value in LINES[row].split(",")[:cell])


def cut_off():
    """Cut a log at many bytes."""
    yield Case(name="cut to nothing", spoil=put(""), said="a header and rows in run2.csv")
    for count in 1, 5, 9:
        said = "a header and rows in run2.csv"
        yield Case(name=f"cut after byte {count}", spoil=put(LOG[:count]), said=said)
    for row in 0, 1, 40, 77, 120, ROWS - 1:
        for cell in 0, 1, 2:
            cut = LOG[: cell_start(row, cell) + 1]
            said = f"4 cells in row {row} of run2.csv"
            yield Case(name=f"cut in row {row} cell {cell}", spoil=put(cut), said=said)
    for row, more in (60, 0), (100, 1), (100, 4), (140, 8):  # a number of which a part is left
        cut = LOG[: cell_start(row, 3) + more]
        name = f"cut in row {row} after {more} of the last cell"
        said = f"a number in row {row}, column 'tau' of run2.csv, got '"
        yield Case(name=name, spoil=put(cut), said=said)
    for row in 3, 8:
        cut = LOG[: cell_start(row, 0)]
        name = f"cut after row {row - 1}"
        yield Case(name=name, spoil=put(cut), found=("run2.csv short",))


def encodings():
    for encoding in "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be":
        said = "UTF-8" if encoding in {"utf-16", "utf-32"} else "run2.csv"
        yield Case(name=encoding, spoil=put(LOG.encode(encoding)), said=said)
    greek = LOG.replace("tau", "τau").encode("iso8859-7")
    yield Case(name="iso8859-7", spoil=put(greek), said="UTF-8")
    degree = LOG.replace("q,", "q,°", 1).encode("latin-1")
    yield Case(name="latin-1", spoil=put(degree), said="UTF-8")
    yield Case(name="a byte of no text", spoil=put(LOG[:99].encode() + b"\xff"), said="UTF-8")
    yield Case(name="EBCDIC", spoil=put(LOG.encode("cp037")), said="run2.csv")
    yield Case(name="two byte order marks", spoil=put(b"\xef\xbb\xbf" * 2 + LOG.encode()), said="t")
    yield Case(name="gzip", spoil=put(gzip.compress(LOG.encode())), said="UTF-8")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("run2.csv", LOG)
    yield Case(name="zip", spoil=put(packed.getvalue()), said="run2.csv")
    yield Case(name="only NUL", spoil=put(b"\0" * 4096), said="run2.csv")
    yield Case(name="NUL at the end", spoil=put(LOG.encode() + b"\0" * 512), said="4 cells in row")
    for cell in range(4):
        place = cell_start(50, cell) + 2
        spoilt = LOG[:place] + "\0" + LOG[place:]
        name, said = f"NUL in cell {cell}", "a number in row 50"
        yield Case(name=name, spoil=put(spoilt), said=said)
    yield Case(name="NUL in the header", spoil=put(LOG.replace("qd", "q\0d", 1)), said="'qd'")


def shapes():
    """Spoil headers, columns, cells and delimiters."""
    for name in "t", "q", "qd", "tau":
        said = f"a column of run2.csv, got {name!r}"
        change = text(lambda log, name=name: _without(log, HEADER.split(",").index(name)))
        yield Case(name=f"no column {name}", spoil=change, said=said)
    for first, second in ("q", "qd"), ("t", "q"), ("tau", "t"):
        header = HEADER.split(",")
        header[header.index(first)] = second
        change = text(lambda log, header=header: log.replace(HEADER, ",".join(header), 1))
        said = f"each column once in run2.csv, got {second!r}"
        yield Case(name=f"column {second} twice", spoil=change, said=said)
    for name, mark in ("semicolons", ";"), ("tabs", "\t"), ("bars", "|"), ("spaces", " "):
        said = "commas"
        change = text(lambda log, mark=mark: log.replace(",", mark))
        yield Case(name=name, spoil=change, said=said)
    changes = {
        "decimal commas": (lambda log: log.replace(".", ","), "4 cells in row 0 of run2.csv"),
        "quoted decimal commas": (_decimal_commas, "a number in row 0"),
        "no header": (lambda log: log.replace(f"{HEADER}\r\n", "", 1), "a column of run2.csv"),
        "a second header": (lambda log: log + log, f"a number in row {ROWS}"),
        "a title": (lambda log: f"run of Monday\r\n{log}", "a column of run2.csv"),
        "a comment": (lambda log: f"# {log}", "a column of run2.csv"),
        "a row of units": (
            lambda log: log.replace(HEADER, f"{HEADER}\r\ns,rad,rad/s,N m", 1),
            "a number in row 0, column 't' of run2.csv, got 's'",
        ),
        "a comma at the end": (
            lambda log: log.replace("\r\n", ",\r\n").replace("tau,", "tau", 1),
            "4 cells in row 0 of run2.csv",
        ),
        "a comma in one row": (lambda log: _in_row(log, 30, ",7"), "4 cells in row 30 of run2.csv"),
        "an open quote": (lambda log: _in_row(log, 30, '\r\n"'), "4 cells in row 31 of run2.csv"),
        "a blank line of spaces": (lambda log: _in_row(log, 9, "\r\n  "), "4 cells in row 10"),
        "upper case": (lambda log: log.replace(HEADER, HEADER.upper(), 1), "a column of run2.csv"),
    }
    for name, (change, said) in changes.items():
        yield Case(name=name, spoil=text(change), said=said)
    yield Case(name="header only", spoil=put(f"{HEADER}\n"), said="a header and rows in run2.csv")
    yield Case(name="line ends only", spoil=put("\n" * 50), said="a header and rows in run2.csv")
    yield Case(name="a page of a server", spoil=put("<html><p>404\n</html>\n"), said="run2.csv")
    yield Case(name="an endless cell", spoil=put(HEADER + "\n0," + "1" * 200_000), said="run2.csv")
    yield Case(name="an endless line", spoil=put(HEADER + "\n" + "0," * 900_000), said="run2.csv")


def words():
    """Put what is no number into a cell of one log."""
    cells = ("zero", "N/A", "null", "None", "0x1F", "1_000", "--", "1.2.3", "12:00:01", "1e",
             "true", "5 rad", "=A1+1", "1.0f", "1d0", "٣", "#REF!", "2024-01-01T00:00")  # fmt: skip
    for i, cell in enumerate(cells):
        column = i % 4
        said = f"a number in row 33, column {HEADER.split(',')[column]!r} of run2.csv, got {cell!r}"
        change = text(lambda log, cell=cell, column=column: _replaced(log, cell, column))
        yield Case(name=f"the word {cell}", spoil=change, said=said)


def _without(log, column):
    kept = [line.split(",") for line in log.splitlines()]
    return "\n".join(",".join(c for i, c in enumerate(row) if i != column) for row in kept) + "\n"


def _decimal_commas(log):
    header, *lines = log.splitlines()
    quoted = [",".join(f'"{c.replace(".", ",")}"' for c in line.split(",")) for line in lines]
    return "\n".join([header, *quoted, ""])


def _in_row(log, row, more):
    lines = log.split("\r\n")
    lines[1 + row] += more
    return "\r\n".join(lines)


def _replaced(log, cell, column):
    lines = log.split("\r\n")
    cells = lines[34].split(",")
    cells[column] = cell
    lines[34] = ",".join(cells)
    return "\r\n".join(lines)


CASES = [*cut_off(), *encodings(), *shapes(), *words()]
