/* The Arduino Mega's firmware in simavr, as a library for tests: bytes at UART 0, edges at the servo pins, the sensors' chips,
the EEPROM, and counts of cycles. Time is the processor's: 16 cycles are 1 us. */
#include <simavr/avr_adc.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_hex.h>
#include <simavr/sim_io.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { CHANNELS = 8, RING = 1 << 16, EDGES = 1 << 16, PAINT = 0xA5, MPU = 0x68, MS = 0x76, EEPROM_BYTES = 4096, RAM_BEGIN = 0x200 };
enum { PIND_ = 0x29, DDRD_ = 0x2A, EECR_ = 0x3F, EEDR_ = 0x40, EEARL_ = 0x41, MCUSR_ = 0x54, TWSR_ = 0xB9, TWDR_ = 0xBB, TWCR_ = 0xBC };
enum { EERE_ = 1, EEPE_ = 2, EEMPE_ = 4, TWEN_ = 4, TWSTO_ = 16, TWSTA_ = 32, TWEA_ = 64, TWINT_ = 128, SCL_ = 1, SDA_ = 2 };
enum { EEPROM_CYCLES = 3400 * 16, ENABLE_CYCLES = 6, EDGE_CYCLES = 40, BYTE_CYCLES = 360 }; /* of the bus at 400 kHz */
enum { CONVERSION_CYCLES = 9040 * 16, STRETCH_CYCLES = 2000 * 16 };

struct edge {
    uint64_t cycle;
    uint32_t channel, level;
};

/* What can be wrong with a chip. */
enum fault { ABSENT, FROZEN, WRONG, LATE, ASLEEP, FAULTS };

struct chip {
    uint8_t address, at, first, has_first; /* `first` byte after the address: register or command */
    uint8_t fault[FAULTS];
    uint8_t registers[128]; /* of the MPU-6050 */
    uint8_t converted;      /* command of the conversion whose result is there, or will be */
    uint8_t sent;           /* that result was read, or there was none */
    uint64_t ready;         /* cycle from which it is */
    uint32_t samples;       /* how often it was read: noise */
};

/* The two-wire bus, with the processor as its only master. */
struct bus {
    struct chip *selected;
    uint8_t is_started, has_address, reads, status;
    uint32_t held;       /* clocks for which a chip still holds SDA */
    uint32_t holds_for;  /* clocks for which it will */
    uint8_t cut_in; /* data bytes after which a chip stops in the middle of one, as after a reset of the processor; 0: never */
};

struct pin {
    struct simulation *simulation;
    uint32_t channel;
    uint8_t is_high, waits;      /* a pulse is under way; a new width waits for its end */
    uint16_t width;              /* that one, as the compare register takes it */
    avr_io_write_t write_width;  /* simavr's own, */
    void *parameter;             /* with its parameter */
};

struct simulation {
    avr_t *avr;
    avr_io_t io;
    uint64_t byte_cycles, next_byte;
    uint32_t in_head, in_tail, out_count, edge_count;
    uint8_t in[RING], out[RING];
    struct edge edges[EDGES];
    struct pin pins[CHANNELS];
    struct chip chips[2];
    struct bus bus;
    uint8_t eeprom[EEPROM_BYTES], ee_value;
    uint16_t ee_address;
    uint64_t ee_enabled, ee_until; /* cycles up to which a write may begin, and one goes on */
    uint32_t ee_writes, ee_errors; /* that were begun; accesses while one went on */
    int16_t imu[7];         /* acceleration, temperature, gyro as the MPU-6050 has them */
    uint32_t pressure, temperature; /* raw, of the MS5837 */
    uint32_t loop_address, idle_address; /* of loop_once and hal_idle, in bytes */
    uint64_t loop_since, loop_worst, loop_cycles;
    uint32_t watched;                     /* address of a function, in bytes */
    uint64_t called, calls, longest_gap;  /* cycle of its last call; since the last look: calls, and cycles between two of them */
    uint16_t paint_from;
    uint8_t hung, kept[2];
};

/* --- the sensors' chips */

static const uint16_t PROM[7] = {0x2000, 34982, 36352, 20328, 22354, 26646, 26146}; /* the data sheet's example */

