"""Python in a separate interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def python(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments in this folder; return its output and exit code."""
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=300, cwd=cwd, check=False
    )


def imported(code: str) -> set[str]:
    """Return the top-level names of all modules that are loaded after `code` has run."""
    told = "import sys\nprint('\\n' + ' '.join({name.split('.')[0] for name in sys.modules}), end='')"
    done = python("-c", f"{code}\n{told}")
    assert done.returncode == 0, done.stderr
    return set(done.stdout.rpartition("\n")[2].split())
