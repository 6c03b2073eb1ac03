"""Where logs and results lie: local paths, or URLs such as s3://bucket/log.mcap, which go through fsspec."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote, urlsplit

from tbmfg.errors import TbmfgError

if TYPE_CHECKING:
    from upath import UPath

Place: TypeAlias = "Path | UPath"

_VERSION_OF_OBJECT = ("etag", "ETag", "mtime", "LastModified", "last_modified", "created")  # what file systems call it


def place(where: str | os.PathLike | Place) -> Place:
    """``where`` as a path: a ``pathlib.Path``, or for a URL its like of ``universal_pathlib``.

    Raises TbmfgError for a kind of URL that nothing installed here can open.
    """
    text = where if isinstance(where, str) else str(where)
    kind, mark, _ = text.partition("://")
    if not mark:
        return Path(where)
    if kind == "file":
        return Path(unquote(urlsplit(text).path))
    from upath import UPath

    try:
        found = UPath(text)
        found.fs  # noqa: B018 - looks for the package that opens it
    except (ImportError, ValueError) as error:
        raise TbmfgError(f"{text}: {kind}:// cannot be opened here ({error}); pip install 'tbmfg[cluster]'") from error
    return found


def is_folder(where: Place) -> bool:
    """A URL that ends in .mcap is taken for a file without asking: a web server cannot say."""
    return where.is_dir() if isinstance(where, Path) else where.suffix != ".mcap" and where.is_dir()


def absolute(where: Place) -> Place:
    return where.absolute() if isinstance(where, Path) else where


def fingerprint(file: Place) -> dict[str, Any]:
    """Size and version (modification time or etag) of one file: equal as long as nobody has written it."""
    if isinstance(file, Path):
        stat = file.stat()
        return {"name": file.name, "size": stat.st_size, "version": str(stat.st_mtime_ns)}
    file.fs.invalidate_cache()  # listings of an object store are kept; what was written since would not show
    info = file.fs.info(file.path)
    version = next((info[key] for key in _VERSION_OF_OBJECT if info.get(key) is not None), None)
    return {"name": file.name, "size": info.get("size"), "version": str(version)}


@contextmanager
def scratch_for(folder: Place) -> Iterator[Path]:
    """A local folder to write in before :func:`publish`; for a local ``folder`` a hidden one inside it, so on the same
    file system. Nothing of it is left behind, nor an empty ``folder`` that was made for it."""
    local = isinstance(folder, Path)
    made = local and not folder.exists()
    if local:
        folder.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=".partial-", dir=folder if local else None))
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if made and not any(folder.iterdir()):
            folder.rmdir()


def publish(file: Path, target: Place) -> None:
    """Move a complete local file to ``target``, where it appears at once: by renaming, or as one object."""
    if isinstance(target, Path):
        file.replace(target)
    else:
        target.fs.put_file(str(file), target.path)


def write_text(target: Place, text: str) -> None:
    """Write one file, which appears under its name when complete."""
    with scratch_for(target.parent) as scratch:
        (scratch / target.name).write_text(text, "utf-8")
        publish(scratch / target.name, target)
