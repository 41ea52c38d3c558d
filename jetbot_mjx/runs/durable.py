"""Have the disk hold what was written, so that it survives a loss of power.

A write is in the memory of the system until a sync, and the disk may receive the writes between two
syncs in any order: a file may have its new name before its content, or never get that name. So

1. a file's content is synced before the file is renamed, and the folder after it;
2. of a folder that is renamed as a whole, all files and folders inside are synced before;
3. a new folder's name is synced in the folder that holds it.

`benchmarks/reliability/power_loss.py` replays what a disk may hold after a loss of power.
"""

import ctypes
import errno
import os
from pathlib import Path

_NOT_SUPPORTED = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)
"""What some file systems answer to the sync of a folder, which they write at once."""

_AT_CURRENT_FOLDER, _EXCHANGE = -100, 2
"""Arguments of Linux's `renameat2`."""


def sync(path: Path) -> None:
    """Wait until the disk holds a file's content, or the names in a folder.

    Raises:
      OSError: the disk could not write it.
    """
    # Windows cannot open folders, and writes their names at once.
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NOT_SUPPORTED or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Wait until the disk holds a folder's regular files and folders, the folder itself last.

    Raises:
      OSError: the disk could not write them.
    """
    for parent, _, names in os.walk(folder, topdown=False):
        for file in (Path(parent, name) for name in names):
            if file.is_file() and not file.is_symlink():
                sync(file)
        sync(Path(parent))


def make_folders(path: Path) -> None:
    """Create a folder and those above it, unless they exist, and sync their names.

    Raises:
      OSError: a folder cannot be created.
    """
    missing = [one for one in (path, *path.parents) if not one.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for one in missing:
        sync(one.parent)


def move(path: Path, target: Path) -> None:
    """Rename a file or folder whose content the disk holds, and sync the folders of both names.

    Raises:
      OSError: it cannot be renamed.
    """
    path.replace(target)
    for folder in {path.parent, target.parent}:
        sync(folder)


def exchange(folder: Path, other: Path) -> bool:
    """Exchange the names of two folders beside each other in one step, so that both always exist.

    Returns:
      Whether it was done; not on systems and file systems that cannot.

    Raises:
      OSError: the disk could not write the names.
    """
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, TypeError):  # a C library without it, or none
        return False
    here = _AT_CURRENT_FOLDER
    if rename(here, os.fsencode(folder), here, os.fsencode(other), _EXCHANGE) != 0:
        return False
    sync(folder.parent)
    return True
