"""The ring of samples answers what a list of them would, and takes its memory at the first one."""

from __future__ import annotations

import tracemalloc

from hypothesis import given
from hypothesis import strategies as st

from controller_node.outbox import Outbox
from protocol.messages import Sample


def sample(seq: int, pairs: int = 1) -> Sample:
    past = [[seq + 0.1 * k, 1.0, 2.0] for k in range(pairs - 1)]
    return Sample(seq, [seq + 0.5, -1.0], [0.25], [1e-3 * seq, 3.0], past)


@given(
    steps=st.lists(st.integers(1, 4), max_size=40),
    since=st.integers(-2, 90),
    last=st.integers(0, 12),
    capacity=st.integers(1, 10),
    pairs=st.integers(1, 3),
)
def test_the_newest_after_a_number(
    steps: list[int], since: int, last: int, capacity: int, pairs: int
) -> None:
    outbox, told, seq = Outbox("run", capacity), [], -1
    for step in steps:
        seq += step
        told.append(sample(seq, pairs))
        outbox.add(told[-1])
    wanted = [one for one in told[-capacity:] if one.seq > since]
    assert outbox.since(since, last) == wanted[len(wanted) - min(last, len(wanted)) :]
    assert outbox.since(since) == wanted


def test_a_controller_that_runs_for_hours_needs_no_more_memory() -> None:
    outbox = Outbox("run", 2000)
    outbox.add(sample(0))
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for seq in range(1, 6000):
        outbox.add(sample(seq))
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Two thousand Samples would be over a megabyte.
    assert after - before < 20_000
