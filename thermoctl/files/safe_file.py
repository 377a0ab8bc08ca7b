"""Write files so that a full or failing disk, kill -9 or a power cut never costs an existing file.

Every writer of the product uses these functions. The new content goes into a hidden temporary file in the
same folder and is synced. Then it is renamed, and the folder is synced: at every moment the old or the new
file is there, whole. A temporary file that a killed program left is removed by the next writer of that name.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from thermoctl.files.yamlfile import InputError

SUFFIX = ".part"
STALE_S = 60.0  # a younger temporary file may belong to a program that has not locked it yet
MAX_SOCKET = 107
"""Largest number of bytes of the path of a Unix socket (sun_path of unix(7) without its end)."""
_IN_THE_WAY = "a file stands where a folder belongs: move it, or give another path"
_REMEDIES = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space of the user's quota",
    errno.EIO: "the disk may be failing: look at `dmesg`",
    errno.EROFS: "the file system is read-only: mount it for writing, or give another path",
    errno.EACCES: "give the user the right to write there, or give another path",
    errno.EPERM: "give the user the right to write there, or give another path",
    errno.ENOTDIR: _IN_THE_WAY,
    errno.EEXIST: _IN_THE_WAY,
    errno.EISDIR: "a folder has this name: give another path",
    errno.ENOENT: "make the folder first, or give another path",
    errno.EFBIG: "`ulimit -f` or the file system allows no larger file: give another path",
    errno.ENAMETOOLONG: "give a shorter path",
}


class WriteError(InputError):
    """A file that could not be written; `why`: its path and the system's reason."""

    def __init__(self, path: str | Path, error: OSError, remedy: str):
        self.why = f"{path}: {reason(error)}; {remedy_of(error)}"
        kept = "; it is as it was before" if os.path.isfile(path) else ""
        super().__init__(f"{path}: cannot be written: {reason(error)}{kept}{'; ' if remedy else ''}{remedy}")


@contextlib.contextmanager
def whole_file(path: str | Path, remedy: str = "", sync: bool = True) -> Iterator[str]:
    """Write a file: the block fills the yielded temporary file, which then becomes `path`.

    Mode and owner of an existing file are kept, and a link stays a link. A device or a pipe, such as
    /dev/stdout, is written directly. `remedy`: advice for the message of an error. `sync`: False for a file
    that is worthless after a power cut; nothing waits for the disk then. Raises WriteError; an existing file
    is then unchanged."""
    with _reported(path, remedy):
        if _is_device(path):
            yield str(path)
            return
        target = Path(os.path.realpath(path))
        fd, part = part_file(target)
        try:
            yield str(part)
            if sync:
                os.fsync(fd)
            os.replace(part, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(part)
            raise
        finally:
            with contextlib.suppress(OSError):  # the content is synced already
                os.close(fd)
        if sync:
            sync_folder(target.parent)


@contextlib.contextmanager
def whole_files(folder: str | Path, remove: Iterable[str] = ()) -> Iterator[Path]:
    """Write the files of one result: the block fills the yielded folder, which then goes to `folder`.

    All files appear, or none. A new folder is renamed at once. In an existing one each file replaces its
    forerunner, and those named in `remove` are deleted; an error on the way restores everything. Only kill -9
    between two renames can leave a mixture, of whole files. Raises WriteError."""
    folder = Path(os.path.realpath(folder))
    with _reported(folder, ""):
        new = not folder.exists()
        folder.parent.mkdir(parents=True, exist_ok=True)
        place = folder.parent if new else folder
        _remove_stale(place, folder.name)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name[:200]}.", suffix=SUFFIX, dir=place))
        lock = os.open(work, os.O_RDONLY)
        try:
            _lock(lock)
            os.chmod(work, 0o777 & ~_umask())
            try:
                yield work
            except InputError as e:  # names the user's folder, not the temporary one
                raise InputError(str(e).replace(str(work), str(folder))) from None
            _sync_tree(work)
            if new:
                os.rename(work, folder)
                sync_folder(place)
            else:
                _move_all(work, folder, remove)
        finally:
            with contextlib.suppress(OSError):
                os.close(lock)
            shutil.rmtree(work, ignore_errors=True)


def write_text(path: str | Path, text: str, remedy: str = "", sync: bool = True) -> None:
    """Write a text as UTF-8, whole or not at all. Raises WriteError as `whole_file`."""
    with whole_file(path, remedy, sync) as part:
        Path(part).write_text(text, encoding="utf-8")


def check_writable(path: str | Path) -> None:
    """Raise WriteError where no file can be written at `path`, before hours of work for it."""
    with _reported(path, ""):
        fd, part = part_file(Path(os.path.realpath(path)))
        os.close(fd)
        os.unlink(part)


