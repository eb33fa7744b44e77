"""Draw a live run: `render` for a terminal, `line` for other outputs. Pure: data in, text out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Column, Table
from rich.text import Text

from run_log.reporting.summary import ADDS_NOTHING
from tandem.live.snapshot import Event, Gauge, ProcessRow, Snapshot

NARROW = 76
FIGURES = 9
BARS = "▁▂▃▄▅▆▇█"
# Shown before the others, and in this order.
COUNTERS = ("ticks", "messages", "samples", "trainings", "published")
TROUBLE = ("bad_", "bulk_overflow", "overflow_", "not_sent_", "write_errors", "dropped", "user_dropped")
DULL = ("sent_control", "sent_bulk")

STATUS_STYLE = {
    "running": "green",
    "ready": "green",
    "starting": "yellow",
    "stopping": "yellow",
    "silent": "bold yellow",
    "no message": "dim",
    "not configured": "dim",
    "failed": "bold red",
    "ended": "bold red",
}
EVENT_STYLE = {"note": "default", "good": "green", "bad": "bold red"}


def render(now: Snapshot, width: int, height: int) -> RenderableType:
    """The whole view in `width` by `height` cells; leaves out the least important parts if there is no room."""
    loop, learning = _panel("loop", _loop(now)), _panel("learning", _learning(now, width // 2))
    # With the height of each, the most important first.
    parts: list[tuple[RenderableType, int]] = [
        (_heading(now, width), 1),
        (_panel("states and input", _gauges(now, width - 4)), len(now.states) + len(now.inputs) + 2),
    ]
    if width < NARROW:
        parts += [(loop, FIGURES + 2), (learning, FIGURES + 2)]
    else:
        both = Table.grid(Column(ratio=1), Column(ratio=1), expand=True)
        both.add_row(loop, learning)
        parts.append((both, FIGURES + 2))
    parts.append((_panel("processes", _processes(now.processes)), len(now.processes) + 2))
    shown: list[RenderableType] = []
    for part, rows in parts:
        if rows <= height:
            shown.append(part)
            height -= rows
    if height >= 3 and now.events:
        shown.append(_panel("events", _events(now.events[-(height - 2) :])))
    return Group(*shown)


def line(now: Snapshot) -> str:
    """The same as one line of plain text."""
    if now.elapsed is None:
        return f"waiting for {now.phase or 'the first command'}: " + ", ".join(
            f"{p.name} {p.status}" for p in now.processes
        )
    parts = [
        f"{now.elapsed:6.1f} s",
        " ".join(f"{g.name} {_number(g)}" for g in (*now.states, *now.inputs)),
        f"{now.ticks} ticks, {now.late} late",
    ]
    if now.solve_ms:
        parts.append(f"solve p50 {now.solve_ms[0]:.1f} p99 {now.solve_ms[1]:.1f} ms")
    if now.prediction_error is not None:
        parts.append(f"error {now.prediction_error:.1e}")
    if now.adds_nothing:
        parts.append(ADDS_NOTHING)
    if now.noise is not None:
        parts.append(f"noise {_noise(now.noise)}")
    parts.append(
        f"weights {_version(now)} ({now.adopted} adopted, {now.refused} refused, {now.rolled_back} rolled back)"
    )
    if now.set_margin is not None:
        parts.append(_sets(now)[0])
    if now.reference:
        parts.append(f"set-point {_set_point(now)}")
    parts.append(now.mode + (f", slack {now.slack:.1e}" if now.slack else ""))
    parts += now.sensor_faults.values()
    if now.phase:
        parts.append(f"waiting for {now.phase}")
    troubled = [f"{p.name} {p.status}" for p in now.processes if p.status not in ("running", "ready")]
    return " | ".join(parts + troubled)


def _sets(now: Snapshot) -> tuple[str, str]:
    """Position of the state relative to the certified sets, in words, and the style."""
    if now.set_margin is None:
        return "none in force", "dim"
    if now.set_margin < 0.0:
        return f"OUTSIDE the sets by {-now.set_margin:.2g}", "bold red"
    return f"in set {now.set_piece}, margin {now.set_margin:.2g}", "default"


RESTS = {"nearest": "; out of reach, at the nearest steady state", "no rest": "; no steady state was found"}
"""Text about a target whose outputs are not at their reference."""


def _set_point(now: Snapshot) -> str:
    """Reference of the outputs, their distance from it, and whether the plant has a steady state there."""
    if not now.reference:
        return "the equilibrium"
    at = {gauge.name: gauge.value for gauge in now.states}
    parts = []
    for name, r in now.reference.items():
        x = at.get(name)
        parts.append(f"{name} {r:.4g}" + ("" if x is None else f", off by {abs(x - r):.2g}"))
    return f"{'; '.join(parts)}{RESTS.get(now.target_status, '')}"


def _panel(title: str, body: RenderableType) -> Panel:
    return Panel(body, title=title, title_align="left", border_style="dim", padding=(0, 1))


def _heading(now: Snapshot, width: int) -> Text:
    config = now.config
    about = f"{now.plant.name}, {config.controller.oracle}, {config.rate:g} Hz"
    left = Text.assemble((" Tandem ", "bold reverse"), f" {config.name}  ", (about, "dim"))
    if now.phase or now.elapsed is None:
        right = Text(f"waiting for {now.phase or 'the first command'} ", "yellow")
    elif math.isinf(now.seconds):
        right = Text(f"{now.elapsed:.1f} s, until Ctrl-C ")
    else:
        elapsed = min(now.elapsed, now.seconds)
        cells = max(0, min(30, width - left.cell_len - 22))
        done = round(cells * elapsed / now.seconds)
        right = Text.assemble(
            ("━" * done, "cyan"), ("━" * (cells - done), "dim"), f" {elapsed:5.1f} / {now.seconds:g} s "
        )
    left.append(" " * max(1, width - left.cell_len - right.cell_len))
    left.append_text(right)
    left.truncate(width)
    return left


def _gauges(now: Snapshot, width: int) -> Table:
    right, dim = Column(justify="right"), Column(style="dim")
    low = Column(justify="right", style="dim")
    table = Table.grid(Column(style="bold"), right, low, Column(), dim, dim.copy(), padding=(0, 1))
    roomy = width >= NARROW
    cells = width - (46 if roomy else 30)
    for gauge in (*now.states, *now.inputs):
        table.add_row(
            gauge.name,
            Text(_number(gauge), _gauge_style(gauge)),
            f"{gauge.low:.4g}",
            _bar(gauge, cells) if cells >= 8 else "",
            f"{gauge.high:.4g}",
            _beside(gauge, now.sensor_faults) if roomy else "",
        )
    return table


def _beside(gauge: Gauge, faults: Mapping[str, str]) -> Text:
    if gauge.name in faults:
        return Text("not trusted", "bold red")
    return Text("" if gauge.value is None else f"off by {gauge.value - gauge.target:+.4f}")


def _number(gauge: Gauge) -> str:
    return "-" if gauge.value is None else f"{gauge.value:.4f}"


def _gauge_style(gauge: Gauge) -> str:
    if gauge.value is None:
        return "dim"
    margin = min(gauge.value - gauge.low, gauge.high - gauge.value) / (2 * gauge.scale)
    if margin < -1e-6:
        return "bold red"
    if margin < 0.05:
        return "bold yellow"
    return "green" if abs(gauge.value - gauge.target) <= 0.04 * gauge.scale else "default"


def _bar(gauge: Gauge, cells: int) -> Text:
    """low ├────┼───●───┤ high; ┼ is the target, and an end without a bound is ╌."""
    bounded = math.isfinite(gauge.low), math.isfinite(gauge.high)
    low = gauge.low if bounded[0] else gauge.target - gauge.scale
    high = gauge.high if bounded[1] else gauge.target + gauge.scale

    def cell(value: float) -> int:
        return round((cells - 1) * (value - low) / (high - low))

    marks = ["─"] * cells
    marks[0], marks[-1] = "├" if bounded[0] else "╌", "┤" if bounded[1] else "╌"
    marks[min(max(cell(gauge.target), 0), cells - 1)] = "┼"
    text = Text("".join(marks), "dim")
    if gauge.value is None or not math.isfinite(gauge.value):
        return text
    at = cell(gauge.value)
    mark = "◀" if at < 0 else "▶" if at >= cells else "●"
    at = min(max(at, 0), cells - 1)
    return Text.assemble(text[:at], (mark, _gauge_style(gauge)), text[at + 1 :])


def _pairs(rows: Sequence[tuple[str, RenderableType]]) -> Table:
    table = Table.grid(Column(style="dim", no_wrap=True), Column(no_wrap=True), padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    return table


def _counted(count: int, what: str, style: str = "bold yellow") -> Text:
    return Text(f"{count} {what}", style if count else "default")


def _loop(now: Snapshot) -> Table:
    rate = "-" if now.measured_rate is None else f"{now.measured_rate:.2f} Hz"
    source: dict[str, str | Text] = {
        "hold": "held at x0",
        "command": "follows commands",
        "plan": Text("follows the last plan", "bold yellow"),
        "safe": Text("its own safe input", "bold red"),
        "manual": Text("under manual control", "bold yellow"),
    }
    mode = now.mode or "-", "default" if now.mode in ("", "solver") else "bold red"
    slack = f"{now.slack:.1e} {now.slack_row}" if now.slack else "none"
    return _pairs(
        [
            ("ticks", Text(f"{now.ticks}   {rate}")),
            ("punctual", Text.assemble(_counted(now.late, "late"), "   ", _counted(now.skipped, "skipped"))),
            ("solve", _milliseconds(now.solve_ms)),
            ("tick", _milliseconds(now.tick_ms)),
            ("mode", Text.assemble(mode, "   ", _counted(now.fallback, "fallback"))),
            ("slack", Text.assemble(slack, "   ", _counted(now.soft, "soft ticks"))),
            ("sets", Text.assemble(_sets(now), "   ", _counted(now.outside, "ticks outside", "bold red"))),
            ("set-point", Text(_set_point(now), "dim" if not now.reference else "default")),
            ("plant", source.get(now.source, now.source or "-")),
        ]
    )


def _milliseconds(values: tuple[float, float] | None) -> str:
    return "-" if values is None else f"p50 {values[0]:.2f} ms   p99 {values[1]:.2f} ms"


def _version(now: Snapshot) -> str:
    return "initial" if now.weights_version <= 0 else str(now.weights_version)


def _learning(now: Snapshot, width: int) -> Table:
    error = "-" if now.prediction_error is None else f"{now.prediction_error:.2e}"
    loss = "-" if now.loss is None else f"{now.loss[0]:.2e} → {now.loss[1]:.2e}"
    return _pairs(
        [
            ("pred. error", Text.assemble(error, "   ", _weight(now))),
            ("each second", spark(now.trend, max(4, width - 18))),
            ("weights", Text(f"version {_version(now)}   {now.adopted} adopted")),
            ("refused", _counted(now.refused, "sets")),
            ("rolled back", _counted(now.rolled_back, "sets")),
            ("loss", Text(loss)),
            ("buffer", Text(f"{now.samples} samples")),
            ("bad messages", _counted(now.bad_messages, "ignored")),
            *([] if now.noise is None else [("noise found", Text(_noise(now.noise)))]),
        ]
    )


def _noise(found: Mapping[str, float]) -> str:
    return " ".join(f"{name} {one:.2g}" for name, one in found.items())


def _weight(now: Snapshot) -> tuple[str, str]:
    """Weights of h_hat in words, and their style."""
    if now.counts is None:
        return "", "default"
    return ("adds nothing", "bold yellow") if now.adds_nothing else (f"counts {now.counts:.0%}", "default")


def spark(values: Sequence[float], cells: int) -> Text:
    """The last `cells` values as bars, on a logarithmic scale over their own range."""
    shown = [math.log10(max(value, 1e-12)) for value in values[-cells:]]
    if not shown:
        return Text("-")
    low, high = min(shown), max(shown)
    steps = [0.0 if high == low else (value - low) / (high - low) for value in shown]
    return Text("".join(BARS[min(7, int(8 * step))] for step in steps), "cyan")


def _processes(rows: Sequence[ProcessRow]) -> Table:
    name, rest = Column(style="bold", no_wrap=True), Column(no_wrap=True, ratio=1)
    table = Table.grid(name, Column(no_wrap=True), rest, padding=(0, 2), expand=True)
    for row in rows:
        calm = row.status in ("running", "ready")
        trouble, usual = _counters(row.counters)
        words = [Text(f"{_words(name)} {row.counters[name]}", "bold yellow") for name in trouble]
        words += [Text(row.note, "default" if calm else "yellow")] if row.note else []
        words += [Text(f"{_words(name)} {row.counters[name]}", "dim") for name in usual]
        status = Text(row.status, STATUS_STYLE.get(row.status, "default"))
        table.add_row(row.name, status, Text(", ").join(words))
    return table


def _words(counter: str) -> str:
    return counter.replace("_", " ")


def _counters(counters: dict[str, int]) -> tuple[list[str], list[str]]:
    """Counters that are not zero: expected ones, and then the others, the most important first."""
    counted = sorted(name for name in counters if counters[name])
    trouble = [name for name in counted if name.startswith(TROUBLE)]
    rest = [name for name in counted if name not in (*trouble, *COUNTERS, *DULL)]
    return trouble, [name for name in (*COUNTERS, *rest, *DULL) if name in counted]


def _events(events: Sequence[Event]) -> Table:
    when = Column(justify="right", style="dim", no_wrap=True)
    table = Table.grid(when, Column(no_wrap=True, ratio=1), padding=(0, 2), expand=True)
    for event in events:
        at = "" if event.at < 0 else f"{event.at:.1f} s"
        table.add_row(at, Text(event.text, EVENT_STYLE[event.weight]))
    return table
