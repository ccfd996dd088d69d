"""Output folders: a result appears whole or not at all, and what is the user's stays.

A command first checks the names that it will write (`claim`). Later it writes its files into a
temporary folder beside the target, which then takes the target's name (`staged`). In a folder that
goes on, as where a format is added to a result, every file takes its name by itself.

SUMS lists the files that the program made in a folder, as `sha256sum -c` reads them. A file that is
not listed, or was changed since, belongs to the user: it is kept, and overwritten only with
`overwrite`. The first line names the subject of the result, such as the frames that were solved.
"""

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain, count
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple

from soup_nlp.errors import DataError, printable
from soup_nlp.storage.files import PathLike, as_path, read_text, require_file, write_text
from soup_nlp.storage.system import deferred_signals

SUMS = "SHA256SUMS"
"""File with the SHA-256 of the files that the program made in a folder."""
_HEAD = "# soup-nlp "
"""First line of SUMS, before the subject; `sha256sum -c` ignores it."""
_NEXT = "# next "
"""Before a line of SUMS for a file that is listed only once it is in its place."""
UNFINISHED = "unfinished-soup-nlp-"
"""First part of the names of temporary folders; one of a process that was killed stays."""


class Sums(NamedTuple):
    """SHA-256 by name of the files that the program made in a folder, and subject of the result."""

    files: dict[str, str]
    subject: str = ""


def read_sums(folder: Path) -> Sums | None:
    """The list of a folder; None if the program has made nothing there."""
    path, text = folder / SUMS, ""
    with suppress(DataError):
        text = "" if path.is_symlink() else read_text(path, SUMS)
    head, _, lines = text.partition("\n")
    if not head.startswith(_HEAD):
        return None
    files: dict[str, str] = {}
    row = rf"^({_NEXT})?([0-9a-f]{{64}})  (\S.*)$"
    for coming, digest, name in re.findall(row, lines, re.MULTILINE):
        # a damaged list must not name files outside the folder
        inside = not PurePosixPath(name).is_absolute() and ".." not in name
        if inside and (not coming or _state(folder, name, {name: digest}) == "made"):
            files[name] = digest
    return Sums(files, head.removeprefix(_HEAD).strip())


