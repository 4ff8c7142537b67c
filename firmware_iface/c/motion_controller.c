#include "motion_controller.h"

#include <math.h>

#define US_PER_S 1e6
#define MM_PER_M 1e3
#define PA_PER_KPA 1e3

void mc_config_default(mc_config_t *config)
{
    mc_config_t values = {
        .axis = 1,
        .sea = {.significant_height_m = 0.5, .peak_period_s = 8.0, .lever = 8.3},
        .ramp_s = 2.0,
        .position_gain_per_s = 2.0,
        .extend = {.velocity_mps = 0.0225, .drop_pa = 20.8e6},
        .retract = {.velocity_mps = 0.0222, .drop_pa = 29.2e6},
        .drop_pa_min = 1e6,
        .position_m_min = 0.05,
        .position_m_max = 1.95,
        .motion_timeout_us = 20000,
        .pressures_timeout_us = 20000,
        .status_timeout_us = 100000,
        .recovery_us = 100000,
    };
    *config = values;
}

bool mc_init(mc_t *controller, const mc_config_t *config)
{
    bool usable = config->axis >= 1 && config->axis <= ACTUATOR_AXIS_COUNT && config->sea.significant_height_m >= 0.0
        && config->sea.peak_period_s > 0.0 && config->sea.lever > 0.0 && config->ramp_s > 0.0
        && config->position_gain_per_s >= 0.0 && config->extend.velocity_mps > 0.0 && config->extend.drop_pa > 0.0
        && config->retract.velocity_mps > 0.0 && config->retract.drop_pa > 0.0 && config->drop_pa_min > 0.0
        && config->position_m_min < config->position_m_max;
    if (!usable) {
        return false;
    }
    *controller = (mc_t){.config = *config, .state = MC_START};
    wave_init(&controller->wave, &config->sea);
    e2e_p02_receiver_init(&controller->measured.motion_receiver, E2E_P02_MAX_DELTA_DEFAULT);
    e2e_p02_receiver_init(&controller->measured.pressures_receiver, E2E_P02_MAX_DELTA_DEFAULT);
    e2e_p02_receiver_init(&controller->measured.status_receiver, E2E_P02_MAX_DELTA_DEFAULT);
    return true;
}

/* Sender's clock minus echo, modulo 2^16; only an echo not seen before tells a round trip. */
static void measure_round_trip(mc_t *controller, uint64_t now_us)
{
    const actuator_bench_status_t *status = &controller->measured.status;
    mc_statistics_t *statistics = &controller->statistics;
    bool answered = status->bench_state != ACTUATOR_BENCH_STATE_WAITING;
    if (!answered || status->echoed_timestamp_us == controller->echo_seen) {
        return;
    }
    uint16_t round_trip_us = (uint16_t)((uint16_t)now_us - status->echoed_timestamp_us);
    controller->echo_seen = status->echoed_timestamp_us;
    statistics->round_trip_count++;
    statistics->round_trip_us_sum += round_trip_us;
    if (round_trip_us > statistics->round_trip_us_max) {
        statistics->round_trip_us_max = round_trip_us;
    }
}

frame_status_t mc_receive(mc_t *controller, uint32_t can_id, const uint8_t *data, size_t length, uint64_t now_us)
{
    unsigned axis = controller->config.axis;
    mc_measured_t *measured = &controller->measured;
    frame_status_t status = FRAME_UNKNOWN_ID;
    if (can_id == ACTUATOR_MOTION_ID(axis)) {
        status = actuator_motion_unpack(data, length, axis, &measured->motion_receiver, &measured->motion);
        if (status == FRAME_VALID) {
            measured->motion_us = now_us;
            measured->motion_seen = true;
        }
    } else if (can_id == ACTUATOR_PRESSURES_ID(axis)) {
        status = actuator_pressures_unpack(data, length, axis, &measured->pressures_receiver, &measured->pressures);
        if (status == FRAME_VALID) {
            measured->pressures_us = now_us;
            measured->pressures_seen = true;
        }
    } else if (can_id == ACTUATOR_BENCH_STATUS_ID(axis)) {
        status = actuator_bench_status_unpack(data, length, axis, &measured->status_receiver, &measured->status);
        if (status == FRAME_VALID) {
            measured->status_us = now_us;
            measured->status_seen = true;
            measure_round_trip(controller, now_us);
        }
    }
    controller->statistics.frame_count[status]++;
    return status;
}

