/* The loop around a board: board.c with the hardware of board_hal.h. */
#ifndef LOOP_H
#define LOOP_H

#include "board.h"
#include "store.h"

struct loop {
    struct board board;
    struct store store;
    uint64_t step_at_us; /* when the next step is due */
    bool has_reading;    /* for the next burst */
    uint64_t sampled_at_us;
    struct reading reading;
};

void loop_begin(struct loop *loop, uint8_t robot);
void loop_once(struct loop *loop); /* one thing of these: a step, a sample, a burst, or a piece of the link's work */

#endif
