"""Cut, damaged and edited logs, and files that are not logs: the readable part, the message, and `recover`."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from run_log.errors import LogError, LogExistsError
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from tests.run_log.samples import Logged, logged, payloads

# -- damaged files ---------------------------------------------------------------------------------------


def test_a_cut_file_is_read_up_to_the_cut(whole: Path, messages: list[Logged], tmp_path: Path) -> None:
    data, expected = whole.read_bytes(), payloads(messages)
    cut = tmp_path / "cut.mcap"
    counts, unreadable = [], []
    for end in [*range(0, len(data), len(data) // 60), len(data) - 1]:
        cut.write_bytes(data[:end])
        try:
            run = read_run(cut)
        except LogError:
            unreadable.append(end)  # cut before the configuration
            continue
        assert run.truncated
        assert f"of {end}" in run.note
        assert "tandem recover" in run.note
        for name, entries in run.streams.items():
            found = [entry.payload for entry in entries]
            assert found == expected[name][: len(found)]
        counts.append(sum(map(len, run.streams.values())))
    assert max(unreadable) < 20_000
    assert counts == sorted(counts)
    assert counts[-1] == len(messages)


@pytest.mark.long
def test_any_flipped_bit_is_found(whole: Path, tmp_path: Path) -> None:
    data = whole.read_bytes()
    edited = tmp_path / "edited.mcap"
    rng = np.random.default_rng(1)
    places = {*range(80), *range(len(data) - 120, len(data)), *rng.integers(0, len(data), 80).tolist()}
    for place in sorted(places):
        changed = bytearray(data)
        changed[place] ^= 1 << int(rng.integers(8))
        edited.write_bytes(changed)
        with pytest.raises(LogError) as caught:
            read_run(edited)
        assert str(edited) in str(caught.value)


def test_damage_is_reported_with_its_place_and_a_remedy(whole: Path, tmp_path: Path) -> None:
    edited = tmp_path / "edited.mcap"
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 4
    edited.write_bytes(data)
    with pytest.raises(LogError, match=r"damaged or edited at byte \d+.*tandem recover"):
        read_run(edited)


def test_foreign_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    cases = {
        b"": "is empty",
        b"PK\x03\x04 and so on": "not an MCAP file",
        b"\x89MCAP0\r\n": "contains no message",
    }
    for data, said in cases.items():
        path.write_bytes(data)
        with pytest.raises(LogError, match=said):
            read_run(path)
    for profile in ("", "ros2"):
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile=profile)
            writer.finish()
        with pytest.raises(LogError, match="not a log of Tandem"):
            read_run(path)
        with pytest.raises(LogError, match="not a log of Tandem"):
            recover(path, tmp_path / "out.mcap")
    with pytest.raises(LogError, match="cannot be read: No such file"):
        read_run(tmp_path / "nowhere.mcap")
    with pytest.raises(LogError, match="cannot be read"):
        read_run(tmp_path)


def test_a_chunk_with_a_wrong_size_uses_no_extra_memory(whole: Path, tmp_path: Path) -> None:
    """A chunk that states an unpacked size of 2^62 bytes."""
    data = bytearray(whole.read_bytes())
    struct.pack_into("<Q", data, chunks(data)[0] + 9 + 16, 2**62)
    path = tmp_path / "liar.mcap"
    path.write_bytes(data)
    with pytest.raises(LogError, match="chunk"):
        read_run(path)


# -- recover ---------------------------------------------------------------------------------------------


def test_recover_makes_a_cut_file_whole(whole: Path, tmp_path: Path) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    saved = recover(cut, out)
    before, after = read_run(cut), read_run(out)
    assert logged(out) == logged(cut)
    assert before.truncated
    assert not after.truncated
    assert after.recovered
    assert after.attachments == before.attachments
    assert saved.messages == sum(map(len, before.streams.values()))
    assert saved.lost_bytes > 0
    with out.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        views = [c.topic for _, c, _ in reader.iter_messages() if c.topic.startswith("view/")]
        assert views
    assert cut.read_bytes() == data[: len(data) * 2 // 3]


def test_recover_overwrites_nothing_and_leaves_whole_files_alone(whole: Path, tmp_path: Path) -> None:
    assert recover(whole, tmp_path / "none.mcap").log is None
    assert not (tmp_path / "none.mcap").exists()
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    cut.write_bytes(whole.read_bytes()[:-1000])
    out.write_bytes(b"mine")
    with pytest.raises(LogExistsError):
        recover(cut, out)
    assert out.read_bytes() == b"mine"
    with pytest.raises(LogExistsError):
        recover(cut, cut)


def chunks(data: bytes | bytearray) -> list[int]:
    """Return the positions at which the chunk records begin."""
    found, position = [], 8
    while data[position] != 0x0F:  # the end of the data
        if data[position] == 6:
            found.append(position)
        position += 9 + struct.unpack_from("<Q", data, position + 1)[0]
    return found


@pytest.mark.parametrize("which", [0, 4, -1])
def test_recover_saves_what_is_around_the_damage(whole: Path, tmp_path: Path, which: int) -> None:
    """The damaged chunk may also be the first one, which declares the channels."""
    data = bytearray(whole.read_bytes())
    data[chunks(data)[which] + 200] ^= 1
    edited, out = tmp_path / "edited.mcap", tmp_path / "out.mcap"
    edited.write_bytes(data)
    saved = recover(edited, out)
    assert len(saved.damage) >= 1
    count = sum(map(len, read_run(whole).streams.values()))
    assert 0.5 * count < saved.messages < count
    assert sum(map(len, read_run(out).streams.values())) == saved.messages
