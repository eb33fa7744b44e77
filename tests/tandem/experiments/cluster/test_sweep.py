"""A sweep on a real scheduler with two workers gives the rows of one process, bit by bit; failed runs stay alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import msgspec
import pytest

from lbmpc.plants import get_plant
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from tandem.experiments.cluster.bundle import gather
from tandem.experiments.cluster.workplace import Cluster
from tandem.experiments.study.declaration import load, resolve
from tandem.experiments.study.isolated import Failure
from tandem.experiments.study.plan import rows
from tandem.experiments.study.runner import Made, Processes, Workplace, run_all, wanted
from tests.helpers.dask_cluster import DaskCluster, dask_cluster

pytestmark = pytest.mark.live
# A true plant from a file that imports another; a case that kills its process, and one that raises.
TRUTH = """
import os
from lbmpc.plants import get_plant
from neighbour import SLOPE

class Moves:
    def __init__(self, deed):
        self.deed = deed
    def step(self, x, u, dt):
        self.deed()
        return x

def fail():
    raise SystemExit("this plant cannot be moved")

STEEP = get_plant("moore_greitzer").varied(slope=SLOPE)
KILLS = Moves(lambda: os.kill(os.getpid(), 9))
RAISES = Moves(fail)
"""
SWEEP = """
name = "sweep"
title = "A small sweep"
steps = 6
[set]
controller = { horizon = 6, oracle = "linear", solver = { compile = "never" } }
network = { hidden = [4] }
trainer = { steps = 2, min_samples = 2 }
[x0s.some]
grid = { z = [0.4, 0.6], y = [1.6] }
[[group]]
name = "fine"
title = "Fine"
picture = "lemma"
[[case]]
name = "steep"
group = "fine"
set.plant.truth = "truth.py:STEEP"
log = true
[[case]]
name = "linear"
group = "fine"
x0s = "some"
[[case]]
name = "network"
group = "fine"
set.controller.oracle = "dnn"
seeds = 2
[[group]]
name = "poison"
title = "Poison"
[[case]]
name = "kills"
group = "poison"
set.plant.truth = "truth.py:KILLS"
[[case]]
name = "raises"
group = "poison"
set.plant.truth = "truth.py:RAISES"
"""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("client")
    (folder / "truth.py").write_text(TRUTH)
    (folder / "neighbour.py").write_text("SLOPE = 1.4\n")
    path = folder / "sweep.toml"
    path.write_text(SWEEP)
    return path


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path_factory.mktemp("cluster"), "first", "second") as cluster:
        yield cluster


def make(path: Path, out: Path, workplace: Workplace, *groups: str) -> Made:
    cases = resolve(load(path), get_plant("moore_greitzer"), str(path))
    plans = list(rows([case for case in cases if case.group in groups]))
    with closing(workplace):
        return run_all(wanted(plans, {"fine"}, out / "logs"), out / "runs", workplace)


def on(cluster: DaskCluster, path: Path, said: list[str]) -> Cluster:
    cases = resolve(load(path), get_plant("moore_greitzer"), str(path))
    bundle = gather(plan.job.config for plan in rows(cases))
    return Cluster(cluster.address, bundle, said.append, patience=300.0)


def test_a_cluster_gives_the_rows_of_one_process_and_a_failed_run_affects_no_other(
    experiment: Path, cluster: DaskCluster, tmp_path: Path
) -> None:
    said: list[str] = []
    here = make(experiment, tmp_path / "here", Processes(1), "fine")
    there = make(experiment, tmp_path / "there", on(cluster, experiment, said), "fine", "poison")
    assert (len(here.records), here.failures) == (9, {})
    for key in here.records:
        one, other = (tmp_path / place / "runs" / f"{key}.json" for place in ("here", "there"))
        assert one.read_bytes() == other.read_bytes()
    assert sorted(text.split()[1] for text in said if "has joined" in text) == ["first", "second"]
    by_kind: dict[str, list[Failure]] = {"crash": [], "error": []}
    for failure in there.failures.values():
        by_kind[failure.kind].append(failure)
        assert failure.where in ("first", "second")
    (killed,) = by_kind["crash"]
    assert "SIGKILL" in killed.text
    # One for each of both with the true h, which a plant without equations does not have.
    raised = [failure for failure in by_kind["error"] if failure.text.startswith("SystemExit")]
    assert (len(raised), len(by_kind["error"])) == (1, 3)
    assert raised[0].text == "SystemExit: this plant cannot be moved"
    assert 'truth.py", line 14, in fail' in raised[0].traceback
    assert cluster.processes["first"].poll() is cluster.processes["second"].poll() is None


def test_a_log_comes_back_whole_and_names_the_files_of_the_client(
    experiment: Path, cluster: DaskCluster, tmp_path: Path
) -> None:
    made = make(experiment, tmp_path, on(cluster, experiment, []), "fine")
    (log,) = (tmp_path / "logs").iterdir()
    run = read_run(log)
    assert run.config.plant.truth == f"{experiment.parent}/truth.py:STEEP"
    assert replay(run).equal
    text = msgspec.json.encode(list(made.records.values())).decode() + json.dumps(
        [info.config for info in run.run_infos]
    )
    assert str(cluster.folder) not in text
