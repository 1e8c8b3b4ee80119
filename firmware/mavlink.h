/* The generated MAVLink headers: layouts, lengths and checksum seeds of the dialect. Their parser and packer are not used. */
#ifndef BOARD_MAVLINK_H
#define BOARD_MAVLINK_H

#include <stdint.h>

#ifdef __AVR__ /* avr-libc's takes a third fewer cycles than the generated one */
#include <util/crc16.h>
#define HAVE_CRC_ACCUMULATE
static inline void crc_accumulate(uint8_t byte, uint16_t *crc) { *crc = _crc_ccitt_update(*crc, byte); }
#endif

#include <mavlink/common/mavlink.h>

#endif
