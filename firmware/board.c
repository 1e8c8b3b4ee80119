#include "board.h"

#include <string.h>

#include "flash.h"

/* Name of the cause of a reset that is no power-on in air. */
static const char *cause(uint8_t causes) {
    return causes & RESET_WATCHDOG    ? PSTR("restarted: watchdog")
           : causes & RESET_BROWN_OUT ? PSTR("restarted: brown-out")
           : causes & RESET_PIN       ? PSTR("restarted: reset pin")
           : causes & RESET_POWER_ON  ? PSTR("restarted: power-on")
                                      : PSTR("restarted: unknown cause");
}

/* HEARTBEAT's custom_mode. Simulated measurements have no zero. */
static uint16_t status(const struct board *board) {
    const uint16_t all = zero_status(&board->zero);
    return rules_hil(&board->rules) ? (uint16_t)(all & ~(unsigned)ZERO_IN_QUESTION) : all;
}

void board_begin(struct board *board, uint8_t robot, const struct settings *settings, struct stamps stamps,
                 const struct start *start) {
    memset(board, 0, sizeof *board);
    struct parameters *parameters = &board->rules.parameters; /* in its place: the stack is deepest here */
    parameters_standard(parameters);
    if (settings != NULL)
        parameters_restore(parameters, &settings->parameters);
    const struct peer me = {robot, BOARD_COMPONENT}, computer = {robot, COMPUTER_COMPONENT};
    const uint8_t *key = settings != NULL && settings->has_key ? settings->key : NULL;
    const bool is_locked = settings != NULL && settings->is_lost;
    rules_begin(&board->rules, computer);
    link_begin(&board->link, me, key, stamps.heard, stamps.sent + SENT_BETWEEN);
    board->link.gate.is_locked = is_locked;
    if (is_locked)
        rules_say(&board->rules, SAY_CRITICAL, PSTR("settings cannot be read: takes nothing"));
    zero_begin(&board->zero, start);
    if (!start->is_power_on)
        rules_say(&board->rules, SAY_WARNING, cause(start->causes));
    board->told_status = status(board);
    board->kept = stamps;
    board->to_list = PARAMETERS;
}

/* --- memory */

struct settings board_settings(const struct board *board) {
    struct settings settings = {.parameters = board->rules.parameters, .has_key = board->link.gate.has_key};
    memcpy(settings.key, board->link.gate.key, KEY_BYTES);
    return settings;
}

struct stamps board_stamps(const struct board *board) {
    return (struct stamps){.heard = board->link.gate.newest, .sent = board->link.sent_stamp};
}

void board_kept(struct board *board, uint8_t what, struct stamps stamps) {
    board->memory &= (uint8_t)~what;
    if (what & KEEP_STAMPS)
        board->kept = stamps;
    if (board->kept.heard < board->used_stamp) /* it came while older ones were written */
        board->memory |= KEEP_STAMPS;
}

/* The latest timestamp taken is used up, whatever is being written by now. */
static void keep_newest(struct board *board) {
    board->used_stamp = board->link.gate.newest;
    board->memory |= KEEP_STAMPS;
}

static bool has_new_stamps(const struct board *board) { return board->link.gate.newest > board->kept.heard; }

/* --- measurements of the simulator */

static void simulate_motion(struct simulated *simulated, const struct reading *motion, uint64_t now_us) {
    const float battery_v = simulated->reading.battery_v;
    simulated->reading = *motion;
    simulated->reading.battery_v = battery_v;
    simulated->has_motion = true;
    simulated->motion_us = now_us;
}

static void simulate_battery(struct simulated *simulated, float battery_v, uint64_t now_us) {
    simulated->reading.battery_v = battery_v;
    simulated->has_battery = true;
    simulated->battery_us = now_us;
}

/* What there is to measure with now: a battery that is silent for too long is at 0 V. */
static void age(struct simulated *simulated, uint64_t now_us) {
    if (now_us - simulated->motion_us > MOTION_AGE_US)
        simulated->has_motion = false;
    if (now_us - simulated->battery_us > BATTERY_AGE_US)
        simulate_battery(simulated, 0.0f, simulated->battery_us);
}

/* --- what arrives */

/* Send the texts and the changes of arming, of HIL mode and of the zero that are due. */
static void report(struct board *board) {
    for (uint8_t i = 0; i < board->rules.texts; i++)
        send_text(&board->link, &board->rules.text[i]);
    board->rules.texts = 0;
    const bool armed = board->rules.armed, hil = rules_hil(&board->rules);
    const uint16_t now = status(board);
    if (armed != board->told_armed || hil != board->told_hil || now != board->told_status) {
        board->told_armed = armed;
        board->told_hil = hil;
        board->told_status = now;
        send_heartbeat(&board->link, &board->rules, now);
    }
}

