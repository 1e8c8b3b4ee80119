/* The Arduino Mega's firmware in simavr, as a library for tests: bytes at UART 0, edges at the servo pins, the sensors' chips,
the EEPROM, and counts of cycles. Time is the processor's: 16 cycles are 1 us. */
#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdlib.h>
#include <string.h>

enum { CHANNELS = 8, RING = 1 << 16, EDGES = 1 << 16, PAINT = 0xA5, MPU = 0x68, MS = 0x76, TWCR = 0xBC };

struct edge {
    uint64_t cycle;
    uint32_t channel, level;
};

struct chip {
    uint8_t address, selected, first, at; /* `first` byte after the address: register or command */
    uint8_t has_first, is_asleep, is_absent; /* asleep as an MPU-6050 is after a loss of its supply: it answers zeros */
    avr_irq_t *irq;
    struct simulation *simulation;
};

struct pin {
    struct simulation *simulation;
    uint32_t channel;
};

struct simulation {
    avr_t *avr;
    uint64_t byte_cycles, next_byte;
    uint32_t in_head, in_tail, out_count, edge_count;
    uint8_t in[RING], out[RING];
    struct edge edges[EDGES];
    struct pin pins[CHANNELS];
    struct chip chips[2];
    int16_t imu[7];         /* acceleration, temperature, gyro as the MPU-6050 has them */
    uint32_t pressure, temperature; /* raw, of the MS5837 */
    uint8_t converted;
    uint32_t loop_address, idle_address; /* of loop_once and hal_idle, in bytes */
    uint64_t loop_since, loop_worst, loop_cycles;
    uint16_t paint_from;
    uint8_t hung, kept[2];
};

static const uint16_t PROM[7] = {0x2000, 34982, 36352, 20328, 22354, 26646, 26146}; /* the data sheet's example */

static uint8_t answer(struct chip *chip) {
    struct simulation *s = chip->simulation;
    const uint8_t at = chip->at++;
    if (chip->address == MPU) {
        if (chip->first == 0x75)
            return MPU;
        if (chip->is_asleep)
            return 0;
        const uint16_t word = (uint16_t)s->imu[(at / 2) % 7];
        return at % 2 ? word & 0xFF : word >> 8;
    }
    if (chip->first >= 0xA0) {
        const uint16_t word = PROM[(chip->first - 0xA0) / 2 % 7];
        return at % 2 ? word & 0xFF : word >> 8;
    }
    const uint32_t result = s->converted == 0x58 ? s->temperature : s->pressure;
    return result >> (16 - 8 * at);
}

static void on_twi(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    struct chip *chip = parameter;
    avr_twi_msg_irq_t in = {.u.v = value};
    if (!(in.u.twi.msg & TWI_COND_STOP)) /* simavr 1.6 leaves TWINT set until the byte is through, which takes 9 us there */
        chip->simulation->avr->data[TWCR] &= 0x7F;
    if (in.u.twi.msg & TWI_COND_STOP)
        chip->selected = 0;
    if (in.u.twi.msg & TWI_COND_START) {
        chip->selected = in.u.twi.addr >> 1 == chip->address && !chip->is_absent ? in.u.twi.addr : 0;
        chip->has_first = chip->at = 0;
        if (chip->selected)
            avr_raise_irq(chip->irq + TWI_IRQ_INPUT, avr_twi_irq_msg(TWI_COND_ACK, chip->selected, 1));
    }
    if (!chip->selected)
        return;
    if (in.u.twi.msg & TWI_COND_WRITE) {
        avr_raise_irq(chip->irq + TWI_IRQ_INPUT, avr_twi_irq_msg(TWI_COND_ACK, chip->selected, 1));
        if (!chip->has_first) {
            chip->first = in.u.twi.data;
            chip->has_first = 1;
            if (chip->address == MS && (chip->first == 0x48 || chip->first == 0x58))
                chip->simulation->converted = chip->first;
        } else if (chip->address == MPU && chip->first == 0x6B)
            chip->is_asleep = 0;
    }
    if (in.u.twi.msg & TWI_COND_READ)
        avr_raise_irq(chip->irq + TWI_IRQ_INPUT, avr_twi_irq_msg(TWI_COND_READ, chip->selected, answer(chip)));
    (void)irq;
}

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    struct simulation *s = parameter;
    if (s->out_count < RING)
        s->out[s->out_count++] = value;
    (void)irq;
}

