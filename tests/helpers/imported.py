"""What a program imports, in an interpreter of its own."""

from __future__ import annotations

import subprocess
import sys


def imported(code: str) -> set[str]:
    """The top-level names of all that is loaded once `code` has run."""
    told = f"{code}\nimport sys\nsys.stdout.write(' '.join({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run(
        [sys.executable, "-c", told], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())
