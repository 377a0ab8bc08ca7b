"""What `make docs` does to the pages before mkdocs reads them.

README.md, CONTRIBUTING.md and CHANGELOG.md of the repository become pages, a link to another file of the repository a copy of it,
and `folder/*.md` in the menu the pages of that folder that it does not name.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "CONTRIBUTING.md", "CHANGELOG.md": "CHANGELOG.md"}
LINK = re.compile(r"(!?\[[^\]]*\]\()(?!\w+:|#|/)([^)#\s]+)")
ITEM = re.compile(r"(?:[-*]|\d+\.) |\|")


def on_config(config: Any) -> Any:
    """Write the menu's patterns out."""
    docs = Path(config.docs_dir)

    def named(entries: list[Any]) -> set[str]:
        texts = [
            e if isinstance(e, str) else v
            for e in entries
            for v in ([e] if isinstance(e, str) else e.values())
        ]
        return {t for v in texts for t in (named(v) if isinstance(v, list) else {v})}

    taken = named(config.nav)

    def written_out(entries: Any) -> list[Any]:
        if isinstance(entries, str):
            entries = [entries]
        made: list[Any] = []
        for entry in entries:
            if isinstance(entry, dict):
                made.append(
                    {k: written_out(v) if isinstance(v, list) or "*" in v else v for k, v in entry.items()}
                )
            elif "*" in entry:
                made += sorted({str(p.relative_to(docs)) for p in docs.glob(entry)} - taken)
            else:
                made.append(entry)
        return made

    config.nav = written_out(config.nav)
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the repository's own pages, and the files that a page links to."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    for page in [f for f in files if f.is_documentation_page()]:
        for target in LINK.findall(page.content_string):
            outside = _outside(page, target[1])
            if outside and (ROOT / outside).is_file() and not files.get_file_from_path(outside):
                files.append(File.generated(config, outside, abs_src_path=str(ROOT / outside)))
    return files


def _source(page: Any) -> PurePosixPath:
    """Return where a page lies in the repository."""
    return PurePosixPath(Path(page.abs_src_path).relative_to(ROOT))


def _outside(page: Any, target: str) -> str | None:
    """Return the path in the repository of a link that leaves docs/ for a file that is no page."""
    path = normpath(str(_source(page).parent / target))
    return None if path.startswith("docs/") or path in PAGES else path


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links of the repository into links of the site; set lists and tables apart from the line before, as GitHub does."""

    def link(match: re.Match[str]) -> str:
        path = normpath(str(_source(page.file).parent / match[2]))
        place = PAGES.get(path, path.removeprefix("docs/"))
        return match[1] + relpath(place, str(PurePosixPath(page.file.src_uri).parent))

    lines, code = [""], False
    for line in markdown.split("\n"):
        code ^= line.lstrip().startswith("```")
        item, before = ITEM.match(line.lstrip()), lines[-1]
        if (
            not code
            and item
            and before.strip()
            and not ITEM.match(before.lstrip())
            and not before.startswith("  ")
        ):
            lines.append("")
        lines.append(line if code else LINK.sub(link, line))
    return "\n".join(lines[1:])
