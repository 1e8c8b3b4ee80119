/* The parts of the Arduino Mega's port. Wiring: README.md. */
#ifndef AVR_H
#define AVR_H

#include <stdint.h>

#include "../board_hal.h"

void uart_begin(void);
bool uart_has_input(void);
uint16_t uart_waiting(void);
uint16_t uart_read(uint8_t *data, uint16_t room);
uint16_t uart_write(const uint8_t *data, uint16_t bytes);

void servos_begin(void); /* pins low until the first call of servos_set */
void servos_set(const uint16_t pulses_us[CHANNELS]);

void sensors_begin(void);
float sensors_battery_v(void);
void sensors_sample(uint64_t now_us, float gyro_bias_radps, struct reading *reading);

/* Two-wire bus: a register of a chip, or a command, in two tries; false if the chip does not answer, after 1 ms at the latest. */
void twi_begin(void);
bool twi_write(uint8_t chip, const uint8_t *data, uint8_t bytes);
bool twi_read(uint8_t chip, uint8_t first, uint8_t *data, uint8_t bytes);

#endif
