/* SHA-256 (FIPS 180-4), block by block, so that a slow processor can do other things between two blocks. */
#ifndef SHA256_H
#define SHA256_H

#include <stdint.h>

enum { SHA256_BLOCK = 64, SHA256_WORDS = 8 };

extern const uint32_t sha256_constants[64]; /* one for each round */

void sha256_begin(uint32_t state[SHA256_WORDS]);
void sha256_block(uint32_t state[SHA256_WORDS], const uint8_t block[SHA256_BLOCK]);

#endif
