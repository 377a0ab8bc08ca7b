"""What was compiled is what was written: no module is older than its source (`make install` builds them)."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TYPED = sorted(
    p.relative_to(ROOT).as_posix()
    for room in ("thermoctl", "hal")
    for p in (ROOT / room).rglob("*.p[xy][xd]")
)


@pytest.mark.parametrize("typed", TYPED)
def test_no_module_is_older_than_its_source(typed):
    path = ROOT / typed
    built = max((p.stat().st_mtime for p in path.parent.glob(f"{path.stem}.*.so")), default=0.0)
    for source in (path, path.with_suffix(".py")):
        assert not source.exists() or source.stat().st_mtime <= built, (
            f"{source} is newer than what was compiled: make install"
        )
