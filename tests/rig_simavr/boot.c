#include "boot.h"

#include <string.h>

enum { COMMAND, SKIP, END, PAGE, HUNG };

enum { STK_OK = 0x10, STK_INSYNC = 0x14, CRC_EOP = 0x20 };

#define NRWW_START 0x7000u /* the boot loader's own section of flash cannot be erased while it is read */

const struct boot_options boot_uno = {
    .reset = PS_MS, .start = 65 * PS_MS, .blink = 375 * PS_MS, .watchdog = 1000 * PS_MS, .give_up = 16 * PS_MS,
    .tick = 1062500, .per_bit = 8,
};

void boot_begin(boot_t *boot, ps_t opened, const struct boot_options *options, line_t *out)
{
    struct boot_counts counts = boot->counts;
    memset(boot, 0, sizeof *boot);
    boot->counts = counts;
    boot->options = *options;
    boot->listens = opened + options->reset + options->start;
    boot->reads = boot->listens + options->blink;
    boot->deadline = boot->reads + options->watchdog;
    boot->ended = NEVER;
    boot->state = COMMAND;
    boot->running = 1;
    boot->queued_error[2] = NEVER;
    boot->out = out;
    receiver_begin(&boot->receiver, boot->listens, options->tick, options->phase, (int)options->per_bit);
}

static void answer(boot_t *boot, ps_t now, uint8_t byte)
{
    boot->counts.replies++;
    if (boot->out != NULL) {
        line_send(boot->out, now, boot->options.tick * boot->options.per_bit, byte);
    }
}

static void ended_well(boot_t *boot, ps_t now)
{
    int k;
    answer(boot, now, STK_INSYNC);
    switch (boot->kind) {
    case 'A':
        answer(boot, now, 4);
        break;
    case 'V':
        answer(boot, now, 0);
        break;
    case 'd':
        if (boot->address >= NRWW_START) {
            boot->counts.page_erases++;
        }
        boot->counts.page_writes++;
        break;
    case 't':
        for (k = 0; k < (boot->length ? boot->length : 256); k++) {
            answer(boot, now, 0xFF);
        }
        break;
    case 'u':
        answer(boot, now, 0x1E);
        answer(boot, now, 0x95);
        answer(boot, now, 0x0F);
        break;
    case 'Q':
        boot->deadline = now + boot->options.give_up;
        boot->options.watchdog = boot->options.give_up;
        break;
    default:
        break;
    }
    answer(boot, now, STK_OK);
    boot->state = COMMAND;
}

/* A command: parameters, then the end mark. */
static void begin(boot_t *boot, uint8_t kind)
{
    boot->kind = kind;
    boot->counts.commands++;
    switch (kind) {
    case 'A':
        boot->left = 1;
        break;
    case 'B':
        boot->left = 20;
        break;
    case 'E':
        boot->left = 5;
        break;
    case 'U':
        boot->left = 2;
        break;
    case 'V':
        boot->left = 4;
        break;
    case 'd':
    case 't':
        boot->left = 3;
        break;
    default:
        boot->left = 0;
    }
    boot->state = boot->left ? SKIP : END;
}

static void take(boot_t *boot, ps_t now, uint8_t byte, int framing_error)
{
    if (!framing_error && boot->state != HUNG) {
        boot->deadline = now + boot->options.watchdog;
    }
    switch (boot->state) {
    case COMMAND:
        begin(boot, byte);
        break;
    case SKIP:
        if (boot->kind == 'U') {
            boot->address = boot->left == 2 ? byte : (uint16_t)(2 * (boot->address | byte << 8));
        }
        if ((boot->kind == 'd' || boot->kind == 't') && boot->left == 2) {
            boot->length = byte;
        }
        if (--boot->left == 0) {
            boot->state = END;
            if (boot->kind == 'd') {
                if (boot->address < NRWW_START) {
                    boot->counts.page_erases++; /* at once, before the page has come */
                }
                boot->left = boot->length ? boot->length : 256;
                boot->state = PAGE;
            }
        }
        break;
    case PAGE:
        if (--boot->left == 0) {
            boot->state = END;
        }
        break;
    case END:
        if (byte == CRC_EOP) {
            ended_well(boot, now);
        } else {
            boot->state = HUNG; /* nothing is read any more, the watchdog ends it */
            boot->deadline = now + boot->options.give_up;
        }
        break;
    default:
        break;
    }
}

static void read_queue(boot_t *boot)
{
    int k;
    for (k = 0; k < boot->queued_count; k++) {
        take(boot, boot->reads, boot->queued[k], boot->queued_error[k]);
    }
    boot->queued_count = 0;
}

int boot_run(boot_t *boot, line_t *line, ps_t now)
{
    ps_t start, done;
    while (boot->running) {
        uint8_t byte = 0;
        int framing_error = 0;
        int found = receiver_next(&boot->receiver, line, &start, &done) && done <= now;
        ps_t until = found ? done : now;
        if (until >= boot->reads && boot->queued_count) {
            read_queue(boot);
        }
        if (boot->deadline <= until) {
            boot->running = 0;
            boot->ended = boot->deadline;
            break;
        }
        if (!found) {
            break;
        }
        if (receiver_take(&boot->receiver, line, start, &byte, &framing_error)) {
            boot->counts.bytes++;
            boot->counts.framing_errors += (uint32_t)framing_error;
            if (done >= boot->reads) {
                take(boot, done, byte, framing_error);
            } else {
                int k = boot->queued_count < 3 ? boot->queued_count++ : 2;
                boot->counts.overruns += k == 2 && boot->queued_error[2] >= 0;
                boot->queued[k] = byte; /* two in the receiver's buffer, one behind it, which the next overruns */
                boot->queued_error[k] = framing_error;
            }
        }
        line_forget(line, boot->receiver.from - 2 * boot->receiver.tick);
    }
    return boot->running;
}

ps_t boot_opening(const struct boot_options *options, int n, const ps_t *at, const uint8_t *bytes, ps_t bit,
                  struct boot_counts *counts)
{
    line_t line = {0};
    boot_t boot;
    int k;
    memset(&boot, 0, sizeof boot);
    boot.counts = *counts;
    boot_begin(&boot, 0, options, NULL);
    for (k = 0; k < n; k++) {
        line_send(&line, at[k], bit, bytes[k]);
    }
    while (boot_run(&boot, &line, boot.deadline + options->watchdog)) {
    }
    *counts = boot.counts;
    line_clear(&line);
    return boot.ended;
}
