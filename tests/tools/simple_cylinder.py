"""The reference firmware's core against a cylinder of a few lines, joined by our own codec (bytes both ways).

The cylinder: rod velocity follows the set point with the law of the orifice, q ~ u sqrt(drop), after a first-order lag.
It shares no code and no model with hilrunner.plant; it tests a controller, not a plant.
"""

import math

import numpy as np

from hilrunner.base import status
from hilrunner.realtime import decode, encode
from tests.tools import codec_entries, contract, firmware_c

PERIOD_S = 1e-3
PERIOD_US = 1000
SUPPLY_PA, CHAMBER_1_PA, CHAMBER_2_PA = 30e6, 9.2e6, 0.8e6


class Cylinder:
    """First-order lag on velocity; gains as the firmware's defaults assume them, times `gain_error`."""

    def __init__(self, position_m=0.6, gain_error=1.0, supply_pa=SUPPLY_PA, lag_s=0.02):
        self.position_m, self.velocity_mps = position_m, 0.0
        self.gain_error, self.supply_pa, self.lag_s = gain_error, supply_pa, lag_s

    def step(self, valve: float) -> None:
        """One period at a set point of -1..1."""
        if valve >= 0:
            full = 0.0225 * math.sqrt((self.supply_pa - CHAMBER_1_PA) / 20.8e6)
        else:
            full = 0.0222 * math.sqrt((self.supply_pa - CHAMBER_2_PA) / 29.2e6)
        target = valve * full * self.gain_error
        self.velocity_mps += (target - self.velocity_mps) * PERIOD_S / self.lag_s
        self.position_m += self.velocity_mps * PERIOD_S


class Rig:
    """Controller, bus and cylinder; time is a number that the rig moves on."""

    def __init__(self, cylinder: Cylinder | None = None, **config):
        self.ffi, self.lib = firmware_c.load()
        self.cylinder = cylinder or Cylinder()
        self.config = self.ffi.new("mc_config_t *")
        self.lib.mc_config_default(self.config)
        for name, value in config.items():
            target, *rest = name.split("__")
            if rest:
                setattr(getattr(self.config, target), rest[0], value)
            else:
                setattr(self.config, target, value)
        self.controller = self.ffi.new("mc_t *")
        assert self.lib.mc_init(self.controller, self.config)
        self.commands, self.measurements = contract.tables(1)
        self.quantities, self.sent = encode.no_quantities(1), encode.send_counters(self.measurements)
        self.fresh, self.last = decode.fresh_commands(1), decode.no_counters(1)
        self.now_us = 5_000_000
        self.tick = 0
        self.bench_state = status.MODE_WAITING
        self.sending = {0x181, 0x281, 0x381}
        self.damage = set()
        self.frames = []
        self.codes = []

    @property
    def statistics(self):
        return self.controller.statistics

    @property
    def state(self) -> str:
        names = {
            self.lib.MC_START: "start",
            self.lib.MC_ACTIVE: "active",
            self.lib.MC_HOLD: "hold",
            self.lib.MC_RESET: "reset",
        }
        return names[self.controller.state]

    def _measure(self) -> None:
        row = self.quantities[0]
        row[encode.QUANTITY_CHAMBER_1_PRESSURE] = CHAMBER_1_PA
        row[encode.QUANTITY_CHAMBER_2_PRESSURE] = CHAMBER_2_PA
        row[encode.QUANTITY_SUPPLY_PRESSURE] = self.cylinder.supply_pa
        row[encode.QUANTITY_ROD_POSITION] = self.cylinder.position_m
        row[encode.QUANTITY_ROD_VELOCITY] = self.cylinder.velocity_mps
        row[encode.QUANTITY_BENCH_STATE] = self.bench_state
        row[encode.QUANTITY_TICK] = self.tick
        row[encode.QUANTITY_ECHOED_TIMESTAMP] = self.fresh[0]["timestamp_us"]
        data = np.zeros(64, np.uint8)
        for message in range(self.measurements.message_count):
            can_id = int(self.measurements.can_id[message])
            if self.tick % self.measurements.period_ticks[message] or can_id not in self.sending:
                continue
            length = codec_entries.encode_one(self.measurements, message, self.quantities, self.sent, data)
            if can_id in self.damage:
                data[7] ^= 1
            self.codes.append(self.lib.mc_receive(self.controller, can_id, bytes(data[:length]), length, self.now_us))

    def step(self, count: int = 1) -> None:
        """Periods: measurements to the controller, its command to the cylinder."""
        for _ in range(count):
            self._measure()
            can_id, data = self.ffi.new("uint32_t *"), self.ffi.new("uint8_t[8]")
            length = self.lib.mc_step(self.controller, self.now_us, can_id, data)
            self.frames.append((can_id[0], bytes(data)))
            got = codec_entries.decode_one(
                self.commands, can_id[0], length, contract.as_array(bytes(data)), self.last, self.fresh
            )
            assert got == (0, status.FRAME_VALID)
            active = self.fresh[0]["control"] == status.CONTROL_ACTIVE
            self._bench_reacts()
            self.cylinder.step(float(self.fresh[0]["valve_command"]) if active else 0.0)
            self.now_us += PERIOD_US
            self.tick += 1

    def _bench_reacts(self) -> None:
        """The part of the bench's rules that a controller sees: a latched fail-safe is left by Reset alone."""
        control = int(self.fresh[0]["control"])
        if self.bench_state == status.MODE_FAIL_SAFE and control != status.CONTROL_RESET:
            return
        modes = {
            status.CONTROL_DISABLED: status.MODE_DISABLED,
            status.CONTROL_ACTIVE: status.MODE_ACTIVE,
        }
        self.bench_state = modes.get(control, status.MODE_HOLD)

    def error_mm_rms(self) -> float:
        """Tracking error as the controller counts it."""
        return 1e3 * math.sqrt(self.statistics.error_square_sum_m2 / self.statistics.tracked_count)

    def reference_mm_rms(self) -> float:
        """The motion the error is to be compared with."""
        return 1e3 * math.sqrt(self.statistics.reference_square_sum_m2 / self.statistics.tracked_count)
