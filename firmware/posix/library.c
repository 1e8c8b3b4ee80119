/* The board as a shared library, for tests: calls that finish all work that is open, and access by name. */
#include <string.h>

#include "../board.h"
#include "../board_hal.h"
#include "../store.h"

static void finish(struct board *board, uint64_t now_us) {
    while (board_work(board, now_us) || board->memory) /* a memory that writes at once */
        board_kept(board, KEEP_SETTINGS | KEEP_STAMPS | KEEP_ZEROS, board_stamps(board));
}

/* --- a memory whose power can fail while a byte is written */

static uint8_t eeprom[HAL_EEPROM_BYTES], torn;
static uint32_t writes_left;

uint8_t *library_eeprom(void) { return eeprom; }

static uint16_t worn_from, worn_to;

/* Bytes `from` to `to` are worn: they keep what they have. */
void library_wear(uint16_t from, uint16_t to) {
    worn_from = from;
    worn_to = to;
}

/* The power fails during this write, counted from 0; the byte is then `value`. */
void library_cut(uint32_t write, uint8_t value) {
    writes_left = write;
    torn = value;
}

static bool is_busy;

/* A byte is being written, or no longer. */
void library_busy(bool busy) { is_busy = busy; }

bool hal_eeprom_busy(void) { return is_busy; }

uint8_t hal_eeprom_read(uint16_t address) { return eeprom[address]; }

void hal_eeprom_write(uint16_t address, uint8_t value) {
    if (writes_left == UINT32_MAX || (address >= worn_from && address < worn_to)) /* without power nothing more is written */
        return;
    eeprom[address] = writes_left > 0 ? value : torn;
    writes_left--;
}

uint32_t library_store_bytes(void) { return sizeof(struct store); }

/* Power-on with what the memory holds. */
void library_boot(struct board *board, struct store *store, uint8_t robot) {
    struct memory memory;
    store_load(store, &memory);
    const struct start start = {RESET_POWER_ON, true, memory.has_zeros, memory.zeros};
    board_begin(board, robot, memory.has_settings ? &memory.settings : NULL, memory.stamps, &start);
}

void library_put(struct board *board, const uint8_t *data, uint16_t bytes, uint64_t now_us) {
    board_put(board, data, bytes, now_us);
}

/* What a loop does in the time of one byte of the memory, which takes long: all work, and that byte. */
void library_pass(struct board *board, struct store *store, uint64_t now_us) {
    while (board_work(board, now_us))
        ;
    store_continue(store, board);
}

float library_parameter(const struct board *board, int index) { return board->rules.parameters.value[index]; }

uint32_t library_board_bytes(void) { return sizeof(struct board); }

void library_begin(struct board *board, uint8_t robot, const uint8_t *key, uint64_t heard, uint64_t sent) {
    struct settings settings = {.has_key = key != NULL};
    parameters_standard(&settings.parameters);
    if (key != NULL)
        memcpy(settings.key, key, KEY_BYTES);
    const struct start start = {.causes = RESET_POWER_ON, .is_power_on = true};
    board_begin(board, robot, &settings, (struct stamps){heard, sent}, &start);
    for (uint8_t i = 0; i < STILL_SAMPLES; i++) { /* it has lain in air since */
        zero_pressure(&board->zero, 0.0f);
        zero_rate(&board->zero, 0.0f);
    }
    board->told_status = zero_status(&board->zero);
}

/* Have this life of the board begin so instead. */
void library_start(struct board *board, uint8_t causes, bool is_power_on, bool has_zeros, float surface_hpa, float bias_radps) {
    const struct start start = {causes, is_power_on, has_zeros, {surface_hpa, bias_radps}};
    const struct settings settings = board_settings(board);
    board_begin(board, board->link.me.system, &settings, board->kept, &start);
}

/* Returns true if a frame was taken: intact, and on a signed link well signed. */
bool library_receive(struct board *board, const uint8_t *data, uint32_t bytes, uint64_t now_us) {
    const uint32_t taken = board->link.count.taken;
    do {
        const uint16_t put = board_put(board, data, bytes < FRAME_BYTES ? (uint16_t)bytes : FRAME_BYTES, now_us);
        data += put;
        bytes -= put;
        finish(board, now_us);
    } while (bytes > 0);
    return board->link.count.taken != taken;
}

void library_step(struct board *board, uint64_t now_us, const struct reading *reading) {
    finish(board, now_us); /* what has begun and not ended may be overdue */
    if (reading != NULL && board_weighs(board, now_us))
        board_weigh(board, now_us, reading->battery_v);
    board_step(board, now_us);
    if (reading != NULL)
        board_measure(board, now_us, reading);
    finish(board, now_us);
}

uint16_t library_take_output(struct board *board, uint8_t *data) {
    uint16_t bytes;
    memcpy(data, link_output(&board->link, &bytes), OUTBOX_BYTES);
    link_sent(&board->link, bytes);
    return bytes;
}

void library_state(const struct board *board, uint16_t outputs_us[CHANNELS], uint32_t state[4]) {
    for (uint8_t i = 0; i < CHANNELS; i++)
        outputs_us[i] = rules_output_us(&board->rules, i);
    state[0] = board->rules.armed;
    state[1] = board->rules.charge;
    state[2] = board->rules.overrides_refused;
    state[3] = board->link.count.unsent;
}

/* The rules' texts that are not sent yet, each with its severity as the first byte and a zero at its end. */
uint16_t library_take_texts(struct rules *rules, char *texts) {
    char *at = texts;
    for (uint8_t i = 0; i < rules->texts; i++) {
        const struct text *text = &rules->text[i];
        *at++ = (char)text->severity;
        memcpy(at, text->characters, text->length);
        at += text->length;
        *at++ = '\0';
    }
    rules->texts = 0;
    return (uint16_t)(at - texts);
}
