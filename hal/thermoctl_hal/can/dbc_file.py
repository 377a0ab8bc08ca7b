"""Read a DBC file so that only the messages that a profile names must be sound.

cantools reads the file as it is. Where it refuses, each message is read alone from its BO_, SG_,
SIG_VALTYPE_ and SG_MUL_VAL_ lines and the attribute VFrameFormat. Other lines have no effect on readings.
One warning names the parts that were mended or left out. A part that cannot be used is refused only when a
profile names it.
"""

from __future__ import annotations

import logging
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermoctl_hal.base.message import multiplexers
from thermoctl_hal.base.text_file import read_text, while_same

if TYPE_CHECKING:  # loading cantools takes a second
    from cantools.database.can import Database, Message

EXTENDED, LONGEST_11, LONGEST_29 = 0x8000_0000, 0x7FF, 0x1FFF_FFFF
NO_MESSAGE = "VECTOR__INDEPENDENT_SIG_MSG"  # pseudo-message that holds signals without a message
NO_MESSAGES = "no message (a line 'BO_ number NAME: bytes sender') is in it"
_BLOCK = re.compile(r"\s*BO_\s+(0[xX][0-9A-Fa-f]+|\d+)\s+([^\s:][^:]*?)\s*:\s*(\d+)\s*(\S*)")
_BEGINS_BLOCK = re.compile(r"\s*BO_\s")
_TEXT = re.compile(r"\s*(?:CM_|BA_\w*)\s")  # statements whose text may go on over several lines
_ENDS_TEXT = re.compile(r'"\s*;\s*$')
_SIGNAL = re.compile(
    r"\s*SG_\s+(?P<name>\S+?)\s*(?P<mux>\b[mM]\d*M?)?\s*:\s*(?P<place>\d+\s*\|\s*\d+\s*@\s*[01]\s*[+-])\s*"
    r'\((?P<scale>[^)]*)\)\s*\[[^\]]*\]\s*"(?P<unit>[^"]*)"'
)
_BEGINS_SIGNAL = re.compile(r"\s*SG_\s+([^\s:]+)")
_NAME = re.compile(r"[A-Za-z_]\w*")
_NUMBER = re.compile(r"[+-]?(?:\d+[.]?\d*|[.]\d+)(?:[eE][+-]?\d+)?")
_PLAIN = re.compile(r"\s*[+-]?\d[^,;]*,\s*[+-]?\d[^,;]*")  # a scale as the format prescribes
_TYPE = re.compile(r"\s*SIG_VALTYPE_\s+(\d+)\s+(\S+?)\s*:?\s*([0-3])\s*;")
_EXTENDED_MUX = re.compile(r"\s*SG_MUL_VAL_\s+(\d+)\s+(\S+)\s+(\S+)\s+([^;]*);")
_FORMAT = re.compile(r'\s*BA_DEF_\s+BO_\s+"VFrameFormat"|\s*BA_DEF_DEF_\s+"VFrameFormat"')
_FORMAT_OF = re.compile(r'\s*BA_\s+"VFrameFormat"\s+BO_\s+(\d+)\s+([^;]*);')
# Names of more than 32 characters: the number of the message, the signal or none, the name.
_LONG = re.compile(r'BA_\s+"System(?:Message|Signal)LongSymbol"\s+(?:BO_|SG_)\s+(\d+)\s+(\w*)\s*"([^"]+)"')
# The lines without which numbers are wrong.
_KIND = re.compile(r"\s*(?:SIG_VALTYPE_|SG_MUL_VAL_)\b", re.IGNORECASE)
_PAGE = re.compile(r"m\d")
_WORDS_OF = re.compile(r"\s*VAL_\s+(\d+)\s+(\S+)")
_WORDS = re.compile(r'\s*VAL_\s+(\d+)\s+\S+(?:\s+-?\d+\s+"(?:[^"\\]|\\.)*")*\s*;\s*')
_VALUES = re.compile(r'(?m)^[ \t]*VAL_\s+(\d+)\s+(\S+)((?:\s+-?\d+\s+"(?:[^"\\]|\\.)*")+)\s*;')
_TABLE = re.compile(r'(?m)^[ \t]*VAL_TABLE_\s+(\w+)((?:\s+-?\d+\s+"(?:[^"\\]|\\.)*")+)\s*;')
_BY_TABLE = re.compile(r"(?m)^([ \t]*VAL_\s+\d+\s+\S+)\s+([A-Za-z_]\w*)\s*;")
# Words of a signal without the semicolon at their end, which cantools passes over.
_UNENDED = re.compile(
    r'(?m)^(\s*VAL_\s+\d+\s+\S+(?:[ \t]+-?\d+[ \t]+"(?:[^"\\\n]|\\.)*")+)[ \t\r]*$(?!\s*[;\d-])'
)
_OF_A_MESSAGE = _TYPE, _EXTENDED_MUX, _FORMAT_OF, _WORDS
_J1939 = re.compile(r'^\s*BA_\s+"ProtocolType"\s+"J1939', re.MULTILINE)
_LINE = re.compile(r"at line (\d+)")


