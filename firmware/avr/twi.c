/* Two-wire bus at 400 kHz, by polling: 23 us a byte. */
#include <avr/io.h>
#include <util/delay.h>
#include <util/twi.h>

#include "avr.h"

enum { TIMEOUT_POLLS = 200 }; /* some 0.2 ms, nine bytes: a chip or wire that holds the bus must not hold the loop */
enum { SCL = 1 << PD0, SDA = 1 << PD1, CLOCKS = 9, TRIES = 2 };
#define HALF_CLOCK_US 5

void twi_begin(void) {
    TWSR = 0;
    TWBR = (F_CPU / 400000 - 16) / 2;
    TWCR = 1 << TWEN;
}

/* Let go of the bus. A chip that holds SDA is in the middle of a byte, of a read that a reset cut off: nine clocks end it, and a
STOP begins anew. */
static void release(void) {
    TWCR = 0;
    PORTD &= (uint8_t)~(SCL | SDA);
    for (uint8_t i = 0; i < CLOCKS && !(PIND & SDA); i++) {
        DDRD |= SCL;
        _delay_us(HALF_CLOCK_US);
        DDRD &= (uint8_t)~SCL;
        _delay_us(HALF_CLOCK_US);
    }
    DDRD |= SDA;
    _delay_us(HALF_CLOCK_US);
    DDRD &= (uint8_t)~SDA;
    _delay_us(HALF_CLOCK_US);
    TWCR = 1 << TWEN;
}

/* One step of the bus; the status that it ends with, 0 (bus error) if it does not end. */
static uint8_t act(uint8_t control) {
    TWCR = (uint8_t)(1 << TWINT | 1 << TWEN | control);
    for (uint8_t i = 0; i < TIMEOUT_POLLS; i++)
        if (TWCR & (1 << TWINT))
            return TW_STATUS;
    return 0;
}

static bool start(uint8_t expected) { return (PIND & SDA || expected == TW_REP_START) && act(1 << TWSTA) == expected; }

/* An address or a byte; true if the chip acknowledges it. */
static bool put(uint8_t byte) {
    TWDR = byte;
    const uint8_t status = act(0);
    return status == TW_MT_SLA_ACK || status == TW_MT_DATA_ACK || status == TW_MR_SLA_ACK;
}

static void stop(bool worked) {
    TWCR = 1 << TWINT | 1 << TWEN | 1 << TWSTO;
    for (uint8_t i = 0; i < TIMEOUT_POLLS && TWCR & (1 << TWSTO); i++) { /* the next START must not cut it off */
    }
    if (!worked || TWCR & (1 << TWSTO))
        release();
}

bool twi_write(uint8_t chip, const uint8_t *data, uint8_t bytes) {
    bool worked = false;
    for (uint8_t try = 0; try < TRIES && !worked; try++) {
        worked = start(TW_START) && put((uint8_t)(chip << 1));
        for (uint8_t i = 0; worked && i < bytes; i++)
            worked = put(data[i]);
        stop(worked);
    }
    return worked;
}

bool twi_read(uint8_t chip, uint8_t first, uint8_t *data, uint8_t bytes) {
    bool worked = false;
    for (uint8_t try = 0; try < TRIES && !worked; try++) {
        worked = start(TW_START) && put((uint8_t)(chip << 1)) && put(first) && start(TW_REP_START) &&
                 put((uint8_t)(chip << 1 | 1));
        for (uint8_t i = 0; worked && i < bytes; i++) {
            const bool last = i + 1 == bytes;
            worked = act(last ? 0 : 1 << TWEA) == (last ? TW_MR_DATA_NACK : TW_MR_DATA_ACK);
            data[i] = TWDR;
        }
        stop(worked);
    }
    return worked;
}
