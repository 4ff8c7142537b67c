/* The reference firmware on Linux: the motion-compensation controller on a SocketCAN interface, in a fixed period.
 *
 * This file knows the clock, the bus and the command line; everything else is motion_controller.c.
 * The period is absolute: deadline = start + n * period on CLOCK_MONOTONIC; a late period skips whole ones and counts them. */
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <getopt.h>
#include <math.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "motion_controller.h"

enum { EXIT_DONE = 0, EXIT_USAGE = 2, EXIT_CAN_LOST = 4 };

#define NS_PER_S 1000000000LL
#define NS_PER_US 1000LL

typedef struct {
    const char *interface;
    long period_us;
    double duration_s; /* 0: until a signal */
    int priority;       /* SCHED_FIFO 1..99; 0: as started */
    double die_after_s; /* 0: never; else stop dead, without a last frame, as a crash would */
    mc_config_t controller;
} options_t;

typedef struct {
    uint64_t late_count;
    uint64_t skipped_count;
    uint64_t lateness_ns_max;
    uint64_t frames_sent;
    uint64_t frames_not_sent;
} loop_statistics_t;

static volatile sig_atomic_t stop_requested = 0;

static void request_stop(int signal_number)
{
    (void)signal_number;
    stop_requested = 1;
}

static int64_t now_mono_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

static void sleep_until(int64_t deadline_mono_ns)
{
    struct timespec deadline = {
        .tv_sec = (time_t)(deadline_mono_ns / NS_PER_S), .tv_nsec = (long)(deadline_mono_ns % NS_PER_S)};
    while (!stop_requested && clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL) == EINTR) {
    }
}

static void print_usage(FILE *out)
{
    fprintf(out,
            "usage: reference_firmware [options]\n"
            "  -i, --interface NAME             SocketCAN interface (vcan0)\n"
            "  -a, --axis K                     axis of actuator.dbc, 1..%d (1)\n"
            "  -p, --period-us N                period of the controller (1000)\n"
            "  -d, --duration-s S               0: until SIGINT or SIGTERM (0)\n"
            "      --significant-height-m H     of the sea (0.5)\n"
            "      --peak-period-s T            of the sea (8)\n"
            "      --gain G                     position control, 1/s (2)\n"
            "      --ramp-s S                   time in which the wave comes in (2)\n"
            "      --priority N                 SCHED_FIFO 1..99 (0: as started)\n"
            "      --die-after-s S              stop dead after S seconds, without a last frame\n"
            "At the end it prints one line of JSON. Exit codes: 0 done, 2 usage, 4 CAN missing or lost.\n",
            ACTUATOR_AXIS_COUNT);
}

static bool read_number(const char *text, double low, double high, double *value)
{
    char *end;
    double number = strtod(text, &end);
    if (end == text || *end != '\0' || !(number >= low && number <= high)) {
        fprintf(stderr, "reference_firmware: '%s' is not a number from %g to %g\n", text, low, high);
        return false;
    }
    *value = number;
    return true;
}

enum { OPTION_HEIGHT = 256, OPTION_PEAK, OPTION_GAIN, OPTION_RAMP, OPTION_PRIORITY, OPTION_DIE };

static bool read_option(int option, const char *text, options_t *options)
{
    double number;
    switch (option) {
    case 'i':
        options->interface = text;
        return true;
    case 'a':
        if (!read_number(text, 1, ACTUATOR_AXIS_COUNT, &number)) {
            return false;
        }
        options->controller.axis = (unsigned)number;
        return true;
    case 'p':
        if (!read_number(text, 100, 1e6, &number)) {
            return false;
        }
        options->period_us = (long)number;
        return true;
    case 'd':
        return read_number(text, 0, 1e7, &options->duration_s);
    case OPTION_HEIGHT:
        return read_number(text, 0, 10, &options->controller.sea.significant_height_m);
    case OPTION_PEAK:
        return read_number(text, 3, 20, &options->controller.sea.peak_period_s);
    case OPTION_GAIN:
        return read_number(text, 0, 20, &options->controller.position_gain_per_s);
    case OPTION_RAMP:
        return read_number(text, 0.01, 60, &options->controller.ramp_s);
    case OPTION_PRIORITY:
        if (!read_number(text, 0, 99, &number)) {
            return false;
        }
        options->priority = (int)number;
        return true;
    case OPTION_DIE:
        return read_number(text, 0, 1e7, &options->die_after_s);
    default:
        return false;
    }
}

