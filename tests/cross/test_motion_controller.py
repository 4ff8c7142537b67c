"""The reference firmware's core: tracking, heartbeat, time-outs, reaction to the bench's fail-safe."""

import math

import e2e.p02
import numpy as np
import pytest

from hilrunner.base import status
from tests.tools import contract, firmware_c
from tests.tools.simple_cylinder import PERIOD_US, Cylinder, Rig


def control_words(rig) -> list[int]:
    return [data[1] >> 4 for _, data in rig.frames]


def setpoints(rig) -> np.ndarray:
    return np.array([int.from_bytes(data[2:4], "little", signed=True) / 16384 for _, data in rig.frames])


@pytest.fixture(scope="module")
def tracked():
    """20 s of tracking, left as it is by the tests that read it."""
    rig = Rig()
    rig.step(20_000)
    return rig


def test_the_rod_follows_the_wave(tracked):
    assert tracked.state == "active"
    assert tracked.reference_mm_rms() > 5
    assert tracked.error_mm_rms() < 0.03 * tracked.reference_mm_rms()
    assert 1e3 * tracked.statistics.error_m_max < 1.0
    assert tracked.statistics.saturated_count == 0
    assert tracked.statistics.tracked_count == 20_000 - 2_000, "judged after the ramp of 2 s only"


def test_tracking_is_counted_as_it_was(tracked):
    """The controller's own statistics against the cylinder's true position."""
    rig, errors = Rig(), []
    for _ in range(6_000):
        before = rig.cylinder.position_m
        rig.step()
        if rig.tick > 2_000:
            errors.append(rig.controller.reference_m - before)
    assert rig.statistics.tracked_count == len(errors)
    assert rig.error_mm_rms() == pytest.approx(1e3 * math.sqrt(np.mean(np.square(errors))), abs=1e-3)


def test_position_control_mends_what_feed_forward_leaves():
    errors = []
    for gain in (0.0, 2.0):
        rig = Rig(Cylinder(gain_error=0.85), position_gain_per_s=gain)
        rig.step(8_000)
        errors.append(rig.error_mm_rms())
    assert errors[1] < 0.5 * errors[0]


def test_feed_forward_knows_the_pressure_drop():
    """With half the drop left the valve must open sqrt(2) wider; without position control it still tracks."""
    opened = []
    for supply_pa in (30e6, 9.2e6 + 10.4e6):
        rig = Rig(Cylinder(supply_pa=supply_pa), position_gain_per_s=0.0)
        rig.step(6_000)
        assert rig.error_mm_rms() < 1.0
        opened.append(setpoints(rig).max())
    assert opened[1] / opened[0] == pytest.approx(math.sqrt(2), rel=0.01)


def test_every_period_has_a_frame_with_the_next_counter(tracked):
    assert len(tracked.frames) == tracked.statistics.period_count == 20_000
    ids = contract.data_ids("VALVE_COMMAND_1")
    for number, (can_id, data) in enumerate(tracked.frames[:2_000]):
        assert can_id == 0x201 and data[1] & 0x0F == (number + 1) % 16
        assert e2e.p02.e2e_p02_check(data, ids, length=8)
        stamp = int.from_bytes(data[4:8], "little")
        assert stamp == (5_000_000 + number * PERIOD_US) % (1 << 32)


def test_round_trips_are_measured(tracked):
    statistics = tracked.statistics
    assert statistics.round_trip_count == pytest.approx(2_000, abs=2), "one each BENCH_STATUS"
    assert statistics.round_trip_us_sum == PERIOD_US * statistics.round_trip_count
    assert statistics.round_trip_us_max == PERIOD_US


@pytest.mark.parametrize("missing", [0x181, 0x281, 0x381])
def test_it_waits_for_every_measurement(missing):
    rig = Rig()
    rig.sending -= {missing}
    rig.step(300)
    assert rig.state == "start" and set(control_words(rig)) == {status.CONTROL_DISABLED}
    assert not setpoints(rig).any()
    rig.sending |= {missing}
    rig.step(20)
    assert rig.state == "active"


