/* What a program that compares a header with its reference needs of its machine: numbers out, and an end.
 *
 * On a host, on a Cortex-M of QEMU (semihosting) and on an AVR in simavr (its console register). The generator of
 * sweep.py and the names of the header are here too.
 */
#include <stdint.h>

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
