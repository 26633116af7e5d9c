#include "uart.h"

#include <stdlib.h>

ps_t line_send(line_t *line, ps_t now, ps_t bit, uint8_t byte)
{
    ps_t start = now > line->free_at ? now : line->free_at;
    if (line->first > 4096 && line->first * 2 > line->count) {
        size_t k;
        for (k = line->first; k < line->count; k++) {
            line->bytes[k - line->first] = line->bytes[k];
        }
        line->count -= line->first;
        line->first = 0;
    }
    if (line->count == line->room) {
        line->room = line->room ? 2 * line->room : 256;
        line->bytes = realloc(line->bytes, line->room * sizeof *line->bytes);
        if (line->bytes == NULL) {
            abort();
        }
    }
    line->bytes[line->count].start = start;
    line->bytes[line->count].bit = bit;
    line->bytes[line->count].byte = byte;
    line->count++;
    line->free_at = start + 10 * bit;
    return line->free_at;
}

static int bit_level(const struct sent *sent, int k)
{
    return k == 0 ? 0 : k > 8 ? 1 : (sent->byte >> (k - 1)) & 1;
}

int line_level(const line_t *line, ps_t at)
{
    size_t k;
    for (k = line->first; k < line->count; k++) {
        const struct sent *sent = &line->bytes[k];
        if (at < sent->start) {
            return 1;
        }
        if (at < sent->start + 10 * sent->bit) {
            return bit_level(sent, (int)((at - sent->start) / sent->bit));
        }
    }
    return 1;
}

ps_t line_next_change(const line_t *line, ps_t at)
{
    int level = line_level(line, at), k;
    size_t n;
    for (n = line->first; n < line->count; n++) {
        const struct sent *sent = &line->bytes[n];
        if (sent->start + 10 * sent->bit <= at) {
            continue;
        }
        for (k = 0; k < 10; k++) {
            ps_t begins = sent->start + k * sent->bit;
            if (begins > at && bit_level(sent, k) != level) {
                return begins;
            }
        }
    }
    return NEVER;
}

void line_forget(line_t *line, ps_t before)
{
    while (line->first < line->count && line->bytes[line->first].start + 10 * line->bytes[line->first].bit < before) {
        line->first++;
    }
}

void line_clear(line_t *line)
{
    free(line->bytes);
    line->bytes = NULL;
    line->first = line->count = line->room = 0;
    line->free_at = 0;
}

static ps_t align(const receiver_t *receiver, ps_t at)
{
    ps_t behind = (at - receiver->phase) % receiver->tick;
    if (behind < 0) {
        behind += receiver->tick;
    }
    return behind ? at + receiver->tick - behind : at;
}

void receiver_begin(receiver_t *receiver, ps_t now, ps_t tick, ps_t phase, int per_bit)
{
    receiver->tick = tick;
    receiver->phase = phase;
    receiver->per_bit = per_bit;
    receiver->from = align(receiver, now);
    receiver->was_high = 1;
}

int receiver_next(receiver_t *receiver, const line_t *line, ps_t *start, ps_t *done)
{
    ps_t at = receiver->from;
    int was_high = receiver->was_high;
    for (;;) {
        int level = line_level(line, at);
        if (!level && was_high) {
            break;
        }
        was_high = level;
        /* Nothing changes at the samples before the next edge. */
        ps_t edge = line_next_change(line, at);
        if (edge == NEVER) {
            return 0;
        }
        at = align(receiver, edge);
    }
    *start = at;
    *done = at + (9 * receiver->per_bit + receiver->per_bit / 2 + 1) * receiver->tick;
    return 1;
}

static int majority(const receiver_t *receiver, const line_t *line, ps_t start, int bit)
{
    ps_t middle = start + (bit * receiver->per_bit + receiver->per_bit / 2) * receiver->tick;
    return line_level(line, middle - receiver->tick) + line_level(line, middle) +
               line_level(line, middle + receiver->tick) >= 2;
}

int receiver_take(receiver_t *receiver, const line_t *line, ps_t start, uint8_t *byte, int *framing_error)
{
    int k, last = 9;
    uint8_t value = 0;
    int is_start = !majority(receiver, line, start, 0);
    if (is_start) {
        for (k = 0; k < 8; k++) {
            value |= (uint8_t)(majority(receiver, line, start, k + 1) << k);
        }
        *byte = value;
        *framing_error = !majority(receiver, line, start, 9);
    } else {
        last = 0;
    }
    ps_t over = start + (last * receiver->per_bit + receiver->per_bit / 2 + 1) * receiver->tick;
    receiver->was_high = line_level(line, over);
    receiver->from = over + receiver->tick;
    return is_start;
}