@dataclass(frozen=True)
class DbcFile:
    """Messages of a DBC file. `faults`: MESSAGE or MESSAGE.SIGNAL -> why a profile cannot use it.

    `warning`: file, line and message of the first part that was mended or left out; '' without any."""

    database: Database
    faults: Mapping[str, str] = field(default_factory=dict)
    warning: str = ""


@dataclass
class _Block:
    """A message's lines: number and text; the first one is its BO_ line."""

    lines: list[tuple[int, str]]
    number: int
    name: str
    length: str
    more: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Signal:
    """A signal's line, its name, the name under which cantools can parse it, and its canonical text."""

    line: int
    name: str
    safe: str
    text: str


@while_same
def load_dbc(path: Path) -> DbcFile:
    """Read a DBC file. Raises OSError; ValueError where no message can be read."""
    from cantools.database import load_string

    text = _with_words(_UNENDED.sub(r"\1 ;", read_text(path)))
    logging.getLogger("cantools").setLevel(logging.ERROR)  # cantools warns of names that are defined twice
    try:
        database: Any = load_string(text, database_format="dbc")
        reason = ""
    except Exception as e:  # cantools raises parse errors of several libraries
        database, reason = None, _first_line(e)
    blocks = (
        _by_message(path, text, reason)
        if database is None
        else DbcFile(database, _doubled(m for m in database.messages))
    )
    if not (blocks.database.messages or blocks.faults):
        raise ValueError(NO_MESSAGES)
    if _J1939.search(text) and "VFrameFormat" not in text:
        for message in blocks.database.messages:
            message.protocol = "j1939"
    return replace(blocks, faults={**blocks.faults, **_misread(text, blocks.database)})


def _with_words(text: str) -> str:
    """Return the file with the words of each signal in one VAL_ line, and those of its table in it.

    cantools keeps the last line of a signal, and takes no name of a table."""
    tables = dict(_TABLE.findall(text))
    text = _BY_TABLE.sub(lambda m: f"{m[1]}{tables[m[2]]} ;" if m[2] in tables else m[0], text)
    words: dict[tuple[str, str], list[str]] = defaultdict(list)
    for number, signal, more in _VALUES.findall(text):
        words[number, signal].append(more.replace("\n", " "))
    several = {key for key, lines in words.items() if len(lines) > 1}

    def whole(m: re.Match[str]) -> str:
        """Return a signal's first line with the words of all, its others empty."""
        if (m[1], m[2]) not in several:
            return m[0]
        lines = words.pop((m[1], m[2]), None)
        kept = f"VAL_ {m[1]} {m[2]}{''.join(lines)} ;" if lines else ""
        return kept + "\n" * m[0].count("\n")

    return _VALUES.sub(whole, text)


