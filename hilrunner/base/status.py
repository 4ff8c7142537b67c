"""Integer codes shared by the loop, the bus and the log. Values are part of the log format: add, never renumber."""

# control word on the bus (VALVE_COMMAND.control)
CONTROL_DISABLED = 0
CONTROL_HOLD = 1
CONTROL_ACTIVE = 2
CONTROL_RESET = 3
CONTROL_TRIP = 4  # a safety line asks for the fail-safe; no control word of the shipped contract

# mode of an axis in the log and in BENCH_STATUS
MODE_WAITING = 0  # no valid command yet: valve neutral
MODE_DISABLED = 1  # firmware says Disabled: valve neutral
MODE_HOLD = 2  # firmware says Hold: valve neutral
MODE_ACTIVE = 3  # firmware commands the valve
MODE_STALE_HOLD = 4  # no valid command for stale_after: last command is held
MODE_STALE_RAMP = 5  # still none for hold_for: ramping to neutral
MODE_FAIL_SAFE = 6  # latched: neutral until Reset
MODE_NAMES = ("waiting", "disabled", "hold", "active", "stale-hold", "stale-ramp", "fail-safe")

# what became of a received frame; index into the frame counters
FRAME_VALID = 0
FRAME_UNKNOWN_ID = 1
FRAME_WRONG_LENGTH = 2
FRAME_REMOTE = 3
FRAME_ERROR = 4
FRAME_BAD_CRC = 5
FRAME_REPEATED_COUNTER = 6
FRAME_LOST_COUNTER = 7  # counter jumped further than the profile allows
FRAME_OUT_OF_RANGE = 8
FRAME_NOT_A_NUMBER = 9
FRAME_BAD_CONTROL = 10
FRAME_OWN_ID = 11  # an identifier this bench sends: another bench speaks on the bus
FRAME_STATUS_NAMES = (
    "valid",
    "unknown id",
    "wrong length",
    "remote frame",
    "error frame",
    "bad crc",
    "repeated counter",
    "lost counter",
    "out of range",
    "not a number",
    "bad control word",
    "own identifier, sent by another",
)
FRAME_STATUS_COUNT = len(FRAME_STATUS_NAMES)

# flags of /<axis>/state
FLAG_OUTSIDE_TRAINING = 1 << 0
FLAG_END_STOP = 1 << 1
FLAG_CAVITATION = 1 << 2
FLAG_FAIL_SAFE = 1 << 3
FLAG_SOLVER_LIMIT = 1 << 4  # the line solve stopped at its iteration limit
FLAG_NOT_FINITE = 1 << 5  # the state left the finite numbers; the run stops
FLAG_FAULT_ACTIVE = 1 << 6  # an injected fault acts on this tick
FLAG_EXACT_STEP = 1 << 7  # the surrogate handed this tick over to the exact engine (plant.handover)
FLAG_NAMES = (
    "outside training range",
    "end stop",
    "cavitation",
    "fail-safe",
    "solver limit",
    "not finite",
    "fault active",
    "exact step",
)
# the flags that also go on the bus: how a tick was computed is the bench's own affair, and no byte of the contract has room for more
BUS_FLAGS = FLAG_EXACT_STEP - 1

# Which plant a run had, written into its log (logs before that say nothing, which is 1). A replay takes the log's own, so that its
# bits stay what they were. 1: surrogates hand no period over, pressures may fall below absolute vacuum; 2: plant.handover, and the
# void of plant.mechanics
PLANT_EQUATIONS = 2

# phases of a period, in order; index into the phase histograms
PHASE_RECEIVE = 0
PHASE_DECODE = 1
PHASE_STEP = 2
PHASE_ENCODE = 3  # encode and send
PHASE_RECORD = 4
PHASE_COUNT = 5
PHASE_NAMES = ("receive", "decode", "step", "encode/send", "record")

# suspected cause of a miss
CAUSE_UNKNOWN = 0
CAUSE_PAGE_FAULT = 1
CAUSE_PREEMPTED = 2  # involuntary context switches rose
CAUSE_LATE_WAKE = 3  # woke late without any of the above: kernel or hypervisor
CAUSE_FRAME_BURST = 4
CAUSE_STEP = 5  # the plant step took the time
CAUSE_SEND = 6
CAUSE_RECORDER = 7  # the ring was full
CAUSE_MIGRATED = 8  # another core than the tick before
CAUSE_CARRIED_OVER = 9  # the tick before ended after this one was due
CAUSE_NAMES = (
    "unknown",
    "page fault",
    "preempted by another task",
    "late wake-up (kernel or hypervisor)",
    "burst of frames",
    "plant step",
    "send blocked",
    "recorder stopped or slow",
    "moved to another core",
    "carried over from the tick before",
)

# why a run ended
EXIT_RUNNING = 0
EXIT_DURATION = 1
EXIT_SIGNAL = 2
EXIT_DEADLINE = 3
EXIT_CAN_LOST = 4
EXIT_NOT_FINITE = 5
EXIT_STIMULUS_END = 6
EXIT_KILLED = 7
EXIT_STALLED = 8  # the host stood still longer than the profile allows, action "stop"
EXIT_SYSTEM_CALL = 9  # a system call of the loop that cannot fail did
EXIT_FIRMWARE = 10  # virtual time came to a stand: the firmware hung, or did what cannot be followed
EXIT_NAMES = (
    "running",
    "duration reached",
    "stopped by signal",
    "deadline budget exceeded",
    "CAN lost",
    "state not finite",
    "stimulus ended",
    "runner killed",
    "the host stalled",
    "system call failed",
    "firmware hung or not to be followed",
)

# overrun policy
OVERRUN_SKIP = 0
OVERRUN_CATCH_UP = 1
OVERRUN_STOP = 2
OVERRUN_NAMES = ("skip", "catch-up", "stop")

# engines
ENGINE_SURROGATE = 0
ENGINE_REFERENCE = 1
ENGINE_ONNX = 2
ENGINE_NAMES = ("surrogate", "reference", "onnx")

# circuits of the plant
CIRCUIT_PAPER = 0
CIRCUIT_LIFT = 1
CIRCUIT_LIFT_LINES = 2
CIRCUIT_NAMES = ("paper", "lift", "lift-lines")
