/* UART 0, which the Mega's USB is on: both directions through rings that interrupts empty and fill. */
#include <avr/interrupt.h>
#include <avr/io.h>

#include "avr.h"

enum { RING = 256 }; /* the indices wrap by themselves */

enum { DIVIDER = (F_CPU / 8 + BAUD / 2) / BAUD, MADE = F_CPU / 8 / DIVIDER }; /* nearest rate that the processor can make */
typedef char baud_within_2_percent[BAUD * 98 <= MADE * 100UL && MADE * 100UL <= BAUD * 102 ? 1 : -1];

static volatile uint8_t received[RING], sending[RING];
static volatile uint8_t received_head, received_tail, sending_head, sending_tail;

ISR(USART0_RX_vect) {
    const uint8_t byte = UDR0, next = (uint8_t)(received_head + 1);
    if (next == received_tail)
        return; /* the loop is late: the frame is damaged, and the link looks for the next */
    received[received_head] = byte;
    received_head = next;
}

ISR(USART0_UDRE_vect) {
    UDR0 = sending[sending_tail];
    sending_tail = (uint8_t)(sending_tail + 1);
    if (sending_tail == sending_head)
        UCSR0B &= (uint8_t)~(1 << UDRIE0);
}

void uart_begin(void) {
    UCSR0A = 1 << U2X0;
    UCSR0C = 1 << UCSZ01 | 1 << UCSZ00; /* 8N1 */
    UBRR0 = DIVIDER - 1;                /* after U2X0: simavr takes the baud rate over here */
    UCSR0B = 1 << RXCIE0 | 1 << RXEN0 | 1 << TXEN0;
}

bool uart_has_input(void) { return received_tail != received_head; }

uint16_t uart_waiting(void) { return (uint8_t)(received_head - received_tail); }

uint16_t uart_read(uint8_t *data, uint16_t room) {
    uint16_t bytes = 0;
    while (bytes < room && received_tail != received_head) {
        data[bytes++] = received[received_tail];
        received_tail = (uint8_t)(received_tail + 1);
    }
    return bytes;
}

uint16_t uart_write(const uint8_t *data, uint16_t bytes) {
    uint8_t head = sending_head;
    const uint8_t room = (uint8_t)(sending_tail - head - 1), taken = (uint8_t)(bytes < room ? bytes : room);
    for (uint8_t left = taken; left > 0; left--)
        sending[head++] = *data++;
    if (taken > 0) {
        const uint8_t state = SREG;
        cli(); /* the interrupt reads what is in the ring by now */
        sending_head = head;
        UCSR0B |= 1 << UDRIE0;
        SREG = state;
    }
    return taken;
}