static void on_pin(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    struct pin *pin = parameter;
    struct simulation *s = pin->simulation;
    if (s->edge_count < EDGES && irq->value != value)
        s->edges[s->edge_count++] = (struct edge){s->avr->cycle, pin->channel, value};
}

/* simavr waits for the wall clock while the processor sleeps; here its time jumps. */
static void no_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    (void)cycles;
}

static void attach(struct simulation *s) {
    static const char PORTS[CHANNELS] = {'E', 'E', 'E', 'H', 'H', 'H', 'B', 'B'};
    static const uint8_t PINS[CHANNELS] = {3, 4, 5, 3, 4, 5, 5, 6};
    static const char *names[2] = {"8>chip.in", "32<chip.out"};
    avr_t *avr = s->avr;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)AVR_UART_FLAG_STDIO;
    flags &= ~(uint32_t)AVR_UART_FLAG_POLL_SLEEP;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, s);
    for (uint8_t i = 4; i <= 5; i++) /* two servo pins are also INT4 and INT5: simavr looks at them in each cycle while they are low */
        avr_extint_set_strict_lvl_trig(avr, i, 0);
    for (uint32_t i = 0; i < CHANNELS; i++) {
        s->pins[i] = (struct pin){s, i};
        avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(PORTS[i]), PINS[i]), on_pin, &s->pins[i]);
    }
    for (uint32_t i = 0; i < 2; i++) {
        struct chip *chip = &s->chips[i];
        chip->address = i ? MS : MPU;
        chip->simulation = s;
        chip->irq = avr_alloc_irq(&avr->irq_pool, 0, 2, names);
        avr_irq_register_notify(chip->irq + TWI_IRQ_OUTPUT, on_twi, chip);
        avr_connect_irq(chip->irq + TWI_IRQ_INPUT, avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT));
        avr_connect_irq(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), chip->irq + TWI_IRQ_OUTPUT);
    }
}

/* Voltage at A0, mV. */
void simulation_battery(struct simulation *s, uint32_t millivolt) {
    avr_raise_irq(avr_io_getirq(s->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0), millivolt);
}

struct simulation *simulation_open(const char *elf, uint32_t baud, uint32_t loop_address, uint32_t idle_address,
                                   uint16_t paint_from) {
    struct simulation *s = calloc(1, sizeof *s);
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (s == NULL || elf_read_firmware(elf, &firmware) != 0)
        return NULL;
    strcpy(firmware.mmcu, "atmega2560");
    firmware.frequency = 16000000;
    s->avr = avr_make_mcu_by_name(firmware.mmcu);
    if (s->avr == NULL)
        return NULL;
    avr_init(s->avr);
    s->avr->log = LOG_ERROR;
    s->avr->sleep = no_sleep;
    avr_load_firmware(s->avr, &firmware);
    s->avr->vcc = s->avr->avcc = s->avr->aref = 5000;
    s->byte_cycles = 10u * 16000000u / baud;
    s->loop_address = loop_address;
    s->idle_address = idle_address;
    s->paint_from = paint_from;
    memset(s->avr->data + paint_from, PAINT, s->avr->ramend + 1u - paint_from);
    s->imu[2] = 8192; /* 1 g */
    s->pressure = 4958179;
    s->temperature = 6815414;
    attach(s);
    simulation_battery(s, 2460);
    return s;
}

/* Chip 0 is the IMU, 1 the pressure sensor. */
void simulation_chip(struct simulation *s, uint32_t chip, int is_asleep, int is_absent) {
    s->chips[chip].is_asleep = (uint8_t)is_asleep;
    s->chips[chip].is_absent = (uint8_t)is_absent;
}

void simulation_close(struct simulation *s) {
    avr_terminate(s->avr);
    free(s);
}

