#include "link.h"

#include <string.h>

#include "flash.h"
#include "mavlink.h"

enum { MARKER = 0xFD, EXTENSION_BYTES = 32 }; /* a newer dialect at the other end may have appended this much to a message */

static const mavlink_msg_entry_t MESSAGES[] PROGMEM = MAVLINK_MESSAGE_CRCS; /* in the order of their ids */

void link_begin(struct link *link, struct peer me, const uint8_t *key, uint64_t heard, uint64_t sent) {
    memset(link, 0, sizeof *link);
    link->me = me;
    gate_open(&link->gate, key, heard);
    link->least_stamp = sent;
}

void link_take_key(struct link *link, const uint8_t key[KEY_BYTES], uint64_t heard, uint64_t sent_between) {
    while (link_sign(link)) {
    } /* what was queued goes out with the key of its time */
    gate_open(&link->gate, key, heard > link->gate.newest ? heard : link->gate.newest);
    link->least_stamp = link->sent_stamp + sent_between;
    link->sent_stamp = 0;
    link->count = (struct link_counts){.taken = link->count.taken};
    link->begin = link->end = link->wait_end = 0;
    link->verifying = false;
    link->sequences = 0;
    link->next_sequence = 0;
}

/* --- what arrives */

uint16_t link_room(const struct link *link) {
    return (uint16_t)(FRAME_BYTES - link->end + (link->verifying ? 0 : link->begin));
}

uint16_t link_put(struct link *link, const uint8_t *data, uint16_t bytes, uint64_t now_us) {
    if (!link->verifying && link->begin > 0) { /* a job must not have its frame moved */
        memmove(link->inbox, link->inbox + link->begin, (size_t)(link->end - link->begin));
        link->end = (uint16_t)(link->end - link->begin);
        link->wait_end = link->wait_end > link->begin ? (uint16_t)(link->wait_end - link->begin) : 0;
        link->begin = 0;
    }
    const uint16_t room = (uint16_t)(FRAME_BYTES - link->end), taken = bytes < room ? bytes : room;
    const bool extends = link->wait_end == link->end && link->wait_end > 0 && link->wait_since_us == now_us;
    memcpy(link->inbox + link->end, data, taken);
    link->put = (uint16_t)(link->put + taken);
    link->end = (uint16_t)(link->end + taken);
    if (extends)
        link->wait_end = link->end;
    return taken;
}

/* Bytes up to the end of the frame that was found last, of all that were ever put; it wraps. */
static uint16_t position(const struct link *link) { return (uint16_t)(link->put - (uint16_t)(link->end - link->begin)); }

void link_mark(struct link *link, uint16_t waiting, uint64_t now_us) {
    link->marked = (uint8_t)((link->marked + 1) % LINK_MARKS);
    link->mark[link->marked] = (struct mark){(uint32_t)now_us, (uint16_t)(link->put + waiting), true};
}

uint64_t link_arrival_us(const struct link *link, uint64_t now_us) {
    uint32_t age_us = 0;
    for (uint8_t i = 0; i < LINK_MARKS; i++) { /* from the newest on, while the frame had come by then */
        const struct mark *mark = &link->mark[(uint8_t)(link->marked + LINK_MARKS - i) % LINK_MARKS];
        if (!mark->is_set || (int16_t)(uint16_t)(mark->arrived - position(link)) < 0)
            break;
        age_us = (uint32_t)now_us - mark->at_us;
    }
    return now_us - age_us;
}

static bool find_message(uint32_t id, mavlink_msg_entry_t *found) {
    uint16_t low = 0, high = sizeof MESSAGES / sizeof MESSAGES[0];
    while (low < high) {
        const uint16_t middle = (uint16_t)((low + high) / 2);
        const uint32_t there = pgm_read_dword(&MESSAGES[middle].msgid);
        if (there == id) {
            memcpy_P(found, &MESSAGES[middle], sizeof *found);
            return true;
        }
        if (there < id)
            low = (uint16_t)(middle + 1);
        else
            high = middle;
    }
    return false;
}

static uint32_t message_of(const uint8_t *frame) {
    return frame[7] | (uint32_t)frame[8] << 8 | (uint32_t)frame[9] << 16;
}

static uint16_t frame_bytes(const uint8_t *frame) {
    return (uint16_t)(HEADER_BYTES + frame[1] + CHECKSUM_BYTES + ((frame[2] & SIGNED_FLAG) ? SIGNATURE_BYTES : 0));
}

static uint16_t checksum(const uint8_t *frame, uint8_t seed) {
    uint16_t crc = X25_INIT_CRC;
    const uint16_t end = (uint16_t)(HEADER_BYTES + frame[1]);
    for (uint16_t i = 1; i < end; i++)
        crc_accumulate(frame[i], &crc);
    crc_accumulate(seed, &crc);
    return crc;
}