/* A time ahead of now (a caller that stamps frames later than the period) counts as fresh. */
static bool fresh(bool seen, uint64_t stamp_us, uint32_t timeout_us, uint64_t now_us)
{
    return seen && (stamp_us >= now_us || now_us - stamp_us <= timeout_us);
}

static bool all_fresh(const mc_t *controller, uint64_t now_us)
{
    const mc_measured_t *measured = &controller->measured;
    const mc_config_t *config = &controller->config;
    return fresh(measured->motion_seen, measured->motion_us, config->motion_timeout_us, now_us)
        && fresh(measured->pressures_seen, measured->pressures_us, config->pressures_timeout_us, now_us)
        && fresh(measured->status_seen, measured->status_us, config->status_timeout_us, now_us);
}

static double limited(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

static double measured_position_m(const mc_t *controller)
{
    return (double)controller->measured.motion.rod_position_mm / MM_PER_M;
}

static void enter_active(mc_t *controller, uint64_t now_us)
{
    controller->state = MC_ACTIVE;
    controller->active_since_us = now_us;
    controller->middle_m =
        limited(measured_position_m(controller), controller->config.position_m_min, controller->config.position_m_max);
}

static void enter_hold(mc_t *controller)
{
    controller->state = MC_HOLD;
    controller->fresh_since_us = 0;
    controller->statistics.measurement_timeout_count++;
}

static void enter_reset(mc_t *controller)
{
    controller->state = MC_RESET;
    controller->statistics.fail_safe_count++;
}

/* MC_HOLD is left only after the measurements have been fresh for a while without a gap. */
static bool recovered(mc_t *controller, bool is_fresh, uint64_t now_us)
{
    if (!is_fresh) {
        controller->fresh_since_us = 0;
        return false;
    }
    if (controller->fresh_since_us == 0) {
        controller->fresh_since_us = now_us;
    }
    return now_us - controller->fresh_since_us >= controller->config.recovery_us;
}

static void decide_state(mc_t *controller, uint64_t now_us)
{
    bool is_fresh = all_fresh(controller, now_us);
    bool is_fail_safe = is_fresh && controller->measured.status.bench_state == ACTUATOR_BENCH_STATE_FAIL_SAFE;
    switch (controller->state) {
    case MC_START:
        if (is_fail_safe) {
            enter_reset(controller);
        } else if (is_fresh) {
            enter_active(controller, now_us);
        }
        break;
    case MC_ACTIVE:
        if (!is_fresh) {
            enter_hold(controller);
        } else if (is_fail_safe) {
            enter_reset(controller);
        }
        break;
    case MC_HOLD:
        if (recovered(controller, is_fresh, now_us)) {
            if (is_fail_safe) {
                enter_reset(controller);
            } else {
                enter_active(controller, now_us);
            }
        }
        break;
    case MC_RESET:
        if (!is_fresh) {
            enter_hold(controller);
        } else if (!is_fail_safe) {
            enter_active(controller, now_us);
        }
        break;
    }
}

/* Reference of this period: the wave, brought in smoothly (its velocity begins and ends the ramp without a jump). */
static void reference(const mc_t *controller, uint64_t now_us, double *position_m, double *velocity_mps, bool *ramped)
{
    double time_s = (double)(now_us - controller->active_since_us) / US_PER_S;
    double wave_m;
    double wave_mps;
    wave_evaluate(&controller->wave, time_s, &wave_m, &wave_mps);
    double share = limited(time_s / controller->config.ramp_s, 0.0, 1.0);
    double weight = share * share * (3.0 - 2.0 * share);
    double weight_per_s = 6.0 * share * (1.0 - share) / controller->config.ramp_s;
    double target_m = controller->middle_m + weight * wave_m;
    *position_m = limited(target_m, controller->config.position_m_min, controller->config.position_m_max);
    *velocity_mps = *position_m == target_m ? weight * wave_mps + weight_per_s * wave_m : 0.0;
    *ramped = share >= 1.0;
}

/* Rod velocity at full valve in the wanted direction: q = k sqrt(drop), scaled from the nominal point. */
static double full_valve_velocity_mps(const mc_t *controller, bool extending)
{
    const mc_config_t *config = &controller->config;
    const actuator_pressures_t *pressures = &controller->measured.pressures;
    const mc_valve_gain_t *gain = extending ? &config->extend : &config->retract;
    double fed_kpa = extending ? pressures->chamber_1_pressure_kpa : pressures->chamber_2_pressure_kpa;
    double drop_pa = ((double)pressures->supply_pressure_kpa - fed_kpa) * PA_PER_KPA;
    return gain->velocity_mps * sqrt(fmax(drop_pa, config->drop_pa_min) / gain->drop_pa);
}

static void judge(mc_t *controller, double error_m, double wave_m)
{
    mc_statistics_t *statistics = &controller->statistics;
    statistics->tracked_count++;
    statistics->error_square_sum_m2 += error_m * error_m;
    statistics->error_m_max = fmax(statistics->error_m_max, fabs(error_m));
    statistics->reference_square_sum_m2 += wave_m * wave_m;
    statistics->reference_m_max = fmax(statistics->reference_m_max, fabs(wave_m));
}

/* Set point of an active period, -1..1. */
static double control(mc_t *controller, uint64_t now_us)
{
    double position_m;
    double velocity_mps;
    bool ramped;
    reference(controller, now_us, &position_m, &velocity_mps, &ramped);
    double error_m = position_m - measured_position_m(controller);
    double wanted_mps = velocity_mps + controller->config.position_gain_per_s * error_m;
    double setpoint = wanted_mps / full_valve_velocity_mps(controller, wanted_mps >= 0.0);
    mc_statistics_t *statistics = &controller->statistics;
    statistics->active_count++;
    if (fabs(setpoint) >= 1.0) {
        statistics->saturated_count++;
    }
    setpoint = limited(setpoint, -1.0, 1.0);
    statistics->setpoint_max = fmax(statistics->setpoint_max, fabs(setpoint));
    if (ramped) {
        judge(controller, error_m, position_m - controller->middle_m);
    }
    controller->reference_m = position_m;
    return setpoint;
}

static size_t make_command(mc_t *controller, uint8_t word, uint64_t now_us, uint32_t *can_id, uint8_t *data)
{
    actuator_valve_command_t command = {
        .control = word,
        .valve_setpoint = (actuator_real_t)(100.0 * controller->setpoint),
        .timestamp_us = (uint32_t)now_us,
    };
    *can_id = ACTUATOR_VALVE_COMMAND_ID(controller->config.axis);
    return actuator_valve_command_pack(data, controller->config.axis, &controller->alive_counter, &command);
}

size_t mc_step(mc_t *controller, uint64_t now_us, uint32_t *can_id, uint8_t *data)
{
    uint8_t word = ACTUATOR_CONTROL_DISABLED;
    controller->statistics.period_count++;
    decide_state(controller, now_us);
    controller->setpoint = 0.0;
    switch (controller->state) {
    case MC_START:
        break;
    case MC_ACTIVE:
        word = ACTUATOR_CONTROL_ACTIVE;
        controller->setpoint = control(controller, now_us);
        break;
    case MC_HOLD:
        word = ACTUATOR_CONTROL_HOLD;
        break;
    case MC_RESET:
        word = ACTUATOR_CONTROL_RESET;
        controller->statistics.reset_frame_count++;
        break;
    }
    return make_command(controller, word, now_us, can_id, data);
}

size_t mc_stop(mc_t *controller, uint64_t now_us, uint32_t *can_id, uint8_t *data)
{
    controller->setpoint = 0.0;
    return make_command(controller, ACTUATOR_CONTROL_DISABLED, now_us, can_id, data);
}