def _misread(text: str, database: Database) -> dict[str, str]:
    """Return the signals whose kind or page cantools passes over, and why.

    It does so at the end of a file that was cut off. Where several multiplexers, or none, could select a
    page, it takes the signal from every page. Signals on pages of such a multiplexer are unusable."""
    faults: dict[str, str] = {}
    for block in _blocks(text, faults)[0]:
        for line, signal in block.lines[1:]:
            match = _SIGNAL.match(signal)
            if match and _PAGE.match(match["mux"] or ""):
                why = "no multiplexer, or several, select its page: add SG_MUL_VAL_ lines"
                faults.setdefault(f"{block.name}.{match['name']}", f"line {line}: {why}")
    read = {
        f"{m.name}.{s.name}"
        for m in database.messages
        for s in m.signals
        if s.is_float or s.multiplexer_ids or s.choices
    }
    unread = {name: why for name, why in faults.items() if name not in read}
    for m in database.messages:
        for s in m.signals:
            chain = list(multiplexers(m, s.name))
            unread |= {f"{m.name}.{s.name}": unread[n] for by in chain if (n := f"{m.name}.{by}") in unread}
            if s.name in chain:
                unread[m.name] = f"{s.name} selects its own page: correct its SG_MUL_VAL_ line"
    return unread


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].removeprefix("DBC: ").strip('"')


def _doubled(messages: Iterator[Message]) -> dict[str, str]:
    """Return the names that several messages have."""
    names = defaultdict(list)
    for m in messages:
        names[m.name].append(f"0x{m.frame_id:X}")
    return {
        n: f"{len(ids)} messages have this name ({', '.join(ids)}): give each a name of its own in the DBC file"
        for n, ids in names.items()
        if len(ids) > 1
    }


def _by_message(path: Path, text: str, reason: str) -> DbcFile:
    from cantools.database.can import Database

    faults: dict[str, str] = {}
    blocks, attributes, remarks = _blocks(text, faults)
    if not blocks:
        raise ValueError(f"{NO_MESSAGES}; {reason}")
    messages: list[Message] = []
    long = [(int(number), name, new) for number, name, new in _LONG.findall(text)]
    for block in blocks:
        message = _message(block, attributes, faults, remarks)
        if message is not None:
            names = {name: new for number, name, new in long if number == block.number}
            _rename(message, names.pop("", message.name), names)
            messages.append(message)
    faults |= _doubled(iter(messages))
    if not remarks:
        remarks.append((_line_of(reason, text), f"{reason}: not needed for readings"))
    remarks.sort()
    more = f"; and {len(remarks) - 1} more" if len(remarks) > 1 else ""
    return DbcFile(Database(messages, strict=False), faults, f"{path}:{remarks[0][0]}: {remarks[0][1]}{more}")


def _line_of(reason: str, text: str) -> int:
    """Return the line that cantools means: by its number, else the last one with the word that it quotes."""
    if match := _LINE.search(reason):
        return int(match[1])
    word = re.search(r"'([^']+)'", reason)
    lines = [n for n, line in enumerate(text.split("\n"), 1) if word and word[1] in line]
    return lines[-1] if lines else 1


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines with their numbers, without those that continue a comment or an attribute's text."""
    lines = text.split("\n")
    until = 0
    for number, line in enumerate(lines, 1):
        if number <= until:
            continue
        if _TEXT.match(line) and line.count('"') % 2 and not _ENDS_TEXT.search(line):
            ends = (n for n in range(number, len(lines)) if _ENDS_TEXT.search(lines[n]))
            until = next(ends, number - 1) + 1
        yield number, line


def _blocks(text: str, faults: dict[str, str]) -> tuple[list[_Block], list[str], list[tuple[int, str]]]:
    """Return the messages' blocks, the lines that declare VFrameFormat, and remarks on the rest.

    A signal whose kind or page stands in a line that cannot be read is one of `faults`."""
    blocks: list[_Block] = []
    attributes: list[str] = []
    remarks: list[tuple[int, str]] = []
    signals: set[tuple[int, str]] = set()
    of: dict[int, list[_Block]] = defaultdict(list)
    block: _Block | None = None
    for number, line in _statements(text):
        if _BEGINS_BLOCK.match(line):
            block = _begun(number, line, remarks)
            if block is not None:
                blocks.append(block)
                of[block.number].append(block)
        elif begin := _BEGINS_SIGNAL.match(line):
            if block is not None:
                block.lines.append((number, line))
                signals.add((block.number, begin[1]))
        elif (begin := _WORDS_OF.match(line)) and (int(begin[1]), begin[2]) not in signals:
            remarks.append((number, f"VAL_ {begin[1]} {begin[2]}: there is no such signal, ignored"))
        elif _FORMAT.match(line):
            attributes.append(line.strip())
        elif match := next(filter(None, (p.match(line) for p in _OF_A_MESSAGE)), None):
            for one in of[int(match[1])] or of[int(match[1]) ^ EXTENDED]:
                one.more.append(line.strip())
        else:
            _unread(number, line, blocks, faults, remarks)
    return blocks, attributes, remarks


