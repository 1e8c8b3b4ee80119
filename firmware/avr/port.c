/* The firmware of an Arduino Mega 2560: clock, EEPROM, watchdog, and the program. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "../loop.h"
#include "avr.h"

/* Not cleared at a start. */
static uint8_t reset_causes __attribute__((section(".noinit")));
static uint16_t mark __attribute__((section(".noinit"))), inverse_mark __attribute__((section(".noinit")));

/* A watchdog that has bitten goes on with 15 ms: it is stopped before anything else. */
void stop_watchdog(void) __attribute__((naked, used, section(".init3")));
void stop_watchdog(void) {
    reset_causes = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

/* RAM outlives every reset but a loss of the supply. So a bootloader that clears MCUSR hides no power-on, and a supply that fails for
a moment is none. */
struct start hal_start(void) {
    enum { MARK = 0x5EA1 };
    const bool outlived = mark == MARK && inverse_mark == (uint16_t)~MARK;
    mark = MARK;
    inverse_mark = (uint16_t)~MARK;
    return (struct start){.causes = reset_causes, 
                          .is_power_on = !outlived && (reset_causes == 0 || reset_causes & (RESET_POWER_ON | RESET_BROWN_OUT))};
}

/* --- clock: timer 5 in half microseconds */

static volatile uint32_t overflows;

ISR(TIMER5_OVF_vect) { overflows++; }

uint64_t hal_now_us(void) {
    const uint8_t state = SREG;
    cli();
    uint32_t high = overflows;
    const uint16_t low = TCNT5;
    if ((TIFR5 & (1 << TOV5)) && low < 0x8000)
        high++;
    SREG = state;
    const union { /* the compiler shifts 64 bits by a loop */
        uint32_t half[2];
        uint64_t whole;
    } now_us = {{high << 15 | low >> 1, high >> 17}};
    return now_us.whole;
}

/* --- EEPROM */

uint8_t hal_eeprom_read(uint16_t address) {
    EEAR = address;
    EECR |= 1 << EERE;
    return EEDR;
}

bool hal_eeprom_busy(void) { return EECR & (1 << EEPE); }

void hal_eeprom_write(uint16_t address, uint8_t value) {
    EEAR = address;
    EEDR = value;
    const uint8_t state = SREG;
    cli(); /* the two bits must follow one another within four cycles */
    EECR |= 1 << EEMPE;
    EECR |= 1 << EEPE;
    SREG = state;
}

/* --- the rest of the hardware */

uint16_t hal_read(uint8_t *data, uint16_t room) { return uart_read(data, room); }

uint16_t hal_waiting(void) { return uart_waiting(); }

uint16_t hal_write(const uint8_t *data, uint16_t bytes) { return uart_write(data, bytes); }

void hal_heard(void) {}

void hal_outputs(const uint16_t pulses_us[CHANNELS]) { servos_set(pulses_us); }

float hal_battery_v(void) { return sensors_battery_v(); }

void hal_sample(uint64_t now_us, float gyro_bias_radps, struct reading *reading) {
    sensors_sample(now_us, gyro_bias_radps, reading);
}

void hal_alive(void) { wdt_reset(); }

EMPTY_INTERRUPT(TIMER5_COMPA_vect) /* wakes from hal_idle */

void hal_idle(uint64_t until_us) {
    OCR5A = (uint16_t)(until_us * 2u);
    TIFR5 = 1 << OCF5A;
    TIMSK5 |= 1 << OCIE5A;
    for (;;) {
        cli();
        if (uart_has_input() || hal_now_us() >= until_us)
            break;
        SMCR = 1 << SE; /* idle: timers and UART go on */
        sei(); /* takes effect after the next instruction: no interrupt is missed */
        sleep_cpu();
        SMCR = 0;
    }
    TIMSK5 &= (uint8_t)~(1 << OCIE5A);
    sei();
}

int main(void) {
    static struct loop loop;
    servos_begin();
    TCCR5A = 0;
    TCCR5B = 1 << CS51; /* 2 MHz */
    TIMSK5 = 1 << TOIE5;
    uart_begin();
    sei();
    wdt_enable(WDTO_120MS);
    sensors_begin();
    wdt_reset();
    loop_begin(&loop, ROBOT);
    for (;;)
        loop_once(&loop);
}