static void refuse_parameter(struct board *board, const struct event *event, int index, enum refusal refusal) {
    static const char WORDS[][24] PROGMEM = {
        "", "no such parameter", "out of range", "not a REAL32", "does not fit the others", "armed"};
    static const uint8_t CODES[] = {0, 1, 2, 2, 2, 3}; /* MAV_PARAM_ERROR */
    struct text text;
    text_begin(&text, SAY_WARNING);
    text_name(&text, event->parameter.name, PARAMETER_NAME);
    text_flash(&text, PSTR(": "));
    text_flash(&text, WORDS[refusal]);
    if (refusal == OUT_OF_RANGE) {
        const struct parameter_row row = parameter_row(index);
        text_flash(&text, PSTR(" ("));
        text_name(&text, row.bounds, sizeof row.bounds);
        text_flash(&text, PSTR(")"));
    }
    send_parameter_error(&board->link, event->from, event->parameter.name, index, CODES[refusal]);
    send_text(&board->link, &text);
}

/* Send a parameter's present value, and the reason for a refusal. */
static void answer_parameter(struct board *board, const struct event *event, int index, enum refusal refusal) {
    if (index >= 0)
        send_parameter(&board->link, index, board->rules.parameters.value[index]);
    if (index < 0 || refusal != TAKEN)
        refuse_parameter(board, event, index, index < 0 ? UNKNOWN_PARAMETER : refusal);
}

static void read_parameter(struct board *board, struct event *event) {
    int index = event->parameter.index;
    if (index >= PARAMETERS) {
        memset(event->parameter.name, 0, PARAMETER_NAME);
        index = NO_PARAMETER;
    } else if (index < 0)
        index = parameter_named(event->parameter.name);
    answer_parameter(board, event, index, TAKEN);
}

static void set_parameter(struct board *board, const struct event *event, uint64_t now_us) {
    const bool was_hil = rules_hil(&board->rules);
    const int index = parameter_named(event->parameter.name);
    const float before = index >= 0 ? board->rules.parameters.value[index] : 0.0f;
    enum refusal refusal = NOT_REAL32;
    if (event->parameter.is_real32)
        refusal = rules_change(&board->rules, index, event->parameter.value);
    answer_parameter(board, event, index, refusal);
    if (refusal == TAKEN && board->rules.parameters.value[index] != before)
        board->memory |= KEEP_SETTINGS;
    if (rules_hil(&board->rules) != was_hil)
        board->simulated = (struct simulated){.motion_us = now_us, .battery_us = now_us};
}

/* Sign with this key from now on. A board with a key takes another only from who has its own. */
static void take_key(struct board *board, const struct event *event) {
    struct text text;
    if (!rules_take_key(&board->rules)) {
        text_begin(&text, SAY_WARNING);
        text_flash(&text, PSTR("no new key: armed"));
        send_text(&board->link, &text);
        return;
    }
    board->has_order = false; /* of the time of another key */
    link_take_key(&board->link, event->key.secret, event->key.newest, SENT_BETWEEN);
    board->refused = 0; /* counted anew, as by the link */
    text_begin(&text, SAY_INFO);
    text_flash(&text, PSTR("signed from now on"));
    send_text(&board->link, &text);
    board->memory |= KEEP_SETTINGS | KEEP_STAMPS;
}

/* Have the zeros confirmed or taken anew, for a person. */
static enum result calibrate(struct board *board, const struct event *event) {
    const bool takes = event->calibrate.pressure || event->calibrate.gyro;
    if (board->rules.armed) {
        rules_say(&board->rules, SAY_WARNING, PSTR("not calibrated: armed"));
        return REJECTED;
    }
    if (rules_hil(&board->rules)) {
        rules_say(&board->rules, SAY_WARNING, PSTR("not calibrated: in HIL mode"));
        return REJECTED;
    }
    if (!zero_calibrate(&board->zero, event->calibrate.pressure, event->calibrate.gyro)) {
        rules_say(&board->rules, SAY_WARNING,
                  takes ? PSTR("depth zero not taken: no pressure") : PSTR("no depth zero is kept: take it in air"));
        return REJECTED;
    }
    if (!takes)
        rules_say(&board->rules, SAY_INFO, PSTR("depth zero confirmed"));
    return ACCEPTED;
}

