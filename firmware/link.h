/* MAVLink 2 frames on the link: finding, checking and numbering those that arrive, queueing and signing those that leave.
The counterpart of shoal/mavlink/framing.py.

Nothing here takes long: each call of link_next checks one frame at most or hashes one block of its signature, and each call of
link_sign hashes one block. */
#ifndef LINK_H
#define LINK_H

#include <stdbool.h>
#include <stdint.h>

#include "signing.h"

enum {
    HEADER_BYTES = 10,
    CHECKSUM_BYTES = 2,
    FRAME_BYTES = HEADER_BYTES + 255 + CHECKSUM_BYTES + SIGNATURE_BYTES,
    OUTBOX_BYTES = 1000, /* a burst with all that can be due at once, signed, and the answers to some questions */
    LINK_MARKS = 40,     /* 200 ms of steps: longer than the bytes that can wait here and in a port's ring */
    LINK_PEERS = 16      /* senders whose sequence numbers are followed at a time; more are a flood */
};
#define FRAME_TIMEOUT_US 50000 /* 280 bytes take 25 ms at 115200 baud: after this, an unfinished frame is a false start byte */
/* After this any sequence number counts as new: the peer was restarted. Longer than a board stays armed on its last override. */
#define PEER_SILENCE_US 500000

struct sequence {
    struct peer peer;
    uint8_t last;
    uint64_t at_us;
};

/* An instant, and how many bytes had arrived by then, of all there ever were (modulo 2^16). */
struct mark {
    uint32_t at_us;
    uint16_t arrived;
    bool is_set;
};

/* An intact frame of a peer that may speak. */
struct frame {
    struct peer peer;
    uint32_t message; /* MAVLink message id */
    uint8_t payload_bytes;
    const uint8_t *payload; /* valid until the link is called again; trailing zeros may be missing */
};

struct link_counts {
    uint32_t bad;         /* start bytes that led to no intact frame */
    uint32_t unauthentic; /* intact frames that were dropped for their signature */
    uint32_t taken;       /* intact frames that were handed on; never counted anew */
    uint32_t unsent;      /* frames for which the outbox had no room */
};

struct link {
    struct peer me;
    struct gate gate;
    struct link_counts count;

    uint16_t begin, end; /* of the bytes in the inbox that are not looked at, or not to the end */
    uint16_t wait_end;   /* bytes up to here were there at wait_since_us, when the wait for the rest of a frame began */
    uint64_t wait_since_us;
    bool verifying; /* the signature of the frame at `begin` */
    uint8_t sequences;
    struct sequence sequence[LINK_PEERS];
    uint8_t inbox[FRAME_BYTES];

    uint8_t next_sequence;
    bool signing_frame, signs_next; /* the turn of a frame to be signed, before the next is verified */
    uint16_t put;                   /* bytes that were ever taken in, modulo 2^16 */
    uint8_t marked;                 /* the newest mark */
    struct mark mark[LINK_MARKS];
    uint16_t outbox_bytes, outbox_ready; /* bytes in the outbox; of these, how many may be sent: signed, if the link is */
    uint64_t sent_stamp, least_stamp; /* timestamp of the last signature; all are later than `least_stamp` */
    struct signature_job job;         /* one at a time, verifying or signing */
    uint8_t outbox[OUTBOX_BYTES];
};

enum link_state { LINK_IDLE, LINK_BUSY, LINK_FRAME };

/* Begin with nothing received. With a key, sign later than `sent`, and take what is later than `heard`. */
void link_begin(struct link *link, struct peer me, const uint8_t *key, uint64_t heard, uint64_t sent);
/* Sign from now on, with times later than all that were used; what is in the inbox is gone. */
void link_take_key(struct link *link, const uint8_t key[KEY_BYTES], uint64_t heard, uint64_t sent_between);

uint16_t link_room(const struct link *link); /* bytes that link_put can take now */
/* Take bytes that came at `now_us` into the inbox; returns how many of them found room. */
uint16_t link_put(struct link *link, const uint8_t *data, uint16_t bytes, uint64_t now_us);
/* Note at a step that so many bytes have arrived, but are not put yet. */
void link_mark(struct link *link, uint16_t waiting, uint64_t now_us);
/* When the frame that was found last had arrived: at the first mark after it, or now. */
uint64_t link_arrival_us(const struct link *link, uint64_t now_us);
/* Look at one frame, or go on with its signature. LINK_BUSY: call again; LINK_IDLE: wait for bytes. */
enum link_state link_next(struct link *link, uint64_t now_us, struct frame *frame);

/* Queue a message. `payload` has its full length. */
void link_send(struct link *link, uint32_t message, uint8_t checksum_seed, const void *payload, uint8_t payload_bytes);
/* Go on signing what is queued; returns true while there is more to do. */
bool link_sign(struct link *link);
const uint8_t *link_output(const struct link *link, uint16_t *bytes); /* what can be sent now */
void link_sent(struct link *link, uint16_t bytes);

#endif
