"""Open a file of any format as sheets of cells: its format by its first bytes, a text by its dialect."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from thermoctl.files.yamlfile import InputError
from thermoctl.recording import files
from thermoctl.recording.foreign import cells, clock, formats, layouts
from thermoctl.recording.foreign.axis import COUNTER_NOTE
from thermoctl.recording.foreign.dialect import (
    FACT,
    Dialect,
    cells_of,
    decoded,
    find_dialect,
    is_comment,
    lines,
    shown,
)
from thermoctl.recording.foreign.facts import stated_step
from thermoctl.recording.foreign.hdf import read_hdf
from thermoctl.recording.foreign.sheet import Cells, How, Sheet, place_in
from thermoctl.recording.foreign.timing import table_of
from thermoctl.recording.foreign.units import split_words

HEAD = 65536  # number of first bytes that show whether this program wrote the file
MAGIC = (
    (b"MDF     ", "mdf"),
    (b"UnFinMF ", "mdf"),
    (b"TDSm", "tdms"),
    (b"PK\x03\x04", "excel"),
    (b"PAR1", "parquet"),
    (b"ARROW1", "arrow"),
    (b"\x89HDF", "hdf"),
    (b"MATLAB ", "mat"),
    (b"\xd0\xcf\x11\xe0", "xls"),
    (b"\x1f\x8b", "gzip"),
    (b"LOGG", "frames"),
)
# Files that are no tables, by their first bytes, and what to do with them.
_NO_TABLES = (
    (b"SQLite format 3", "an SQLite database; export its table as CSV"),
    (b"\x93NUMPY", "an array of NumPy, which has no names; save it with names as .mat or .csv"),
    (b"\x80\x04\x95", "a pickle of Python; save the table as Parquet or CSV"),
    (b"\x80\x05\x95", "a pickle of Python; save the table as Parquet or CSV"),
    (b"\xfd7zXZ", "an xz archive; unpack it"),
    (b"BZh", "a bzip2 archive; unpack it"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive; unpack it"),
    (b"7z\xbc\xaf", "a 7z archive; unpack it"),
    (b"Rar!", "a RAR archive; unpack it"),
    (b"FEA1", "Feather 1; save it as Feather 2, or as Parquet"),
    (b"\x89MCAP", "MCAP; export its messages as CSV"),
    (b"#ROSBAG", "a bag of ROS; export its topics as CSV"),
    (b'"TOB', "binary data of Campbell; convert it to TOA5 with LoggerNet or CardConvert"),
    (b"%PDF", "a PDF; export the table as CSV or .xlsx"),
    (b"version https://git-lfs", "a pointer of Git LFS in place of the file; `git lfs pull` brings it"),
    (b"<?xml", "XML; export the table as CSV (of an RRD: `rrdtool fetch FILE AVERAGE`)"),
    (b"IGOR", "waves of Igor; save them as a table with names"),
    (b"<!doctype html", "a web page; save its table as CSV"),
    (b"<html", "a web page; save its table as CSV"),
)
# Logs of CAN frames: Vector's .asc, PEAK's .trc, BUSMASTER's, SavvyCAN's, candump's.
_FRAMES = re.compile(
    rb"(?mi)^(base (hex|dec) +timestamps|;\$FILEVERSION=|\*{3}BUSMASTER|Time Stamp,ID,Extended,|"
    rb"\s*(\([-\d.: ]+\)\s+\S+|[vxsl]*can\d+)\s+[0-9A-F]{3,8}(#|\s+\[\d+\]))"
)
_QUOTED = re.compile(rb'^"([^"\n]*[,;\t][^"\n]*[,;\t][^"\n]*)"\r?$', re.MULTILINE)  # a row that is one cell
# A cell of several lines, as the header of a table that was made in Excel has them.
_BROKEN = re.compile(rb'(?m)(?:^|(?<=[,;\t]))"[^",;\t]*\n[^",;\t]*"(?=[,;\t\r\n])')
# The header of a segment of LVM, with the line of names below it.
_SEGMENT = re.compile(rb"(?ms)^Channels\t.*?^\*{3}End_of_Header\*{3}[^\n]*\n[^\n]*\n")
_ARTISAN = {"Time1", "Time2", "ET", "BT"}  # a coffee roaster's log: minutes and seconds
SHOWN = 8192  # number of last bytes that show the digits of the last column
FEW = 6  # least number of lines that show them
_STAMPED = re.compile(rb"(?m)^(\d\d:\d\d:\d\d\.\d{3}) -> ")  # Arduino's monitor before each line
# The header of Ignition's datasets: names, types, number of rows.
_DATASET = re.compile(rb'\A"#NAMES"\r?\n(.*\n)"#TYPES".*\n.*\n"#ROWS".*\n')
_FETCHED = re.compile(rb"(?m)^(\d{9,10}):(?=[ \t])")  # the times of rrdtool fetch
_SUFFIXES = {".mf4": "mdf", ".mdf": "mdf", ".tdms": "tdms", ".xlsx": "excel", ".xlsm": "excel"}
_SUFFIXES |= {
    ".parquet": "parquet",
    ".mat": "mat",
    **dict.fromkeys((".arrow", ".arrows", ".feather"), "arrow"),
}


def kind_of(path: Path) -> str:
    """Return the format by the first bytes, of an empty or damaged file by its suffix."""
    with open(path, "rb") as f:
        head = f.read(8)
    suffix = path.suffix.lower()
    if suffix in _SUFFIXES and (not head or suffix in (".arrow", ".arrows", ".feather")):
        return _SUFFIXES[suffix]
    found = next((kind for magic, kind in MAGIC if head.startswith(magic)), None)
    if found == "hdf" and suffix == ".mat":
        return "mat"
    return found or _SUFFIXES.get(suffix, "text")


def sheets_of(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    """Read a file's sheets by its format."""
    kind = kind_of(path)
    how.trace.append(f"format: {kind}")
    if how.sheet is not None and kind not in ("hdf", "tdms", "mat", "excel"):
        notes.append(f"--sheet {how.sheet} has no effect: {kind} has no sheets")
    if kind in _READERS:
        return [_of_names(s) for s in _READERS[kind](path, how, notes)]
    if kind == "frames":
        raise formats.frames(path)
    if kind == "xls":
        raise InputError(
            f"{path}: an Excel file of before 2007, or with a password; save it as .xlsx or .csv"
        )
    if (size := path.stat().st_size) > files.MAX_CSV_BYTES:
        raise InputError(
            f"{path}: {size} bytes; a text file of at most {files.MAX_CSV_BYTES} was expected (cut it in parts)"
        )
    data = path.read_bytes()
    if kind == "gzip":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError) as e:
            raise InputError(f"{path}: not a whole gzip file: {e}") from None
    start = data[:64].removeprefix(b"\xef\xbb\xbf").lstrip()
    if (what := next((w for m, w in _NO_TABLES if start.lower().startswith(m.lower())), None)) is not None:
        raise InputError(f"{path}: {what}")
    text, said = decoded(path, data)
    notes += said
    return _text(path, text, how, notes)


