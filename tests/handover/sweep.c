/* Prints what a header's functions give for scans out of a generator that Python has too (sweep.py).
 *
 * A line a scan: gravity and angle in fixed point, gravity and angle in float, as hexadecimal words. The same on a
 * host, on a Cortex-M of QEMU (semihosting) and on an AVR in simavr (its console register).
 */
#include HEADER

#ifndef SCANS
#define SCANS 10000
#endif

#if defined(__AVR__)
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include "avr_mcu_section.h"
AVR_MCU(16000000, "atmega328p");
AVR_MCU_SIMAVR_CONSOLE(&GPIOR0);
static void put(char c) { GPIOR0 = (uint8_t)(c == '\n' ? '\r' : c); } /* simavr shows a line at its \r */
static void finish(int status)
{
    (void)status;
    cli();
    sleep_enable();
    sleep_cpu(); /* asleep without interrupts: simavr ends */
}
#elif defined(__arm__)
/* Semihosting (Arm, Semihosting for AArch32 and AArch64): SYS_WRITE0 and SYS_EXIT. */
static void call(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}
static void put(char c)
{
    static char line[256];
    static int n;
    line[n++] = c;
    if (c == '\n') {
        line[n] = 0;
        call(4, line);
        n = 0;
    }
}
static void finish(int status) { call(0x18, (const void *)(status ? 0x20023 : 0x20026)); }
#else
#include <stdio.h>
#include <stdlib.h>
static void put(char c) { putchar(c); }
static void finish(int status) { exit(status); }
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(name) JOIN(PREFIX, name)

static uint32_t state;

static uint32_t next(void)
{
    state = state * 1664525UL + 1013904223UL;
    return state >> 8;
}

static void put_word(uint32_t word)
{
    int bits;
    for (bits = 28; bits >= 0; bits -= 4) {
        put("0123456789abcdef"[(word >> bits) & 15]);
    }
    put(' ');
}

static void put_float(float value)
{
    union {
        float value;
        uint32_t word;
    } both;
    both.value = value;
    put_word(both.word);
}

int main(void);
int main(void)
{
    uint32_t k;
    state = 12345UL;
    put_word((uint32_t)OF(_self_check)());
    put('\n');
    for (k = 0; k < SCANS; k++) {
        int32_t fixed[3] = { 0, 0, 0 };
        float single[3] = { 0.0f, 0.0f, 0.0f };
        OF(_scan) scan;
        const uint32_t a = next(), b = next(), c = next(), t = next(), v = next();
        int i;
#ifdef WORDS
        if (k & 1) {
            scan = OF(_scan_of_words)((uint16_t)a, (uint16_t)b, (uint16_t)c, (uint16_t)t, (uint16_t)v);
        } else
#endif
        {
            scan.x = (int32_t)(a % SPAN) - (int32_t)(SPAN / 2);
            scan.y = (int32_t)(b % SPAN) - (int32_t)(SPAN / 2);
            scan.z = (int32_t)(c % SPAN) - (int32_t)(SPAN / 2);
            scan.temperature = (int32_t)(t % 200000UL) - 100000L;
            scan.supply = (int32_t)(v % 2000000UL);
        }
        OF(_correct_fixed)(&scan, fixed);
        OF(_correct_float)(&scan, single);
        for (i = 0; i < AXES; i++) {
            put_word((uint32_t)fixed[i]);
        }
        put_word((uint32_t)OF(ANGLE(udeg))(&scan));
        for (i = 0; i < AXES; i++) {
            put_float(single[i]);
        }
        put_float(OF(ANGLE(deg))(&scan));
        put('\n');
    }
    finish(0);
    return 0;
}

#if defined(__arm__)
void start(void);
void start(void)
{
#if defined(__ARM_FP)
    *(volatile uint32_t *)0xE000ED88UL |= 0x00F00000UL; /* CPACR: the FPU is on */
#endif
    main();
}

const struct {
    uint32_t stack;
    void (*reset)(void);
} vectors __attribute__((section(".vectors"), used)) = { 0x20003F00UL, start };
#endif
