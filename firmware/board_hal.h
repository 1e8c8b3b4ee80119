/* The hardware of a board, as loop.c uses it. posix/ and avr/ have one implementation each. No call waits, but hal_sample for
the sensors' bus. */
#ifndef BOARD_HAL_H
#define BOARD_HAL_H

#include <stdbool.h>
#include <stdint.h>

#include "messages.h"
#include "zero.h"

enum { HAL_EEPROM_BYTES = 4096 };

struct start hal_start(void); /* how this life began; without what is kept */
uint64_t hal_now_us(void); /* since power-on; never goes back */

uint16_t hal_read(uint8_t *data, uint16_t room);         /* bytes of the link that have come, at most `room` */
uint16_t hal_waiting(void);                              /* bytes that have come, and are not read yet */
uint16_t hal_write(const uint8_t *data, uint16_t bytes); /* send; returns how many were taken */
void hal_heard(void);                                    /* whoever sent what was read last sent an intact frame */

void hal_outputs(const uint16_t pulses_us[CHANNELS]);
float hal_battery_v(void); /* called every BURST_US */
void hal_sample(uint64_t now_us, float gyro_bias_radps, struct reading *reading); /* the bias is for the heading */

uint8_t hal_eeprom_read(uint16_t address);
bool hal_eeprom_busy(void);                                /* a byte is being written */
void hal_eeprom_write(uint16_t address, uint8_t value);    /* begin to write a byte, if not busy */

void hal_alive(void); /* the loop goes round: the watchdog may wait on */
void hal_idle(uint64_t until_us); /* nothing to do until then, or until bytes come */

#endif