@pytest.mark.parametrize("stopped, timeout_ms", [(0x181, 20), (0x281, 20), (0x381, 100)])
@pytest.mark.parametrize("damaged", [False, True], ids=["silent", "bad crc"])
def test_a_measurement_that_ages_stops_the_valve(stopped, timeout_ms, damaged):
    rig = Rig()
    rig.step(3_001)
    assert rig.state == "active"
    if damaged:
        rig.damage = {stopped}
    else:
        rig.sending -= {stopped}
    rig.step(timeout_ms)
    assert rig.state == "active"
    rig.step(1)
    assert rig.state == "hold"
    assert control_words(rig)[-1] == status.CONTROL_HOLD and setpoints(rig)[-1] == 0
    assert rig.statistics.measurement_timeout_count == 1
    assert (rig.statistics.frame_count[status.FRAME_BAD_CRC] > 0) == damaged
    position = rig.cylinder.position_m
    rig.step(500)
    assert abs(rig.cylinder.position_m - position) < 1e-3, "the rod stands"
    rig.damage, rig.sending = set(), {0x181, 0x281, 0x381}
    rig.step(90)
    assert rig.state == "hold", "fresh for 100 ms first"
    rig.step(30)
    assert rig.state == "active"
    rig.step(200)
    assert np.abs(np.diff(setpoints(rig)[-230:])).max() < 0.02, "taken up without a jump"


def test_a_gap_while_recovering_starts_the_wait_anew():
    rig = Rig()
    rig.step(500)
    rig.sending -= {0x281}
    rig.step(50)
    rig.sending |= {0x281}
    rig.step(60)
    rig.sending -= {0x281}
    rig.step(30)
    rig.sending |= {0x281}
    rig.step(90)
    assert rig.state == "hold" and rig.statistics.measurement_timeout_count == 1
    rig.step(30)
    assert rig.state == "active"


def test_the_latched_fail_safe_is_reset_once_and_left():
    rig = Rig()
    rig.step(3_000)
    rig.bench_state = status.MODE_FAIL_SAFE
    rig.step(25)
    words = control_words(rig)[3_000:]
    assert rig.state == "active"
    assert rig.statistics.fail_safe_count == 1
    first, last = words.index(status.CONTROL_RESET), len(words) - 1 - words[::-1].index(status.CONTROL_RESET)
    assert set(words[:first]) <= {status.CONTROL_ACTIVE} and set(words[last + 1 :]) == {status.CONTROL_ACTIVE}
    assert last - first + 1 == rig.statistics.reset_frame_count <= 10, "until the next BENCH_STATUS, 10 ms"
    assert not setpoints(rig)[3_000 + first : 3_000 + last + 1].any()
    assert abs(setpoints(rig)[3_000 + last + 1]) < 0.05, "taken up from the measured position"


def test_a_fail_safe_found_at_the_start_is_reset():
    rig = Rig()
    rig.bench_state = status.MODE_FAIL_SAFE
    rig.step(30)
    assert rig.state == "active" and rig.statistics.fail_safe_count == 1


def test_no_reset_while_measurements_are_missing():
    rig = Rig()
    rig.step(1_000)
    rig.bench_state = status.MODE_FAIL_SAFE
    rig.sending -= {0x281}
    rig.step(300)
    after_timeout = control_words(rig)[1_030:]
    assert set(after_timeout) == {status.CONTROL_HOLD}
    rig.sending |= {0x281}
    rig.step(200)
    assert rig.state == "active"


def test_setpoint_is_limited_and_saturation_counted():
    rig = Rig(sea__significant_height_m=3.0)
    rig.step(12_000)
    assert np.abs(setpoints(rig)).max() == 1.0 and rig.statistics.setpoint_max == 1.0
    assert rig.statistics.saturated_count > 100


def test_the_reference_stays_between_its_limits():
    rig = Rig(Cylinder(position_m=0.055))
    lowest = 1.0
    for _ in range(12_000):
        rig.step()
        lowest = min(lowest, rig.controller.reference_m or 1.0)
    assert lowest == pytest.approx(0.05)
    assert rig.cylinder.position_m > 0.0495


def test_two_runs_make_the_same_bytes():
    frames = []
    for _ in range(2):
        rig = Rig()
        rig.step(2_500)
        frames.append(rig.frames)
    assert frames[0] == frames[1]


def test_stop_puts_the_valve_in_neutral(tracked):
    rig = Rig()
    rig.step(2_000)
    can_id, data = rig.ffi.new("uint32_t *"), rig.ffi.new("uint8_t[8]")
    assert rig.lib.mc_stop(rig.controller, rig.now_us, can_id, data) == 8
    decoded = contract.database().decode_message(can_id[0], bytes(data), decode_choices=False)
    assert decoded["control"] == status.CONTROL_DISABLED and decoded["valve_setpoint"] == 0
    assert decoded["alive_counter"] == (rig.frames[-1][1][1] + 1) % 16


