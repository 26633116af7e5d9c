/* An asynchronous serial line as levels over time, and a receiver that samples it with a clock of its own. */
#ifndef UART_H
#define UART_H

#include <stddef.h>
#include <stdint.h>

#include "chip.h" /* ps_t, NEVER */

struct sent { ps_t start, bit; uint8_t byte; };

typedef struct {
    struct sent *bytes; /* in order of time, not overlapping */
    size_t first, count, room;
    ps_t free_at;
} line_t;

/* Sends a byte (8N1) as soon as the line is free, not before now; returns when its stop bit is over. */
ps_t line_send(line_t *line, ps_t now, ps_t bit, uint8_t byte);
int line_level(const line_t *line, ps_t at);
ps_t line_next_change(const line_t *line, ps_t at); /* after at; NEVER where none is known yet */
void line_forget(line_t *line, ps_t before);
void line_clear(line_t *line);

/* As the AVR's: a start bit is a falling edge, each bit the majority of the three samples in its middle. */
typedef struct {
    ps_t tick, phase; /* sampling clock */
    int per_bit;      /* samples a bit: 16, or 8 at double speed */
    ps_t from;        /* looks for a start bit from here */
    int was_high;     /* level of the sample before */
} receiver_t;

void receiver_begin(receiver_t *receiver, ps_t now, ps_t tick, ps_t phase, int per_bit);
/* Time of the first sample of the next start bit and of the last one of its stop bit; 0 where none is known. */
int receiver_next(receiver_t *receiver, const line_t *line, ps_t *start, ps_t *done);
/* Takes the byte that begins at start: 0 where it was no start bit. */
int receiver_take(receiver_t *receiver, const line_t *line, ps_t start, uint8_t *byte, int *framing_error);

#endif
