/* MAVLink 2 signatures: of frames that arrive and of frames that leave. The counterpart of shoal/mavlink/signing.py.

A signature takes two blocks of SHA-256 or more, which is long on an 8-bit processor. So it is computed as a job, a block with
each call. Timestamps count in 10 us since 2015; 48 bits. */
#ifndef SIGNING_H
#define SIGNING_H

#include <stdbool.h>
#include <stdint.h>

#include "sha256.h"

#define SIGNING_MINUTE UINT64_C(6000000) /* 60 s: a stream that is new may be so much older than the newest timestamp */

enum { KEY_BYTES = 32, SIGNATURE_BYTES = 13, HASH_BYTES = 6, SIGNING_STREAMS = 16, SIGNED_FLAG = 0x01 };
#define LATEST_TIMESTAMP ((UINT64_C(1) << 48) - 1)

struct peer {
    uint8_t system, component;
};

static inline bool same_peer(struct peer a, struct peer b) { return a.system == b.system && a.component == b.component; }

enum verdict { SIGNATURE_GOOD, SIGNATURE_UNSIGNED, SIGNATURE_FORGED, SIGNATURE_REPLAYED };

struct signing_stream {
    uint8_t link_id;
    struct peer peer;
    uint64_t timestamp;
};

/* Who may speak on the link, and the timestamps that are used up. */
struct gate {
    bool has_key;
    bool is_locked; /* the settings, in which there may be a key, cannot be read: nothing is taken */
    uint8_t key[KEY_BYTES];
    uint64_t floor;  /* a stream that is new must begin later */
    uint64_t newest; /* latest timestamp taken */
    uint8_t streams;
    struct signing_stream stream[SIGNING_STREAMS];
};

/* SHA-256 over a key and a frame, which must both stay where they are until it is done. */
struct signature_job {
    const uint8_t *key, *frame;
    uint16_t length, hashed; /* bytes of key and frame; of these, how many are in the state */
    uint32_t state[SHA256_WORDS];
};

void gate_open(struct gate *gate, const uint8_t *key, uint64_t floor); /* key NULL: unsigned frames only */

void signature_begin(struct signature_job *job, const uint8_t *key, const uint8_t *frame, uint16_t frame_bytes);
bool signature_continue(struct signature_job *job); /* hash one block; true when it was the last */
void signature_hash(const struct signature_job *job, uint8_t hash[HASH_BYTES]);

/* Judge a signed frame of which the hash is right, and remember its timestamp. */
enum verdict gate_take(struct gate *gate, struct peer peer, const uint8_t *signature);

uint64_t read_timestamp(const uint8_t bytes[6]);
void write_timestamp(uint8_t bytes[6], uint64_t timestamp);

#endif
