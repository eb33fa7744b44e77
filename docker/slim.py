"""Makes an environment smaller by what is of no use at run time: python docker/slim.py FOLDER.

Headers, static libraries and the packages' own tests go. Wheels cannot hold links, so many carry a library once for
each of its names: of such copies one stays, and links to it.
"""

from __future__ import annotations

import filecmp
import shutil
import sys
from collections import defaultdict
from pathlib import Path

UNUSED_FOLDERS = ("include", "tests")


def remove_unused(packages: Path) -> None:
    """Headers and tests of every package below, and static libraries."""
    unused = [path for name in UNUSED_FOLDERS for path in packages.rglob(name) if path.is_dir()]
    for path in unused:
        shutil.rmtree(path, ignore_errors=True)
    for path in list(packages.rglob("*.a")):
        path.unlink()


def link_copies(packages: Path) -> None:
    """One file for libraries of one folder with equal content."""
    alike: dict[tuple[Path, str, int], list[Path]] = defaultdict(list)
    for path in sorted(packages.rglob("*.so*")):
        if path.is_file() and not path.is_symlink():
            alike[path.parent, path.name.split(".so")[0], path.stat().st_size].append(path)
    for first, *others in alike.values():
        for path in others:
            if filecmp.cmp(first, path, shallow=False):
                path.unlink()
                path.symlink_to(first.name)


def main() -> None:
    for packages in Path(sys.argv[1]).rglob("site-packages"):
        remove_unused(packages)
        link_copies(packages)


if __name__ == "__main__":
    main()