/* -1: go on; otherwise the exit code. */
static int read_options(int count, char **words, options_t *options)
{
    static const struct option names[] = {
        {"interface", required_argument, NULL, 'i'},
        {"axis", required_argument, NULL, 'a'},
        {"period-us", required_argument, NULL, 'p'},
        {"duration-s", required_argument, NULL, 'd'},
        {"significant-height-m", required_argument, NULL, OPTION_HEIGHT},
        {"peak-period-s", required_argument, NULL, OPTION_PEAK},
        {"gain", required_argument, NULL, OPTION_GAIN},
        {"ramp-s", required_argument, NULL, OPTION_RAMP},
        {"priority", required_argument, NULL, OPTION_PRIORITY},
        {"die-after-s", required_argument, NULL, OPTION_DIE},
        {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0},
    };
    int option;
    while ((option = getopt_long(count, words, "i:a:p:d:h", names, NULL)) != -1) {
        if (option == 'h') {
            print_usage(stdout);
            return EXIT_DONE;
        }
        if (!read_option(option, optarg, options)) {
            print_usage(stderr);
            return EXIT_USAGE;
        }
    }
    if (optind < count) {
        fprintf(stderr, "reference_firmware: unexpected '%s'\n", words[optind]);
        return EXIT_USAGE;
    }
    return -1;
}

/* A refusal is told, not fatal: the controller then runs as well as it may. */
static void ask_for_priority(int priority)
{
    struct sched_param parameters = {.sched_priority = priority};
    if (priority > 0 && sched_setscheduler(0, SCHED_FIFO, &parameters) < 0) {
        fprintf(stderr, "reference_firmware: SCHED_FIFO %d refused: %s\n", priority, strerror(errno));
    }
}

/* A non-blocking raw socket that receives the axis' three messages only; -1 with a message on stderr. */
static int open_bus(const char *interface, unsigned axis)
{
    struct can_filter filters[] = {
        {.can_id = ACTUATOR_MOTION_ID(axis), .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
        {.can_id = ACTUATOR_PRESSURES_ID(axis), .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
        {.can_id = ACTUATOR_BENCH_STATUS_ID(axis), .can_mask = CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG},
    };
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    if (address.can_ifindex == 0) {
        fprintf(stderr, "reference_firmware: interface %s: %s\n", interface, strerror(errno));
        return -1;
    }
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bus < 0) {
        fprintf(stderr, "reference_firmware: CAN socket: %s\n", strerror(errno));
        return -1;
    }
    if (setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) < 0
        || bind(bus, (struct sockaddr *)&address, sizeof address) < 0) {
        fprintf(stderr, "reference_firmware: interface %s: %s\n", interface, strerror(errno));
        close(bus);
        return -1;
    }
    return bus;
}

/* false: the bus is gone. */
static bool receive_all(int bus, mc_t *controller)
{
    struct can_frame frame;
    for (;;) {
        ssize_t size = recv(bus, &frame, sizeof frame, MSG_DONTWAIT);
        if (size < 0) {
            return errno == EAGAIN || errno == EINTR;
        }
        if (size == (ssize_t)sizeof frame) {
            mc_receive(controller, frame.can_id, frame.data, frame.can_dlc, (uint64_t)(now_mono_ns() / NS_PER_US));
        }
    }
}

/* false: the bus is gone. A full transmit queue costs this frame, which is counted; the next one is as good. */
static bool send_frame(int bus, uint32_t can_id, const uint8_t *data, size_t length, loop_statistics_t *statistics)
{
    struct can_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.can_id = can_id;
    frame.can_dlc = (uint8_t)length;
    memcpy(frame.data, data, length);
    if (send(bus, &frame, sizeof frame, MSG_DONTWAIT) == (ssize_t)sizeof frame) {
        statistics->frames_sent++;
        return true;
    }
    statistics->frames_not_sent++;
    return errno == ENOBUFS || errno == EAGAIN || errno == EINTR;
}

/* Periods until the end, a signal, or the loss of the bus. */
static int run(int bus, const options_t *options, mc_t *controller, loop_statistics_t *statistics)
{
    const int64_t period_ns = options->period_us * NS_PER_US;
    const int64_t start_mono_ns = now_mono_ns();
    const int64_t end_ns = options->duration_s > 0.0 ? (int64_t)(options->duration_s * 1e9) : INT64_MAX;
    const int64_t die_ns = options->die_after_s > 0.0 ? (int64_t)(options->die_after_s * 1e9) : INT64_MAX;
    uint32_t can_id;
    uint8_t data[CAN_MAX_DLEN];
    size_t length;
    for (int64_t tick = 0; !stop_requested && tick * period_ns < end_ns; tick++) {
        sleep_until(start_mono_ns + tick * period_ns);
        int64_t late_ns = now_mono_ns() - (start_mono_ns + tick * period_ns);
        if (tick * period_ns >= die_ns) {
            _exit(EXIT_DONE);
        }
        if (late_ns > 0 && (uint64_t)late_ns > statistics->lateness_ns_max) {
            statistics->lateness_ns_max = (uint64_t)late_ns;
        }
        if (late_ns >= period_ns) {
            statistics->late_count++;
            statistics->skipped_count += (uint64_t)(late_ns / period_ns);
            tick += late_ns / period_ns;
        }
        if (!receive_all(bus, controller)) {
            return EXIT_CAN_LOST;
        }
        length = mc_step(controller, (uint64_t)(now_mono_ns() / NS_PER_US), &can_id, data);
        if (!send_frame(bus, can_id, data, length, statistics)) {
            return EXIT_CAN_LOST;
        }
    }
    length = mc_stop(controller, (uint64_t)(now_mono_ns() / NS_PER_US), &can_id, data);
    return send_frame(bus, can_id, data, length, statistics) ? EXIT_DONE : EXIT_CAN_LOST;
}

