#include "store.h"

#include <string.h>

#include "board_hal.h"
#include "flash.h"
#include "mavlink.h"

/* A record of settings: count 2, has key 1, key 32, checksum of the table 2, values; the record's checksum in the last 2.
A record of stamps: count 2, heard 6, sent 6, checksum 2. One of zeros: count 2, zeros 8, checksum in the last 2. Numbers are
little-endian. */
enum { COUNT_AT = 0, HAS_KEY_AT = 2, KEY_AT = 3, TABLE_AT = KEY_AT + KEY_BYTES, VALUES_AT = TABLE_AT + 2 };
enum { HEARD_AT = 2, SENT_AT = 8, ZEROS_AT = 2 };
typedef char settings_fit[VALUES_AT + sizeof(struct parameters) + 2 <= SETTINGS_SLOT ? 1 : -1];
typedef char store_fits[STORE_BYTES <= (int)HAL_EEPROM_BYTES ? 1 : -1];

static const struct area {
    uint16_t base, bytes;
    uint8_t slots;
} AREA[STORE_AREAS] = {
    {0, SETTINGS_SLOT, SETTINGS_SLOTS},
    {SETTINGS_SLOT * SETTINGS_SLOTS, STAMPS_SLOT, STAMPS_SLOTS},
    {SETTINGS_SLOT * SETTINGS_SLOTS + STAMPS_SLOT * STAMPS_SLOTS, ZEROS_SLOT, ZEROS_SLOTS},
};

static uint16_t read16(const uint8_t *bytes) { return (uint16_t)(bytes[0] | bytes[1] << 8); }

static void write16(uint8_t *bytes, uint16_t value) {
    bytes[0] = (uint8_t)value;
    bytes[1] = (uint8_t)(value >> 8);
}

static uint16_t checksum(const uint8_t *bytes, uint16_t count) {
    uint16_t crc = X25_INIT_CRC;
    while (count-- > 0)
        crc_accumulate(*bytes++, &crc);
    return crc;
}

/* Of the names in the table of parameters: the values of another table are not taken. */
static uint16_t table_checksum(void) {
    uint16_t crc = X25_INIT_CRC;
    for (int i = 0; i < PARAMETERS; i++) {
        const struct parameter_row row = parameter_row(i);
        for (uint8_t k = 0; k < PARAMETER_NAME; k++)
            crc_accumulate((uint8_t)row.name[k], &crc);
    }
    return crc;
}

static bool read_record(uint8_t *record, uint16_t address, uint16_t bytes) {
    for (uint16_t i = 0; i < bytes; i++)
        record[i] = hal_eeprom_read((uint16_t)(address + i));
    return checksum(record, (uint16_t)(bytes - 2)) == read16(record + bytes - 2);
}

static uint16_t address_of(uint8_t area, uint8_t slot) { return (uint16_t)(AREA[area].base + slot * AREA[area].bytes); }

/* Read the newest whole record of an area, by its count; false if none is whole. */
static bool read_newest(struct store *store, uint8_t area) {
    bool found = false;
    for (uint8_t slot = 0; slot < AREA[area].slots; slot++) {
        if (!read_record(store->record, address_of(area, slot), AREA[area].bytes))
            continue;
        const uint16_t counted = read16(store->record + COUNT_AT);
        if (!found || (int16_t)(counted - store->count[area]) > 0) {
            store->slot[area] = slot;
            store->count[area] = counted;
        }
        found = true;
    }
    if (found)
        read_record(store->record, address_of(area, store->slot[area]), AREA[area].bytes);
    return found;
}

/* How many places of settings are not as a new or erased memory has them. */
static uint8_t written_slots(void) {
    uint8_t written = 0;
    for (uint8_t slot = 0; slot < SETTINGS_SLOTS; slot++) {
        uint16_t at = 0;
        while (at < SETTINGS_SLOT && hal_eeprom_read((uint16_t)((uint16_t)(slot * SETTINGS_SLOT) + at)) == 0xFF)
            at++;
        written = (uint8_t)(written + (at < SETTINGS_SLOT));
    }
    return written;
}

static void load_settings(struct store *store, struct settings *settings) {
    const uint8_t *record = store->record;
    settings->has_key = record[HAS_KEY_AT] == 1;
    memcpy(settings->key, record + KEY_AT, KEY_BYTES);
    if (read16(record + TABLE_AT) == store->table)
        memcpy(&settings->parameters, record + VALUES_AT, sizeof settings->parameters);
}

