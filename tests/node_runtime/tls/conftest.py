"""A site that all tests of this folder share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tandem import certificate_authority
from tests.helpers.certificates import issue
from tests.helpers.live import Process, free_endpoint, live_config
from tests.node_runtime.tls.site import Site


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("site")
    certificate_authority.create("jet1", [], folder / "jet1", 30)
    certificate_authority.create(
        "jet1", [], folder / "other", 30
    )  # the same names, but from another authority
    own = certificate_authority.create("jet2", [], folder / "jet2", 30)
    assert own
    issue(folder / "jet1", "expired", "trainer.jet1", -0.5)
    issue(folder / "jet1", "stranger", "stranger.jet1", 30)
    issue(folder / "jet1", "neighbour", "trainer.jet2", 30)
    remote = free_endpoint().replace("tcp/", "tls/")
    config = live_config(f'bus.remote="{remote}"', f'bus.tls.keys="{folder / "jet1" / "router"}"')
    with Process("node_runtime.router", config) as process:
        site = Site(folder, process, config)
        site.router.heard("with certificates, on")
        yield site
