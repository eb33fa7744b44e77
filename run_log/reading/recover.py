"""Write a complete copy of a log that was cut off or damaged, with all intact records."""

from __future__ import annotations

from pathlib import Path

import msgspec
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema

from node_runtime.config.strict import readable
from run_log.errors import LogError
from run_log.file_format import RAW, RECOVERED, check_header
from run_log.reading.mcap_scan import Scan
from run_log.writing.durable_file import Sink, mcap_writer

CHUNK_BYTES = 256 * 1024


class Recovery(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a recovery. `log` is null if the file was complete and no new one was made."""

    source: str
    log: str | None
    messages: int
    """Number of messages (views are not counted)."""
    attachments: int
    seconds: float
    """Duration from the first to the last recovered message."""
    cut_at: int | None
    """Byte at which the source was cut off; null if it was not."""
    lost_bytes: int
    """Bytes of the incomplete record at the cut."""
    damage: list[str]
    """Parts with a wrong checksum, which were left out."""


def recover(path: str | Path, out: str | Path) -> Recovery:
    """Copy all intact records of `path` to the new file `out`, with an index.

    Raises:
        LogExistsError: `out` exists already.
        LogError: `path` is unreadable, not a log of Tandem, or empty; `out` cannot be written.
    """
    path, out = Path(path), Path(out)
    probe = Scan(path, keep_going=True)
    header: Header | None = None
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    stamps: list[tuple[int, int]] = []
    attachments = 0
    for record in probe:
        match record:
            case Header():
                header = header or record
                check_header(path, record)
            case Attachment():
                attachments += 1
            case Schema():
                schemas.setdefault(record.id, record)
            case Channel():
                channels.setdefault(record.id, record)
            case Message():
                stamps.append((record.channel_id, record.log_time))
    times = [time for i, time in stamps if i in channels and channels[i].topic.startswith(RAW)]
    if header is None or (not times and not attachments):
        raise LogError(f"{path}: contains no message; there is nothing to recover")
    whole = probe.cut_at is None and not probe.damage
    if not whole:
        _copy(probe, out, header, schemas, channels)
    return Recovery(
        source=str(path),
        log=None if whole else str(out),
        messages=len(times),
        attachments=attachments,
        seconds=(max(times) - min(times)) * 1e-9 if times else 0.0,
        cut_at=probe.cut_at,
        lost_bytes=0 if probe.cut_at is None else probe.size - probe.cut_at,
        damage=probe.damage,
    )


def _copy(
    probe: Scan, out: Path, header: Header, schemas: dict[int, Schema], channels: dict[int, Channel]
) -> None:
    sink = Sink(out)
    writer = mcap_writer(sink, CHUNK_BYTES)
    writer.start(header.profile, header.library)
    reason = "whole" if probe.cut_at is None else f"cut at byte {probe.cut_at}"
    writer.add_metadata(
        RECOVERED, {"from": readable(probe.path.name), "because": "; ".join([reason, *probe.damage])}
    )
    new_schemas = {
        schema.id: writer.register_schema(schema.name, schema.encoding, schema.data)
        for schema in schemas.values()
    }
    new_channels = {
        channel.id: writer.register_channel(
            channel.topic, channel.message_encoding, new_schemas.get(channel.schema_id, 0), channel.metadata
        )
        for channel in channels.values()
    }
    for record in Scan(probe.path, keep_going=True):
        match record:
            case Attachment():
                writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Message() if record.channel_id in channels:
                writer.add_message(
                    new_channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
                sink.flush()
    writer.finish()
    if not sink.close():
        raise LogError(f"{sink.error}; {out} is incomplete")
