/* Written by generate_messages.py from actuator.dbc; change the DBC and run it again. */
#include "actuator_messages.h"

#define REAL(number) ((actuator_real_t)(number))

/* Nearest whole number, ties to even, of a number within the range of int32. */
static int64_t whole(actuator_real_t number)
{
    int64_t below = (int64_t)number;
    if ((actuator_real_t)below > number) {
        below--;
    }
    actuator_real_t rest = number - (actuator_real_t)below;
    if (rest > REAL(0.5) || (rest == REAL(0.5) && below % 2 != 0)) {
        below++;
    }
    return below;
}

/* Raw number of a physical value, clamped; NaN becomes the raw number nearest to 0. */
static int64_t raw_of(actuator_real_t value, actuator_real_t scale, actuator_real_t offset, int64_t low, int64_t high)
{
    actuator_real_t number = (value - offset) / scale;
    if (!(number == number)) {
        number = 0;
    }
    if (number <= (actuator_real_t)low) {
        return low;
    }
    if (number >= (actuator_real_t)high) {
        return high;
    }
    return whole(number);
}

static int64_t clamped(int64_t value, int64_t low, int64_t high)
{
    return value < low ? low : value > high ? high : value;
}

/* A value outside its value table means nothing, least of all its neighbour: the start value is sent. */
static int64_t listed(int64_t value, int64_t low, int64_t high, int64_t start)
{
    return value < low || value > high ? start : value;
}

static const uint8_t pressures_data_ids[4][E2E_P02_COUNTER_MODULUS] = {
    {2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30, 32},
    {6, 12, 18, 24, 30, 36, 42, 48, 54, 60, 66, 72, 78, 84, 90, 96},
    {10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120, 130, 140, 150, 160},
    {14, 28, 42, 56, 70, 84, 98, 112, 126, 140, 154, 168, 182, 196, 210, 224},
};

size_t actuator_pressures_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_pressures_t *values)
{
    if (axis < 1 || axis > 4) {
        return 0;
    }
    for (size_t index = 0; index < 8; index++) {
        data[index] = 0;
    }
    uint64_t chamber_1_pressure_kpa_raw = (uint64_t)clamped((int64_t)values->chamber_1_pressure_kpa, 0, 60000);
    data[2] = (uint8_t)(data[2] | (chamber_1_pressure_kpa_raw & 0xFFu));
    data[3] = (uint8_t)(data[3] | ((chamber_1_pressure_kpa_raw >> 8) & 0xFFu));
    uint64_t chamber_2_pressure_kpa_raw = (uint64_t)clamped((int64_t)values->chamber_2_pressure_kpa, 0, 60000);
    data[4] = (uint8_t)(data[4] | (chamber_2_pressure_kpa_raw & 0xFFu));
    data[5] = (uint8_t)(data[5] | ((chamber_2_pressure_kpa_raw >> 8) & 0xFFu));
    uint64_t supply_pressure_kpa_raw = (uint64_t)clamped((int64_t)values->supply_pressure_kpa, 0, 60000);
    data[6] = (uint8_t)(data[6] | (supply_pressure_kpa_raw & 0xFFu));
    data[7] = (uint8_t)(data[7] | ((supply_pressure_kpa_raw >> 8) & 0xFFu));
    e2e_p02_protect(data, 8, pressures_data_ids[axis - 1], counter);
    return 8;
}

