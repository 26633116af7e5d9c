/* Optiboot as an Uno has it (STK500, 115200 baud): what it makes of whatever its receiver samples. */
#ifndef BOOT_H
#define BOOT_H

#include "uart.h"

struct boot_options {
    ps_t reset;     /* from opening to the end of the reset pulse (DTR over 100 nF) */
    ps_t start;     /* from there to the receiver: the oscillator's start-up, 65 ms by the fuses of an Uno */
    ps_t blink;     /* six changes of the LED, 62.5 ms each; nothing is read meanwhile */
    ps_t watchdog;  /* 1 s since the last byte without a framing error */
    ps_t give_up;   /* 16 ms, once a command did not end as it should */
    ps_t phase;     /* of the sampling clock */
    ps_t tick;      /* of it: 16 MHz / 17 at double speed, what UBRR can do for 115 200 baud: 117 647 */
    int64_t per_bit; /* samples a bit */
};

struct boot_counts { uint32_t bytes, framing_errors, overruns, commands, replies, page_erases, page_writes; };

typedef struct {
    struct boot_options options;
    struct boot_counts counts;
    ps_t listens, reads, deadline, ended;
    int state, then, left, kind, running;
    uint16_t address;
    uint8_t length, queued[3];
    int queued_error[3], queued_count;
    line_t *out;     /* answers go here, or nowhere */
    receiver_t receiver;
} boot_t;

extern const struct boot_options boot_uno;

/* A reset at opening. The counts go on. */
void boot_begin(boot_t *boot, ps_t opened, const struct boot_options *options, line_t *out);
/* Takes all that the line brought until now; 0 once the application runs, from boot->ended on. */
int boot_run(boot_t *boot, line_t *line, ps_t now);

/* One opening: n bytes that the host sends at these times (ps, from opening) with this bit time.
 * Returns when the application starts. */
ps_t boot_opening(const struct boot_options *options, int n, const ps_t *at, const uint8_t *bytes, ps_t bit,
                  struct boot_counts *counts);

#endif
