/* Six functions by which a controller core meets time and CAN; all that a portable core needs to run against the bench.
 *
 * hil_core.c carries them out with SocketCAN and CLOCK_MONOTONIC: the same program then runs on a real interface, on vcan0, and in virtual time
 * (`hilrunner run --virtual -- ./program`). On a microcontroller the six are a few lines over its own timer and CAN driver.
 *
 *     hil_t hil;
 *     if (hil_open(&hil, "vcan0") != 0) { return 4; }
 *     for (int64_t due_ns = hil_now_ns(&hil);; due_ns += 1000000) {
 *         if (hil_wait_until(&hil, due_ns) != 0) { break; }
 *         while (hil_receive(&hil, &frame) > 0) { core_take(&frame); }
 *         core_step(&frame);
 *         hil_send(&hil, &frame);
 *     }
 *     hil_close(&hil);
 */
#ifndef HIL_CORE_H
#define HIL_CORE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
    uint32_t can_id; /* bit 31: 29-bit identifier, as in SocketCAN */
    uint8_t length;  /* data bytes, 0..8 */
    uint8_t data[8];
} hil_frame_t;

typedef struct {
    int descriptor;
} hil_t;

/* Open the interface for sending and receiving. 0; or an errno, with nothing left open. */
int hil_open(hil_t *hil, const char *interface_name);

/* CLOCK_MONOTONIC, ns. */
int64_t hil_now_ns(const hil_t *hil);

/* Sleep until a point of that clock; at once when it has passed. 0; or EINTR when a signal came first. */
int hil_wait_until(const hil_t *hil, int64_t deadline_mono_ns);

/* Send without waiting. 0; or an errno: ENOBUFS when the transmit queue is full. */
int hil_send(const hil_t *hil, const hil_frame_t *frame);

/* The oldest waiting frame, without waiting. 1; 0 when there is none; -errno when the bus is gone. Frames of CAN FD are passed over. */
int hil_receive(const hil_t *hil, hil_frame_t *frame);

/* Close it; once. */
void hil_close(hil_t *hil);

#ifdef __cplusplus
}
#endif

#endif