frame_status_t actuator_pressures_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_pressures_t *values)
{
    if (axis < 1 || axis > 4) {
        return FRAME_UNKNOWN_ID;
    }
    if (length != 8) {
        return FRAME_WRONG_LENGTH;
    }
    frame_status_t status = e2e_p02_check(receiver, data, 8, pressures_data_ids[axis - 1]);
    if (status != FRAME_VALID) {
        return status;
    }
    uint64_t chamber_1_pressure_kpa_bits = (uint64_t)(data[2] & 0xFFu)
        | ((uint64_t)(data[3] & 0xFFu) << 8);
    int64_t chamber_1_pressure_kpa_raw = (int64_t)chamber_1_pressure_kpa_bits;
    uint64_t chamber_2_pressure_kpa_bits = (uint64_t)(data[4] & 0xFFu)
        | ((uint64_t)(data[5] & 0xFFu) << 8);
    int64_t chamber_2_pressure_kpa_raw = (int64_t)chamber_2_pressure_kpa_bits;
    uint64_t supply_pressure_kpa_bits = (uint64_t)(data[6] & 0xFFu)
        | ((uint64_t)(data[7] & 0xFFu) << 8);
    int64_t supply_pressure_kpa_raw = (int64_t)supply_pressure_kpa_bits;
    if (chamber_1_pressure_kpa_raw > 60000 || chamber_2_pressure_kpa_raw > 60000 || supply_pressure_kpa_raw > 60000) {
        return FRAME_OUT_OF_RANGE;
    }
    values->chamber_1_pressure_kpa = (uint16_t)chamber_1_pressure_kpa_raw;
    values->chamber_2_pressure_kpa = (uint16_t)chamber_2_pressure_kpa_raw;
    values->supply_pressure_kpa = (uint16_t)supply_pressure_kpa_raw;
    e2e_p02_accept(receiver, data);
    return FRAME_VALID;
}

static const uint8_t valve_command_data_ids[4][E2E_P02_COUNTER_MODULUS] = {
    {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16},
    {5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55, 60, 65, 70, 75, 80},
    {9, 18, 27, 36, 45, 54, 63, 72, 81, 90, 99, 108, 117, 126, 135, 144},
    {13, 26, 39, 52, 65, 78, 91, 104, 117, 130, 143, 156, 169, 182, 195, 208},
};

size_t actuator_valve_command_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_valve_command_t *values)
{
    if (axis < 1 || axis > 4) {
        return 0;
    }
    for (size_t index = 0; index < 8; index++) {
        data[index] = 0;
    }
    uint64_t control_raw = (uint64_t)listed((int64_t)values->control, 0, 3, 0);
    data[1] = (uint8_t)(data[1] | ((control_raw & 0xFu) << 4));
    uint64_t valve_setpoint_raw = (uint64_t)raw_of(
        values->valve_setpoint, REAL(0.006103515625), REAL(0.0), -16384, 16384);
    data[2] = (uint8_t)(data[2] | (valve_setpoint_raw & 0xFFu));
    data[3] = (uint8_t)(data[3] | ((valve_setpoint_raw >> 8) & 0xFFu));
    uint64_t timestamp_us_raw = (uint64_t)clamped((int64_t)values->timestamp_us, 0, 4294967295);
    data[4] = (uint8_t)(data[4] | (timestamp_us_raw & 0xFFu));
    data[5] = (uint8_t)(data[5] | ((timestamp_us_raw >> 8) & 0xFFu));
    data[6] = (uint8_t)(data[6] | ((timestamp_us_raw >> 16) & 0xFFu));
    data[7] = (uint8_t)(data[7] | ((timestamp_us_raw >> 24) & 0xFFu));
    e2e_p02_protect(data, 8, valve_command_data_ids[axis - 1], counter);
    return 8;
}

frame_status_t actuator_valve_command_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_valve_command_t *values)
{
    if (axis < 1 || axis > 4) {
        return FRAME_UNKNOWN_ID;
    }
    if (length != 8) {
        return FRAME_WRONG_LENGTH;
    }
    frame_status_t status = e2e_p02_check(receiver, data, 8, valve_command_data_ids[axis - 1]);
    if (status != FRAME_VALID) {
        return status;
    }
    uint64_t control_bits = (uint64_t)((data[1] >> 4) & 0xFu);
    int64_t control_raw = (int64_t)control_bits;
    uint64_t valve_setpoint_bits = (uint64_t)(data[2] & 0xFFu)
        | ((uint64_t)(data[3] & 0xFFu) << 8);
    int64_t valve_setpoint_raw = (int64_t)(valve_setpoint_bits ^ 0x8000u) - 0x8000;
    uint64_t timestamp_us_bits = (uint64_t)(data[4] & 0xFFu)
        | ((uint64_t)(data[5] & 0xFFu) << 8)
        | ((uint64_t)(data[6] & 0xFFu) << 16)
        | ((uint64_t)(data[7] & 0xFFu) << 24);
    int64_t timestamp_us_raw = (int64_t)timestamp_us_bits;
    if (valve_setpoint_raw < -16384 || valve_setpoint_raw > 16384) {
        return FRAME_OUT_OF_RANGE;
    }
    if (control_raw > 3) {
        return FRAME_BAD_CONTROL;
    }
    values->control = (uint8_t)control_raw;
    values->valve_setpoint = (actuator_real_t)valve_setpoint_raw * REAL(0.006103515625) + REAL(0.0);
    values->timestamp_us = (uint32_t)timestamp_us_raw;
    e2e_p02_accept(receiver, data);
    return FRAME_VALID;
}

