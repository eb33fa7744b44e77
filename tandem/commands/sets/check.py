"""`tandem sets check`: the hash, the model, the claim, and W against the true plant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import NO_SETS, Configured

if TYPE_CHECKING:
    from controller_node.certified_sets import CertifiedSets
    from lbmpc.model import Model


@dataclass(frozen=True, kw_only=True)
class SetsCheck(Configured):
    """Prove the claim of a file again from the file and the plant's equations, and check that it fits this model."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A file of certified sets."""
    samples: Annotated[int, arg(metavar="N")] = 20_000
    """Number of states and inputs at which W is sampled before it is proved."""
    prove: bool = True
    """Prove W by interval arithmetic, which takes most of the time; otherwise it is only sampled."""

    def run(self) -> int:
        """Return 0 if everything holds, 3 if the file is refused."""
        config, _ = self.resolve()
        from controller_node.build import build_model
        from controller_node.certified_sets import read_sets
        from lbmpc.sets.certificate import CertificateError, require_match

        terminal.limited("--samples", self.samples, 1, 1_000_000)
        model = build_model(config)
        result: dict[str, Any] = {"file": str(self.file), "certificate": "ok"}
        try:
            sets = read_sets(self.file)
            result |= {"kind": sets.certificate.kind, "sha256": sets.sha256, "facets": sum(sets.facets)}
            require_match(sets.certificate, model)
            reason = self._reason(sets, model, result)
        except CertificateError as error:
            reason = str(error)
        if reason:
            result["certificate"] = reason
            terminal.complain(f"{self.file}: refused: {reason}", as_json=False)
        else:
            self.say(f"{self.file}: ok", style="green")
            text = (
                f"{len(sets.facets)} sets ({sets.certificate.kind}), {result['facets']} facets, {result['vertices']} "
                f"vertices confirmed; margin {result['invariance_margin']:.2g} of X's half-widths\n"
                f"h is in W: {result['W']}\n"
                f"sha256 {sets.sha256}"
            )
            self.say(text)
        self.emit(result)
        return NO_SETS if reason else 0

    def _reason(self, sets: CertifiedSets, model: Model, result: dict[str, Any]) -> str:
        """Return why the claim is refused, empty if it holds; results go into `result`."""
        from lbmpc.sets.check import check
        from lbmpc.sets.enclosures.affine_forms import DisturbanceError
        from lbmpc.sets.enclosures.proof import prove
        from tandem.commands.sets.sampling import HAIR, sample

        certificate = sets.certificate
        with terminal.share_bar(self.console) as bar:
            task = bar.add_task("proving that the sets are invariant", total=1.0)
            verdict = check(certificate, progress=lambda done: bar.update(task, completed=done))
            result |= {"invariance_margin": verdict.margin, "vertices": verdict.vertices}
            if not verdict.ok:
                return f"the claim does not hold: {verdict.reason}"
            if model.equations is None:
                result["W"] = "not checked: the plant has matrices only, and no equations to compare with"
                return ""
            found = sample(certificate, model, self.samples)
            result |= {"samples": found.samples, "largest_excess_over_W": found.excess}
            if found.excess > HAIR:
                return f"its W does not contain h of the true plant: {found.where}"
            result["W"] = f"sampled at {found.samples} states and inputs, not proved"
            if certificate.source_of_W == "given":
                result["W"] += " (it is given)"
            if certificate.source_of_W == "given" or not self.prove:
                return ""
            task = bar.add_task("proving W", total=1.0)
            try:
                proof = prove(model, certificate, progress=lambda done: bar.update(task, completed=done))
            except DisturbanceError as error:
                return f"its W cannot be proved: {error}"
        if proof.reason:
            return f"its W is not proved for the true plant: {proof.reason}"
        # The checker's scales are half-widths rounded to powers of two.
        if 2 * proof.beyond >= verdict.margin:
            return f"W is proved only to {proof.beyond:.2g} of X's half-widths, and the margin is {verdict.margin:.2g}"
        result["W"] = (
            f"proved by interval arithmetic on {proof.boxes} boxes, to {proof.beyond:.1g} of X's half-widths"
        )
        return ""
