/* Motion-compensation controller of one axis: the rod follows a wave reference, by feed-forward and position control.
 *
 * The portable core of the reference firmware. It has no heap, no globals, no clock and no bus: the caller hands in
 * received frames and the time, and takes one command frame each period. One caller at a time per struct.
 *
 * Invariants: a command frame is made in every period, whatever the state (it is the heartbeat the bench watches); its
 * set point is 0 in every state but MC_ACTIVE; nothing of a rejected frame is used; counters never go back.
 *
 *   MC_START --all measurements fresh--> MC_ACTIVE --one too old--> MC_HOLD --fresh for recovery_us--> MC_ACTIVE
 *   any state but MC_START --bench says fail-safe, measurements fresh--> MC_RESET --bench says otherwise--> MC_ACTIVE
 *
 * Entering MC_ACTIVE takes the measured position as the middle of the motion and brings the wave in over ramp_s. */
#ifndef MOTION_CONTROLLER_H
#define MOTION_CONTROLLER_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "actuator_messages.h"
#include "wave.h"

#define MC_FRAME_STATUS_COUNT 11

typedef enum {
    MC_START = 0,  /* sends Disabled: not all measurements seen yet */
    MC_ACTIVE = 1, /* sends Active and the set point */
    MC_HOLD = 2,   /* sends Hold: a measurement is too old */
    MC_RESET = 3   /* sends Reset: the bench has latched its fail-safe */
} mc_state_t;

/* Velocity at full valve and the pressure drop over the feeding edge at which it was found; between, q ~ sqrt(drop). */
typedef struct {
    double velocity_mps;
    double drop_pa;
} mc_valve_gain_t;

typedef struct {
    unsigned axis; /* 1..ACTUATOR_AXIS_COUNT */
    wave_sea_t sea;
    double ramp_s;
    double position_gain_per_s;
    mc_valve_gain_t extend;  /* pump feeds chamber 1 */
    mc_valve_gain_t retract; /* pump feeds chamber 2 */
    double drop_pa_min;      /* the feed-forward trusts no smaller drop */
    double position_m_min;   /* the reference stays between these */
    double position_m_max;
    uint32_t motion_timeout_us;
    uint32_t pressures_timeout_us;
    uint32_t status_timeout_us;
    uint32_t recovery_us;
} mc_config_t;

/* Written by mc_receive only. Age of a measurement: now minus its *_us; valid only after its *_seen. */
typedef struct {
    actuator_motion_t motion;
    actuator_pressures_t pressures;
    actuator_bench_status_t status;
    uint64_t motion_us;
    uint64_t pressures_us;
    uint64_t status_us;
    bool motion_seen;
    bool pressures_seen;
    bool status_seen;
    e2e_p02_receiver_t motion_receiver;
    e2e_p02_receiver_t pressures_receiver;
    e2e_p02_receiver_t status_receiver;
} mc_measured_t;

/* Tracking is judged in MC_ACTIVE after the ramp only. */
typedef struct {
    uint64_t period_count;
    uint64_t active_count;
    uint64_t saturated_count;                     /* periods with the set point at its limit */
    uint64_t frame_count[MC_FRAME_STATUS_COUNT];  /* received frames by frame_status_t */
    uint32_t measurement_timeout_count;           /* times MC_HOLD was entered */
    uint32_t fail_safe_count;                     /* times MC_RESET was entered */
    uint64_t reset_frame_count;
    uint64_t tracked_count;
    double error_square_sum_m2;
    double error_m_max;
    double reference_square_sum_m2; /* of the reference around its middle */
    double reference_m_max;
    double setpoint_max;            /* largest magnitude, 0..1 */
    uint64_t round_trip_count;
    uint64_t round_trip_us_sum;
    uint32_t round_trip_us_max;
} mc_statistics_t;

typedef struct {
    mc_config_t config;
    wave_t wave;
    mc_measured_t measured;
    mc_statistics_t statistics;
    mc_state_t state;
    uint8_t alive_counter;
    uint64_t fresh_since_us; /* MC_HOLD: measurements are fresh since then; 0: they are not */
    uint64_t active_since_us;
    double middle_m;
    double reference_m;      /* of the newest period */
    double setpoint;         /* of the newest period, -1..1 */
    uint16_t echo_seen;      /* newest echoed time stamp, so that each is measured once */
} mc_t;

/* Values for the amc-lift bench: 320/200 mm cylinder, 23 mm/s at full valve. */
void mc_config_default(mc_config_t *config);

/* false: the configuration cannot work (axis, gains, limits or sea out of range). */
bool mc_init(mc_t *controller, const mc_config_t *config);

/* Takes one received frame (11-bit identifier, no remote or error frame) and says what became of it. */
frame_status_t mc_receive(mc_t *controller, uint32_t can_id, const uint8_t *data, size_t length, uint64_t now_us);

/* One period: decides the state, makes the command frame. data: 8 bytes, written. Returns the frame's length. */
size_t mc_step(mc_t *controller, uint64_t now_us, uint32_t *can_id, uint8_t *data);

/* A last frame that puts the valve in neutral (Disabled, set point 0), for a controller that is about to stop. */
size_t mc_stop(mc_t *controller, uint64_t now_us, uint32_t *can_id, uint8_t *data);

#endif
