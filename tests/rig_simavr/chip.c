#include "chip.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

/* -- registers ------------------------------------------------------------------------------------------- */

enum {
    ENDURANCE = 0x00, SUPPLY_OUT = 0x02, XGYRO_OUT = 0x04, XACCL_OUT = 0x0A, XTEMP_OUT = 0x10, AUX_ADC = 0x16,
    XGYRO_OFF = 0x1A, XACCL_OFF = 0x20, ALM_MAG1 = 0x26, ALM_MAG2 = 0x28, ALM_SMPL1 = 0x2A, ALM_SMPL2 = 0x2C,
    ALM_CTRL = 0x2E, AUX_DAC = 0x30, GPIO_CTRL = 0x32, MSC_CTRL = 0x34, SMPL_PRD = 0x36, SENS_AVG = 0x38,
    SLP_CNT = 0x3A, STATUS = 0x3C, COMMAND = 0x3E
};

#define WORDS 32 /* 16-bit registers: address / 2 */
#define CHANNELS INPUTS
#define HISTORY 256 /* a power of two, above 255: the differences of a rate-of-change alarm */
#define LOG_ROOM 1024

/* Bits that exist in a register that can be written. */
static const uint16_t writable[WORDS] = {
    [XGYRO_OFF / 2] = 0x1FFF, [XGYRO_OFF / 2 + 1] = 0x1FFF, [XGYRO_OFF / 2 + 2] = 0x1FFF,
    [XACCL_OFF / 2] = 0x0FFF, [XACCL_OFF / 2 + 1] = 0x0FFF, [XACCL_OFF / 2 + 2] = 0x0FFF,
    [ALM_MAG1 / 2] = 0xBFFF, [ALM_MAG2 / 2] = 0xBFFF, [ALM_SMPL1 / 2] = 0x00FF, [ALM_SMPL2 / 2] = 0x00FF,
    [ALM_CTRL / 2] = 0xFFD7, [AUX_DAC / 2] = 0x0FFF, [GPIO_CTRL / 2] = 0x0303, [MSC_CTRL / 2] = 0x07C7,
    [SMPL_PRD / 2] = 0x00FF, [SENS_AVG / 2] = 0x0707, [SLP_CNT / 2] = 0x00FF,
};

/* Bits that have a copy in flash. */
static const uint16_t kept[WORDS] = {
    [XGYRO_OFF / 2] = 0xFFFF, [XGYRO_OFF / 2 + 1] = 0xFFFF, [XGYRO_OFF / 2 + 2] = 0xFFFF,
    [XACCL_OFF / 2] = 0xFFFF, [XACCL_OFF / 2 + 1] = 0xFFFF, [XACCL_OFF / 2 + 2] = 0xFFFF,
    [ALM_MAG1 / 2] = 0xFFFF, [ALM_MAG2 / 2] = 0xFFFF, [ALM_SMPL1 / 2] = 0xFFFF, [ALM_SMPL2 / 2] = 0xFFFF,
    [ALM_CTRL / 2] = 0xFFFF, [MSC_CTRL / 2] = 0x00FF, [SMPL_PRD / 2] = 0xFFFF, [SENS_AVG / 2] = 0xFFFF,
};

enum { /* STATUS */
    ST_SUPPLY_LOW = 1 << 0, ST_SUPPLY_HIGH = 1 << 1, ST_FLASH = 1 << 2, ST_SPI = 1 << 3, ST_OVER_RANGE = 1 << 4,
    ST_SELF_TEST = 1 << 5, ST_ALARM1 = 1 << 8, ST_ALARM2 = 1 << 9
};
#define ST_FALLS (ST_SUPPLY_LOW | ST_SUPPLY_HIGH | ST_OVER_RANGE)

enum { CMD_AUTONULL = 1 << 0, CMD_RESTORE = 1 << 1, CMD_DAC = 1 << 2, CMD_FLASH = 1 << 3, CMD_PRECISION = 1 << 4,
       CMD_RESET = 1 << 7 };

/* -- parameters: what the sheet leaves open, and its figures --------------------------------------------- */