static const uint8_t motion_data_ids[4][E2E_P02_COUNTER_MODULUS] = {
    {3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45, 48},
    {7, 14, 21, 28, 35, 42, 49, 56, 63, 70, 77, 84, 91, 98, 105, 112},
    {11, 22, 33, 44, 55, 66, 77, 88, 99, 110, 121, 132, 143, 154, 165, 176},
    {15, 30, 45, 60, 75, 90, 105, 120, 135, 150, 165, 180, 195, 210, 225, 240},
};

size_t actuator_motion_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_motion_t *values)
{
    if (axis < 1 || axis > 4) {
        return 0;
    }
    for (size_t index = 0; index < 8; index++) {
        data[index] = 0;
    }
    uint64_t rod_position_mm_raw = (uint64_t)raw_of(
        values->rod_position_mm, REAL(0.001), REAL(0.0), -20000000, 20000000);
    data[2] = (uint8_t)(data[2] | (rod_position_mm_raw & 0xFFu));
    data[3] = (uint8_t)(data[3] | ((rod_position_mm_raw >> 8) & 0xFFu));
    data[4] = (uint8_t)(data[4] | ((rod_position_mm_raw >> 16) & 0xFFu));
    data[5] = (uint8_t)(data[5] | ((rod_position_mm_raw >> 24) & 0xFFu));
    uint64_t rod_velocity_mmps_raw = (uint64_t)raw_of(
        values->rod_velocity_mmps, REAL(0.1), REAL(0.0), -30000, 30000);
    data[6] = (uint8_t)(data[6] | (rod_velocity_mmps_raw & 0xFFu));
    data[7] = (uint8_t)(data[7] | ((rod_velocity_mmps_raw >> 8) & 0xFFu));
    e2e_p02_protect(data, 8, motion_data_ids[axis - 1], counter);
    return 8;
}

frame_status_t actuator_motion_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_motion_t *values)
{
    if (axis < 1 || axis > 4) {
        return FRAME_UNKNOWN_ID;
    }
    if (length != 8) {
        return FRAME_WRONG_LENGTH;
    }
    frame_status_t status = e2e_p02_check(receiver, data, 8, motion_data_ids[axis - 1]);
    if (status != FRAME_VALID) {
        return status;
    }
    uint64_t rod_position_mm_bits = (uint64_t)(data[2] & 0xFFu)
        | ((uint64_t)(data[3] & 0xFFu) << 8)
        | ((uint64_t)(data[4] & 0xFFu) << 16)
        | ((uint64_t)(data[5] & 0xFFu) << 24);
    int64_t rod_position_mm_raw = (int64_t)(rod_position_mm_bits ^ 0x80000000u) - 0x80000000;
    uint64_t rod_velocity_mmps_bits = (uint64_t)(data[6] & 0xFFu)
        | ((uint64_t)(data[7] & 0xFFu) << 8);
    int64_t rod_velocity_mmps_raw = (int64_t)(rod_velocity_mmps_bits ^ 0x8000u) - 0x8000;
    if (rod_position_mm_raw < -20000000 || rod_position_mm_raw > 20000000 || rod_velocity_mmps_raw < -30000 || rod_velocity_mmps_raw > 30000) {
        return FRAME_OUT_OF_RANGE;
    }
    values->rod_position_mm = (actuator_real_t)rod_position_mm_raw * REAL(0.001) + REAL(0.0);
    values->rod_velocity_mmps = (actuator_real_t)rod_velocity_mmps_raw * REAL(0.1) + REAL(0.0);
    e2e_p02_accept(receiver, data);
    return FRAME_VALID;
}