void store_load(struct store *store, struct memory *memory) {
    memset(store, 0, sizeof *store);
    memset(memory, 0, sizeof *memory);
    store->table = table_checksum();
    parameters_standard(&memory->settings.parameters);
    if (read_newest(store, STAMPS_AREA)) {
        memory->stamps.heard = read_timestamp(store->record + HEARD_AT);
        memory->stamps.sent = read_timestamp(store->record + SENT_AT);
    }
    memory->has_zeros = read_newest(store, ZEROS_AREA);
    if (memory->has_zeros)
        memcpy(&memory->zeros, store->record + ZEROS_AT, sizeof memory->zeros);
    memory->has_settings = read_newest(store, SETTINGS_AREA);
    if (memory->has_settings)
        load_settings(store, &memory->settings);
    else { /* the first record is written twice: a torn one alone is that of a board that had no settings */
        memory->settings.is_lost = memory->has_settings = written_slots() > 1;
        store->is_first = true;
    }
}

/* Put a record, which is filled but for its count and checksum, into the area's next place, byte by byte from now on. */
static struct writing begin_record(struct store *store, uint8_t *record, uint8_t area, uint8_t what) {
    const uint16_t bytes = AREA[area].bytes;
    store->slot[area] = (uint8_t)((store->slot[area] + 1) % AREA[area].slots);
    write16(record + COUNT_AT, ++store->count[area]);
    write16(record + bytes - 2, checksum(record, (uint16_t)(bytes - 2)));
    return (struct writing){
        .what = what, .area = area, .record = record, .address = address_of(area, store->slot[area]), .bytes = bytes};
}

static void begin_stamps(struct store *store, const struct board *board) {
    store->stamps = board_stamps(board);
    write_timestamp(store->stamps_record + HEARD_AT, store->stamps.heard);
    write_timestamp(store->stamps_record + SENT_AT, store->stamps.sent);
    store->stamps_writing = begin_record(store, store->stamps_record, STAMPS_AREA, KEEP_STAMPS);
}

static void begin_zeros(struct store *store, struct board *board) {
    board_kept(board, KEEP_ZEROS, store->stamps); /* a change from now on is kept by the next write */
    memset(store->record, 0, ZEROS_SLOT);
    memcpy(store->record + ZEROS_AT, &board->zero.now, sizeof board->zero.now);
    store->writing = begin_record(store, store->record, ZEROS_AREA, KEEP_ZEROS);
}

static void begin_settings(struct store *store, struct board *board) {
    const struct settings settings = board_settings(board);
    if (!store->is_first)
        board_kept(board, KEEP_SETTINGS, store->stamps);
    store->is_first = false;
    memset(store->record, 0, sizeof store->record);
    store->record[HAS_KEY_AT] = settings.has_key;
    memcpy(store->record + KEY_AT, settings.key, KEY_BYTES);
    write16(store->record + TABLE_AT, store->table);
    memcpy(store->record + VALUES_AT, &settings.parameters, sizeof settings.parameters);
    store->writing = begin_record(store, store->record, SETTINGS_AREA, KEEP_SETTINGS);
}

/* Begin the record that comes first of those that the board wants kept. */
static void begin(struct store *store, struct board *board) {
    if (board->memory & KEEP_STAMPS)
        begin_stamps(store, board);
    else if (store->writing.what != KEEP_NOTHING)
        return;
    else if (board->memory & KEEP_SETTINGS)
        begin_settings(store, board);
    else if (board->memory & KEEP_ZEROS)
        begin_zeros(store, board);
}

static bool is_whole(const struct writing *writing) {
    for (uint16_t at = 0; at < writing->bytes; at++)
        if (hal_eeprom_read((uint16_t)(writing->address + at)) != writing->record[at])
            return false;
    return true;
}

/* Write the next byte that is another one than the memory has; false if there is none left, and all are kept. */
static bool write_next(struct store *store, struct writing *writing, struct board *board) {
    while (writing->at < writing->bytes) {
        const uint16_t address = (uint16_t)(writing->address + writing->at);
        const uint8_t value = writing->record[writing->at++];
        if (hal_eeprom_read(address) != value) {
            hal_eeprom_write(address, value);
            return true;
        }
    }
    uint8_t *const worn = &store->worn[writing->area];
    if (writing->what != KEEP_NOTHING && !is_whole(writing)) {
        if (++*worn == AREA[writing->area].slots)
            rules_say(&board->rules, SAY_CRITICAL, PSTR("memory is worn: it keeps nothing"));
        *writing = begin_record(store, writing->record, writing->area, writing->what);
        return true;
    }
    *worn = 0;
    writing->what = KEEP_NOTHING;
    return false;
}

void store_continue(struct store *store, struct board *board) {
    if (hal_eeprom_busy())
        return;
    if (store->stamps_writing.what == KEEP_NOTHING)
        begin(store, board);
    if (store->stamps_writing.what == KEEP_NOTHING)
        write_next(store, &store->writing, board);
    else if (!write_next(store, &store->stamps_writing, board))
        board_kept(board, KEEP_STAMPS, store->stamps);
}
