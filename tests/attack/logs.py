"""Hostile logs: made to fill the memory of whoever reads them, to keep him busy for ever, or to write on his terminal.

Every maker takes a generator of random numbers and a folder, and returns the path of one log. All are small files (at most some
megabytes, or sparse) and most are sound by their checksums.
"""

import json
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

from hilrunner.base import records
from hilrunner.base.records import MESSAGE_OFFSET
from hilrunner.record.mcap_log import LogWriter
from hilrunner.record.schemas import schema_text
from tests.attack import mcap_raw as raw
from tests.attack.campaign import Attempt, Campaign, Tried
from tests.attack.outcome import call
from tests.attack.source import eventful_log, warm_up
from tests.tools import bench_run, synthetic_run

EVIL = "\x1b]0;owned\x07\x1b[2J\r\nverdict: passed\u202egnp"
SECRET = "secret-line-of-another-file"
_TICK = raw.schema(1, "hilrunner/msg/Tick", schema_text("Tick", records.TICK)) + raw.channel(1, 1, "/rt/tick")
_STATE = raw.schema(2, "hilrunner/msg/State", schema_text("State", records.STATE))
_CAN = raw.schema(3, "hilrunner/msg/CanFrame", schema_text("CanFrame", records.CAN_FRAME))


def _payload(row: np.ndarray) -> bytes:
    return row.tobytes()[MESSAGE_OFFSET:]


def _one_tick(**fields) -> bytes:
    row = records.allocate(records.TICK, 1)
    for name, value in fields.items():
        row[name] = value
    return _payload(row[0])


def _ticks(count: int) -> bytes:
    return b"".join(raw.message(1, _one_tick(tick=k, deadline_mono_ns=k * 1_000_000)) for k in range(count))


def _write(folder: Path, data: bytes) -> Path:
    path = folder / "hostile.mcap"
    path.write_bytes(data)
    return path


def decompression_bomb(rng, folder):
    """A chunk that unpacks to thousands of times its size: declared, undeclared, or many of them."""
    size = int(rng.choice([1 << 27, 1 << 30, 4 << 30]))
    kind = int(rng.integers(5))
    if kind == 0:  # the frame itself promises it
        packed = zstandard.ZstdCompressor(level=1).compress(bytes(1 << 28))
        parts = [raw.chunk(b"", packed, size=int(rng.choice([1000, 1 << 28, size])))] * int(rng.integers(1, 30))
    elif kind == 1:  # nothing is promised
        stream = zstandard.ZstdCompressor(level=1).compressobj()
        packed = b"".join(stream.compress(bytes(1 << 22)) for _ in range(64)) + stream.flush()
        parts = [raw.chunk(b"", packed, size=int(rng.choice([1000, 1 << 27, size])))] * int(rng.integers(1, 20))
    elif kind == 2:
        packed = lz4.frame.compress(bytes(1 << 27))
        parts = [raw.chunk(b"", packed, name="lz4", size=int(rng.choice([1000, 1 << 27, size])))] * int(
            rng.integers(1, 8)
        )
    elif kind == 3:  # honest chunks of the same tick, over and over
        content = raw.message(1, _one_tick(tick=7)) * 300_000
        parts = [raw.chunk(content)] * int(rng.integers(1, 40))
    else:  # messages of nothing
        parts = [raw.chunk(raw.message(1, b"") * 1_000_000)] * int(rng.integers(1, 20))
    return _write(folder, raw.file(_TICK, _ticks(3), *parts))


