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
    uint8_t block[SHA256_BLOCK] = {0};
    const uint8_t of_key = job->hashed == 0 ? KEY_BYTES : 0; /* the key begins the first block */
    const uint16_t at = (uint16_t)(job->hashed + of_key), room = (uint16_t)(SHA256_BLOCK - of_key);
    const uint16_t left = at < job->length ? (uint16_t)(job->length - at) : 0, bytes = left < room ? left : room;
    memcpy(block, job->key, of_key);
    if (bytes > 0)
        memcpy(block + of_key, job->frame + (at - KEY_BYTES), bytes);
    if (left < room && at <= job->length)
        block[of_key + bytes] = 0x80;
    job->hashed = (uint16_t)(job->hashed + SHA256_BLOCK);
    const bool last = job->length + 9 <= job->hashed; /* 0x80 and the length in 8 bytes fit behind the data */
    if (last) {
        const uint16_t bits = (uint16_t)(job->length * 8);
        block[SHA256_BLOCK - 2] = (uint8_t)(bits >> 8);
        block[SHA256_BLOCK - 1] = (uint8_t)bits;
    }
    sha256_block(job->state, block);
    return last;
}

void signature_hash(const struct signature_job *job, uint8_t hash[HASH_BYTES]) {
    const uint32_t first = job->state[0], second = job->state[1];
    hash[0] = (uint8_t)(first >> 24), hash[1] = (uint8_t)(first >> 16), hash[2] = (uint8_t)(first >> 8);
    hash[3] = (uint8_t)first, hash[4] = (uint8_t)(second >> 24), hash[5] = (uint8_t)(second >> 16);
}

/* A place for a new stream: behind the others, or that of the first unused for more than a minute, of which nothing said before
can count as new. NULL if all are in use. */
static struct signing_stream *free_stream(struct gate *gate) {
    if (gate->streams < SIGNING_STREAMS)
        return &gate->stream[gate->streams++];
    for (uint8_t i = 0; i < SIGNING_STREAMS; i++)
        if (gate->stream[i].timestamp + SIGNING_MINUTE < gate->newest)
            return &gate->stream[i];
    return NULL;
}

enum verdict gate_take(struct gate *gate, struct peer peer, const uint8_t *signature) {
    const uint64_t timestamp = read_timestamp(signature + 1);
    struct signing_stream *stream = gate->stream, *end = gate->stream + gate->streams;
    while (stream < end && !(stream->link_id == signature[0] && same_peer(stream->peer, peer)))
        stream++;
    if (timestamp <= (stream < end ? stream->timestamp : gate->floor))
        return SIGNATURE_REPLAYED;
    if (stream == end) { /* as MAVLink's own library: none that begins more than a minute ago */
        if (timestamp + SIGNING_MINUTE < gate->newest)
            return SIGNATURE_REPLAYED;
        stream = free_stream(gate);
        if (stream == NULL)
            return SIGNATURE_REPLAYED;
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
