"""One finding of the checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a plant or a recording, and what to do about it.

    `kind`: one word for programs; `where`: plant file or recording. `severe`: a diagnosis of these data would
    name the mistake as physics."""

    kind: str
    where: str
    what: str
    suggestion: str
    severe: bool = True

    def __str__(self) -> str:
        return f"{'severe' if self.severe else 'warning'}: {self.where}: {self.what}. {self.suggestion}"