struct parameters {
    double startup_ms;          /* B: 150 typical; used after a reset too */
    double self_test_ms;        /* A: 35 */
    double flash_ms;            /* A: about 100 */
    double autonull_ms;         /* open */
    double precision_null_ms;   /* A: about 30 s */
    double wake_ms;             /* B: 3 */
    double self_test_fails;     /* STATUS bits that an internal self-test finds */
    double accl_lsb_mg;         /* A: 0.4672 on the 16354 */
    double accl_off_lsb_mg;     /* C: the LSB of the output */
    double accl_range_mg;       /* open: where over-range begins */
    double gyro_overrange;      /* open: over-range of the gyros, as a part of the range set; 0 never */
    double dr_width_us;         /* open: width of the data-ready pulse */
    double dr_delay_us;         /* open: from the update to the pulse */
    double latch_next;          /* open: 0 the word is fetched where its request ends, 1 where the next frame begins */
    double write_reply;         /* open: word shifted out after a write frame; -1 the word before it */
    double short_frame_status;  /* open: a frame of wrong length sets STATUS[3] */
    double stall_locks;         /* C: too short a stall makes the part deaf until a reset (as on later parts) */
    double base_us;             /* 0.61035 ms in the sheet, which also says 819.2 SPS: 1/1638.4 s */
    double smpl_restart;        /* open: 1 a change of SMPL_PRD begins a new period, 0 the running one is finished */
    double smpl_zero_as_one;    /* open: SMPL_PRD[6:0] = 0 */
    double offset_after_filter; /* open (later parts: after) */
    double filter_zeros;        /* open: 1 the filter starts from zeros, 0 from the first sample */
    double filter_clears;       /* open: 1 it starts anew where SMPL_PRD, range or taps change, and after a sleep */
    double ea_at_update;        /* open: 1 EA is that of the last update, 0 that of the moment of the reading */
    double unused_bits_stick;   /* open: bits that are not used keep what was written */
    double busy_updates;        /* open: the outputs go on during a flash update and an autonull */
    double busy_restart;        /* open: 1 a new period begins behind a flash update or a self-test */
    double flash_needs_supply;  /* open: where the last update saw less than 4.75 V nothing is saved and STATUS[2] is set */
    double alarm_line_held;     /* open: 1 an alarm's line follows STATUS, 0 the last update */
    double gpio_pins;           /* levels from outside at DIO2 (bit 1) and DIO1 (bit 0) */
    double self_test_gyro;      /* open: answer of the gyros to the manual self-test, in deg/s */
    double self_test_accl;      /* open: that of the accelerometers, in mg */
    double self_test_over_range; /* open: the answer to it counts for over-range */
    double first_update_us;     /* open: from the end of the start-up to the first update; negative: a period */
    double pattern;             /* for tests: 1 the outputs count the updates, from a start of their own a channel */
};

static const struct parameters defaults = {
    .startup_ms = 150, .self_test_ms = 35, .flash_ms = 100, .autonull_ms = 150, .precision_null_ms = 30000, .wake_ms = 3,
    .accl_lsb_mg = 0.4672, .accl_off_lsb_mg = 0.4672, .accl_range_mg = 1700, .gyro_overrange = 1.0, .dr_width_us = 100,
    .short_frame_status = 1, .base_us = 1e6 / 1638.4, .stall_locks = 1, .smpl_zero_as_one = 1, .offset_after_filter = 1, .busy_updates = 1,
    .gpio_pins = 3, .self_test_gyro = 50, .self_test_accl = 500, .first_update_us = -1,
};

#define PARAMETER(name) {#name, offsetof(struct parameters, name)}
static const struct { const char *name; size_t at; } names[] = {
    PARAMETER(startup_ms), PARAMETER(self_test_ms), PARAMETER(flash_ms), PARAMETER(autonull_ms),
    PARAMETER(precision_null_ms), PARAMETER(wake_ms), PARAMETER(self_test_fails), PARAMETER(accl_lsb_mg),
    PARAMETER(accl_off_lsb_mg), PARAMETER(accl_range_mg), PARAMETER(gyro_overrange), PARAMETER(dr_width_us),
    PARAMETER(dr_delay_us), PARAMETER(latch_next), PARAMETER(write_reply), PARAMETER(short_frame_status),
    PARAMETER(stall_locks), PARAMETER(base_us), PARAMETER(smpl_restart), PARAMETER(filter_clears),
    PARAMETER(busy_restart), PARAMETER(flash_needs_supply), PARAMETER(alarm_line_held), PARAMETER(smpl_zero_as_one), PARAMETER(offset_after_filter),
    PARAMETER(filter_zeros), PARAMETER(ea_at_update), PARAMETER(unused_bits_stick), PARAMETER(busy_updates),
    PARAMETER(gpio_pins), PARAMETER(self_test_gyro), PARAMETER(self_test_accl),
    PARAMETER(self_test_over_range), PARAMETER(first_update_us), PARAMETER(pattern),
};
#define NAMES (sizeof names / sizeof names[0])

/* -- limits of the wires, in ps ----------------------------------------------------------------------------- */

#define T_CS 48800
#define T_DAV 100000
#define T_DSU 24400
#define T_DHD 48800
#define UNSURE 20000
#define SCLK_SLOWEST (100 * PS_US) /* 10 kHz */

static const struct limits { ps_t stall, period, sclk, sleep; } limits[2] = {
    {9 * PS_US, 40 * PS_US, 500000, 10 * PS_US},     /* fast: 2 MHz */
    {75 * PS_US, 160 * PS_US, 3333333, 80 * PS_US},  /* normal: 300 kHz */
};

static const char *const violation_names[V_KINDS] = {
    "stall", "period", "sclk_fast", "sclk_slow", "clocks", "mode", "select", "setup", "hold", "bit14", "reset_traffic",
    "sleep_select", "wake_traffic", "restore_traffic",
};

/* -- state ------------------------------------------------------------------------------------------------ */

struct chip {
    struct parameters p;
    uint16_t reg[WORDS], flash[WORDS];
    uint16_t out[CHANNELS];       /* data bits of the outputs */
    uint16_t fresh;               /* ND, a bit a channel */
    uint16_t endurance;
    uint16_t status, held_ea;
    double input[INPUTS];
    double history[CHANNELS][HISTORY];
    unsigned head, filled;        /* updates since the filter began anew */
    int32_t raw[CHANNELS];        /* last unfiltered values, in LSB */
    int32_t past[CHANNELS][HISTORY]; /* the outputs, for the rate-of-change alarms */
    unsigned taken;               /* values in the histories */
    int supply_low;               /* at the last update */
    int alarm_on[2];

