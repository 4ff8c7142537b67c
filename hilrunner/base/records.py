"""Record layouts of the log: what the loop fills *is* what the file holds.

A record starts with 4 unused bytes and the 4-byte CDR header, so that every field is aligned in memory;
the message is `bytes(record)[MESSAGE_OFFSET:]`. Fields are ordered by size, so that CDR needs no padding
between them (OMG DDS-XTypes 7.4.3, plain CDR, little-endian). `schema_text` derives the ros2msg text from the dtype.
"""

import numpy as np

CDR_HEADER = (0, 1, 0, 0)  # representation id CDR_LE, options 0
MESSAGE_OFFSET = 4
_PREFIX = [("unused", "u1", (4,)), ("cdr", "u1", (4,))]


def _layout(fields: list[tuple]) -> np.dtype:
    dtype = np.dtype(_PREFIX + fields)
    offsets = [dtype.fields[name][1] for name in dtype.names]
    for name, offset in zip(dtype.names, offsets, strict=True):
        base = dtype.fields[name][0].base.itemsize
        assert offset % base == 0, f"{name} is not aligned: CDR would pad before it"
    return dtype


TICK = _layout(
    [
        ("tick", "u8"),  # period number on the grid; gaps are skipped periods without a row
        ("deadline_mono_ns", "i8"),  # start_mono_ns + tick * period_ns
        ("wake_mono_ns", "i8"),
        ("end_mono_ns", "i8"),  # after the record phase of this tick
        ("receive_ns", "u4"),
        ("decode_ns", "u4"),
        ("step_ns", "u4"),
        ("encode_ns", "u4"),  # encode and send
        ("record_ns", "u4"),  # record phase of the tick before: this one is not over when the record is written
        ("frames_received", "u4"),
        ("skipped_count", "u4"),  # whole periods skipped just before this tick that have no row of their own
        ("flags", "u4"),  # TICK_FLAG_*: late (a miss), near a miss, fail-safe forced before this tick, skipped
    ]
)
TICK_FLAG_MISS = 1
TICK_FLAG_NEAR_MISS = 2
TICK_FLAG_FORCED_FAIL_SAFE = 4  # by a deadline limit of the profile, just before this tick
TICK_FLAG_SKIPPED = 8  # computed after a stall, from the frames that came in its time; nothing of it was sent

COMMAND = _layout(
    [
        ("tick", "u8"),
        ("valve_command", "f8"),  # -1..1, as applied to the plant
        ("age_ns", "i8"),  # since the tick that received the newest valid command; -1: none yet
        ("echoed_timestamp_us", "u4"),
        ("mode", "u1"),  # status.MODE_*
        ("counter", "u1"),  # alive counter of the newest valid command
        ("status", "u1"),  # status.FRAME_* of the last frame of this tick for this axis; 255: none
        ("control", "u1"),  # status.CONTROL_* of the newest valid command
    ]
)
FRAME_STATUS_NONE = 255

STATE = _layout(
    [
        ("tick", "u8"),
        ("rod_position_m", "f8"),  # the ten of base.state_layout, in that order
        ("rod_velocity_mps", "f8"),
        ("chamber_1_pressure_pa", "f8"),
        ("chamber_2_pressure_pa", "f8"),
        ("spool_1_position_m", "f8"),
        ("spool_2_position_m", "f8"),
        ("spool_1_velocity_mps", "f8"),
        ("spool_2_velocity_mps", "f8"),
        ("line_a_pressure_pa", "f8"),
        ("line_b_pressure_pa", "f8"),
        ("load_force_n", "f8"),
        ("load_scale", "f8"),  # factor on the static load in this period (vessel heave, faults); input of a replay
        ("flags", "u4"),  # status.FLAG_*
    ]
)
STATE_FIELDS = STATE.names[3:13]  # the ten state fields

