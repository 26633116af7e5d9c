/* Prints what a header's rates are for turns and scans out of the generator of sweep.c.
 *
 * A line a turn: three rates in fixed point, three in float, as hexadecimal words; before them the self-check.
 */
#include HEADER

#include "machine.h"

static int32_t within(uint32_t span)
{
    return (int32_t)(next() % span) - (int32_t)(span / 2);
}

int main(void)
{
    uint32_t k;
    int i;
    state = 12345UL;
    put_word((uint32_t)OF(_self_check)());
    put('\n');
    for (k = 0; k < SCANS; k++) {
        int32_t fixed[3];
        float single[3];
        OF(_scan) scan;
        OF(_turn) turn;
        turn.x = within(TURNS);
        turn.y = within(TURNS);
        turn.z = within(TURNS);
        scan.x = within(SPAN);
        scan.y = within(SPAN);
        scan.z = within(SPAN);
        scan.temperature = within(200000UL);
        scan.supply = (int32_t)(next() % 2000000UL);
#ifdef WORDS
        if (k % 3 == 0) {
            turn = OF(_turn_of_words)((uint16_t)turn.x, (uint16_t)turn.y, (uint16_t)turn.z, k % 2 ? 300 : k % 4 ? 150 : 75);
        }
#endif
        OF(_rates_udps)(&turn, &scan, fixed);
        OF(_rates_dps)(&turn, &scan, single);
        for (i = 0; i < 3; i++) {
            put_word((uint32_t)fixed[i]);
        }
        for (i = 0; i < 3; i++) {
            put_float(single[i]);
        }
        put('\n');
    }
    finish(0);
    return 0;
}