    ps_t next_update, last_update;
    ps_t ready_until, asleep_until, test_until;
    ps_t null_until, busy_until;  /* end of what a command measures, and of the flash update behind it */
    uint16_t busy_command;
    int sleeping, waking, woken, deaf, in_reset;

    int cs, sck, mosi, rst;
    ps_t cs_fell, cs_rose, sck_fell, sck_rose, mosi_changed;
    int clocks, falls;
    uint16_t in_word, out_word, reply, previous;
    int fetch;                    /* register whose word the next frame brings, -1 none */
    uint16_t known, out_known;    /* bits of the reply that the sheet settles */
    int loose, out_loose;         /* its number is settled to 1 LSB: the rounding of a filter that fills is open */
    int unsure;                   /* an update came so close to a reading that the order is anybody's guess */
    int ignored;                  /* the frame now running is not heard */
    int miso, miso_before;
    ps_t miso_at;

    uint32_t counts[V_KINDS], logged;
    struct { ps_t at, measured; int kind; } log[LOG_ROOM];
    uint64_t frames, updates;
    ps_t least_stall, least_period, least_sclk, most_select;
};

static void violate(chip_t *c, int kind, ps_t at, ps_t measured)
{
    c->counts[kind]++;
    if (c->logged < LOG_ROOM) {
        c->log[c->logged].at = at;
        c->log[c->logged].measured = measured;
        c->log[c->logged].kind = kind;
        c->logged++;
    }
}

static int normal_mode(const chip_t *c)
{
    return (c->reg[SMPL_PRD / 2] & 0xFF) >= 0x0A; /* the time base's bit makes it slow as well */
}

static ps_t ms(double value)
{
    return (ps_t)llround(value * 1e9);
}

static ps_t sample_period(const chip_t *c)
{
    unsigned n = c->reg[SMPL_PRD / 2] & 0x7F;
    double base_ms = c->p.base_us * 1e-3 * ((c->reg[SMPL_PRD / 2] & 0x80) ? 31 : 1); /* 18.921 ms are 31 of them */
    if (n == 0 && !(c->reg[SMPL_PRD / 2] & 0x80) && c->p.smpl_zero_as_one != 0) {
        n = 1;
    }
    return ms(base_ms * (n + 1));
}

static int sign_extend(unsigned value, int bits)
{
    int sign = 1 << (bits - 1);
    return (int)(value & (unsigned)(2 * sign - 1)) - ((value & (unsigned)sign) ? 2 * sign : 0);
}

/* -- outputs ------------------------------------------------------------------------------------------------ */

static double gyro_lsb(const chip_t *c)
{
    switch ((c->reg[SENS_AVG / 2] >> 8) & 7) {
    case 1:
        return 0.018315;
    case 2:
        return 0.03663;
    default:
        return 0.07326;
    }
}

static double lsb(const chip_t *c, int channel)
{
    if (channel == IN_SUPPLY) {
        return 0.0018315;
    }
    if (channel <= IN_GYRO_Z) {
        return gyro_lsb(c);
    }
    if (channel <= IN_ACCL_Z) {
        return c->p.accl_lsb_mg;
    }
    if (channel <= IN_TEMP_Z) {
        return 0.1453;
    }
    return 0.0006105;
}

static double offset(const chip_t *c, int channel)
{
    if (channel >= IN_GYRO_X && channel <= IN_GYRO_Z) {
        return sign_extend(c->reg[XGYRO_OFF / 2 + channel - IN_GYRO_X], 13) * 0.018315;
    }
    if (channel >= IN_ACCL_X && channel <= IN_ACCL_Z) {
        return sign_extend(c->reg[XACCL_OFF / 2 + channel - IN_ACCL_X], 12) * c->p.accl_off_lsb_mg;
    }
    return 0;
}

static double stimulus(const chip_t *c, int channel)
{
    double sign = ((c->reg[MSC_CTRL / 2] >> 8) & 1) - (double)((c->reg[MSC_CTRL / 2] >> 9) & 1);
    if (channel >= IN_GYRO_X && channel <= IN_GYRO_Z) {
        return sign * c->p.self_test_gyro;
    }
    if (channel >= IN_ACCL_X && channel <= IN_ACCL_Z && sign > 0) {
        return c->p.self_test_accl; /* the accelerometers have the positive stimulus only */
    }
    return 0;
}

static double measured(const chip_t *c, int channel)
{
    return c->input[channel] - (channel >= IN_TEMP_X && channel <= IN_TEMP_Z ? 25.0 : 0.0) + stimulus(c, channel);
}

static int32_t to_counts(const chip_t *c, int channel, double value)
{
    int is_signed = channel >= IN_GYRO_X && channel <= IN_TEMP_Z;
    int bits = channel >= IN_GYRO_X && channel <= IN_ACCL_Z ? 14 : 12;
    double low = is_signed ? -(double)(1 << (bits - 1)) : 0;
    double high = is_signed ? (1 << (bits - 1)) - 1 : (1 << bits) - 1;
    double counts = floor(value / lsb(c, channel) + 0.5);
    return (int32_t)(counts < low ? low : counts > high ? high : counts);
}

