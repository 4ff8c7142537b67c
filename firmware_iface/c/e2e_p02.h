/* AUTOSAR end-to-end protection, profile 2 (P02).
 *
 * Byte 0 of a protected message is a CRC-8 (polynomial 0x2F, start and final xor 0xFF) over byte 1 to the last byte and
 * then one byte that is not sent: the Data ID that belongs to the counter value. The low nibble of byte 1 is the alive
 * counter 0..15. Source: AUTOSAR "Specification of SW-C End-to-End Communication Protection Library", E2E profile 2.
 *
 * No heap, no globals, nothing blocks. Every function may be called from anywhere as
 * long as one sender or receiver struct is used by one caller at a time.
 */
#ifndef E2E_P02_H
#define E2E_P02_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define E2E_P02_COUNTER_MODULUS 16
#define E2E_P02_MAX_DELTA_DEFAULT 3

/* The bench counts received frames under the same numbers (its log, field `status`). */
typedef enum {
    FRAME_VALID = 0,
    FRAME_UNKNOWN_ID = 1,
    FRAME_WRONG_LENGTH = 2,
    FRAME_BAD_CRC = 5,
    FRAME_REPEATED_COUNTER = 6,
    FRAME_LOST_COUNTER = 7,
    FRAME_OUT_OF_RANGE = 8,
    FRAME_BAD_CONTROL = 10 /* a value outside its value table */
} frame_status_t;

/* Receiving side of one message.
 * Invariants: a rejected frame changes nothing here, with one exception: a frame whose counter jumped further than
 * max_delta is not used, but its counter becomes the last one (SyncCounterInit = 1 in AUTOSAR's words), so a restarted
 * sender loses exactly one frame. */
typedef struct {
    uint8_t last_counter;
    uint8_t max_delta; /* 1..14: largest accepted step of the counter */
    bool begun;        /* false: the next frame is accepted whatever its counter */
} e2e_p02_receiver_t;

/* CRC of a message; byte 0, where it belongs, is not read. length: all bytes of the message, 2 or more. */
uint8_t e2e_p02_crc(const uint8_t *data, size_t length, uint8_t data_id);

/* Moves the sender's counter on and writes it and the CRC into an otherwise complete message.
 * A counter that starts at 0 makes the first frame carry 1. */
void e2e_p02_protect(uint8_t *data, size_t length, const uint8_t *data_id_list, uint8_t *counter);

void e2e_p02_receiver_init(e2e_p02_receiver_t *receiver, uint8_t max_delta);

/* Judges CRC and counter; call e2e_p02_accept when the content is good as well. */
frame_status_t e2e_p02_check(e2e_p02_receiver_t *receiver, const uint8_t *data, size_t length,
                             const uint8_t *data_id_list);

void e2e_p02_accept(e2e_p02_receiver_t *receiver, const uint8_t *data);

#endif
