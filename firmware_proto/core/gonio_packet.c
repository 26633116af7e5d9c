#include "gonio_packet.h"

#include "gonio_board.h"

/* A processor with two address spaces would copy constants to RAM, where there is no room for a kilobyte. */
#ifdef __AVR__
#include <avr/pgmspace.h>
#define GONIO_IN_FLASH PROGMEM
#define FETCH(entry) pgm_read_dword(&(entry))
#else
#define GONIO_IN_FLASH
#define FETCH(entry) (entry)
#endif
#include "gonio_crc_table.h"

/* By a table: bit by bit an 8-bit processor takes longer for a packet of scans than until the next sample. */
uint32_t gonio_crc32(const uint8_t *data, uint8_t length)
{
    uint32_t crc = GP_CRC_INITIAL;
    while (length-- > 0u) {
        crc = (crc >> 8) ^ FETCH(crc_table[(uint8_t)(crc ^ *data++)]);
    }
    return crc ^ GP_CRC_FINAL;
}

uint16_t gonio_get16(const uint8_t *at)
{
    return (uint16_t)(at[0] | ((uint16_t)at[1] << 8));
}

uint32_t gonio_get32(const uint8_t *at)
{
    return gonio_get16(at) | ((uint32_t)gonio_get16(at + 2) << 16);
}

void gonio_put16(uint8_t *at, uint16_t value)
{
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

void gonio_put32(uint8_t *at, uint32_t value)
{
    gonio_put16(at, (uint16_t)value);
    gonio_put16(at + 2, (uint16_t)(value >> 16));
}

void gonio_decoder_init(struct gonio_decoder *decoder, uint8_t *raw, uint8_t room)
{
    decoder->raw = raw;
    decoder->room = room;
    decoder->length = 0;
    decoder->code = 0;
    decoder->left = 0;
    decoder->too_long = 0;
}

static void put(struct gonio_decoder *decoder, uint8_t byte)
{
    if (decoder->length < decoder->room) {
        decoder->raw[decoder->length++] = byte;
    } else {
        decoder->too_long = 1;
    }
}

static enum gonio_decoded complete(const struct gonio_decoder *decoder)
{
    uint8_t body_end;
    if (decoder->code == 0u) {
        return GONIO_MORE;
    }
    if (decoder->too_long != 0u) {
        return GONIO_BAD_LENGTH;
    }
    if (decoder->left != 0u) {
        return GONIO_BAD_COBS;
    }
    if (decoder->length < GP_HEADER_SIZE + GP_CRC_SIZE) {
        return GONIO_BAD_LENGTH;
    }
    body_end = (uint8_t)(decoder->length - GP_CRC_SIZE);
    if (gonio_crc32(decoder->raw, body_end) != gonio_get32(decoder->raw + body_end)) {
        return GONIO_BAD_CRC;
    }
    return GONIO_PACKET;
}

enum gonio_decoded gonio_decode(struct gonio_decoder *decoder, uint8_t byte)
{
    if (byte == GP_DELIMITER) {
        enum gonio_decoded result = complete(decoder);
        uint8_t length = decoder->length;
        gonio_decoder_init(decoder, decoder->raw, decoder->room);
        if (result == GONIO_PACKET) {
            decoder->length = length; /* for the caller; the next byte begins anew */
        }
        return result;
    }
    if (decoder->left == 0u) {
        if (decoder->code == 0u) {
            decoder->length = 0;
        } else if (decoder->code != 0xFFu) {
            put(decoder, 0);
        }
        decoder->code = byte;
        decoder->left = (uint8_t)(byte - 1u);
    } else {
        put(decoder, byte);
        decoder->left--;
    }
    return GONIO_MORE;
}

uint8_t gonio_seal(uint8_t *raw, uint8_t length)
{
    gonio_put32(raw + length, gonio_crc32(raw, length));
    return (uint8_t)(length + GP_CRC_SIZE);
}

void gonio_send(const uint8_t *raw, uint8_t length)
{
    const uint8_t *end = raw + length;
    for (;;) { /* packets are shorter than 254 bytes: each run ends at a zero or at the end */
        const uint8_t *stop = raw;
        while (stop != end && *stop != 0u) {
            stop++;
        }
        board_send((uint8_t)(stop - raw + 1));
        while (raw != stop) {
            board_send(*raw++);
        }
        if (raw == end) {
            break;
        }
        raw++;
    }
    board_send(GP_DELIMITER);
    board_send_now();
}