static uint16_t to_bits(int channel, int32_t counts)
{
    return (uint16_t)(counts & (channel >= IN_GYRO_X && channel <= IN_ACCL_Z ? 0x3FFF : 0x0FFF));
}

/* Two boxcars of n taps after each other are a triangle of 2n - 1. */
static double filtered(const chip_t *c, int channel)
{
    unsigned m = c->reg[SENS_AVG / 2] & 7, n, k;
    double sum = 0;
    n = 1u << (m > 6 ? 6 : m);
    for (k = 0; k < 2 * n - 1; k++) {
        double weight = k < n ? k + 1 : 2 * n - 1 - k;
        sum += weight * c->history[channel][(c->head - k) & (HISTORY - 1)];
    }
    return sum / ((double)n * n);
}

static void fill_history(chip_t *c)
{
    int channel, k;
    c->filled = c->taken = 0;
    for (channel = 0; channel < CHANNELS; channel++) {
        double value = c->p.filter_zeros != 0 ? 0 : measured(c, channel);
        if (c->p.offset_after_filter == 0 && c->p.filter_zeros == 0) {
            value += offset(c, channel);
        }
        for (k = 0; k < HISTORY; k++) {
            c->history[channel][k] = value;
        }
    }
}

/* Source of an alarm: 1 supply, 2-4 gyros, 5-7 accelerometers, 8-10 temperatures, 11 auxiliary. */
static int alarm_stands(const chip_t *c, int which)
{
    uint16_t control = c->reg[ALM_CTRL / 2];
    unsigned source = (control >> (which ? 12 : 8)) & 0xF;
    uint16_t limit = c->reg[(which ? ALM_MAG2 : ALM_MAG1) / 2];
    int channel = (int)source - 1, is_signed, bits;
    double value, threshold;
    if (source == 0 || source > 11) {
        return 0;
    }
    is_signed = channel >= IN_GYRO_X && channel <= IN_TEMP_Z;
    bits = channel >= IN_GYRO_X && channel <= IN_ACCL_Z ? 14 : 12;
    threshold = is_signed ? sign_extend(limit, bits) : limit & ((1 << bits) - 1);
    value = control & (1 << 4) ? c->past[channel][c->head] : c->raw[channel];
    if (control & (which ? 1 << 7 : 1 << 6)) { /* mean change a sample over N differences */
        unsigned n = c->reg[(which ? ALM_SMPL2 : ALM_SMPL1) / 2] & 0xFF, then;
        n = n ? n : 1; /* open */
        then = (c->head - n) & (HISTORY - 1);
        if (c->taken <= n) {
            return 0;
        }
        value -= control & (1 << 4) ? c->past[channel][then]
                                    : to_counts(c, channel, c->history[channel][then] +
                                                            (c->p.offset_after_filter != 0 ? offset(c, channel) : 0));
        value /= n;
        threshold = sign_extend(limit, bits); /* open for the unsigned ones: a fall is a change as well */
    }
    return (limit & 0x8000) ? value > threshold : value < threshold;
}

static void update(chip_t *c, ps_t at)
{
    int channel, which;
    uint16_t standing = 0;
    double range = gyro_lsb(c) * 4095;
    c->updates++;
    c->filled++;
    c->taken++;
    c->head = (c->head + 1) & (HISTORY - 1);
    for (channel = 0; channel < CHANNELS; channel++) {
        double value = measured(c, channel), off = offset(c, channel);
        double felt = value - (c->p.self_test_over_range != 0 ? 0 : stimulus(c, channel));
        int after = c->p.offset_after_filter != 0;
        c->history[channel][c->head] = value + (after ? 0 : off);
        c->raw[channel] = to_counts(c, channel, value + off);
        c->past[channel][c->head] = to_counts(c, channel, filtered(c, channel) + (after ? off : 0));
        c->out[channel] = to_bits(channel, c->past[channel][c->head]);
        if (c->p.pattern != 0) {
            c->out[channel] = to_bits(channel, (int32_t)(c->updates + 100 * (unsigned)channel));
        }
        if (channel >= IN_GYRO_X && channel <= IN_GYRO_Z && c->p.gyro_overrange > 0 &&
            fabs(felt) > range * c->p.gyro_overrange) {
            standing |= ST_OVER_RANGE;
        }
        if (channel >= IN_ACCL_X && channel <= IN_ACCL_Z && fabs(felt) > c->p.accl_range_mg) {
            standing |= ST_OVER_RANGE;
        }
    }
    c->fresh = (1 << CHANNELS) - 1;
    c->supply_low = c->input[IN_SUPPLY] < 4.75;
    if (c->supply_low) {
        standing |= ST_SUPPLY_LOW;
    }
    if (c->input[IN_SUPPLY] > 5.25) {
        standing |= ST_SUPPLY_HIGH;
    }
    for (which = 0; which < 2; which++) {
        c->alarm_on[which] = alarm_stands(c, which);
        if (c->alarm_on[which]) {
            standing |= which ? ST_ALARM2 : ST_ALARM1;
        }
    }
    c->status = (uint16_t)((c->status & ~ST_FALLS) | standing);
    c->held_ea = c->status != 0;
    c->last_update = at;
}

