/* Written by generate_messages.py from actuator.dbc; change the DBC and run it again. */

/* Messages between a motion-control firmware and the actuator bench: values <-> bytes, protected by E2E profile 2.
 *
 * pack: clamps every number to the range of the DBC (NaN is sent as the one nearest to 0; a value outside its value
 *   table as the start value), moves the counter on, writes counter and CRC. Rounds half to even. `counter`
 *   belongs to the caller, one a message, 0 at first.
 * unpack: FRAME_VALID, or why the frame must not be used; then `values` and (but for the resynchronisation told in
 *   e2e_p02.h) the receiver are as before.
 * axis: 1..4; anything else packs nothing and returns 0, or unpacks to FRAME_UNKNOWN_ID.
 * No heap, no globals, no floating-point environment, nothing blocks. */
#ifndef ACTUATOR_MESSAGES_H
#define ACTUATOR_MESSAGES_H

#include <stddef.h>
#include <stdint.h>

#include "e2e_p02.h"

/* float would lose the last digit of a position beyond 8 m */
#ifndef ACTUATOR_REAL
#define ACTUATOR_REAL double
#endif
typedef ACTUATOR_REAL actuator_real_t;

#define ACTUATOR_AXIS_COUNT 4

/* PRESSURES_k, BENCH -> FIRMWARE: Pressure transmitters of the axis, gauge pressure. */
#define ACTUATOR_PRESSURES_ID(axis) (0x180u + (axis))
#define ACTUATOR_PRESSURES_LENGTH 8
#define ACTUATOR_PRESSURES_CYCLE_MS 1

typedef struct {
    /* kPa, [0, 60000]. Bore-side chamber. Suction below atmosphere reads 0, as a 0..600 bar transmitter does;
     * above 60000 is not sent. */
    uint16_t chamber_1_pressure_kpa;
    /* kPa, [0, 60000]. Rod-side chamber. Suction below atmosphere reads 0; above 60000 is not sent. */
    uint16_t chamber_2_pressure_kpa;
    /* kPa, [0, 60000]. Pump line at the directional valve. */
    uint16_t supply_pressure_kpa;
} actuator_pressures_t;

size_t actuator_pressures_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_pressures_t *values);
frame_status_t actuator_pressures_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_pressures_t *values);

/* VALVE_COMMAND_k, FIRMWARE -> BENCH: Valve command of the axis. Not protected, repeated, late or out-of-range
 * frames are counted by the bench and otherwise ignored. */
#define ACTUATOR_VALVE_COMMAND_ID(axis) (0x200u + (axis))
#define ACTUATOR_VALVE_COMMAND_LENGTH 8
#define ACTUATOR_VALVE_COMMAND_CYCLE_MS 1

enum {
    ACTUATOR_CONTROL_DISABLED = 0,
    ACTUATOR_CONTROL_HOLD = 1,
    ACTUATOR_CONTROL_ACTIVE = 2,
    ACTUATOR_CONTROL_RESET = 3
};

typedef struct {
    /* [0, 3]. Disabled and Hold put the valve in neutral whatever the set point; Active lets the set point
     * through; Reset leaves the latched fail-safe (valve neutral until Active). */
    uint8_t control;
    /* %, [-100, 100]. Spool set point, raw 16384 = 100 % (CiA 408, 6300h:1); positive extends the rod. A frame
     * outside -100..100 % is not used. */
    actuator_real_t valve_setpoint;
    /* us, [0, 4294967295]. The sender's own microsecond clock, free running; its low 16 bits come back in
     * BENCH_STATUS_1.echoed_timestamp_us. */
    uint32_t timestamp_us;
} actuator_valve_command_t;

size_t actuator_valve_command_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_valve_command_t *values);
frame_status_t actuator_valve_command_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_valve_command_t *values);

/* MOTION_k, BENCH -> FIRMWARE: Position and velocity transmitter of the cylinder. */
#define ACTUATOR_MOTION_ID(axis) (0x280u + (axis))
#define ACTUATOR_MOTION_LENGTH 8
#define ACTUATOR_MOTION_CYCLE_MS 1