static void power_chip(struct chip *chip, uint8_t address) {
    chip->address = address;
    memset(chip->registers, 0, sizeof chip->registers);
    chip->registers[0x6B] = 0x40; /* sleeps */
    chip->converted = 0;
    chip->sent = 1;
}

static uint8_t imu_answer(struct simulation *s, struct chip *chip, uint8_t reg) {
    if (reg == 0x75)
        return chip->fault[WRONG] ? 0x70 : MPU;
    if (reg < 0x3B || reg > 0x48)
        return (uint8_t)(chip->registers[reg & 127] | (reg == 0x6B && chip->fault[ASLEEP] ? 0x40 : 0));
    if (chip->registers[0x6B] & 0x40 || chip->fault[ASLEEP])
        return 0;
    const uint8_t which = (uint8_t)((reg - 0x3B) / 2);
    int word = s->imu[which];
    if (which >= 4 && !(chip->registers[0x1B] & 0x18))
        word *= 2; /* the range is half of what it should be */
    if (which < 3 && !chip->fault[FROZEN])
        word += (int)(chip->samples % 3) - 1; /* noise */
    chip->samples += reg == 0x48; /* the last byte of a sample */
    return (uint8_t)(reg % 2 ? word >> 8 : word); /* 0x3B is the first high byte */
}

static uint8_t pressure_answer(struct simulation *s, struct chip *chip, uint8_t at) {
    if (chip->first >= 0xA0) {
        const uint16_t word = (uint16_t)(PROM[(chip->first - 0xA0) / 2 % 7] ^ (chip->fault[WRONG] ? 0x10 : 0));
        return at % 2 ? word & 0xFF : word >> 8;
    }
    if (at == 0 && s->avr->cycle < chip->ready)
        chip->sent = 1; /* read too early: there is no result */
    uint32_t result = chip->converted == 0x58 ? s->temperature : s->pressure;
    if (!chip->fault[FROZEN])
        result ^= chip->samples & 1; /* noise */
    if (chip->sent || chip->converted == 0 || chip->fault[ASLEEP])
        result = 0;
    if (at == 2) {
        chip->sent = 1;
        chip->samples++;
    }
    return (uint8_t)(result >> (16 - 8 * (at > 2 ? 2 : at)));
}

static uint8_t answer(struct simulation *s, struct chip *chip) {
    const uint8_t at = chip->at++;
    return chip->address == MPU ? imu_answer(s, chip, (uint8_t)(chip->first + at)) : pressure_answer(s, chip, at);
}

/* A byte behind the address; true if it is acknowledged. */
static int take(struct simulation *s, struct chip *chip, uint8_t byte) {
    if (chip->has_first) {
        if (chip->address == MPU)
            chip->registers[chip->first++ & 127] = byte;
        return 1;
    }
    chip->first = byte;
    chip->has_first = 1;
    if (chip->address == MS && byte == 0x1E) {
        chip->converted = 0;
        chip->sent = 1;
    } else if (chip->address == MS && (byte & 0xE0) == 0x40) {
        chip->converted = byte;
        chip->sent = 0;
        chip->ready = s->avr->cycle + CONVERSION_CYCLES * (chip->fault[LATE] ? 4u : 1u);
    }
    return 1;
}

/* --- the two-wire bus: simavr's own takes 9 us for a byte, and no chip can hold it */

static avr_cycle_count_t end_of_bus_step(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    struct simulation *s = parameter;
    (void)when;
    avr->data[TWSR_] = (uint8_t)((avr->data[TWSR_] & 3) | s->bus.status);
    avr->data[TWCR_] |= TWINT_;
    return 0;
}

static avr_cycle_count_t end_of_stop(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    (void)when;
    (void)parameter;
    avr->data[TWCR_] &= (uint8_t)~TWSTO_;
    return 0;
}

/* A late IMU holds the clock meanwhile. */
static void end_later(struct simulation *s, uint8_t status, uint32_t cycles) {
    const struct chip *chip = s->bus.selected;
    s->bus.status = status;
    avr_cycle_timer_register(s->avr, chip == &s->chips[0] && chip->fault[LATE] ? STRETCH_CYCLES : cycles, end_of_bus_step, s);
}