/* -- time --------------------------------------------------------------------------------------------------- */

static void start_up(chip_t *c, ps_t now)
{
    uint16_t endurance = c->endurance;
    int k;
    for (k = 0; k < WORDS; k++) {
        c->reg[k] = (uint16_t)(c->flash[k] & kept[k]);
    }
    c->endurance = endurance;
    c->status = c->held_ea = 0;
    c->fresh = 0;
    memset(c->out, 0, sizeof c->out);
    memset(c->alarm_on, 0, sizeof c->alarm_on);
    c->reply = 0;
    c->known = 0;
    c->loose = 0;
    c->fetch = -1;
    c->sleeping = c->waking = c->woken = c->deaf = 0;
    c->busy_until = c->null_until = c->test_until = NEVER;
    c->busy_command = 0;
    c->last_update = NEVER;
    c->supply_low = 0;
    c->ready_until = now + ms(c->p.startup_ms);
    c->next_update = c->ready_until +
                     (c->p.first_update_us < 0 ? sample_period(c) : (ps_t)llround(c->p.first_update_us * 1e6));
    fill_history(c);
}

static void save(chip_t *c)
{
    int k;
    if (c->p.flash_needs_supply != 0 && c->supply_low) {
        c->status |= ST_FLASH;
        return;
    }
    for (k = 0; k < WORDS; k++) {
        c->flash[k] = (uint16_t)(c->reg[k] & kept[k]);
    }
    c->endurance = (uint16_t)((c->endurance + 1) & 0x7FFF);
}

static void null_gyros(chip_t *c)
{
    int k;
    for (k = 0; k < 3; k++) {
        int channel = IN_GYRO_X + k;
        double rate = filtered(c, channel) - (c->p.offset_after_filter != 0 ? 0 : offset(c, channel));
        int counts = (int)floor(-rate / 0.018315 + 0.5);
        counts = counts < -4096 ? -4096 : counts > 4095 ? 4095 : counts;
        c->reg[XGYRO_OFF / 2 + k] = (uint16_t)(counts & 0x1FFF);
    }
}

static void finish_command(chip_t *c, ps_t at)
{
    save(c);
    c->busy_command = 0;
    c->busy_until = NEVER;
    if (c->p.busy_restart != 0) {
        c->next_update = at + sample_period(c);
    }
}

static void awake(chip_t *c)
{
    c->next_update = c->ready_until + sample_period(c);
    if (c->p.filter_clears != 0) {
        fill_history(c);
    }
}

void chip_run(chip_t *c, ps_t now)
{
    for (;;) {
        ps_t at = c->next_update;
        int what = 0;
        if (c->busy_until != NEVER && c->busy_until < at) {
            at = c->busy_until;
            what = 1;
        }
        if (c->test_until != NEVER && c->test_until < at) {
            at = c->test_until;
            what = 2;
        }
        if (c->null_until != NEVER && c->null_until <= at) {
            at = c->null_until;
            what = 4;
        }
        if (c->sleeping && c->asleep_until < at) {
            at = c->asleep_until;
            what = 3;
        }
        if (at > now || c->in_reset) {
            return;
        }
        switch (what) {
        case 1:
            finish_command(c, at);
            break;
        case 4:
            c->null_until = NEVER;
            null_gyros(c);
            break;
        case 2:
            c->test_until = NEVER;
            if (c->p.busy_restart != 0) {
                c->next_update = at + sample_period(c);
            }
            c->reg[MSC_CTRL / 2] &= (uint16_t)~(1u << 10);
            if ((uint16_t)c->p.self_test_fails) {
                c->status |= (uint16_t)(ST_SELF_TEST | (uint16_t)c->p.self_test_fails);
            }
            break;
        case 3:
            c->sleeping = 0;
            c->waking = 1;
            c->ready_until = at + ms(c->p.wake_ms);
            awake(c);
            break;
        default:
            if (!c->sleeping && c->test_until == NEVER && (c->busy_until == NEVER || c->null_until != NEVER || c->p.busy_updates != 0)) {
                update(c, at);
            }
            c->next_update += sample_period(c);
        }
    }
}

ps_t chip_next_event(const chip_t *c, ps_t now)
{
    ps_t on = c->last_update + (ps_t)(c->p.dr_delay_us * 1e6), off = on + (ps_t)(c->p.dr_width_us * 1e6);
    if (c->in_reset) {
        return NEVER;
    }
    if (c->last_update != NEVER && on > now && on < c->next_update) {
        return on;
    }
    if (c->last_update != NEVER && off > now && off < c->next_update) {
        return off;
    }
    return c->next_update;
}

/* -- words --------------------------------------------------------------------------------------------------- */

