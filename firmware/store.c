#include "store.h"

#include <string.h>

#include "board_hal.h"
#include "flash.h"
#include "mavlink.h"

/* A record of settings: count 2, has key 1, key 32, checksum of the table 2, values; the record's checksum in the last 2.
A record of stamps: count 2, heard 6, sent 6, checksum 2. Numbers are little-endian. */
enum { COUNT_AT = 0, HAS_KEY_AT = 2, KEY_AT = 3, TABLE_AT = KEY_AT + KEY_BYTES, VALUES_AT = TABLE_AT + 2 };
enum { HEARD_AT = 2, SENT_AT = 8, STAMPS_BASE = SETTINGS_SLOT * SETTINGS_SLOTS };
typedef char settings_fit[VALUES_AT + sizeof(struct parameters) + 2 <= SETTINGS_SLOT ? 1 : -1];
typedef char store_fits[STORE_BYTES <= (int)HAL_EEPROM_BYTES ? 1 : -1];

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

/* The newest whole record among the slots, by its count; false if none is whole. */
static bool find_newest(struct store *store, uint16_t base, uint16_t bytes, uint8_t slots, uint8_t *newest, uint16_t *count) {
    bool found = false;
    for (uint8_t slot = 0; slot < slots; slot++) {
        if (!read_record(store->record, (uint16_t)(base + slot * bytes), bytes))
            continue;
        const uint16_t counted = read16(store->record + COUNT_AT);
        if (!found || (int16_t)(counted - *count) > 0) {
            *newest = slot;
            *count = counted;
        }
        found = true;
    }
    return found && read_record(store->record, (uint16_t)(base + *newest * bytes), bytes);
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

uint8_t store_load(struct store *store, struct settings *settings, struct stamps *stamps) {
    memset(store, 0, sizeof *store);
    store->table = table_checksum();
    memset(stamps, 0, sizeof *stamps);
    uint8_t found = KEEP_NOTHING;
    settings->is_lost = false;
    if (find_newest(store, STAMPS_BASE, STAMPS_SLOT, STAMPS_SLOTS, &store->stamps_slot, &store->stamps_count)) {
        stamps->heard = read_timestamp(store->record + HEARD_AT);
        stamps->sent = read_timestamp(store->record + SENT_AT);
        found |= KEEP_STAMPS;
    }
    if (find_newest(store, 0, SETTINGS_SLOT, SETTINGS_SLOTS, &store->settings_slot, &store->settings_count)) {
        const uint8_t *record = store->record;
        settings->has_key = record[HAS_KEY_AT] == 1;
        memcpy(settings->key, record + KEY_AT, KEY_BYTES);
        if (read16(record + TABLE_AT) == store->table)
            memcpy(&settings->parameters, record + VALUES_AT, sizeof settings->parameters);
        else
            parameters_standard(&settings->parameters);
        found |= KEEP_SETTINGS;
    } else { /* the first record is written twice: a torn one alone is that of a board that had no settings */
        parameters_standard(&settings->parameters);
        settings->has_key = false;
        settings->is_lost = written_slots() > 1;
        store->is_first = true;
    }
    return found;
}

static void begin_record(struct store *store, uint16_t address, uint16_t bytes, uint16_t count) {
    write16(store->record + COUNT_AT, count);
    write16(store->record + bytes - 2, checksum(store->record, (uint16_t)(bytes - 2)));
    store->address = address;
    store->at = 0;
    store->bytes = bytes;
}

static void begin_stamps(struct store *store, const struct board *board) {
    store->writing = KEEP_STAMPS;
    store->stamps = board_stamps(board);
    store->stamps_slot = (uint8_t)((store->stamps_slot + 1) % STAMPS_SLOTS);
    write_timestamp(store->record + HEARD_AT, store->stamps.heard);
    write_timestamp(store->record + SENT_AT, store->stamps.sent);
    begin_record(store, (uint16_t)(STAMPS_BASE + store->stamps_slot * STAMPS_SLOT), STAMPS_SLOT, ++store->stamps_count);
}

static void begin_settings(struct store *store, struct board *board) {
    const struct settings settings = board_settings(board);
    store->writing = KEEP_SETTINGS;
    if (!store->is_first)
        board_kept(board, KEEP_SETTINGS, store->stamps); /* a change from now on is kept by the next write */
    store->is_first = false;
    store->settings_slot = (uint8_t)((store->settings_slot + 1) % SETTINGS_SLOTS);
    memset(store->record, 0, sizeof store->record);
    store->record[HAS_KEY_AT] = settings.has_key;
    memcpy(store->record + KEY_AT, settings.key, KEY_BYTES);
    write16(store->record + TABLE_AT, store->table);
    memcpy(store->record + VALUES_AT, &settings.parameters, sizeof settings.parameters);
    begin_record(store, (uint16_t)(store->settings_slot * SETTINGS_SLOT), SETTINGS_SLOT, ++store->settings_count);
}

void store_continue(struct store *store, struct board *board) {
    if (hal_eeprom_busy())
        return;
    if (store->writing == KEEP_NOTHING) {
        if (board->memory & KEEP_STAMPS)
            begin_stamps(store, board);
        else if (board->memory & KEEP_SETTINGS)
            begin_settings(store, board);
        return;
    }
    while (store->at < store->bytes) {
        const uint16_t address = (uint16_t)(store->address + store->at);
        const uint8_t value = store->record[store->at++];
        if (hal_eeprom_read(address) != value) {
            hal_eeprom_write(address, value);
            return;
        }
    }
    if (store->writing == KEEP_STAMPS)
        board_kept(board, KEEP_STAMPS, store->stamps);
    store->writing = KEEP_NOTHING;
}