static const uint8_t bench_status_data_ids[4][E2E_P02_COUNTER_MODULUS] = {
    {4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60, 64},
    {8, 16, 24, 32, 40, 48, 56, 64, 72, 80, 88, 96, 104, 112, 120, 128},
    {12, 24, 36, 48, 60, 72, 84, 96, 108, 120, 132, 144, 156, 168, 180, 192},
    {16, 32, 48, 64, 80, 96, 112, 128, 144, 160, 176, 192, 208, 224, 240, 5},
};

size_t actuator_bench_status_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_bench_status_t *values)
{
    if (axis < 1 || axis > 4) {
        return 0;
    }
    for (size_t index = 0; index < 8; index++) {
        data[index] = 0;
    }
    uint64_t bench_state_raw = (uint64_t)listed((int64_t)values->bench_state, 0, 6, 0);
    data[1] = (uint8_t)(data[1] | ((bench_state_raw & 0xFu) << 4));
    uint64_t flags_raw = (uint64_t)clamped((int64_t)values->flags, 0, 255);
    data[2] = (uint8_t)(data[2] | (flags_raw & 0xFFu));
    uint64_t deadline_misses_raw = (uint64_t)clamped((int64_t)values->deadline_misses, 0, 255);
    data[3] = (uint8_t)(data[3] | (deadline_misses_raw & 0xFFu));
    uint64_t tick_raw = (uint64_t)clamped((int64_t)values->tick, 0, 65535);
    data[4] = (uint8_t)(data[4] | (tick_raw & 0xFFu));
    data[5] = (uint8_t)(data[5] | ((tick_raw >> 8) & 0xFFu));
    uint64_t echoed_timestamp_us_raw = (uint64_t)clamped((int64_t)values->echoed_timestamp_us, 0, 65535);
    data[6] = (uint8_t)(data[6] | (echoed_timestamp_us_raw & 0xFFu));
    data[7] = (uint8_t)(data[7] | ((echoed_timestamp_us_raw >> 8) & 0xFFu));
    e2e_p02_protect(data, 8, bench_status_data_ids[axis - 1], counter);
    return 8;
}

frame_status_t actuator_bench_status_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_bench_status_t *values)
{
    if (axis < 1 || axis > 4) {
        return FRAME_UNKNOWN_ID;
    }
    if (length != 8) {
        return FRAME_WRONG_LENGTH;
    }
    frame_status_t status = e2e_p02_check(receiver, data, 8, bench_status_data_ids[axis - 1]);
    if (status != FRAME_VALID) {
        return status;
    }
    uint64_t bench_state_bits = (uint64_t)((data[1] >> 4) & 0xFu);
    int64_t bench_state_raw = (int64_t)bench_state_bits;
    uint64_t flags_bits = (uint64_t)(data[2] & 0xFFu);
    int64_t flags_raw = (int64_t)flags_bits;
    uint64_t deadline_misses_bits = (uint64_t)(data[3] & 0xFFu);
    int64_t deadline_misses_raw = (int64_t)deadline_misses_bits;
    uint64_t tick_bits = (uint64_t)(data[4] & 0xFFu)
        | ((uint64_t)(data[5] & 0xFFu) << 8);
    int64_t tick_raw = (int64_t)tick_bits;
    uint64_t echoed_timestamp_us_bits = (uint64_t)(data[6] & 0xFFu)
        | ((uint64_t)(data[7] & 0xFFu) << 8);
    int64_t echoed_timestamp_us_raw = (int64_t)echoed_timestamp_us_bits;
    if (bench_state_raw > 6) {
        return FRAME_BAD_CONTROL;
    }
    values->bench_state = (uint8_t)bench_state_raw;
    values->flags = (uint8_t)flags_raw;
    values->deadline_misses = (uint8_t)deadline_misses_raw;
    values->tick = (uint16_t)tick_raw;
    values->echoed_timestamp_us = (uint16_t)echoed_timestamp_us_raw;
    e2e_p02_accept(receiver, data);
    return FRAME_VALID;
}

