"""Paths of the repository."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIGS, DOCS = ROOT / "configs", ROOT / "docs"
INSTALLED = (
    "network_model",
    "lbmpc",
    "protocol",
    "node_runtime",
    "controller_node",
    "trainer_node",
    "plant_sim",
    "run_log",
    "tandem",
)
"""The packages of the wheel."""
NAMESAKES = ("signal", "queue", "protocol", "lbmpc", "tandem")


def write_namesakes(folder: Path) -> None:
    """Files with the names of modules that every process imports. Importing one of them raises an error."""
    for name in NAMESAKES:
        (folder / f"{name}.py").write_text("raise SystemExit('imported from the current folder')\n")
