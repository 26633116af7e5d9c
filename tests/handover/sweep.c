/* Prints what a header's functions give for scans out of a generator that Python has too (sweep.py).
 *
 * A line a scan: gravity and angle in fixed point, gravity and angle in float, as hexadecimal words.
 */
#include HEADER

#ifndef SCANS
#define SCANS 10000
#endif

#include "machine.h"

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