static uint16_t read_register(chip_t *c, int address)
{
    int word = address / 2;
    c->known = 0xFFFF;
    c->loose = 0;
    if (word == ENDURANCE / 2) {
        return c->endurance;
    }
    if (word >= SUPPLY_OUT / 2 && word <= AUX_ADC / 2) {
        int channel = word - SUPPLY_OUT / 2;
        uint16_t value = c->out[channel];
        unsigned m = c->reg[SENS_AVG / 2] & 7;
        if (c->test_until != NEVER) { /* outputs are not available */
            c->known = 0;
            return 0;
        }
        if (channel == IN_SUPPLY || channel > IN_ACCL_Z) {
            c->known = 0xCFFF;
        }
        c->loose = c->filled < 2u * (1u << (m > 6 ? 6 : m)) - 1u;
        if (c->fresh & (1 << channel)) {
            value |= 0x8000;
        }
        if (c->p.ea_at_update != 0 ? c->held_ea : c->status != 0) {
            value |= 0x4000;
        }
        c->fresh &= (uint16_t)~(1u << channel);
        return value;
    }
    if (word == STATUS / 2) {
        uint16_t value = c->status;
        c->status = 0;
        return value;
    }
    if (word == COMMAND / 2 || word == 0x18 / 2) {
        c->known = 0;
        return 0;
    }
    if (word == GPIO_CTRL / 2) {
        uint16_t value = c->reg[word];
        unsigned line;
        for (line = 0; line < 2; line++) { /* an input shows its pin */
            if (!(value & (1u << line))) {
                value = (uint16_t)((value & ~(0x100u << line)) | ((((unsigned)c->p.gpio_pins >> line) & 1u) << (8 + line)));
            }
        }
        return value;
    }
    return c->reg[word];
}

static void command(chip_t *c, uint8_t bits, ps_t now)
{
    if (bits & CMD_RESET) {
        start_up(c, now);
        return;
    }
    if (c->busy_command & CMD_PRECISION) {
        return; /* only a reset ends it */
    }
    if (bits & CMD_RESTORE) {
        memset(&c->reg[XGYRO_OFF / 2], 0, 6 * sizeof c->reg[0]);
    }
    if (bits & (CMD_PRECISION | CMD_AUTONULL | CMD_RESTORE | CMD_FLASH)) {
        double takes = bits & CMD_PRECISION ? c->p.precision_null_ms : bits & CMD_AUTONULL ? c->p.autonull_ms : 0;
        c->busy_command = bits;
        c->null_until = bits & (CMD_PRECISION | CMD_AUTONULL) ? now + ms(takes) : NEVER;
        c->busy_until = now + ms(takes + c->p.flash_ms);
    }
}

static void write_byte(chip_t *c, int address, uint8_t byte, ps_t now)
{
    int word = address / 2, high = address & 1;
    uint16_t mask = writable[word], before = c->reg[word], value;
    if (word == COMMAND / 2) {
        if (!high) {
            command(c, byte, now);
        }
        return;
    }
    if (mask == 0) {
        return; /* read only, or reserved */
    }
    if (c->p.unused_bits_stick != 0) {
        mask = 0xFFFF;
    }
    value = high ? (uint16_t)((c->reg[word] & 0x00FF) | (byte << 8)) : (uint16_t)((c->reg[word] & 0xFF00) | byte);
    c->reg[word] = value & mask;
    if (c->reg[word] != before && (word == SMPL_PRD / 2 || word == SENS_AVG / 2)) {
        if (word == SMPL_PRD / 2 && c->p.smpl_restart != 0) {
            c->next_update = now + sample_period(c);
        }
        if (c->p.filter_clears != 0) {
            fill_history(c);
        }
    }
    if (word == MSC_CTRL / 2 && high && (byte & 4)) {
        c->test_until = now + ms(c->p.self_test_ms);
    }
    if (word == SLP_CNT / 2 && !high && byte) {
        c->sleeping = 1;
        c->asleep_until = now + ms(500.0 * byte);
        c->reg[word] = 0;
    }
}

/* -- lines --------------------------------------------------------------------------------------------------- */

static void least(ps_t *kept_value, ps_t value)
{
    if (*kept_value == NEVER || value < *kept_value) {
        *kept_value = value;
    }
}

static void drive_miso(chip_t *c, ps_t now, int level)
{
    c->miso_before = c->miso;
    c->miso = level;
    c->miso_at = now + T_DAV;
}

static void select_falls(chip_t *c, ps_t now)
{
    const struct limits *limit = &limits[normal_mode(c)];
    c->frames++;
    c->clocks = c->falls = 0;
    c->in_word = 0;
    c->ignored = 0;
    if (c->in_reset || (!c->waking && now < c->ready_until)) {
        violate(c, V_RESET_TRAFFIC, now, c->ready_until - now);
        c->ignored = 1;
    } else if (c->busy_command & CMD_RESTORE) {
        violate(c, V_RESTORE_TRAFFIC, now, c->busy_until - now);
        c->ignored = 1;
    } else if (c->sleeping) {
        c->sleeping = 0;
        c->waking = 1;
        c->woken = 1;
        c->ready_until = INT64_MAX / 2; /* counts from the pulse's end */
        c->next_update = c->ready_until;
        c->ignored = 1;
    } else if (c->waking && now < c->ready_until) {
        violate(c, V_WAKE_TRAFFIC, now, c->ready_until - now);
        c->ignored = 1;
    } else {
        c->waking = 0;
        if (c->cs_rose != NEVER) {
            ps_t high = now - c->cs_rose, period = now - c->cs_fell;
            if (high < limit->stall) {
                violate(c, V_STALL, now, high);
                c->deaf |= c->p.stall_locks != 0;
            }
            if (period < limit->period) {
                violate(c, V_PERIOD, now, period);
            }
            least(&c->least_stall, high);
            least(&c->least_period, period);
        }
    }
    if (!c->sck) {
        violate(c, V_MODE, now, 0);
    }
    if (c->fetch >= 0 && !c->ignored) {
        c->reply = read_register(c, c->fetch);
        c->fetch = -1;
    }
    c->out_word = c->reply;
    c->out_known = c->known;
    c->out_loose = c->loose;
    c->cs_fell = now;
    c->miso_before = HIGH_Z;
    /* Nothing is promised before the first edge: the wrong bit shows who samples there. */
    c->miso = c->ignored || c->deaf ? HIGH_Z : !(c->out_word >> 15);
    c->miso_at = now;
}

