"""The log of a run: topics and records of interface.md into an MCAP file, whole blocks at a time.

Used by the recorder process, by `simulate` and by `replay --out`. Log time is the end of the tick, publish time the
scheduled tick, both in ns since the Unix epoch. Not thread-safe. See docs/log.md.
"""

import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import zstandard
from mcap.records import Channel, Schema

from hilrunner import __version__
from hilrunner.base import records
from hilrunner.record import chunk, schemas
from hilrunner.record.mcap_file import McapFile

CHUNK_SIZE_BYTES = 1 << 20  # pending bytes that close a chunk
BLOCK_SIZE_BYTES = 1 << 14  # of a chunk, before compression: some two dozen ticks of one axis
COMPRESSION_LEVEL = 1  # zstd; measured on ticks with frames: level 3 costs a third more time for 2 % fewer bytes


class LogWriter:
    """Writes one run.

    Args:
        path: the file; created or emptied. Raises LogError when it cannot be written.
        axis_names: one name an axis, in the order of the COMMAND and STATE records.
        can_data_size: 8 (classic) or 64 (FD) bytes in a logged frame.
        metadata: table name -> {key: text}, written at once; `close` may replace tables.
        attachments: (name, media type, data) of files to keep inside the log.
    """

    verdict = None  # a log is judged by who reads it

    def __init__(
        self,
        path: str | Path,
        axis_names: Sequence[str],
        can_data_size: int = 8,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Sequence[tuple[str, str, bytes]] = (),
    ) -> None:
        self.axis_count = len(axis_names)
        self._file = McapFile(path, f"hilrunner {__version__}")
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._blocks: list[chunk.Block] = []
        self._pending_bytes = 0
        self._compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL)
        self.write_stall_ns_max = 0
        can_frame = records.can_frame_record(can_data_size)
        self.add_topic("/rt/tick", "Tick", records.TICK)
        for name in axis_names:
            self.add_topic(f"/{name}/command", "Command", records.COMMAND)
            self.add_topic(f"/{name}/state", "State", records.STATE)
            self.add_topic(f"/{name}/check", "Check", records.CHECK)
        self.add_topic("/rt/miss", "Miss", records.MISS)
        self.add_topic("/rt/statistics", "Statistics", records.STATISTICS)
        self.add_topic("/can/rx", "CanFrame", can_frame)
        self.add_topic("/can/tx", "CanFrame", can_frame)
        self._add_channel("/log", schemas.LOG_SCHEMA_NAME, schemas.LOG_SCHEMA_TEXT)
        self._axis_names = tuple(axis_names)
        for name, values in (metadata or {}).items():
            self._file.add_metadata(name, {key: str(value) for key, value in values.items()})
        for name, media_type, data in attachments:
            self.add_attachment(name, media_type, data)
        self._file.end_of_head()

    @property
    def path(self) -> Path:
        """Where the log is written."""
        return self._file.path

    @property
    def size_bytes(self) -> int:
        """Bytes in the file so far."""
        return self._file.size_bytes

    def is_in_place(self) -> bool:
        """Whether the file still stands under its name."""
        return self._file.is_in_place()

    @property
    def lost_bytes(self) -> int:
        """Bytes (as stored) the disk refused."""
        return self._file.lost_bytes

    @property
    def lost_messages(self) -> int:
        """Messages in what the disk refused."""
        return self._file.lost_messages

    def message_counts(self) -> dict[str, int]:
        """Messages in the file by topic, without those still pending."""
        counts = self._file.message_counts()
        return {topic: counts.get(channel, 0) for topic, channel in self._channel_ids.items()}

    def add_topic(self, topic: str, message: str, dtype: np.dtype) -> None:
        """Declare a topic of `base.records`-like records; `message` names its schema `hilrunner/msg/<message>`."""
        self._add_channel(topic, f"hilrunner/msg/{message}", schemas.schema_text(message, dtype))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Keep a file inside the log."""
        self._file.add_attachment(name, media_type, data, time.time_ns())

    def write_records(self, topic: str, payload: np.ndarray, log_real_ns, publish_real_ns) -> None:
        """Add records (n,) of the topic's layout; times (n,) or scalar int64 ns since the Unix epoch."""
        self._add(topic, payload, log_real_ns, publish_real_ns)
        self._close_full_chunk()

    def _add(self, topic: str, payload: np.ndarray, log_real_ns, publish_real_ns) -> None:
        if len(payload) == 0:
            return
        channel = self._channel_ids[topic]
        block = chunk.build_block(channel, self._sequences[channel], payload, log_real_ns, publish_real_ns)
        self._sequences[channel] += len(payload)
        self._blocks.append(block)
        self._pending_bytes += block.messages.nbytes

    def _close_full_chunk(self) -> None:
        if self._pending_bytes >= CHUNK_SIZE_BYTES:
            self.flush()

    def write_ticks(
        self, tick: np.ndarray, command: np.ndarray, state: np.ndarray, start_mono_ns: int, start_real_ns: int
    ) -> None:
        """Add periods: tick (n,) TICK, command and state (n * axis_count,) with the axes of a tick side by side."""
        offset_ns = start_real_ns - start_mono_ns
        log_real_ns = tick["end_mono_ns"] + offset_ns
        publish_real_ns = tick["deadline_mono_ns"] + offset_ns
        self._add("/rt/tick", tick, log_real_ns, publish_real_ns)
        for axis, name in enumerate(self._axis_names):
            of_axis = slice(axis, None, self.axis_count)
            self._add(f"/{name}/command", command[of_axis], log_real_ns, publish_real_ns)
            self._add(f"/{name}/state", state[of_axis], log_real_ns, publish_real_ns)
        self._close_full_chunk()  # only here: a chunk holds whole ticks

    def write_check(self, axis_name: str, check: np.ndarray, log_real_ns, publish_real_ns) -> None:
        """Add cross-check records (n,) CHECK of one axis, with the times of the ticks they belong to."""
        self.write_records(f"/{axis_name}/check", check, log_real_ns, publish_real_ns)

    def write_miss(self, miss: np.ndarray, start_real_ns: int, period_ns: int) -> None:
        """Add misses (n,) MISS; a missed tick ended its lateness after the end of its period."""
        publish_real_ns = start_real_ns + miss["tick"].astype(np.int64) * period_ns
        self.write_records("/rt/miss", miss, publish_real_ns + period_ns + miss["lateness_ns"], publish_real_ns)

    def write_can(self, can: np.ndarray, start_mono_ns: int, start_real_ns: int) -> None:
        """Add frames (n,) of can_frame_record: received and sent to their topics; publish time is the kernel's stamp."""
        log_real_ns = can["mono_ns"] + (start_real_ns - start_mono_ns)
        publish_real_ns = np.where(can["kernel_real_ns"] > 0, can["kernel_real_ns"], log_real_ns)
        sent = (can["flags"] & records.CAN_FRAME_SENT) != 0
        for topic, chosen in (("/can/rx", ~sent), ("/can/tx", sent)):
            self.write_records(topic, can[chosen], log_real_ns[chosen], publish_real_ns[chosen])

    def write_statistics(self, statistics: np.ndarray, log_real_ns: int, publish_real_ns: int) -> None:
        """Add statistics (n,) STATISTICS."""
        self.write_records("/rt/statistics", statistics, log_real_ns, publish_real_ns)

    def write_log(self, level: int, name: str, text: str, real_ns: int) -> None:
        """Add an event in words (LOG_LEVEL_*), as Foxglove's log panel shows it."""
        payload = np.array([log_message(level, name, text, real_ns)], dtype=np.void)
        self.write_records("/log", payload, real_ns, real_ns)

    def flush(self) -> None:
        """Close the pending chunk, if any, and give it to the system."""
        if not self._blocks:
            return
        begin_ns = time.monotonic_ns()
        data, pairs = chunk.assemble(self._blocks)
        times = [b.messages["log_real_ns"] for b in self._blocks]
        self._file.add_chunk(
            compressed=self._compress(data),
            compression="zstd",
            uncompressed_size=len(data),
            uncompressed_crc=zlib.crc32(data),
            message_indexes={channel: index.tobytes() for channel, index in pairs.items()},
            message_counts={channel: len(index) for channel, index in pairs.items()},
            start_real_ns=int(min(t.min() for t in times)),
            end_real_ns=int(max(t.max() for t in times)),
        )
        self._blocks.clear()
        self._pending_bytes = 0
        self.write_stall_ns_max = max(self.write_stall_ns_max, time.monotonic_ns() - begin_ns)

    def _compress(self, data: np.ndarray) -> bytes:
        """One Zstandard frame in short blocks: of a file cut inside a chunk every block before the cut can be read."""
        stream = self._compressor.compressobj(size=len(data))
        parts = []
        for start in range(0, len(data), BLOCK_SIZE_BYTES):
            parts.append(stream.compress(data[start : start + BLOCK_SIZE_BYTES]))
            if start + BLOCK_SIZE_BYTES < len(data):
                parts.append(stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
        parts.append(stream.flush())
        return b"".join(parts)

    def close(self, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Finish the file; tables given here stand beside earlier ones of the same name and replace them for a reader."""
        self.flush()
        for name, values in (metadata or {}).items():
            self._file.add_metadata(name, {key: str(value) for key, value in values.items()})
        self._file.close()

    def _add_channel(self, topic: str, schema_name: str, text: str) -> None:
        if schema_name not in self._schema_ids:
            schema_id = len(self._schema_ids) + 1
            self._file.add_schema(Schema(id=schema_id, data=text.encode(), encoding="ros2msg", name=schema_name))
            self._schema_ids[schema_name] = schema_id
        channel = len(self._channel_ids) + 1
        self._file.add_channel(
            Channel(
                id=channel, topic=topic, message_encoding="cdr", metadata={}, schema_id=self._schema_ids[schema_name]
            )
        )
        self._channel_ids[topic] = channel
        self._sequences[channel] = 0


def log_message(level: int, name: str, text: str, real_ns: int) -> bytes:
    """CDR of rcl_interfaces/msg/Log: strings with length and closing zero, 4-byte aligned."""
    out = bytearray(bytes(records.CDR_HEADER) + struct.pack("<iIB", real_ns // 10**9, real_ns % 10**9, level))
    for value in (name, text, "", ""):
        encoded = value.encode() + b"\0"
        out += b"\0" * (-len(out) % 4) + struct.pack("<I", len(encoded)) + encoded
    return bytes(out + b"\0" * (-len(out) % 4) + struct.pack("<I", 0))