def test_foreign_frames_are_counted_and_ignored():
    rig = Rig()
    rig.step(100)
    before = bytes(rig.ffi.buffer(rig.ffi.addressof(rig.controller.measured)))
    for can_id in (0x182, 0x201, 0x7FF, 0x281 | 0x80000000, 0x281 | 0x40000000):
        assert rig.lib.mc_receive(rig.controller, can_id, bytes(8), 8, rig.now_us) == status.FRAME_UNKNOWN_ID
    assert rig.lib.mc_receive(rig.controller, 0x281, bytes(8), 7, rig.now_us) == status.FRAME_WRONG_LENGTH
    assert bytes(rig.ffi.buffer(rig.ffi.addressof(rig.controller.measured))) == before
    assert rig.statistics.frame_count[status.FRAME_UNKNOWN_ID] == 5


@pytest.mark.parametrize(
    "name, value",
    [
        ("axis", 0), ("axis", 5), ("ramp_s", 0.0), ("position_gain_per_s", -1.0), ("drop_pa_min", 0.0),
        ("position_m_min", 3.0), ("sea.peak_period_s", 0.0), ("sea.significant_height_m", -1.0), ("sea.lever", 0.0),
        ("extend.velocity_mps", 0.0), ("retract.velocity_mps", -1.0), ("extend.drop_pa", 0.0), ("ramp_s", float("nan")),
    ],
)  # fmt: skip
def test_configurations_that_cannot_work(name, value):
    ffi, lib = firmware_c.load()
    config, controller = ffi.new("mc_config_t *"), ffi.new("mc_t *")
    lib.mc_config_default(config)
    assert lib.mc_init(controller, config)
    target, *rest = name.split(".")
    setattr(getattr(config, target) if rest else config, rest[0] if rest else target, value)
    assert not lib.mc_init(controller, config)


def wave_of(height_m=0.5, period_s=8.0):
    ffi, lib = firmware_c.load()
    wave, sea = ffi.new("wave_t *"), ffi.new("wave_sea_t *", [height_m, period_s, 8.3])
    lib.wave_init(wave, sea)
    position, velocity = ffi.new("double *"), ffi.new("double *")

    def at(time_s):
        lib.wave_evaluate(wave, time_s, position, velocity)
        return position[0], velocity[0]

    return wave, at


def test_the_wave_is_within_what_the_valve_can_follow():
    """One hour of Hs 0.5 m, Tp 8 s at the rod: about 9 mm RMS, never beyond 25 mm or 23 mm/s."""
    _, at = wave_of()
    path = np.array([at(0.1 * index) for index in range(36_000)])
    assert 0.008 < path[:, 0].std() < 0.0105
    assert np.abs(path[:, 0]).max() < 0.025 and np.abs(path[:, 1]).max() < 0.023


def test_the_wave_velocity_is_its_derivative():
    _, at = wave_of()
    for time_s in np.linspace(0, 300, 50):
        slope = (at(time_s + 1e-4)[0] - at(time_s - 1e-4)[0]) / 2e-4
        assert at(time_s)[1] == pytest.approx(slope, abs=1e-9)


def test_the_wave_has_the_energy_of_its_spectrum():
    """Sum of squares against a fine integral of the JONSWAP spectrum times the response, written anew with numpy."""
    wave, _ = wave_of()
    omega = np.linspace(0.45, 1.75, 20_001)
    peak = 2 * np.pi / 8.0
    sharp = 3.3 ** np.exp(-((omega - peak) ** 2) / (2 * np.where(omega <= peak, 0.07, 0.09) ** 2 * peak**2))
    spectrum = (
        (1 - 0.287 * np.log(3.3)) * 5 / 16 * 0.25 * peak**4 * omega**-5.0 * np.exp(-1.25 * (omega / peak) ** -4) * sharp
    )
    k = omega**2 / 9.81
    rod = spectrum * (np.exp(-k * 5) * np.abs(np.sin(k * 9) / (k * 9)) / 8.3) ** 2
    energy = np.sum((rod[1:] + rod[:-1]) / 2 * np.diff(omega))
    assert sum(amplitude**2 / 2 for amplitude in wave.amplitude_m) == pytest.approx(energy, rel=0.15)


def test_the_wave_grows_with_the_sea():
    one, two = wave_of(0.25)[0], wave_of(0.5)[0]
    np.testing.assert_allclose(np.array(list(two.amplitude_m)), 2 * np.array(list(one.amplitude_m)), rtol=1e-12)
    assert not any(wave_of(0.0)[0].amplitude_m)