static void handle(struct board *board, struct event *event, uint64_t now_us) {
    struct link *link = &board->link;
    switch (event->kind) {
    case EVENT_OVERRIDE:
        if (rules_override(&board->rules, event->from, event->pulses_us, link_arrival_us(link, now_us)))
            board->is_commanded = true;
        break;
    case EVENT_ARM: {
        if (!event->arm && board->has_order && board->order.kind == EVENT_ARM)
            board->has_order = false; /* an order to arm that waits is withdrawn */
        const enum result result = rules_arm(&board->rules, event->arm, now_us);
        if (board->rules.armed)
            zero_leave_bias(&board->zero);
        report(board);
        send_acknowledge(link, event->from, COMMAND_ARM_DISARM, result);
        break;
    }
    case EVENT_CALIBRATE: {
        const enum result result = calibrate(board, event);
        report(board);
        send_acknowledge(link, event->from, COMMAND_CALIBRATE, result);
        break;
    }
    case EVENT_TIMESYNC:
        send_timesync(link, now_us > 0 ? (int64_t)(now_us * 1000u) : 1, event->sent_ns);
        break;
    case EVENT_TELL_VERSION:
        send_acknowledge(link, event->from, COMMAND_REQUEST_MESSAGE, ACCEPTED);
        send_version(link);
        break;
    case EVENT_UNSUPPORTED:
        send_acknowledge(link, event->from, event->command, UNSUPPORTED);
        break;
    case EVENT_LIST_PARAMETERS:
        board->to_list = 0;
        break;
    case EVENT_READ_PARAMETER:
        read_parameter(board, event);
        break;
    case EVENT_SET_PARAMETER:
        set_parameter(board, event, now_us);
        break;
    case EVENT_SET_KEY:
        take_key(board, event);
        break;
    case EVENT_SIMULATED_MOTION:
        simulate_motion(&board->simulated, &event->motion, now_us);
        break;
    case EVENT_SIMULATED_BATTERY:
        simulate_battery(&board->simulated, event->battery_v, now_us);
        break;
    case EVENT_REFUSED:
        board->refused++;
        break;
    case EVENT_NONE:
        break;
    }
}

uint16_t board_put(struct board *board, const uint8_t *data, uint16_t bytes, uint64_t now_us) {
    return link_put(&board->link, data, bytes, now_us);
}

/* True for what may count only after its timestamp is kept, so that it cannot count again after a loss of power. Disarming,
which cannot do harm twice, does not wait. */
static bool is_order(const struct event *event) {
    return (event->kind == EVENT_ARM && event->arm) || event->kind == EVENT_SET_PARAMETER || event->kind == EVENT_CALIBRATE;
}

/* One order waits at a time, so that overrides behind it are read: the next has to be sent again, as one that was lost. Its
timestamp is used up. */
static void refuse_order(struct board *board, const struct event *event) {
    keep_newest(board);
    if (event->kind != EVENT_SET_PARAMETER)
        send_acknowledge(&board->link, event->from, event->kind == EVENT_ARM ? COMMAND_ARM_DISARM : COMMAND_CALIBRATE, REJECTED);
}

bool board_work(struct board *board, uint64_t now_us) {
    if (board->has_order && board->kept.heard >= board->order_stamp) {
        board->has_order = false;
        handle(board, &board->order, now_us);
        return true;
    }
    struct frame frame;
    switch (link_next(&board->link, now_us, &frame)) {
    case LINK_FRAME: {
        struct event event = read_event(&frame, board->link.me.system, rules_hil(&board->rules));
        if (is_order(&event) && board->has_order)
            refuse_order(board, &event);
        else if (is_order(&event) && has_new_stamps(board)) {
            board->order = event;
            board->order_stamp = board->link.gate.newest;
            board->has_order = true;
            keep_newest(board);
        } else
            handle(board, &event, now_us);
        return true;
    }
    case LINK_BUSY:
        return true;
    default:
        return link_sign(&board->link);
    }
}

/* --- time goes on */

/* True once for each multiple of the period that is reached. `due_us` is the next one; a division, which is slow, only if others
were passed over. */
static bool is_due(uint64_t *due_us, uint32_t period_us, uint64_t now_us) {
    if (now_us < *due_us)
        return false;
    *due_us += period_us;
    if (*due_us <= now_us)
        *due_us = (now_us / period_us + 1) * period_us;
    return true;
}

bool board_weighs(const struct board *board, uint64_t now_us) { return now_us >= board->weigh_due_us; }

