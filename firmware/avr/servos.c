/* Eight servo outputs by the compare units of three timers: their edges need no software.

Fast PWM, 20 ms, 0.5 us a tick. A new width is taken over at the beginning of the next pulse, by the hardware's buffer. */
#include <avr/io.h>

#include "avr.h"

enum { TICKS_PER_US = 2, PERIOD_TICKS = 40000, WAVEFORM_A = 1 << 1, WAVEFORM_B = 1 << 4 | 1 << 3, PRESCALE_8 = 1 << 1 };

/* Thrusters D5, D2, D3, D6; ankles D7, D8, D11, D12. */
static volatile uint16_t *const COMPARE[CHANNELS] = {&OCR3A, &OCR3B, &OCR3C, &OCR4A, &OCR4B, &OCR4C, &OCR1A, &OCR1B};

void servos_begin(void) {
    DDRE |= 1 << PE3 | 1 << PE4 | 1 << PE5;
    DDRH |= 1 << PH3 | 1 << PH4 | 1 << PH5;
    DDRB |= 1 << PB5 | 1 << PB6;
    ICR1 = ICR3 = ICR4 = PERIOD_TICKS - 1;
}

static void start(void) {
    TCNT1 = TCNT3 = TCNT4 = PERIOD_TICKS - 2;
    TCCR1A = 1 << COM1A1 | 1 << COM1B1 | WAVEFORM_A;
    TCCR3A = 1 << COM3A1 | 1 << COM3B1 | 1 << COM3C1 | WAVEFORM_A;
    TCCR4A = 1 << COM4A1 | 1 << COM4B1 | 1 << COM4C1 | WAVEFORM_A;
    TCCR1B = TCCR3B = TCCR4B = WAVEFORM_B | PRESCALE_8;
}

void servos_set(const uint16_t pulses_us[CHANNELS]) {
    for (uint8_t i = 0; i < CHANNELS; i++)
        *COMPARE[i] = (uint16_t)(pulses_us[i] * TICKS_PER_US - 1);
    if (TCCR3B == 0)
        start();
}
