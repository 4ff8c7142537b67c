#include "e2e_p02.h"

#define POLYNOMIAL 0x2Fu

/* Bit by bit: 8-byte frames at 1 kHz leave time enough, and no table can be damaged. */
static uint8_t crc_step(uint8_t crc, uint8_t byte)
{
    unsigned value = (unsigned)crc ^ byte;
    for (int bit = 0; bit < 8; bit++) {
        value = (value & 0x80u) ? (value << 1) ^ POLYNOMIAL : value << 1;
    }
    return (uint8_t)(value & 0xFFu);
}

uint8_t e2e_p02_crc(const uint8_t *data, size_t length, uint8_t data_id)
{
    uint8_t crc = 0xFFu;
    for (size_t index = 1; index < length; index++) {
        crc = crc_step(crc, data[index]);
    }
    return (uint8_t)(crc_step(crc, data_id) ^ 0xFFu);
}

void e2e_p02_protect(uint8_t *data, size_t length, const uint8_t *data_id_list, uint8_t *counter)
{
    *counter = (uint8_t)((*counter + 1u) % E2E_P02_COUNTER_MODULUS);
    data[1] = (uint8_t)((data[1] & 0xF0u) | *counter);
    data[0] = e2e_p02_crc(data, length, data_id_list[*counter]);
}

void e2e_p02_receiver_init(e2e_p02_receiver_t *receiver, uint8_t max_delta)
{
    receiver->last_counter = 0;
    receiver->max_delta = max_delta;
    receiver->begun = false;
}

frame_status_t e2e_p02_check(e2e_p02_receiver_t *receiver, const uint8_t *data, size_t length,
                             const uint8_t *data_id_list)
{
    uint8_t counter = data[1] & 0x0Fu;
    if (e2e_p02_crc(data, length, data_id_list[counter]) != data[0]) {
        return FRAME_BAD_CRC;
    }
    if (!receiver->begun) {
        return FRAME_VALID;
    }
    uint8_t step = (uint8_t)((counter + E2E_P02_COUNTER_MODULUS - receiver->last_counter) % E2E_P02_COUNTER_MODULUS);
    if (step == 0) {
        return FRAME_REPEATED_COUNTER;
    }
    if (step > receiver->max_delta) {
        receiver->last_counter = counter;
        return FRAME_LOST_COUNTER;
    }
    return FRAME_VALID;
}

void e2e_p02_accept(e2e_p02_receiver_t *receiver, const uint8_t *data)
{
    receiver->last_counter = data[1] & 0x0Fu;
    receiver->begun = true;
}