static uint8_t address_step(struct simulation *s) {
    struct bus *bus = &s->bus;
    const uint8_t byte = s->avr->data[TWDR_];
    bus->has_address = 1;
    bus->reads = byte & 1;
    bus->selected = NULL;
    for (uint32_t i = 0; i < 2; i++)
        if (s->chips[i].address == byte >> 1 && !s->chips[i].fault[ABSENT])
            bus->selected = &s->chips[i];
    if (bus->selected == NULL)
        return bus->reads ? 0x48 : 0x20;
    bus->selected->at = 0;
    if (!bus->reads)
        bus->selected->has_first = 0;
    return bus->reads ? 0x40 : 0x18;
}

static uint8_t data_step(struct simulation *s, uint8_t control) {
    struct bus *bus = &s->bus;
    if (bus->reads) {
        s->avr->data[TWDR_] = bus->selected == NULL ? 0xFF : answer(s, bus->selected);
        return control & TWEA_ ? 0x50 : 0x58;
    }
    return bus->selected != NULL && take(s, bus->selected, s->avr->data[TWDR_]) ? 0x28 : 0x30;
}

static void show_lines(struct simulation *s) {
    const uint8_t low = s->avr->data[DDRD_], high = (uint8_t)((low & SCL_ ? 0 : SCL_) | (low & SDA_ || s->bus.held ? 0 : SDA_));
    s->avr->data[PIND_] = (uint8_t)((s->avr->data[PIND_] & ~(SCL_ | SDA_)) | high);
}

static void on_twcr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *parameter) {
    struct simulation *s = parameter;
    struct bus *bus = &s->bus;
    const uint8_t before = avr->data[address];
    avr->data[address] = (uint8_t)((value & 0x7F) | (value & TWINT_ ? 0 : before & TWINT_));
    if (!(value & TWEN_)) {
        avr_cycle_timer_cancel(avr, end_of_bus_step, s);
        bus->is_started = 0;
        return;
    }
    if (!(value & TWINT_))
        return;
    if (value & TWSTO_) {
        bus->is_started = 0;
        bus->selected = NULL;
        if (bus->held == 0)
            avr_cycle_timer_register(avr, EDGE_CYCLES, end_of_stop, s);
    } else if (bus->held > 0)
        return; /* nothing ends */
    else if (value & TWSTA_) {
        end_later(s, bus->is_started ? 0x10 : 0x08, EDGE_CYCLES);
        bus->is_started = 1;
        bus->has_address = 0;
    } else if (bus->is_started && !bus->has_address)
        end_later(s, address_step(s), BYTE_CYCLES);
    else if (bus->is_started) {
        if (bus->cut_in > 0 && bus->reads && --bus->cut_in == 0) {
            bus->held = bus->holds_for; /* in the middle of a byte whose next bits are 0 */
            show_lines(s);
        } else
            end_later(s, data_step(s, value), BYTE_CYCLES);
    }
}

/* The program drives the bus by hand: a chip that holds SDA sees the clocks. */
static void on_ddrd(avr_t *avr, avr_io_addr_t address, uint8_t value, void *parameter) {
    struct simulation *s = parameter;
    if ((value & SCL_) && !(avr->data[address] & SCL_) && s->bus.held > 0)
        s->bus.held--;
    avr->data[address] = value;
    show_lines(s);
}

/* --- the EEPROM: simavr's own writes at once */

static avr_cycle_count_t end_of_write(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    struct simulation *s = parameter;
    (void)when;
    s->eeprom[s->ee_address] = s->ee_value;
    s->ee_until = 0;
    avr->data[EECR_] &= (uint8_t)~EEPE_;
    return 0;
}

static void on_eecr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *parameter) {
    struct simulation *s = parameter;
    const uint16_t at = (uint16_t)((avr->data[EEARL_] | avr->data[EEARL_ + 1] << 8) % EEPROM_BYTES);
    if (value & (EERE_ | EEPE_) && s->ee_until > 0 && !(avr->data[address] & value & EEPE_ && !(value & EERE_)))
        s->ee_errors++;
    else if (value & EERE_)
        avr->data[EEDR_] = s->eeprom[at];
    else if (value & EEPE_ && s->ee_until == 0 && avr->cycle <= s->ee_enabled) {
        s->ee_address = at;
        s->ee_value = avr->data[EEDR_];
        s->ee_writes++;
        s->ee_until = avr->cycle + EEPROM_CYCLES;
        avr_cycle_timer_register(avr, EEPROM_CYCLES, end_of_write, s);
    }
    if (value & EEMPE_)
        s->ee_enabled = avr->cycle + ENABLE_CYCLES;
    avr->data[address] = (uint8_t)((value & ~(EERE_ | EEPE_ | EEMPE_)) | (s->ee_until > 0 ? EEPE_ : 0));
}

