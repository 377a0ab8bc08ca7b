"""Results of earlier commands, read again: a damaged one ends a command with one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from thermoctl.files.safe_file import reason
from thermoctl.files.yamlfile import InputError


@contextmanager
def reading(path: str | Path, expected: str, remedy: str) -> Iterator[None]:
    """Raise InputError where the block cannot read `path`, or trips over content that no program wrote.

    expected: the content in words. remedy: the next step of the user."""
    try:
        yield
    except InputError:
        raise
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {reason(e)}; {expected} was expected; {remedy}") from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as e:
        raise InputError(
            f"{path}: damaged or of another version ({type(e).__name__}: {e}); {expected} was expected; {remedy}"
        ) from None
