/* A thruster board: rules.c with a link, sensors and a memory around it. Bytes, readings and the time come in, bytes and pulses
go out. The counterpart of sim_bridge/thruster_board/board.py.

A port (posix/, avr/) calls, as often as it can: board_put with the bytes that came, board_work until it returns false, and
board_step every STEP_US, board_weigh before it and board_measure when they are due; it sends what board->link has to send. None of these
calls waits or takes long. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "link.h"
#include "messages.h"
#include "rules.h"
#include "zero.h"

enum { STEP_US = 5000 };
#define BURST_US 20000 /* 50 Hz */
#define STATUS_US 500000
#define HEARTBEAT_US 1000000
#define KEEP_US 1000000
#define MOTION_AGE_US 100000 /* age of simulated measurements at which they count as gone */
#define BATTERY_AGE_US 2000000
#define SENT_BETWEEN 10000 /* more timestamps than a board uses between two writes of its memory */

/* State that a board keeps without power. */
struct settings {
    struct parameters parameters;
    bool is_lost; /* none can be read, though there were some: a key among them would be unknown */
    bool has_key;
    uint8_t key[KEY_BYTES];
};
struct stamps {
    uint64_t heard; /* newest timestamp of a signed frame that was taken; frames up to it are refused */
    uint64_t sent;  /* newest timestamp that was used for signing */
};

/* The latest measurements of the simulator, in HIL mode. */
struct simulated {
    bool has_motion, has_battery;
    uint64_t motion_us, battery_us; /* when they came, or HIL mode began */
    struct reading reading;
};

struct board {
    struct rules rules;
    struct link link;
    struct stamps kept; /* as the memory has them */
    uint8_t memory;     /* memory_* of the settings and stamps that are to be written: see board_to_keep */
    bool has_order;     /* an order waits until its timestamp, or a later one, is kept */
    uint64_t order_stamp, used_stamp; /* of that order; up to which all are to be kept */
    struct zero zero;
    uint8_t told_chip[CHIPS];
    bool told_armed, told_hil;
    uint16_t told_status;
    bool is_commanded; /* an override was taken, which the next step follows */
    uint8_t to_list; /* parameters from this one on are still to be told */
    uint64_t burst_due_us, status_due_us, heartbeat_due_us, keep_due_us;
    bool has_weighed;
    uint64_t weigh_due_us, weighed_us;
    float battery_v;
    uint32_t refused; /* frames for another board, or with a value that no board takes */
    struct simulated simulated;
    struct event order;
};

/* A life of the board of a robot begins. `settings` NULL: parameters as built, no key. */
void board_begin(struct board *board, uint8_t robot, const struct settings *settings, struct stamps stamps,
                 const struct start *start);

uint16_t board_put(struct board *board, const uint8_t *data, uint16_t bytes, uint64_t now_us); /* how many found room */
bool board_work(struct board *board, uint64_t now_us); /* do a small piece; true: call again */
bool board_measures(const struct board *board, uint64_t now_us); /* a burst is due, and has room */
bool board_weighs(const struct board *board, uint64_t now_us); /* the battery is due, every BURST_US */
void board_weigh(struct board *board, uint64_t now_us, float voltage_v);
void board_step(struct board *board, uint64_t now_us);
/* Send a burst with what was measured at `now_us`; in HIL mode with what the simulator has measured, and `reading` is nothing. */
void board_measure(struct board *board, uint64_t now_us, const struct reading *reading);

/* The port asks what to keep, writes it, and says when it is written. */
enum { KEEP_NOTHING = 0, KEEP_SETTINGS = 1, KEEP_STAMPS = 2, KEEP_ZEROS = 4 };
struct settings board_settings(const struct board *board);
struct stamps board_stamps(const struct board *board);
void board_kept(struct board *board, uint8_t what, struct stamps stamps);

#endif
