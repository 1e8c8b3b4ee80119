/* Constants that stay in the program memory of a microcontroller whose RAM is small. */
#ifndef FLASH_H
#define FLASH_H

#ifdef __AVR__
#include <avr/pgmspace.h>
#else
#include <string.h>
#define PROGMEM
#define PSTR(text) (text)
#define memcpy_P memcpy
#define memcmp_P memcmp
#define strlen_P strlen
#define pgm_read_byte(address) (*(const unsigned char *)(address))
#define pgm_read_dword(address) (*(address))
#endif

#endif