void board_weigh(struct board *board, uint64_t now_us, float voltage_v) {
    const bool hil = rules_hil(&board->rules), later = board->has_weighed && now_us > board->weighed_us;
    const float elapsed_s = later ? (float)(now_us - board->weighed_us) * 1e-6f : 0.0f;
    if (!is_due(&board->weigh_due_us, BURST_US, now_us))
        return;
    board->has_weighed = true;
    board->weighed_us = now_us;
    age(&board->simulated, now_us);
    board->battery_v = hil ? board->simulated.reading.battery_v : voltage_v;
    if (!hil || board->simulated.has_battery)
        rules_battery(&board->rules, board->battery_v, elapsed_s);
}

/* A burst waits until the one before is signed: on a slow processor that can take longer than its time. */
bool board_measures(const struct board *board, uint64_t now_us) {
    return now_us >= board->burst_due_us && board->link.outbox_ready == board->link.outbox_bytes;
}

/* Send all measurements that there are, ATTITUDE last: it completes a burst. */
static void burst(struct board *board, uint64_t now_us, const struct reading *reading, bool has_motion, bool has_battery) {
    struct link *link = &board->link;
    struct rules *rules = &board->rules;
    const uint32_t board_ms = (uint32_t)(now_us / 1000u);
    if (has_motion) {
        send_imu(link, board_ms, reading);
        send_pressure(link, board_ms, reading);
    }
    send_servo_output(link, (uint32_t)now_us, rules);
    if (is_due(&board->status_due_us, STATUS_US, now_us) && has_battery) {
        send_status(link, board->battery_v, rules->charge, rules->overrides_refused + board->refused, has_motion ? reading : NULL);
        send_battery(link, board->battery_v, rules->charge);
    }
    if (is_due(&board->heartbeat_due_us, HEARTBEAT_US, now_us))
        send_heartbeat(link, rules, status(board));
    if (board->to_list < PARAMETERS) {
        send_parameter(link, board->to_list, rules->parameters.value[board->to_list]);
        board->to_list++;
    }
    if (has_motion)
        send_attitude(link, board_ms, reading);
    if (is_due(&board->keep_due_us, KEEP_US, now_us) && has_new_stamps(board))
        board->memory |= KEEP_STAMPS;
}

static void say_chip(struct rules *rules, uint8_t chip, uint8_t state) {
    static const char NAMES[][11] PROGMEM = {"IMU: ", "pressure: "};
    static const char STATES[][7] PROGMEM = {"live", "absent", "", "asleep", "reset", "stuck"};
    rules_say(rules, state == CHIP_LIVE ? SAY_INFO : SAY_WARNING, NAMES[chip]);
    text_flash(&rules->text[rules->texts - 1], STATES[state]);
}

/* Take the zeros of the sensors off a measurement, which they may be taken from. */
static struct reading zeroed(struct board *board, const struct reading *measured) {
    struct zero *zero = &board->zero;
    const enum zero_event event = zero_pressure(zero, measured->excess_hpa);
    if (event == ZERO_TAKEN)
        rules_say(&board->rules, SAY_INFO, PSTR("depth zero taken"));
    if (event == ZERO_MISSED)
        rules_say(&board->rules, SAY_WARNING, PSTR("depth zero not taken: no pressure"));
    if (event == ZERO_QUESTIONED)
        rules_say(&board->rules, SAY_WARNING, PSTR("depth zero in question: confirm it"));
    if (zero_rate(zero, measured->yaw_rate_radps) == BIAS_TAKEN || event == ZERO_TAKEN)
        board->memory |= KEEP_ZEROS;
    for (uint8_t i = 0; i < CHIPS; i++) /* not that it starts: one that never measures does so once a second */
        if (measured->chip[i] != board->told_chip[i] && measured->chip[i] != CHIP_STARTING)
            say_chip(&board->rules, i, board->told_chip[i] = measured->chip[i]);
    struct reading reading = *measured;
    reading.excess_hpa = zero_excess_hpa(zero, measured->excess_hpa);
    reading.yaw_rate_radps -= zero->now.gyro_bias_radps;
    return reading;
}

void board_step(struct board *board, uint64_t now_us) {
    board->is_commanded = false;
    rules_step(&board->rules, now_us);
    report(board);
}

void board_measure(struct board *board, uint64_t now_us, const struct reading *reading) {
    const bool hil = rules_hil(&board->rules);
    struct reading own;
    if (hil) {
        age(&board->simulated, now_us);
        reading = &board->simulated.reading;
    } else {
        own = zeroed(board, reading);
        reading = &own;
    }
    report(board);
    if (is_due(&board->burst_due_us, BURST_US, now_us))
        burst(board, now_us, reading, !hil || board->simulated.has_motion, !hil || board->simulated.has_battery);
}
