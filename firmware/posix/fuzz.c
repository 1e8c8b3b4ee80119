/* Any bytes, frames and times: libFuzzer's target, under the address and undefined-behaviour sanitizers. `make fuzz`.

An input is a byte that says how the board begins, and then records: raw bytes, frames, steps, and how much of its work the
board does after each. A frame begins as one that the board takes; the record's bytes are XORed onto its payload, checksum and
signature are made after that. After each step the rules that matter most are looked at: `look`. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "../board.h"
#include "../mavlink.h"

enum { RAW, FRAME, STEP, WORK }; /* kinds of records */
enum { RIGHT, STRANGER, FORGED, REPEATED };

#define MESSAGE(NAME, ...) {MAVLINK_MSG_ID_##NAME, MAVLINK_MSG_ID_##NAME##_CRC, MAVLINK_MSG_ID_##NAME##_LEN, {__VA_ARGS__}}
#define PULSES(us) .chan1_raw = us, .chan2_raw = us, .chan3_raw = us, .chan4_raw = us
#define TO_BOARD .target_system = 1, .target_component = BOARD_COMPONENT

static const struct message {
    uint16_t id;
    uint8_t seed, bytes;
    union {
        mavlink_rc_channels_override_t override;
        mavlink_command_long_t command;
        mavlink_param_set_t set;
        mavlink_param_request_read_t read;
        mavlink_param_request_list_t list;
        mavlink_setup_signing_t key;
        mavlink_hil_sensor_t motion;
        mavlink_battery_status_t battery;
        mavlink_timesync_t timesync;
        mavlink_heartbeat_t heartbeat;
        uint8_t byte[255];
    } payload;
} MESSAGES[] = {
    MESSAGE(RC_CHANNELS_OVERRIDE, .override = {PULSES(1500), TO_BOARD, .chan5_raw = IGNORED, .chan6_raw = IGNORED,
                                               .chan7_raw = IGNORED, .chan8_raw = IGNORED}),
    MESSAGE(RC_CHANNELS_OVERRIDE,
            .override = {PULSES(1560), TO_BOARD, .chan5_raw = 1000, .chan6_raw = 1500, .chan7_raw = 1500, .chan8_raw = 2000}),
    MESSAGE(COMMAND_LONG, .command = {TO_BOARD, .command = COMMAND_ARM_DISARM, .param1 = 1.0f}),
    MESSAGE(COMMAND_LONG, .command = {TO_BOARD, .command = COMMAND_ARM_DISARM}),
    MESSAGE(COMMAND_LONG,
            .command = {TO_BOARD, .command = COMMAND_REQUEST_MESSAGE, .param1 = MAVLINK_MSG_ID_AUTOPILOT_VERSION}),
    MESSAGE(COMMAND_LONG, .command = {TO_BOARD, .command = COMMAND_CALIBRATE, .param3 = 1.0f}),
    MESSAGE(PARAM_SET, .set = {TO_BOARD, .param_type = MAV_PARAM_TYPE_REAL32}),
    MESSAGE(PARAM_SET, .set = {TO_BOARD, .param_type = MAV_PARAM_TYPE_REAL32, .param_id = "HIL_MODE", .param_value = 1.0f}),
    MESSAGE(PARAM_SET, .set = {TO_BOARD, .param_type = MAV_PARAM_TYPE_REAL32, .param_id = "HIL_OUTPUTS", .param_value = 1.0f}),
    MESSAGE(PARAM_REQUEST_READ, .read = {TO_BOARD, .param_index = -1}),
    MESSAGE(PARAM_REQUEST_LIST, .list = {TO_BOARD}),
    MESSAGE(SETUP_SIGNING, .key = {TO_BOARD, .secret_key = "a key that was given to the boar"}),
    MESSAGE(HIL_SENSOR, .motion = {.zacc = -9.8f, .xmag = 1.0f, .abs_pressure = 1100.0f, .fields_updated = 0x2E7}),
    MESSAGE(BATTERY_STATUS, .battery = {.voltages = {12000}}),
    MESSAGE(TIMESYNC, .timesync = {.ts1 = 1}),
    MESSAGE(HEARTBEAT, .heartbeat = {.mavlink_version = 3}),
};
enum { KINDS = sizeof MESSAGES / sizeof MESSAGES[0] };

