#include "loop.h"

#include <stddef.h>

#include "board_hal.h"

enum { READ_BYTES = 64 };

static void move_outputs(const struct rules *rules) {
    uint16_t pulses_us[CHANNELS];
    for (uint8_t i = 0; i < CHANNELS; i++)
        pulses_us[i] = rules_output_us(rules, i);
    hal_outputs(pulses_us);
}

void loop_begin(struct loop *loop, uint8_t robot) {
    struct memory memory;
    struct start start = hal_start();
    store_load(&loop->store, &memory);
    start.has_zeros = memory.has_zeros;
    start.zeros = memory.zeros;
    board_begin(&loop->board, robot, memory.has_settings ? &memory.settings : NULL, memory.stamps, &start);
    loop->step_at_us = hal_now_us();
    move_outputs(&loop->board.rules);
}

static void step(struct loop *loop, uint64_t now_us) {
    link_mark(&loop->board.link, hal_waiting(), now_us);
    if (board_weighs(&loop->board, now_us))
        board_weigh(&loop->board, now_us, hal_battery_v());
    board_step(&loop->board, now_us);
    move_outputs(&loop->board.rules);
    hal_alive();
    loop->step_at_us += STEP_US;
    if (loop->step_at_us <= now_us) /* held up: go on from here */
        loop->step_at_us = now_us + STEP_US;
}

/* Take a sample, and in the next loop send it. In HIL mode the simulator measures. */
static void measure(struct loop *loop, uint64_t now_us) {
    struct board *board = &loop->board;
    if (rules_hil(&board->rules))
        board_measure(board, now_us, NULL);
    else if (!loop->has_reading) {
        hal_sample(now_us, board->zero.now.gyro_bias_radps, &loop->reading);
        loop->sampled_at_us = now_us;
        loop->has_reading = true;
        return;
    } else
        board_measure(board, loop->sampled_at_us, &loop->reading);
    loop->has_reading = false;
}

/* Take what has come, do a piece of the work, go on with the memory, send. Returns false if there was nothing to do. */
static bool serve_link(struct loop *loop, uint64_t now_us) {
    struct board *board = &loop->board;
    uint8_t data[READ_BYTES];
    const uint16_t room = link_room(&board->link), read = hal_read(data, room < READ_BYTES ? room : READ_BYTES);
    board_put(board, data, read, now_us);
    const uint32_t taken = board->link.count.taken;
    const bool worked = board_work(board, now_us);
    if (board->link.count.taken != taken)
        hal_heard();
    if (board->is_commanded)
        loop->step_at_us = now_us; /* the outputs follow an override in the next loop, and its age ends with a step */
    store_continue(&loop->store, board);
    uint16_t bytes;
    const uint8_t *output = link_output(&board->link, &bytes);
    bytes = bytes > 0 ? hal_write(output, bytes) : 0;
    if (bytes > 0)
        link_sent(&board->link, bytes);
    const bool is_writing = loop->store.stamps_writing.what != KEEP_NOTHING || loop->store.writing.what != KEEP_NOTHING;
    return worked || read > 0 || bytes > 0 || is_writing;
}

void loop_once(struct loop *loop) {
    const uint64_t now_us = hal_now_us();
    if (now_us >= loop->step_at_us)
        step(loop, now_us);
    else if (board_measures(&loop->board, now_us))
        measure(loop, now_us);
    else if (!serve_link(loop, now_us)) {
        const uint64_t burst_at_us = loop->board.burst_due_us;
        hal_idle(burst_at_us < loop->step_at_us ? burst_at_us : loop->step_at_us);
    }
}