def wrong_lengths(rng, folder):
    """Lengths of records, texts, maps, chunks and attachments that are not there."""
    claims = (0, 1, 8, 1 << 16, 1 << 31, (1 << 32) - 1, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
    claimed = claims[rng.integers(len(claims))]
    small = claimed & 0xFFFFFFFF
    parts = [
        raw.record(raw.METADATA, b"\x04\x00\x00\x00runs", claimed),
        raw.record(raw.METADATA, raw.text("run", small) + struct.pack("<I", small)),
        raw.record(raw.METADATA, raw.text("run") + struct.pack("<I", small) + raw.text("a") + raw.text("b")),
        raw.attachment("profile.toml", b"x", claimed),
        raw.record(raw.SCHEMA, struct.pack("<H", 9) + raw.text("n", small)),
        raw.record(raw.CHANNEL, struct.pack("<HH", 9, 9) + raw.text("/x", small)),
        raw.chunk(_ticks(5), size=claimed),
        raw.record(raw.CHUNK, struct.pack("<QQQI", 1, 1, claimed, 0) + raw.text("zstd", small)),
        raw.record(
            raw.CHUNK, struct.pack("<QQQI", 1, 1, 50, 0) + raw.text("zstd") + struct.pack("<Q", claimed) + b"x" * 50
        ),
        raw.chunk(raw.record(raw.MESSAGE, b"short", claimed)),
        raw.record(raw.MESSAGE, b"", claimed),
        raw.record(raw.DATA_END, b"1234567", claimed),
        raw.record(int(rng.integers(16, 256)), b"private", claimed),
    ]
    order = rng.permutation(len(parts))[: int(rng.integers(1, 5))]
    return _write(
        folder, raw.file(_TICK, _ticks(20), *(parts[k] for k in order), _ticks(5), finished=bool(rng.integers(2)))
    )


def many_channels(rng, folder):
    """Up to every channel there can be: foreign, of many axes, of one topic, of events, or never defined."""
    count = int(rng.choice([2000, 20_000, 65_000]))
    kind = int(rng.integers(5))
    data = _payload(records.allocate(records.STATE, 1)[0])
    names = {
        0: lambda k: f"/foreign/{k}",
        1: lambda k: f"/axis_{k}/state",
        2: lambda k: "/luffing/state",
        3: lambda k: "/log",
        4: lambda k: EVIL + str(k),
    }[kind]
    number = 4 if kind == 3 else 2
    events = raw.schema(4, "rcl_interfaces/msg/Log", "string msg")
    defined = (
        b"".join(raw.channel(k % 65_534 + 2, number, names(k)) for k in range(count)) if rng.random() < 0.8 else b""
    )
    body = b"".join(raw.message(k % 65_534 + 2, data if rng.random() < 0.5 else b"") for k in range(count)) * 2
    parts = [defined, body] if rng.integers(2) else [raw.chunk(defined + body)]
    return _write(folder, raw.file(_STATE, events, _TICK, _ticks(10), *parts, _ticks(5)))


def deep_tables(rng, folder):
    """JSON and TOML that nest without end, and numbers that are none, where a log keeps findings, histograms and profile."""
    depth = int(rng.choice([1000, 100_000]))
    deep = [
        "[" * depth,
        "[" * depth + "]" * depth,
        '{"a":' * depth,
        "1e999",
        "-0",
        "null",
        '"x"',
        "9" * 5000,
        "[[1,2],[3]]",
        "{}",
    ]
    value = deep[rng.integers(len(deep))]
    toml = [
        f'name = "x"\na = {"[" * depth}{"]" * depth}', "a" + ".a" * depth + " = 1", f"a = {'9' * 5000}", "[limits]\na = 1e400",
        f"[[axis]]\nname = {value}", "name = 1979-05-27T99:99:99", "limits = 3", f"[limits]\npressure_mpa_max = {'9' * 400}",
        '[limits]\n"' + "k" * 100_000 + '" = 1', "[limits]\npressure_mpa_max = nan", "\x00", "axis = 7", value,
    ]  # fmt: skip
    host = {
        "mode_label": "best effort",
        "findings": value,
        "grants": deep[rng.integers(len(deep))],
        "mode_reasons": EVIL,
    }
    run = {"axis_names": "luffing", "exit_reason": "duration reached", "period_ns": "1000000"}
    parts = [
        raw.metadata("run", run), raw.metadata("host", host), raw.attachment("profile.toml", toml[rng.integers(len(toml))].encode()),
        raw.attachment("rt_histograms.json", deep[rng.integers(len(deep))].encode()),
        raw.attachment("effective.json", value.encode()),
    ]  # fmt: skip
    return _write(folder, raw.file(_TICK, _ticks(50), *parts))


_ABSURD = [
    "", "-1", "0", "1", "nan", "inf", "-inf", "1e400", "9" * 30, "9" * 5000, "0x10", "true", "[]", "{}", "\x00", EVIL, " 7 ", "1_0",
    "\u0661", "18446744073709551616", "-9223372036854775809", "1000000", "a" * 100_000,
]  # fmt: skip
_KEYS = (
    "period_ns", "warm_up_ticks", "can_bitrate", "bitrate", "axis_names", "engine", "exit_reason", "tick_count", "start_mono_ns",
    "start_real_ns", "profile", "profile_name", "dropped_ticks", "dropped_frames", "lost_bytes", "lost_messages", "miss_count",
    "skipped_count", "compiled_source_hash", "profile_sha256", "sha256:profile.toml", "frames_received", "frames_sent",
)  # fmt: skip


def _with_tables(folder: Path, tables: dict, attachments: list) -> Path:
    path = folder / "hostile.mcap"
    log = LogWriter(path, ["luffing"], 8, tables, attachments)
    tick, _ = synthetic_run.ticks_of(0, 300, np.random.default_rng(1), 100)
    command, state, _ = synthetic_run.plant_of(tick, np.random.default_rng(1))
    log.write_ticks(tick, command, state, synthetic_run.START_MONO_NS, synthetic_run.START_REAL_NS)
    log.close()
    return path


def absurd_metadata(rng, folder):
    """Every number and text of the metadata replaced by what it cannot be."""
    run = {key: _ABSURD[rng.integers(len(_ABSURD))] for key in _KEYS if rng.random() < 0.4}
    host = {key: _ABSURD[rng.integers(len(_ABSURD))] for key in ("mode_label", "findings", "grants", "kernel")}
    clamped = {_ABSURD[rng.integers(len(_ABSURD))][:1000]: _ABSURD[rng.integers(len(_ABSURD))] for _ in range(3)}
    tables = {
        "run": {"axis_names": "luffing", **run},
        "host": host,
        "clamped": clamped,
        "frames": clamped,
        "check": clamped,
    }
    return _with_tables(folder, tables, [("profile.toml", "text/plain", bench_run.PROFILE.encode())])


def strange_names(rng, folder):
    """NUL, escapes, very long and undecodable names of everything that has one."""
    names = [
        b"\x00",
        EVIL.encode(),
        b"n" * 1_000_000,
        b"\xff\xfe\xfd",
        b"",
        b"../../../tmp/x",
        b"/",
        b"..",
        "é".encode() * 300,
        b"a/b\\c",
    ]
    pick = lambda: names[rng.integers(len(names))]  # noqa: E731
    parts = [
        raw.attachment(pick(), b"data"), raw.attachment(pick(), bench_run.PROFILE.encode()), raw.metadata(pick(), {pick(): pick()}),
        raw.channel(9, 2, pick()), raw.metadata("run", {"axis_names": pick(), "engine": pick(), "exit_reason": pick(), pick(): pick()}),
        raw.attachment("profile.toml", bench_run.PROFILE.encode()),
        raw.chunk(b"", b"packed", name=pick()[:200]),
    ]  # fmt: skip
    kept = [part for part in parts if rng.random() < 0.6]
    return _write(folder, raw.file(_STATE, _TICK, _ticks(10), *kept, library=pick()))


def wild_rows(rng, folder):
    """Right sizes, random bytes: ticks, states, commands, misses, statistics, frames and checks that nothing computed."""
    path = folder / "hostile.mcap"
    log = LogWriter(
        path, ["luffing"], 8, {"run": {"axis_names": "luffing"}}, [("profile.toml", "t", bench_run.PROFILE.encode())]
    )
    layouts = {
        "/rt/tick": records.TICK, "/luffing/command": records.COMMAND, "/luffing/state": records.STATE, "/rt/miss": records.MISS,
        "/luffing/check": records.CHECK, "/rt/statistics": records.STATISTICS, "/can/rx": records.CAN_FRAME, "/can/tx": records.CAN_FRAME,
    }  # fmt: skip
    count = int(rng.choice([1, 2, 50, 5000]))
    in_order = rng.random() < 0.7
    for topic, layout in layouts.items():
        if rng.random() < 0.15:
            continue
        rows = rng.integers(0, 256, (count, layout.itemsize), dtype=np.uint8).view(layout)[:, 0]
        if in_order:
            rows["tick"] = np.arange(count) + int(rng.choice([0, 0, 1 << 31, 1 << 62]))
        if "skipped_count" in layout.names and rng.random() < 0.6:
            rows["skipped_count"] = 0
        log.write_records(topic, rows, 1, 1)
    log.close()
    return path


def wild_profile(rng, folder):
    """A sound run whose profile names files of the reader's machine, or asks for what no machine can do."""
    (folder / "secret.txt").write_text(SECRET + "\n")
    target = str(
        rng.choice(
            [
                "/etc/passwd",
                "/dev/zero",
                "/dev/stdin",
                "../secret.txt",
                str(folder / "secret.txt"),
                "pipe",
                "/proc/self/mem",
                "/",
            ]
        )
    )
    if target == "pipe":
        target = str(folder / "pipe")
        import os

        os.mkfifo(target)
    lines = {
        "dbc": f'[can]\ndbc = "{target}"', "model": f'model = "{target}"', "schedule": f'[stimulus]\nschedule = "{target}"',
        "period": "[bench]\nperiod_us = 1", "force": '[axis.load]\nkind = "constant"\nforce_kn = 1e300',
        "substeps": "surrogate_substeps = 10000\nreference_substeps = 10000", "axes": "", "seed": "[axis.load]\nperturbation_seed = 99999999999999999999",
    }  # fmt: skip
    kind = str(rng.choice(sorted(lines)))
    head, tail = bench_run.PROFILE.split("\n[axis.wave]", 1)
    line = lines[kind]
    text = (
        f"{head}\n{line}\n[axis.wave]{tail}"
        if kind in ("model", "substeps", "force", "seed")
        else f"{bench_run.PROFILE}\n{line}\n"
    )
    if kind == "axes":
        text = 'name = "many"\n' + "".join(f'[[axis]]\nname = "a{k}"\n' for k in range(10_000))
    tables = {"run": {"axis_names": "luffing", "engine": str(rng.choice(["reference", "surrogate", "onnx"]))}}
    attachments = [("profile.toml", "text/plain", text.encode())]
    if rng.random() < 0.3:
        attachments.append(("actuator.dbc", "text/plain", b"BO_ 1 X: 8 Y\n" * 1000))
    return _with_tables(folder, tables, attachments)


def strange_schemas(rng, folder):
    """Fields without number, of enormous size, twice, of unknown types."""
    texts = [
        "uint8[999999] data", "uint8[99999999999999999999] data", "uint64 tick\nuint8[65536] data", "uint8[0] data\nuint64 tick",
        "\n".join(f"float64 f{k}" for k in range(100_000)), "uint64 tick\nuint64 tick", "string tick", "uint64 tick " * 10_000,
        "float32 tick", "uint8[64] tick", "uint64 unused", "uint64 cdr", "", "#" * 1_000_000, "uint8[\u0661] tick",
    ]  # fmt: skip
    chosen = texts[rng.integers(len(texts))]
    topic = str(rng.choice(["/rt/tick", "/luffing/state", "/can/rx", "/rt/miss", "/luffing/check"]))
    body = raw.message(8, bytes(int(rng.choice([4, 12, 68, 200]))))
    return _write(folder, raw.file(raw.schema(8, "x", chosen), raw.channel(8, 8, topic), _TICK, _ticks(10), body * 50))


def npy_claims(rng, folder):
    """A table of commands whose head promises what is not there, or is no number."""
    shapes = [
        "(1000000000000, 1)",
        "(-1, 1)",
        "(2, 1)",
        "()",
        "(1,)",
        "(0, 1)",
        "(2, 3)",
        "(9999999999999999999999, 1)",
        "(" * 300,
    ]
    layout = str(rng.choice(["<f8", "O", "<U999999999", "V8", "|b1", ">f8", "<f4"]))
    head = f"{{'descr': '{layout}', 'fortran_order': {rng.choice(['True', 'False'])}, 'shape': {shapes[rng.integers(len(shapes))]}, }}"
    version = bytes([int(rng.choice([1, 2, 3, 9])), 0])
    length = struct.pack("<H" if version[0] == 1 else "<I", len(head) + 1)
    data = b"\x93NUMPY" + version + length + head.encode() + b"\n" + bytes(16)
    attachments = [
        ("profile.toml", "t", bench_run.PROFILE.encode()),
        ("stimulus.npy", "application/octet-stream", data),
    ]
    return _with_tables(folder, {"run": {"axis_names": "luffing", "engine": "reference"}}, attachments)


def rubble(rng, folder):
    """Chunks of nothing between single wrong bytes: every one is a place to go on from."""
    piece = raw.chunk(b"", b"", size=0) + bytes([int(rng.choice([0, 0x55, 0x05]))])
    return _write(
        folder, raw.file(_TICK, _ticks(5), piece * int(rng.choice([100, 5000, 50_000])), finished=bool(rng.integers(2)))
    )


def sparse_file(rng, folder):
    """Gigabytes of nothing behind a small head: one record, one chunk, one attachment, or zeros."""
    size = int(rng.choice([1 << 28, 1 << 32, 1 << 35]))
    heads = [
        raw.record(raw.ATTACHMENT, b"", size), raw.record(raw.CHUNK, struct.pack("<QQQI", 1, 1, size, 0), size),
        raw.record(raw.MESSAGE, struct.pack("<HIQQ", 1, 0, 1, 1), size), b"", raw.record(raw.METADATA, raw.text("run"), size),
    ]  # fmt: skip
    path = _write(folder, raw.file(_TICK, _ticks(5), heads[rng.integers(len(heads))], finished=False))
    with open(path, "r+b") as file:
        file.truncate(size + 10_000)
    return path


def nested_records(rng, folder):
    """Records that overlap: a chunk inside a chunk, a length that covers the records behind it, one channel of two topics."""
    inner = raw.chunk(_ticks(20))
    parts = {
        0: [raw.chunk(inner * 50)], 1: [raw.record(raw.METADATA, b"", len(inner) * 3), inner, inner, inner, inner],
        2: [raw.channel(1, 2, "/luffing/state"), inner, raw.channel(1, 1, "/rt/miss"), inner],
        3: [raw.chunk(raw.attachment("profile.toml", b"x") + raw.metadata("run", {"period_ns": "1"}) + _ticks(3))],
        4: [raw.attachment("profile.toml", bench_run.PROFILE.encode()), raw.attachment("profile.toml", b"limits = 1")],
        5: [raw.file(_TICK, _ticks(3)), raw.file(_TICK, _ticks(3))], 6: [raw.chunk(_TICK + _ticks(5) + raw.channel(1, 9, "/x") * 20_000)],
    }[int(rng.integers(7))]  # fmt: skip
    return _write(folder, raw.file(_STATE, _TICK, *parts, _ticks(2)))


def wild_frames(rng, folder):
    """Frames of every identifier and length, with stamps years apart: one array a kind and second would fill memory."""
    path = folder / "hostile.mcap"
    log = LogWriter(path, ["luffing"], 8, {"run": {"axis_names": "luffing", "bitrate": "500000"}}, [])
    count = int(rng.choice([1000, 100_000]))
    rows = records.allocate(records.CAN_FRAME, count)
    rows["tick"] = np.sort(rng.integers(0, 1 << int(rng.choice([10, 32, 63])), count))
    for name in ("length", "flags", "status"):
        rows[name] = rng.integers(0, 256, count)
    rows["can_id"] = rng.integers(0, 1 << 32, count)
    rows["mono_ns"] = rng.integers(0, 1 << int(rng.choice([40, 62])), count)
    rows["kernel_real_ns"] = rng.integers(0, 1 << 62, count)
    for part in np.array_split(rows, 10):
        log.write_records(str(rng.choice(["/can/rx", "/can/tx"])), part, 1, 1)
    tick, _ = synthetic_run.ticks_of(0, 300, np.random.default_rng(1), 100)
    log.write_records("/rt/tick", tick, 1, 1)
    log.close()
    return path


def long_texts(rng, folder):
    """Megabytes where a sentence is expected: events, values, reasons."""
    size = int(rng.choice([10_000, 3_000_000]))
    run = {
        "axis_names": "luffing",
        "seed": "x" * size,
        "exit_reason": "y" * size,
        "profile": "z" * size,
        "k" * size: "v",
    }
    host = {
        "mode_label": "m" * size,
        "mode_reasons": "; ".join(["r" * 50] * (size // 50)),
        "findings": json.dumps(["x"] * 5000),
    }
    path = _with_tables(folder, {"run": run, "host": host}, [])
    return path


def not_a_log(rng, folder):
    """What is no file, or no log."""
    import os

    path = folder / "hostile.mcap"
    kind = int(rng.integers(6))
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    elif kind == 2:
        path.symlink_to("/dev/zero")
    elif kind == 3:
        path.symlink_to(path)
    elif kind == 4:
        path.write_bytes(rng.bytes(int(rng.integers(0, 5000))))
    else:
        path.write_bytes(raw.MAGIC + rng.bytes(int(rng.integers(0, 5000))))
    return path


MAKERS = (
    decompression_bomb, wrong_lengths, many_channels, deep_tables, absurd_metadata, strange_names, wild_rows, wild_profile,
    strange_schemas, npy_claims, rubble, sparse_file, nested_records, wild_frames, long_texts, not_a_log,
)  # fmt: skip
COMMANDS = (
    ["report"],
    ["report", "--json"],
    ["report", "--html"],
    ["replay", "--only", "exact"],
    ["replay", "--duration", "0.1"],
)


def prepare(folder: Path) -> Attempt:
    """The makers in turn, the reading command drawn."""
    warm_up(eventful_log(folder))

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        maker = MAKERS[int(rng.integers(len(MAKERS)))]
        log = maker(rng, own)
        words = list(COMMANDS[int(rng.integers(len(COMMANDS)))])
        if words[-1] == "--html":
            words += [str(own / "page.html"), "--junit", str(own / "verdict.xml")]
        outcome = call([words[0], str(log), *words[1:]])
        faults = outcome.faults()
        pages = "".join(page.read_text() for page in (own / "page.html", own / "verdict.xml") if page.exists())
        if SECRET in outcome.out + outcome.err + pages or "root:x:" in outcome.out + outcome.err + pages:
            faults.append("a line of another file was shown")
        if outcome.code not in (0, 1, 2, 3, 4, 5, 7, 8, None):
            faults.append("an exit code that is not documented")
        return Tried(
            f"{' '.join(words[:2])} of {maker.__name__}",
            maker.__name__,
            outcome.code,
            faults,
            outcome.wall_s,
            outcome.memory_bytes,
            outcome.err[-4000:],
        )

    return attempt


LOGS = Campaign("logs", "hostile logs: bombs, lengths, names, tables, numbers, paths", 1000, prepare)
