"""AUTOSAR end-to-end protection, profile 2 (P02): a CRC in byte 0, an alive counter in the low nibble of byte 1.

Source: AUTOSAR "Specification of SW-C End-to-End Communication Protection Library" (E2E profile 2) and
"Specification of CRC Routines" (CRC-8 with polynomial 0x2F, start value and final xor 0xFF).
The CRC covers byte 1 to the last byte and then one byte that is not sent: the Data ID of this counter value.
"""

import numpy as np

from hilrunner.base.compiled import hot

POLYNOMIAL = 0x2F
COUNTER_MODULUS = 16
NO_COUNTER = -1  # last counter of a stream that has not begun


def _crc_table() -> np.ndarray:
    table = np.zeros(256, np.uint8)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = ((crc << 1) ^ POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        table[value] = crc
    return table


CRC_TABLE = _crc_table()


@hot
def crc_p02(data, length, data_id):
    """CRC of a P02-protected message; byte 0, where it belongs, is not read.

    Args:
        data: u1[>= length], read. length: data bytes, 2 or more. data_id: of this counter value, 0..255.
    """
    crc = 0xFF
    for index in range(1, length):
        crc = np.int64(CRC_TABLE[crc ^ np.int64(data[index])])
    return np.int64(CRC_TABLE[crc ^ np.int64(data_id)]) ^ 0xFF


@hot
def counter_p02(data):
    """The alive counter of a received message."""
    return np.int64(data[1]) & 0x0F


@hot
def protect_p02(data, length, data_ids, counter):
    """Write counter and CRC into a message that is otherwise complete.

    Args:
        data: u1[>= length], byte 0 and the low nibble of byte 1 written. data_ids: u1[16]. counter: 0..15.
    """
    data[1] = (np.int64(data[1]) & 0xF0) | counter
    data[0] = crc_p02(data, length, data_ids[counter])


@hot
def counter_step(counter, last_counter):
    """How far the counter went, 0..15: 0 repeated, 1 in sequence, more: some lost."""
    return (counter - last_counter) % COUNTER_MODULUS