/* Bytes of the frame that starts with these, by its header; 0 if there can be no frame. */
static uint16_t expected_bytes(struct link *link, const uint8_t *start, uint16_t bytes, mavlink_msg_entry_t *kind) {
    if (bytes >= 3 && (start[2] & ~SIGNED_FLAG)) { /* flags that a receiver must understand */
        link->count.bad++;
        return 0;
    }
    if (bytes < HEADER_BYTES)
        return HEADER_BYTES + CHECKSUM_BYTES + 1;
    if (!find_message(message_of(start), kind))
        return 0;
    if (start[1] < 1 || start[1] > kind->max_msg_len + EXTENSION_BYTES) {
        link->count.bad++;
        return 0;
    }
    return frame_bytes(start);
}

/* True if the frame at `begin` is overdue. False start bytes that came together are overdue together. */
static bool waited_too_long(struct link *link, uint64_t now_us) {
    if (link->begin >= link->wait_end) {
        link->wait_since_us = now_us;
        link->wait_end = link->end;
    }
    if (now_us - link->wait_since_us <= FRAME_TIMEOUT_US)
        return false;
    link->count.bad++;
    return true;
}

/* The sequence numbers of a peer; of a new one, as if the frame before this `number` had just come. NULL: too many others. */
static struct sequence *sequence_of(struct link *link, struct peer peer, uint8_t number, uint64_t now_us) {
    for (uint8_t i = 0; i < link->sequences; i++)
        if (same_peer(link->sequence[i].peer, peer))
            return &link->sequence[i];
    if (link->sequences == LINK_PEERS) {
        uint8_t kept = 0;
        for (uint8_t i = 0; i < link->sequences; i++)
            if (now_us - link->sequence[i].at_us < PEER_SILENCE_US)
                link->sequence[kept++] = link->sequence[i];
        link->sequences = kept;
    }
    if (link->sequences == LINK_PEERS)
        return NULL;
    struct sequence *added = &link->sequence[link->sequences++];
    *added = (struct sequence){peer, (uint8_t)(number - 1), now_us};
    return added;
}

/* True if a frame is newer than all before it of its sender. After a silence any frame is. */
static bool is_new(struct link *link, const uint8_t *frame, struct peer peer, uint64_t now_us) {
    struct sequence *sequence = sequence_of(link, peer, frame[4], now_us);
    if (sequence == NULL)
        return false;
    const uint8_t step = (uint8_t)(frame[4] - sequence->last);
    if ((step == 0 || step >= 128) && now_us - sequence->at_us < PEER_SILENCE_US)
        return false;
    sequence->last = frame[4];
    sequence->at_us = now_us;
    return true;
}

/* The frame at `begin` is intact: judge by its signature, before its sequence number, or a forged frame would make the true
ones look old. */
static enum verdict judge(struct link *link, const uint8_t *frame, struct peer peer, uint16_t bytes) {
    if (link->gate.is_locked)
        return SIGNATURE_UNSIGNED;
    if (!(frame[2] & SIGNED_FLAG))
        return link->gate.has_key ? SIGNATURE_UNSIGNED : SIGNATURE_GOOD;
    if (!link->gate.has_key)
        return SIGNATURE_FORGED;
    uint8_t hash[HASH_BYTES], difference = 0;
    signature_hash(&link->job, hash);
    for (uint8_t i = 0; i < HASH_BYTES; i++)
        difference = (uint8_t)(difference | (hash[i] ^ frame[bytes - HASH_BYTES + i])); /* in constant time */
    return difference ? SIGNATURE_FORGED : gate_take(&link->gate, peer, frame + bytes - SIGNATURE_BYTES);
}

