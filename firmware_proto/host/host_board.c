#include "host_board.h"

#include <string.h>

#include "gonio_board.h"
#include "gonio_core.h"

#define RING 65536u /* a power of two */

uint16_t (*host_frame_hook)(uint16_t word);

const uint16_t board_capabilities = GP_CAP_DATA_READY | GP_CAP_HARD_RESET;
const uint32_t board_clocks_hz[GP_CLOCKS] = {2000000ul, 1000000ul, 250000ul, 0ul, 0ul, 0ul};

struct ring {
    uint8_t bytes[RING];
    uint32_t head, tail;
};

static struct ring from_host, to_host;
static uint32_t now_us, clock_hz, stall, period, reset_us, lock_errors;
static uint16_t room_limit, counter;
static uint8_t falling_edge, locked;

/* -- the core's side ------------------------------------------------------------------------------- */

void board_set_timing(uint8_t clock, uint16_t stall_us, uint16_t period_us)
{
    clock_hz = board_clocks_hz[clock];
    stall = stall_us;
    period = period_us;
}

uint16_t board_frame(uint16_t word)
{
    now_us += period;
    return host_frame_hook != NULL ? host_frame_hook(word) : counter++;
}

void board_reset_chip(uint16_t low_us)
{
    reset_us += low_us;
}

void board_select_edge(uint8_t falling)
{
    falling_edge = falling;
}

uint32_t board_now_us(void)
{
    return now_us;
}

void board_lock(void)
{
    lock_errors += locked;
    locked = 1;
}

void board_unlock(void)
{
    lock_errors += locked == 0u;
    locked = 0;
}

uint8_t board_receive(uint8_t *byte)
{
    if (from_host.tail == from_host.head) {
        return 0;
    }
    *byte = from_host.bytes[from_host.tail++ % RING];
    return 1;
}

uint16_t board_receive_overruns(void)
{
    return 0;
}

uint16_t board_send_room(void)
{
    uint32_t used = to_host.head - to_host.tail;
    return used >= room_limit ? 0u : (uint16_t)(room_limit - used);
}

void board_send(uint8_t byte)
{
    to_host.bytes[to_host.head++ % RING] = byte;
}

void board_send_now(void)
{
}

uint8_t board_name(uint8_t *text, uint8_t room)
{
    static const char name[] = "host TEST1";
    uint8_t length = sizeof name - 1u;
    if (length > room) {
        length = room;
    }
    memcpy(text, name, length);
    return length;
}

/* -- the test's side --------------------------------------------------------------------------------- */

void host_start(void)
{
    from_host.head = from_host.tail = to_host.head = to_host.tail = 0;
    now_us = reset_us = lock_errors = 0;
    room_limit = 255;
    counter = 0;
    locked = 0;
    gonio_init();
}

uint32_t host_feed(const uint8_t *bytes, uint32_t count)
{
    uint32_t k = 0;
    while (k < count && from_host.head - from_host.tail < RING) {
        from_host.bytes[from_host.head++ % RING] = bytes[k++];
    }
    return k;
}

uint32_t host_take(uint8_t *bytes, uint32_t room)
{
    uint32_t k = 0;
    while (k < room && to_host.tail != to_host.head) {
        bytes[k++] = to_host.bytes[to_host.tail++ % RING];
    }
    return k;
}

void host_poll(uint32_t times)
{
    while (times-- > 0u) {
        gonio_poll();
    }
}

void host_set_time(uint32_t time_us)
{
    now_us = time_us;
}

void host_edge(void)
{
    gonio_on_edge(now_us);
}

void host_limit_room(uint16_t room)
{
    room_limit = room;
}

uint32_t host_timing(uint32_t *stall_us, uint32_t *period_us)
{
    *stall_us = stall;
    *period_us = period;
    return clock_hz;
}

uint8_t host_falling(void)
{
    return falling_edge;
}

uint32_t host_reset_us(void)
{
    return reset_us;
}

uint32_t host_lock_errors(void)
{
    return lock_errors;
}