/* A byte has come; when the next one will have, 0 if there is none. A timer of simavr ends the processor's sleep. */
static avr_cycle_count_t feed(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    struct simulation *s = parameter;
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), s->in[s->in_tail++ % RING]);
    s->next_byte = when + s->byte_cycles;
    return s->in_tail == s->in_head ? 0 : s->next_byte;
}

/* Bytes to the board, one after the other at the baud rate. */
void simulation_receive(struct simulation *s, const uint8_t *data, uint32_t bytes) {
    for (uint32_t i = 0; i < bytes; i++)
        s->in[s->in_head++ % RING] = data[i];
}

/* Ends a sleep of the processor. */
static avr_cycle_count_t wake(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    (void)avr;
    (void)when;
    (void)parameter;
    return 0;
}

/* The loop begins anew, or has nothing to do. */
static void note_loop(struct simulation *s, int begins) {
    const uint64_t cycles = s->avr->cycle - s->loop_since;
    if (s->loop_since != 0) {
        s->loop_worst = cycles > s->loop_worst ? cycles : s->loop_worst;
        s->loop_cycles += cycles;
    }
    s->loop_since = begins ? s->avr->cycle : 0;
}

/* Run to this cycle; 0 if the processor crashed. */
int simulation_run(struct simulation *s, uint64_t cycle) {
    int state = cpu_Running;
    const uint64_t now = s->avr->cycle;
    if (now < cycle)
        avr_cycle_timer_register(s->avr, cycle - now, wake, s);
    if (s->in_tail != s->in_head && avr_cycle_timer_status(s->avr, feed, s) == 0) /* a reset of the processor clears it, too */
        avr_cycle_timer_register(s->avr, s->next_byte > now ? s->next_byte - now : 1, feed, s);
    while (s->avr->cycle < cycle && state != cpu_Done && state != cpu_Crashed) {
        state = avr_run(s->avr);
        if (s->avr->pc == s->loop_address || s->avr->pc == s->idle_address)
            note_loop(s, s->avr->pc == s->loop_address);
    }
    return state != cpu_Done && state != cpu_Crashed;
}

uint64_t simulation_cycle(const struct simulation *s) { return s->avr->cycle; }

uint32_t simulation_waiting(const struct simulation *s) { return s->in_head - s->in_tail; }

uint32_t simulation_take(struct simulation *s, uint8_t *data) {
    const uint32_t bytes = s->out_count;
    memcpy(data, s->out, bytes);
    s->out_count = 0;
    return bytes;
}

uint32_t simulation_take_edges(struct simulation *s, struct edge *edges) {
    const uint32_t count = s->edge_count;
    memcpy(edges, s->edges, count * sizeof *edges);
    s->edge_count = 0;
    return count;
}

/* Cycles of the worst loop, and cycles of all loops, since the last call; without what the processor slept. */
void simulation_loop(struct simulation *s, uint64_t cycles[2]) {
    cycles[0] = s->loop_worst;
    cycles[1] = s->loop_cycles;
    s->loop_worst = s->loop_cycles = s->loop_since = 0;
}

/* Bytes of stack that were ever used. */
uint32_t simulation_stack(const struct simulation *s) {
    uint32_t at = s->paint_from;
    while (at < s->avr->ramend && s->avr->data[at] == PAINT)
        at++;
    return s->avr->ramend + 1u - at;
}

void simulation_eeprom(struct simulation *s, uint8_t *bytes, int write) {
    avr_eeprom_desc_t all = {.ee = bytes, .offset = 0, .size = 4096};
    avr_ioctl(s->avr, write ? AVR_IOCTL_EEPROM_SET : AVR_IOCTL_EEPROM_GET, &all);
}

/* The supply fails for a moment: all but the EEPROM begins anew. */
void simulation_reset(struct simulation *s) {
    avr_reset(s->avr);
    s->loop_since = 0;
}

/* Have the loop hang at its next begin (an endless `rjmp`), or run again. */
void simulation_hang(struct simulation *s, int hang) {
    uint8_t *code = s->avr->flash + s->loop_address;
    if (hang && !s->hung) {
        memcpy(s->kept, code, 2);
        code[0] = 0xFF, code[1] = 0xCF;
    } else if (!hang && s->hung)
        memcpy(code, s->kept, 2);
    s->hung = (uint8_t)hang;
}