static struct board board;
static uint64_t now_us;
static uint8_t sequence, pieces; /* number of the next frame; calls of board_work after a record, 0: all there are */

static void keep(void) { board_kept(&board, KEEP_SETTINGS | KEEP_STAMPS | KEEP_ZEROS, board_stamps(&board)); }

/* Do all work, or as many pieces as the input says; its lowest bits hold up the memory and the output. */
static void work(void) {
    for (uint8_t i = 0; pieces == 0 || i < pieces; i++) {
        const bool more = board_work(&board, now_us);
        if (!(pieces & 1))
            keep();
        if (!more && !board.memory)
            break;
    }
    uint16_t bytes;
    link_output(&board.link, &bytes);
    link_sent(&board.link, pieces & 2 ? bytes / 2 : bytes);
}

static void receive(const uint8_t *data, uint16_t bytes) {
    while (bytes > 0) {
        const uint16_t room = link_room(&board.link), put = board_put(&board, data, bytes, now_us);
        if (put != (bytes < room ? bytes : room))
            abort();
        data += put;
        bytes = (uint16_t)(bytes - put);
        work();
        if (put == 0) { /* or an order would wait for the memory for ever */
            keep();
            board_work(&board, now_us);
        }
    }
}

/* Write the signature behind a frame of which so many bytes are made. */
static void sign(uint8_t *frame, uint16_t bytes, uint8_t how) {
    frame[bytes] = 0; /* link id */
    write_timestamp(frame + bytes + 1, board.link.gate.newest + (how != REPEATED));
    struct signature_job job;
    signature_begin(&job, board.link.gate.key, frame, (uint16_t)(bytes + SIGNATURE_BYTES - HASH_BYTES));
    while (!signature_continue(&job)) {
    }
    signature_hash(&job, frame + bytes + SIGNATURE_BYTES - HASH_BYTES);
    frame[bytes + SIGNATURE_BYTES - 1] ^= how == FORGED;
}

/* Name the parameter of a message that has none, with its standard value; returns true if it did. */
static bool name_parameter(struct message *message, uint8_t which) {
    const struct parameter_row row = parameter_row(which % PARAMETERS);
    if (message->id == MAVLINK_MSG_ID_PARAM_REQUEST_READ)
        memcpy(message->payload.read.param_id, row.name, PARAMETER_NAME);
    else if (message->id == MAVLINK_MSG_ID_PARAM_SET && message->payload.set.param_id[0] == '\0') {
        memcpy(message->payload.set.param_id, row.name, PARAMETER_NAME);
        message->payload.set.param_value = row.standard;
    } else
        return false;
    return true;
}

static void receive_frame(struct message message, uint8_t how, const uint8_t *mask, uint8_t masked) {
    uint8_t frame[FRAME_BYTES], *payload = frame + HEADER_BYTES, bytes = message.bytes;
    if (masked > 0 && name_parameter(&message, *mask))
        mask++, masked--;
    for (uint8_t i = 0; i < masked; i++)
        message.payload.byte[i] ^= mask[i];
    while (bytes > 1 && message.payload.byte[bytes - 1] == 0)
        bytes--;
    const bool simulated = message.id == MAVLINK_MSG_ID_HIL_SENSOR || message.id == MAVLINK_MSG_ID_BATTERY_STATUS;
    const uint8_t sender = how == STRANGER ? sequence : simulated ? SIMULATOR_COMPONENT : COMPUTER_COMPONENT;
    const bool is_signed = board.link.gate.has_key != (how == FORGED && (masked & 1));
    const uint8_t header[HEADER_BYTES] = {
        0xFD, bytes, is_signed ? SIGNED_FLAG : 0, 0, sequence, 1, sender, (uint8_t)message.id, (uint8_t)(message.id >> 8), 0};
    sequence = (uint8_t)(sequence + (how != REPEATED));
    memcpy(frame, header, HEADER_BYTES);
    memcpy(payload, message.payload.byte, bytes);
    uint16_t crc = X25_INIT_CRC;
    for (uint16_t i = 1; i < HEADER_BYTES + bytes; i++)
        crc_accumulate(frame[i], &crc);
    crc_accumulate(message.seed, &crc);
    payload[bytes] = (uint8_t)crc;
    payload[bytes + 1] = (uint8_t)(crc >> 8);
    const uint16_t unsigned_bytes = (uint16_t)(HEADER_BYTES + bytes + CHECKSUM_BYTES);
    if (is_signed)
        sign(frame, unsigned_bytes, how);
    receive(frame, (uint16_t)(unsigned_bytes + (is_signed ? SIGNATURE_BYTES : 0)));
}

