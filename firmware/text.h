/* A line for people, as STATUSTEXT carries it: cut after 50 characters. */
#ifndef TEXT_H
#define TEXT_H

#include <stdint.h>

enum { TEXT_BYTES = 50 };
enum severity { SAY_CRITICAL = 2, SAY_WARNING = 4, SAY_INFO = 6 }; /* MAV_SEVERITY */

struct text {
    uint8_t severity, length;
    char characters[TEXT_BYTES];
};

void text_begin(struct text *text, enum severity severity);
void text_flash(struct text *text, const char *words); /* of PSTR() */
void text_name(struct text *text, const char *name, uint8_t bytes); /* up to a zero; what is not ASCII becomes '?' */
void text_number(struct text *text, uint32_t number);

#endif
