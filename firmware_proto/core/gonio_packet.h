/* Bytes, CRC-32 and COBS. */
#ifndef GONIO_PACKET_H
#define GONIO_PACKET_H

#include <stdint.h>

#include "gonio_protocol.h"

/* Takes one wire byte a call and collects the raw packet. */
struct gonio_decoder {
    uint8_t *raw;
    uint8_t room;
    uint8_t length;
    uint8_t code;
    uint8_t left;
    uint8_t too_long;
};

enum gonio_decoded {
    GONIO_MORE,       /* not complete, or empty */
    GONIO_PACKET,     /* raw holds length bytes, the CRC is right */
    GONIO_BAD_COBS,
    GONIO_BAD_LENGTH,
    GONIO_BAD_CRC
};

/* Little endian, at any address. */
uint16_t gonio_get16(const uint8_t *at);
uint32_t gonio_get32(const uint8_t *at);
void gonio_put16(uint8_t *at, uint16_t value);
void gonio_put32(uint8_t *at, uint32_t value);

uint32_t gonio_crc32(const uint8_t *data, uint8_t length);

void gonio_decoder_init(struct gonio_decoder *decoder, uint8_t *raw, uint8_t room);

/* What this byte completes; after anything but GONIO_MORE the next byte begins a packet. */
enum gonio_decoded gonio_decode(struct gonio_decoder *decoder, uint8_t byte);

/* Append the CRC: raw has room for GP_CRC_SIZE bytes more; returns the new length. */
uint8_t gonio_seal(uint8_t *raw, uint8_t length);

/* Send a sealed packet; the transmitter has room for length + 2 bytes. */
void gonio_send(const uint8_t *raw, uint8_t length);

#endif