def write_sums(folder: Path, sums: Sums, coming: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write the list of a folder, see `read_sums`; `coming` are files that will be put there."""
    lines = [f"{digest}  {name}" for name, digest in sorted(sums.files.items())]
    lines += [f"{_NEXT}{digest}  {name}" for name, digest in sorted(coming.items())]
    write_text(folder / SUMS, "\n".join([f"{_HEAD}{printable(sums.subject)}", *lines, ""]))


def files_in(folder: Path) -> list[str]:
    """Names of all files below a folder, without the list."""
    paths = [path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()]
    return sorted(p.relative_to(folder).as_posix() for p in paths if p != folder / SUMS)


def digest_of(path: Path) -> str:
    """SHA-256 of a regular file; pipes may never end."""
    try:
        with require_file(path, "file").open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError("file cannot be read", where=path, found=error.strerror) from error


def _state(folder: Path, name: str, made: dict[str, str]) -> str:
    """What is under a name: nothing, made (by the program), foreign, or blocked by a folder."""
    path, above = folder / name, [folder / p for p in PurePosixPath(name).parents[:-1]]
    # a file or link above it blocks a name as well
    if any(p.is_symlink() or (p.exists() and not p.is_dir()) for p in above):
        return "blocked"
    if path.is_file() and not path.is_symlink():
        return "made" if name in made and made[name] == digest_of(path) else "foreign"
    blocked = path.is_dir() and not path.is_symlink()
    return "blocked" if blocked else "foreign" if os.path.lexists(path) else "nothing"


def default_folder(name: str, subject: str) -> Path:
    """`out/NAME`, or the first of `out/NAME-2`, ... that holds no result of another subject."""
    names = chain([name], (f"{name}-{k}" for k in count(2)))
    found = ((p, read_sums(p)) for p in (Path("out") / n for n in names))
    return next(p for p, sums in found if sums is None or sums.subject in ("", subject))


def claim(
    folder: PathLike,
    names: Iterable[str],
    overwrite: bool = False,
    subject: str = "",
    journal: str = "",
) -> Path:
    """Check that these files may be written into an output folder, which is not made yet.

    Args:
        folder: The output folder.
        names: Files that will be written.
        overwrite: Allow files of the user with these names, and the result of another subject.
        subject: Subject of the new result, see `Sums`.
        journal: File that the command appends to: one that is there must be of this program.
    """
    hint = "choose another --out, or --overwrite"
    with _named_errors(folder):
        target = Path(os.path.realpath(as_path(folder, "output folder")))
        if os.path.ismount(target):
            what = "output folder is a mount point"
            raise DataError(what, where=folder, hint="choose a folder below it")
        for place in (target, next(p for p in target.parents if os.path.lexists(p))):
            if os.path.lexists(place):
                # fails where nothing can be written
                tempfile.TemporaryFile(dir=place).close()
        before = read_sums(target)
        files, old = before or Sums({})
        if subject and old not in ("", printable(subject)) and not overwrite:
            what = "output folder holds the result of something else"
            raise DataError(what, where=folder, found=old, expected=subject, hint=hint)
        own = {} if before else {SUMS: _state(target, SUMS, {})}
        states = own | {name: _state(target, name, files) for name in names}
        if journal and (state := _state(target, journal, {})) != "nothing":
            # it grows, so that it is not listed
            linked = (target / journal).is_symlink()
            states[journal] = "made" if before and state == "foreign" and not linked else "blocked"
        foreign = [name for name, state in states.items() if state in ("foreign", "blocked")]
        if foreign and not overwrite:
            raise DataError(
                "output folder holds files that would be overwritten and that this program did not"
                " make, or that were changed since",
                where=folder,
                found=", ".join(foreign),
                expected="a new or empty folder, or that of an earlier result",
                hint=f"move them away, {hint}",
            )
        if blocked := [name for name in foreign if states[name] == "blocked"]:
            what = "cannot write over a folder, below a file or link, or into another one's file"
            raise DataError(what, where=target / blocked[0], hint="choose another --out")
    return Path(folder)


@contextmanager
def staged(
    folder: PathLike, whole: bool = False, overwrite: bool = False, subject: str = ""
) -> Iterator[Path]:
    """An empty folder whose files are those of `folder` when the block ends without exception.

    On an exception `folder` does not change, and no new folder is left.

    Args:
        folder: The output folder.
        whole: The new files are a complete result: files of an earlier result are removed.
        overwrite: Overwrite files that the program did not make.
        subject: Subject of the new result; empty for that of the earlier result.
    """
    target = Path(os.path.realpath(as_path(folder, "output folder")))
    fresh = [p for p in target.parents if not os.path.lexists(p)]
    with _named_errors(folder):
        target.parent.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=target.parent))
        # unlike the temporary folder, it has the usual permissions
        new = place / "new"
        try:
            new.mkdir()
            yield new
            with _locked(target.parent), deferred_signals():
                claim(target, files_in(new), overwrite)
                _commit(new, target, whole, subject)
        except DataError as error:
            # name the final path instead of the temporary one
            if not isinstance(error.where, Path) or not error.where.is_relative_to(new):
                raise
            final = target / error.where.relative_to(new)
            raise DataError(error.what, where=final, found=error.found, hint=error.hint) from error
        finally:
            with deferred_signals(), suppress(OSError):
                if not (place / "old").exists():
                    shutil.rmtree(place, ignore_errors=True)
                # fails for a folder that is not empty
                for path in fresh:
                    path.rmdir()


def _commit(new: Path, target: Path, whole: bool, subject: str) -> None:
    """Give new files their names."""
    names, before = files_in(new), read_sums(target)
    made, old = before or Sums({})
    digests = {name: digest_of(new / name) for name in names}
    # a file that was changed stays listed, so that it is known to be changed
    write_sums(new, Sums(digests if whole else made | digests, subject or old))
    for name in (*names, SUMS):
        # wait until the file is on disk: some systems report a full disk only here
        with (new / name).open("rb") as file:
            os.fsync(file.fileno())
    if not target.exists():
        os.rename(new, target)
        return
    shutil.copymode(target, new)
    gone = {n for n in made if whole and _state(target, n, made) == "made"} - digests.keys()
    # a shell stays in its working folder
    if whole and before is not None and not Path.cwd().is_relative_to(target):
        _exchange(new, target, {*digests, *gone, SUMS})
        return
    # a kill from here on leaves files of both, of which every one is listed as it is
    write_sums(new.parent, Sums(made, subject or old), digests)
    os.replace(new.parent / SUMS, target / SUMS)
    for name in gone:
        (target / name).unlink()
    for name in (*names, SUMS):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(new / name, target / name)


def _exchange(new: Path, target: Path, replaced: Set[str]) -> None:
    """Put a folder in the place of another one, whose files that are not replaced it gets."""
    shared = {parent for name in replaced for parent in PurePosixPath(name).parents}
    kept = set()
    for name in set(files_in(target)) - replaced:
        path = PurePosixPath(name)
        # a folder with nothing but the user's files moves at once
        kept.add(next(p for p in (*reversed(path.parents), path) if p not in shared))
    old = new.with_name("old")
    # a kill from here on leaves the other folder beside the target
    os.rename(target, old)
    try:
        os.rename(new, target)
    except OSError:
        os.rename(old, target)
        raise
    for path in kept:
        (target / path).parent.mkdir(parents=True, exist_ok=True)
        os.rename(old / path, target / path)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Other processes that write into folders of this one wait; not where there are no locks."""
    with ExitStack() as stack:
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


@contextmanager
def _named_errors(folder: PathLike) -> Iterator[None]:
    """Turn errors of the operating system into a DataError that names the output folder."""
    try:
        yield
    except OSError as error:
        reason, hint = error.strerror or error, "choose another --out, or make room on a full disk"
        what = "output folder cannot be written"
        raise DataError(what, where=folder, found=reason, hint=hint) from error
