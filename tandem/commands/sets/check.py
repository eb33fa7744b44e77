"""`tandem sets check`: the hash, the model, the claim, and W against the true plant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import NO_SETS, Configured


@dataclass(frozen=True, kw_only=True)
class SetsCheck(Configured):
    """Prove the claim of a file again, from the file alone; with the configuration, that it is about this model."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A file of certified sets."""
    samples: Annotated[int, arg(metavar="N")] = 20_000
    """States and inputs at which the true plant is asked whether W holds."""

    def run(self) -> int:
        """0: everything holds; 3: refused, and why."""
        config, _ = self.resolve()
        from controller_node.build import build_model
        from controller_node.certified_sets import read_sets
        from lbmpc.sets.certificate import CertificateError, require_match
        from lbmpc.sets.check import check
        from tandem.commands.sets.sampling import HAIR, sample

        terminal.limited("--samples", self.samples, 1, 1_000_000)
        model = build_model(config)
        result: dict[str, Any] = {"file": str(self.file), "certificate": "ok"}
        reason = ""
        try:
            sets = read_sets(self.file)
            result |= {"kind": sets.certificate.kind, "sha256": sets.sha256, "facets": sum(sets.facets)}
            require_match(sets.certificate, model)
        except CertificateError as error:
            reason = str(error)
        else:
            with terminal.share_bar(self.console) as bar:
                task = bar.add_task("proving the claim", total=1.0)
                verdict = check(sets.certificate, progress=lambda done: bar.update(task, completed=done))
            found = sample(sets.certificate, model, self.samples)
            result |= {"invariance_margin": verdict.margin, "vertices": verdict.vertices}
            result |= {"samples": found.samples, "largest_excess_over_W": found.excess}
            if not verdict.ok:
                reason = f"the claim does not hold: {verdict.reason}"
            elif found.excess > HAIR:
                reason = f"its W does not hold for the true plant: {found.where}"
        if reason:
            result["certificate"] = reason
            terminal.complain(f"{self.file}: refused: {reason}", as_json=False)
        else:
            self.say(f"{self.file}: ok", style="green")
            near = (
                f"at least {-found.excess:.2g} inside" if found.excess < 0 else f"never outside by {HAIR:g}"
            )
            text = (
                f"{len(sets.facets)} sets ({sets.certificate.kind}), {result['facets']} facets, {result['vertices']} "
                f"vertices confirmed; margin {result['invariance_margin']:.2g} of X's half-widths\n"
                f"the true plant at {found.samples} states and inputs: h stays in W ({near})\n"
                f"sha256 {sets.sha256}"
            )
            self.say(text)
        self.emit(result)
        return NO_SETS if reason else 0
