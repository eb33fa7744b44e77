"""Python in an interpreter of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def python(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """With these arguments, in this folder; what it wrote, and how it ended."""
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=300, cwd=cwd, check=False
    )


def imported(code: str) -> set[str]:
    """The top-level names of all that is loaded once `code` has run."""
    told = "import sys\nprint('\\n' + ' '.join({name.split('.')[0] for name in sys.modules}), end='')"
    done = python("-c", f"{code}\n{told}")
    assert done.returncode == 0, done.stderr
    return set(done.stdout.rpartition("\n")[2].split())
