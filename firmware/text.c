#include "text.h"

#include "flash.h"

void text_begin(struct text *text, enum severity severity) {
    text->severity = (uint8_t)severity;
    text->length = 0;
}

static void put(struct text *text, char character) {
    if (text->length < TEXT_BYTES)
        text->characters[text->length++] = character;
}

void text_flash(struct text *text, const char *words) {
    for (char c; (c = (char)pgm_read_byte(words)) != '\0'; words++)
        put(text, c);
}

void text_name(struct text *text, const char *name, uint8_t bytes) {
    for (uint8_t i = 0; i < bytes && name[i] != '\0'; i++)
        put(text, (name[i] & 0x80) ? '?' : name[i]);
}

void text_number(struct text *text, uint32_t number) {
    char digits[10];
    uint8_t count = 0;
    do
        digits[count++] = (char)('0' + number % 10);
    while ((number /= 10) != 0);
    while (count > 0)
        put(text, digits[--count]);
}
