/* Any bytes at any time: libFuzzer's target, under the address and undefined-behaviour sanitizers. `make fuzz`.

An input is a key or none, and then records: raw bytes, frames that are made intact, time that passes. After each step the rule
that matters most is looked at: thrusters turn only while the board is armed, within their limits. */
#include <stdlib.h>
#include <string.h>

#include "../board.h"
#include "../mavlink.h"

enum { RAW, INTACT, STEP, KINDS };

static struct board board;
static uint64_t now_us;

static void finish(void) {
    while (board_work(&board, now_us) || board.memory)
        board_kept(&board, KEEP_SETTINGS | KEEP_STAMPS, board_stamps(&board));
    uint16_t bytes;
    link_output(&board.link, &bytes);
    link_sent(&board.link, bytes);
}

static void receive(const uint8_t *data, uint16_t bytes) {
    while (bytes > 0) {
        const uint16_t put = board_put(&board, data, bytes, now_us);
        data += put;
        bytes = (uint16_t)(bytes - put);
        finish();
    }
}

/* A frame of a message that the board knows, with these bytes as its payload. */
static void receive_intact(uint8_t which, const uint8_t *payload, uint8_t bytes) {
    static const struct {
        uint8_t id, seed;
    } MESSAGES[] = {{70, 124}, {76, 152}, {20, 214}, {21, 159}, {23, 168}, {0, 50}, {111, 34}};
    static uint8_t sequence;
    uint8_t frame[FRAME_BYTES] = {0xFD, bytes, 0, 0, sequence++, 1, which & 0x80 ? 190 : COMPUTER_COMPONENT};
    if (bytes == 0)
        return;
    const uint8_t at = (which & 0x7F) % (sizeof MESSAGES / sizeof MESSAGES[0]);
    frame[7] = MESSAGES[at].id;
    memcpy(frame + HEADER_BYTES, payload, bytes);
    uint16_t crc = X25_INIT_CRC;
    for (uint16_t i = 1; i < HEADER_BYTES + bytes; i++)
        crc_accumulate(frame[i], &crc);
    crc_accumulate(MESSAGES[at].seed, &crc);
    frame[HEADER_BYTES + bytes] = (uint8_t)crc;
    frame[HEADER_BYTES + bytes + 1] = (uint8_t)(crc >> 8);
    receive(frame, (uint16_t)(HEADER_BYTES + bytes + CHECKSUM_BYTES));
}

static void step(uint8_t how) {
    struct reading reading = {.battery_v = (float)(how & 0x0F)};
    memcpy(&reading.heading_rad, &now_us, sizeof reading.heading_rad);
    now_us += (uint64_t)(how >> 4) * 20000u + 1000u;
    finish();
    board_step(&board, now_us, board_measures(&board, now_us) ? &reading : NULL);
    const float *value = board.rules.parameters.value;
    for (uint8_t i = 0; i < THRUSTERS; i++) {
        const uint16_t echo_us = rules_echo_us(&board.rules, i);
        const bool neutral = (float)echo_us == value[THR_NEUTRAL_US];
        if (!(neutral || (board.rules.armed && value[THR_MIN_US] <= echo_us && echo_us <= value[THR_MAX_US])))
            abort();
    }
    finish();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    static const struct stamps NONE = {0, 0};
    struct settings settings = {.has_key = size > 0 && (data[0] & 1)};
    parameters_standard(&settings.parameters);
    now_us = 0;
    board_begin(&board, 1, &settings, NONE);
    for (size_t at = 1; at + 3 <= size;) {
        const uint8_t kind = data[at] % KINDS, detail = data[at + 1];
        const size_t left = size - at - 3, bytes = data[at + 2] < left ? data[at + 2] : left;
        if (kind == RAW)
            receive(data + at + 3, (uint16_t)bytes);
        else if (kind == INTACT)
            receive_intact(detail, data + at + 3, (uint8_t)bytes);
        else
            step(detail);
        at += kind == STEP ? 2 : 3 + bytes;
    }
    return 0;
}