/* A reset of the processor has cleared its registers and timers. The bus floats high. */
static void on_reset(avr_io_t *io) {
    struct simulation *s = (struct simulation *)((char *)io - offsetof(struct simulation, io));
    s->bus.is_started = 0;
    s->loop_since = 0;
    for (uint32_t i = 0; i < CHANNELS; i++)
        s->pins[i].is_high = s->pins[i].waits = 0;
    if (s->ee_until > 0) { /* a write goes on through a reset */
        s->ee_until = s->avr->cycle + EEPROM_CYCLES;
        avr_cycle_timer_register(s->avr, EEPROM_CYCLES, end_of_write, s);
        s->avr->data[EECR_] = EEPE_;
    }
    show_lines(s);
}

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    struct simulation *s = parameter;
    if (s->out_count < RING)
        s->out[s->out_count++] = value;
    (void)irq;
}

/* --- the servo pins: simavr takes a new width in the middle of a pulse, and misses its end if that has passed; an ATmega's compare
registers are buffered */

static const uint8_t COMPARE[CHANNELS] = {0x98, 0x9A, 0x9C, 0xA8, 0xAA, 0xAC, 0x88, 0x8A}; /* OCR3A, B, C, OCR4A, B, C, OCR1A, B */

static avr_cycle_count_t take_width(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    struct pin *pin = parameter;
    const uint8_t low = COMPARE[pin->channel];
    (void)when;
    pin->waits = 0;
    avr->data[low + 1] = (uint8_t)(pin->width >> 8);
    pin->write_width(avr, low, (uint8_t)pin->width, pin->parameter);
    return 0;
}

static void on_width(avr_t *avr, avr_io_addr_t address, uint8_t value, void *parameter) {
    struct pin *pin = parameter;
    pin->width = (uint16_t)(avr->data[address + 1] << 8 | value);
    pin->waits = pin->is_high;
    if (!pin->waits)
        take_width(avr, avr->cycle, pin);
}

static void on_pin(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    struct pin *pin = parameter;
    struct simulation *s = pin->simulation;
    pin->is_high = value != 0;
    if (!pin->is_high && pin->waits)
        avr_cycle_timer_register(s->avr, 1, take_width, pin);
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
    avr_t *avr = s->avr;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)AVR_UART_FLAG_STDIO;
    flags &= ~(uint32_t)AVR_UART_FLAG_POLL_SLEEP;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, s);
    for (uint32_t i = 0; i < CHANNELS; i++) {
        s->pins[i] = (struct pin){.simulation = s, .channel = i, .write_width = avr->io[AVR_DATA_TO_IO(COMPARE[i])].w.c,
                                  .parameter = avr->io[AVR_DATA_TO_IO(COMPARE[i])].w.param};
        avr->io[AVR_DATA_TO_IO(COMPARE[i])].w.c = on_width;
        avr->io[AVR_DATA_TO_IO(COMPARE[i])].w.param = &s->pins[i];
        avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(PORTS[i]), PINS[i]), on_pin, &s->pins[i]);
    }
    power_chip(&s->chips[0], MPU);
    power_chip(&s->chips[1], MS);
    s->avr->io[AVR_DATA_TO_IO(TWCR_)].w.c = on_twcr; /* in the place of simavr's own */
    s->avr->io[AVR_DATA_TO_IO(TWCR_)].w.param = s;
    s->avr->io[AVR_DATA_TO_IO(EECR_)].w.c = on_eecr;
    s->avr->io[AVR_DATA_TO_IO(EECR_)].w.param = s;
    s->avr->io[AVR_DATA_TO_IO(DDRD_)].w.c = on_ddrd;
    s->avr->io[AVR_DATA_TO_IO(DDRD_)].w.param = s;
    s->io = (avr_io_t){.kind = "board", .reset = on_reset};
    avr_register_io(avr, &s->io);
    show_lines(s);
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
    s->pressure = 4510376; /* 1013.2 hPa */
    s->temperature = 6815414;
    attach(s);
    simulation_battery(s, 2460);
    return s;
}

