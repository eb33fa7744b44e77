"""The table of rates has the measured figures and is written only between its marks."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.document_block import conditions
from benchmarks.live import rates
from benchmarks.live.rates import COLUMNS, MARKS, Rates


def test_a_document_without_marks_does_not_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "rates.md"
    page.write_text("nothing here\n")
    assert rates.main(Rates(document=page)) == 2
    assert page.read_text() == "nothing here\n"
    assert MARKS.begin in capsys.readouterr().err


def test_the_table_goes_between_the_marks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "rates.md"
    page.write_text(f"before\n{MARKS.begin}\nold\n{MARKS.end}\nafter\n")
    row = ["x"] * len(COLUMNS)
    monkeypatch.setattr(rates, "_row", lambda _settings, _rate, _mode, _log: row)
    assert rates.main(Rates(rates=(20, 1000), document=page)) == 0
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert text.count(f"| {' | '.join(row)} |") == 4
    assert text.partition(MARKS.begin)[2].partition(MARKS.end)[0].strip() == capsys.readouterr().out.strip()


def test_the_command_is_a_block_and_the_machine_a_wrapped_paragraph() -> None:
    note = "A training has 300 steps. " * 9
    fence, command, end, empty, *paragraph = conditions("python -m benchmarks.live.rates", note.strip())
    assert (fence, command, end, empty) == ("```", "python -m benchmarks.live.rates", "```", "")
    assert " ".join(paragraph).endswith(note.strip())
    assert len(paragraph) > 1
    assert max(len(line) for line in paragraph) <= 120
