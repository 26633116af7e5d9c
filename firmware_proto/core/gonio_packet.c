#include "gonio_packet.h"

#include "gonio_board.h"

/* By bytes: an 8-bit processor shifts 16 bits slowly. */
uint16_t gonio_crc16(const uint8_t *data, uint8_t length)
{
    uint8_t high = (uint8_t)(GP_CRC_INITIAL >> 8);
    uint8_t low = (uint8_t)(GP_CRC_INITIAL & 0xFFu);
    while (length-- > 0u) {
        uint8_t x = (uint8_t)(high ^ *data++);
        x ^= (uint8_t)(x >> 4);
        high = (uint8_t)(low ^ (uint8_t)(x << 4) ^ (x >> 3));
        low = (uint8_t)((uint8_t)(x << 5) ^ x);
    }
    return (uint16_t)((uint16_t)high << 8 | low);
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
    if (gonio_crc16(decoder->raw, body_end) !=
        (uint16_t)(decoder->raw[body_end] | ((uint16_t)decoder->raw[body_end + 1u] << 8))) {
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
    uint16_t crc = gonio_crc16(raw, length);
    raw[length] = (uint8_t)crc;
    raw[length + 1u] = (uint8_t)(crc >> 8);
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