/* Chip 0 is the IMU, 1 the pressure sensor. */
void simulation_fault(struct simulation *s, uint32_t chip, uint32_t fault, int is_on) { s->chips[chip].fault[fault] = (uint8_t)is_on; }

/* A chip's supply fails for a moment. */
void simulation_power_chip(struct simulation *s, uint32_t chip) { power_chip(&s->chips[chip], s->chips[chip].address); }

/* A register of the IMU changes by itself. */
void simulation_glitch(struct simulation *s, uint8_t address, uint8_t value) { s->chips[0].registers[address & 127] = value; }

/* A chip stops in the middle of a byte of the read that comes, and holds the bus for so many clocks. */
void simulation_hold_bus(struct simulation *s, uint8_t bytes, uint32_t clocks) {
    s->bus.cut_in = bytes;
    s->bus.holds_for = clocks;
}

/* The bus is free again. */
void simulation_free_bus(struct simulation *s) {
    s->bus.held = s->bus.cut_in = 0;
    show_lines(s);
}

/* What the sensors measure, in their own numbers. */
void simulation_measure(struct simulation *s, const int16_t imu[7], uint32_t pressure) {
    memcpy(s->imu, imu, sizeof s->imu);
    s->pressure = pressure;
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

static void note_call(struct simulation *s) {
    const uint64_t gap = s->avr->cycle - s->called;
    s->longest_gap = s->calls > 0 && gap > s->longest_gap ? gap : s->longest_gap;
    s->called = s->avr->cycle;
    s->calls++;
}

/* Watch a function from now on; its calls since then, and the cycles of the longest time between two of them. */
void simulation_watch(struct simulation *s, uint32_t address) {
    s->watched = address;
    s->calls = s->longest_gap = 0;
}

void simulation_calls(const struct simulation *s, uint64_t calls[2]) {
    calls[0] = s->calls;
    calls[1] = s->longest_gap;
}

/* Run to this cycle; 0 if the processor crashed. */
int simulation_run(struct simulation *s, uint64_t cycle) {
    for (uint8_t i = 4; i <= 5; i++) /* two servo pins are also INT4 and INT5: since a reset simavr looks at them in each cycle while low */
        avr_extint_set_strict_lvl_trig(s->avr, i, 0);
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
        else if (s->avr->pc == s->watched)
            note_call(s);
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
    memcpy(write ? s->eeprom : bytes, write ? bytes : s->eeprom, EEPROM_BYTES);
}

/* Bytes that were begun to be written; accesses while one was. */
void simulation_eeprom_counts(const struct simulation *s, uint32_t counts[2]) {
    counts[0] = s->ee_writes;
    counts[1] = s->ee_errors;
}

/* A reset, with causes as MCUSR has them. With `lost` nothing but the EEPROM outlives it, and a byte of it that is being written becomes
`torn`; the chips stay on. */
void simulation_reset(struct simulation *s, uint8_t causes, int lost, uint8_t torn) {
    if (lost) {
        if (s->ee_until > 0)
            s->eeprom[s->ee_address] = torn;
        s->ee_until = 0;
        for (uint32_t i = RAM_BEGIN, noise = torn + 1u; i <= s->avr->ramend; i++) {
            noise = noise * 1664525u + 1013904223u;
            s->avr->data[i] = (uint8_t)(noise >> 24);
        }
    }
    avr_reset(s->avr);
    s->avr->data[MCUSR_] = causes;
}

/* Start at a bootloader, which an Intel HEX file has; bytes of it. */
uint32_t simulation_bootloader(struct simulation *s, const char *path, uint32_t start) {
    uint32_t size, begin;
    uint8_t *data = read_ihex_file(path, &size, &begin);
    if (data == NULL)
        return 0;
    memcpy(s->avr->flash + begin, data, size);
    free(data);
    s->avr->reset_pc = start;
    s->avr->codeend = s->avr->flashend;
    return size;
}

uint32_t simulation_pc(const struct simulation *s) { return s->avr->pc; }

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