static void select_rises(chip_t *c, ps_t now)
{
    const struct limits *limit = &limits[normal_mode(c)];
    uint16_t word = c->in_word;
    int address = (word >> 8) & 0x3F;
    c->cs_rose = now;
    c->miso = HIGH_Z;
    c->miso_at = now;
    if (!c->sck) {
        violate(c, V_MODE, now, 0);
    }
    if (c->woken) {
        c->woken = 0;
        c->ready_until = now + ms(c->p.wake_ms);
        awake(c);
    }
    if (c->ignored || c->deaf) {
        return;
    }
    if ((c->last_update != NEVER && now - c->last_update < UNSURE) || c->next_update - now < UNSURE) {
        c->unsure = 1;
    }
    if (c->clocks != 16 || c->falls != 16) {
        violate(c, V_CLOCKS, now, c->clocks);
        if (c->p.short_frame_status != 0 && c->clocks) { /* a mere pulse of chip select is what wakes the part */
            c->status |= ST_SPI;
        }
        return;
    }
    if (now - c->sck_rose > c->most_select) {
        c->most_select = now - c->sck_rose;
    }
    if (word & 0x4000) {
        violate(c, V_BIT14, now, word);
    }
    c->previous = c->reply;
    if (!(word & 0x8000)) {
        if (c->p.latch_next != 0) {
            c->fetch = address;
        } else {
            c->reply = read_register(c, address);
        }
        return;
    }
    if (address / 2 == SLP_CNT / 2 && !(address & 1) && (word & 0xFF) && now - c->sck_rose > limit->sleep) {
        violate(c, V_SLEEP_SELECT, now, now - c->sck_rose);
    }
    c->known = 0;
    c->loose = 0;
    c->reply = c->p.write_reply < 0 ? c->previous : (uint16_t)c->p.write_reply;
    write_byte(c, address, (uint8_t)word, now);
}

void chip_cs(chip_t *c, ps_t now, int level)
{
    chip_run(c, now);
    if (level != c->cs) {
        c->cs = level;
        if (level) {
            select_rises(c, now);
        } else {
            select_falls(c, now);
        }
    }
}

void chip_sck(chip_t *c, ps_t now, int level)
{
    if (level == c->sck) {
        return;
    }
    c->sck = level;
    if (c->cs) {
        return;
    }
    if (!level) {
        const struct limits *limit = &limits[normal_mode(c)];
        if (c->falls == 0) {
            if (now - c->cs_fell < T_CS) {
                violate(c, V_SELECT, now, now - c->cs_fell);
            }
        } else {
            ps_t period = now - c->sck_fell;
            if (period < limit->sclk) {
                violate(c, V_SCLK_FAST, now, period);
            }
            if (period > SCLK_SLOWEST) {
                violate(c, V_SCLK_SLOW, now, period);
            }
            least(&c->least_sclk, period);
        }
        c->sck_fell = now;
        if (!c->ignored && !c->deaf) {
            drive_miso(c, now, c->falls < 16 ? (c->out_word >> (15 - c->falls)) & 1 : 0);
        }
        c->falls++;
    } else {
        if (c->mosi_changed != NEVER && now - c->mosi_changed < T_DSU) {
            violate(c, V_SETUP, now, now - c->mosi_changed);
        }
        c->sck_rose = now;
        c->in_word = (uint16_t)((c->in_word << 1) | (c->mosi ? 1 : 0));
        c->clocks++;
    }
}

void chip_mosi(chip_t *c, ps_t now, int level)
{
    if (level == c->mosi) {
        return;
    }
    c->mosi = level;
    c->mosi_changed = now;
    if (!c->cs && c->clocks && c->sck && now - c->sck_rose < T_DHD) {
        violate(c, V_HOLD, now, now - c->sck_rose);
    }
}

void chip_rst(chip_t *c, ps_t now, int level)
{
    chip_run(c, now);
    if (level == c->rst) {
        return;
    }
    c->rst = level;
    c->in_reset = !level;
    start_up(c, now);
}

int chip_miso(chip_t *c, ps_t now)
{
    if (c->cs) {
        return HIGH_Z;
    }
    return now >= c->miso_at ? c->miso : c->miso_before;
}