static const uint8_t heave_data_ids[4][E2E_P02_COUNTER_MODULUS] = {
    {250, 249, 248, 247, 246, 245, 244, 243, 242, 241, 240, 239, 238, 237, 236, 235},
    {249, 247, 245, 243, 241, 239, 237, 235, 233, 231, 229, 227, 225, 223, 221, 219},
    {248, 245, 242, 239, 236, 233, 230, 227, 224, 221, 218, 215, 212, 209, 206, 203},
    {247, 243, 239, 235, 231, 227, 223, 219, 215, 211, 207, 203, 199, 195, 191, 187},
};

size_t actuator_heave_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_heave_t *values)
{
    if (axis < 1 || axis > 4) {
        return 0;
    }
    for (size_t index = 0; index < 8; index++) {
        data[index] = 0;
    }
    uint64_t heave_position_mm_raw = (uint64_t)raw_of(
        values->heave_position_mm, REAL(0.01), REAL(0.0), -2000000, 2000000);
    data[2] = (uint8_t)(data[2] | (heave_position_mm_raw & 0xFFu));
    data[3] = (uint8_t)(data[3] | ((heave_position_mm_raw >> 8) & 0xFFu));
    data[4] = (uint8_t)(data[4] | ((heave_position_mm_raw >> 16) & 0xFFu));
    data[5] = (uint8_t)(data[5] | ((heave_position_mm_raw >> 24) & 0xFFu));
    uint64_t heave_velocity_mmps_raw = (uint64_t)raw_of(
        values->heave_velocity_mmps, REAL(0.5), REAL(0.0), -30000, 30000);
    data[6] = (uint8_t)(data[6] | (heave_velocity_mmps_raw & 0xFFu));
    data[7] = (uint8_t)(data[7] | ((heave_velocity_mmps_raw >> 8) & 0xFFu));
    e2e_p02_protect(data, 8, heave_data_ids[axis - 1], counter);
    return 8;
}

frame_status_t actuator_heave_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_heave_t *values)
{
    if (axis < 1 || axis > 4) {
        return FRAME_UNKNOWN_ID;
    }
    if (length != 8) {
        return FRAME_WRONG_LENGTH;
    }
    frame_status_t status = e2e_p02_check(receiver, data, 8, heave_data_ids[axis - 1]);
    if (status != FRAME_VALID) {
        return status;
    }
    uint64_t heave_position_mm_bits = (uint64_t)(data[2] & 0xFFu)
        | ((uint64_t)(data[3] & 0xFFu) << 8)
        | ((uint64_t)(data[4] & 0xFFu) << 16)
        | ((uint64_t)(data[5] & 0xFFu) << 24);
    int64_t heave_position_mm_raw = (int64_t)(heave_position_mm_bits ^ 0x80000000u) - 0x80000000;
    uint64_t heave_velocity_mmps_bits = (uint64_t)(data[6] & 0xFFu)
        | ((uint64_t)(data[7] & 0xFFu) << 8);
    int64_t heave_velocity_mmps_raw = (int64_t)(heave_velocity_mmps_bits ^ 0x8000u) - 0x8000;
    if (heave_position_mm_raw < -2000000 || heave_position_mm_raw > 2000000 || heave_velocity_mmps_raw < -30000 || heave_velocity_mmps_raw > 30000) {
        return FRAME_OUT_OF_RANGE;
    }
    values->heave_position_mm = (actuator_real_t)heave_position_mm_raw * REAL(0.01) + REAL(0.0);
    values->heave_velocity_mmps = (actuator_real_t)heave_velocity_mmps_raw * REAL(0.5) + REAL(0.0);
    e2e_p02_accept(receiver, data);
    return FRAME_VALID;
}