def _of_names(sheet: Sheet) -> Sheet:
    """Return a sheet with the units that its columns' names state, such as 'P (mW)', as those of a text."""
    split = {n: split_words(n) for n in sheet.columns}
    plain = [name for name, _ in split.values()]
    names = {
        n: name if unit and n not in sheet.units and plain.count(name) == 1 else n
        for n, (name, unit) in split.items()
    }
    units = sheet.units | {names[n]: unit for n, (_, unit) in split.items() if unit and names[n] != n}
    return replace(sheet, columns={names[n]: c for n, c in sheet.columns.items()}, units=units)


def _of_arrow(path: Path, arrow: pa.Table) -> list[Sheet]:
    sheet = formats.read_arrow(path, arrow)
    return layouts.pivoted(sheet) or [sheet]


def _arrow(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    try:
        table = files.read_table(path)
    except InputError:  # another program's
        return _of_arrow(path, files.arrow_of(path))
    return [Sheet({"t": table.t, **table.columns}, place_in(path), meta=table.meta)]


def _excel(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    """Return the named sheet of an Excel file, else the first table with times, else with a counter."""
    pages = formats.read_excel(path, how.sheet)
    first: InputError | None = None
    found: list[tuple[bool, str, list[Sheet], list[str], list[str]]] = []
    for title, text in pages:
        try:
            here: list[str] = []
            tried = replace(how, trace=[])
            sheets = _text(path, text, tried, here)
            table = table_of(path, sheets, replace(how, trace=[]), list(here))
        except InputError as e:
            first = first or e
            continue
        counted = any(COUNTER_NOTE in n for n in table.notes)
        found.append((counted, title, sheets, here, tried.trace))
        if not counted:
            break
    if not found:
        raise first or InputError(f"{path}: no rows; at least one sample was expected")
    _, title, sheets, here, trace = min(found, key=lambda f: f[0])
    how.trace.extend(trace)
    if len(pages) > 1:
        notes.append(f"sheet '{title}' read, of {', '.join(t for t, _ in pages)} (another: --sheet NAME)")
    notes += here
    return sheets


def _parquet(path: Path, how: How, notes: list[str]) -> list[Sheet]:
    with pa.parquet.ParquetFile(path, page_checksum_verification=True) as f:
        return _of_arrow(path, f.read())


_READERS: dict[str, Callable[[Path, How, list[str]], list[Sheet]]] = {
    "hdf": lambda path, how, notes: read_hdf(path, notes, how.sheet),
    "mdf": lambda path, how, notes: formats.read_mdf(path, notes),
    "tdms": lambda path, how, notes: formats.read_tdms(path, notes, how.sheet),
    "mat": lambda path, how, notes: formats.read_mat(path, notes, how.sheet),
    "parquet": _parquet,
    "arrow": _arrow,
    "excel": _excel,
}


def _text(path: Path, text: bytes, how: How, notes: list[str]) -> list[Sheet]:
    """Read a text as sheets: a table of rows, or a layout of its own."""
    if b"\0" in text:
        raise InputError(f"{path}: holds zero bytes; text was expected (was the file cut off?)")
    if _FRAMES.search(text[:HEAD]):
        raise formats.frames(path)
    if (special := layouts.special(path, text)) is not None:
        return [p for s in special for p in layouts.pivoted(s) or [s]]
    text = _DATASET.sub(rb"\n\n\n\n\1", text)
    text = _one_header(_with_whole_cells(_fetched(text)), notes)
    if 2 * len(_QUOTED.findall(text[:HEAD])) > text[:HEAD].count(b"\n"):
        text = _QUOTED.sub(rb"\1", text)
        notes.append("whole lines stand in quotes; read without them")
    if 2 * len(_STAMPED.findall(text[:HEAD])) > text[:HEAD].count(b"\n"):
        separator = next((s for s in (b"\t", b";", b",") if s in text[:HEAD]), b" ")
        text = re.sub(_STAMPED.pattern + rb"(?=[^\W\d])", b"time" + separator, text, count=1)  # the header
        text = _STAMPED.sub(lambda m: m[1] + separator, text)
    text, depth = _innermost(text)
    if depth:
        notes.append(f"the rows of the innermost of {depth + 1} nested tables read")
    dialect = find_dialect(path, text[: 4 * HEAD].decode("utf-8", errors="ignore"), text)
    if len(dialect.names) == 1:
        text = _with_empty_lines(text, dialect, notes)
    text = _without_cut(text, dialect, notes)
    how.trace.append(f"read as: text, separator {shown(dialect.separator)}, data from line {dialect.first}")
    notes += dialect.notes

    def closely() -> list[Sheet]:
        """Read the rows cell by cell."""
        return _stated(_slow(path, text, dialect), dialect)

    sheet = _fast(path, text, dialect, how)
    if sheet is None:
        return closely()
    stated = _stated(sheet, dialect)
    stated[0].again = closely  # reading cell by cell gives an error with the line
    return stated


def _fetched(text: bytes) -> bytes:
    """Return what rrdtool fetch wrote with a name of its times, and without the colon behind each."""
    if not _FETCHED.search(text[:HEAD]):
        return text
    return re.sub(rb"\A\s*(?=[^\W\d])", b"time ", _FETCHED.sub(rb"\1", text))


def _with_whole_cells(text: bytes) -> bytes:
    """Return a text whose first cells have one line each; empty lines before it keep the numbers of lines."""
    head = _BROKEN.sub(lambda m: re.sub(rb"\s*\n\s*", b" ", m[0]), text[:HEAD])
    return b"\n" * (text[:HEAD].count(b"\n") - head.count(b"\n")) + head + text[HEAD:]


def _one_header(text: bytes, notes: list[str]) -> bytes:
    """Return an LVM text of several segments with the first header alone, without its interval."""
    if not text.startswith(b"LabVIEW") or len(found := _SEGMENT.findall(text)) < 2:
        return text
    notes.append(f"{len(found)} segments, each with a header: read as one table")
    head, body = text.split(found[0], 1)
    body = _SEGMENT.sub(lambda m: b"\n" * m[0].count(b"\n"), body)
    return head + re.sub(rb"(?m)^(?:X0|Delta_X)\t.*$", b"", found[0]) + body


def _without_cut(text: bytes, dialect: Dialect, notes: list[str]) -> bytes:
    """Return the text without a last line that has no end, and fewer last digits than all others.

    A logger that lost power wrote `206.5` as `20`, and `"206.5"` as `"20`."""
    if text.endswith(b"\n"):
        return text
    shown = _body(text, dialect)[-SHOWN:].decode("utf-8", errors="ignore").splitlines()[1:]
    shown = [line for line in shown if line.strip()]
    last = [cells_of(line, dialect.separator)[-1] for line in shown]
    digits = [len(re.sub(r"^[^.,]*[.,]?", "", c)) for c in last]
    if not any(digits):  # whole numbers
        digits = list(map(len, last))
    if [line.count('"') % 2 for line in shown] == [0] * (len(shown) - 1) + [1]:
        said = "with an open quote"
    elif (
        len(set(digits[:-1])) != 1
        or len(last) < FEW
        or not digits[-1] < digits[0]
        or cells.is_missing(last[-1])
    ):
        return text
    else:
        said = "without the digits of the others"
    notes.append(f"the last line ends in '{last[-1]}', {said}: left out (was the file cut off?)")
    return text[: text.rfind(b"\n") + 1]


def _innermost(text: bytes) -> tuple[bytes, int]:
    """Return the rows of the innermost of nested tables (Neware), and how deep they are.

    They begin with most separators. The text begins with the headers and first rows of all tables."""
    shown = [re.match(rb"[,;\t]*", line)[0] for line in text[:HEAD].splitlines()[:8]]  # type: ignore[index]
    for depth in (2, 1):
        levels = [len(s) for s in shown[: 2 * depth + 2]]
        if levels == 2 * [*range(depth + 1)]:
            begin = re.escape(shown[depth])
            other = rb"(?m)^(?!" + begin + rb"[^,;\t\r\n]).*$"
            return re.sub(rb"(?m)^" + begin, b"", re.sub(other, b"", text)), depth
    return text, 0


def _with_empty_lines(text: bytes, dialect: Dialect, notes: list[str]) -> bytes:
    """Return the text of one column with "nan" in its empty lines, so that later rows keep their times."""
    body = _body(text, dialect)
    rows = re.sub(rb"(?<=\n)\r?(?=\n)", b"nan", body.strip())
    if not 0 < 2 * rows.count(b"nan\n") < rows.count(b"\n"):  # none, or each line ends twice
        return text
    notes.append("empty lines between the rows read as no value")
    return text.removesuffix(body) + rows + b"\n"


def _stated(sheet: Sheet, dialect: Dialect) -> list[Sheet]:
    """Return a sheet with the units and the interval of its dialect; of a long table one a signal."""
    sheet.units = dict(dialect.units)
    if set(dialect.names) >= _ARTISAN:
        sheet.units["Time1"] = "mm:ss"
    if list(dialect.names[:2]) == ["timestamp", "timestamp_sample"]:  # ulog2csv of PX4
        sheet.units |= dict.fromkeys(dialect.names[:2], "us")
    sheet.columns = {n: c for n, c in sheet.columns.items() if not FACT.match(n)}
    sheet.decimal = dialect.decimal or ("," if dialect.separator == ";" else None)
    if (stated := stated_step(dialect.facts)) is not None:
        sheet.step_s, sheet.offset_s = stated
    return layouts.pivoted(sheet) or [sheet]


def _fast(path: Path, text: bytes, dialect: Dialect, how: How) -> Sheet | None:
    """Read by Arrow: plain numbers as floats, other columns as texts; None where that cannot be right."""
    decimal = how.decimal or dialect.decimal
    if decimal is None or dialect.separator in (" ", "  ") or "" in dialect.names:
        return None
    body = _body(text, dialect)
    if b"\n#" in body or b"\n%" in body or body[:1] in b"#%":
        body = b"\n".join(x for x in body.splitlines() if not is_comment(x.decode("utf-8")))
    names, empty = list(dialect.names), ["", "NaN", "nan", "NAN", "NA", "null"]
    types = {n: pa.float64() if n in dialect.numeric else pa.string() for n in names}
    named = pa.csv.ReadOptions(column_names=names)
    parse = pa.csv.ParseOptions(delimiter=dialect.separator, ignore_empty_lines=True)
    convert = pa.csv.ConvertOptions(column_types=types, null_values=empty, decimal_point=decimal)
    try:
        arrow = pa.csv.read_csv(pa.BufferReader(body), named, parse, convert)
    except pa.ArrowInvalid:
        return None
    if len(arrow) * len(names) > files.MAX_CELLS:
        raise InputError(
            f"{path}: {len(arrow)} rows; at most {files.MAX_CELLS} cells are read at once: cut it"
        )
    columns = {n: _plain_column(arrow[n]) for n in names}
    return Sheet(columns, lambda row: f"{path}:{_line(text, dialect, row)}")


def _plain_column(column: pa.ChunkedArray) -> Cells:
    if pa.types.is_floating(column.type):
        return files.to_numpy(column)
    return column.combine_chunks()


def _body(text: bytes, dialect: Dialect) -> bytes:
    position = 0
    for _ in range(dialect.first - 1):
        position = text.find(b"\n", position) + 1
        if position == 0:
            return b""
    body = text[position:]
    return body if position < len(text) else b""


def _line(text: bytes, dialect: Dialect, row: int) -> int:
    """Return the line of data row `row`."""
    numbers = (n for n, _ in lines(text.decode("utf-8")) if n >= dialect.first)
    return next((n for i, n in enumerate(numbers) if i == row), dialect.first + row)


def _slow(path: Path, text: bytes, dialect: Dialect) -> Sheet:
    """Read row by row: repeated headers and a cut last line are left out with a note. Raises InputError."""
    width = len(dialect.names)
    headers = (list(dialect.header), [c for c in dialect.header if c])
    rows: list[tuple[int, list[str]]] = []
    odd: list[tuple[int, list[str]]] = []
    again: list[int] = []
    notes: list[str] = []
    for line, content in lines(text.decode("utf-8")):
        cells = cells_of(content, dialect.separator) if line >= dialect.first else []
        cells = cells[:-1] if len(cells) == width + 1 and not cells[-1] else cells
        cells = cells[:width] if line == dialect.longer else cells
        if cells and (cells in headers or (again and again[-1] == line - 1 and not _any_value(cells))):
            again.append(line)
        elif any(cells):
            (rows if len(cells) == width else odd).append((line, cells))
    while len(rows) > 1 and _is_footer(rows[-1][1], rows[0][1]):
        odd.append(rows.pop())
    if not rows:
        raise InputError(f"{path}: no rows; at least one sample was expected")
    if odd and min(odd)[0] < rows[-1][0]:
        line, cells = min(odd)
        raise InputError(
            f"{path}:{line}: {len(cells)} cells; {width} as in the header were expected "
            "(quote a cell that holds the separator; delete a line that is no row)"
        )
    if odd:
        notes.append(
            f"line{'s' if len(odd) > 1 else ''} {', '.join(str(n) for n, _ in odd[:3])} at the end left out: "
            f"{len(odd[0][1])} cells of {width}, or words only (was the file cut off?)"
        )
    if again:
        notes.append(f"the header stands again in line {', '.join(map(str, again[:5]))}; left out")
    numbers = [n for n, _ in rows]
    columns = {n: pa.array([r[i] for _, r in rows], pa.string()) for i, n in enumerate(dialect.names)}
    return Sheet(dict(columns), lambda row: f"{path}:{numbers[min(row, len(numbers) - 1)]}", notes=notes)


def _is_footer(row: Sequence[str], first: Sequence[str]) -> bool:
    """Return whether a row holds words only, or begins with one where the first row has a number or time."""
    if _any_value(first) and not _any_value(row):
        return any(not cells.is_missing(c) for c in row)
    return _any_value(first[:1]) and not _any_value(row[:1]) and not cells.is_missing(row[0])


def _any_value(row: Sequence[str]) -> bool:
    """Return whether a cell is a number or a time."""
    return any(cells.is_number(c) or clock.is_time(c) for c in row)