def _unread(
    number: int, line: str, blocks: list[_Block], faults: dict[str, str], remarks: list[tuple[int, str]]
) -> None:
    """Leave out the signals that a line names whose kind, page or words it should state.

    Words may say that a number is no reading."""
    words = set(re.findall(r"\w+", line)) if _KIND.match(line) else set()
    if of := _WORDS_OF.match(line):
        words = {of[2]}
        blocks = [b for b in blocks if b.number in (int(of[1]), int(of[1]) ^ EXTENDED)]
    for block in blocks:
        for _, text in block.lines:
            if (begin := _BEGINS_SIGNAL.match(text)) and begin[1] in words:
                why = f"{line.strip()[:60]}: no line of the format"
                _left_out(number, f"{block.name}.{begin[1]}", why, faults, remarks)


def _begun(line: int, text: str, remarks: list[tuple[int, str]]) -> _Block | None:
    """Return the message that a BO_ line begins; None where it is no message."""
    match = _BLOCK.match(text)
    if match is None:
        remarks.append((line, f"'{text.strip()[:40]}' is no message of the format, left out"))
    if match is None or match[2] == NO_MESSAGE:
        return None
    is_hexadecimal = "x" in match[1].lower()
    if is_hexadecimal:
        remarks.append((line, f"{match[2]}: identifier {match[1]} in hexadecimal"))
    number = int(match[1], 16 if is_hexadecimal else 10)
    return _Block([(line, text)], number, match[2], match[3])


def _message(
    block: _Block, attributes: list[str], faults: dict[str, str], remarks: list[tuple[int, str]]
) -> Message | None:
    """Read a message alone; add mended and ignored parts to `remarks`, unusable ones to `faults`."""
    line, number = block.lines[0][0], block.number
    if LONGEST_11 < number < EXTENDED:
        number |= EXTENDED
        remarks.append((line, f"{block.name}: identifier 0x{block.number:X} without bit 31, read as 29 bits"))
    if number & ~EXTENDED > LONGEST_29:
        _left_out(line, block.name, f"identifier 0x{number:X} has more than 29 bits", faults, remarks)
        return None
    signals = _signals(block, faults, remarks)
    safe_name = block.name if _NAME.fullmatch(block.name) else "X_"
    if safe_name != block.name:
        remarks.append((line, f"{block.name}: not a name of the DBC format"))

    def parsed(*chosen: _Signal) -> tuple[Message | None, str]:
        """Return the message with these signals, and what is wrong with it."""
        return _parsed(block, number, safe_name, chosen, attributes)

    message, why = parsed(*signals)
    if message is None:  # a signal is wrong: leave out each one that cannot be read alone
        for signal in list(signals):
            alone, fault = parsed(signal)
            if alone is None:
                _left_out(signal.line, f"{block.name}.{signal.name}", fault, faults, remarks)
                signals.remove(signal)
        message, why = parsed(*signals)
    if message is None:
        _left_out(line, block.name, why, faults, remarks)
        return None
    if why:
        remarks.append((line, f"{block.name}: {why}"))
    return message


def _left_out(line: int, name: str, why: str, faults: dict[str, str], remarks: list[tuple[int, str]]) -> None:
    """Note a message or signal that cannot be used."""
    faults[name] = f"line {line}: {why}"
    remarks.append((line, f"{name}: {why}"))