/* Abort if a board is armed without a young override, or a thruster turns that is not armed, beyond its limits, or on a pin that
HIL mode holds. */
static void look(void) {
    const struct rules *rules = &board.rules;
    const float *value = rules->parameters.value;
    const bool held = value[HIL_MODE] != 0.0f && value[HIL_OUTPUTS] == 0.0f;
    if (rules->armed && !(rules->has_command && now_us - rules->command_at_us <= (uint64_t)value[CMD_AGE_MS] * 1000u))
        abort();
    for (uint8_t i = 0; i < value[THR_COUNT]; i++) {
        const float echo_us = rules_echo_us(rules, i);
        const float pin_us = (held ? value[THR_NEUTRAL_US] : echo_us) + value[THR1_TRIM_US + i];
        if ((float)rules_output_us(rules, i) != fminf(fmaxf(pin_us, value[THR_MIN_US]), value[THR_MAX_US]))
            abort();
        if (echo_us != value[THR_NEUTRAL_US] && !(rules->armed && value[THR_MIN_US] <= echo_us && echo_us <= value[THR_MAX_US]))
            abort();
    }
}

static void step(uint8_t how) {
    static const uint32_t LATER_US[] = {0, 1000, 5000, 20000, 60000, 240000, 600000, 3000000};
    static const float BATTERY_V[] = {12.0f, 12.0f, 10.6f, 10.2f, 9.5f, 0.0f, NAN, INFINITY};
    struct reading reading = {.battery_v = BATTERY_V[how >> 3 & 7]};
    memcpy(&reading.heading_rad, &now_us, sizeof reading.heading_rad);
    memset(&reading.yaw_rate_radps, how, sizeof reading.yaw_rate_radps);
    reading.excess_hpa = how & 0x20 ? NAN : (float)how;
    reading.chip[how & 1] = (uint8_t)((how >> 1 & 7) % (CHIP_STUCK + 1));
    now_us += LATER_US[how & 7];
    if (board_weighs(&board, now_us))
        board_weigh(&board, now_us, reading.battery_v);
    board_step(&board, now_us);
    if (board_measures(&board, now_us))
        board_measure(&board, now_us, &reading);
    look();
    work();
}

/* Bit 0 a key, bit 1 in HIL mode, bit 2 with parameters that the memory has damaged, bit 3 a restart. */
static void begin(uint8_t how) {
    static struct board begun[16];
    static bool is_made;
    for (uint8_t i = 0; i < 16 && !is_made; i++) {
        struct settings settings = {.has_key = i & 1, .key = "the key that the board begins w"};
        parameters_standard(&settings.parameters);
        if (i & 4)
            settings.parameters.value[SLEW_US_S] = NAN;
        const struct start start = {i & 8 ? RESET_WATCHDOG : RESET_POWER_ON, !(i & 8), i & 1, {0.0f, 0.01f}};
        board_begin(&begun[i], 1, &settings, (struct stamps){0, 0}, &start);
        if (i & 2)
            rules_change(&begun[i].rules, HIL_MODE, 1.0f);
    }
    is_made = true;
    board = begun[how & 15];
    now_us = 0;
    sequence = pieces = 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    begin(size > 0 ? data[0] : 0);
    for (size_t at = 1; at < size;) {
        const uint8_t kind = data[at] & 3, detail = data[at] >> 2, count = at + 1 < size ? data[at + 1] : 0;
        at++;
        if (kind == STEP || kind == WORK) {
            if (kind == STEP)
                step(detail);
            else
                pieces = detail;
            continue;
        }
        at++;
        const size_t left = at < size ? size - at : 0, bytes = (count & 0x3F) < left ? count & 0x3F : left;
        if (kind == RAW)
            receive(data + at, (uint16_t)bytes);
        else
            receive_frame(MESSAGES[detail % KINDS], count >> 6, data + at, (uint8_t)bytes);
        at += bytes;
    }
    return 0;
}
