"""Numbers in lines of text: which base and which decimal sign, and why a line or a number was not taken.

Ambiguous text is never guessed: "+78" is 78 or, in base 16, 120; "1,5" is 1.5 or two numbers. The profile
decides. Text that does not fit the profile is reported with the received line.
"""

from __future__ import annotations

import re

BASES = (10, 16)
_SHOWN = 60  # largest number of characters of a line in a message
_NUMBER = {
    (10, "."): re.compile(r"([-+]?) *(\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?)$", re.ASCII),
    (10, ","): re.compile(r"([-+]?) *(\d+,?\d*(?:[eE][-+]?\d+)?|,\d+(?:[eE][-+]?\d+)?)$", re.ASCII),
    (16, "."): re.compile(r"([-+]?) *(?:0[xX])?([0-9A-Fa-f]{1,16})$", re.ASCII),
}
_NUMBER[16, ","] = _NUMBER[16, "."]
_GOES_ON = re.compile(r"[.,]?\d|[eE][-+]?\d", re.ASCII)  # the rest of a number that is longer than its group
_HEX = [sign + zeros + "A" for sign in ("", "+", "-", " ") for zeros in ("0" * n for n in range(16))]


def number(text: str, base: int, decimal: str) -> float | None:
    """Return the number in `text`, or None; blanks may stand around it and after its sign."""
    match = _NUMBER[base, decimal].match(text.strip())
    if match is None:
        return None
    value = float(int(match[2], 16)) if base == 16 else float(match[2].replace(",", "."))
    return -value if match[1] == "-" else value


def cut_short(line: str, match: re.Match[str], group: str) -> bool:
    """Return whether the line's number is longer than the pattern's last group."""
    return match.end(group) == match.end() and _GOES_ON.match(line, match.end()) is not None


def takes_letters(pattern: re.Pattern[str], group: str) -> bool:
    """Return whether `group` also matches the letters A to F, so that the profile must say its base."""
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
    except re.error:  # the group refers to other groups: undecidable here
        return False
    return any(alone.fullmatch(sample) for sample in _HEX)


def why_no_match(line: str, pattern: re.Pattern[str]) -> str:
    """Return one line: the received text, and why it does not match, if that can be found out."""
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
    """Return one line: the received text, and the text that is no number."""
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
    """Return a received line for a message: quoted, unprintable characters escaped, cut to 60 characters."""
    return repr(line if len(line) <= _SHOWN else line[:_SHOWN] + "...")
