"""Read and write files of executable code that no other user can have written.

A cached program is machine code, and the cache folder may be shared with other users. As ssh does
with its keys, a file is trusted if it and its folder belong to this user or to root and nobody else
may write to either. On a system without file owners, such as Windows, every file is trusted. Each
file begins with the digest of its content, by which a damaged one is recognised.
"""

import contextlib
import hashlib
import os
import stat
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import jax

_DIGEST_BYTES = hashlib.sha256().digest_size


def read_trusted(path: Path) -> bytes | None:
    """Return the content of a file that nobody but this user and root can have written.

    Args:
      path: a file that `write_private` wrote.

    Returns:
      The content; None if the file does not exist, is damaged or is not trusted. A file that is not
      trusted costs a warning.
    """
    try:
        # Check the folder first: whoever may write to it may replace any file in it.
        reason = distrust(path.parent, path.parent.stat())
        if reason is None:
            with path.open("rb") as file:
                # Ask the file that is open, not its path, behind which there may be another file by
                # now.
                reason = distrust(path, os.fstat(file.fileno()))
                if reason is None:
                    # A file that was cut off or changed does not have the digest it begins with.
                    digest, content = file.read(_DIGEST_BYTES), file.read()
                    return content if digest == hashlib.sha256(content).digest() else None
    except OSError:
        return None
    warnings.warn(f"compiled programs are not read, and compiled again: {reason}", stacklevel=2)
    return None


def write_private(path: Path, content: bytes) -> None:
    """Write a file that `read_trusted` trusts, atomically.

    Args:
      path: the file. Nothing is written if its folder is not trusted, as it would not be read.
      content: the whole content that `read_trusted` returns.

    Raises:
      OSError: the folder does not exist, or the file cannot be written.
    """
    if distrust(path.parent, path.parent.stat()) is not None:
        return
    # Write to a new folder and rename: readers find the old file or the whole new one. The file is
    # private from its first byte.
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        written = Path(folder) / path.name
        with open(os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
            # A power loss after the rename must not leave the new name without the new content.
            file.flush()
            os.fsync(file.fileno())
        written.replace(path)


def distrust(path: Path, status: os.stat_result) -> str | None:
    """Return why a file or folder is not trusted, or None if it is trusted.

    Args:
      path: the file or folder, for the message.
      status: the owner and mode of the file or folder.

    Returns:
      The reason and the remedy, on one line.
    """
    # Windows has no owners and modes that could be checked.
    if not hasattr(os, "geteuid"):
        return None
    if status.st_uid not in (os.geteuid(), 0):
        return f"{path} belongs to another user, number {status.st_uid}"
    # Its group or everybody may write to it.
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to {path}: chmod go-w {path}"
    return None


def cached_bytes(kind: str, key: bytes, make: Callable[[], bytes]) -> bytes:
    """Return cached bytes from the folder of compiled programs, or make and cache them.

    Args:
      kind: the prefix of the file's name.
      key: the cache key: everything that the content depends on.
      make: a function that returns the content if it is not cached.

    Returns:
      The content.
    """
    # The folder is the one in which JAX caches its own programs; without one, nothing is cached.
    cache = jax.config.values["jax_compilation_cache_dir"]
    if not cache or not jax.config.values["jax_enable_compilation_cache"]:
        return make()
    path = Path(cache) / f"{kind}-{hashlib.sha256(key).hexdigest()}"
    content = read_trusted(path)
    if content is None:
        content = make()
        # A folder that cannot be written only costs time: the content is made again next time.
        with contextlib.suppress(OSError):
            write_private(path, content)
    return content
