"""`tandem architecture`: network architectures in files of your own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, Suppress, arg, subcommand

from tandem.commands.base import Command

NETWORKS = 60
"""Number of random sizes. Most architectures accept most of them."""


@dataclass(frozen=True, kw_only=True)
class ArchitectureCheck(Command):
    """Check that numpy, CasADi and torch compute the same network from your file, and that phi is bounded by 1."""

    EXTRAS = "trainer"

    name: Annotated[Positional[str], arg(metavar="FILE:NAME")]
    """The architecture, as in network.architecture: gru.py:GRU, or a shipped one."""

    def run(self) -> int:
        """Return 0 if they agree on networks of random sizes, as far as the architecture accepts them, else 1."""
        import numpy as np

        from network_model.registry import register
        from node_runtime.config.architecture import load_architecture
        from node_runtime.config.reference import is_reference
        from node_runtime.config.strict import ConfigError
        from tandem.parity import Parity, drawn, parity

        name = self.name
        if is_reference(name):
            own = load_architecture(name)
            register(name, *own)
            name = own.name
        rng, found, refused = np.random.default_rng(0), Parity(0.0, 0.0, 0.0), dict[str, int]()
        for seed in range(NETWORKS):
            try:
                description = drawn(name, rng)
            except ValueError as error:
                refused[str(error)] = refused.get(str(error), 0) + 1
            else:
                found = found.worst(parity(description, seed, size=10.0 ** rng.integers(-1, 2)))
        accepted = NETWORKS - sum(refused.values())
        if not accepted:
            raise ConfigError(
                f"{name}: refuses all {NETWORKS} random sizes; the first reason: {next(iter(refused))}"
            )
        self.say(
            f"{name}: {accepted} networks of random sizes",
            *(f"  {count} refused: {text}" for text, count in refused.items()),
            f"  largest difference of h_hat between numpy, CasADi and torch: {found.value:.1e} of the output scale",
            f"  largest difference of the slopes between CasADi and torch: {found.slope:.1e}",
            f"  largest entry of phi: {found.phi:.6g}"
            + ("" if found.phi <= 1.0 else "; it must be bounded by 1"),
        )
        self.say(
            "the implementations agree" if found.holds else "the implementations DIFFER",
            style="green" if found.holds else "bold red",
        )
        self.emit(
            {"name": name, "networks": accepted, "refused": refused, **found._asdict(), "holds": found.holds}
        )
        return 0 if found.holds else 1


@dataclass(frozen=True, kw_only=True)
class ArchitectureCommand:
    """Work with network architectures of your own."""

    # A union, so that `check` is a word of its own on the command line.
    action: Annotated[ArchitectureCheck, subcommand("check")] | Annotated[None, Suppress]