def _signals(block: _Block, faults: dict[str, str], remarks: list[tuple[int, str]]) -> list[_Signal]:
    """Return the signals of a message whose lines can be read."""
    signals: dict[str, _Signal] = {}
    for line, text in block.lines[1:]:
        match, begin = _SIGNAL.match(text), _BEGINS_SIGNAL.match(text)
        name = match["name"] if match else begin[1] if begin else text
        scale = _scale(match["scale"]) if match else ""
        if name in signals:
            _left_out(line, f"{block.name}.{name}", "a second signal of this name", faults, remarks)
        elif match is None or not scale:
            why = f"no signal of the format: {text.strip()[:60]}"
            _left_out(line, f"{block.name}.{name}", why, faults, remarks)
        else:
            safe = name if _NAME.fullmatch(name) else f"X_{len(signals)}_"
            if safe != name:
                remarks.append((line, f"{block.name}.{name}: not a name of the DBC format"))
            if not _PLAIN.fullmatch(match["scale"]):
                remarks.append(
                    (line, f"{block.name}.{name}: odd numbers ({match['scale']}), read as {scale}")
                )
            mux, place, unit = match["mux"] or "", match["place"], match["unit"]
            canonical = f' SG_ {safe} {mux} : {place} {scale} [0|0] "{unit}" Vector__XXX'
            signals[name] = _Signal(line, name, safe, canonical)
    return list(signals.values())


def _scale(text: str) -> str:
    """Return '(factor,offset)' in the format's notation; '' where it is none. Decimal commas are read."""
    parts = [p.strip() for p in re.split(r"[,;]", text)]
    if len(parts) == 4:  # a decimal comma in both numbers
        parts = [f"{parts[0]}.{parts[1]}", f"{parts[2]}.{parts[3]}"]
    elif len(parts) == 3 and not parts[0].strip("+-0"):  # a decimal comma in the factor: it is not 0
        parts = [f"{parts[0]}.{parts[1]}", parts[2]]
    if len(parts) != 2 or not all(_NUMBER.fullmatch(p) for p in parts):
        return ""
    return f"({float(parts[0])!r},{float(parts[1])!r})"


def _parsed(
    block: _Block, number: int, name: str, signals: Sequence[_Signal], attributes: list[str]
) -> tuple[Message | None, str]:
    """Return the message by cantools, and the fault that its strict mode finds; None where it reads none."""
    from cantools.database import load_string

    back = {s.name: s.safe for s in signals}
    more = [re.sub(r"^(\S+\s+(?:BO_\s+)?)\d+", rf"\g<1>{number}", m) for m in block.more if "BA_" not in m]
    more += [
        re.sub(r"BO_\s+\d+", f"BO_ {number}", m) for m in block.more if m.startswith("BA_") and attributes
    ]
    more = [" ".join(back.get(word, word) for word in m.split(" ")) for m in more]
    more = [m for m in more if m.startswith("BA_") or m.split()[2].rstrip(":") in back.values()]
    head = [f"BO_ {number} {name}: {block.length} Vector__XXX", *(s.text for s in signals), ""]
    begin = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_:", "", *head]
    text = "\n".join([*begin, *attributes, *more, ""])
    without = "\n".join([*begin, *(m for m in more if not m.startswith("BA_")), ""])  # a wrong VFrameFormat
    why = ""
    for content, strict in ((text, True), (text, False), (without, False)):
        try:
            database: Any = load_string(content, database_format="dbc", strict=strict)
        except Exception as e:  # cantools raises parse errors of several libraries
            why = why or _first_line(e)
            continue
        message: Message = database.messages[0]
        _rename(message, block.name, {s.safe: s.name for s in signals if s.safe != s.name})
        return message, why
    return None, why


def _rename(message: Message, name: str, names: Mapping[str, str]) -> None:
    """Give a message and its signals the names that they have in the file."""
    if message.name != name:
        message.name = name
    if names:
        for signal in message.signals:
            signal.name = names.get(signal.name, signal.name)
            if signal.multiplexer_signal is not None:
                signal.multiplexer_signal = names.get(signal.multiplexer_signal, signal.multiplexer_signal)
        message.refresh(strict=False)
