/* The ADIS16354 at its pins: edges in, levels out. Written from the facts sheet of the part alone, as a second
 * opinion beside src/adis_gonio/sim: nothing is shared with it, neither code nor tables.
 *
 * Times are picoseconds. Calls come in the order of time. What the sheet leaves open is a parameter (chip_set).
 */
#ifndef CHIP_H
#define CHIP_H

#include <stdint.h>

typedef int64_t ps_t;

#define PS_US 1000000ll
#define PS_MS 1000000000ll

enum { HIGH_Z = -1, NEVER = -1 };

/* What a host may not do. */
enum violation {
    V_STALL,          /* chip select high for too short */
    V_PERIOD,         /* frames too close to each other */
    V_SCLK_FAST,      /* falling edges too close */
    V_SCLK_SLOW,      /* falling edges too far apart */
    V_CLOCKS,         /* not 16 clocks in a frame */
    V_MODE,           /* clock low where chip select falls or rises: not mode 3 */
    V_SELECT,         /* first clock edge too soon after chip select */
    V_SETUP,          /* MOSI changed too shortly before the rising edge */
    V_HOLD,           /* MOSI changed too shortly after it */
    V_BIT14,          /* bit 14 of a frame is set */
    V_RESET_TRAFFIC,  /* chip select low while the part starts up */
    V_SLEEP_SELECT,   /* chip select stayed low for too long after a write to SLP_CNT */
    V_WAKE_TRAFFIC,   /* a frame while the part wakes up */
    V_RESTORE_TRAFFIC, /* chip select low during a factory restore */
    V_KINDS
};

/* Inputs of the part: what it measures. */
enum input { IN_SUPPLY, IN_GYRO_X, IN_GYRO_Y, IN_GYRO_Z, IN_ACCL_X, IN_ACCL_Y, IN_ACCL_Z, IN_TEMP_X, IN_TEMP_Y, IN_TEMP_Z,
             IN_AUX, INPUTS }; /* V, deg/s, mg, degC, V */

typedef struct chip chip_t;

chip_t *chip_new(void); /* powered on at time 0 */
void chip_free(chip_t *chip);

/* Sets a parameter by its name (see chip.c); returns 0 where there is none. */
int chip_set(chip_t *chip, const char *name, double value);
double chip_get(const chip_t *chip, const char *name);
void chip_input(chip_t *chip, ps_t now, int input, double value);
/* Applies the parameters from power-on: forgets everything but flash and counters. */
void chip_power_on(chip_t *chip, ps_t now);

/* Lines that the host drives. */
void chip_cs(chip_t *chip, ps_t now, int level);
void chip_sck(chip_t *chip, ps_t now, int level);
void chip_mosi(chip_t *chip, ps_t now, int level);
void chip_rst(chip_t *chip, ps_t now, int level);

/* Lines that the part drives: 0, 1 or HIGH_Z. Line 1 is DIO1, 2 is DIO2. */
int chip_miso(chip_t *chip, ps_t now);
int chip_dio(chip_t *chip, ps_t now, int line);

/* Lets time pass; time after now at which a DIO line may change by itself, or NEVER. */
void chip_run(chip_t *chip, ps_t now);
ps_t chip_next_event(const chip_t *chip, ps_t now);

/* Frames made of edges; what came back, and how much of that the sheet settles. Returns 1 where an update came so
 * close to a reading that its place is open. */
struct frame { ps_t begin, half; uint16_t word, bits; };
struct answer { uint16_t word, known, loose; };
int chip_frames(chip_t *chip, int n, const struct frame *frames, struct answer *answers);

const char *chip_violation_name(int kind);
uint32_t chip_violations(const chip_t *chip, int kind);
/* Time and measured value of the k-th violation of all; returns its kind, or -1. */
int chip_violation(const chip_t *chip, uint32_t k, ps_t *at, ps_t *measured);
uint64_t chip_frame_count(const chip_t *chip);
uint64_t chip_update_count(const chip_t *chip);
/* Least (CS high, period, clock period) and most (CS low after the last clock) seen so far, or NEVER. */
ps_t chip_extreme(const chip_t *chip, const char *name);
void chip_forget_extremes(chip_t *chip);

#endif
