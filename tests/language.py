"""Docstrings and comments of the product: draw a sample for a reader, and count mechanical faults.

`python -m tests.language --seed 22 --number 60` prints a sample with file and line and marks the faults.
`--count` prints the faults by package, `--all` every faulty text. tests/test_language.py compares the
counts with LIMITS.
"""

from __future__ import annotations

import argparse
import io
import random
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MAX_WORDS, MAX_COLUMNS = 25, 110
INSTEAD = {  # word or phrase: the field's word
    r"explanations?": "hypothesis, fitted hypothesis, effect",
    r"finalists?": "shortlist",
    r"compet(?:e|es|ed|ing)": "refit the shortlist",
    r"(?:what|it) (?:remains|leaves)|leaves nothing": "residual structure, the residual (is white)",
    r"likeness|alike|its like": "equivalent, indistinguishable",
    r"foretold|foretells?": "projection on the predicted difference",
    r"colours? (?:of|is|was|has)|noise's colours?": "noise model, noise spectrum",
    r"heard|believed|surprise": "with measured noise, prior, negative log prior",
    r"occam|pays?|paid": "complexity penalty, log evidence",
    r"sponge": "free input",
    r"haste|patience": "computing budget",
    r"told|said|says so": "reported, result",
    r"begun|beginnings": "started, starting points",
    r"what moves": "mechanical plant, moving axis",
    r"judged?|judges": "validate, check, score",
    r"the house": "packages, modules",
    r"comes? out as|holds? against|held against": "say it directly: is, compared with",
}
_WORDS = re.compile(r"\b(?:" + "|".join(f"({p})" for p in INSTEAD) + r")\b", re.IGNORECASE)
_HEADLESS = re.compile(r"(?:of|between) ")  # the start of a comment that does not name its quantity
_SUBJECT = re.compile(r"(?:^|[.:;,] +)(?:what|whatever|that which) (?!if\b)", re.IGNORECASE)
_DIRECTIVE = re.compile(r"#\s*(?:noqa|type:|cython:|distutils:|pragma|ruff:|fmt:|!|-{3,})")
_AFTER = (tokenize.NEWLINE, tokenize.COMMENT)  # what follows a string that is a statement by itself
_SKIPPED = (tokenize.NL, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING)


@dataclass(frozen=True)
class Text:
    """A docstring or a block of comments, and the line where it starts."""

    path: Path
    line: int
    text: str
    columns: int  # of its longest line in the source

    @property
    def where(self) -> str:
        return f"{self.path.relative_to(ROOT)}:{self.line}"

    @property
    def package(self) -> str:
        parts = self.path.relative_to(ROOT).with_suffix("").parts
        return (
            ".".join(parts[1:-1])
            if parts[0] == "hal"
            else ".".join(parts[:2])
            if len(parts) > 2
            else parts[0]
        )

    def sentences(self) -> list[str]:
        """Return the sentences of its prose, without equations, which stand indented."""
        prose = [
            line.strip() if len(line) - len(line.lstrip()) < 4 else "" for line in self.text.splitlines()
        ]
        paragraphs = re.split(r"\n\s*\n|\n(?=- )", "\n".join(prose))
        flat = (re.sub(r"\s+", " ", p).strip() for p in paragraphs)
        return [s for p in flat for s in re.split(r"(?<=[.?!])\s+", p) if s]

    def faults(self) -> list[str]:
        """Return one line for each mechanical fault."""
        found = []
        for s in self.sentences():
            count = sum(any(c.isalpha() for c in w) for w in s.split())
            if count > MAX_WORDS:
                found.append(f"{count} words in one sentence")
            for m in _WORDS.finditer(re.sub(r"`[^`]*`", "", s)):
                found.append(f"'{m[0]}': {list(INSTEAD.values())[(m.lastindex or 1) - 1]}")
            if _SUBJECT.search(s) and not s.endswith("?"):
                found.append("'what ...' as a noun: name the thing")
        if self.path.suffix == ".py" and _HEADLESS.match(self.text.strip()):
            found.append("starts with 'of' or 'between': name the quantity first")
        if self.columns > MAX_COLUMNS:
            found.append(f"{self.columns} columns")
        return found


def texts(path: Path) -> Iterator[Text]:
    """Yield the docstrings and the blocks of comments of a Python or Cython source."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    last = tokenize.NEWLINE
    block: list[tokenize.TokenInfo] = []
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))

    def made(line: int, text: str, end: int) -> Text:
        return Text(path, line, text, max(len(x) for x in lines[line - 1 : end]))

    def comments() -> Iterator[Text]:
        if block:
            text = "\n".join(t.string.lstrip("#:").removeprefix(" ") for t in block)
            yield made(block[0].start[0], text, block[-1].start[0])
            block.clear()

    for i, t in enumerate(tokens):
        if t.type == tokenize.COMMENT:
            if _DIRECTIVE.match(t.string):
                continue
            apart = block and (
                t.start != (block[-1].start[0] + 1, block[-1].start[1]) or t.line.split("#")[0].strip()
            )
            if apart:
                yield from comments()
            block.append(t)
        elif t.type == tokenize.STRING and last == tokenize.NEWLINE and tokens[i + 1].type in _AFTER:
            if t.string.strip('"').lstrip().startswith("/*"):
                continue  # C for Cython
            yield from comments()
            text = t.string.strip("rRbBfF").strip("\"'").replace("\n" + " " * t.start[1], "\n")
            yield made(t.start[0], text, t.end[0])
        if t.type not in _SKIPPED:
            last = t.type
    yield from comments()


def product() -> list[Text]:
    """Return all texts of thermoctl and hal in order."""
    paths = sorted(p for top in ("thermoctl", "hal") for p in (ROOT / top).rglob("*.p[yx]*"))
    return [t for p in paths if p.suffix in (".py", ".pyx", ".pxd") for t in texts(p) if t.text.strip()]


def counts() -> Counter[str]:
    """Return the number of mechanical faults by package."""
    return Counter(t.package for t in product() for _ in t.faults())


def main() -> None:
    """Print a sample, or the counts."""
    parser = argparse.ArgumentParser(prog="python -m tests.language", description=__doc__)
    parser.add_argument("--seed", type=int, default=22)
    parser.add_argument("--number", type=int, default=60)
    parser.add_argument("--count", action="store_true", help="print the faults by package")
    parser.add_argument("--all", action="store_true", help="print every faulty text instead of a sample")
    args = parser.parse_args()
    if args.count:
        for package, number in sorted(counts().items()):
            print(f'    "{package}": {number},')
        return
    known = product()
    if args.all:
        sample = [t for t in known if t.faults()]
    else:
        drawn = random.Random(args.seed).sample(range(len(known)), min(args.number, len(known)))
        sample = [known[i] for i in sorted(drawn)]
    for t in sample:
        print(t.where)
        code = t.path.read_text(encoding="utf-8").splitlines()[t.line - 1].split("#")[0].strip()
        if code and '"""' not in code:
            print(f"    [{code}]")
        print("    " + "\n    ".join(t.text.strip().splitlines()))
        for fault in t.faults():
            print(f"  !! {fault}")
    faulty = sum(bool(t.faults()) for t in sample)
    print(f"\n{len(sample)} of {len(known)} texts, {faulty} with a mechanical fault")


if __name__ == "__main__":
    main()
