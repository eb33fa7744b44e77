"""The compressor in ten lines: the script runs unchanged and prints the output that its page shows."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from tests.helpers.paths import ROOT

FOLDER = ROOT / "examples" / "compressor"


def test_the_script_gives_what_its_page_shows(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, FOLDER / "compressor.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (shown,) = re.findall(r"```\n(one solve.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
    assert done.stdout == shown
    assert (tmp_path / "compressor.png").read_bytes().startswith(b"\x89PNG")
