"""Numbers in lines of text: which base and which decimal sign, and why a line or a number was not taken.

Text that another reading would also fit is not guessed: "+78" is 78 or 120, "1,5" is 1.5 or two numbers. The profile says
which, and what does not fit it is reported with the line that was received.
"""

from __future__ import annotations

import re

BASES = (10, 16)
DECIMALS = (".", ",")
_SHOWN = 60  # characters of a line in a message
_NUMBER = {
    (10, "."): re.compile(r"([-+]?) *(\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?)$", re.ASCII),
    (10, ","): re.compile(r"([-+]?) *(\d+,?\d*(?:[eE][-+]?\d+)?|,\d+(?:[eE][-+]?\d+)?)$", re.ASCII),
    (16, "."): re.compile(r"([-+]?) *(?:0[xX])?([0-9A-Fa-f]{1,16})$", re.ASCII),
}
_NUMBER[16, ","] = _NUMBER[16, "."]
_GOES_ON = re.compile(r"[.,]?\d|[eE][-+]?\d", re.ASCII)  # the number in the line is longer than its group
_HEX = [sign + zeros + "A" for sign in ("", "+", "-", " ") for zeros in ("0" * n for n in range(16))]


def number(text: str, base: int, decimal: str) -> float | None:
    """The number in `text`, blanks allowed around it and after its sign; None when it is none."""
    found = _NUMBER[base, decimal].match(text.strip())
    if found is None:
        return None
    value = float(int(found[2], 16)) if base == 16 else float(found[2].replace(",", "."))
    return -value if found[1] == "-" else value


def cut_short(line: str, match: re.Match[str], group: str) -> bool:
    """True when the line's number goes on where the pattern's last group ends: its first digits alone would be wrong."""
    return match.end(group) == match.end() and _GOES_ON.match(line, match.end()) is not None


def takes_letters(pattern: re.Pattern[str], group: str) -> bool:
    """True when `group` also matches numbers with the letters A to F, so that its base must be said."""
    start = pattern.pattern.index(f"(?P<{group}>")
    at, depth, in_class = start, 0, False
    text = pattern.pattern
    while at < len(text):
        c = text[at]
        if c == "\\":
            at += 1
        elif in_class:
            in_class = c != "]"
        elif c == "[":
            in_class = True
            at += text[at + 1 : at + 2] == "]" or 2 * (text[at + 1 : at + 3] == "^]")
        elif c in "()":
            depth += 1 if c == "(" else -1
            if depth == 0:
                break
        at += 1
    try:
        alone = re.compile(text[start : at + 1], re.ASCII)
    except re.error:  # it refers to other groups: nothing can be said
        return False
    return any(alone.fullmatch(sample) for sample in _HEX)


def why_no_match(line: str, pattern: re.Pattern[str]) -> str:
    """One line: what was received, and why it did not match as far as that can be said."""
    if "," in line and pattern.match(line.replace(",", ".")):
        hint = "it would match with a decimal point: let the group take ',' and say decimal: ',' in 'text'"
    elif pattern.match(re.sub(r"([-+]) +(?=[\d.,])", r"\1", line)):
        hint = "blanks stand between sign and digits: let the group take them, as in [-+] *[0-9.]+"
    elif pattern.match(line.strip()):
        hint = "it would match without the blanks around it"
    elif pattern.search(line):
        hint = "the pattern fits further right in the line: a pattern starts at its first character"
    else:
        hint = f"the pattern is {pattern.pattern}"
    return f"received {shown(line)}, which does not match: {hint}"


def why_no_number(text: str, line: str, base: int, decimal: str) -> str:
    """One line: what stood where a number was expected."""
    kind = "hexadecimal" if base == 16 else f"decimal (sign of decimals '{decimal}')"
    other = [
        f"{key}: {value}"
        for b, d, key, value in (
            (16, decimal, "base", "16"),
            (10, "," if decimal == "." else ".", "decimal", ""),
        )
        if (b, d) != (base, decimal) and number(text, b, d) is not None
        for value in (value or f"'{d}'",)
    ]
    hint = f": say {' or '.join(other)}" if other else ""
    return f"received {shown(line)}: {shown(text)} is no {kind} number{hint}"


def shown(line: str) -> str:
    """A received line for a message: quoted, unprintable characters escaped, cut."""
    return repr(line if len(line) <= _SHOWN else line[:_SHOWN] + "...")
