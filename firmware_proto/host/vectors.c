/* The C side of ../vectors.txt: vectors FILE. Says what differs; exit status 1 where something does. */
#include <stdio.h>
#include <string.h>

#include "gonio_packet.h"
#include "host_board.h"

static uint32_t bytes_of(const char *hex, uint8_t *out)
{
    uint32_t count = 0;
    unsigned byte;
    while (strcmp(hex, "-") != 0 && sscanf(hex, "%2x", &byte) == 1) {
        out[count++] = (uint8_t)byte;
        hex += 2;
    }
    return count;
}

static int result_of(const char *name)
{
    static const char *const names[] = {"empty", "packet", "cobs", "length", "crc"};
    static const int results[] = {GONIO_MORE, GONIO_PACKET, GONIO_BAD_COBS, GONIO_BAD_LENGTH, GONIO_BAD_CRC};
    size_t k;
    for (k = 0; k < sizeof results / sizeof results[0]; k++) {
        if (strcmp(name, names[k]) == 0) {
            return results[k];
        }
    }
    return -1;
}

static int check(const char *kind, const char *left, const char *right)
{
    uint8_t raw[600], out[600];
    uint32_t raw_length = bytes_of(left, raw);
    if (strcmp(kind, "crc") == 0) {
        unsigned crc = 0;
        return sscanf(right, "%x", &crc) == 1 && gonio_crc32(raw, (uint8_t)raw_length) == crc;
    }
    if (strcmp(kind, "packet") == 0) { /* header and body; what stands on the wire */
        uint8_t wire[600];
        uint32_t wire_length = bytes_of(right, wire);
        struct gonio_decoder decoder;
        enum gonio_decoded result = GONIO_MORE;
        uint8_t sealed = gonio_seal(raw, (uint8_t)raw_length);
        uint32_t k;
        host_start();
        gonio_send(raw, sealed);
        if (host_take(out, sizeof out) != wire_length || memcmp(out, wire, wire_length) != 0) {
            return 0;
        }
        gonio_decoder_init(&decoder, out, GP_MAX_RAW);
        for (k = 0; k < wire_length; k++) {
            result = gonio_decode(&decoder, wire[k]);
        }
        return result == GONIO_PACKET && decoder.length == sealed && memcmp(out, raw, sealed) == 0;
    }
    if (strcmp(kind, "wire") == 0) { /* bytes before a delimiter; what they are */
        struct gonio_decoder decoder;
        uint32_t k;
        gonio_decoder_init(&decoder, out, GP_MAX_RAW);
        for (k = 0; k < raw_length; k++) {
            if (gonio_decode(&decoder, raw[k]) != GONIO_MORE) {
                return 0;
            }
        }
        return (int)gonio_decode(&decoder, 0) == result_of(right);
    }
    return 0;
}

int main(int argc, char **argv)
{
    static char line[4096], kind[16], left[2048], right[2048];
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;
    int number = 0, checked = 0, wrong = 0;
    if (file == NULL) {
        fprintf(stderr, "usage: vectors FILE\n");
        return 2;
    }
    while (fgets(line, sizeof line, file) != NULL) {
        number++;
        if (line[0] == '#' || line[0] == '\n') {
            continue;
        }
        checked++;
        if (sscanf(line, "%15s %2047s %2047s", kind, left, right) != 3 || !check(kind, left, right)) {
            printf("line %d: %s", number, line);
            wrong++;
        }
    }
    fclose(file);
    printf("%d vectors, %d wrong\n", checked, wrong);
    return wrong != 0 || checked == 0;
}
