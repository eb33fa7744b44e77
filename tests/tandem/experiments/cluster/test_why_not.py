"""The workers that are refused, and the reasons that are reported."""

from __future__ import annotations

import dask
import msgspec
import pytest

from tandem.experiments.cluster.bundle import Bundle
from tandem.experiments.cluster.making import Facts
from tandem.experiments.cluster.making import facts as facts_here
from tandem.experiments.cluster.workplace import Cluster, why_not
from tandem.experiments.study.isolated import Failure
from tandem.experiments.study.runner import RunnerError

OURS = facts_here()


def test_a_worker_like_this_process_is_taken() -> None:
    assert why_not(OURS) is None


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        (
            msgspec.structs.replace(OURS, versions=OURS.versions | {"numpy": "1.0"}),
            f"numpy 1.0, here {OURS.versions['numpy']}",
        ),
        (
            msgspec.structs.replace(
                OURS,
                versions={name: text for name, text in OURS.versions.items() if name != "torch"},
                missing=["torch"],
            ),
            f"torch is missing, here {OURS.versions['torch']}",
        ),
        (msgspec.structs.replace(OURS, missing=["mcap"]), "mcap is missing"),
        (msgspec.structs.replace(OURS, code="0"), "the same version of Tandem with other code"),
        (Failure(kind="error", text="ImportError: x", traceback=""), "Tandem does not run on it: ImportError: x"),
    ],
    ids=["version", "torch", "mcap", "code", "broken"],
)  # fmt: skip
def test_one_that_could_give_other_numbers_is_refused_with_the_reason(
    facts: Facts | Failure, why: str
) -> None:
    assert why in (why_not(facts) or "")


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({}, "has no ca-file"),
        (dict.fromkeys(("ca-file", "client.cert", "client.key"), "/no/such.pem"), "No such file"),
    ],
    ids=["none", "missing"],
)
def test_tls_without_certificates_is_refused_before_a_connection(settings: dict[str, str], why: str) -> None:
    configured = {f"distributed.comm.tls.{name}": value for name, value in settings.items()}
    with (
        dask.config.set(configured),
        pytest.raises(RunnerError, match=f"needs certificates.*{why}.*tls.yaml"),
    ):
        Cluster("tls://127.0.0.1:1", Bundle({}))