CHECK = _layout(
    [
        ("tick", "u8"),
        ("reference_rod_position_m", "f8"),
        ("reference_rod_velocity_mps", "f8"),
        ("reference_chamber_1_pressure_pa", "f8"),
        ("reference_chamber_2_pressure_pa", "f8"),
        ("rod_position_error_m", "f8"),  # surrogate minus free-running reference
        ("rod_velocity_error_mps", "f8"),
        ("chamber_1_pressure_error_pa", "f8"),
        ("chamber_2_pressure_error_pa", "f8"),
        ("one_step_rod_position_error_m", "f8"),  # surrogate minus reference, both from the surrogate's last state
        ("one_step_rod_velocity_error_mps", "f8"),
        ("one_step_chamber_1_pressure_error_pa", "f8"),
        ("one_step_chamber_2_pressure_error_pa", "f8"),
        ("lag_ns", "i8"),  # how far the check is behind the loop
        ("flags", "u4"),  # bit 0: out of tolerance
    ]
)

MISS = _layout(
    [
        ("tick", "u8"),
        ("lateness_ns", "i8"),  # how far the tick ended (or woke) past the end of its period
        ("wake_lateness_ns", "i8"),
        ("execution_ns", "i8"),
        ("page_faults_minor", "u4"),  # since the tick before
        ("page_faults_major", "u4"),
        ("switches_voluntary", "u4"),
        ("switches_involuntary", "u4"),
        ("frames_queued", "u4"),
        ("skipped_count", "u4"),  # periods lost to this miss
        ("cpu", "u2"),
        ("cpu_before", "u2"),
        ("phase", "u1"),  # status.PHASE_*, the longest; 255: the wake-up itself
        ("cause", "u1"),  # status.CAUSE_*
    ]
)
PHASE_WAKE = 255

HISTOGRAM_NAMES = (
    "wake_lateness",
    "receive",
    "decode",
    "step",
    "encode",
    "record",
    "execution",
    "period",
    "command_age",
    "response",
)
STATISTIC_NAMES = ("min", "p50", "p90", "p99", "p999", "p9999", "p99999", "max")

STATISTICS = _layout(
    [("tick", "u8"), ("tick_count", "u8"), ("miss_count", "u8"), ("skipped_count", "u8"), ("record_drop_count", "u8")]
    + [(f"{name}_ns_{stat}", "i8") for name in HISTOGRAM_NAMES for stat in STATISTIC_NAMES]
)


def can_frame_record(data_size_bytes: int) -> np.dtype:
    """Layout of one logged CAN frame; `data_size_bytes` is 8 (classic) or 64 (FD)."""
    return _layout(
        [
            ("tick", "u8"),  # tick that received or sent it; after a stall the period in which it came
            ("kernel_real_ns", "i8"),  # receive: the kernel's stamp (CLOCK_REALTIME); 0: none, as always when sent
            ("mono_ns", "i8"),  # receive: wake-up of the tick; send: just after the system call returned
            ("can_id", "u4"),  # SocketCAN: 29 bits and EFF/RTR/ERR flags in the upper three
            ("length", "u1"),  # data bytes
            ("flags", "u1"),  # bit 0: FD, bit 1: BRS, bit 7: sent by the bench
            ("status", "u1"),  # status.FRAME_* (received frames)
            ("axis", "u1"),  # 255: none
            ("data", "u1", (data_size_bytes,)),
        ]
    )


CAN_FRAME_SENT = 1 << 7
CAN_FRAME = can_frame_record(8)
CAN_FD_FRAME = can_frame_record(64)

_ROS_TYPES = {
    "u1": "uint8", "u2": "uint16", "u4": "uint32", "u8": "uint64",
    "i1": "int8", "i2": "int16", "i4": "int32", "i8": "int64", "f4": "float32", "f8": "float64",
}  # fmt: skip


def schema_text(dtype: np.dtype) -> str:
    """The ros2msg definition of a record layout, one field a line, without the prefix."""
    lines = []
    for name in dtype.names[2:]:
        field = dtype.fields[name][0]
        ros = _ROS_TYPES[field.base.str[1:]]
        array = f"[{field.shape[0]}]" if field.shape else ""
        lines.append(f"{ros}{array} {name}")
    return "\n".join(lines) + "\n"


def allocate(dtype: np.dtype, count: int) -> np.ndarray:
    """A zeroed array of records with their CDR headers in place."""
    records = np.zeros(count, dtype)
    records["cdr"] = CDR_HEADER
    return records
