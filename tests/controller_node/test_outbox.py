"""The ring of samples: it answers like a list, allocates its memory at the first sample, and answers queries."""

from __future__ import annotations

import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller_node.outbox import BATCH, Outbox
from protocol import codec, topics
from protocol.messages import Sample, Samples


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
def test_since_returns_the_newest_samples_after_a_number(
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


def test_the_memory_does_not_grow_with_time() -> None:
    outbox = Outbox("run", 2000)
    outbox.add(sample(0))
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for seq in range(1, 6000):
        outbox.add(sample(seq))
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Two thousand `Sample` objects would take over a megabyte.
    assert after - before < 20_000


def seqs(answer: list[bytes]) -> list[int]:
    batches = [codec.decode(topics.SAMPLES, payload) for payload in answer]
    assert all(isinstance(batch, Samples) and batch.seq == batch.samples[-1].seq for batch in batches)
    return [one.seq for batch in batches if isinstance(batch, Samples) for one in batch.samples]


def test_the_outbox_returns_the_newest_of_the_later_samples() -> None:
    outbox = Outbox("controller-a", capacity=1500)
    assert outbox.answer({}) == []
    for seq in range(0, 4000, 2):
        outbox.add(sample(seq))
    assert seqs(outbox.answer({})) == list(range(1000, 4000, 2))
    assert seqs(outbox.answer({"since": "3990"})) == [3992, 3994, 3996, 3998]
    assert seqs(outbox.answer({"since": "3991", "last": "2"})) == [3996, 3998]
    assert seqs(outbox.answer({"run": "controller-a", "since": "", "last": "3"})) == [3994, 3996, 3998]
    assert outbox.answer({"run": "controller-b"}) == []
    assert outbox.answer({"since": "3998"}) == []
    assert outbox.answer({"last": "0"}) == []
    assert max(len(batch.samples) for batch in outbox.batches(outbox.since(-1))) == BATCH


@pytest.mark.parametrize("parameters", [{"since": "seven"}, {"last": "1.5"}, {"sinse": "7"}])
def test_a_wrong_query_to_the_outbox_gives_a_readable_error(parameters: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"whole number|unknown parameter 'sinse'"):
        Outbox("controller-a").answer(parameters)
