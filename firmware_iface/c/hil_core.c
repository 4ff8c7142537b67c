/* The six functions of hil_core.h on Linux. */
#define _POSIX_C_SOURCE 200809L
#define _DEFAULT_SOURCE
#include "hil_core.h"

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define NS_PER_S 1000000000LL

int hil_open(hil_t *hil, const char *interface_name)
{
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)if_nametoindex(interface_name);
    if (address.can_ifindex == 0) {
        return errno;
    }
    hil->descriptor = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (hil->descriptor < 0) {
        return errno;
    }
    if (bind(hil->descriptor, (struct sockaddr *)&address, sizeof address) < 0) {
        int error = errno;
        hil_close(hil);
        return error;
    }
    return 0;
}

int64_t hil_now_ns(const hil_t *hil)
{
    struct timespec now;
    (void)hil;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

int hil_wait_until(const hil_t *hil, int64_t deadline_mono_ns)
{
    struct timespec deadline;
    (void)hil;
    deadline.tv_sec = (time_t)(deadline_mono_ns / NS_PER_S);
    deadline.tv_nsec = (long)(deadline_mono_ns % NS_PER_S);
    return clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL);
}

int hil_send(const hil_t *hil, const hil_frame_t *frame)
{
    struct can_frame raw;
    memset(&raw, 0, sizeof raw);
    raw.can_id = frame->can_id;
    raw.can_dlc = frame->length;
    memcpy(raw.data, frame->data, sizeof frame->data);
    return send(hil->descriptor, &raw, sizeof raw, MSG_DONTWAIT) == (ssize_t)sizeof raw ? 0 : errno;
}

int hil_receive(const hil_t *hil, hil_frame_t *frame)
{
    struct can_frame raw;
    for (;;) {
        ssize_t size = recv(hil->descriptor, &raw, sizeof raw, MSG_DONTWAIT);
        if (size < 0) {
            return errno == EAGAIN || errno == EINTR ? 0 : -errno;
        }
        if (size == (ssize_t)sizeof raw) {
            frame->can_id = raw.can_id;
            frame->length = raw.can_dlc;
            memcpy(frame->data, raw.data, sizeof frame->data);
            return 1;
        }
    }
}

void hil_close(hil_t *hil)
{
    close(hil->descriptor);
    hil->descriptor = -1;
}