static double rms_mm(double square_sum_m2, uint64_t count)
{
    return count > 0 ? 1e3 * sqrt(square_sum_m2 / (double)count) : 0.0;
}

static void print_json(const options_t *options, const mc_t *controller, const loop_statistics_t *loop, int code)
{
    static const char *const names[] = {"start", "active", "hold", "reset"};
    const mc_statistics_t *control = &controller->statistics;
    uint64_t received = 0;
    for (int status = 0; status < MC_FRAME_STATUS_COUNT; status++) {
        received += control->frame_count[status];
    }
    double error_mm = rms_mm(control->error_square_sum_m2, control->tracked_count);
    double reference_mm = rms_mm(control->reference_square_sum_m2, control->tracked_count);
    double round_trip_us =
        control->round_trip_count > 0 ? (double)control->round_trip_us_sum / (double)control->round_trip_count : 0.0;
    printf("{\"interface\": \"%s\", \"axis\": %u, \"period_us\": %ld, \"state\": \"%s\", \"exit_code\": %d, ",
           options->interface, options->controller.axis, options->period_us, names[controller->state], code);
    printf("\"periods\": %llu, \"active_periods\": %llu, \"tracked_periods\": %llu, \"saturated_periods\": %llu, ",
           (unsigned long long)control->period_count, (unsigned long long)control->active_count,
           (unsigned long long)control->tracked_count, (unsigned long long)control->saturated_count);
    printf("\"tracking_error_mm_rms\": %.4f, \"tracking_error_mm_max\": %.4f, \"reference_mm_rms\": %.4f, "
           "\"reference_mm_max\": %.4f, \"valve_setpoint_max\": %.4f, ",
           error_mm, 1e3 * control->error_m_max, reference_mm, 1e3 * control->reference_m_max, control->setpoint_max);
    printf("\"frames_sent\": %llu, \"frames_not_sent\": %llu, \"frames_received\": %llu, \"frames_rejected\": %llu, ",
           (unsigned long long)loop->frames_sent, (unsigned long long)loop->frames_not_sent,
           (unsigned long long)received, (unsigned long long)(received - control->frame_count[FRAME_VALID]));
    printf("\"measurement_timeouts\": %u, \"fail_safes_seen\": %u, \"reset_frames\": %llu, ",
           control->measurement_timeout_count, control->fail_safe_count,
           (unsigned long long)control->reset_frame_count);
    printf("\"round_trip_us_mean\": %.0f, \"round_trip_us_max\": %u, \"late_periods\": %llu, "
           "\"skipped_periods\": %llu, \"lateness_us_max\": %.1f}\n",
           round_trip_us, control->round_trip_us_max, (unsigned long long)loop->late_count,
           (unsigned long long)loop->skipped_count, (double)loop->lateness_ns_max / 1e3);
    fflush(stdout);
}

int main(int count, char **words)
{
    options_t options = {.interface = "vcan0", .period_us = 1000};
    mc_config_default(&options.controller);
    int code = read_options(count, words, &options);
    if (code >= 0) {
        return code;
    }
    mc_t controller;
    if (!mc_init(&controller, &options.controller)) {
        fprintf(stderr, "reference_firmware: these options make no usable controller\n");
        return EXIT_USAGE;
    }
    int bus = open_bus(options.interface, options.controller.axis);
    if (bus < 0) {
        return EXIT_CAN_LOST;
    }
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = request_stop;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    ask_for_priority(options.priority);
    loop_statistics_t statistics = {0};
    code = run(bus, &options, &controller, &statistics);
    if (code == EXIT_CAN_LOST) {
        fprintf(stderr, "reference_firmware: interface %s lost: %s\n", options.interface, strerror(errno));
    }
    print_json(&options, &controller, &statistics, code);
    close(bus);
    return code;
}
