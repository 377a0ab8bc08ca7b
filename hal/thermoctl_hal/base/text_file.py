"""Files that describe devices: parsed again only after a change, in the encodings that programs write."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from functools import lru_cache, wraps
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
KEPT = 32  # files of each kind

_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),  # before UTF-16, whose mark begins in the same way
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def while_same(read: Callable[[Path], T]) -> Callable[[Path], T]:
    """Let `read` parse a file again only where its bytes have changed; the result is shared."""

    @lru_cache(maxsize=KEPT)
    def kept(path: Path, content: bytes) -> T:
        return read(path)

    @wraps(read)
    def call(path: Path) -> T:
        try:
            content = path.read_bytes()
        except OSError:
            return read(path)  # `read` raises its own error
        return kept(path, content)

    return call


def read_text(path: Path) -> str:
    """Return a file's text: by its byte order mark, else UTF-8, UTF-16 without a mark, else cp1252.

    Lines end with \\n. Bytes that the encoding does not know become U+FFFD. Raises OSError."""
    data = path.read_bytes()
    return _decoded(data).replace("\r\n", "\n").replace("\r", "\n")


def _decoded(data: bytes) -> str:
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data.decode(encoding, "replace")
    if data[1:2] == b"\0" or data[:1] == b"\0":  # the first character is ASCII in both formats
        return data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be", "replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")
