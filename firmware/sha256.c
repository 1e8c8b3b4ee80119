#include "sha256.h"

#include "flash.h"

const uint32_t sha256_constants[64] PROGMEM = {
    0x428a2f98u, 0x71374491u, 0xb5c0fbcfu, 0xe9b5dba5u, 0x3956c25bu, 0x59f111f1u, 0x923f82a4u, 0xab1c5ed5u,
    0xd807aa98u, 0x12835b01u, 0x243185beu, 0x550c7dc3u, 0x72be5d74u, 0x80deb1feu, 0x9bdc06a7u, 0xc19bf174u,
    0xe49b69c1u, 0xefbe4786u, 0x0fc19dc6u, 0x240ca1ccu, 0x2de92c6fu, 0x4a7484aau, 0x5cb0a9dcu, 0x76f988dau,
    0x983e5152u, 0xa831c66du, 0xb00327c8u, 0xbf597fc7u, 0xc6e00bf3u, 0xd5a79147u, 0x06ca6351u, 0x14292967u,
    0x27b70a85u, 0x2e1b2138u, 0x4d2c6dfcu, 0x53380d13u, 0x650a7354u, 0x766a0abbu, 0x81c2c92eu, 0x92722c85u,
    0xa2bfe8a1u, 0xa81a664bu, 0xc24b8b70u, 0xc76c51a3u, 0xd192e819u, 0xd6990624u, 0xf40e3585u, 0x106aa070u,
    0x19a4c116u, 0x1e376c08u, 0x2748774cu, 0x34b0bcb5u, 0x391c0cb3u, 0x4ed8aa4au, 0x5b9cca4fu, 0x682e6ff3u,
    0x748f82eeu, 0x78a5636fu, 0x84c87814u, 0x8cc70208u, 0x90befffau, 0xa4506cebu, 0xbef9a3f7u, 0xc67178f2u,
};

void sha256_begin(uint32_t state[SHA256_WORDS]) {
    static const uint32_t INITIAL[SHA256_WORDS] PROGMEM = {
        0x6a09e667u, 0xbb67ae85u, 0x3c6ef372u, 0xa54ff53au, 0x510e527fu, 0x9b05688cu, 0x1f83d9abu, 0x5be0cd19u,
    };
    memcpy_P(state, INITIAL, sizeof INITIAL);
}

#ifndef __AVR__ /* avr/sha256_block.S */
static inline uint32_t rotate(uint32_t x, uint8_t bits) { return (x >> bits) | (x << (32 - bits)); }

void sha256_block(uint32_t state[SHA256_WORDS], const uint8_t block[SHA256_BLOCK]) {
    uint32_t w[16]; /* the last 16 words of the message schedule */
    uint32_t a = state[0], b = state[1], c = state[2], d = state[3];
    uint32_t e = state[4], f = state[5], g = state[6], h = state[7];
    for (uint8_t i = 0; i < 64; i++) {
        const uint8_t at = i & 15;
        if (i < 16) {
            const uint8_t *bytes = block + 4 * i;
            w[at] = (uint32_t)bytes[0] << 24 | (uint32_t)bytes[1] << 16 | (uint32_t)bytes[2] << 8 | bytes[3];
        } else {
            const uint32_t w2 = w[(i + 14) & 15], w15 = w[(i + 1) & 15];
            const uint32_t small0 = rotate(w15, 7) ^ rotate(w15, 18) ^ (w15 >> 3);
            const uint32_t small1 = rotate(w2, 17) ^ rotate(w2, 19) ^ (w2 >> 10);
            w[at] += small0 + w[(i + 9) & 15] + small1;
        }
        const uint32_t big1 = rotate(e, 6) ^ rotate(e, 11) ^ rotate(e, 25);
        const uint32_t big0 = rotate(a, 2) ^ rotate(a, 13) ^ rotate(a, 22);
        const uint32_t t1 = h + big1 + (g ^ (e & (f ^ g))) + sha256_constants[i] + w[at];
        const uint32_t t2 = big0 + ((a & b) | (c & (a | b)));
        h = g, g = f, f = e, e = d + t1, d = c, c = b, b = a, a = t1 + t2;
    }
    state[0] += a, state[1] += b, state[2] += c, state[3] += d;
    state[4] += e, state[5] += f, state[6] += g, state[7] += h;
}
#endif