def move(source: str | Path, target: str | Path) -> None:
    """Sync a file that is whole, and rename it within its file system. Raises OSError."""
    fd = os.open(source, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
        os.replace(source, target)
    finally:
        os.close(fd)
    sync_folder(Path(target).parent)


def make_folder(folder: str | Path, remedy: str = "") -> Path:
    """Make a folder and those above it, if they are not there. Raises WriteError."""
    with _reported(folder, remedy):
        Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


def part_file(target: Path) -> tuple[int, Path]:
    """Create the temporary file of `target`; return its descriptor, which holds a lock, and its path.

    Raises OSError."""
    try:
        old: os.stat_result | None = target.stat()
    except FileNotFoundError:
        old = None
    if old is not None and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(target))
    if old is not None and stat.S_ISDIR(old.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    _remove_stale(target.parent, target.name)
    fd, part = tempfile.mkstemp(prefix=f".{target.name[:200]}.", suffix=SUFFIX, dir=target.parent)
    try:
        _lock(fd)
        os.fchmod(fd, stat.S_IMODE(old.st_mode) if old else 0o666 & ~_umask())
        if old is not None and os.geteuid() == 0:
            os.fchown(fd, old.st_uid, old.st_gid)
    except OSError:
        os.close(fd)
        os.unlink(part)
        raise
    return fd, Path(part)


def sync_folder(folder: Path) -> None:
    """Sync the names in a folder. Raises OSError."""
    fd = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    except OSError as e:
        if e.errno != errno.EINVAL:  # a file system that cannot sync folders
            raise
    finally:
        os.close(fd)


def reason(e: OSError) -> str:
    """Return the system's words for an error, also where a library has put its own around them."""
    return os.strerror(e.errno) if e.errno else str(e).splitlines()[0]


def long_socket(path: str | Path, option: str) -> str:
    """Return a sentence where the path is longer than one of a Unix socket may be; '' else."""
    size = len(os.fsencode(path))
    if size <= MAX_SOCKET:
        return ""
    return (
        f"{path}: {size} bytes; a socket's path of at most {MAX_SOCKET} was expected, as the system allows; give a "
        f"shorter {option}, such as /run/thermoctl/rig"
    )


def remedy_of(e: OSError) -> str:
    """Return advice for an error of writing a file."""
    return _REMEDIES.get(e.errno or 0, "give another path")


@contextlib.contextmanager
def _reported(path: str | Path, remedy: str) -> Iterator[None]:
    """Turn an OSError into an InputError of one line that names `path`."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            remedy = f"{remedy_of(e)} and run this again"
        elif e.errno == errno.EIO:
            remedy = ""
        raise WriteError(path, e, remedy or remedy_of(e)) from None


def _is_device(path: str | Path) -> bool:
    folder = os.path.realpath(os.path.dirname(os.path.abspath(path)))
    if folder == "/dev" or folder.startswith("/proc/"):
        return True
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))


def _remove_stale(folder: Path, name: str) -> None:
    """Remove the temporary files of killed writers of this name: unlocked, and older than STALE_S."""
    head = f".{name[:200]}."
    for part in os.scandir(folder):
        if not (part.name.startswith(head) and part.name.endswith(SUFFIX)):
            continue
        with contextlib.suppress(OSError):
            if time.time() - part.stat(follow_symlinks=False).st_mtime < STALE_S:
                continue
            fd = os.open(part.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if part.is_dir(follow_symlinks=False):
                    shutil.rmtree(part.path, ignore_errors=True)
                else:
                    os.unlink(part.path)
            finally:
                os.close(fd)


def _lock(fd: int) -> None:
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _sync_tree(folder: Path) -> None:
    for place, _, names in os.walk(folder):
        for name in names:
            fd = os.open(os.path.join(place, name), os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(fd)
            finally:
                os.close(fd)
        sync_folder(Path(place))


def _move_all(work: Path, folder: Path, remove: Iterable[str]) -> None:
    """Rename every entry of `work` into `folder`; undo all renames where one fails."""
    new = sorted(os.listdir(work))
    gone = [name for name in remove if name not in new and (folder / name).exists()]
    before = work / ".before"
    before.mkdir()
    moved: list[str] = []
    try:
        for name in (*new, *gone):
            moved.append(name)
            if (folder / name).is_file():
                try:
                    os.link(folder / name, before / name)
                except OSError:  # a file system without links
                    shutil.copy2(folder / name, before / name)
            if name in gone:
                os.unlink(folder / name)
            else:
                os.rename(work / name, folder / name)
        sync_folder(folder)
    except OSError:
        for name in moved:
            with contextlib.suppress(OSError):
                if (before / name).exists():
                    os.rename(before / name, folder / name)
                elif name in new and not (work / name).exists():
                    os.unlink(folder / name)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
