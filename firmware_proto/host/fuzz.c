/* Rubbish into the core, with a session open: fuzz BYTES SEED, where BYTES are random ones
 *
 * Three kinds in turn: random bytes; packets with a right CRC and random content; sound requests with a few
 * bytes changed. None of them asks for a write, so a frame with the write bit, or with bit 14, is a failure.
 * Build it with the sanitizers: see Makefile.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "gonio_board.h"
#include "gonio_packet.h"
#include "host_board.h"

#define CHUNK 512u
#define NONCE 0x5A5A1234ul

static uint64_t state;
static unsigned long frames, packets_out;
static uint16_t next_id;

static uint32_t draw(void)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t)(state >> 16);
}

static uint16_t take_frame(uint16_t word)
{
    frames++;
    if ((word & (GP_WRITE_BIT | GP_RESERVED_BIT)) != 0u) {
        fprintf(stderr, "frame 0x%04X was sent\n", (unsigned)word);
        abort();
    }
    return (uint16_t)draw();
}

/* COBS of a sealed packet between delimiters; returns the length. */
static uint32_t stuff(const uint8_t *raw, uint32_t length, uint8_t *out)
{
    uint32_t code = 1, at = 2, k;
    out[0] = 0;
    for (k = 0; k < length; k++) {
        if (raw[k] == 0u) {
            out[code] = (uint8_t)(at - code);
            code = at++;
        } else {
            out[at++] = raw[k];
        }
    }
    out[code] = (uint8_t)(at - code);
    out[at++] = 0;
    return at;
}

static uint32_t random_bytes(uint8_t *out)
{
    uint32_t k;
    for (k = 0; k < CHUNK; k++) {
        uint32_t x = draw();
        out[k] = (x & 0x700u) == 0u ? 0u : (uint8_t)x; /* more delimiters than chance would give */
    }
    return CHUNK;
}

static uint32_t hello(uint8_t *out)
{
    uint8_t raw[16] = {GP_TYPE_HELLO_REQUEST, 0, 0, GP_VERSION};
    uint32_t nonce = NONCE + (draw() & 3u);
    uint32_t k;
    next_id = (uint16_t)draw();
    raw[1] = (uint8_t)next_id;
    raw[2] = (uint8_t)(next_id >> 8);
    for (k = 0; k < 4u; k++) {
        raw[4u + k] = (uint8_t)(nonce >> (8u * k));
    }
    return stuff(raw, gonio_seal(raw, 8), out);
}

/* A packet with a right CRC. Its exchange requests carry a wrong count wherever there are writes. */
static uint32_t random_packet(uint8_t *out)
{
    uint8_t raw[256];
    uint32_t length = GP_HEADER_SIZE + draw() % 90u;
    uint32_t k;
    for (k = 0; k < length; k++) {
        raw[k] = (uint8_t)draw();
    }
    raw[0] = (draw() & 15u) == 0u ? (uint8_t)draw() : (uint8_t)(1u + draw() % 8u);
    if ((draw() & 3u) != 0u) {
        next_id = (uint16_t)(next_id + (draw() % 3u));
        raw[1] = (uint8_t)next_id;
        raw[2] = (uint8_t)(next_id >> 8);
    }
    if (raw[0] == GP_TYPE_EXCHANGE_REQUEST && length > GP_HEADER_SIZE) {
        uint8_t writes = 0;
        uint8_t mask = (uint8_t)draw();
        for (k = GP_HEADER_SIZE + 2u; k < length; k += 2u) {
            raw[k] &= (mask & 1u) != 0u ? 0x3Fu : (mask & 2u) != 0u ? 0xBFu : 0xFFu;
            writes = (uint8_t)(writes + (raw[k] >> 7));
        }
        raw[GP_HEADER_SIZE] = writes != 0u ? (uint8_t)(writes + 1u + draw() % 255u) : (uint8_t)(draw() & 1u);
    }
    if (raw[0] == GP_TYPE_STREAM_REQUEST && length > GP_HEADER_SIZE + GP_STREAM_REQUEST_SIZE && (draw() & 7u) != 0u) {
        uint8_t *body = raw + GP_HEADER_SIZE;
        length -= (length - GP_HEADER_SIZE - GP_STREAM_REQUEST_SIZE) % 2u;
        body[0] = (uint8_t)(draw() % 4u);
        body[1] = (uint8_t)(draw() % 8u);
        body[2] = (uint8_t)(1u + draw() % 3u);
        body[3] = 0;
        memset(body + 4, 0, 4);
        body[5] = body[0] == GP_TRIGGER_PERIOD ? (uint8_t)draw() : 0u;
        for (k = GP_STREAM_REQUEST_SIZE + 1u; k + GP_HEADER_SIZE < length; k += 2u) {
            body[k] &= (draw() & 63u) == 0u ? 0xFFu : 0x3Fu;
        }
    }
    return stuff(raw, gonio_seal(raw, (uint8_t)length), out);
}

static uint32_t broken_request(uint8_t *out)
{
    uint32_t length = random_packet(out);
    uint32_t k = 1u + draw() % 4u;
    while (k-- > 0u) {
        out[draw() % length] = (uint8_t)draw();
    }
    return length;
}

int main(int argc, char **argv)
{
    unsigned long total = argc > 1 ? strtoul(argv[1], NULL, 0) : 1000000ul;
    unsigned long fed = 0;
    uint32_t time_us = 0;
    state = (argc > 2 ? strtoull(argv[2], NULL, 0) : 1ull) * 0x9E3779B97F4A7C15ull + 1ull;
    host_frame_hook = take_frame;
    host_start();
    while (fed < total) {
        uint8_t bytes[600], sent[1024];
        uint32_t length, k, kind = draw() % 32u;
        uint8_t random = kind != 0u && kind < 12u;
        length = kind == 0u ? hello(bytes) : kind < 12u ? random_bytes(bytes)
                 : kind < 24u ? random_packet(bytes) : broken_request(bytes);
        fed += host_feed(bytes, length) * random; /* only these are counted */
        for (k = 0; k < 64u; k++) {
            time_us += draw() % 900u;
            host_set_time(time_us);
            if ((draw() & 1u) != 0u) {
                host_edge();
            }
            host_poll(1u + draw() % 4u);
        }
        host_limit_room((draw() & 7u) == 0u ? (uint16_t)(draw() % 256u) : 255u);
        length = host_take(sent, sizeof sent);
        for (k = 0; k < length; k++) {
            packets_out += sent[k] == 0u;
        }
    }
    if (host_lock_errors() != 0u) {
        fprintf(stderr, "lock and unlock do not match\n");
        return 1;
    }
    printf("%lu random bytes in, besides requests; %lu packets out, %lu read frames, no write frame\n", fed, packets_out, frames);
    return frames == 0ul || packets_out == 0ul; /* a fuzzer that reaches nothing proves nothing */
}
