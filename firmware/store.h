/* Settings, timestamps and the zeros of the sensors in an EEPROM, with worn levelling: each write goes to the next of many places, and the newest that is
whole counts. A loss of power while writing leaves the one before. A record is read back: from a place that is worn it goes on to the next.

Writing goes on byte by byte beside everything else (3.4 ms each on an ATmega2560). Timestamps, which orders wait for, go before the
rest of a longer record. */
#ifndef STORE_H
#define STORE_H

#include "board.h"

enum {
    SETTINGS_SLOT = 256, /* bytes */
    SETTINGS_SLOTS = 6,
    STAMPS_SLOT = 16,
    STAMPS_SLOTS = 144,
    ZEROS_SLOT = 16,
    ZEROS_SLOTS = 16,
    STORE_BYTES = SETTINGS_SLOT * SETTINGS_SLOTS + STAMPS_SLOT * STAMPS_SLOTS + ZEROS_SLOT * ZEROS_SLOTS
};
enum { SETTINGS_AREA, STAMPS_AREA, ZEROS_AREA, STORE_AREAS };

/* A record that is being written. */
struct writing {
    uint8_t what; /* KEEP_SETTINGS, KEEP_STAMPS, KEEP_ZEROS or KEEP_NOTHING */
    uint8_t area;
    uint8_t *record;
    uint16_t address, at, bytes;
};

struct store {
    uint16_t table; /* checksum of the table of parameters */
    bool is_first; /* no settings were found: the first are written twice, see store_load */
    uint8_t slot[STORE_AREAS]; /* the newest */
    uint8_t worn[STORE_AREAS]; /* places in a row that have not kept a record */
    uint16_t count[STORE_AREAS];
    struct stamps stamps; /* that are being written */
    struct writing stamps_writing, writing; /* of timestamps; of settings or zeros */
    uint8_t stamps_record[STAMPS_SLOT], record[SETTINGS_SLOT];
};

/* What was kept, as board_begin takes it. */
struct memory {
    bool has_settings; /* or has lost them */
    struct settings settings;
    struct stamps stamps;
    bool has_zeros;
    struct zeros zeros;
};
void store_load(struct store *store, struct memory *memory);
/* Write what the board wants kept, a byte at most with each call. */
void store_continue(struct store *store, struct board *board);

#endif
