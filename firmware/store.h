/* Settings and timestamps in an EEPROM, with worn levelling: each write goes to the next of many places, and the newest that is
whole counts. A loss of power while writing leaves the one before.

Writing goes on byte by byte beside everything else (3.4 ms each on an ATmega2560). */
#ifndef STORE_H
#define STORE_H

#include "board.h"

enum {
    SETTINGS_SLOT = 256, /* bytes */
    SETTINGS_SLOTS = 6,
    STAMPS_SLOT = 16,
    STAMPS_SLOTS = 160,
    STORE_BYTES = SETTINGS_SLOT * SETTINGS_SLOTS + STAMPS_SLOT * STAMPS_SLOTS
};

struct store {
    uint16_t table; /* checksum of the table of parameters */
    bool is_first; /* no settings were found: the first are written twice, see store_load */
    uint8_t settings_slot, stamps_slot; /* the newest */
    uint16_t settings_count, stamps_count;
    uint8_t writing; /* KEEP_SETTINGS, KEEP_STAMPS or KEEP_NOTHING */
    struct stamps stamps;
    uint16_t address, at, bytes;
    uint8_t record[SETTINGS_SLOT];
};

/* Find what was kept. Returns KEEP_SETTINGS and KEEP_STAMPS for what was found. */
uint8_t store_load(struct store *store, struct settings *settings, struct stamps *stamps);
/* Write what the board wants kept, a byte at most with each call. */
void store_continue(struct store *store, struct board *board);

#endif