enum link_state link_next(struct link *link, uint64_t now_us, struct frame *found) {
    while (link->begin < link->end && link->inbox[link->begin] != MARKER)
        link->begin++;
    if (link->begin == link->end)
        return LINK_IDLE;
    const uint8_t *frame = link->inbox + link->begin;
    const uint16_t there = (uint16_t)(link->end - link->begin);
    mavlink_msg_entry_t kind = {0};
    const uint16_t bytes = expected_bytes(link, frame, there, &kind);
    if (bytes > there && !waited_too_long(link, now_us))
        return LINK_IDLE;
    const struct peer peer = {frame[5], frame[6]};
    if (!link->verifying) {
        if (bytes == 0 || bytes > there) {
            link->begin++;
            return LINK_BUSY;
        }
        const uint8_t *sum = frame + HEADER_BYTES + frame[1];
        if (checksum(frame, kind.crc_extra) != (uint16_t)(sum[0] | sum[1] << 8)) {
            link->count.bad++;
            link->begin++;
            return LINK_BUSY;
        }
        if (same_peer(peer, link->me)) {
            link->begin = (uint16_t)(link->begin + bytes);
            return LINK_BUSY;
        }
        if ((frame[2] & SIGNED_FLAG) && link->gate.has_key) {
            if (!link->signing_frame && (!link->signs_next || link->outbox_ready == link->outbox_bytes)) {
                signature_begin(&link->job, link->gate.key, frame, (uint16_t)(bytes - HASH_BYTES));
                link->verifying = true;
            } else
                link_sign(link);
            return LINK_BUSY;
        }
    } else if (!signature_continue(&link->job))
        return LINK_BUSY;
    link->signs_next = link->verifying; /* in turn, or a flood would keep telemetry from being signed */
    link->verifying = false;
    link->begin = (uint16_t)(link->begin + bytes);
    if (judge(link, frame, peer, bytes) != SIGNATURE_GOOD) {
        link->count.unauthentic++;
        return LINK_BUSY;
    }
    if (!is_new(link, frame, peer, now_us))
        return LINK_BUSY;
    link->count.taken++;
    found->peer = peer;
    found->message = kind.msgid;
    found->payload_bytes = frame[1] < kind.max_msg_len ? frame[1] : kind.max_msg_len;
    found->payload = frame + HEADER_BYTES;
    return LINK_FRAME;
}

/* --- what leaves */

void link_send(struct link *link, uint32_t message, uint8_t checksum_seed, const void *payload, uint8_t payload_bytes) {
    const uint8_t *bytes = payload;
    while (payload_bytes > 1 && bytes[payload_bytes - 1] == 0)
        payload_bytes--;
    uint8_t *frame = link->outbox + link->outbox_bytes;
    const uint8_t flags = link->gate.has_key ? SIGNED_FLAG : 0;
    const uint16_t size = (uint16_t)(HEADER_BYTES + payload_bytes + CHECKSUM_BYTES + (flags ? SIGNATURE_BYTES : 0));
    const uint8_t number = link->next_sequence++;
    if (size > OUTBOX_BYTES - link->outbox_bytes) {
        link->count.unsent++;
        return;
    }
    const uint8_t header[HEADER_BYTES] = {MARKER, payload_bytes, flags, 0, number, link->me.system, link->me.component,
                                          (uint8_t)message, (uint8_t)(message >> 8), (uint8_t)(message >> 16)};
    memcpy(frame, header, HEADER_BYTES);
    memcpy(frame + HEADER_BYTES, payload, payload_bytes);
    const uint16_t sum = checksum(frame, checksum_seed);
    frame[HEADER_BYTES + payload_bytes] = (uint8_t)sum;
    frame[HEADER_BYTES + payload_bytes + 1] = (uint8_t)(sum >> 8);
    link->outbox_bytes = (uint16_t)(link->outbox_bytes + size);
    if (!flags && link->outbox_ready == link->outbox_bytes - size)
        link->outbox_ready = link->outbox_bytes;
}

bool link_sign(struct link *link) {
    if (link->verifying || link->outbox_ready == link->outbox_bytes)
        return false;
    uint8_t *frame = link->outbox + link->outbox_ready;
    const uint16_t bytes = frame_bytes(frame);
    if (!(frame[2] & SIGNED_FLAG)) { /* queued before there was a key */
        link->outbox_ready = (uint16_t)(link->outbox_ready + bytes);
        return true;
    }
    uint8_t *signature = frame + bytes - SIGNATURE_BYTES;
    if (!link->signing_frame) {
        uint64_t least = link->gate.newest > link->least_stamp ? link->gate.newest : link->least_stamp;
        if (link->sent_stamp > least)
            least = link->sent_stamp;
        link->sent_stamp = least < LATEST_TIMESTAMP ? least + 1 : LATEST_TIMESTAMP;
        signature[0] = 0; /* link id */
        write_timestamp(signature + 1, link->sent_stamp);
        signature_begin(&link->job, link->gate.key, frame, (uint16_t)(bytes - HASH_BYTES));
        link->signing_frame = true;
    }
    if (signature_continue(&link->job)) {
        signature_hash(&link->job, signature + SIGNATURE_BYTES - HASH_BYTES);
        link->signing_frame = link->signs_next = false;
        link->outbox_ready = (uint16_t)(link->outbox_ready + bytes);
    }
    return true;
}

const uint8_t *link_output(const struct link *link, uint16_t *bytes) {
    *bytes = link->outbox_ready;
    return link->outbox;
}

void link_sent(struct link *link, uint16_t bytes) {
    memmove(link->outbox, link->outbox + bytes, (size_t)(link->outbox_bytes - bytes));
    link->outbox_bytes = (uint16_t)(link->outbox_bytes - bytes);
    link->outbox_ready = (uint16_t)(link->outbox_ready - bytes);
    if (link->signing_frame)
        link->job.frame -= bytes;
}
