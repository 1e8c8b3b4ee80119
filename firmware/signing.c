#include "signing.h"

#include <string.h>

void gate_open(struct gate *gate, const uint8_t *key, uint64_t floor) {
    gate->has_key = key != NULL;
    if (key != NULL)
        memmove(gate->key, key, KEY_BYTES);
    gate->floor = gate->newest = floor;
    gate->streams = 0;
}

void signature_begin(struct signature_job *job, const uint8_t *key, const uint8_t *frame, uint16_t frame_bytes) {
    job->key = key;
    job->frame = frame;
    job->length = (uint16_t)(KEY_BYTES + frame_bytes);
    job->hashed = 0;
    sha256_begin(job->state);
}

bool signature_continue(struct signature_job *job) {
    uint8_t block[SHA256_BLOCK];
    uint16_t at = job->hashed;
    for (uint8_t i = 0; i < SHA256_BLOCK; i++, at++)
        block[i] = at < KEY_BYTES ? job->key[at] : at < job->length ? job->frame[at - KEY_BYTES] : at == job->length ? 0x80 : 0;
    const bool last = job->length + 9 <= at; /* 0x80 and the length in 8 bytes fit behind the data */
    if (last) {
        const uint16_t bits = (uint16_t)(job->length * 8);
        block[SHA256_BLOCK - 2] = (uint8_t)(bits >> 8);
        block[SHA256_BLOCK - 1] = (uint8_t)bits;
    }
    sha256_block(job->state, block);
    job->hashed = at;
    return last;
}

void signature_hash(const struct signature_job *job, uint8_t hash[HASH_BYTES]) {
    for (uint8_t i = 0; i < HASH_BYTES; i++)
        hash[i] = (uint8_t)(job->state[i / 4] >> (24 - 8 * (i % 4)));
}

enum verdict gate_take(struct gate *gate, struct peer peer, const uint8_t *signature) {
    const uint64_t timestamp = read_timestamp(signature + 1);
    struct signing_stream *stream = gate->stream, *end = gate->stream + gate->streams;
    while (stream < end && !(stream->link_id == signature[0] && same_peer(stream->peer, peer)))
        stream++;
    if (timestamp <= (stream < end ? stream->timestamp : gate->floor))
        return SIGNATURE_REPLAYED;
    if (stream == end) {
        if (gate->streams == SIGNING_STREAMS)
            return SIGNATURE_REPLAYED;
        gate->streams++;
        stream->link_id = signature[0];
        stream->peer = peer;
    }
    stream->timestamp = timestamp;
    if (timestamp > gate->newest)
        gate->newest = timestamp;
    return SIGNATURE_GOOD;
}

uint64_t read_timestamp(const uint8_t bytes[6]) {
    uint64_t timestamp = 0;
    for (uint8_t i = 6; i-- > 0;)
        timestamp = timestamp << 8 | bytes[i];
    return timestamp;
}

void write_timestamp(uint8_t bytes[6], uint64_t timestamp) {
    for (uint8_t i = 0; i < 6; i++, timestamp >>= 8)
        bytes[i] = (uint8_t)timestamp;
}