int chip_dio(chip_t *c, ps_t now, int line)
{
    uint16_t msc = c->reg[MSC_CTRL / 2], alarm = c->reg[ALM_CTRL / 2], gpio = c->reg[GPIO_CTRL / 2];
    chip_run(c, now);
    if (c->in_reset || (!c->waking && now < c->ready_until)) {
        return HIGH_Z;
    }
    if ((msc & 4) && (msc & 1) == line - 1) {
        ps_t on = c->last_update + (ps_t)(c->p.dr_delay_us * 1e6);
        int active = c->last_update != NEVER && now >= on && now < on + (ps_t)(c->p.dr_width_us * 1e6);
        return active == ((msc >> 1) & 1);
    }
    if ((alarm & 4) && (alarm & 1) == line - 1) {
        int on = c->p.alarm_line_held != 0 ? (c->status & (ST_ALARM1 | ST_ALARM2)) != 0 : c->alarm_on[0] || c->alarm_on[1];
        return on == ((alarm >> 1) & 1);
    }
    if (gpio & (1 << (line - 1))) {
        return (gpio >> (8 + line - 1)) & 1;
    }
    return HIGH_Z;
}

/* A host in mode 3: 2 * 16 half periods from the fall of chip select to its rise, a quarter of a clock at each end. */
int chip_frames(chip_t *c, int n, const struct frame *frames, struct answer *answers)
{
    int k, bit;
    c->unsure = 0;
    for (k = 0; k < n; k++) {
        const struct frame *frame = &frames[k];
        ps_t half = frame->half, t = frame->begin + half / 2;
        uint16_t reply = 0;
        chip_cs(c, frame->begin, 0);
        for (bit = 0; bit < frame->bits; bit++) {
            chip_sck(c, t, 0);
            chip_mosi(c, t, bit < 16 ? (frame->word >> (15 - bit)) & 1 : 0);
            t += half;
            reply = (uint16_t)((reply << 1) | (chip_miso(c, t) != 0)); /* nobody drives it: a pull-up */
            chip_sck(c, t, 1);
            t += half;
        }
        chip_cs(c, frame->begin + 2 * half * frame->bits, 1);
        answers[k].word = reply;
        answers[k].known = frame->bits != 16 ? 0 : c->deaf ? 0xFFFF : c->ignored ? 0 : c->out_known;
        answers[k].loose = (uint16_t)c->out_loose;
    }
    return c->unsure;
}

/* -- life, parameters, counters ------------------------------------------------------------------------------- */

chip_t *chip_new(void)
{
    chip_t *c = calloc(1, sizeof *c);
    if (c == NULL) {
        return NULL;
    }
    c->p = defaults;
    c->flash[SMPL_PRD / 2] = 0x0001;
    c->flash[SENS_AVG / 2] = 0x0402;
    c->input[IN_SUPPLY] = 5.0;
    c->input[IN_TEMP_X] = c->input[IN_TEMP_Y] = c->input[IN_TEMP_Z] = 25.0;
    c->input[IN_ACCL_Z] = -1000.0; /* level, Z up: the arrows point against the axes */
    c->cs = c->sck = c->rst = 1;
    c->cs_rose = c->cs_fell = c->mosi_changed = NEVER;
    c->least_stall = c->least_period = c->least_sclk = NEVER;
    c->most_select = NEVER;
    start_up(c, 0);
    return c;
}

void chip_free(chip_t *c)
{
    free(c);
}

void chip_power_on(chip_t *c, ps_t now)
{
    chip_run(c, now);
    start_up(c, now);
}

void chip_input(chip_t *c, ps_t now, int input, double value)
{
    chip_run(c, now);
    if (input >= 0 && input < INPUTS) {
        c->input[input] = value;
        c->filled = 0; /* the filter has to settle again */
    }
}

int chip_set(chip_t *c, const char *name, double value)
{
    size_t k;
    for (k = 0; k < NAMES; k++) {
        if (strcmp(names[k].name, name) == 0) {
            memcpy((char *)&c->p + names[k].at, &value, sizeof value);
            return 1;
        }
    }
    return 0;
}

double chip_get(const chip_t *c, const char *name)
{
    size_t k;
    double value = NAN;
    for (k = 0; k < NAMES; k++) {
        if (strcmp(names[k].name, name) == 0) {
            memcpy(&value, (const char *)&c->p + names[k].at, sizeof value);
        }
    }
    return value;
}

const char *chip_violation_name(int kind)
{
    return kind >= 0 && kind < V_KINDS ? violation_names[kind] : NULL;
}

uint32_t chip_violations(const chip_t *c, int kind)
{
    return kind >= 0 && kind < V_KINDS ? c->counts[kind] : 0;
}

int chip_violation(const chip_t *c, uint32_t k, ps_t *at, ps_t *value)
{
    if (k >= c->logged) {
        return -1;
    }
    *at = c->log[k].at;
    *value = c->log[k].measured;
    return c->log[k].kind;
}

uint64_t chip_frame_count(const chip_t *c)
{
    return c->frames;
}

uint64_t chip_update_count(const chip_t *c)
{
    return c->updates;
}

ps_t chip_extreme(const chip_t *c, const char *name)
{
    if (strcmp(name, "stall") == 0) {
        return c->least_stall;
    }
    if (strcmp(name, "period") == 0) {
        return c->least_period;
    }
    if (strcmp(name, "sclk") == 0) {
        return c->least_sclk;
    }
    return strcmp(name, "select") == 0 ? c->most_select : NEVER;
}

void chip_forget_extremes(chip_t *c)
{
    c->least_stall = c->least_period = c->least_sclk = c->most_select = NEVER;
}