typedef struct {
    /* mm, [-20000, 20000]. Rod position from the retracted end, resolution 1 um. */
    actuator_real_t rod_position_mm;
    /* mm/s, [-3000, 3000]. Rod velocity, positive extending, resolution 0.1 mm/s. */
    actuator_real_t rod_velocity_mmps;
} actuator_motion_t;

size_t actuator_motion_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_motion_t *values);
frame_status_t actuator_motion_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_motion_t *values);

/* BENCH_STATUS_k, BENCH -> FIRMWARE: What the bench does with the commands, and how well it keeps time. */
#define ACTUATOR_BENCH_STATUS_ID(axis) (0x380u + (axis))
#define ACTUATOR_BENCH_STATUS_LENGTH 8
#define ACTUATOR_BENCH_STATUS_CYCLE_MS 10

enum {
    ACTUATOR_BENCH_STATE_WAITING = 0,
    ACTUATOR_BENCH_STATE_DISABLED = 1,
    ACTUATOR_BENCH_STATE_HOLD = 2,
    ACTUATOR_BENCH_STATE_ACTIVE = 3,
    ACTUATOR_BENCH_STATE_STALE_HOLD = 4,
    ACTUATOR_BENCH_STATE_STALE_RAMP = 5,
    ACTUATOR_BENCH_STATE_FAIL_SAFE = 6
};

enum {
    ACTUATOR_FLAGS_NONE = 0,
    ACTUATOR_FLAGS_OUTSIDE_TRAINING_RANGE = 1,
    ACTUATOR_FLAGS_END_STOP = 2,
    ACTUATOR_FLAGS_CAVITATION = 4,
    ACTUATOR_FLAGS_FAIL_SAFE = 8,
    ACTUATOR_FLAGS_SOLVER_LIMIT = 16,
    ACTUATOR_FLAGS_NOT_FINITE = 32,
    ACTUATOR_FLAGS_FAULT_ACTIVE = 64
};

typedef struct {
    /* [0, 6]. What the bench applies to the valve now. */
    uint8_t bench_state;
    /* [0, 255]. Bits: 0 outside training range, 1 end stop, 2 cavitation, 3 fail-safe, 4 solver limit, 5 not
     * finite, 6 fault injected. */
    uint8_t flags;
    /* [0, 255]. Periods the bench has missed since its start; stays at 255. */
    uint8_t deadline_misses;
    /* [0, 65535]. Low 16 bits of the bench's period number, as in its log. */
    uint16_t tick;
    /* us, [0, 65535]. Low 16 bits of timestamp_us of the newest valid command: the sender's clock minus this is
     * the round trip (up to 65 ms). */
    uint16_t echoed_timestamp_us;
} actuator_bench_status_t;

size_t actuator_bench_status_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_bench_status_t *values);
frame_status_t actuator_bench_status_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_bench_status_t *values);

/* HEAVE_k, BENCH -> FIRMWARE: Motion reference unit: the heave of the vessel that moves the load of this axis. All
 * zero where the profile has no wave. */
#define ACTUATOR_HEAVE_ID(axis) (0x480u + (axis))
#define ACTUATOR_HEAVE_LENGTH 8
#define ACTUATOR_HEAVE_CYCLE_MS 10

typedef struct {
    /* mm, [-20000, 20000]. Heave of the vessel from its rest, positive upwards, as the load feels it in this
     * period. */
    actuator_real_t heave_position_mm;
    /* mm/s, [-15000, 15000]. Its speed, positive upwards. */
    actuator_real_t heave_velocity_mmps;
} actuator_heave_t;

size_t actuator_heave_pack(uint8_t *data, unsigned axis, uint8_t *counter,
    const actuator_heave_t *values);
frame_status_t actuator_heave_unpack(const uint8_t *data, size_t length, unsigned axis,
    e2e_p02_receiver_t *receiver, actuator_heave_t *values);

#endif
